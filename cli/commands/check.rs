//! `carril check FILE...`: every problem of a graph file or a scenario file, at file:line:column, with a hint.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Result;
use carril_runtime::Registry;
use carril_runtime::graph::{Graph, Problems, ReadOptions};
use carril_runtime::scenario::Scenario;
use clap::Args;
use serde_json::Value;

use crate::common::graph_file::{self, OverrideArgs, Usage};
use crate::common::output;

/// Arguments of `carril check`.
#[derive(Args)]
#[command(after_help = "Exit code: 0 clean (warnings allowed), 1 problems, 2 wrong command line.

Examples:
  carril check dataflow.yaml
  carril check dataflows/hardware.yaml --devices
  carril check dataflow.yaml --set lane.threshold=300
  carril check dataflows/two-machines.yaml --machine laptop
  carril check scenarios/lanes.yaml
  carril check dataflow.yaml --json | jq -r '.[] | \"\\(.line): \\(.message)\"'")]
pub struct CheckArgs {
    /// Graph files, or scenario files: those have a `graph` and no `nodes`
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Also look whether cameras and serial ports are plugged in
    #[arg(long)]
    devices: bool,
    /// As this machine sees it, which runs nodes of the graph: what they need must be here, what the car needs need not
    #[arg(long, value_name = "NAME")]
    machine: Option<String>,
    /// The problems as a JSON list of {file, line, column, severity, rule, message, hint}
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    overrides: OverrideArgs,
}

/// Runs it.
pub fn run(args: &CheckArgs, registry: &Registry) -> Result<ExitCode> {
    args.files.iter().try_for_each(|file| graph_file::must_be_a_file(file))?;
    let (overrides, probe_devices) = (args.overrides.overrides.clone(), args.devices);
    let machine = args.machine.clone();
    let options = ReadOptions { overrides, probe_devices, machine, ..ReadOptions::default() };
    let mut errors = 0;
    let mut list = Vec::new();
    for file in &args.files {
        let (problems, clean) = if Scenario::is_one(file) {
            scenario(file, args, registry)?
        } else {
            match Graph::read(file, registry, &options) {
                Ok(graph) => (graph.warnings.clone(), Some(of_graph(&graph))),
                Err(problems) => (problems, None),
            }
        };
        errors += problems.errors();
        if args.json {
            list.extend(problems.to_json().as_array().cloned().unwrap_or_default());
        } else {
            show(file, clean, &problems)?;
        }
    }
    if args.json {
        output::json(&Value::Array(list))?;
    }
    Ok(if errors == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The problems of a scenario file, and what it is when there are none.
fn scenario(file: &Path, args: &CheckArgs, registry: &Registry) -> Result<(Problems, Option<String>)> {
    let of_graphs = [
        ("--set", !args.overrides.overrides.is_empty()),
        ("--devices", args.devices),
        ("--machine", args.machine.is_some()),
    ];
    if let Some((option, _)) = of_graphs.iter().find(|(_, given)| *given) {
        let file = file.display();
        return Err(Usage(format!("`{option}` is for graph files, `{file}` is a scenario file; check it alone")).into());
    }
    Ok(match Scenario::read(file, registry) {
        Ok(scenario) => (Problems::default(), Some(of_scenario(&scenario))),
        Err(problems) => (problems, None),
    })
}

fn of_scenario(scenario: &Scenario) -> String {
    let latencies = scenario.latency.iter().filter(|(_, ms)| ms.varies()).count();
    let drawn = output::counted((scenario.vary.len() + latencies) as u64, "value");
    format!("a scenario of {}, {drawn} drawn for each drive", scenario.graph.display())
}

fn of_graph(graph: &Graph) -> String {
    let connections: usize = graph.nodes.iter().map(|node| node.inputs.len()).sum();
    let elsewhere = |machine: &str| {
        let nodes = graph.nodes.iter().filter(|node| node.is_on(Some(machine))).count();
        format!(", {} on machine {machine}", output::counted(nodes as u64, "node"))
    };
    format!(
        "{} in {}, {}, {}{}",
        output::counted(graph.nodes.len() as u64, "node"),
        output::counted(graph.processes().len() as u64, "process"),
        output::counted(connections as u64, "connection"),
        output::counted(graph.budgets.len() as u64, "budget"),
        graph.machines().into_iter().map(elsewhere).collect::<String>(),
    )
}

/// `clean`: what the file holds, when nothing is wrong with it.
fn show(file: &Path, clean: Option<String>, problems: &Problems) -> Result<()> {
    if !problems.is_empty() {
        output::text(graph_file::render(problems, graph_file::styled(&std::io::stdout())))?;
    }
    clean.map_or(Ok(()), |clean| output::line(format_args!("{}: ok: {clean}", file.display())))
}
