//! Operators for the tests of everything that watches over operators. `bad-lane` has the ports of `lane-detector` and finds the
//! lane as that does, until it misbehaves as its configuration tells it. `other-ports` has ports that fit nowhere.
//!
//! A copy of the program under the name of one operator has that one alone, as `carril swap --exec` wants it: `bad-lane`,
//! `other-ports`, and carril's own `decision` and `actuator` for tests that move them to a process of their own. `first-lane` is
//! `bad-lane` under another name, so that a test can begin with one binary and go on with another. `slow-to-start` takes longer to
//! come up than anybody waits, `dies-at-start` ends at once.

mod bad_lane;
mod estimate;
mod other_ports;

use std::process::ExitCode;
use std::time::Duration;

use carril_operators::actuator::Actuator;
use carril_operators::decision::Decision;
use carril_runtime::Registry;

/// Longer than a candidate has to start.
const SLOW: Duration = Duration::from_secs(12);

fn main() -> ExitCode {
    let program = std::env::current_exe().ok();
    let name = program.as_deref().and_then(|path| path.file_stem()?.to_str()).unwrap_or_default();
    if std::env::args().nth(1).is_some_and(|argument| argument == "process") {
        misbehave_as_process(name);
    }
    carril_runtime::process::main_from_arguments(&registry(name))
}

fn registry(name: &str) -> Registry {
    match name {
        "bad-lane" | "first-lane" | "slow-to-start" | "dies-at-start" => Registry::new().with::<bad_lane::BadLane>(),
        "other-ports" => Registry::new().with::<other_ports::OtherPorts>(),
        "decision" => Registry::new().with::<Decision>(),
        "actuator" => Registry::new().with::<Actuator>(),
        _ => Registry::new().with::<bad_lane::BadLane>().with::<other_ports::OtherPorts>(),
    }
}

fn misbehave_as_process(name: &str) {
    match name {
        "slow-to-start" => std::thread::sleep(SLOW),
        "dies-at-start" => std::process::exit(9),
        _ => {}
    }
}
