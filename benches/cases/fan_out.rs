//! One camera to 1, 4, 16 and 64 subscribers, each in a process of its own: latency of the last to hear, and what it costs the
//! camera's process.

use crate::hop::{role_nodes, text};
use crate::support::children::Role;
use crate::support::measure::Series;
use crate::support::nodes;
use crate::support::report::Row;

const COUNT: usize = 40;
const PERIOD_MS: usize = 100;

/// Measures each width of the fan.
pub fn run(emit: &mut dyn FnMut(Row)) {
    for readers in [1, 4, 16, 64] {
        let plain = plain_fan(readers);
        let ours = our_fan(readers);
        for (label, quantile) in [("median", 0.5), ("p99", 0.99)] {
            let (value, baseline) = (ours.quantile_us(quantile), plain.quantile_us(quantile));
            emit(Row::against(format!("one camera, {readers} readers, {label}"), value, "us", baseline));
        }
    }
}

fn all(mut sinks: Vec<Role>) -> Series {
    let mut series = Series::default();
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
    let sinks: Vec<Role> =
        (0..readers).map(|n| Role::start(&role_nodes(dir.path(), &graph, &format!("r{n}"), "", 0))).collect();
    let sinks = ready(sinks);
    let connect = (0..readers).map(|n| format!("r{n}")).collect::<Vec<_>>().join(",");
    let _camera = Role::start(&role_nodes(dir.path(), &graph, "camera", &connect, 0));
    all(sinks)
}

fn plain_fan(readers: usize) -> Series {
    let dir = tempfile::tempdir().expect("a folder");
    let socket = |n: usize| nodes::socket(dir.path(), &format!("r{n}"));
    let count = COUNT.to_string();
    let sinks =
        (0..readers).map(|n| Role::start(&text(&["plain-sink", &socket(n), "", "bench/image", &count]))).collect();
    let sinks = ready(sinks);
    let connect = (0..readers).map(socket).collect::<Vec<_>>().join(",");
    let period = PERIOD_MS.to_string();
    let _camera = Role::start(&text(&["plain-source", &connect, "bench/image", "921600", &count, &period]));
    all(sinks)
}

fn ready(mut roles: Vec<Role>) -> Vec<Role> {
    roles.iter_mut().for_each(Role::wait_ready);
    roles
}
