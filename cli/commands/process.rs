//! `carril process --run-dir DIR --name NAME`: one process of a run. The supervisor starts it; it is not for people.

use std::path::PathBuf;
use std::process::ExitCode;

use carril_runtime::{Registry, process};
use clap::Args;

/// Arguments of `carril process`.
#[derive(Args)]
pub struct ProcessArgs {
    /// Folder of the run
    #[arg(long, value_name = "DIR")]
    run_dir: PathBuf,
    /// Name of the process
    #[arg(long, value_name = "NAME")]
    name: String,
}

/// Runs the nodes of the process until it is told to end.
pub fn run(args: &ProcessArgs, registry: &Registry) -> ExitCode {
    process::main(registry, &args.run_dir, &args.name)
}
