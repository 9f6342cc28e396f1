//! The default graph at work, and what can be seen of it from outside: samples with their headers, receipts, processes.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Header, Payload, Stamp};
use carril_runtime::client::{Client, find_run};
use carril_runtime::transport::Guard;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use super::{HANGS_AFTER, Outcome, Running, Sandbox, program, project_file};

/// The default graph with the patience that a shared test machine needs: a lease, a budget and a deadline of a second and more, and a
/// slow car, which does not leave its lane while the machine does something else.
/// Then with more changes, each of which must find what it changes.
pub fn patient_graph(more: &[(&str, &str)]) -> String {
    let text = std::fs::read_to_string(project_file("dataflow.yaml")).expect("the default graph is there");
    patient(text, &[&[("tracks/oval.yaml", "oval")], more].concat())
}

/// A graph like the default one, slow and patient.
pub fn patient(text: String, more: &[(&str, &str)]) -> String {
    let patience = [
        ("lease_ms: 200", "lease_ms: 1500"),
        ("max_age_ms: 100", "max_age_ms: 3000"),
        ("deadline_ms: 10", "deadline_ms: 1000"),
        (
            "auto_start: true",
            "auto_start: true, cruise_speed_m_s: 0.3, lane_timeout_ms: 1500, sectors_timeout_ms: 3000",
        ),
        (
            "inputs: { command: decision/command }",
            "inputs: { command: decision/command }\n    config: { timeout_ms: 1500 }",
        ),
    ];
    patience.iter().chain(more).fold(text, |text, (from, to)| {
        assert!(text.contains(from), "the graph has `{from}`");
        text.replace(from, to)
    })
}

/// A busy machine drops frames and estimates on these edges, swap or no swap. With these changes each one must come through, so that one
/// that is missing was lost by a swap.
pub const EVERY_FRAME: [(&str, &str); 2] = [
    ("inputs: { image: world/camera }", "inputs: { image: { from: world/camera, queue: 60, reliable: true } }"),
    ("lane: lane/lane,", "lane: { from: lane/lane, queue: 60, reliable: true },"),
];

/// The same for what the actuator sends.
pub const EVERY_COMMAND: (&str, &str) = (
    "inputs: { command: actuator/command }",
    "inputs: { command: { from: actuator/command, queue: 60, reliable: true } }",
);

/// Waits for what must happen sooner or later; only a hang fails.
#[track_caller]
pub fn until(what: &str, mut reached: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !reached() {
        assert!(begun.elapsed() < HANGS_AFTER, "still waiting for: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// A sample's header, as far as tests want it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Heard {
    /// Life of its writer.
    pub epoch: u64,
    /// Number within it.
    pub seq: u64,
    /// Publication.
    pub stamp: Stamp,
    /// Exposure; `None`: it derives from no sensor.
    pub captured: Option<Stamp>,
}

/// Everything that came on a port.
pub struct Ears<T> {
    heard: Arc<Mutex<Vec<(Heard, T)>>>,
    _guard: Guard,
}

impl<T: Clone + Send + 'static> Ears<T> {
    /// What came so far, in the order in which it came.
    pub fn heard(&self) -> Vec<(Heard, T)> {
        self.heard.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The headers of it.
    pub fn headers(&self) -> Vec<Heard> {
        self.heard().into_iter().map(|(header, _)| header).collect()
    }

    /// The last message.
    pub fn last(&self) -> Option<T> {
        self.heard.lock().unwrap_or_else(PoisonError::into_inner).last().map(|(_, value)| value.clone())
    }

    /// Waits for so many more.
    #[track_caller]
    pub fn wait_for(&self, count: usize) {
        let before = self.heard().len();
        until("more samples", || self.heard().len() >= before + count);
    }
}

/// A car at work.
pub struct Car {
    /// Where it runs.
    pub sandbox: Sandbox,
    /// `carril run`.
    pub run: Running,
    client: Arc<Client>,
}

impl Car {
    /// Launches a graph of [`patient_graph`] and waits until the car drives.
    pub fn launch(graph: &str) -> Self {
        let car = Self::launch_standing(Sandbox::new(), graph);
        car.until_it("drives", "lane-follow");
        car
    }

    /// Launches a graph in a folder where another may have run before.
    pub fn launch_standing(sandbox: Sandbox, graph: &str) -> Self {
        let file = sandbox.write("patient.yaml", graph).display().to_string();
        let run = sandbox.launch(&file, &[]);
        let runs = sandbox.path().join("runs");
        let client = Client::open(find_run(&runs, None).expect("it runs")).expect("it can be reached");
        Self { sandbox, run, client: Arc::new(client) }
    }

    /// This process's way into the run: it has one only.
    pub fn client(&self) -> Arc<Client> {
        Arc::clone(&self.client)
    }

    /// The file that it runs.
    pub fn graph_file(&self) -> PathBuf {
        self.sandbox.path().join("patient.yaml")
    }

    /// Hears a port: `world/camera`.
    pub fn hear<T: Clone + Send + 'static>(
        &self,
        port: &str,
        read: impl Fn(&Header, &Payload) -> T + Send + Sync + 'static,
    ) -> Ears<T> {
        let (node, port) = port.split_once('/').expect("node/port");
        let heard: Arc<Mutex<Vec<(Heard, T)>>> = Arc::default();
        let hearing = Arc::clone(&heard);
        let guard = self.client.subscribe(node, port, move |header, payload, _| {
            let value = read(&header, &payload);
            let Header { epoch, seq, stamp, ref origins, .. } = header;
            let heard = Heard { epoch, seq, stamp, captured: origins.oldest() };
            hearing.lock().unwrap_or_else(PoisonError::into_inner).push((heard, value));
        });
        Ears { heard, _guard: guard.expect("subscribing") }
    }

    /// Hears the headers of a port.
    pub fn hear_headers(&self, port: &str) -> Ears<()> {
        self.hear(port, |_, _| ())
    }

    /// The receipt of a change.
    #[track_caller]
    pub fn change(&self, args: &[&str]) -> Value {
        receipt(&self.sandbox.carril(&[args, &["--json"]].concat()))
    }

    /// Swaps with the patience that a shared test machine needs.
    #[track_caller]
    pub fn try_swap(&self, args: &[&str]) -> Value {
        self.change(&[&["swap"], args, &["--stall-ms", "2000"]].concat())
    }

    /// Swaps, which must go through with nothing lost and nothing twice.
    #[track_caller]
    pub fn swap(&self, args: &[&str]) -> Value {
        let receipt = self.try_swap(args);
        assert_eq!(receipt["outcome"], "done", "{args:?}: {receipt}");
        assert_eq!((&receipt["lost"], &receipt["duplicated"]), (&0.into(), &0.into()), "{args:?}: {receipt}");
        receipt
    }

    /// The newest message of a port.
    pub fn sample(&self, port: &str) -> Value {
        let outcome = self.sandbox.carril(&["echo", port, "-n", "1", "--json", "--for", "20s"]);
        let line = outcome.stdout.lines().next().unwrap_or_default().to_owned();
        serde_json::from_str::<Value>(&line).unwrap_or_default()["value"].clone()
    }

    /// Waits for a state of the decision node.
    #[track_caller]
    pub fn until_it(&self, what: &str, state: &str) {
        let state_now = || self.sample("decision/state")["state"].clone();
        until(&format!("the car {what}"), || state_now() == state);
    }

    /// It drives, and never was a wheel outside.
    #[track_caller]
    pub fn assert_in_the_lane(&self) {
        // A car that was just told to start has to come up to speed first.
        until("it to have driven", || {
            self.sample("world/progress")["distance_m"].as_f64().is_some_and(|driven| driven > 0.1)
        });
        let progress = self.sample("world/progress");
        let (departures, collisions) = (&progress["departures"], &progress["collisions"]);
        assert_eq!((departures, collisions), (&0.into(), &0.into()), "{progress}");
    }

    /// Where the output of the run stands now: see [`said_since`](Self::said_since).
    pub fn mark(&self) -> (usize, usize) {
        let (stdout, stderr) = self.run.output();
        (stdout.len(), stderr.len())
    }

    /// Whether the run, or one of its processes, has said this since the mark.
    pub fn said_since(&self, (stdout_at, stderr_at): (usize, usize), text: &str) -> bool {
        let (stdout, stderr) = self.run.output();
        [(stdout, stdout_at), (stderr, stderr_at)].iter().any(|(said, at)| said[*at..].contains(text))
    }

    /// `bad-operators` under the name of one of its operators.
    pub fn bad(&self, name: &str) -> String {
        bad_program(&self.sandbox, name).display().to_string()
    }

    /// Ends the run in order.
    #[track_caller]
    pub fn end(self) {
        drop(self.client);
        self.run.interrupt().expect(0);
    }

    /// Kills the supervisor as nothing can be prepared for, and gives what is left.
    pub fn kill_supervisor(self) -> Sandbox {
        self.run.signal(Signal::SIGKILL);
        drop(self.client);
        assert_eq!(self.run.wait().code, None, "it was killed");
        self.sandbox
    }
}

/// The receipt that a command has printed.
#[track_caller]
pub fn receipt(outcome: &Outcome) -> Value {
    serde_json::from_str(&outcome.stdout).unwrap_or_else(|error| panic!("{error}: {}", outcome.report()))
}

/// `bad-operators` under the name of one of its operators, in the sandbox.
pub fn bad_program(sandbox: &Sandbox, name: &str) -> PathBuf {
    let path = sandbox.path().join(name);
    if !path.exists() {
        // A program that is still open for writing cannot be started; a rename has no such moment.
        let fresh = sandbox.path().join(format!("{name}.new"));
        std::fs::copy(program("bad-operators"), &fresh).expect("the sandbox is writable");
        std::fs::rename(&fresh, &path).expect("the sandbox is writable");
    }
    path
}

/// The processes of runs in this sandbox, by process id and name.
pub fn processes(sandbox: &Sandbox) -> Vec<(i32, String)> {
    let runs = sandbox.path().join("runs").display().to_string();
    let entries = std::fs::read_dir("/proc").expect("Linux").flatten();
    let of_the_run = |entry: std::fs::DirEntry| {
        let pid: i32 = entry.file_name().to_str()?.parse().ok()?;
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let arguments: Vec<String> = line.split(|byte| *byte == 0).map(|a| String::from_utf8_lossy(a).into()).collect();
        let after = |name: &str| arguments.iter().skip_while(|argument| *argument != name).nth(1).cloned();
        after("--run-dir").filter(|dir| dir.starts_with(&runs))?;
        Some((pid, after("--name")?))
    };
    entries.filter_map(of_the_run).collect()
}

/// How far a swap of `lane` has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// The candidate's process starts.
    Start,
    /// The candidate is built.
    Prepare,
    /// It steps in shadow.
    Shadow,
    /// It takes over the state.
    HandOver,
    /// It publishes.
    Probation,
}

impl Phase {
    /// All of them, in order.
    pub const ALL: [Self; 5] = [Self::Start, Self::Prepare, Self::Shadow, Self::HandOver, Self::Probation];

    /// As receipts call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Prepare => "prepare",
            Self::Shadow => "shadow",
            Self::HandOver => "hand-over",
            Self::Probation => "probation",
        }
    }
}

impl Car {
    /// Begins a swap of `lane`, which runs `bad-lane`, and returns when it is in this phase, for long enough to strike: the command,
    /// and the candidate's process.
    #[track_caller]
    pub fn swap_as_far_as(&self, phase: Phase) -> (Running, i32) {
        let (program, more): (&str, &[&str]) = match phase {
            Phase::Start => ("slow-to-start", &[]),
            Phase::Prepare => ("bad-lane", &["--set", "build_ms=8000"]),
            Phase::Shadow => ("bad-lane", &["--shadow", "30s"]),
            Phase::HandOver => ("bad-lane", &["--shadow", "100ms", "--set", "take_over_ms=1500"]),
            Phase::Probation => ("bad-lane", &["--shadow", "100ms", "--probation", "100000"]),
        };
        let sign = match phase {
            Phase::Start => None,
            Phase::Prepare => Some("bad-lane is being built"),
            Phase::Shadow => Some("bad-lane steps with state 1"),
            Phase::HandOver => Some("bad-lane takes state 2"),
            Phase::Probation => Some("bad-lane steps with state 2"),
        };
        let (mark, exec) = (self.mark(), self.bad(program));
        let args = [&["swap", "lane", "--exec", &exec, "--json", "--stall-ms", "5000"], more].concat();
        let mut command = self.sandbox.start(&args);
        let mut candidate = None;
        until(&format!("the swap is in phase {}", phase.name()), || {
            command.must_be_alive(phase.name());
            candidate = candidate.or_else(|| self.candidate());
            candidate.is_some() && sign.is_none_or(|sign| self.said_since(mark, sign))
        });
        (command, candidate.expect("it was waited for"))
    }

    /// The process of a candidate for `lane`.
    pub fn candidate(&self) -> Option<i32> {
        processes(&self.sandbox).into_iter().find(|(_, name)| name.starts_with("lane.")).map(|(pid, _)| pid)
    }
}

/// Ends a process as nothing can be prepared for.
pub fn kill_at_once(pid: i32) {
    kill(Pid::from_raw(pid), Signal::SIGKILL).expect("it is alive");
}

/// Every frame between the first and the last estimate has exactly one, in the order of the frames, in one life with unbroken numbers.
/// A sample that came twice on the wire under one number is one: readers leave the second out.
#[track_caller]
pub fn assert_one_estimate_per_frame(frames: &[Heard], estimates: &[Heard]) {
    let mut estimates = estimates.to_vec();
    estimates.sort_by_key(|estimate| (estimate.epoch, estimate.seq));
    estimates.dedup_by_key(|estimate| (estimate.epoch, estimate.seq, estimate.captured));
    for pair in estimates.windows(2) {
        assert_eq!((pair[0].epoch, pair[0].seq + 1), (pair[1].epoch, pair[1].seq), "one life, no gap: {pair:?}");
        assert!(pair[0].captured <= pair[1].captured, "in the order of the frames: {pair:?}");
    }
    let frames: BTreeMap<Option<Stamp>, u64> = frames.iter().map(|frame| (frame.captured, frame.seq)).collect();
    let mut known = 0;
    let mut since: Option<(u64, u64)> = None;
    // A step that reads several frames sends several estimates, which all carry the exposure of the oldest.
    for step in estimates.chunk_by(|one, next| one.stamp == next.stamp && one.captured == next.captured) {
        let frame = frames.get(&step[0].captured).copied();
        if let (Some(frame), Some((before, estimates))) = (frame, since) {
            assert_eq!(frame - before, estimates, "one estimate for each frame from {before} to {frame}: {step:?}");
            known += estimates;
        }
        let so_far = since.filter(|_| frame.is_none());
        since = frame.map(|frame| (frame, 0)).or(so_far).map(|(frame, count)| (frame, count + step.len() as u64));
    }
    assert!(known * 2 > estimates.len() as u64, "the frames were heard: {known} of {}", estimates.len());
}
