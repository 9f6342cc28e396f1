//! `carril start`, `stop`, `estop` and `reset`: a word to every node of the car, and who confirmed it.

use anyhow::{Result, bail};
use carril_messages::Control;
use carril_runtime::control_plane::ControlReply;
use carril_runtime::supervisor::SUPERVISOR;
use clap::Args;
use serde_json::json;

use crate::common::live::Run;
use crate::common::output;
use crate::common::way::Target;

/// Arguments of all four.
#[derive(Args)]
pub struct ControlArgs {
    /// Who confirmed and who did not, as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// Examples of `carril start`.
pub const START_HELP: &str = "A car that a fault or an e-stop has stopped needs `carril reset` first.

Examples:
  carril start
  carril reset && carril start";
/// Examples of `carril stop`.
pub const STOP_HELP: &str = "Stops the car, not the graph; that ends with Ctrl-C in the terminal of `carril run`.

Examples:
  carril stop
  carril stop --robot car2";
/// Examples of `carril estop`.
pub const ESTOP_HELP: &str =
    "Goes straight to every process, not by way of the supervisor. Exit code 1, with names, when one does not confirm.

Examples:
  carril estop || echo cut the power
  carril reset && carril start        # afterwards";
/// Examples of `carril reset`.
pub const RESET_HELP: &str = "Examples:
  carril reset
  carril reset && carril start";

/// Runs one of them.
pub fn run(args: &ControlArgs, word: Control) -> Result<()> {
    let run = Run::connect(&args.target)?;
    let (replies, errors) = split(run.control(word)?);
    let expected: Vec<&str> = run.file().processes.iter().map(|process| process.name.as_str()).collect();
    let missing = missing(&expected, &replies);
    if args.json {
        output::json_line(&json!({ "word": word, "confirmed": replies, "missing": missing, "errors": errors }))?;
    } else {
        output::line(confirmed(word, &replies))?;
    }
    if missing.is_empty() && errors.is_empty() {
        return Ok(());
    }
    let names = missing.iter().copied().chain(errors.iter().map(String::as_str)).collect::<Vec<_>>().join(", ");
    match word {
        Control::EStop => bail!("`estop` was not confirmed by {names}\nhint: cut the power; then see `carril top`"),
        _ => bail!("`{word}` was not confirmed by {names}\nhint: see `carril top` for what is down"),
    }
}

fn split(answers: Vec<Result<ControlReply, String>>) -> (Vec<ControlReply>, Vec<String>) {
    let mut split = (Vec::new(), Vec::new());
    for answer in answers {
        match answer {
            Ok(reply) if reply.process != SUPERVISOR => split.0.push(reply),
            Ok(_) => {}
            Err(error) => split.1.push(error),
        }
    }
    split.0.sort_by(|left, right| left.process.cmp(&right.process));
    split
}

fn missing<'a>(expected: &[&'a str], replies: &[ControlReply]) -> Vec<&'a str> {
    let silent = |name: &&&str| !replies.iter().any(|reply| reply.process == **name);
    expected.iter().filter(silent).copied().collect()
}

fn confirmed(word: Control, replies: &[ControlReply]) -> String {
    let names: Vec<&str> = replies.iter().map(|reply| reply.process.as_str()).collect();
    let nodes: usize = replies.iter().map(|reply| reply.nodes.len()).sum();
    let nodes = output::counted(nodes as u64, "node");
    let processes = output::counted(replies.len() as u64, "process");
    format!("{word}: confirmed by {nodes} in {processes}: {}", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_silent_process_is_named() {
        let reply = ControlReply { process: "bridge".into(), nodes: vec!["bridge".into()] };
        assert_eq!(missing(&["bridge", "vision"], std::slice::from_ref(&reply)), ["vision"], "it did not answer");
        assert_eq!(confirmed(Control::EStop, &[reply]), "estop: confirmed by 1 node in 1 process: bridge", "text");
    }
}
