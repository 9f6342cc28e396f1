//! `carril set NODE path=value`: changes parameters of a running node between two of its steps, and with `--save` the graph file.

use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use carril_runtime::Registry;
use carril_runtime::control_plane::{Change, LiveNode, Outcome, Receipt};
use carril_runtime::parameters::{shown, unknown_path, value_at, with_values};
use clap::Args;
use serde_json::{Map, Value, json};

use super::params::find;
use crate::common::graph_edit::Prepared;
use crate::common::live::Run;
use crate::common::way::Target;
use crate::common::{assignments, output};

/// Arguments of `carril set`.
#[derive(Args)]
#[command(
    after_help = "The values are YAML. Either all of them come into force, between two steps of the node, or none does.

Examples:
  carril set lane threshold=180
  carril set lane threshold=otsu,min_contrast=25
  carril set sectors sectors.2.from_deg=-30 --save"
)]
pub struct SetArgs {
    /// The node, as `carril list` shows it
    #[arg(value_name = "NODE")]
    node: String,
    /// What shall be in force, for example threshold=180; several are divided by commas or blanks
    #[arg(value_name = "PATH=VALUE", required = true)]
    values: Vec<String>,
    /// Write the values into the graph file too; comments, order and style stay as they are
    #[arg(long)]
    save: bool,
    /// The receipt as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// Runs it. Exit code 1: the change was refused.
pub fn run(args: &SetArgs, registry: &Registry) -> Result<ExitCode> {
    let values = assignments::parse(&args.values)?;
    let run = Run::connect(&args.target)?;
    let graph = run.graph()?;
    let node = find(&graph, &args.node)?;
    for path in values.keys() {
        if let Some(why) = unknown_path(&node.schema, &node.config, path) {
            bail!("node `{}`: {why}", node.name);
        }
    }
    let wanted = with_values(&node.config, &values).map_err(anyhow::Error::msg)?;
    // What cannot be saved is said before the car drives differently.
    let prepared =
        args.save.then(|| Prepared::new(&graph.graph, &node.name, &values, &wanted, registry)).transpose()?;
    let receipt = run.change(&Change::Set { node: node.name.clone(), values: values.clone() })?;
    let done = receipt.outcome == Outcome::Done;
    let saved = prepared.as_ref().filter(|_| done);
    if let Some(prepared) = saved {
        prepared.save().with_context(|| told(node, &values, &receipt))?;
    }
    if args.json {
        output::json(&json!({ "receipt": receipt, "saved": saved.map(Prepared::path) }))?;
    } else if done {
        output::line(told(node, &values, &receipt))?;
        if let Some(prepared) = saved {
            output::line(format_args!("saved in {}", prepared.path().display()))?;
        }
    }
    if !done {
        if !args.json {
            eprintln!("error: {}", told(node, &values, &receipt));
        }
        return Ok(ExitCode::FAILURE);
    }
    Ok(ExitCode::SUCCESS)
}

/// `lane: threshold 190 -> 180, version 2, in force after 1.2 ms`
fn told(node: &LiveNode, values: &Map<String, Value>, receipt: &Receipt) -> String {
    let changed = |(path, value): (&String, &Value)| {
        let before = value_at(&node.config, path).map_or_else(|| "none".to_owned(), shown);
        format!("{path} {before} -> {}", shown(value))
    };
    let changes: Vec<String> = values.iter().map(changed).collect();
    let changes = changes.join(", ");
    let reason = receipt.reason.as_deref().unwrap_or("no reason was given");
    let name = &node.name;
    match receipt.outcome {
        Outcome::Done => {
            let version = receipt.to.split(':').next().unwrap_or_default();
            let took = receipt.took_ms.map_or_else(String::new, |ms| format!(" after {ms:.1} ms"));
            format!("{name}: {changes}, version {version}, in force{took}")
        }
        Outcome::RolledBack => format!("{name}: {changes}: taken back: {reason}"),
        Outcome::Refused | Outcome::Compared | Outcome::Planned => format!("{name}: {changes}: refused: {reason}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::common::graph_file::Usage;

    fn node() -> LiveNode {
        let config = json!({ "threshold": 190.0, "row_far": 0.75 });
        let (name, operator) = ("lane".to_owned(), "lane-detector".to_owned());
        LiveNode { name, operator, exec: None, version: 1, config, schema: Value::Null, fitting: Vec::new() }
    }

    fn receipt(outcome: Outcome, reason: Option<&str>) -> Receipt {
        let reason = reason.map(str::to_owned);
        let to = "2: lane-detector".to_owned();
        Receipt { node: "lane".into(), outcome, reason, to, took_ms: Some(1.21), ..Receipt::default() }
    }

    #[test]
    fn the_receipt_is_one_line() {
        let values = assignments::parse(&["threshold=180".into(), "row_far=0.7".into()]).expect("two values");
        let done = told(&node(), &values, &receipt(Outcome::Done, None));
        let expected = "lane: row_far 0.75 -> 0.7, threshold 190 -> 180, version 2, in force after 1.2 ms";
        assert_eq!(done, expected, "what, which version, how soon");
        let refused = told(&node(), &values, &receipt(Outcome::Refused, Some("got 300, allowed is 0 to 255")));
        assert!(refused.ends_with("refused: got 300, allowed is 0 to 255"), "{refused}");
    }

    #[test]
    fn wrong_values_are_a_wrong_command_line() {
        for text in ["threshold", "threshold=.nan", "=1"] {
            let error = assignments::parse(&[text.to_owned()]).expect_err("refused");
            assert!(error.is::<Usage>(), "{text}: {error}");
        }
        assert!(assignments::parse(&["a=1".into(), "a=2".into()]).is_err(), "given twice");
    }
}
