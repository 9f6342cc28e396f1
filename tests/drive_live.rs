//! The default graph, live: seven nodes in seven processes, Zenoh, a real serial line. The car laps; nodes are killed while it drives; the
//! microcontroller's cable is pulled. Asserts what the car did, never how fast.

mod support;

use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use support::{HANGS_AFTER, Running, Sandbox, project_file, thorough};

/// The default graph with the patience that a shared test machine needs: a lease and a budget of a second and more.
fn patient_graph(sandbox: &Sandbox) -> String {
    let text = std::fs::read_to_string(project_file("dataflow.yaml")).expect("the default graph is there");
    let changes = [
        ("tracks/oval.yaml", "oval"),
        ("lease_ms: 200", "lease_ms: 1500"),
        ("max_age_ms: 100", "max_age_ms: 3000"),
        ("auto_start: true", "auto_start: true, lane_timeout_ms: 1500, sectors_timeout_ms: 3000"),
        (
            "inputs: { command: decision/command }",
            "inputs: { command: decision/command }\n    config: { timeout_ms: 1500 }",
        ),
    ];
    let patient = changes.iter().fold(text, |text, (from, to)| {
        assert!(text.contains(from), "the default graph has `{from}`");
        text.replace(from, to)
    });
    sandbox.write("patient.yaml", patient).display().to_string()
}

/// A car at work, and what can be asked about it.
struct Drive {
    sandbox: Sandbox,
    run: Running,
}

impl Drive {
    fn start(arguments: &[&str]) -> Self {
        let sandbox = Sandbox::new();
        let graph = patient_graph(&sandbox);
        let run = sandbox.launch(&graph, arguments);
        Self { sandbox, run }
    }

    /// The newest sample of a port; `None` when none came within some seconds.
    fn sample(&self, port: &str) -> Option<Value> {
        let outcome = self.sandbox.carril(&["echo", port, "-n", "1", "--json", "--for", "10s"]);
        let first: Value = serde_json::from_str(outcome.stdout.lines().next()?).ok()?;
        first.get("value").cloned()
    }

    fn number(&self, port: &str, field: &str) -> f64 {
        self.sample(port).and_then(|value| value[field].as_f64()).unwrap_or(f64::NAN)
    }

    fn node(&self, name: &str) -> Value {
        let top = self.sandbox.carril(&["top", "-n", "1", "--json"]).stdout;
        let status: Value = serde_json::from_str(&top).unwrap_or_default();
        let nodes = status["nodes"].as_array().cloned().unwrap_or_default();
        nodes.into_iter().find(|node| node["node"] == name).unwrap_or_default()
    }

    #[track_caller]
    fn until(&self, what: &str, reached: impl Fn(&Self) -> bool) {
        let begun = Instant::now();
        while !reached(self) {
            let said = || self.run.output().0.lines().rev().take(8).collect::<Vec<_>>().join("\n");
            assert!(begun.elapsed() < HANGS_AFTER, "{what}: never reached; the run said last:\n{}", said());
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    #[track_caller]
    fn drives_on(&self, metres: f64) {
        let begun_m = self.number("world/progress", "distance_m");
        self.until(&format!("{metres} m more"), |drive| {
            drive.number("world/progress", "distance_m") >= begun_m + metres
        });
    }

    /// As `kill -9` does, on the process of a node; waits until another has taken its place.
    #[track_caller]
    fn kill_and_wait(&self, name: &str) {
        let pid = self.node(name)["pid"].as_i64().expect("a live node has a process");
        kill(Pid::from_raw(pid as i32), Signal::SIGKILL).expect("the process of the node is ours");
        self.until(&format!("`{name}` runs again"), |drive| {
            let node = drive.node(name);
            // Its health comes from the new process.
            node["pid"].as_i64().is_some_and(|new| new != pid) && node["restarts"].as_u64() >= Some(1)
        });
    }

    fn said(&self, word: &str) {
        self.sandbox.carril(&[word]).expect(0);
    }
}

#[test]
fn drives_the_oval_within_its_lane() {
    // At 0.5 m/s 30 s are more than a lap of 10.3 m.
    let (duration, distance_m, laps) = thorough::count(("8s", 2.0, 0), ("30s", 10.3, 1));
    let sandbox = Sandbox::new();
    let graph = patient_graph(&sandbox);
    let stdout = sandbox.carril(&["run", &graph, "--for", duration, "--json"]).expect(0);
    let last = stdout.lines().last().expect("a summary");
    let summary: Value = serde_json::from_str(last).expect("the summary is JSON");
    let summary = &summary["summary"]["progress"];
    assert!(summary["distance_m"].as_f64() >= Some(distance_m), "{distance_m} m in {duration}: {summary}");
    assert!(summary["laps"].as_u64() >= Some(laps), "laps in {duration}: {summary}");
    assert_eq!(summary["departures"], 0, "no wheel left the lane: {summary}");
    assert_eq!(summary["collisions"], 0, "nothing was touched: {summary}");
    assert!(!sandbox.path().join("runs/car1").exists(), "an orderly end leaves no folder");
}

#[test]
fn a_killed_node_comes_back_while_the_car_drives_and_takes_nothing_with_it() {
    let drive = Drive::start(&[]);
    drive.drives_on(0.5);
    let before: Vec<Value> = ["world", "actuator", "bridge", "mcu"].map(|name| drive.node(name)["pid"].clone()).into();
    for name in thorough::count(&["decision"][..], &["lane", "sectors", "decision"]) {
        drive.kill_and_wait(name);
        drive.drives_on(0.5);
    }
    let after: Vec<Value> = ["world", "actuator", "bridge", "mcu"].map(|name| drive.node(name)["pid"].clone()).into();
    assert_eq!(before, after, "the others are still the same processes");
    assert_eq!(drive.number("world/progress", "departures"), 0.0, "no wheel left the lane");
    assert_eq!(drive.number("world/progress", "collisions"), 0.0, "nothing was touched");
    assert_eq!(drive.run.interrupt().code, Some(0), "Ctrl-C ends in order");
}

#[test]
fn a_frozen_bridge_stops_the_car_until_someone_resets_it() {
    let drive = Drive::start(&[]);
    drive.drives_on(0.5);
    let bridge = Pid::from_raw(drive.node("bridge")["pid"].as_i64().expect("a live node has a process") as i32);
    kill(bridge, Signal::SIGSTOP).expect("the process of the node is ours");
    drive.until("the car stands", |drive| drive.number("world/vehicle", "speed_m_s") == 0.0);
    kill(bridge, Signal::SIGCONT).expect("the process of the node is ours");
    let fault_of_the_lease = |drive: &Drive| drive.number("bridge/telemetry", "faults") as u64 & 1 == 1;
    drive.until("the lease's fault is reported", fault_of_the_lease);
    drive.said("start");
    assert_eq!(drive.number("world/vehicle", "speed_m_s"), 0.0, "`start` alone moves nothing");
    drive.said("reset");
    drive.said("start");
    drive.drives_on(0.5);
    // With the patient lease it rolls on for 0.75 m with its wheels held: before a bend that may lead over a marking.
    assert_eq!(drive.number("world/progress", "collisions"), 0.0, "nothing was touched");
}

#[test]
fn the_serial_line_pulled_and_plugged_in_again() {
    let drive = Drive::start(&[]);
    drive.drives_on(0.5);
    drive.kill_and_wait("mcu");
    drive.until("the car stands", |drive| drive.number("world/vehicle", "speed_m_s") == 0.0);
    drive.until("the link is up again", |drive| drive.sample("bridge/telemetry").is_some());
    drive.said("reset");
    drive.said("start");
    drive.drives_on(0.5);
}

#[test]
fn an_estop_holds_until_reset_and_start() {
    let drive = Drive::start(&[]);
    drive.drives_on(0.5);
    drive.said("estop");
    drive.until("the car stands", |drive| drive.number("world/vehicle", "speed_m_s") == 0.0);
    drive.said("start");
    let state = drive.sample("decision/state").expect("the decision node says what it does");
    assert_eq!(state["state"], "e-stop", "`start` alone moves nothing");
    drive.said("reset");
    drive.said("start");
    drive.drives_on(0.5);
}
