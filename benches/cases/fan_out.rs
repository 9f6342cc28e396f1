//! One camera to 1, 4, 16 and 64 readers, each in a process of its own, beside a plain Zenoh publisher with as many subscribers:
//! latency over all readers, and CPU time of all processes for each reading of a frame.

use std::time::Duration;

use crate::hop::{emit_latency, role_nodes, text};
use crate::support::children::Role;
use crate::support::measure::Series;
use crate::support::nodes;
use crate::support::report::Row;

const COUNT: usize = 60;
const PERIOD_MS: usize = 50;

/// Measures each width of the fan.
pub fn run(emit: &mut dyn FnMut(Row)) {
    for readers in [1, 4, 16, 64] {
        // In turn: with both at once, 130 processes would wake each other on the same cores.
        let plain = plain_fan(readers);
        let ours = our_fan(readers);
        emit_latency(emit, &format!("one camera, {readers} readers"), &ours, &plain);
        let (value, baseline) = (ours.cpu_per_message_us(), plain.cpu_per_message_us());
        emit(Row::against(format!("one camera, {readers} readers, CPU per reading"), value, "us", baseline));
    }
}

fn all(mut sinks: Vec<Role>, mut camera: Role) -> Series {
    let mut series: Series = camera.result();
    for sink in &mut sinks {
        series.add(&sink.result());
    }
    series
}

fn our_fan(readers: usize) -> Series {
    let dir = tempfile::tempdir().expect("a folder");
    let mut graph = format!(
        "robot: bench\nnodes:\n  camera:\n    operator: bench-source\n    config: {{ width: 640, height: 480, colour: true, \
         period_ms: {PERIOD_MS} }}\n"
    );
    for reader in 0..readers {
        let config = format!("inputs: {{ image: camera/image }}\n    config: {{ count: {COUNT} }}");
        graph += &["  r", &reader.to_string(), ":\n    operator: bench-sink\n    ", &config, "\n"].concat();
    }
    let sinks: Vec<Role> = (0..readers)
        .map(|n| Role::start(&role_nodes(dir.path(), &graph, &format!("r{n}"), "", Duration::ZERO)))
        .collect();
    let sinks = ready(sinks);
    let connect = (0..readers).map(|n| format!("r{n}")).collect::<Vec<_>>().join(",");
    let measured = Duration::from_millis((COUNT * PERIOD_MS) as u64);
    let mut camera = Role::start(&role_nodes(dir.path(), &graph, "camera", &connect, measured));
    camera.wait_ready();
    all(sinks, camera)
}

fn plain_fan(readers: usize) -> Series {
    let dir = tempfile::tempdir().expect("a folder");
    let socket = |n: usize| nodes::socket(dir.path(), &format!("r{n}"));
    let count = COUNT.to_string();
    let sinks =
        (0..readers).map(|n| Role::start(&text(&["plain-sink", &socket(n), "", "bench/image", &count]))).collect();
    let sinks = ready(sinks);
    let connect = (0..readers).map(socket).collect::<Vec<_>>().join(",");
    let period_us = (PERIOD_MS * 1000).to_string();
    let camera = Role::start(&text(&["plain-source", &connect, "bench/image", "921600", &count, &period_us]));
    all(sinks, camera)
}

fn ready(mut roles: Vec<Role>) -> Vec<Role> {
    roles.iter_mut().for_each(Role::wait_ready);
    roles
}
