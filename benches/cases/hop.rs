//! One hop: from the making of a message in one node to the step of its reader, between two processes and within one, beside
//! a plain Zenoh program on the same link.

use std::path::Path;
use std::time::Duration;

use crate::support::children::Role;
use crate::support::measure::{self, Series};
use crate::support::nodes::{self, Process};
use crate::support::plain;
use crate::support::report::Row;

const ROUNDS: usize = 5;
const COUNT: usize = 200;
const PERIOD: Duration = Duration::from_millis(5);
/// Processes find each other within this time.
const LINK_UP: Duration = Duration::from_millis(500);
/// Message sizes: name, width, height, colour.
const SIZES: [(&str, u32, u32, bool); 4] =
    [("16 B", 16, 1, false), ("1 KiB", 1024, 1, false), ("64 KiB", 256, 256, false), ("921600 B", 640, 480, true)];

/// Measures all sizes.
pub fn run(emit: &mut dyn FnMut(Row)) {
    for (name, width, height, colour) in SIZES {
        let size = (width * height) as usize * if colour { 3 } else { 1 };
        let (mut ours, mut plain) = (Series::default(), Series::default());
        for round in 0..ROUNDS {
            // Who comes first alternates, so that neither always runs on the warmer machine.
            if round % 2 == 0 {
                plain.add(&plain_hop(size));
                ours.add(&our_hop(width, height, colour));
            } else {
                ours.add(&our_hop(width, height, colour));
                plain.add(&plain_hop(size));
            }
        }
        for (label, quantile) in [("median", 0.5), ("p99", 0.99)] {
            let (value, baseline) = (ours.quantile_us(quantile), plain.quantile_us(quantile));
            emit(Row::against(format!("hop between processes, {name}, {label}"), value, "us", baseline));
        }
        let (value, baseline) = (ours.cpu_per_message_us(), plain.cpu_per_message_us());
        emit(Row::against(format!("hop between processes, {name}, CPU"), value, "us", baseline));
    }
    local(emit);
}

fn local(emit: &mut dyn FnMut(Row)) {
    let (_, width, height, colour) = SIZES[3];
    let (mut ours, mut channel) = (Series::default(), Series::default());
    for _ in 0..ROUNDS {
        let dir = tempfile::tempdir().expect("a folder");
        let graph = graph(width, height, colour, "one", "one");
        let mut process = Role::start(&role_nodes(dir.path(), &graph, "one", "", 0));
        process.wait_ready();
        ours.add(&process.result());
        channel.add(&channel_hop());
    }
    for (label, quantile) in [("median", 0.5), ("p99", 0.99)] {
        let (value, baseline) = (ours.quantile_us(quantile), channel.quantile_us(quantile));
        emit(Row::against(format!("hop within a process, 921600 B, {label}, against mpsc"), value, "us", baseline));
    }
}

/// What Rust's own channel takes from thread to thread.
fn channel_hop() -> Series {
    let (sender, receiver) = std::sync::mpsc::channel();
    let reader = std::thread::spawn(move || {
        let mut recorder = measure::Recorder::new(COUNT);
        receiver.iter().find_map(|sent_ns| recorder.record(sent_ns)).expect("all messages come")
    });
    measure::paced(COUNT + measure::WARM_UP, PERIOD, || {
        sender.send(measure::monotonic_ns()).expect("the reader reads until the last");
    });
    reader.join().expect("the reader ends")
}

fn plain_hop(size: usize) -> Series {
    let dir = tempfile::tempdir().expect("a folder");
    let endpoint = nodes::socket(dir.path(), "plain");
    let mut sink = Role::start(&text(&["plain-sink", &endpoint, "", "bench/hop", &COUNT.to_string()]));
    sink.wait_ready();
    let mut source = Role::start(&text(&["plain-source", &endpoint, "bench/hop", &size.to_string()]));
    let mut series: Series = sink.result();
    series.add(&source.result());
    series
}

fn our_hop(width: u32, height: u32, colour: bool) -> Series {
    let dir = tempfile::tempdir().expect("a folder");
    let graph = graph(width, height, colour, "source", "sink");
    let mut sink = Role::start(&role_nodes(dir.path(), &graph, "sink", "", 0));
    sink.wait_ready();
    let mut source = Role::start(&role_nodes(dir.path(), &graph, "source", "sink", COUNT));
    source.wait_ready();
    let mut series: Series = sink.result();
    series.add(&source.result());
    series
}

fn graph(width: u32, height: u32, colour: bool, source: &str, sink: &str) -> String {
    format!(
        "robot: bench
nodes:
  source:
    operator: bench-source
    process: {source}
    config: {{ width: {width}, height: {height}, colour: {colour}, period_ms: {} }}
  sink:
    operator: bench-sink
    process: {sink}
    inputs: {{ image: source/image }}
    config: {{ count: {COUNT} }}
",
        PERIOD.as_millis()
    )
}

/// The arguments of a process that runs nodes. With `periods` it prints its CPU time over so many periods.
pub fn role_nodes(dir: &Path, graph: &str, process: &str, connect: &str, periods: usize) -> Vec<String> {
    text(&["nodes", &dir.display().to_string(), graph, process, connect, &periods.to_string()])
}

/// Owned words.
pub fn text(words: &[&str]) -> Vec<String> {
    words.iter().map(|word| (*word).to_owned()).collect()
}

fn names(list: &str) -> Vec<String> {
    list.split(',').filter(|name| !name.is_empty()).map(str::to_owned).collect()
}

/// Runs nodes in this process until it is ended: folder, graph, process, processes to connect to, and over how many periods its
/// CPU time is measured (0: not at all).
pub fn play_nodes(arguments: &[String]) -> ! {
    let [dir, graph, process, connect, periods] = arguments else { panic!("five arguments") };
    let nodes = Process::start(Path::new(dir), graph, process, &names(connect));
    println!("ready");
    let periods: u32 = periods.parse().expect("a number");
    if periods == 0 {
        park(&nodes)
    }
    // Until the link is up, nothing goes out that could be measured.
    std::thread::sleep(LINK_UP);
    let cpu_at_start = measure::cpu_us();
    std::thread::sleep(PERIOD * periods);
    Series { latencies_ns: Vec::new(), cpu_us: measure::cpu_us() - cpu_at_start }.print();
    park(&nodes)
}

/// Lets the nodes work until this process is ended.
fn park(_nodes: &Process) -> ! {
    loop {
        std::thread::park();
    }
}

/// Plays a part of the plain Zenoh program.
pub fn play_plain(arguments: &[String]) {
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["plain-source", connect, key, size] => {
            plain::source(&names(connect), key, size.parse().expect("a number"), COUNT, PERIOD)
        }
        ["plain-source", connect, key, size, count, period_ms] => plain::source(
            &names(connect),
            key,
            size.parse().expect("a number"),
            count.parse().expect("a number"),
            Duration::from_millis(period_ms.parse().expect("a number")),
        ),
        ["plain-sink", listen, connect, key, count] => {
            plain::sink(listen, &names(connect), key, count.parse().expect("a number")).print();
        }
        ["plain-relay", listen, connect, from, to] => plain::relay(listen, &names(connect), from, to),
        _ => panic!("no such part: {arguments:?}"),
    }
}
