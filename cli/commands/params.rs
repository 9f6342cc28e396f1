//! `carril params`: every parameter of the running nodes. `carril get`: the value of one. Both also read a graph file.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use carril_runtime::Registry;
use carril_runtime::control_plane::{LiveGraph, LiveNode};
use carril_runtime::parameters::{Parameter, parameters, shown, unknown_path, value_at};
use clap::Args;
use serde::Serialize;

use crate::common::graph_file::{self, GraphArgs, OverrideArgs};
use crate::common::live::Run;
use crate::common::way::Target;
use crate::common::{output, suggest};

/// Where parameters are read.
#[derive(Args)]
struct From {
    /// Read a graph file instead of the running graph
    #[arg(long, value_name = "FILE")]
    graph: Option<PathBuf>,
    #[command(flatten)]
    target: Target,
}

/// Arguments of `carril params`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril params lane
  carril params --json | jq '.[] | select(.value != .default)'
  carril params --graph dataflow.yaml")]
pub struct ParamsArgs {
    /// The node, as `carril list` shows it; all nodes when left out
    #[arg(value_name = "NODE")]
    node: Option<String>,
    /// JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    from: From,
}

/// Arguments of `carril get`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril get lane threshold
  carril get sectors sectors.0.from_deg
  carril get decision --json")]
pub struct GetArgs {
    /// The node, as `carril list` shows it
    #[arg(value_name = "NODE")]
    node: String,
    /// Path of the value, as `carril params` shows it; the whole configuration when left out
    #[arg(value_name = "PATH")]
    path: Option<String>,
    /// JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    from: From,
}

/// A parameter with its node.
#[derive(Serialize)]
struct Row<'a> {
    node: &'a str,
    #[serde(flatten)]
    parameter: Parameter,
}

/// Runs `carril params`.
pub fn params(args: &ParamsArgs, registry: &Registry) -> Result<()> {
    let graph = read(&args.from, registry)?;
    let nodes: Vec<&LiveNode> = match &args.node {
        Some(name) => vec![find(&graph, name)?],
        None => graph.nodes.iter().collect(),
    };
    let rows = nodes.into_iter().flat_map(|node| {
        let row = |parameter| Row { node: &node.name, parameter };
        parameters(&node.schema, &node.config).into_iter().map(row)
    });
    let rows: Vec<Row<'_>> = rows.collect();
    if args.json {
        return output::json(&rows);
    }
    let cells: Vec<Vec<String>> = rows.iter().map(cells).collect();
    output::text(output::table(&["NODE", "PATH", "VALUE", "DEFAULT", "RANGE", "UNIT", "WHAT IT DOES"], &cells))
}

fn cells(row: &Row<'_>) -> Vec<String> {
    let Parameter { path, value, default, range, unit, text } = &row.parameter;
    let default = default.as_ref().map_or_else(|| "-".to_owned(), shown);
    let sentence = text.split_once(". ").map_or(text.as_str(), |(first, _)| first).trim_end_matches('.');
    let unit = unit.clone().unwrap_or_default();
    vec![row.node.to_owned(), path.clone(), shown(value), default, range.to_string(), unit, sentence.to_owned()]
}

/// Runs `carril get`.
pub fn get(args: &GetArgs, registry: &Registry) -> Result<()> {
    let graph = read(&args.from, registry)?;
    let node = find(&graph, &args.node)?;
    let path = args.path.as_deref().unwrap_or_default();
    let Some(value) = value_at(&node.config, path) else {
        let why = unknown_path(&node.schema, &node.config, path);
        bail!("node `{}`: {}", node.name, why.unwrap_or_else(|| format!("`{path}` is not set")));
    };
    if args.json { output::json(value) } else { output::line(shown(value)) }
}

fn read(from: &From, registry: &Registry) -> Result<LiveGraph> {
    match &from.graph {
        Some(file) => of_file(file, registry),
        None => Run::connect(&from.target)?.graph(),
    }
}

/// As the graph would begin to run. Binaries of the user's own do not tell their parameters before they run.
fn of_file(file: &Path, registry: &Registry) -> Result<LiveGraph> {
    let overrides = OverrideArgs { overrides: Vec::new() };
    let graph = graph_file::read(&GraphArgs { file: file.to_owned(), overrides }, registry)?;
    let nodes = graph.nodes.iter().filter_map(|node| {
        let kind = node.kind()?;
        Some(LiveNode {
            name: node.name.clone(),
            operator: kind.name.to_owned(),
            exec: None,
            version: 1,
            config: kind.effective_config(&node.config),
            schema: kind.config_schema(),
            fitting: Vec::new(),
        })
    });
    Ok(LiveGraph { graph: file.to_owned(), nodes: nodes.collect() })
}

/// The node of that name.
pub fn find<'a>(graph: &'a LiveGraph, name: &str) -> Result<&'a LiveNode> {
    let names: Vec<&str> = graph.nodes.iter().map(|node| node.name.as_str()).collect();
    let Some(node) = graph.nodes.iter().find(|node| node.name == name) else {
        let otherwise = format!("there are {}", names.join(", "));
        bail!("there is no node `{name}`{}", suggest::hint(name, names.iter().copied(), &otherwise));
    };
    Ok(node)
}
