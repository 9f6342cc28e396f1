//! Nodes are replaced while the graph runs, in real processes: nothing is lost, nothing comes twice, and what fails is taken
//! back.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use carril_messages::{Command, Control, Message};
use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::{Change, Outcome, Receipt, SwapRequest, SwapTerms};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::supervisor::{Options, Running, Supervisor};
use carril_runtime::transport::Guard;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Map, Value, json};

#[path = "support/swap_operators.rs"]
mod swap_operators;
#[path = "../../tests/support/thorough.rs"]
mod thorough;
#[path = "support/until.rs"]
mod until;

use thorough::count;
use until::until;

const OWN_PROCESSES: &str = "  ticker: { operator: ticker }
  tally: { operator: tally, inputs: { number: { from: ticker/number, queue: 1000, reliable: true } } }
  sink: { operator: tally, inputs: { number: { from: tally/tally, queue: 1000, reliable: true } } }
";
const ONE_PROCESS: &str = "  ticker: { operator: ticker, process: all }
  tally: { operator: tally, process: all, inputs: { number: { from: ticker/number, queue: 1000, reliable: true } } }
  sink: { operator: tally, inputs: { number: { from: tally/tally, queue: 1000, reliable: true } } }
";

/// What came out of a port: life, sequence number, the two numbers of the command.
type Came = Vec<(u64, u64, f32, f32)>;

struct Rig {
    running: Running,
    client: Client,
    tallies: Arc<Mutex<Came>>,
    _guard: Guard,
    dir: tempfile::TempDir,
}

impl Rig {
    fn start(nodes: &str) -> Self {
        Self::start_listening(nodes, ("tally", "tally"))
    }

    fn start_listening(nodes: &str, (node, port): (&str, &str)) -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let registry = swap_operators::registry();
        let text = format!("robot: car\nnodes:\n{nodes}");
        let graph = Graph::parse(text, Path::new("test.yaml"), &registry, &ReadOptions::default())
            .unwrap_or_else(|problems| panic!("the graph is valid: {problems:?}"));
        let program = (PathBuf::from(env!("CARGO_BIN_EXE_carril-test-host")), vec!["process".to_owned()]);
        let options = Options { program: Some(program), runs_dir: Some(dir.path().to_owned()), ..Options::default() };
        let running = Supervisor::start(&graph, &registry, &options).expect("the graph starts");
        let client = Client::open(find_run(dir.path(), None).expect("it runs")).expect("it can be reached");
        let tallies: Arc<Mutex<Came>> = Arc::default();
        let heard = Arc::clone(&tallies);
        let guard = client.subscribe(node, port, move |header, payload, _| {
            let command = Command::decode(&header.meta, &payload).expect("a command");
            let mut heard = heard.lock().expect("no test panics while it hears");
            heard.push((header.epoch, header.seq, command.speed_m_s, command.steering_rad));
        });
        let rig = Self { running, client, tallies, _guard: guard.expect("subscribing"), dir };
        rig.wait_for_more(50);
        rig
    }

    fn came(&self) -> Came {
        self.tallies.lock().expect("no test panics while it hears").clone()
    }

    fn wait_for_more(&self, count: usize) {
        let before = self.came().len();
        until("more tallies", || self.came().len() >= before + count);
    }

    /// The test program under another name: it has that operator only.
    fn binary(&self, name: &str) -> PathBuf {
        let path = self.dir.path().join(name);
        if !path.exists() {
            std::fs::copy(env!("CARGO_BIN_EXE_carril-test-host"), &path).expect("the folder is writable");
        }
        path
    }

    fn swap(&self, request: SwapRequest) -> Receipt {
        self.client.change(&Change::Swap(request)).expect("the supervisor answers")
    }

    fn pid(&self, node: &str) -> u32 {
        let run = self.running.run_file();
        let process = &run.nodes.iter().find(|entry| entry.name == node).expect("the node").process;
        let entry = run.processes.iter().find(|entry| entry.name == *process).expect("its process");
        entry.pid.expect("it is up")
    }

    /// Every number exactly once, counted without a break, in one life with unbroken sequence numbers. `offset`: what
    /// versions may have added to the numbers.
    fn assert_unbroken(&self) {
        self.wait_for_more(50);
        let mut came = self.came();
        // A sample that came twice on the wire is left out by readers.
        // The first ones come while links come up.
        came.drain(..50);
        came.sort_by_key(|(epoch, seq, ..)| (*epoch, *seq));
        came.dedup_by_key(|(epoch, seq, ..)| (*epoch, *seq));
        for (at, pair) in came.windows(2).enumerate() {
            let near = &came[at.saturating_sub(3)..came.len().min(at + 6)];
            let [(epoch, seq, number, count), (next_epoch, next_seq, next_number, next_count)] = pair else { continue };
            assert_eq!((epoch, seq + 1), (next_epoch, *next_seq), "one life, no gap in the sequence: {pair:?}");
            assert!((next_number - number - 1.0).abs() < 0.5, "each number once: {near:?}");
            assert!((next_count - count - 1.0).abs() < 0.5, "the count does not break: {pair:?}");
        }
    }

    fn end(self) {
        self.running.stop();
        self.running.wait().expect("the run ends in order");
    }
}

fn terms() -> SwapTerms {
    SwapTerms { shadow_ms: 50, probation_outputs: 20, stall_ms: 1500, ..SwapTerms::default() }
}

fn values(values: Value) -> Map<String, Value> {
    match values {
        Value::Object(values) => values,
        other => panic!("{other} is no object"),
    }
}

fn with(config: Value) -> SwapRequest {
    SwapRequest { node: "tally".into(), values: values(config), terms: terms(), ..SwapRequest::default() }
}

fn assert_done(receipt: &Receipt) {
    assert_eq!(receipt.outcome, Outcome::Done, "it goes through: {receipt:?}");
    assert_eq!((receipt.lost, receipt.duplicated), (0, 0), "nothing is lost, nothing comes twice: {receipt:?}");
}

#[test]
fn another_config_takes_over_without_a_break() {
    for nodes in [OWN_PROCESSES, ONE_PROCESS] {
        let rig = Rig::start(nodes);
        let mut compared = 0;
        for after in 0..count(20, 200) {
            let receipt = rig.swap(with(json!({ "after": after })));
            assert_done(&receipt);
            assert!(receipt.state_bytes.is_some_and(|bytes| bytes > 0), "the state goes over: {receipt:?}");
            compared += receipt.compared;
        }
        assert!(compared > 0, "the shadows were compared");
        rig.assert_unbroken();
        rig.end();
    }
}

#[test]
fn a_binary_takes_over_and_gives_back_without_a_break() {
    for nodes in [OWN_PROCESSES, ONE_PROCESS] {
        let rig = Rig::start(nodes);
        let before = rig.pid("tally");
        for name in ["tally", "tally-two"] {
            let exec = Some(rig.binary(name));
            let request = SwapRequest { exec, ..with(json!({})) };
            assert_done(&rig.swap(request));
            assert_ne!(rig.pid("tally"), before, "in a process of its own");
        }
        let back =
            rig.client.change(&Change::Rollback { node: "tally".into(), terms: SwapTerms { fresh: true, ..terms() } });
        let back = back.expect("the supervisor answers");
        assert_eq!(back.outcome, Outcome::Done, "back to `tally`: {back:?}");
        rig.end();
    }
}

#[test]
fn an_operator_may_take_an_older_state_or_refuse_it() {
    let rig = Rig::start(OWN_PROCESSES);
    let two = SwapRequest { operator: Some("tally-two".into()), ..with(json!({})) };
    let receipt = rig.swap(two);
    assert_done(&receipt);
    assert_eq!(receipt.state_versions, Some((1, 2)), "version 1 was taken by version 2: {receipt:?}");
    let one = SwapRequest { operator: Some("tally".into()), ..with(json!({})) };
    let refused = rig.swap(one);
    assert_eq!(refused.outcome, Outcome::Refused, "version 2 is not taken by version 1: {refused:?}");
    let reason = refused.reason.clone().unwrap_or_default();
    assert!(reason.contains("version 2") && reason.contains("--fresh"), "it says how to go on: {reason}");
    rig.assert_unbroken();
    rig.end();
}

#[test]
fn a_restart_keeps_the_state_unless_it_is_told_not_to() {
    for nodes in [OWN_PROCESSES, ONE_PROCESS] {
        let rig = Rig::start(nodes);
        let restart = |fresh| {
            let terms = SwapTerms { fresh, shadow_ms: 0, ..terms() };
            rig.client.change(&Change::Restart { node: "tally".into(), terms }).expect("the supervisor answers")
        };
        let kept = restart(false);
        assert_done(&kept);
        assert!(kept.state_bytes.is_some_and(|bytes| bytes > 0), "the state goes over: {kept:?}");
        rig.assert_unbroken();
        let count = || rig.came().last().map_or(0.0, |(.., count)| *count);
        let before = count();
        let fresh = restart(true);
        assert_eq!((fresh.outcome, fresh.state_bytes), (Outcome::Done, None), "without the state: {fresh:?}");
        rig.wait_for_more(1);
        assert!(count() < before, "it counts anew: {} after {before}", count());
        let version = rig.client.graph().expect("the supervisor answers").nodes[1].version;
        assert_eq!(version, 1, "it is the version that it was");
        let back = rig.client.change(&Change::Rollback { node: "tally".into(), terms: terms() });
        let reason = back.expect("the supervisor answers").reason.unwrap_or_default();
        assert!(reason.contains("was not changed"), "a restart is nothing to go back to: {reason}");
        rig.end();
    }
}

#[test]
fn a_source_in_steady_time_is_replaced_without_a_break() {
    let rig = Rig::start(OWN_PROCESSES);
    for period_ms in [1, 2, 1] {
        let request = SwapRequest { node: "ticker".into(), ..with(json!({ "period_ms": period_ms })) };
        assert_done(&rig.swap(request));
    }
    let exec = Some(rig.binary("ticker"));
    assert_done(&rig.swap(SwapRequest { node: "ticker".into(), exec, ..with(json!({})) }));
    rig.assert_unbroken();
    rig.end();
}

/// Faults that show in shadow, and those that come only after the take-over.
#[test]
fn a_candidate_that_fails_changes_nothing() {
    for nodes in [OWN_PROCESSES, ONE_PROCESS] {
        let rig = Rig::start(nodes);
        for fault in ["panic", "error", "garbage"] {
            let early = rig.swap(with(json!({ "fault": fault, "after": 10 })));
            assert_eq!(early.outcome, Outcome::Refused, "{fault}: it shows in shadow: {early:?}");
            // Without shadow it counts from the take-over on.
            let late = SwapTerms { shadow_ms: 0, ..terms() };
            let late = rig.swap(SwapRequest { terms: late, ..with(json!({ "fault": fault, "after": 12 })) });
            assert_ne!(late.outcome, Outcome::Done, "{fault}: {late:?}");
            assert!(late.reason.is_some(), "{fault}: it says why: {late:?}");
        }
        rig.assert_unbroken();
        rig.end();
    }
}

#[test]
fn a_candidate_that_stalls_is_left_behind() {
    let stall = |after: u32, shadow_ms: u64| SwapRequest {
        terms: SwapTerms { shadow_ms, stall_ms: 400, probation_outputs: 1000, ..terms() },
        ..with(json!({ "fault": "stall", "after": after }))
    };
    let rig = Rig::start(ONE_PROCESS);
    for request in [stall(5, 1000), stall(40, 0)] {
        let receipt = rig.swap(request);
        assert_ne!(receipt.outcome, Outcome::Done, "{receipt:?}");
        assert!(receipt.reason.as_ref().is_some_and(|reason| reason.contains("stalls")), "it says so: {receipt:?}");
    }
    rig.assert_unbroken();
    rig.end();
}

#[test]
fn a_candidate_process_that_dies_or_grows_changes_nothing() {
    let rig = Rig::start(OWN_PROCESSES);
    let exec = Some(rig.binary("tally"));
    let request = |config: Value, shadow_ms: u64| SwapRequest {
        exec: exec.clone(),
        terms: SwapTerms { shadow_ms, probation_outputs: 1000, memory_limit_mb: 80, ..terms() },
        ..with(config)
    };
    let cases = [
        (json!({ "fault": "exit", "after": 20 }), 500, "exit code 7"),
        (json!({ "fault": "exit", "after": 60 }), 0, "exit code 7"),
        (json!({ "fault": "grow" }), 2000, "memory"),
        (json!({ "unbuildable": true }), 0, "told not to be built"),
        (json!({ "refuse_state": true }), 0, "told to refuse"),
    ];
    for (config, shadow_ms, why) in cases {
        let receipt = rig.swap(request(config.clone(), shadow_ms));
        assert_ne!(receipt.outcome, Outcome::Done, "{config}: {receipt:?}");
        let reason = receipt.reason.clone().unwrap_or_default();
        assert!(reason.contains(why), "{config}: it says why: {receipt:?}");
    }
    rig.assert_unbroken();
    let processes = rig.running.run_file().processes.len();
    assert_eq!(processes, 3, "no candidate is left behind");
    rig.end();
}

#[test]
fn a_candidate_that_is_killed_in_any_phase_changes_nothing() {
    let rig = Rig::start(OWN_PROCESSES);
    let exec = Some(rig.binary("tally"));
    for (delay_ms, shadow_ms) in [(5, 300), (60, 300), (300, 300), (150, 0), (350, 0), (500, 0)] {
        let terms = SwapTerms { shadow_ms, probation_outputs: 100_000, probation_ms: 1500, ..terms() };
        let request = SwapRequest { exec: exec.clone(), terms, ..with(json!({})) };
        let receipt = std::thread::scope(|scope| {
            let swapping = scope.spawn(|| rig.swap(request));
            let candidate = || {
                let run = rig.running.run_file();
                run.processes.iter().find(|entry| entry.name.starts_with("tally.")).and_then(|entry| entry.pid)
            };
            until("the candidate's process", || candidate().is_some());
            std::thread::sleep(Duration::from_millis(delay_ms));
            if let Some(pid) = candidate() {
                kill(Pid::from_raw(pid as i32), Signal::SIGKILL).expect("it is alive");
            }
            swapping.join().expect("the swap ends")
        });
        assert_ne!(receipt.outcome, Outcome::Done, "{delay_ms} ms: {receipt:?}");
        assert!(
            receipt.phase.is_some() && receipt.reason.is_some(),
            "{delay_ms} ms: which phase, and why: {receipt:?}"
        );
    }
    rig.assert_unbroken();
    rig.end();
}

#[test]
fn what_cannot_be_is_refused_before_anything_starts() {
    let rig = Rig::start(OWN_PROCESSES);
    let missing = Some(rig.dir.path().join("missing"));
    let cases = [
        (SwapRequest { node: "nobody".into(), ..with(json!({})) }, "`nobody`"),
        (SwapRequest { operator: Some("nothing".into()), ..with(json!({})) }, "`nothing`"),
        (SwapRequest { operator: Some("stranger".into()), ..with(json!({})) }, "input `number`"),
        (SwapRequest { exec: missing, ..with(json!({})) }, "missing"),
        (with(json!({ "offset": 5000.0 })), "-1000 to 1000"),
        (with(json!({ "offzet": 1 })), "offzet"),
        (with(json!({ "offset": "high" })), "offset"),
    ];
    for (request, why) in cases {
        let receipt = rig.swap(request);
        assert_eq!(receipt.outcome, Outcome::Refused, "{receipt:?}");
        assert!(receipt.reason.as_ref().is_some_and(|reason| reason.contains(why)), "{why}: {receipt:?}");
    }
    let nothing = rig.client.change(&Change::Rollback { node: "tally".into(), terms: terms() });
    assert_eq!(nothing.expect("it answers").outcome, Outcome::Refused, "there is nothing to go back to");
    rig.assert_unbroken();
    rig.end();
}

#[test]
fn two_swaps_of_one_node_at_once_are_one() {
    let rig = Rig::start(OWN_PROCESSES);
    let receipts: Vec<Receipt> = std::thread::scope(|scope| {
        let swaps: Vec<_> = (0..2).map(|_| scope.spawn(|| rig.swap(with(json!({ "after": 1 }))))).collect();
        swaps.into_iter().map(|swap| swap.join().expect("it ends")).collect()
    });
    let done = receipts.iter().filter(|receipt| receipt.outcome == Outcome::Done).count();
    let refused = receipts.iter().find(|receipt| receipt.outcome == Outcome::Refused).expect("one is refused");
    assert_eq!(done, 1, "the other goes through: {receipts:?}");
    assert!(refused.reason.as_ref().is_some_and(|reason| reason.contains("under way")), "it says so: {refused:?}");
    rig.assert_unbroken();
    rig.end();
}

/// A node that holds a device which counts its holders, and a journal of who held it.
struct DeviceRig {
    rig: Rig,
    journal: PathBuf,
    _dir: tempfile::TempDir,
}

impl DeviceRig {
    fn start() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let (lock, journal) = (dir.path().join("device"), dir.path().join("journal"));
        let config = json!({ "lock": lock, "journal": journal });
        let nodes = format!("  device: {{ operator: device, config: {config} }}\n");
        Self { rig: Rig::start_listening(&nodes, ("device", "number")), journal, _dir: dir }
    }

    fn swap(&self, config: Value) -> Receipt {
        self.rig.swap(SwapRequest { node: "device".into(), ..with(config) })
    }

    /// In a process of its own; another binary starts with another configuration.
    fn swap_binary(&self, config: Value) -> Receipt {
        let mut values = values(config);
        values.insert("lock".into(), json!(self.journal.with_file_name("device")));
        values.insert("journal".into(), json!(self.journal));
        let exec = Some(self.rig.binary("device"));
        self.rig.swap(SwapRequest { node: "device".into(), exec, ..with(Value::Object(values)) })
    }

    /// It was opened so often, each time after it had been closed, and nobody met it taken.
    fn assert_held_by_one_at_a_time(&self, openings: usize) {
        let journal = std::fs::read_to_string(&self.journal).expect("it was opened");
        let lines: Vec<&str> = journal.lines().collect();
        let one_at_a_time = lines.iter().enumerate().all(|(at, line)| *line == ["opened", "closed"][at % 2]);
        assert!(one_at_a_time && lines.len() == 2 * openings - 1, "{openings} times, one at a time: {lines:?}");
    }

    /// Every number once, one life: what came before the swaps and after them is one count.
    fn assert_one_count(&self) {
        self.rig.wait_for_more(50);
        let mut came = self.rig.came();
        came.sort_by_key(|(epoch, seq, ..)| (*epoch, *seq));
        for pair in came.windows(2) {
            let [(epoch, seq, number, _), (next_epoch, next_seq, next_number, _)] = pair else { continue };
            assert_eq!((epoch, seq + 1), (next_epoch, *next_seq), "one life, no gap in the sequence: {pair:?}");
            assert!((next_number - number - 1.0).abs() < 0.5, "each number once: {pair:?}");
        }
    }
}

#[test]
fn a_device_is_never_held_twice() {
    let device = DeviceRig::start();
    assert_done(&device.swap(json!({ "panic_at": 100_000 })));
    assert_done(&device.swap_binary(json!({})));
    assert_done(&device.swap_binary(json!({ "panic_at": 100_000 })));
    device.assert_one_count();
    let failed = device.swap(json!({ "panic_at": 5 }));
    assert_eq!(failed.outcome, Outcome::RolledBack, "it panics on probation: {failed:?}");
    device.rig.wait_for_more(50);
    let mut epochs: Vec<u64> = device.rig.came().iter().map(|(epoch, ..)| *epoch).collect();
    epochs.dedup();
    assert_eq!(epochs.len(), 1, "one life");
    // The first one, three successors, the one that panicked, and the one before it again.
    device.assert_held_by_one_at_a_time(6);
    device.rig.end();
}

#[test]
fn a_node_whose_successor_cannot_open_the_device_comes_back_with_its_state() {
    let device = DeviceRig::start();
    for (at, in_a_process_of_its_own) in [false, true].into_iter().enumerate() {
        let broken = json!({ "broken": true });
        let receipt = if in_a_process_of_its_own { device.swap_binary(broken) } else { device.swap(broken) };
        assert_eq!(receipt.outcome, Outcome::RolledBack, "{receipt:?}");
        assert_eq!(receipt.phase.as_deref(), Some("hand-over"), "it was to open it then: {receipt:?}");
        assert!(receipt.reason.as_ref().is_some_and(|reason| reason.contains("cannot be opened")), "{receipt:?}");
        device.assert_one_count();
        device.assert_held_by_one_at_a_time(at + 2);
    }
    device.rig.end();
}

#[test]
fn a_word_during_the_swap_is_heard() {
    let rig = Rig::start(OWN_PROCESSES);
    let words: Arc<Mutex<Vec<Control>>> = Arc::default();
    let heard = Arc::clone(&words);
    let guard = rig.client.subscribe("tally", "word", move |header, payload, _| {
        let word = Control::decode(&header.meta, &payload).expect("a word");
        heard.lock().expect("no test panics while it hears").push(word);
    });
    let _guard = guard.expect("subscribing");
    for round in 1..=5_usize {
        std::thread::scope(|scope| {
            let swapping = scope.spawn(|| rig.swap(with(json!({ "after": round }))));
            std::thread::sleep(Duration::from_millis(round as u64 * 20));
            rig.client.control(Control::EStop).expect("they hear");
            assert_done(&swapping.join().expect("the swap ends"));
        });
        until("the word", || words.lock().expect("no test panics while it hears").len() >= round);
    }
    rig.end();
}

#[test]
fn a_parameter_is_set_between_two_steps() {
    let rig = Rig::start(OWN_PROCESSES);
    let set = |config: Value| {
        let change = Change::Set { node: "tally".into(), values: values(config) };
        rig.client.change(&change).expect("the supervisor answers")
    };
    for after in 0..20 {
        assert_eq!(set(json!({ "after": after })).outcome, Outcome::Done, "it is in force");
    }
    let refused = set(json!({ "offset": 1e9 }));
    assert_eq!(refused.outcome, Outcome::Refused, "out of range: {refused:?}");
    let graph = rig.client.graph().expect("the supervisor answers");
    let tally = graph.nodes.iter().find(|node| node.name == "tally").expect("the node");
    assert_eq!((tally.version, tally.config["after"].clone()), (21, json!(19)), "the last that went through");
    rig.assert_unbroken();
    rig.end();
}

#[test]
fn a_driver_that_never_gets_its_device_gives_the_node_back() {
    let device = DeviceRig::start();
    for in_a_process_of_its_own in [false, true] {
        let dark = json!({ "dark": true });
        let receipt = if in_a_process_of_its_own { device.swap_binary(dark) } else { device.swap(dark) };
        assert_eq!(receipt.outcome, Outcome::RolledBack, "{receipt:?}");
        device.assert_one_count();
    }
    device.rig.end();
}
