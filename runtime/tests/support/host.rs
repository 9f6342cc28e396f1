//! The program that serves the processes of graphs in the tests of the supervisor. `supervise GRAPH RUNS_DIR` runs a graph, for
//! tests that kill the supervisor itself.

use std::path::Path;
use std::process::ExitCode;

use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::supervisor::{Options, Supervisor};

mod live_operators;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match &arguments[..] {
        [word, graph, runs_dir] if word == "supervise" => supervise(Path::new(graph), Path::new(runs_dir)),
        _ => carril_runtime::process::main_from_arguments(&live_operators::registry()),
    }
}

fn supervise(path: &Path, runs_dir: &Path) -> ExitCode {
    let registry = live_operators::registry();
    let graph = match Graph::read(path, &registry, &ReadOptions::default()) {
        Ok(graph) => graph,
        Err(problems) => {
            eprintln!("{problems:?}");
            return ExitCode::FAILURE;
        }
    };
    let options = Options { runs_dir: Some(runs_dir.to_owned()), ..Options::default() };
    match Supervisor::start(&graph, &registry, &options).and_then(carril_runtime::supervisor::Running::wait) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}
