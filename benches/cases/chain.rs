//! From frame to steering: camera, lane detector, decision and actuator in four processes at 30 Hz, beside four plain Zenoh
//! programs that pass the same frame and the same small messages on without computing anything.

use std::path::Path;
use std::time::Duration;

use crate::hop::{emit_latency, role_nodes, text};
use crate::support::children::Role;
use crate::support::measure::Series;
use crate::support::nodes;
use crate::support::report::Row;

const ROUNDS: usize = 3;
const COUNT: usize = 150;
const PERIOD_MS: usize = 33;
/// A little different, so that the two chains seldom meet.
const PLAIN_PERIOD_US: &str = "33700";

/// Measures both chains, each round at the same time.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let (mut ours, mut plain) = (Series::default(), Series::default());
    for _ in 0..ROUNDS {
        let (plain_dir, own_dir) = (folder(), folder());
        let (mut plain_roles, mut own_roles) = (plain_chain(plain_dir.path()), our_chain(own_dir.path()));
        plain.add(&plain_roles[0].result());
        ours.add(&own_roles[0].result());
    }
    emit_latency(emit, "frame to steering, four processes", &ours, &plain);
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a folder")
}

/// The processes, the one that prints the result first.
fn our_chain(dir: &Path) -> Vec<Role> {
    let graph = format!(
        "robot: bench
nodes:
  camera:
    operator: bench-source
    config: {{ width: 640, height: 480, colour: true, period_ms: {PERIOD_MS} }}
  lane:
    operator: lane-detector
    inputs: {{ image: camera/image }}
  decision:
    operator: decision
    inputs: {{ lane: lane/lane }}
    config: {{ auto_start: true }}
  actuator:
    operator: actuator
    inputs: {{ command: decision/command }}
  sink:
    operator: bench-command-sink
    process: actuator
    inputs: {{ command: {{ from: actuator/command, queue: 16 }} }}
    config: {{ count: {COUNT} }}
"
    );
    [("actuator", ""), ("decision", "actuator"), ("lane", "decision"), ("camera", "lane")]
        .into_iter()
        .map(|(process, connect)| {
            let mut role = Role::start(&role_nodes(dir, &graph, process, connect, Duration::ZERO));
            role.wait_ready();
            role
        })
        .collect()
}

fn plain_chain(dir: &Path) -> Vec<Role> {
    let socket = |name: &str| nodes::socket(dir, name);
    let count = COUNT.to_string();
    let mut roles = vec![Role::start(&text(&["plain-sink", &socket("actuator"), "", "bench/command", &count]))];
    roles[0].wait_ready();
    for (name, next, from, to) in
        [("decision", "actuator", "bench/lane", "bench/command"), ("lane", "decision", "bench/image", "bench/lane")]
    {
        let mut relay = Role::start(&text(&["plain-relay", &socket(name), &socket(next), from, to]));
        relay.wait_ready();
        roles.push(relay);
    }
    roles.push(Role::start(&text(&[
        "plain-source",
        &socket("lane"),
        "bench/image",
        "921600",
        &count,
        PLAIN_PERIOD_US,
    ])));
    roles
}
