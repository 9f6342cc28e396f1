//! Every operator is replaced again and again in the middle of a recorded drive: a new instance with the same configuration takes
//! over state and inputs. Whatever it sends must be, to the byte, what the one instance would have sent that was never replaced.

use std::cell::RefCell;
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use carril_messages::{Control, Stamp};
use carril_runtime::clock::VirtualClock;
use carril_runtime::executor::lockstep::{Lockstep, LockstepOptions};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::lines::MemoryLines;
use carril_runtime::{Context, ErasedOperator, HeapPool, Incoming, OperatorKind, Registry, Setup, Trigger};
use serde_json::Value;

/// Nodes at the ends of a serial line look at it this often.
const LINE_PERIOD_MS: u64 = 5;

fn registry() -> Registry {
    carril_operators::registry().and(carril_bridge::registry()).and(carril_simulator::registry())
}

fn graph(file: &str) -> Graph {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    Graph::read(&path, &registry(), &ReadOptions::default()).unwrap_or_else(|problems| panic!("{problems:?}"))
}

/// What a successor gets.
#[derive(Clone, Copy, PartialEq)]
enum Handover {
    All,
    /// As if the operator had no state.
    NoState,
    /// As if its inputs held nothing.
    NoInputs,
}

/// A node with its recorded inputs, and a log of what it sends.
struct Bench {
    kind: Arc<OperatorKind>,
    config: Value,
    setup: Setup,
    operator: Box<dyn ErasedOperator>,
    replaced: Option<(usize, Handover)>,
    steps: usize,
    log: Vec<String>,
}

impl Bench {
    fn new(graph: &Graph, node: &str, lines: &MemoryLines, clock: &Arc<VirtualClock>) -> Self {
        let node = graph.node(node).expect("the node is there");
        let kind = Arc::clone(node.kind().expect("one of ours"));
        let setup = Setup {
            base_dir: graph.base_dir.clone(),
            memory_lines: Some(lines.clone()),
            clock: Arc::clone(clock) as _,
            ..Setup::for_tests(&node.name)
        };
        let operator = kind.build(node.config.clone(), &setup).expect("it can be built");
        let config = node.config.clone();
        let mut bench = Self { kind, config, setup, operator, replaced: None, steps: 0, log: Vec::new() };
        bench.operator.set_wanted(&|_| true);
        bench
    }

    /// As a swap does: the old one is gone before the new one is built.
    fn replace(&mut self, handover: Handover) {
        let (version, state) = self.operator.snapshot().expect("the state has bytes");
        let held = self.operator.held();
        self.operator = Box::new(Gone);
        self.operator = self.kind.build(self.config.clone(), &self.setup).expect("it can be built again");
        self.operator.set_wanted(&|_| true);
        if handover != Handover::NoState {
            self.operator.restore(version, &state).expect("its own state");
        }
        if handover != Handover::NoInputs {
            self.operator.take_held(held).expect("its own inputs");
        }
    }

    fn step(&mut self, now: Stamp, trigger: Trigger) {
        if let Some((every, handover)) = self.replaced
            && self.steps % every == every - 1
        {
            self.replace(handover);
        }
        self.steps += 1;
        self.operator.begin(now, &|_| None);
        let result = self.operator.step(&Context::new(now, trigger, &HeapPool));
        let used = self.operator.take_used();
        let log = &mut self.log;
        log.push(format!("{now} {trigger:?} {result:?} from {used:?}"));
        self.operator.drain(&mut |port, outgoing| {
            let encoded = outgoing.message.encode().expect("it has bytes");
            let mut hasher = DefaultHasher::new();
            encoded.payload.to_vec().hash(&mut hasher);
            log.push(format!("  {port} {:?} {:?} {:016x}", outgoing.provenance, encoded.meta, hasher.finish()));
        });
    }
}

/// Stands where an operator was.
struct Gone;

impl ErasedOperator for Gone {
    fn accept(&mut self, _: usize, _: Incoming) -> Result<(), carril_messages::CodecError> {
        unreachable!("nobody uses it")
    }
    fn begin(&mut self, _: Stamp, _: &dyn Fn(usize) -> Option<Duration>) {}
    fn step(&mut self, _: &Context<'_>) -> Result<(), carril_runtime::StepError> {
        unreachable!("nobody uses it")
    }
    fn take_used(&mut self) -> carril_messages::Origins {
        carril_messages::Origins::none()
    }
    fn drain(&mut self, _: &mut dyn FnMut(usize, carril_runtime::Outgoing)) {}
    fn stale(&mut self, _: usize) -> u64 {
        0
    }
    fn set_wanted(&mut self, _: &dyn Fn(usize) -> bool) {}
    fn control(&mut self, _: Control, _: Stamp) {}
    fn snapshot(&self) -> Result<(u32, Vec<u8>), carril_messages::CodecError> {
        unreachable!("nobody uses it")
    }
    fn restore(&mut self, _: u32, _: &[u8]) -> Result<(), carril_runtime::StateError> {
        unreachable!("nobody uses it")
    }
    fn held(&mut self) -> Vec<carril_runtime::Held> {
        Vec::new()
    }
    fn take_held(&mut self, _: Vec<carril_runtime::Held>) -> Result<(), carril_messages::CodecError> {
        Ok(())
    }
    fn reconfigure(&mut self, _: &Value) -> Option<Result<(), carril_runtime::SetupError>> {
        None
    }
}

/// What happens to a node.
#[derive(Clone)]
enum Event {
    Input(usize, Incoming),
    Word(Control),
    Step(Trigger),
}

/// A drive with every word that a person can say.
const WORDS: [(u64, Control); 6] = [
    (1_200, Control::Stop),
    (1_500, Control::Start),
    (2_300, Control::EStop),
    (2_600, Control::Reset),
    (2_900, Control::Start),
    (3_700, Control::Stop),
];

/// Everything that happens to `nodes` in a drive, in order: time, node, event.
fn record(graph: &Graph, nodes: &[&str], ms: u64, words: &[(u64, Control)]) -> Vec<(Stamp, usize, Event)> {
    let mut lockstep = Lockstep::new(graph, LockstepOptions::default()).expect("it runs in lockstep");
    let events: Rc<RefCell<Vec<(Stamp, usize, Event)>>> = Rc::default();
    for (index, name) in nodes.iter().enumerate() {
        let node = graph.node(name).expect("the node is there");
        let kind = node.kind().expect("one of ours");
        for edge in &node.inputs {
            let port = kind.input(&edge.input).expect("the port is there");
            let triggers = kind.inputs[port].triggers;
            let (events, delay) = (Rc::clone(&events), edge.delay.unwrap_or_default());
            let hear = move |published: &carril_runtime::node::Published| {
                let at = published.header.stamp + delay;
                let incoming = Incoming::Local(Arc::clone(&published.header), Arc::clone(&published.message));
                let mut events = events.borrow_mut();
                events.push((at, index, Event::Input(port, incoming)));
                if triggers {
                    events.push((at, index, Event::Step(Trigger::Input)));
                }
            };
            lockstep.subscribe(&edge.from.node, &edge.from.port, hear).expect("the output is there");
        }
    }
    let stamp = |ms: u64| Stamp::ZERO + Duration::from_millis(ms);
    for &(at, word) in words {
        lockstep.control_at(stamp(at), word);
    }
    lockstep.run_until(stamp(ms)).expect("the drive goes well");
    drop(lockstep);
    let mut events = Rc::try_unwrap(events).ok().expect("the drive is over").into_inner();
    for (index, name) in nodes.iter().enumerate() {
        let node = graph.node(name).expect("the node is there");
        for &(at, word) in words {
            events.push((stamp(at), index, Event::Word(word)));
            events.push((stamp(at), index, Event::Step(Trigger::Control)));
        }
        if let Some(period) = node.period {
            let count = Duration::from_millis(ms).as_nanos() / period.as_nanos();
            let at = |number: u128| Stamp::ZERO + period * number as u32;
            events.extend((0..count).map(|number| (at(number), index, Event::Step(Trigger::Period))));
        }
        if ["bridge", "mcu"].contains(name) {
            let wakes = (0..ms / LINE_PERIOD_MS).map(|number| stamp(number * LINE_PERIOD_MS));
            events.extend(wakes.map(|at| (at, index, Event::Step(Trigger::Wake))));
        }
    }
    events.sort_by_key(|(at, ..)| *at);
    events.retain(|(at, ..)| *at <= stamp(ms));
    events
}

/// What the nodes send, when one of them is replaced at every `every`-th step.
fn log(
    graph: &Graph,
    nodes: &[&str],
    events: &[(Stamp, usize, Event)],
    replaced: Option<(&str, usize, Handover)>,
) -> Vec<String> {
    let (lines, clock) = (MemoryLines::default(), Arc::new(VirtualClock::default()));
    let mut benches: Vec<Bench> = nodes.iter().map(|node| Bench::new(graph, node, &lines, &clock)).collect();
    if let Some((node, every, handover)) = replaced {
        let index = nodes.iter().position(|name| *name == node).expect("the node is there");
        benches[index].replaced = Some((every, handover));
    }
    for (at, index, event) in events {
        clock.advance_to(*at);
        let bench = &mut benches[*index];
        match event {
            Event::Input(port, incoming) => bench.operator.accept(*port, incoming.clone()).expect("a good sample"),
            Event::Word(word) => bench.operator.control(*word, *at),
            Event::Step(trigger) => bench.step(*at, *trigger),
        }
    }
    let named =
        |(bench, node): (Bench, &&str)| bench.log.into_iter().map(|line| format!("{node} {line}")).collect::<Vec<_>>();
    benches.into_iter().zip(nodes).flat_map(named).collect()
}

fn first_difference(expected: &[String], got: &[String]) -> Option<String> {
    let at = expected.iter().zip(got).position(|(expected, got)| expected != got);
    let at = at.or((expected.len() != got.len()).then_some(expected.len().min(got.len())))?;
    let line = |log: &[String]| log.get(at).cloned().unwrap_or_else(|| "nothing".into());
    Some(format!("line {at}:\nexpected {}\ngot      {}", line(expected), line(got)))
}

/// Replaces `node` of `nodes` at every step, every 7th and every 50th, and finds no difference.
fn goes_on(file: &str, nodes: &[&str], node: &str, ms: u64) {
    let graph = graph(file);
    let events = {
        // A link says an e-stop again whenever its line opens, which is more than an instance says that is never replaced.
        let is_said = |word: &Control| node != "bridge" || *word != Control::EStop;
        let words: Vec<_> = WORDS.into_iter().filter(|(_, word)| is_said(word)).collect();
        record(&graph, nodes, ms, &words)
    };
    let expected = log(&graph, nodes, &events, None);
    assert!(expected.len() > 20, "{node}: the drive is a drive: {} lines", expected.len());
    for every in [1, 7, 50] {
        let got = log(&graph, nodes, &events, Some((node, every, Handover::All)));
        let difference = first_difference(&expected, &got);
        assert!(
            difference.is_none(),
            "{node}, replaced at every step number {every}, {}",
            difference.unwrap_or_default()
        );
    }
}

#[test]
fn decision_goes_on() {
    goes_on("dataflow.yaml", &["decision"], "decision", 4_500);
}

#[test]
fn actuator_goes_on() {
    goes_on("dataflow.yaml", &["actuator"], "actuator", 4_500);
}

#[test]
fn lidar_sectors_go_on() {
    goes_on("dataflow.yaml", &["sectors"], "sectors", 2_000);
}

#[test]
fn lane_detector_goes_on() {
    goes_on("dataflow.yaml", &["lane"], "lane", 1_000);
}

#[test]
fn simulated_world_goes_on() {
    goes_on("dataflow.yaml", &["world"], "world", 1_000);
}

#[test]
fn camera_goes_on_to_the_end_of_its_source() {
    goes_on("dataflows/video.yaml", &["camera"], "camera", 3_000);
}

#[test]
fn link_to_the_microcontroller_goes_on_in_its_session() {
    goes_on("dataflow.yaml", &["bridge", "mcu"], "bridge", 4_500);
}

#[test]
fn simulated_microcontroller_goes_on_in_the_middle_of_a_lease() {
    goes_on("dataflow.yaml", &["bridge", "mcu"], "mcu", 4_500);
}

#[test]
fn without_state_or_held_inputs_the_difference_shows() {
    let graph = graph("dataflow.yaml");
    for (nodes, node, handover) in [
        (&["decision"][..], "decision", Handover::NoState),
        (&["decision"], "decision", Handover::NoInputs),
        (&["actuator"], "actuator", Handover::NoState),
        (&["bridge", "mcu"], "bridge", Handover::NoState),
        (&["bridge", "mcu"], "mcu", Handover::NoState),
        (&["bridge", "mcu"], "mcu", Handover::NoInputs),
    ] {
        let events = record(&graph, nodes, 2_000, &WORDS);
        let (expected, got) =
            (log(&graph, nodes, &events, None), log(&graph, nodes, &events, Some((node, 7, handover))));
        assert!(first_difference(&expected, &got).is_some(), "{node}: what is not handed over must be missed");
    }
}
