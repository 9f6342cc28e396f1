//! The nodes of a run as a table: what `top` shows again and again, and `run` at its end. Pure.

use std::collections::BTreeMap;

use carril_messages::{Health, InputHealth, Percentiles};
use carril_runtime::control_plane::MachineStatus;

use super::usage::Usage;
use super::{drive, output, time};

/// Names of the columns; `>` marks those that stand to the right.
pub const COLUMNS: [&str; 11] = [
    "NODE",
    "STATE",
    ">HZ",
    ">STEP p50/p99",
    ">LATENCY p50/p99",
    ">AGE p50/p99",
    ">OVERRUNS",
    ">LOST",
    ">DROPPED",
    ">ERRORS",
    ">RESTARTS",
];

/// Columns that only `top` has: what the node's process uses.
pub const USAGE_COLUMNS: [&str; 3] = ["PROCESS", ">CPU %", ">MEMORY"];

/// One row.
pub fn row(node: &Health) -> Vec<String> {
    let sum = |count: fn(&InputHealth) -> u64| node.inputs.iter().map(count).sum::<u64>();
    vec![
        node.node.clone(),
        drive::state_name(node.state).to_owned(),
        format!("{:.1}", node.rate_hz),
        pair(node.step_us, 1e-6),
        optional(node.latency_us, 1e-6),
        optional(node.age_ms, 1e-3),
        (node.overruns + node.missed_periods).to_string(),
        sum(|input| input.lost).to_string(),
        sum(|input| input.dropped + input.stale).to_string(),
        (node.errors + sum(|input| input.refused)).to_string(),
        node.restarts.to_string(),
    ]
}

/// The columns that only `top` has.
pub fn usage_row(node: &Health, usage: Option<Usage>) -> Vec<String> {
    let cpu = usage.and_then(|usage| usage.cpu_percent);
    vec![
        node.process.clone(),
        cpu.map_or_else(|| "-".to_owned(), |cpu| format!("{cpu:.1}")),
        usage.map_or_else(|| "-".to_owned(), |usage| output::bytes(usage.memory_b as f64)),
    ]
}

fn optional(percentiles: Option<Percentiles>, unit_s: f64) -> String {
    percentiles.map_or_else(|| "-".to_owned(), |percentiles| pair(percentiles, unit_s))
}

/// Median and 99th percentile: `3.1 ms / 4.9 ms`.
pub fn pair(percentiles: Percentiles, unit_s: f64) -> String {
    format!("{} / {}", time::span(percentiles.p50 * unit_s), time::span(percentiles.p99 * unit_s))
}

/// A machine that runs nodes of the graph: `elsewhere: laptop (joined): lane`.
pub fn elsewhere(machine: &MachineStatus) -> String {
    let joined = if machine.joined { "joined" } else { "not joined" };
    format!("elsewhere: {} ({joined}): {}", machine.machine, machine.nodes.join(", "))
}

/// What needs attention, a line each: last errors and refusals.
pub fn complaints(nodes: &[Health]) -> Vec<String> {
    let mut lines = Vec::new();
    for node in nodes {
        if let Some(error) = &node.last_error {
            lines.push(format!("{}: {}, the last: {error}", node.node, output::counted(node.errors, "error")));
        }
        for input in &node.inputs {
            if let Some(refusal) = &input.last_refusal {
                let samples = output::counted(input.refused, "sample");
                lines.push(format!("{}/{}: refused {samples}, the last: {refusal}", node.node, input.port));
            }
        }
        if node.budget_violations > 0 {
            let samples = output::counted(node.budget_violations, "sample");
            lines.push(format!("{}: {samples} older than the end-to-end budget", node.node));
        }
    }
    lines.extend(full_pools(nodes));
    lines
}

/// Processes whose shared memory was too small; the nodes of a process share it.
fn full_pools(nodes: &[Health]) -> impl Iterator<Item = String> {
    let pools: BTreeMap<&str, u64> = nodes.iter().map(|node| (node.process.as_str(), node.pool_fallbacks)).collect();
    let full = pools.into_iter().filter(|(_, fallbacks)| *fallbacks > 0);
    full.map(|(process, fallbacks)| {
        let payloads = output::counted(fallbacks, "large payload");
        format!("process {process}: {payloads} found no room in shared memory, and went through the socket")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_has_a_cell_for_every_column() {
        let node = Health { node: "lane".into(), rate_hz: 29.97, ..Health::default() };
        assert_eq!(row(&node).len(), COLUMNS.len(), "node columns");
        assert_eq!(usage_row(&node, None).len(), USAGE_COLUMNS.len(), "usage columns");
        assert_eq!(row(&node)[2], "30.0", "the rate");
        assert_eq!(row(&node)[4], "-", "no latency is no number");
    }

    #[test]
    fn errors_and_refusals_are_told() {
        let refusal = Some("too short".to_owned());
        let input = InputHealth { port: "image".into(), refused: 2, last_refusal: refusal, ..InputHealth::default() };
        let (node, last_error, inputs) = ("lane".to_owned(), Some("no rows".to_owned()), vec![input]);
        let node = Health { node, errors: 1, last_error, inputs, ..Health::default() };
        let expected = ["lane: 1 error, the last: no rows", "lane/image: refused 2 samples, the last: too short"];
        assert_eq!(complaints(&[node]), expected, "both");
    }

    #[test]
    fn a_full_pool_is_told_once_for_each_process() {
        let node =
            |process: &str, pool_fallbacks| Health { process: process.into(), pool_fallbacks, ..Health::default() };
        let told = complaints(&[node("vision", 3), node("vision", 3), node("lane", 0)]);
        let expected = "process vision: 3 large payloads found no room in shared memory, and went through the socket";
        assert_eq!(told, [expected], "not for each node, and not where there was room");
    }
}
