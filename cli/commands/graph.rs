//! `carril graph FILE --format mermaid|dot|json`: the graph as a picture or as data. `carril schema`: the JSON Schema of graph
//! files, for editors.

use anyhow::Result;
use carril_runtime::Registry;
use carril_runtime::graph::render;
use clap::{Args, ValueEnum};

use crate::common::graph_file::{self, GraphArgs};
use crate::common::output;

/// Arguments of `carril graph`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril graph dataflow.yaml                                    for Markdown: ```mermaid ... ```
  carril graph dataflow.yaml --format dot | dot -Tsvg -o graph.svg
  carril graph dataflow.yaml --format json | jq '.nodes[].name'")]
pub struct GraphCommandArgs {
    #[command(flatten)]
    graph: GraphArgs,
    /// What to write
    #[arg(long, value_enum, default_value_t = Format::Mermaid)]
    format: Format,
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
    let graph = graph_file::read(&args.graph, registry)?;
    match args.format {
        Format::Mermaid => output::text(ended(&render::to_mermaid(&graph))),
        Format::Dot => output::text(ended(&render::to_dot(&graph))),
        Format::Json => output::json(&render::to_json(&graph)),
    }
}

/// Runs `carril schema`.
pub fn schema(registry: &Registry) -> Result<()> {
    output::json(&carril_runtime::graph::schema(registry))
}

fn ended(text: &str) -> String {
    format!("{}\n", text.trim_end())
}
