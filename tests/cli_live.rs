//! Every command on a running graph: a simulated car over Zenoh and a pseudo-terminal, as a user sees it from a second terminal.

mod support;

use std::io::Read;
use std::process::Stdio;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use support::{HANGS_AFTER, Sandbox, project};

/// The whole chain but the camera's detector: cheap enough for tests that run side by side.
const CAR: &str = "dataflows/no-camera.yaml";

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

fn last_line(text: &str) -> Value {
    json(text.lines().last().expect("there is output"))
}

/// A graph of one process, for tests about runs, not about driving.
fn small_graph(sandbox: &Sandbox, robot: &str) -> String {
    let track = project().join("tracks/oval.yaml").display().to_string();
    let text = format!(
        "robot: {robot}\nnodes:\n  world:\n    operator: sim-world\n    process: all\n    config: {{ track: {track} }}\n  \
         sectors:\n    operator: lidar-sectors\n    process: all\n    inputs: {{ scan: world/scan }}\n"
    );
    sandbox.write(&format!("{robot}.yaml"), text).display().to_string()
}

/// Looks again and again until `seen` says yes.
#[track_caller]
fn until(what: &str, mut seen: impl FnMut() -> bool) {
    let begun = std::time::Instant::now();
    while !seen() {
        assert!(begun.elapsed() < HANGS_AFTER, "never seen: {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// The value of the next sample of a port.
fn next_value(sandbox: &Sandbox, port: &str) -> Value {
    let output = sandbox.carril(&["echo", port, "-n", "1", "--json"]).expect(0);
    json(output.lines().next().expect("a sample"))["value"].clone()
}

#[test]
fn a_running_graph_can_be_watched() {
    let sandbox = Sandbox::new();
    let run = sandbox.launch(CAR, &[]);

    let list = sandbox.carril(&["list"]).expect(0);
    for port in ["world/camera", "actuator/command", "bridge/telemetry", "decision/goal"] {
        assert!(list.lines().any(|line| line.starts_with(port)), "`{port}` in\n{list}");
    }
    assert!(
        list.contains("input, for `carril pub`") && list.contains("decision/lane"),
        "readers and open ports:\n{list}"
    );
    let whole = json(&sandbox.carril(&["list", "--json"]).expect(0));
    assert_eq!(whole["nodes"].as_array().map(Vec::len), Some(6), "every node: {whole}");

    let info = sandbox.carril(&["info", "decision"]).expect(0);
    for part in ["decision: decision in process decision (", "reads world/lane", "open for `carril pub`"] {
        assert!(info.contains(part), "`{part}` in\n{info}");
    }
    until("the health of a node", || sandbox.carril(&["info", "decision"]).expect(0).contains("step time"));

    let top = sandbox.carril(&["top", "-n", "1"]).expect(0);
    assert!(top.contains("CPU %") && top.lines().any(|line| line.starts_with("bridge")), "{top}");
    let top = json(&sandbox.carril(&["top", "-n", "1", "--json"]).expect(0));
    let world = top["nodes"].as_array().and_then(|nodes| nodes.iter().find(|node| node["node"] == "world")).cloned();
    assert!(world.is_some_and(|node| node["memory_b"].as_u64() > Some(0)), "what its process uses: {top}");

    samples_are_shown(&sandbox);
    rates_are_measured(&sandbox);
    mistakes_are_explained(&sandbox);
    readers_may_go_away(&sandbox);

    let pids: Vec<i32> = pids(&whole);
    let outcome = run.interrupt();
    let stdout = outcome.expect(0);
    assert!(stdout.contains(r#""kind":"stopping""#), "first the car is stopped: {stdout}");
    let summary = &last_line(&stdout)["summary"];
    assert_eq!(summary["nodes"].as_array().map(Vec::len), Some(6), "{summary}");
    assert_eq!(summary["progress"]["departures"], 0, "the car kept its lane: {summary}");
    assert!(summary["age_ms"]["p50"].is_number(), "exposure to wheel: {summary}");
    assert_eq!(summary["age_path"], "oldest exposure to bridge", "nobody reads the camera of this graph");
    for pid in pids {
        assert!(kill(Pid::from_raw(pid), None).is_err(), "process {pid} outlived the run");
    }
}

fn pids(run: &Value) -> Vec<i32> {
    let processes = run["processes"].as_array().expect("a list of processes");
    processes.iter().map(|process| process["pid"].as_i64().expect("it is up") as i32).collect()
}

fn samples_are_shown(sandbox: &Sandbox) {
    let text = sandbox.carril(&["echo", "decision/state", "-n", "2"]).expect(0);
    assert!(text.starts_with('#') && text.contains("--- decision/state: 2 samples, 0 lost ---"), "{text}");
    let sectors = sandbox.carril(&["echo", "sectors/sectors", "-n", "1"]).expect(0);
    assert!(sectors.contains("\n  front "), "one line a sector: {sectors}");
    let plot = sandbox.carril(&["echo", "world/scan", "--plot", "-n", "1"]).expect(0);
    assert!(plot.contains(" returns, ") && plot.contains("x up\n#") && !plot.contains('\u{1b}'), "{plot}");
    let lines = sandbox.carril(&["echo", "world/lane", "-n", "3", "--json"]).expect(0);
    let samples: Vec<Value> = lines.lines().map(json).collect();
    assert_eq!(samples.len(), 4, "three samples and the statistics: {lines}");
    let seqs: Vec<u64> = samples[..3].iter().filter_map(|sample| sample["seq"].as_u64()).collect();
    assert_eq!(seqs, [seqs[0], seqs[0] + 1, seqs[0] + 2], "in order: {lines}");
    assert!(samples[0]["value"]["lane"]["angle_rad"].is_number() && samples[0]["age_ms"].is_number(), "{lines}");
    assert_eq!(samples[3]["statistics"][0]["count"], 3, "the statistics are those of what was seen: {lines}");

    let file = sandbox.path().join("frame.png");
    let saved = sandbox.carril(&["echo", "world/camera", "--save", &file.display().to_string()]).expect(0);
    assert!(saved.contains("640x480 bgr8, 921600 B"), "an image is size and encoding: {saved}");
    let image = image::open(&file).expect("it can be read");
    assert_eq!((image.width(), image.height()), (640, 480), "the size of the camera");

    let mut echo = sandbox.start(&["echo", "bridge/telemetry"]);
    echo.wait_for_output("telemetry", |output| output.lines().count() > 5);
    let ended = echo.interrupt().expect(0);
    assert!(
        ended.contains("--- bridge/telemetry: ") && ended.contains("rate "),
        "Ctrl-C gives the statistics: {ended}"
    );
}

fn rates_are_measured(sandbox: &Sandbox) {
    let hz = sandbox.carril(&["hz", "decision/command", "actuator/command", "-n", "60", "--json"]).expect(0);
    let statistics = last_line(&hz)["statistics"].clone();
    for (index, port) in ["decision/command", "actuator/command"].into_iter().enumerate() {
        assert_eq!(
            (&statistics[index]["port"], &statistics[index]["count"]),
            (&port.into(), &60.into()),
            "{statistics}"
        );
        assert!(statistics[index]["rate_hz"].as_f64() > Some(0.0), "{statistics}");
    }
    let bw = sandbox.carril(&["bw", "world/scan", "-n", "3"]).expect(0);
    assert!(bw.contains("--- world/scan: 3 samples") && bw.contains("kB each"), "{bw}");
    let delay = sandbox.carril(&["delay", "actuator/command", "-n", "20"]).expect(0);
    assert!(delay.contains("publication to here") && delay.contains("exposure of world/lane to here"), "{delay}");
}

fn mistakes_are_explained(sandbox: &Sandbox) {
    let cases: [(&[&str], &[&str]); 8] = [
        (&["echo", "world/camrea"], &["did you mean `world/camera`?", "ports are world/camera, world/scan"]),
        (&["echo", "world"], &["`world` is a node", "world/camera"]),
        (&["echo", "decision/lane"], &["it reads `world/lane`"]),
        (&["hz", "lane/lane"], &["has a port `lane/lane`"]),
        (&["info", "desicion"], &["did you mean `decision`?"]),
        (&["list", "--robot", "car7"], &["`car7`", "car1"]),
        (&["echo", "world/lane", "--plot"], &["`--plot` draws scans", "carril/LaneEstimate"]),
        (&["echo", "world/lane", "--save", "lane.png"], &["`--save` writes images", "carril/LaneEstimate"]),
    ];
    for (args, parts) in cases {
        let error = sandbox.carril(args).expect_error(1);
        for part in parts {
            assert!(error.contains(part), "`{part}` in {args:?}: {error}");
        }
    }
    let silent = sandbox.carril(&["echo", "decision/goal", "--for", "2500ms"]);
    assert!(silent.stderr.contains("waiting: nothing has come on `decision/goal` yet"), "{}", silent.stderr);
    assert!(silent.expect_error(1).contains("nothing came on `decision/goal`"), "a script can tell");
}

fn readers_may_go_away(sandbox: &Sandbox) {
    let mut child = sandbox
        .command(&["echo", "bridge/telemetry"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("it starts");
    let mut byte = [0];
    child.stdout.take().expect("stdout is piped").read_exact(&mut byte).expect("a sample comes");
    let output = child.wait_with_output().expect("it ends");
    assert_eq!((output.status.code(), &output.stderr[..]), (Some(0), &b""[..]), "as `carril echo ... | head -1`");
}

#[test]
fn people_can_speak_to_the_car() {
    let sandbox = Sandbox::new();
    let _run = sandbox.launch(CAR, &[]);
    until("the car drives", || next_value(&sandbox, "decision/state")["state"] == "lane-follow");

    sandbox.carril(&["pub", "decision/goal", r#"{"cruise": {"speed_m_s": 0.25}}"#]).expect(0);
    until("the new speed", || next_value(&sandbox, "decision/command")["speed_m_s"] == 0.25);
    let refused: [(&[&str], &str); 4] = [
        (&["pub", "decision/goal", r#"{"cruise": {"speed": 1}}"#], "speed_m_s"),
        (&["pub", "decision/goal", "{"], "is no JSON"),
        (&["pub", "decision/lane", "{}"], "`world/lane` writes it"),
        (&["pub", "decision/command", "{}"], "node `decision` (decision) writes it"),
    ];
    for (args, part) in refused {
        let error = sandbox.carril(args).expect_error(1);
        assert!(error.contains(part), "`{part}` in {args:?}: {error}");
    }

    let estop = sandbox.carril(&["estop"]).expect(0);
    assert!(estop.starts_with("estop: confirmed by 6 nodes in 6 processes: actuator, bridge, decision"), "{estop}");
    assert_eq!(next_value(&sandbox, "decision/state")["state"], "e-stop", "at once");
    sandbox.carril(&["start"]).expect(0);
    assert_eq!(next_value(&sandbox, "decision/state")["state"], "e-stop", "only `reset` ends it");
    sandbox.carril(&["reset"]).expect(0);
    assert_eq!(next_value(&sandbox, "decision/state")["state"], "idle", "nothing moves before `start`");
    sandbox.carril(&["start"]).expect(0);
    until("the car drives again", || next_value(&sandbox, "decision/state")["state"] == "lane-follow");
    let stop = json(&sandbox.carril(&["stop", "--json"]).expect(0));
    assert_eq!((&stop["word"], stop["missing"].as_array().map(Vec::len)), (&"stop".into(), Some(0)), "{stop}");
    until("the car stands", || next_value(&sandbox, "decision/state")["state"] == "idle");
}

#[test]
fn an_estop_names_who_did_not_confirm() {
    let sandbox = Sandbox::new();
    let _run = sandbox.launch(CAR, &[]);
    let run = json(&sandbox.carril(&["list", "--json"]).expect(0));
    let processes = run["processes"].as_array().expect("a list of processes");
    let bridge = processes.iter().find(|process| process["name"] == "bridge").expect("there is a bridge");
    let bridge = Pid::from_raw(bridge["pid"].as_i64().expect("it is up") as i32);
    kill(bridge, Signal::SIGSTOP).expect("a process of this test");
    let outcome = sandbox.carril(&["estop"]);
    kill(bridge, Signal::SIGCONT).expect("it is still there");
    let error = outcome.expect_error(1);
    assert!(error.contains("`estop` was not confirmed by bridge") && error.contains("cut the power"), "{error}");
}

#[test]
fn two_robots_are_told_apart() {
    let sandbox = Sandbox::new();
    let _first = sandbox.launch(&small_graph(&sandbox, "car1"), &[]);
    let second = sandbox.launch(&small_graph(&sandbox, "car2"), &[]);
    let error = sandbox.carril(&["list"]).expect_error(1);
    assert!(error.contains("car1, car2") && error.contains("--robot"), "{error}");
    let list = sandbox.carril(&["list", "--robot", "car2"]).expect(0);
    assert!(list.starts_with("car2 "), "{list}");
    let twice = sandbox.carril(&["run", &small_graph(&sandbox, "car2")]).expect_error(1);
    assert!(twice.contains("`car2` runs already"), "one run a robot: {twice}");
    let mut echo = sandbox.start(&["echo", "sectors/sectors", "--robot", "car2"]);
    echo.wait_for_output("sectors", |output| output.contains("front"));
    second.interrupt().expect(0);
    let ended = echo.wait();
    assert!(ended.stdout.contains("--- sectors/sectors: "), "the statistics come all the same: {}", ended.stdout);
    assert!(ended.expect_error(1).contains("`car2` has ended"), "and why it ended");
}

#[test]
fn a_run_has_a_line_a_second_and_a_summary() {
    let sandbox = Sandbox::new();
    let outcome = sandbox.carril(&["run", CAR, "--for", "4s", "--set", "decision.auto_start=false"]);
    assert!(outcome.stderr.contains("6 nodes in 6 processes up after"), "{}", outcome.stderr);
    assert!(outcome.stderr.contains("stopping: first the car"), "{}", outcome.stderr);
    let text = outcome.expect(0);
    assert!(text.lines().any(|line| line.contains("idle") && line.contains("Hz: world")), "status lines: {text}");
    assert!(text.contains("no-camera.yaml ran for") && text.contains("laps         0"), "the summary: {text}");
    let quiet = sandbox.carril(&["run", &small_graph(&sandbox, "car3"), "--for", "2s", "--quiet", "--json"]).expect(0);
    assert_eq!(quiet.lines().count(), 1, "only the summary: {quiet}");
    assert_eq!(json(&quiet)["summary"]["robot"], "car3", "{quiet}");
}
