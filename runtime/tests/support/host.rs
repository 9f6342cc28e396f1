//! The program that serves the processes of graphs in the tests of the supervisor.

use std::process::ExitCode;

mod live_operators;

fn main() -> ExitCode {
    carril_runtime::process::main_from_arguments(&live_operators::registry())
}
