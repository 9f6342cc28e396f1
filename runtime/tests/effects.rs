//! What a graph asks of the operating system and of late steps must really happen: priority, cores and locked memory are read
//! back from /proc, late steps are counted. Where this machine does not permit something, the test says so and passes.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command as Program;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use carril_messages::{Command, Header, Key, Message, Meta, Origins, Stamp, VehicleState};
use carril_runtime::clock::LiveClock;
use carril_runtime::executor::live::{Environment, Executor};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::supervisor::{Event, Options, Running, Supervisor};
use carril_runtime::transport::memory::MemoryTransport;
use carril_runtime::transport::{Sink, Transport};
use carril_runtime::{AnyInput, Incoming, Input};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

#[path = "support/live_operators.rs"]
mod live_operators;
#[path = "support/until.rs"]
mod until;

use until::until;

const PATIENCE: Duration = Duration::from_secs(10);

fn graph(nodes: &str) -> Graph {
    let text = format!("robot: car\nnodes:\n{nodes}");
    Graph::parse(text, Path::new("test.yaml"), &live_operators::registry(), &ReadOptions::default())
        .unwrap_or_else(|problems| panic!("the graph is valid: {problems:?}"))
}

/// A run with real processes, each started through `wrapper`.
fn start(nodes: &str, runs: &Path, wrapper: &[&str]) -> Running {
    let host = env!("CARGO_BIN_EXE_carril-test-host");
    let mut words: Vec<String> = wrapper.iter().map(|word| (*word).to_owned()).collect();
    words.extend([host.to_owned(), "process".to_owned()]);
    let program = Some((PathBuf::from(words.remove(0)), words));
    let options = Options { program, runs_dir: Some(runs.to_owned()), ..Options::default() };
    Supervisor::start(&graph(nodes), &live_operators::registry(), &options).expect("the graph starts")
}

/// The process of a node that has told its health, and so has set up its thread.
fn pid_at_work(running: &Running, node: &str) -> u32 {
    let mut pid = None;
    until("the health of the node", || {
        let status = running.status();
        let status = status.borrow();
        pid = status.nodes.iter().find(|health| health.node == node && health.steps > 0).and_then(|health| health.pid);
        pid.is_some()
    });
    pid.expect("the loop waited for it")
}

/// The folder in /proc of the thread that is named like the node.
fn thread_of(pid: u32, node: &str) -> PathBuf {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).expect("the process lives");
    let named = |path: &PathBuf| fs::read_to_string(path.join("comm")).is_ok_and(|name| name.trim() == node);
    let mut found = threads.filter_map(|thread| Some(thread.ok()?.path())).filter(named);
    found.next().expect("the node has a thread of its name")
}

/// Scheduling policy and realtime priority of a thread: fields 41 and 40 of `stat` (proc_pid_stat(5)).
fn policy_and_priority(thread: &Path) -> (u32, u32) {
    let stat = fs::read_to_string(thread.join("stat")).expect("the thread lives");
    let after_name = stat.rsplit_once(')').expect("the name is in brackets").1;
    // The first of these is field 3.
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    let number = |field: usize| fields[field - 3].parse().expect("a number");
    (number(41), number(40))
}

fn status_line(folder: &Path, name: &str) -> String {
    let status = fs::read_to_string(folder.join("status")).expect("the process lives");
    let line = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
    line.unwrap_or_else(|| panic!("status has `{name}`")).trim().to_owned()
}

/// What the processes have said so far.
fn lines(events: &mut tokio::sync::broadcast::Receiver<Event>) -> Vec<String> {
    let mut lines = Vec::new();
    while let Ok(event) = events.try_recv() {
        if let Event::Line { text, .. } = event {
            lines.push(text);
        }
    }
    lines
}

fn locked_kb(pid: u32) -> u64 {
    let line = status_line(Path::new(&format!("/proc/{pid}")), "VmLck");
    line.trim_end_matches("kB").trim().parse().expect("a number of kB")
}

fn end(running: Running) {
    running.stop_now();
    running.wait().expect("an end at once");
}

fn permitted(program: &str, arguments: &[&str]) -> bool {
    Program::new(program).args(arguments).output().is_ok_and(|output| output.status.success())
}

const SCHED_FIFO: u32 = 1;
/// Zenoh locks the few pages in which it keeps account of shared memory.
const ZENOH_LOCKS_KB: u64 = 256;

#[test]
fn priority_and_cores_are_really_set() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = "  urgent: { operator: source, process: all, priority: 17 }
  pinned: { operator: source, process: all, cpus: [0] }
  plain: { operator: source, process: all }
";
    let running = start(nodes, runs.path(), &["env"]);
    let pid = pid_at_work(&running, "pinned");
    assert_eq!(status_line(&thread_of(pid, "pinned"), "Cpus_allowed_list"), "0", "only core 0");
    assert_eq!(policy_and_priority(&thread_of(pid, "plain")).0, 0, "who asks for nothing keeps SCHED_OTHER");
    let all = status_line(&thread_of(pid, "plain"), "Cpus_allowed_list");
    assert_eq!(all, status_line(Path::new("/proc/self"), "Cpus_allowed_list"), "and all cores");
    if permitted("chrt", &["--fifo", "17", "true"]) {
        assert_eq!(policy_and_priority(&thread_of(pid, "urgent")), (SCHED_FIFO, 17), "SCHED_FIFO at 17");
    } else {
        println!("left out: SCHED_FIFO is not permitted here (`chrt --fifo 17 true` fails)");
    }
    end(running);
}

#[test]
fn locked_memory_is_really_locked() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = "  locked: { operator: source, lock_memory: true }\n  loose: { operator: source }\n";
    let running = start(nodes, runs.path(), &["env"]);
    let mut events = running.events();
    let (locked, loose) = (locked_kb(pid_at_work(&running, "locked")), locked_kb(pid_at_work(&running, "loose")));
    end(running);
    assert!(loose <= ZENOH_LOCKS_KB, "who does not ask for it has nothing locked: {loose} kB");
    if lines(&mut events).iter().any(|line| line.contains("its memory cannot be locked")) {
        println!("left out: locking memory is not permitted here (the process has said so)");
    } else {
        assert!(locked > 1024, "who asks for it, and hears no refusal, has its pages locked: {locked} kB");
    }
}

#[test]
fn what_is_not_permitted_is_said_and_the_node_runs_without() {
    let limits = ["prlimit", "--memlock=65536:65536", "--rtprio=0:0"];
    // Root has the rights without any limit: they are taken away.
    let without_rights = ["setpriv", "--bounding-set=-sys_nice,-ipc_lock"];
    let is_root = nix::unistd::geteuid().is_root();
    let mut wrapper: Vec<&str> = if is_root { without_rights.to_vec() } else { Vec::new() };
    wrapper.extend(limits);
    if !permitted(wrapper[0], &[&wrapper[1..], &["true"]].concat()) {
        println!("left out: rights cannot be taken away here (`{} true` fails)", wrapper.join(" "));
        return;
    }
    let runs = tempfile::tempdir().expect("a temporary folder");
    let running = start("  urgent: { operator: source, priority: 17, lock_memory: true }\n", runs.path(), &wrapper);
    let mut events = running.events();
    let pid = pid_at_work(&running, "urgent");
    assert_eq!(policy_and_priority(&thread_of(pid, "urgent")).0, 0, "it runs, without the priority");
    assert!(locked_kb(pid) <= ZENOH_LOCKS_KB, "and without locked memory: {} kB", locked_kb(pid));
    end(running);
    let lines = lines(&mut events);
    for words in [
        ["node `urgent`: priority 17 (SCHED_FIFO) is not permitted", "ulimit -r 17"],
        ["process `urgent`: its memory cannot be locked", "ulimit -l unlimited"],
    ] {
        let told = lines.iter().filter(|line| words.iter().all(|word| line.contains(word))).count();
        assert_eq!(told, 1, "{words:?} is said once, with a remedy: {lines:#?}");
    }
}

/// The speeds that came out of a node: each sample here carries its number as its speed.
#[derive(Default)]
struct Passed(Mutex<Vec<f32>>);

impl Sink for Passed {
    fn deliver(&self, incoming: Incoming) {
        let mut input = Input::<Command>::default();
        input.accept(incoming).expect("the node sends commands");
        let speed_m_s = input.take().expect("it was just put in").speed_m_s;
        self.0.lock().expect("no test panics while it hears").push(speed_m_s);
    }

    fn refuse(&self, reason: String) {
        panic!("an output is always valid: {reason}");
    }
}

impl Passed {
    fn speeds(&self) -> Vec<f32> {
        self.0.lock().expect("no test panics while it hears").clone()
    }
}

/// What a late step of `late` comes to: five samples wait when it ends. Gives how many were dropped, and the numbers
/// of those that came out.
fn late_step(on_overrun: &str) -> (u64, Vec<f32>) {
    let transport = MemoryTransport::default();
    // Its writer lives elsewhere, so that the test can be the writer.
    let nodes = format!(
        "  source: {{ operator: source, process: other }}
  late: {{ operator: follower, process: all, deadline_ms: 20, on_overrun: {on_overrun}, config: {{ hold_at: 1 }}, inputs: {{ command: {{ from: source/command, queue: 100 }} }} }}\n"
    );
    let environment = Environment {
        transport: Arc::new(transport.clone()),
        clock: Arc::new(LiveClock::anchored_now()),
        run_dir: None,
        seed: 1,
    };
    let (executor, _events) = Executor::start(&graph(&nodes), "all", &environment).expect("the nodes start");
    let passed = Arc::new(Passed::default());
    let out = Key::new("car", "late", "command");
    let _guard = transport.subscribe(&out, false, passed.clone()).expect("listening");
    let hold = live_operators::Hold::begin();
    let put = move |transport: &MemoryTransport, seq: u64| {
        let (origins, meta) = (Origins::none(), Meta::new());
        let header = Header { epoch: 1, seq, stamp: Stamp::ZERO, origins, message_type: Command::TYPE, meta };
        let command = Command { speed_m_s: seq as f32, steering_rad: 0.0 }.encode().expect("a command encodes");
        let key = Key::new("car", "source", "command");
        transport.put_raw(&key, &header.encode().expect("a header encodes"), command.payload).expect("putting");
    };
    // The step may run on the thread that puts.
    let first = std::thread::spawn({
        let transport = transport.clone();
        move || put(&transport, 0)
    });
    until("the late step to be at work", || hold.is_at_work());
    std::thread::sleep(Duration::from_millis(25));
    (1..=5).for_each(|seq| put(&transport, seq));
    hold.release();
    first.join().expect("putting does not panic");
    // Answered between two steps: the late one is over.
    drop(executor.health(PATIENCE));
    put(&transport, 6);
    until("the last sample to be through", || passed.speeds().last() == Some(&6.0));
    let health = executor.health(PATIENCE).pop().expect("the node answers");
    assert_eq!(health.overruns, 1, "one late step");
    executor.stop();
    (health.inputs[0].dropped, passed.speeds())
}

#[test]
fn skip_drops_what_queued_up_and_warn_does_not() {
    assert_eq!(late_step("skip"), (5, vec![0.0, 6.0]), "the late one comes out, and what came after it had ended");
    assert_eq!(late_step("warn"), (0, vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), "all come out");
}

#[test]
fn stop_really_stops_the_car_and_one_that_starts_later() {
    let runs = tempfile::tempdir().expect("a temporary folder");
    let nodes = "  car: { operator: car }
  source: { operator: source }
  late: { operator: follower, deadline_ms: 1, on_overrun: stop, config: { step_ms: 3 }, inputs: { command: source/command } }
";
    let running = start(nodes, runs.path(), &["env"]);
    let (stands, speeds) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(Vec::new())));
    let (own_stands, own_speeds) = (Arc::clone(&stands), Arc::clone(&speeds));
    let guard = running.subscribe("car", "state", move |_, payload, _| {
        let state = VehicleState::decode(&[], &payload).expect("a state of the car");
        own_speeds.lock().expect("no test panics while it hears").push(state.speed_m_s);
        own_stands.store(state.speed_m_s == 0.0, Ordering::Relaxed);
    });
    let _guard = guard.expect("subscribing");
    until("the car in its own process to stand", || stands.load(Ordering::Relaxed));
    let fault = |running: &Running| running.status().borrow().fault.clone();
    until("the fault in the status", || fault(&running).is_some());
    let text = format!("{:?}", fault(&running));
    assert!(text.contains("late") && text.contains("deadline"), "who stopped it, and why: {text}");

    let pid = |running: &Running| {
        let run = running.run_file();
        run.processes.iter().find(|process| process.name == "car").and_then(|process| process.pid)
    };
    let old = pid(&running).expect("it runs");
    kill(Pid::from_raw(old as i32), Signal::SIGKILL).expect("the child is alive");
    until("another process in its place", || pid(&running).is_some_and(|new| new != old));
    speeds.lock().expect("no test panics while it hears").clear();
    until("it drives off, is told, and stands", || {
        let speeds = speeds.lock().expect("no test panics while it hears");
        speeds.last() == Some(&0.0)
    });
    end(running);
}
