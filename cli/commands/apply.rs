//! `carril apply`: makes the running graph that of a file, node by node, while the car drives.

use std::io::{BufRead, IsTerminal, Write as _};

use anyhow::Result;
use carril_runtime::Registry;
use carril_runtime::control_plane::{ApplyReceipt, ApplyRequest, NodeChange, Outcome, SwapTerms};
use carril_runtime::graph::Graph;
use carril_runtime::supervisor::plan::Plan;
use clap::Args;

use crate::common::graph_file::{self, GraphArgs, Shown, Usage};
use crate::common::live::Run;
use crate::common::way::Target;
use crate::common::{applied, output, time};

/// Arguments of `carril apply`.
#[derive(Args)]
#[command(
    after_help = "Shows what differs between the running graph and the file, asks, and carries it out: nodes are added, removed,
replaced, rewired, reconfigured and moved with the means of `carril swap`; the others keep running untouched. A node that
fails undoes what was done before it. Exit code 1 when it was refused or undone.

Examples:
  carril apply dataflow.yaml --dry-run
  carril apply dataflow.yaml
  carril apply dataflow.yaml --yes --set lane.threshold=180"
)]
pub struct ApplyArgs {
    #[command(flatten)]
    graph: GraphArgs,
    /// Only say what would be done
    #[arg(long, conflicts_with = "yes")]
    dry_run: bool,
    /// Do not ask
    #[arg(long, short)]
    yes: bool,
    /// How long each new version runs in shadow before it takes over
    #[arg(long, value_name = "TIME", default_value = "300ms", value_parser = time::parse_span)]
    shadow: std::time::Duration,
    /// Outputs after which a version before is let go
    #[arg(long = "probation", value_name = "OUTPUTS", default_value_t = SwapTerms::default().probation_outputs)]
    probation: u64,
    /// A step that takes longer is a stall
    #[arg(long, value_name = "MS", default_value_t = SwapTerms::default().stall_ms)]
    stall_ms: u64,
    /// The plan and the receipt as JSON, one object each
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// Runs `carril apply`.
pub fn run(args: &ApplyArgs, registry: &Registry) -> Result<()> {
    let graph = graph_file::read(&args.graph, registry)?;
    let run = Run::connect(&args.target.clone().for_robot(&graph.robot))?;
    let plan = run.apply(&request(args, &graph, None)?)?;
    show_plan(&plan, &graph, args)?;
    if plan.reason.is_some() {
        return Err(Shown.into());
    }
    if plan.changes.is_empty() || args.dry_run || !(args.yes || agreed()?) {
        return Ok(());
    }
    let receipt = run.apply(&request(args, &graph, Some(plan.changes))?)?;
    if args.json {
        output::json_line(&receipt)?;
    } else {
        output::line(applied::receipt(&receipt))?;
    }
    if receipt.outcome == Outcome::Done { Ok(()) } else { Err(Shown.into()) }
}

fn request(args: &ApplyArgs, graph: &Graph, agreed: Option<Vec<NodeChange>>) -> Result<ApplyRequest> {
    let terms = SwapTerms {
        shadow_ms: args.shadow.as_millis() as u64,
        probation_outputs: args.probation,
        stall_ms: args.stall_ms,
        ..SwapTerms::default()
    };
    // The running graph keeps its own seed.
    let plan = serde_json::to_value(Plan::new(graph, 0))?;
    Ok(ApplyRequest { plan, text: graph.text.clone(), terms, agreed })
}

fn show_plan(plan: &ApplyReceipt, graph: &Graph, args: &ApplyArgs) -> Result<()> {
    if args.json { output::json_line(plan) } else { output::line(applied::plan(plan, &graph.robot, &graph.path)) }
}

fn agreed() -> Result<bool> {
    if !std::io::stdin().is_terminal() {
        let reason = "nobody is there to ask: add --yes to carry this out, or --dry-run to only look at it";
        return Err(Usage(reason.to_owned()).into());
    }
    eprint!("Carry this out? [y/N] ");
    std::io::stderr().flush()?;
    let mut answer = String::new();
    std::io::stdin().lock().read_line(&mut answer)?;
    Ok(matches!(answer.trim().to_lowercase().as_str(), "y" | "yes"))
}
