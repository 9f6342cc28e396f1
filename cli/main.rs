//! `carril`: checks, runs, simulates and watches dataflow graphs of small autonomous cars.
//!
//! This file reads the command line, hands over to one file per command, and turns the result into an exit code: 0 ok,
//! 1 problems, 2 usage.

mod commands;
mod common;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Parser, Subcommand};

use commands::{check, graph, operators, sim};
use common::graph_file::{Shown, Usage};
use common::output::ClosedPipe;
use common::registry;

/// Runs small autonomous cars as a graph of operators
#[derive(Parser)]
#[command(name = "carril", version, max_term_width = 110)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Report every problem of a graph file
    Check(check::CheckArgs),
    /// Run a graph in lockstep: virtual time, deterministic, faster than real time
    Sim(sim::SimArgs),
    /// Write a graph as Mermaid, Graphviz or JSON
    Graph(graph::GraphCommandArgs),
    /// Write the JSON Schema of graph files, for editors
    Schema(graph::SchemaArgs),
    /// List the kinds of operators, their ports and configuration
    Operators(operators::OperatorsArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    start_logging();
    match run(cli.command) {
        Ok(code) => code,
        Err(error) if error.is::<ClosedPipe>() => ExitCode::SUCCESS,
        Err(error) if error.is::<Shown>() => ExitCode::FAILURE,
        Err(error) if error.is::<Usage>() => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Logs go to standard error; `CARRIL_LOG=info` or `CARRIL_LOG=carril_runtime=debug` shows more than warnings.
fn start_logging() {
    let filter = tracing_subscriber::EnvFilter::try_from_env("CARRIL_LOG");
    let filter = filter.unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_target(false).init();
}

fn run(command: Command) -> Result<ExitCode> {
    let registry = registry::built_in();
    match command {
        Command::Check(args) => return check::run(&args, &registry),
        Command::Sim(args) => sim::run(&args, &registry)?,
        Command::Graph(args) => graph::run(&args, &registry)?,
        Command::Schema(_) => graph::schema(&registry)?,
        Command::Operators(args) => operators::run(&args, &registry)?,
    }
    Ok(ExitCode::SUCCESS)
}
