//! Chains of 5 to 200 nodes that pass a small message on, ten a second: what a node costs, each in a process of its own and all
//! in one process. Beside each figure stands that of the shortest chain: 1.0 means that nodes cost the same however many.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use crate::hop::role_nodes;
use crate::support::children::Role;
use crate::support::measure;
use crate::support::report::Row;

const LENGTHS: [usize; 5] = [5, 20, 50, 100, 200];
const PERIOD_MS: u64 = 100;
const MEASURED: Duration = Duration::from_secs(4);
/// At least so much memory stays free, B.
const SPARE_BYTES: u64 = 1 << 30;
/// Assumed of the first chain, before there is a measurement, B.
const PROCESS_BYTES: u64 = 32 << 20;

/// What a chain came to.
struct Cost {
    /// From the start of the first process to the first message at the last node, s.
    start_s: f64,
    cpu_per_message_us: f64,
    resident_mb: f64,
    proportional_mb: f64,
    processes: usize,
}

/// Measures all lengths.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let mut first: BTreeMap<String, f64> = BTreeMap::new();
    for (arrangement, own_processes) in [("a process each", true), ("one process", false)] {
        let mut process_bytes = PROCESS_BYTES;
        for nodes in LENGTHS {
            let (needed, free) = (process_bytes * nodes as u64 + SPARE_BYTES, available_bytes());
            if own_processes && needed > free {
                eprintln!(
                    "not run: {nodes} processes need {} MiB of memory, {} MiB are free",
                    needed >> 20,
                    free >> 20
                );
                continue;
            }
            let cost = measure_chain(nodes, own_processes);
            process_bytes = (cost.proportional_mb * 1e6) as u64 / cost.processes as u64;
            let per_node = |total: f64| total / nodes as f64;
            for (what, value, unit) in [
                ("start per node", per_node(cost.start_s) * 1e3, "ms"),
                ("CPU per node and message", cost.cpu_per_message_us, "us"),
                ("RSS per node", per_node(cost.resident_mb), "MB"),
                ("PSS per node", per_node(cost.proportional_mb), "MB"),
            ] {
                let baseline = *first.entry(format!("{arrangement} {what}")).or_insert(value);
                emit(Row::against(format!("{nodes} nodes, {arrangement}: {what}"), value, unit, baseline));
            }
            emit(Row::alone(
                format!("{nodes} nodes, {arrangement}: start to the last node's first message"),
                cost.start_s,
                "s",
            ));
        }
    }
}

fn measure_chain(nodes: usize, own_processes: bool) -> Cost {
    let dir = tempfile::tempdir().expect("a folder");
    let graph = graph(nodes, own_processes);
    let process = |index: usize| format!("n{index}");
    let begun_ns = measure::monotonic_ns();
    let count = if own_processes { nodes } else { 1 };
    // A later process connects to the earlier one whose output it reads, as in a real run.
    let mut roles: Vec<Role> = (0..count)
        .map(|index| {
            let connect = index.checked_sub(1).map_or_else(String::new, process);
            Role::start(&role_nodes(dir.path(), &graph, &process(index), &connect, Duration::ZERO))
        })
        .collect();
    let (last, others) = roles.split_last_mut().expect("a chain has a process");
    others.iter_mut().for_each(Role::wait_ready);
    // Which comes first is open where all nodes share a process.
    let arrived_ns: u64 = [last.line(), last.line()].iter().find_map(|line| line.parse().ok()).expect("the arrival");
    let pids: Vec<u32> = roles.iter().map(Role::pid).collect();
    let (cpu_at_start, started) = (cpu_us(&pids), Instant::now());
    std::thread::sleep(MEASURED);
    let messages = started.elapsed().as_secs_f64() * 1e3 / PERIOD_MS as f64;
    Cost {
        start_s: arrived_ns.saturating_sub(begun_ns) as f64 * 1e-9,
        cpu_per_message_us: (cpu_us(&pids) - cpu_at_start) / messages / nodes as f64,
        resident_mb: memory_mb(&pids, "Rss:"),
        proportional_mb: memory_mb(&pids, "Pss:"),
        processes: count,
    }
}

fn graph(nodes: usize, own_processes: bool) -> String {
    let mut graph = "robot: bench\nnodes:\n".to_owned();
    for index in 0..nodes {
        let process = if own_processes { index } else { 0 };
        let (operator, settings) = match index {
            0 => ("bench-source", format!("config: {{ width: 16, height: 1, colour: false, period_ms: {PERIOD_MS} }}")),
            last if last + 1 == nodes => ("bench-arrival", format!("inputs: {{ image: n{}/image }}", last - 1)),
            index => ("bench-relay", format!("inputs: {{ image: n{}/image }}", index - 1)),
        };
        writeln!(graph, "  n{index}:\n    operator: {operator}\n    process: n{process}\n    {settings}")
            .expect("a text grows");
    }
    graph
}

/// CPU time of processes so far, µs: what the scheduler says of each thread, ns.
fn cpu_us(pids: &[u32]) -> f64 {
    let of_thread = |thread: &Path| -> Option<f64> {
        fs::read_to_string(thread.join("schedstat")).ok()?.split_whitespace().next()?.parse().ok()
    };
    let of_process = |pid: &u32| -> f64 {
        let threads = fs::read_dir(format!("/proc/{pid}/task")).expect("the process lives");
        threads.filter_map(|thread| of_thread(&thread.ok()?.path())).sum()
    };
    pids.iter().map(of_process).sum::<f64>() * 1e-3
}

/// The sum of a line of `smaps_rollup` over processes, MB.
fn memory_mb(pids: &[u32], line: &str) -> f64 {
    let of_process = |pid: &u32| field_kb(&format!("/proc/{pid}/smaps_rollup"), line);
    pids.iter().map(of_process).sum::<u64>() as f64 * 1024e-6
}

fn available_bytes() -> u64 {
    field_kb("/proc/meminfo", "MemAvailable:") * 1024
}

fn field_kb(file: &str, line: &str) -> u64 {
    let text = fs::read_to_string(file).expect("every Linux has this file");
    let number = text.lines().find_map(|found| found.strip_prefix(line)?.split_whitespace().next()?.parse().ok());
    number.unwrap_or_else(|| panic!("`{file}` has a line `{line}`"))
}
