//! From frame to steering: camera, lane detector, decision and actuator in four processes at 30 Hz, beside four plain Zenoh
//! programs that pass the same frame and the same small messages on without computing anything.

use crate::hop::{role_nodes, text};
use crate::support::children::Role;
use crate::support::measure::Series;
use crate::support::nodes;
use crate::support::report::Row;

const ROUNDS: usize = 3;
const COUNT: usize = 150;
const PERIOD_MS: usize = 33;

/// Measures both chains in turn.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let (mut ours, mut plain) = (Series::default(), Series::default());
    for _ in 0..ROUNDS {
        plain.add(&plain_chain());
        ours.add(&our_chain());
    }
    for (label, quantile) in [("median", 0.5), ("p99", 0.99)] {
        let (value, baseline) = (ours.quantile_us(quantile), plain.quantile_us(quantile));
        emit(Row::against(format!("frame to steering, four processes, {label}"), value, "us", baseline));
    }
}

fn our_chain() -> Series {
    let dir = tempfile::tempdir().expect("a folder");
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
    let mut roles: Vec<Role> = [("actuator", ""), ("decision", "actuator"), ("lane", "decision"), ("camera", "lane")]
        .into_iter()
        .map(|(process, connect)| {
            let mut role = Role::start(&role_nodes(dir.path(), &graph, process, connect, 0));
            role.wait_ready();
            role
        })
        .collect();
    roles[0].result()
}

fn plain_chain() -> Series {
    let dir = tempfile::tempdir().expect("a folder");
    let socket = |name: &str| nodes::socket(dir.path(), name);
    let count = COUNT.to_string();
    let mut sink = Role::start(&text(&["plain-sink", &socket("actuator"), "", "bench/command", &count]));
    sink.wait_ready();
    let mut relays = Vec::new();
    for (name, next, from, to) in
        [("decision", "actuator", "bench/lane", "bench/command"), ("lane", "decision", "bench/image", "bench/lane")]
    {
        let mut relay = Role::start(&text(&["plain-relay", &socket(name), &socket(next), from, to]));
        relay.wait_ready();
        relays.push(relay);
    }
    let period = PERIOD_MS.to_string();
    let _camera = Role::start(&text(&["plain-source", &socket("lane"), "bench/image", "921600", &count, &period]));
    sink.result()
}
