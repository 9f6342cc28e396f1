//! The running graph becomes another one, in real processes: what does not change is left alone, what changes loses nothing, and a
//! node that fails undoes everything.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use carril_messages::{Command, Message};
use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::{
    Action, ApplyReceipt, ApplyRequest, Change, NodeChange, Outcome, SwapRequest, SwapTerms,
};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::supervisor::plan::Plan;
use carril_runtime::supervisor::{Options, Running, Supervisor};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

#[path = "support/swap_operators.rs"]
mod swap_operators;
#[path = "support/until.rs"]
mod until;

use until::until;

/// A source, a count of what comes from it, and a count of that: each in a process of its own.
const CHAIN: &str = "  ticker: { operator: ticker }
  tally: { operator: tally, inputs: { number: { from: ticker/number, queue: 1000, reliable: true } } }
  sink: { operator: tally, inputs: { number: { from: tally/tally, queue: 1000, reliable: true } } }
";

fn graph(nodes: &str) -> Graph {
    graph_of(&format!("robot: car\nnodes:\n{nodes}"))
}

fn graph_of(text: &str) -> Graph {
    Graph::parse(text.to_owned(), Path::new("test.yaml"), &swap_operators::registry(), &ReadOptions::default())
        .unwrap_or_else(|problems| panic!("the graph is valid: {problems:?}"))
}

/// What came out of a port: life, sequence number, the two numbers of the command.
type Came = Arc<Mutex<Vec<(u64, u64, f32, f32)>>>;

struct Rig {
    running: Running,
    client: Client,
    dir: tempfile::TempDir,
}

impl Rig {
    fn start(nodes: &str) -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let program = (PathBuf::from(env!("CARGO_BIN_EXE_carril-test-host")), vec!["process".to_owned()]);
        let options = Options { program: Some(program), runs_dir: Some(dir.path().to_owned()), ..Options::default() };
        let registry = swap_operators::registry();
        let running = Supervisor::start(&graph(nodes), &registry, &options).expect("the graph starts");
        let client = Client::open(find_run(dir.path(), None).expect("it runs")).expect("it can be reached");
        Self { running, client, dir }
    }

    /// Hears an output from now on.
    fn hear(&self, node: &str, port: &str) -> (Came, carril_runtime::transport::Guard) {
        let came = Came::default();
        let heard = Arc::clone(&came);
        let guard = self.client.subscribe(node, port, move |header, payload, _| {
            let command = Command::decode(&header.meta, &payload).expect("a command");
            let mut heard = heard.lock().expect("no test panics while it hears");
            heard.push((header.epoch, header.seq, command.speed_m_s, command.steering_rad));
        });
        let guard = guard.expect("subscribing");
        wait_for_more(&came, 50);
        (came, guard)
    }

    fn request(wanted: &Graph, agreed: Option<Vec<NodeChange>>) -> ApplyRequest {
        let plan = serde_json::to_value(Plan::new(wanted, 0)).expect("a plan is JSON");
        let terms = SwapTerms { shadow_ms: 100, probation_outputs: 20, stall_ms: 1500, ..SwapTerms::default() };
        ApplyRequest { plan, text: wanted.text.clone(), terms, agreed }
    }

    fn plan(&self, wanted: &Graph) -> ApplyReceipt {
        self.client.apply(&Self::request(wanted, None)).expect("the supervisor answers")
    }

    /// Looks at the plan, agrees, and has it carried out.
    fn apply(&self, wanted: &Graph) -> ApplyReceipt {
        let plan = self.plan(wanted);
        assert_eq!(plan.outcome, Outcome::Planned, "{plan:?}");
        self.client.apply(&Self::request(wanted, Some(plan.changes))).expect("the supervisor answers")
    }

    #[track_caller]
    fn apply_well(&self, wanted: &Graph) -> ApplyReceipt {
        let receipt = self.apply(wanted);
        assert_eq!(receipt.outcome, Outcome::Done, "{receipt:?}");
        for step in &receipt.steps {
            assert_eq!((step.lost, step.duplicated), (0, 0), "nothing is lost, nothing comes twice: {step:?}");
        }
        let again = self.plan(wanted);
        assert!(again.changes.is_empty(), "it runs as the file says: {again:?}");
        receipt
    }

    fn process(&self, node: &str) -> String {
        let run = self.running.run_file();
        run.nodes.iter().find(|entry| entry.name == node).expect("the node").process.clone()
    }

    fn pid(&self, node: &str) -> u32 {
        let (run, process) = (self.running.run_file(), self.process(node));
        let entry = run.processes.iter().find(|entry| entry.name == process).expect("its process");
        entry.pid.expect("it is up")
    }

    fn processes(&self) -> Vec<String> {
        let mut names: Vec<String> = self.running.run_file().processes.into_iter().map(|entry| entry.name).collect();
        names.sort();
        names
    }

    fn end(self) {
        self.running.stop();
        self.running.wait().expect("the run ends in order");
    }
}

fn wait_for_more(came: &Came, count: usize) {
    let len = || came.lock().expect("no test panics while it hears").len();
    let before = len();
    until("more samples", || len() >= before + count);
}

/// What came, each once, in order. What came first came while the link came up.
fn in_order(came: &Came) -> Vec<(u64, u64, f32, f32)> {
    wait_for_more(came, 50);
    let mut came = came.lock().expect("no test panics while it hears").clone();
    came.drain(..50);
    came.sort_by_key(|(epoch, seq, ..)| (*epoch, *seq));
    came.dedup_by_key(|(epoch, seq, ..)| (*epoch, *seq));
    came
}

/// One life, no gap in the sequence. Of an output with a reliable reader: only there the link may lose nothing.
#[track_caller]
fn assert_unbroken(came: &Came) {
    for pair in in_order(came).windows(2) {
        assert_eq!((pair[0].0, pair[0].1 + 1), (pair[1].0, pair[1].1), "one life, no gap in the sequence: {pair:?}");
    }
}

/// One life, in which a count goes on with the sequence numbers: nothing was made twice or left out, whatever the link lost.
#[track_caller]
fn assert_goes_on(came: &Came, count: impl Fn(f32, f32) -> f32) {
    let ahead =
        |(_, seq, number, counted): &(u64, u64, f32, f32)| (count(*number, *counted) - *seq as f32).round() as i64;
    for pair in in_order(came).windows(2) {
        assert_eq!((pair[0].0, ahead(&pair[0])), (pair[1].0, ahead(&pair[1])), "one life, one count: {pair:?}");
    }
}

/// The count in the second number goes on.
#[track_caller]
fn assert_counts_on(came: &Came) {
    assert_goes_on(came, |_, count| count);
}

fn actions(receipt: &ApplyReceipt) -> Vec<(&str, Vec<Action>)> {
    receipt.changes.iter().map(|change| (change.node.as_str(), change.actions.clone())).collect()
}

/// The chain with a node put in between.
fn longer_chain() -> Graph {
    let middle =
        "  middle: { operator: tally, inputs: { number: { from: ticker/number, queue: 1000, reliable: true } } }\n";
    graph(&(CHAIN.replace("from: ticker/number", "from: middle/tally") + middle))
}

#[test]
fn a_node_is_put_in_between_and_taken_out_again_and_the_others_are_left_alone() {
    let rig = Rig::start(CHAIN);
    let (ticks, _ticks) = rig.hear("ticker", "number");
    let (tallies, _tallies) = rig.hear("tally", "tally");
    let before = [rig.pid("ticker"), rig.pid("sink")];
    let longer = longer_chain();
    let planned = rig.plan(&longer);
    assert_eq!(
        (actions(&planned), planned.unchanged.clone()),
        (vec![("tally", vec![Action::Rewire]), ("middle", vec![Action::Add])], vec!["ticker".into(), "sink".into()]),
        "what is to be done: {planned:?}"
    );
    assert_eq!(rig.processes(), ["sink", "tally", "ticker"], "a plan changes nothing");
    rig.apply_well(&longer);
    assert_eq!(rig.processes(), ["middle", "sink", "tally", "ticker"], "the new node has a process");
    let (middle, _middle) = rig.hear("middle", "tally");
    assert_counts_on(&middle);
    rig.apply_well(&graph(CHAIN));
    until("the process of the node that went to end", || rig.processes() == ["sink", "tally", "ticker"]);
    assert_eq!([rig.pid("ticker"), rig.pid("sink")], before, "the others keep their processes");
    assert_unbroken(&ticks);
    assert_unbroken(&tallies);
    assert_counts_on(&tallies);
    rig.end();
}

#[test]
fn a_node_moves_into_the_process_of_another_and_out_again() {
    let rig = Rig::start(CHAIN);
    let (tallies, _tallies) = rig.hear("tally", "tally");
    let (sums, _sums) = rig.hear("sink", "tally");
    let together = CHAIN.replace("operator: tally,", "operator: tally, process: counting,");
    let receipt = rig.apply_well(&graph(&together));
    assert_eq!(receipt.changes[0].actions, [Action::Move], "{receipt:?}");
    assert_eq!((rig.process("tally"), rig.process("sink")), ("counting".into(), "counting".into()), "together");
    until("the empty processes to end", || rig.processes() == ["counting", "ticker"]);
    rig.apply_well(&graph(CHAIN));
    assert_ne!(rig.process("tally"), rig.process("sink"), "apart");
    // Into a process that was linked to none of its neighbours.
    rig.apply_well(&graph(&CHAIN.replace("operator: ticker", "operator: ticker, process: sink")));
    assert_eq!(rig.process("ticker"), rig.process("sink"), "in the process that is there");
    assert_unbroken(&tallies);
    assert_counts_on(&tallies);
    assert_counts_on(&sums);
    rig.end();
}

#[test]
fn only_what_differs_is_done_anew() {
    let rig = Rig::start(CHAIN);
    let (tallies, _tallies) = rig.hear("tally", "tally");
    let cases = [
        (
            "operator: tally, inputs: { number: { from: ticker",
            "config: { offset: 0 }",
            "nothing: the default is written out",
        ),
        ("operator: tally, inputs: { number: { from: ticker", "config: { offset: 2 }", "reconfigure"),
        ("operator: tally, inputs: { number: { from: ticker", "deadline_ms: 500", "reconfigure, settings"),
        ("operator: tally, inputs: { number: { from: ticker", "restart: { max: 9 }", "settings"),
    ];
    for (before, more, what) in cases {
        let wanted = graph(&CHAIN.replace(before, &format!("{more}, {before}")));
        let planned = rig.plan(&wanted);
        let shown: Vec<String> =
            planned.changes.iter().flat_map(|change| &change.actions).map(ToString::to_string).collect();
        let shown = if shown.is_empty() { "nothing: the default is written out".to_owned() } else { shown.join(", ") };
        assert_eq!(shown, what, "{more}: {planned:?}");
        assert_eq!(planned.unchanged.len() + planned.changes.len(), 3, "each node is in one of both: {planned:?}");
        rig.apply_well(&wanted);
    }
    assert_counts_on(&tallies);
    rig.end();
}

#[test]
fn a_budget_concerns_the_node_at_which_it_ends() {
    let rig = Rig::start(CHAIN);
    let (tallies, _tallies) = rig.hear("tally", "tally");
    let budgets = "budgets:\n  - { from: ticker/number, to: sink/number, max_age_ms: 60000, on_violation: warn }\n";
    let receipt = rig.apply_well(&graph_of(&format!("robot: car\nnodes:\n{CHAIN}{budgets}")));
    assert_eq!(actions(&receipt), [("sink", vec![Action::Settings])], "{receipt:?}");
    assert_counts_on(&tallies);
    rig.end();
}

#[test]
fn a_node_that_fails_undoes_everything() {
    let device = |lock: &Path| format!("  device: {{ operator: device, config: {{ lock: {} }} }}\n", lock.display());
    let lock_dir = tempfile::tempdir().expect("a temporary folder");
    let lock = lock_dir.path().join("lock");
    let rig = Rig::start(&(CHAIN.to_owned() + &device(&lock)));
    let (tallies, _tallies) = rig.hear("tally", "tally");
    let (sums, _sums) = rig.hear("sink", "tally");
    let (numbers, _numbers) = rig.hear("device", "number");
    let processes = rig.processes();
    // The device is let go first, then come `middle` and `other`, then the sink is replaced, then `tally` fails.
    let nodes = format!(
        "  ticker: {{ operator: ticker }}
  sink: {{ operator: tally, config: {{ offset: 1 }}, inputs: {{ number: {{ from: tally/tally, queue: 1000, reliable: true }} }} }}
  tally: {{ operator: tally, config: {{ fault: panic, after: 5 }}, inputs: {{ number: middle/tally }} }}
  middle: {{ operator: tally, inputs: {{ number: ticker/number }} }}
{}",
        device(&lock).replace("device:", "other:")
    );
    let failing = graph(&nodes);
    let receipt = rig.apply(&failing);
    assert_eq!((receipt.outcome, receipt.node.as_deref()), (Outcome::RolledBack, Some("tally")), "{receipt:?}");
    let reason = receipt.reason.clone().unwrap_or_default();
    assert!(reason.contains("told to panic") && !reason.contains("could not be put back"), "why: {receipt:?}");
    let undone: Vec<&str> =
        receipt.steps.iter().filter(|step| step.what == "undo").map(|step| step.node.as_str()).collect();
    assert_eq!(undone, ["sink", "other", "middle", "device"], "the last is undone first: {receipt:?}");
    let again = rig.plan(&graph(&(CHAIN.to_owned() + &device(&lock))));
    assert!(again.changes.is_empty(), "the graph is as it was: {again:?}");
    until("what came to be gone", || rig.processes() == processes);
    assert_counts_on(&tallies);
    assert_counts_on(&sums);
    assert_goes_on(&numbers, |number, _| number);
    rig.end();
}

#[test]
fn a_node_of_its_own_that_dies_afterwards_comes_back_as_applied() {
    let rig = Rig::start(CHAIN);
    rig.apply_well(&longer_chain());
    let (sums, _sums) = rig.hear("sink", "tally");
    for node in ["middle", "tally", "ticker"] {
        let pid = rig.pid(node);
        kill(Pid::from_raw(pid as i32), Signal::SIGKILL).expect("it is alive");
        until("it to be started again", || {
            let run = rig.running.run_file();
            let entry = run.processes.iter().find(|entry| entry.name == rig.process(node));
            entry.and_then(|entry| entry.pid).is_some_and(|now| now != pid)
        });
        wait_for_more(&sums, 50);
    }
    let planned = rig.plan(&longer_chain());
    assert!(planned.changes.is_empty(), "{planned:?}");
    rig.end();
}

#[test]
fn a_node_that_hangs_can_be_removed() {
    let hung = "  hung: { operator: tally, config: { fault: stall, after: 3 }, inputs: { number: ticker/number } }\n";
    let rig = Rig::start(&(CHAIN.to_owned() + hung));
    let (tallies, _tallies) = rig.hear("tally", "tally");
    rig.apply_well(&graph(CHAIN));
    until("its process to be gone", || rig.processes() == ["sink", "tally", "ticker"]);
    assert_counts_on(&tallies);
    rig.end();
}

#[test]
fn other_changes_wait_while_a_graph_is_applied() {
    let rig = Rig::start(CHAIN);
    let (tallies, _tallies) = rig.hear("tally", "tally");
    let longer = longer_chain();
    let agreed = rig.plan(&longer).changes;
    let request = Rig::request(&longer, Some(agreed));
    let request = ApplyRequest { terms: SwapTerms { shadow_ms: 1500, ..request.terms }, ..request };
    let swap = Change::Swap(SwapRequest { node: "sink".into(), ..SwapRequest::default() });
    std::thread::scope(|scope| {
        let applying = scope.spawn(|| rig.client.apply(&request).expect("the supervisor answers"));
        until("the apply to begin", || rig.processes().len() > 3);
        let refused = rig.client.change(&swap).expect("the supervisor answers");
        assert_eq!((refused.outcome, refused.phase.as_deref()), (Outcome::Refused, Some("request")), "{refused:?}");
        assert!(refused.reason.is_some_and(|reason| reason.contains("apply")), "it says why");
        let second = rig.client.apply(&request).expect("the supervisor answers");
        assert_eq!(second.outcome, Outcome::Refused, "{second:?}");
        let receipt = applying.join().expect("no panic");
        assert_eq!(receipt.outcome, Outcome::Done, "{receipt:?}");
    });
    let after = rig.client.change(&swap).expect("the supervisor answers");
    assert_eq!(after.outcome, Outcome::Done, "then it goes through: {after:?}");
    assert_counts_on(&tallies);
    rig.end();
}

#[test]
fn what_cannot_be_applied_is_refused_before_anything_is_done() {
    let rig = Rig::start(CHAIN);
    let (tallies, _tallies) = rig.hear("tally", "tally");
    let stale = Rig::request(&longer_chain(), Some(Vec::new()));
    let stale = rig.client.apply(&stale).expect("the supervisor answers");
    let why = |receipt: &ApplyReceipt| receipt.reason.clone().unwrap_or_default();
    assert!(why(&stale).contains("no longer as it was"), "agreed to something else: {stale:?}");
    let other = graph_of(&format!("robot: truck\nnodes:\n{CHAIN}"));
    let other = rig.plan(&other);
    assert!(why(&other).contains("`truck`") && why(&other).contains("`car`"), "another robot: {other:?}");
    let garbage = ApplyRequest { plan: serde_json::json!({ "seed": "x" }), ..Rig::request(&graph(CHAIN), None) };
    let garbage = rig.client.apply(&garbage).expect("the supervisor answers");
    assert!(why(&garbage).contains("no graph"), "not a plan: {garbage:?}");
    let mut elsewhere = graph(CHAIN);
    elsewhere.base_dir = rig.dir.path().to_owned();
    let elsewhere = rig.plan(&elsewhere);
    assert!(why(&elsewhere).contains("put the file there"), "another folder: {elsewhere:?}");
    let mut wrong = graph(CHAIN);
    wrong.nodes[1].config = serde_json::json!({ "offset": 1e9 });
    let wrong = rig.plan(&wrong);
    assert!(why(&wrong).contains("offset"), "a value out of range: {wrong:?}");
    let mut loose = graph(CHAIN);
    loose.nodes[1].inputs[0].from.node = "nobody".into();
    let loose = rig.plan(&loose);
    assert!(why(&loose).contains("`nobody/number`, which nothing publishes"), "an edge from nowhere: {loose:?}");
    for receipt in [stale, other, garbage, elsewhere, wrong, loose] {
        assert_eq!((receipt.outcome, receipt.phase.as_deref()), (Outcome::Refused, Some("request")), "{receipt:?}");
    }
    assert_eq!(rig.processes(), ["sink", "tally", "ticker"], "nothing has changed");
    assert_counts_on(&tallies);
    rig.end();
}
