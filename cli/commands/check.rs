//! `carril check FILE...`: every problem of a graph file, at file:line:column, with a hint.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Result;
use carril_runtime::Registry;
use carril_runtime::graph::{Graph, Problems, ReadOptions};
use clap::Args;
use serde_json::Value;

use crate::common::graph_file::{self, OverrideArgs};
use crate::common::output;

/// Arguments of `carril check`.
#[derive(Args)]
#[command(after_help = "Exit code: 0 clean (warnings allowed), 1 problems, 2 wrong command line.

Examples:
  carril check dataflow.yaml
  carril check dataflows/hardware.yaml --devices
  carril check dataflow.yaml --set lane.threshold=300
  carril check dataflows/two-machines.yaml --machine laptop
  carril check dataflow.yaml --json | jq -r '.[] | \"\\(.line): \\(.message)\"'")]
pub struct CheckArgs {
    /// Graph files
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
        let result = Graph::read(file, registry, &options);
        let problems = match &result {
            Ok(graph) => &graph.warnings,
            Err(problems) => problems,
        };
        errors += problems.errors();
        if args.json {
            list.extend(problems.to_json().as_array().cloned().unwrap_or_default());
        } else {
            show(file, result.as_ref().ok(), problems)?;
        }
    }
    if args.json {
        output::json(&Value::Array(list))?;
    }
    Ok(if errors == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn show(file: &Path, graph: Option<&Graph>, problems: &Problems) -> Result<()> {
    if !problems.is_empty() {
        output::text(graph_file::render(problems, graph_file::styled(&std::io::stdout())))?;
    }
    let Some(graph) = graph else { return Ok(()) };
    let connections: usize = graph.nodes.iter().map(|node| node.inputs.len()).sum();
    let elsewhere = |machine: &str| {
        let nodes = graph.nodes.iter().filter(|node| node.is_on(Some(machine))).count();
        format!(", {} on machine {machine}", output::counted(nodes as u64, "node"))
    };
    output::line(format_args!(
        "{}: ok: {} in {}, {}, {}{}",
        file.display(),
        output::counted(graph.nodes.len() as u64, "node"),
        output::counted(graph.processes().len() as u64, "process"),
        output::counted(connections as u64, "connection"),
        output::counted(graph.budgets.len() as u64, "budget"),
        graph.machines().into_iter().map(elsewhere).collect::<String>(),
    ))
}
