//! The program that serves the processes of graphs in the tests of the dashboard.

use std::process::ExitCode;

mod operators;

fn main() -> ExitCode {
    carril_runtime::process::main_from_arguments(&operators::registry())
}
