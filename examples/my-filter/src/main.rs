//! `my-filter`: a program with one operator for graphs of carril. `my-filter --help` says how to use it.

mod filter;

use std::process::ExitCode;

use carril_runtime::Registry;

fn main() -> ExitCode {
    carril_runtime::process::main_from_arguments(&Registry::new().with::<filter::Filter>())
}
