//! `my-lane`: a program with one operator for graphs of carril. `my-lane --help` says how to use it.

mod detector;

use std::process::ExitCode;

use carril_runtime::Registry;

fn main() -> ExitCode {
    carril_runtime::process::main_from_arguments(&Registry::new().with::<detector::Detector>())
}
