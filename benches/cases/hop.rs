//! One hop: from the making of a message in one node to the step of its reader. Between two processes beside a plain Zenoh
//! program, within a process beside Rust's own channel. Both sides run at the same time, so that what else happens on the
//! machine meets both alike; their periods differ a little, so that they seldom meet each other.

use std::path::Path;
use std::time::Duration;

use crate::support::children::Role;
use crate::support::measure::{self, Series};
use crate::support::nodes::{self, Process};
use crate::support::plain;
use crate::support::report::Row;

const ROUNDS: usize = 4;
const COUNT: usize = 400;
const OUR_PERIOD_MS: usize = 5;
const PLAIN_PERIOD_US: usize = 5_100;
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
            let start_plain = || Pair::plain(size);
            let start_ours = || Pair::ours(&graph(width, height, colour, ["source", "sink"], ""));
            // Who comes first alternates.
            let (mut own_pair, mut plain_pair) = if round % 2 == 0 {
                let plain_pair = start_plain();
                (start_ours(), plain_pair)
            } else {
                (start_ours(), start_plain())
            };
            ours.add(&own_pair.result());
            plain.add(&plain_pair.result());
        }
        emit_latency(emit, &format!("hop between processes, {name}"), &ours, &plain);
        let (value, baseline) = (ours.cpu_per_message_us(), plain.cpu_per_message_us());
        emit(Row::against(format!("hop between processes, {name}, CPU"), value, "us", baseline));
    }
    within(emit, "one thread for both", "");
    within(emit, "a thread for each", "cpus: [0, 1]");
}

/// Median and 99th percentile beside those of the yardstick.
pub fn emit_latency(emit: &mut dyn FnMut(Row), name: &str, ours: &Series, plain: &Series) {
    for (label, quantile) in [("median", 0.5), ("p99", 0.99)] {
        let (value, baseline) = (ours.quantile_us(quantile), plain.quantile_us(quantile));
        emit(Row::against(format!("{name}, {label}"), value, "us", baseline));
    }
}

/// Two nodes of one process, as they really hop: published by one step, read by the next.
fn within(emit: &mut dyn FnMut(Row), threads: &str, sink_settings: &str) {
    let (_, width, height, colour) = SIZES[3];
    let (mut ours, mut channel) = (Series::default(), Series::default());
    for _ in 0..ROUNDS {
        let dir = tempfile::tempdir().expect("a folder");
        let graph = graph(width, height, colour, ["one", "one"], sink_settings);
        let mut process = Role::start(&role_nodes(dir.path(), &graph, "one", "", Duration::ZERO));
        process.wait_ready();
        channel.add(&channel_hop());
        ours.add(&process.result());
    }
    emit_latency(emit, &format!("hop within a process, {threads}, against mpsc"), &ours, &channel);
}

/// What Rust's own channel takes from thread to thread.
fn channel_hop() -> Series {
    let (sender, receiver) = std::sync::mpsc::channel();
    let reader = std::thread::spawn(move || {
        let mut recorder = measure::Recorder::new(COUNT);
        receiver.iter().find_map(|sent_ns| recorder.record(sent_ns)).expect("all messages come")
    });
    measure::paced(COUNT + measure::WARM_UP, Duration::from_micros(PLAIN_PERIOD_US as u64), || {
        sender.send(measure::monotonic_ns()).expect("the reader reads until the last");
    });
    reader.join().expect("the reader ends")
}

/// A writer and its reader at work.
struct Pair {
    sink: Role,
    source: Role,
    _dir: tempfile::TempDir,
}

impl Pair {
    fn plain(size: usize) -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let endpoint = nodes::socket(dir.path(), "plain");
        let (count, period_us, size) = (COUNT.to_string(), PLAIN_PERIOD_US.to_string(), size.to_string());
        let mut sink = Role::start(&text(&["plain-sink", &endpoint, "", "bench/hop", &count]));
        sink.wait_ready();
        let source = Role::start(&text(&["plain-source", &endpoint, "bench/hop", &size, &count, &period_us]));
        Self { sink, source, _dir: dir }
    }

    fn ours(graph: &str) -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let mut sink = Role::start(&role_nodes(dir.path(), graph, "sink", "", Duration::ZERO));
        sink.wait_ready();
        let measured = Duration::from_millis((COUNT * OUR_PERIOD_MS) as u64);
        let mut source = Role::start(&role_nodes(dir.path(), graph, "source", "sink", measured));
        source.wait_ready();
        Self { sink, source, _dir: dir }
    }

    /// Latencies, and the CPU time of both processes.
    fn result(&mut self) -> Series {
        let mut series: Series = self.sink.result();
        series.add(&self.source.result());
        series
    }
}

fn graph(width: u32, height: u32, colour: bool, [source, sink]: [&str; 2], sink_settings: &str) -> String {
    format!(
        "robot: bench
nodes:
  source:
    operator: bench-source
    process: {source}
    config: {{ width: {width}, height: {height}, colour: {colour}, period_ms: {OUR_PERIOD_MS} }}
  sink:
    operator: bench-sink
    process: {sink}
    inputs: {{ image: source/image }}
    config: {{ count: {COUNT} }}
    {sink_settings}
"
    )
}

/// The arguments of a process that runs nodes. It prints its CPU time over `measured`, unless that is zero.
pub fn role_nodes(dir: &Path, graph: &str, process: &str, connect: &str, measured: Duration) -> Vec<String> {
    text(&["nodes", &dir.display().to_string(), graph, process, connect, &measured.as_millis().to_string()])
}

/// Owned words.
pub fn text(words: &[&str]) -> Vec<String> {
    words.iter().map(|word| (*word).to_owned()).collect()
}

fn names(list: &str) -> Vec<String> {
    list.split(',').filter(|name| !name.is_empty()).map(str::to_owned).collect()
}

/// Runs nodes in this process until it is ended: folder, graph, process, processes to connect to, and over how many ms its CPU
/// time is measured (0: not at all).
pub fn play_nodes(arguments: &[String]) -> ! {
    let [dir, graph, process, connect, measured_ms] = arguments else { panic!("five arguments") };
    let nodes = Process::start(Path::new(dir), graph, process, &names(connect));
    println!("ready");
    let measured = Duration::from_millis(measured_ms.parse().expect("a number"));
    if measured.is_zero() {
        park(&nodes)
    }
    // Until the link is up, nothing goes out that could be measured.
    std::thread::sleep(LINK_UP);
    let cpu_at_start = measure::cpu_us();
    std::thread::sleep(measured);
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
        ["plain-source", connect, key, size, count, period_us] => plain::source(
            &names(connect),
            key,
            size.parse().expect("a number"),
            count.parse().expect("a number"),
            Duration::from_micros(period_us.parse().expect("a number")),
        ),
        ["plain-sink", listen, connect, key, count] => {
            plain::sink(listen, &names(connect), key, count.parse().expect("a number")).print();
        }
        ["plain-relay", listen, connect, from, to] => plain::relay(listen, &names(connect), from, to),
        _ => panic!("no such part: {arguments:?}"),
    }
}
