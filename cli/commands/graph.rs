//! `carril graph FILE --format mermaid|dot|json`: the graph as a picture or as data. `carril graph --live`: the running one, with what
//! flows. `carril schema`: the JSON Schema of graph files, for editors.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Result;
use carril_runtime::Registry;
use carril_runtime::control_plane::Status;
use carril_runtime::graph::render;
use clap::{Args, ValueEnum};
use serde_json::json;

use crate::common::graph_file::{self, GraphArgs, OverrideArgs};
use crate::common::live::Run;
use crate::common::way::Target;
use crate::common::{flow, interrupt, output, time};

/// Arguments of `carril graph`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril graph dataflow.yaml                                    for Markdown: ```mermaid ... ```
  carril graph dataflow.yaml --format dot | dot -Tsvg -o graph.svg
  carril graph dataflow.yaml --format json | jq '.nodes[].name'
  carril graph --live                                           the running one, from sensors to wheels, anew each second
  carril graph --live -n 1 --json")]
pub struct GraphCommandArgs {
    /// The graph file
    #[arg(value_name = "FILE", required_unless_present = "live", conflicts_with = "live")]
    file: Option<PathBuf>,
    #[command(flatten)]
    overrides: OverrideArgs,
    /// What to write
    #[arg(long, value_enum, default_value_t = Format::Mermaid, conflicts_with = "live")]
    format: Format,
    /// The running graph: state of each node, rate, bandwidth and losses of each edge, anew each second
    #[arg(long, conflicts_with = "overrides")]
    live: bool,
    /// With --live: one JSON object a second
    #[arg(long, requires = "live")]
    json: bool,
    /// With --live: end after this time, for example 30s or 2m
    #[arg(long = "for", value_name = "DURATION", value_parser = time::parse, requires = "live")]
    duration: Option<Duration>,
    /// With --live: end after N looks, one a second
    #[arg(short = 'n', long = "count", value_name = "N", value_parser = clap::value_parser!(u64).range(1..), requires = "live")]
    count: Option<u64>,
    #[command(flatten)]
    target: Target,
}

#[derive(Clone, Copy, ValueEnum)]
enum Format {
    /// For Markdown pages
    Mermaid,
    /// For Graphviz
    Dot,
    /// For programs
    Json,
}

/// Arguments of `carril schema`.
#[derive(Args)]
#[command(after_help = "Example, with the YAML extension of an editor:
  carril schema > carril.schema.json
  # yaml-language-server: $schema=carril.schema.json      (first line of dataflow.yaml)")]
pub struct SchemaArgs {}

/// Runs `carril graph`.
pub fn run(args: &GraphCommandArgs, registry: &Registry) -> Result<()> {
    let Some(file) = &args.file else { return live(args) };
    let overrides = OverrideArgs { overrides: args.overrides.overrides.clone() };
    let graph = graph_file::read(&GraphArgs { file: file.clone(), overrides }, registry)?;
    match args.format {
        Format::Mermaid => output::text(ended(&render::to_mermaid(&graph))),
        Format::Dot => output::text(ended(&render::to_dot(&graph))),
        Format::Json => output::json(&render::to_json(&graph)),
    }
}

/// What flows lies between two looks: the first one is shown only where nothing else is awaited.
fn live(args: &GraphCommandArgs) -> Result<()> {
    let run = Run::connect(&args.target)?;
    let stopped = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&stopped);
    interrupt::on_interrupt(move || stop.store(true, Ordering::Relaxed))?;
    let end = args.duration.map(|duration| Instant::now() + duration);
    let over = || stopped.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end);
    let mut before = None;
    let mut shown = 0;
    while !over() && args.count.is_none_or(|count| shown < count) {
        let Some(status) = run.next_status(Duration::from_millis(200)) else {
            anyhow::ensure!(run.is_alive(), "the graph of robot `{}` has ended", run.file().robot);
            continue;
        };
        if before.is_some() {
            show(args, &run, before.as_ref(), &status)?;
            shown += 1;
        }
        before = Some(status);
    }
    Ok(())
}

fn show(args: &GraphCommandArgs, run: &Run, before: Option<&Status>, now: &Status) -> Result<()> {
    // Nodes may have come and gone meanwhile.
    let file = run.client().run().unwrap_or_else(|_| run.file().clone());
    let stages = flow::stages(&file.nodes, before, now);
    if args.json {
        return output::json_line(&json!({ "uptime_s": now.uptime_s, "fault": now.fault, "nodes": stages }));
    }
    let title = format!("{}  {}  up {}", file.robot, file.graph.display(), time::clock(now.uptime_s));
    // In a terminal each look takes the place of the last.
    let clear = if std::io::stdout().is_terminal() { "\x1b[H\x1b[2J" } else { "" };
    output::text(format_args!("{clear}{}\n", flow::as_text(&title, &stages, now)))
}

/// Runs `carril schema`.
pub fn schema(registry: &Registry) -> Result<()> {
    output::json(&carril_runtime::graph::schema(registry))
}

fn ended(text: &str) -> String {
    format!("{}\n", text.trim_end())
}
