//! Operators for the tests of everything that watches over operators. `bad-lane` has the ports of `lane-detector` and finds the
//! lane as that does, until it misbehaves as its configuration tells it. `other-ports` has ports that fit nowhere.

mod bad_lane;
mod estimate;
mod other_ports;

use std::process::ExitCode;

use carril_runtime::Registry;

fn main() -> ExitCode {
    let registry = Registry::new().with::<bad_lane::BadLane>().with::<other_ports::OtherPorts>();
    carril_runtime::process::main_from_arguments(&registry)
}
