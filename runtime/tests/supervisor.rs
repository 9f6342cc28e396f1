//! The supervisor with real processes: what dies comes back, what dies too often stays down, nothing is left behind.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use carril_messages::{Control, Goal, Message, NodeState};
use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::RunFile;
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::supervisor::run_dir::is_alive;
use carril_runtime::supervisor::{Event, Options, RunError, Running, Supervisor};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

#[path = "support/live_operators.rs"]
mod live_operators;
#[path = "support/until.rs"]
mod until;

use until::until;

fn graph(nodes: &str) -> Graph {
    let text = format!("robot: car\nnodes:\n{nodes}");
    let registry = live_operators::registry();
    Graph::parse(text, Path::new("test.yaml"), &registry, &ReadOptions::default())
        .unwrap_or_else(|problems| panic!("the graph is valid: {problems:?}"))
}

fn options(runs: &Path) -> Options {
    let program = (PathBuf::from(env!("CARGO_BIN_EXE_carril-test-host")), vec!["process".to_owned()]);
    Options { program: Some(program), runs_dir: Some(runs.to_owned()), ..Options::default() }
}

fn start(nodes: &str, runs: &Path) -> Running {
    Supervisor::start(&graph(nodes), &live_operators::registry(), &options(runs)).expect("the graph starts")
}

fn state(running: &Running, node: &str) -> NodeState {
    let status = running.status();
    let status = status.borrow();
    status.nodes.iter().find(|health| health.node == node).map_or(NodeState::Starting, |health| health.state)
}

fn pid(run: &RunFile, process: &str) -> Option<u32> {
    run.processes.iter().find(|entry| entry.name == process)?.pid
}

fn sigkill(pid: u32) {
    kill(Pid::from_raw(pid as i32), Signal::SIGKILL).expect("the child is alive");
}

/// The epochs and the number of samples of a port.
#[derive(Default)]
struct Port {
    epochs: Mutex<Vec<u64>>,
    samples: AtomicU64,
}

fn listen(client: &Client, node: &str, port: &str) -> (Arc<Port>, Box<dyn std::any::Any>) {
    let heard = Arc::new(Port::default());
    let own = Arc::clone(&heard);
    let guard = client.subscribe(node, port, move |header, _, _| {
        let mut epochs = own.epochs.lock().expect("no test panics while it hears");
        if epochs.last() != Some(&header.epoch) {
            epochs.push(header.epoch);
        }
        own.samples.fetch_add(1, Ordering::Relaxed);
    });
    (heard, guard.expect("subscribing"))
}

fn hears(port: &Port, what: &str) {
    let before = port.samples.load(Ordering::Relaxed);
    until(what, || port.samples.load(Ordering::Relaxed) > before + 10);
}

const CHAIN: &str = "  source: { operator: source }
  middle: { operator: follower, inputs: { command: source/command } }
  last: { operator: follower, inputs: { command: middle/command } }
";

#[test]
fn processes_talk_die_come_back_and_leave_nothing_behind() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let running = start(CHAIN, runs.path());
    let client = Client::open(find_run(runs.path(), None).expect("it runs")).expect("a way in");
    let (source, _source_guard) = listen(&client, "source", "command");
    let (last, _last_guard) = listen(&client, "last", "command");
    hears(&last, "samples through three processes");

    let old = pid(&running.run_file(), "middle").expect("it runs");
    sigkill(old);
    until("another process in its place", || pid(&running.run_file(), "middle").is_some_and(|new| new != old));
    hears(&last, "samples through the new process");
    assert_eq!(source.epochs.lock().expect("no panic").len(), 1, "the others did not notice: source");
    assert_eq!(last.epochs.lock().expect("no panic").len(), 1, "the others did not notice: last");
    until("the restart in the status", || {
        running.status().borrow().nodes.iter().any(|node| node.node == "middle" && node.restarts == 1)
    });

    let pids: Vec<u32> = running.run_file().processes.iter().filter_map(|process| process.pid).collect();
    assert_eq!(pids.len(), 3, "three processes");
    running.stop();
    running.wait().expect("an orderly end");
    assert!(pids.into_iter().all(|pid| !is_alive(pid)), "no process is left");
    assert!(!runs.path().join("car").exists(), "no folder is left");
}

#[test]
fn what_dies_too_often_stays_down_and_the_rest_goes_on() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = "  source: { operator: source }
  bad: { operator: follower, config: { panic_at: 1 }, restart: { max: 2 }, inputs: { command: source/command } }
";
    let running = start(nodes, runs.path());
    let mut events = running.events();
    until("it to be given up", || state(&running, "bad") == NodeState::GaveUp);
    let all: Vec<Event> = std::iter::from_fn(|| events.try_recv().ok()).collect();
    let died: Vec<_> = all
        .iter()
        .filter_map(|event| match event {
            Event::Died { process, again_in, .. } if process == "bad" => *again_in,
            _ => None,
        })
        .collect();
    assert_eq!(died, [100, 200].map(Duration::from_millis), "two restarts, the second after a longer pause");
    let why = all.iter().find_map(|event| match event {
        Event::GaveUp { why, .. } => Some(why.clone()),
        _ => None,
    });
    assert!(why.is_some_and(|why| why.contains("exit code 101") && why.contains("2 times")), "it says why: {all:?}");
    let panic_shown = |event: &Event| matches!(event, Event::Line { text, .. } if text.contains("told to panic"));
    assert!(all.iter().any(panic_shown), "what the node said is passed on: {all:?}");
    assert_eq!(state(&running, "source"), NodeState::Running, "the other node works");
    running.stop();
    running.wait().expect("an orderly end");
}

#[test]
fn words_and_goals_reach_nodes_also_without_a_supervisor_in_between() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let running = start(CHAIN, runs.path());
    let client = Client::open(find_run(runs.path(), None).expect("it runs")).expect("a way in");
    let (words, _guard) = listen(&client, "middle", "word");
    until("all nodes to hear", || {
        let answers = client.control(Control::EStop).expect("asking");
        answers.iter().flatten().flat_map(|reply| &reply.nodes).count() == 3
    });
    until("a word to be acted on", || {
        client.control(Control::Reset).expect("asking");
        words.samples.load(Ordering::Relaxed) >= 1
    });
    let mut goals = client.publisher("middle", "goal", Goal::TYPE);
    let goal = || Goal::Cruise { speed_m_s: 0.4 }.encode().expect("a goal encodes");
    until("the goal in the health of the node", || {
        goals.put(goal()).expect("putting");
        let status = client.next_status(Duration::from_secs(3));
        status.is_some_and(|status| status.nodes[1].inputs.iter().any(|i| i.port == "goal" && i.received > 0))
    });
    assert_eq!(client.run().expect("the supervisor answers").robot, "car", "the run file over the link");
    running.stop();
    running.wait().expect("an orderly end");
}

#[test]
fn a_second_run_of_the_same_robot_is_refused() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let running = start("  source: { operator: source }\n", runs.path());
    let second = Supervisor::start(
        &graph("  source: { operator: source }\n"),
        &live_operators::registry(),
        &options(runs.path()),
    );
    let error = second.err().expect("it is refused").to_string();
    assert!(error.contains("`car`") && error.contains(&std::process::id().to_string()), "who runs: {error}");
    running.stop_now();
    running.wait().expect("an end at once");
    assert!(!runs.path().join("car").exists(), "no folder is left");
}

#[test]
fn a_node_that_cannot_be_built_ends_the_run_with_its_reason() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = "  source: { operator: source, config: { refuse: true } }\n  other: { operator: source }\n";
    let running = start(nodes, runs.path());
    let error = running.wait().expect_err("the run ends");
    assert!(matches!(&error, RunError::Setup { process, .. } if process == "source"), "which process: {error:?}");
    assert!(error.to_string().contains("no device here; plug it in"), "the operator's own words: {error}");
    assert!(!runs.path().join("car").exists(), "no folder is left");
}

#[test]
fn a_program_that_is_not_there_is_named() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let program = Some((PathBuf::from("/nowhere/carril"), Vec::new()));
    let options = Options { program, ..options(runs.path()) };
    let running = Supervisor::start(&graph("  source: { operator: source }\n"), &live_operators::registry(), &options)
        .expect("the folder is made");
    let error = running.wait().expect_err("nothing can be started").to_string();
    assert!(error.contains("/nowhere/carril"), "the program is named: {error}");
}

#[test]
fn the_car_is_stopped_before_its_processes() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = "  vehicle: { operator: car }\n  follower: { operator: follower }\n";
    let running = start(nodes, runs.path());
    let client = Client::open(find_run(runs.path(), None).expect("it runs")).expect("a way in");
    let last_speed = Arc::new(Mutex::new(None));
    let heard = Arc::clone(&last_speed);
    let _guard = client.subscribe("vehicle", "state", move |header, payload, _| {
        let state = carril_messages::VehicleState::decode(&header.meta, &payload).expect("it is one");
        *heard.lock().expect("no panic") = Some(state.speed_m_s);
    });
    until("the car to drive", || *last_speed.lock().expect("no panic") == Some(0.5));
    running.stop();
    running.wait().expect("an orderly end");
    assert_eq!(*last_speed.lock().expect("no panic"), Some(0.0), "the last that was heard: it stands");
}

#[test]
fn nothing_outlives_a_killed_supervisor_and_the_next_run_takes_over() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let file = runs.path().join("graph.yaml");
    std::fs::write(&file, format!("robot: car\nnodes:\n{CHAIN}")).expect("the folder is writable");
    let mut supervisor = std::process::Command::new(env!("CARGO_BIN_EXE_carril-test-host"))
        .arg("supervise")
        .args([&file, runs.path()])
        .spawn()
        .expect("the supervisor starts");
    let mut pids = Vec::new();
    until("three processes", || {
        pids = find_run(runs.path(), None)
            .map_or_else(|_| Vec::new(), |run| run.processes.iter().filter_map(|process| process.pid).collect());
        pids.len() == 3
    });
    supervisor.kill().expect("it is alive");
    supervisor.wait().expect("it was killed");
    until("its processes to die with it", || !pids.iter().any(|pid| is_alive(*pid)));
    let stale = find_run(runs.path(), None).expect_err("nothing runs").to_string();
    assert!(stale.contains("has died"), "tools say what happened: {stale}");
    let running = start(CHAIN, runs.path());
    running.stop();
    running.wait().expect("an orderly end of the run after it");
    assert!(!runs.path().join("car").exists(), "no folder is left");
}

#[test]
fn a_binary_of_the_users_own_is_a_node() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = format!(
        "  source: {{ exec: {} }}\n  reader: {{ operator: follower, inputs: {{ command: source/command }} }}\n",
        env!("CARGO_BIN_EXE_carril-test-host")
    );
    let running = start(&nodes, runs.path());
    let client = Client::open(find_run(runs.path(), None).expect("it runs")).expect("a way in");
    let (reader, _guard) = listen(&client, "reader", "command");
    hears(&reader, "samples from the binary");
    let entry = running.run_file().nodes.swap_remove(0);
    assert_eq!(
        (entry.operator.as_str(), entry.exec.is_some()),
        ("source", true),
        "one of its operators, by the node's name"
    );
    assert_eq!(entry.outputs[0].message_type, "carril/Command", "the type of its port, from its description");
    running.stop();
    running.wait().expect("an orderly end");
}

#[test]
fn a_process_that_hangs_is_killed_in_the_end() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = "  source: { operator: source }
  hung: { operator: follower, config: { step_ms: 3600000 }, inputs: { command: source/command } }
";
    let running = start(nodes, runs.path());
    let pid = || pid(&running.run_file(), "hung");
    let client = Client::open(find_run(runs.path(), None).expect("it runs")).expect("a way in");
    until("the node to be named as stuck", || {
        let answers = client.control(Control::Stop).expect("asking");
        answers.iter().any(|answer| answer.as_ref().is_err_and(|error| error.contains("`hung` did not hear `stop`")))
    });
    let hung = pid().expect("it runs");
    running.stop();
    running.wait().expect("an end all the same");
    assert!(!is_alive(hung), "it is gone");
}
