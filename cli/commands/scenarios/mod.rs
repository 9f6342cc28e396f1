//! `carril scenarios`: many drives of a graph that differ from each other, and a verdict over them.

mod drive;
mod regression;
mod run;
mod show;
mod shrink;
mod summary;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Result;
use carril_runtime::Registry;
use carril_runtime::scenario::Scenario;
use clap::{Args, Subcommand};

use crate::common::graph_file::{self, Shown};

/// Where scenarios are looked for by name.
const FOLDER: &str = "scenarios";

/// Arguments of `carril scenarios`.
#[derive(Args)]
#[command(
    after_help = "A scenario names a graph, what is drawn anew for each drive, and what counts as success. Each drive can be repeated \
        from the file and its seed alone (docs/scenarios.md).

Examples:
  carril scenarios run scenarios/lanes.yaml --runs 1000 --jobs 2
  carril scenarios run lanes --seed 7 --out results.jsonl --json | jq .success"
)]
pub struct ScenariosArgs {
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand)]
enum Action {
    /// Drive a scenario many times; exit code 1 when fewer succeed than it requires
    Run(run::RunArgs),
    /// One drive again, from its seed: what was drawn, the states with their reasons, the hash
    Show(show::ShowArgs),
    /// The smallest scenario in which a drive still fails, written as a file
    Shrink(shrink::ShrinkArgs),
}

/// Runs it.
pub fn run(args: &ScenariosArgs, registry: &Registry) -> Result<ExitCode> {
    match &args.action {
        Action::Run(args) => run::run(args, registry),
        Action::Show(args) => show::run(args, registry),
        Action::Shrink(args) => shrink::run(args, registry),
    }
}

/// Reads the scenario of a file, or of a name: `lanes` is `scenarios/lanes.yaml`. Problems go to standard error.
fn read(file: &Path, registry: &Registry) -> Result<Scenario> {
    let path = find(file);
    graph_file::must_be_a_file(&path)?;
    Scenario::read(&path, registry).map_err(|problems| {
        eprint!("{}", graph_file::render(&problems, graph_file::styled(&std::io::stderr())));
        Shown.into()
    })
}

fn find(file: &Path) -> PathBuf {
    let named = Path::new(FOLDER).join(file).with_extension("yaml");
    let is_name = file.components().count() == 1 && file.extension().is_none() && !file.exists();
    if is_name && named.is_file() { named } else { file.to_owned() }
}
