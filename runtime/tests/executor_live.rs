//! The live executor, in this program, over the transport in memory.

use std::path::Path;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use carril_messages::{Command, Control, Header, Health, Key, Message, Meta, NodeState, Origins, Payload, Stamp};
use carril_runtime::Incoming;
use carril_runtime::clock::LiveClock;
use carril_runtime::executor::live::{Environment, Executor, NodeEvent, StartError};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::transport::memory::MemoryTransport;
use carril_runtime::transport::{Guard, Sink, Transport};

#[path = "support/live_operators.rs"]
mod live_operators;
#[path = "support/until.rs"]
mod until;

use until::until;

const PATIENCE: Duration = Duration::from_secs(10);

fn graph(nodes: &str) -> Graph {
    let text = format!("robot: car\nnodes:\n{nodes}");
    let registry = live_operators::registry();
    Graph::parse(text, Path::new("test.yaml"), &registry, &ReadOptions::default())
        .unwrap_or_else(|problems| panic!("the graph is valid: {problems:?}"))
}

struct Bench {
    transport: MemoryTransport,
    executor: Executor,
    events: Receiver<NodeEvent>,
}

fn start(nodes: &str) -> Bench {
    let transport = MemoryTransport::default();
    let (executor, events) = try_start(nodes, &transport).expect("the nodes start");
    Bench { transport, executor, events }
}

fn try_start(nodes: &str, transport: &MemoryTransport) -> Result<(Executor, Receiver<NodeEvent>), StartError> {
    let environment = Environment {
        transport: Arc::new(transport.clone()),
        clock: Arc::new(LiveClock::anchored_now()),
        run_dir: None,
        seed: 1,
    };
    Executor::start(&graph(nodes), "all", &environment)
}

#[derive(Default)]
struct Heard(Mutex<Vec<Incoming>>);

impl Sink for Heard {
    fn deliver(&self, incoming: Incoming) {
        self.0.lock().expect("no test panics while it hears").push(incoming);
    }

    fn refuse(&self, reason: String) {
        panic!("an output is always valid: {reason}");
    }
}

impl Heard {
    fn len(&self) -> usize {
        self.0.lock().expect("no test panics while it hears").len()
    }

    fn epochs(&self) -> Vec<u64> {
        let mut epochs: Vec<u64> =
            self.0.lock().expect("no test panics while it hears").iter().map(|s| s.header().epoch).collect();
        epochs.dedup();
        epochs
    }
}

impl Bench {
    fn listen(&self, node: &str, port: &str) -> (Arc<Heard>, Guard) {
        let heard = Arc::new(Heard::default());
        let guard = self.transport.subscribe(&Key::new("car", node, port), false, heard.clone()).expect("listening");
        (heard, guard)
    }

    fn health(&self, node: &str) -> Health {
        let all = self.executor.health(PATIENCE);
        all.into_iter().find(|health| health.node == node).expect("every node answers")
    }
}

#[test]
fn samples_go_from_node_to_node_and_beyond() {
    let bench = start(
        "  source: { operator: source, process: all }\n  follower: { operator: follower, process: all, inputs: { command: { from: source/command, queue: 100 } } }\n",
    );
    let (heard, _guard) = bench.listen("follower", "command");
    until("ten samples", || heard.len() >= 10);
    let health = bench.health("follower");
    assert_eq!((health.inputs[0].lost, health.inputs[0].dropped), (0, 0), "nothing is lost within a process");
    let output = |node: &str| {
        let outputs = bench.health(node).outputs.into_iter();
        outputs.filter(|output| output.port == "command").map(|output| (output.sent, output.bytes)).next()
    };
    let (sent, bytes) = output("source").expect("it has that port");
    assert!(sent >= 10 && bytes == 0, "what is read within the process is not encoded: {sent} sent, {bytes} B");
    let (sent, bytes) = output("follower").expect("it has that port");
    assert!(sent >= 10 && bytes >= 10 * 8, "what leaves it is counted: {sent} sent, {bytes} B");
    bench.executor.stop();
}

#[test]
fn nodes_hear_words_while_nothing_else_happens() {
    let bench = start("  follower: { operator: follower, process: all }\n");
    let (heard, _guard) = bench.listen("follower", "word");
    let reply = bench.executor.control(Control::EStop, PATIENCE).expect("it hears");
    assert_eq!(reply.nodes, ["follower"], "it is named");
    until("the word to come out", || heard.len() == 1);
    bench.executor.stop();
}

#[test]
fn a_stuck_node_is_named() {
    let bench = start(
        "  source: { operator: source, process: all }\n  slow: { operator: follower, process: all, cpus: [0], config: { step_ms: 400 }, inputs: { command: source/command } }\n  quick: { operator: follower, process: all }\n",
    );
    let (heard, _guard) = bench.listen("slow", "command");
    until("the slow node to be at work", || heard.len() >= 1);
    let error = bench.executor.control(Control::Stop, Duration::from_millis(1)).expect_err("it sleeps in its step");
    assert!(error.contains("`slow` did not hear `stop`"), "the node is named: {error}");
    bench.executor.stop();
}

#[test]
fn a_panic_in_a_shared_process_takes_nothing_else_down() {
    let bench = start(
        "  source: { operator: source, process: all }\n  bad: { operator: follower, process: all, config: { panic_at: 3 }, restart: { max: 1 }, inputs: { command: source/command } }\n  good: { operator: follower, process: all, inputs: { command: source/command } }\n",
    );
    let (good, _good_guard) = bench.listen("good", "command");
    let (bad, _bad_guard) = bench.listen("bad", "command");
    let event = bench.events.recv_timeout(PATIENCE).expect("the panic is reported");
    let expected = NodeEvent::Panicked { node: "bad".into(), message: "told to panic".into(), alone: false };
    assert_eq!(event, expected, "who and what");
    until("a second life", || bad.epochs().len() == 2);
    until("the end of it", || bench.health("bad").state == NodeState::GaveUp);
    assert_eq!(bench.health("bad").restarts, 1, "built anew once, as its rule allows");
    let before = good.len();
    until("the others to go on", || good.len() > before + 10);
    assert_eq!(good.epochs().len(), 1, "in the same life");
    bench.executor.stop();
}

#[test]
fn the_only_node_of_a_process_takes_it_down() {
    let transport = MemoryTransport::default();
    let nodes = "  lone: { operator: follower, process: all, config: { panic_at: 1 } }\n";
    let (executor, events) = try_start(nodes, &transport).expect("the node starts");
    let header = header(0, carril_messages::Goal::TYPE).encode().expect("a header encodes");
    let goal = carril_messages::Goal::Cruise { speed_m_s: 0.4 }.encode().expect("a goal encodes");
    transport.put_raw(&Key::new("car", "lone", "goal"), &header, goal.payload).expect("putting");
    let event = events.recv_timeout(PATIENCE).expect("the panic is reported");
    assert!(matches!(event, NodeEvent::Panicked { alone: true, .. }), "the process shall end: {event:?}");
    executor.stop();
}

#[test]
fn overruns_are_counted_and_stop_the_car_where_told() {
    let bench = start(
        "  source: { operator: source, process: all }\n  warned: { operator: follower, process: all, deadline_ms: 1, config: { step_ms: 3 }, inputs: { command: source/command } }\n  stopped: { operator: follower, process: all, deadline_ms: 1, on_overrun: stop, config: { step_ms: 3 }, inputs: { command: source/command } }\n",
    );
    let (words, _guard) = bench.listen("stopped", "word");
    let NodeEvent::Fault(report) = bench.events.recv_timeout(PATIENCE).expect("the fault is reported") else {
        panic!("an overrun is a fault");
    };
    assert_eq!(report.node, "stopped", "only the node that asks for it");
    assert!(report.reason.contains("deadline"), "with the reason: {}", report.reason);
    until("the e-stop", || words.len() >= 1);
    until("overruns of the other", || bench.health("warned").overruns >= 3);
    assert!(bench.events.try_recv().is_err(), "a fault is reported once until reset");
    bench.executor.control(Control::Reset, PATIENCE).expect("they hear");
    bench.events.recv_timeout(PATIENCE).expect("after reset it is reported again");
    bench.executor.stop();
}

fn header(seq: u64, message_type: carril_messages::MessageType) -> Header {
    let (origins, meta) = (Origins::none(), Meta::new());
    Header { epoch: 1, seq, stamp: Stamp::ZERO, origins, message_type, meta }
}

/// Damaged, foreign, old and absurd samples: header bytes and payload.
fn garbage(good: &Header) -> Vec<(Vec<u8>, Payload)> {
    let mut seq = 0;
    // Each with a number of its own: what has come before is left out, not refused.
    let mut next_valid = || {
        seq += 1;
        Header { seq, ..good.clone() }.encode().expect("a header encodes")
    };
    let foreign = header(0, carril_messages::LaserScan::TYPE).encode().expect("a header encodes");
    let mut older = good.clone();
    older.message_type.version = 0;
    let older = older.encode().expect("a header encodes");
    let mut old_header = next_valid();
    old_header[0] = 0;
    let mut samples: Vec<(Vec<u8>, Payload)> = Vec::new();
    // Random bytes from a fixed seed (xorshift, Marsaglia 2003), with and without a valid header before them.
    let mut state = 0x9e37_79b9_u32;
    for len in [0, 1, 7, 64, 1000] {
        let bytes: Vec<u8> = (0..len)
            .map(|_| {
                state ^= state << 13;
                state ^= state >> 17;
                state ^= state << 5;
                state as u8
            })
            .collect();
        samples.push((bytes.clone(), Payload::from(bytes.clone())));
        samples.push((next_valid(), Payload::from([&[255_u8; 9], &bytes[..]].concat())));
    }
    samples.push((foreign, Payload::from(vec![0; 8])));
    samples.push((older, Payload::from(vec![0; 8])));
    samples.push((old_header, Payload::from(vec![0; 8])));
    samples.push((next_valid(), Payload::from(vec![0; 5 << 20])));
    samples
}

#[test]
fn garbage_on_every_input_is_counted_and_the_node_goes_on() {
    // The writers of these edges live in another process, so that the inputs read from the transport.
    let nodes = "  source: { operator: source, process: other }\n  follower: { operator: follower, process: all, inputs: { command: { from: source/command, queue: 100 } } }\n";
    let bench = start(nodes);
    let (heard, _guard) = bench.listen("follower", "command");
    let ports = [
        (Key::new("car", "source", "command"), Command::TYPE, 0),
        (Key::new("car", "follower", "goal"), carril_messages::Goal::TYPE, 2),
    ];
    for (key, message_type, index) in ports {
        let samples = garbage(&header(0, message_type));
        for (header, payload) in &samples {
            let before = bench.health("follower").inputs[index].refused;
            bench.transport.put_raw(&key, header, payload.clone()).expect("putting");
            until("the refusal", || bench.health("follower").inputs[index].refused > before);
        }
        let input = bench.health("follower").inputs[index].clone();
        assert_eq!(input.refused, samples.len() as u64, "{key}: each is counted");
        assert!(input.last_refusal.is_some(), "{key}: with a reason");
    }
    let good = Command { speed_m_s: 1.0, steering_rad: 0.0 }.encode().expect("a command encodes");
    let valid = header(100, Command::TYPE).encode().expect("a header encodes");
    bench.transport.put_raw(&Key::new("car", "source", "command"), &valid, good.payload).expect("putting");
    until("the good sample to pass", || heard.len() == 1);
    bench.executor.stop();
}

#[test]
fn a_node_that_cannot_be_built_says_why() {
    let nodes = "  source: { operator: source, process: all, config: { refuse: true } }\n";
    let error = try_start(nodes, &MemoryTransport::default()).err().expect("it refuses").to_string();
    assert!(error.contains("`source`") && error.contains("plug it in"), "who, and what to do: {error}");
}

#[test]
fn missed_periods_are_counted_and_not_caught_up() {
    let bench = start(
        "  source: { operator: source, process: all }\n  slow: { operator: follower, process: all, config: { step_ms: 30 }, inputs: { command: source/command } }\n",
    );
    until("missed periods", || bench.health("source").missed_periods >= 5);
    let health = bench.health("source");
    assert!(health.sent <= health.steps, "each step sends once, none twice: {health:?}");
    bench.executor.stop();
}
