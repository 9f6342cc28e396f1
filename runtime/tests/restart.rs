//! Nodes that are down are started again while the graph runs, as they were or as another version; and what is down is told from
//! what runs.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use carril_messages::NodeState;
use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::{Change, Outcome, Receipt, SwapRequest, SwapTerms};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::supervisor::{Options, Running, Supervisor};
use carril_runtime::transport::Guard;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};

#[path = "support/live_operators.rs"]
mod live_operators;
#[path = "support/until.rs"]
mod until;

use until::until;

struct Rig {
    running: Running,
    client: Client,
    _dir: tempfile::TempDir,
}

impl Rig {
    fn start(nodes: &str) -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let registry = live_operators::registry();
        let text = format!("robot: car\nnodes:\n{nodes}");
        let graph = Graph::parse(text, Path::new("test.yaml"), &registry, &ReadOptions::default())
            .unwrap_or_else(|problems| panic!("the graph is valid: {problems:?}"));
        let program = (PathBuf::from(env!("CARGO_BIN_EXE_carril-test-host")), vec!["process".to_owned()]);
        let options = Options { program: Some(program), runs_dir: Some(dir.path().to_owned()), ..Options::default() };
        let running = Supervisor::start(&graph, &registry, &options).expect("the graph starts");
        let client = Client::open(find_run(dir.path(), None).expect("it runs")).expect("it can be reached");
        Self { running, client, _dir: dir }
    }

    fn state(&self, node: &str) -> NodeState {
        let status = self.running.status();
        let status = status.borrow();
        status.nodes.iter().find(|health| health.node == node).map_or(NodeState::Starting, |health| health.state)
    }

    #[track_caller]
    fn until_state(&self, node: &str, state: NodeState) {
        until(&format!("`{node}` {state:?}"), || self.state(node) == state);
    }

    fn change(&self, change: &Change) -> Receipt {
        self.client.change(change).expect("the supervisor answers")
    }

    fn restart(&self, node: &str) -> Receipt {
        self.change(&Change::Restart { node: node.into(), terms: terms() })
    }

    fn swap(&self, node: &str, values: Value) -> Receipt {
        self.change(&Change::Swap(swap(node, values)))
    }

    fn pid(&self, node: &str) -> Option<u32> {
        let run = self.running.run_file();
        let process = &run.nodes.iter().find(|entry| entry.name == node)?.process;
        run.processes.iter().find(|entry| entry.name == *process)?.pid
    }

    /// Counts the samples of `node/command`, and its lives.
    fn listen(&self, node: &str) -> (Arc<Heard>, Guard) {
        let heard = Arc::new(Heard::default());
        let own = Arc::clone(&heard);
        let guard = self.client.subscribe(node, "command", move |header, _, _| {
            if own.epoch.swap(header.epoch, Ordering::Relaxed) != header.epoch {
                own.lives.fetch_add(1, Ordering::Relaxed);
            }
            own.samples.fetch_add(1, Ordering::Relaxed);
        });
        (heard, guard.expect("subscribing"))
    }

    fn end(self) {
        self.running.stop();
        self.running.wait().expect("the run ends in order");
    }
}

#[derive(Default)]
struct Heard {
    samples: AtomicU64,
    lives: AtomicU64,
    epoch: AtomicU64,
}

impl Heard {
    #[track_caller]
    fn hears(&self, what: &str) {
        let before = self.samples.load(Ordering::Relaxed);
        until(what, || self.samples.load(Ordering::Relaxed) > before + 10);
    }
}

fn terms() -> SwapTerms {
    SwapTerms { stall_ms: 2000, probation_outputs: 5, ..SwapTerms::restart(false) }
}

fn swap(node: &str, values: Value) -> SwapRequest {
    let Value::Object(values) = values else { panic!("{values} is no object") };
    SwapRequest { node: node.into(), values, terms: terms(), ..SwapRequest::default() }
}

#[track_caller]
fn assert_done(receipt: &Receipt) {
    assert_eq!(receipt.outcome, Outcome::Done, "it goes through: {receipt:?}");
}

/// Refused, with these words in the reason.
#[track_caller]
fn assert_refused(receipt: &Receipt, words: &[&str]) {
    assert_eq!(receipt.outcome, Outcome::Refused, "nothing has changed: {receipt:?}");
    let reason = receipt.reason.clone().unwrap_or_default();
    for word in words {
        assert!(reason.contains(word), "`{word}` in: {reason}");
    }
}

#[track_caller]
fn sigkill(pid: Option<u32>) {
    kill(Pid::from_raw(pid.expect("it runs") as i32), Signal::SIGKILL).expect("the child is alive");
}

const BREAKS: &str = "  source: { operator: source }
  bad: { operator: follower, config: { panic_at: 3 }, restart: { max: 1 }, inputs: { command: source/command } }
  last: { operator: follower, inputs: { command: bad/command } }
";

#[test]
fn a_node_that_gave_up_comes_back_as_the_version_that_mends_it() {
    let rig = Rig::start(BREAKS);
    let (last, _guard) = rig.listen("last");
    rig.until_state("bad", NodeState::GaveUp);

    let set = Change::Set { node: "bad".into(), values: serde_json::Map::new() };
    assert_refused(&rig.change(&set), &["gave up", "carril restart bad", "carril swap bad"]);
    let compare = SwapTerms { compare_only: true, ..terms() };
    let shadow = Change::Swap(SwapRequest { terms: compare, ..swap("bad", json!({})) });
    assert_refused(&rig.change(&shadow), &["nothing to compare with", "carril restart bad"]);
    assert_refused(&rig.restart("bad"), &["told to panic"]);
    rig.until_state("bad", NodeState::GaveUp);
    let processes = rig.running.run_file().processes;
    assert_eq!(processes.iter().filter(|process| process.pid.is_some()).count(), 2, "nothing is left: {processes:?}");

    let mended = rig.swap("bad", json!({ "panic_at": null }));
    assert_done(&mended);
    assert!(mended.from.ends_with("; it gave up"), "the receipt says how it was: {}", mended.from);
    last.hears("samples through the new version");
    rig.until_state("bad", NodeState::Running);
    let version = rig.client.graph().expect("the supervisor answers").nodes[1].version;
    assert_eq!(version, 2, "it is another version");
    assert_eq!(last.lives.load(Ordering::Relaxed), 1, "its reader did not notice");
    rig.end();
}

#[test]
fn a_version_that_gives_up_after_its_probation_can_be_taken_back() {
    let rig = Rig::start(&BREAKS.replace("panic_at: 3", ""));
    let (last, _guard) = rig.listen("last");
    last.hears("samples");
    assert_done(&rig.swap("bad", json!({ "panic_at": 40 })));
    rig.until_state("bad", NodeState::GaveUp);
    assert_done(&rig.change(&Change::Rollback { node: "bad".into(), terms: terms() }));
    last.hears("samples of the version before");
    let back = rig.client.graph().expect("the supervisor answers").nodes[1].config["panic_at"].clone();
    assert_eq!(back, Value::Null, "as it was");
    rig.end();
}

#[test]
fn nodes_that_are_left_down_come_back_one_by_one() {
    let rig = Rig::start(
        "  source: { operator: source }
  middle: { operator: follower, restart: { policy: never }, inputs: { command: source/command } }
  last: { operator: follower, restart: { policy: never }, inputs: { command: middle/command } }
",
    );
    let (source, _source_guard) = rig.listen("source");
    let (last, _last_guard) = rig.listen("last");
    last.hears("samples through three processes");
    for node in ["middle", "last"] {
        sigkill(rig.pid(node));
        rig.until_state(node, NodeState::Stopped);
    }
    // Its neighbour is down: it cannot be told, and need not be.
    assert_done(&rig.restart("last"));
    assert_done(&rig.restart("middle"));
    last.hears("samples through two new processes");
    assert_eq!(source.lives.load(Ordering::Relaxed), 1, "the one that was up did not notice");
    sigkill(rig.pid("middle"));
    rig.until_state("middle", NodeState::Stopped);
    assert_done(&rig.restart("middle"));
    last.hears("samples after another death: its rule is still its own");
    let versions: Vec<u32> =
        rig.client.graph().expect("the supervisor answers").nodes.iter().map(|node| node.version).collect();
    assert_eq!(versions, [1, 1, 1], "a restart is no other version");
    rig.end();
}

#[test]
fn a_node_that_gave_up_in_a_shared_process_comes_back_beside_its_neighbours() {
    let rig = Rig::start(
        "  source: { operator: source, process: all }
  bad: { operator: follower, process: all, config: { panic_at: 3 }, restart: { max: 1 }, inputs: { command: source/command } }
  good: { operator: follower, process: all, inputs: { command: source/command } }
",
    );
    let (bad, _bad_guard) = rig.listen("bad");
    let (good, _good_guard) = rig.listen("good");
    rig.until_state("bad", NodeState::GaveUp);
    let before = rig.pid("bad");
    assert_refused(&rig.restart("bad"), &["told to panic"]);
    assert_done(&rig.swap("bad", json!({ "panic_at": null })));
    bad.hears("samples of the new version");
    rig.until_state("bad", NodeState::Running);
    assert_eq!(rig.pid("bad"), before, "in the same process");
    let heard = rig.client.control(carril_messages::Control::Stop).expect("asking");
    assert!(heard.iter().all(Result::is_ok), "words reach it, and nobody waits for the one that is gone: {heard:?}");
    assert_done(&rig.restart("bad"));
    bad.hears("samples after a restart of what runs");
    assert_eq!(good.lives.load(Ordering::Relaxed), 1, "its neighbour did not notice");
    rig.end();
}
