//! `carril calibrate lane` and `lidar` on the simulated car, and the calibration file that a graph takes.

mod support;

use std::io::Write;
use std::process::Stdio;

use serde_json::Value;
use support::car::patient_graph;
use support::{Running, Sandbox, project};

const FILE: &str = "car1.calibration.yaml";

/// The default graph on a track, with a calibration file and more changes.
fn graph(track: &str, more: &[(&str, &str)]) -> String {
    let named = format!("robot: car1\ncalibration: {FILE}");
    let world = format!("track: {track}");
    let changes = [&[("robot: car1", named.as_str()), ("track: oval", world.as_str())], more].concat();
    patient_graph(&changes)
}

/// An oval with more in it.
fn track(sandbox: &Sandbox, name: &str, more: &str) -> String {
    let oval = std::fs::read_to_string(project().join("tracks/oval.yaml")).expect("it ships");
    sandbox.write(name, format!("{oval}{more}\n"));
    name.to_owned()
}

/// Writes a graph and runs it.
fn launch(sandbox: &Sandbox, text: &str) -> (String, Running) {
    let file = sandbox.write("graph.yaml", text).display().to_string();
    let run = sandbox.launch(&file, &[]);
    (file, run)
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("JSON: {error} in {text}"))
}

/// Runs a command whose questions are answered.
fn answered(sandbox: &Sandbox, args: &[&str], answers: &str) -> (Option<i32>, String, String) {
    let mut command = sandbox.command(args);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("it starts");
    child.stdin.take().expect("piped").write_all(answers.as_bytes()).expect("it listens");
    let output = child.wait_with_output().expect("it ends");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// Laps in the simulation, with the exit code that says they were done.
#[track_caller]
fn assert_laps_without_departure(sandbox: &Sandbox, file: &str, changes: &[&str]) {
    let args = [&["sim", file, "--laps", "2", "--seconds", "120"], changes].concat();
    let told = sandbox.carril(&args).expect(0);
    assert!(told.contains("departures   0"), "{changes:?}: {told}");
}

#[test]
fn lane_finds_a_threshold_that_drives_and_is_in_force_at_the_next_start() {
    let sandbox = Sandbox::new();
    let (file, run) = launch(&sandbox, &graph("oval", &[("threshold: 190", "threshold: 240")]));
    let note = sandbox.carril(&["check", &file]).expect(0);
    assert!(note.contains("note: there is no calibration file") && note.contains("graph.yaml:"), "{note}");
    let told = sandbox.carril(&["calibrate", "lane", "--save"]).expect(0);
    for part in
        ["frames of `world/camera`", "GREY VALUES", "marking", "proposal: lane.threshold", "carril set lane threshold="]
    {
        assert!(told.contains(part), "`{part}` in\n{told}");
    }
    let found = json(&sandbox.carril(&["calibrate", "lane", "--seconds", "0.5", "--json"]).expect(0));
    let threshold = found["threshold"].as_u64().expect("a threshold");
    assert!((80..210).contains(&threshold), "between a floor of 60 and markings of 230: {found}");
    assert_eq!(found["saved"], Value::Null, "--json alone saves nothing");
    let frame = sandbox.path().join("frame.png").display().to_string();
    sandbox.carril(&["echo", "world/camera", "-n", "1", "--save", &frame]).expect(0);
    run.interrupt();

    let saved = std::fs::read_to_string(sandbox.path().join(FILE)).expect("it was saved");
    assert!(saved.contains("nodes:\n  lane: { threshold: ") && saved.contains("what: lane"), "{saved}");
    assert!(saved.contains("command: \"carril calibrate lane --save\"") && saved.contains("frames: "), "{saved}");
    let clean = sandbox.carril(&["check", &file]).expect(0);
    assert!(!clean.contains("note"), "nothing to say any more: {clean}");
    assert_laps_without_departure(&sandbox, &file, &[]);
    let threshold = format!("lane.threshold={threshold}");
    assert_laps_without_departure(&sandbox, "dataflow.yaml", &["--set", &threshold]);

    let (_, run) = launch(&sandbox, &graph("oval", &[("threshold: 190", "threshold: 240")]));
    let in_force: f64 = sandbox.carril(&["get", "lane", "threshold"]).expect(0).trim().parse().expect("a number");
    assert!(in_force < 210.0, "that of the calibration file, not 240: {in_force}");
    run.interrupt();

    let again = sandbox.carril(&["calibrate", "lane", "--images", &frame, "--graph", &file, "--yes"]).expect(0);
    assert!(again.contains("1 frame of"), "{again}");
    let saved = std::fs::read_to_string(sandbox.path().join(FILE)).expect("it was saved");
    assert_eq!(saved.matches("- when:").count(), 2, "a record of each: {saved}");
}

#[test]
fn in_dim_light_lane_finds_a_threshold_as_long_as_there_is_one() {
    let sandbox = Sandbox::new();
    let dim = ("seed: 1", "seed: 1, camera: { lighting: dim-gradient }");
    let (file, run) = launch(&sandbox, &graph("oval", &[dim]));
    let told = sandbox.carril(&["calibrate", "lane", "--save", "--seconds", "1"]).expect(0);
    assert!(told.contains("with threshold 190, 0 % of the marking"), "why it did not drive: {told}");
    run.interrupt();
    assert_laps_without_departure(&sandbox, &file, &[]);
}

#[test]
fn a_floor_that_is_as_bright_as_the_marking_elsewhere_is_told_and_nothing_is_proposed() {
    let sandbox = Sandbox::new();
    let grey = track(&sandbox, "grey.yaml", "floor: { colour: [150, 150, 150] }");
    let dim = ("seed: 1", "seed: 1, camera: { lighting: dim-gradient }");
    let (_, run) = launch(&sandbox, &graph(&grey, &[dim]));
    let outcome = sandbox.carril(&["calibrate", "lane", "--save", "--seconds", "1"]);
    assert!(!outcome.stdout.contains("proposal") && outcome.stdout.contains("GREY VALUES"), "{}", outcome.stdout);
    let error = outcome.expect_error(1);
    for part in ["marking and floor overlap", "no threshold divides them", "hint:", "hsv", "exposure"] {
        assert!(error.contains(part), "`{part}` in {error}");
    }
    let found = json(&sandbox.carril(&["calibrate", "lane", "--seconds", "0.5", "--json", "--save"]).expect(1));
    assert!(found["findings"]["verdict"]["overlap"]["gap"].is_i64() && found["threshold"].is_null(), "{found}");
    assert!(!sandbox.path().join(FILE).exists(), "nothing was saved");
    run.interrupt();
}

/// The graph with `lane-lines` on a long straight, or on another track, by a camera that stands where `seen` says.
fn lines_graph(track: &str, seen: &str) -> String {
    graph(
        track,
        &[
            ("operator: lane-detector", "operator: lane-lines"),
            ("{ threshold: 190, row_far: 0.75, row_near: 0.85 }", "{}"),
            ("seed: 1", &format!("seed: 1, {seen}")),
            ("auto_start: true", "auto_start: false"),
        ],
    )
}

#[test]
fn lane_finds_how_the_camera_looks_at_the_floor_when_lines_are_followed() {
    let sandbox = Sandbox::new();
    let straight = "lane:\n  left: solid\n  right: solid\n  centre:\n    pieces:\n      - straight_m: 6.0\n      - left: { radius_m: 1.0, angle_deg: 180 }\n      - straight_m: 6.0\n      - left: { radius_m: 1.0, angle_deg: 180 }\n";
    sandbox.write("straight.yaml", straight);
    let text =
        lines_graph("straight.yaml", "camera: { height_m: 0.25, pitch_deg: 26 }, start: { along_m: 1.0, yaw_deg: 3 }");
    let (_, run) = launch(&sandbox, &text);
    let told = sandbox.carril(&["calibrate", "lane", "--seconds", "0.5", "--save"]).expect(0);
    for part in [
        "both lines of a straight lane",
        "height_m",
        "pitch_deg",
        "proposal: lane.camera.height_m 0.2",
        "carril set lane",
    ] {
        assert!(told.contains(part), "`{part}` in\n{told}");
    }
    let found = json(&sandbox.carril(&["calibrate", "lane", "--seconds", "0.5", "--json"]).expect(0));
    let [height, pitch] = ["height_m", "pitch_deg"].map(|name| found["findings"][name]["value"].as_f64());
    assert!(height.is_some_and(|height| (height - 0.25).abs() < 0.006), "height: {found}");
    assert!(pitch.is_some_and(|pitch| (pitch - 26.0).abs() < 0.5), "pitch: {found}");
    run.interrupt();
    let saved = std::fs::read_to_string(sandbox.path().join(FILE)).expect("it was saved");
    assert!(
        saved.contains("camera: {") && saved.contains("height_m: 0.2") && saved.contains("pitch_deg: 2"),
        "{saved}"
    );
}

#[test]
fn in_a_curve_nothing_is_proposed_for_the_camera() {
    let sandbox = Sandbox::new();
    let (file, run) = launch(&sandbox, &lines_graph("oval", "start: { along_m: 3.0 }"));
    let outcome = sandbox.carril(&["calibrate", "lane", "--seconds", "0.5", "--save"]);
    let error = outcome.expect_error(1);
    assert!(error.contains("straight") && error.contains("hint:"), "{error}");
    assert!(!sandbox.path().join(FILE).exists(), "nothing was saved");
    run.interrupt();
    let follow = sandbox.write(
        "follow.yaml",
        std::fs::read_to_string(file).expect("it is there").replace("config: {}", "config: { lane: follow }"),
    );
    let args = ["calibrate", "lane", "--images", "none.png", "--graph", &follow.display().to_string()];
    let error = sandbox.carril(&args).expect_error(1);
    assert!(error.contains("node `lane`") && error.contains("one line"), "{error}");
}

#[test]
fn lidar_finds_that_it_is_mounted_backwards() {
    let sandbox = Sandbox::new();
    let backwards = ("seed: 1", "seed: 1, lidar: { mounting_deg: 180 }");
    let stands = ("auto_start: true", "auto_start: false");
    let record = |name: &str| {
        let scans = sandbox.carril(&["echo", "world/scan", "-n", "5", "--json"]).expect(0);
        sandbox.write(name, scans).display().to_string()
    };
    let (_, run) = launch(&sandbox, &graph("oval", &[backwards, stands]));
    let empty = record("empty.json");
    let nothing = sandbox.carril(&["calibrate", "lidar", "--wait-s", "0.1", "--before-s", "0.5", "--after-s", "0.5"]);
    let nothing = nothing.expect_error(1);
    assert!(nothing.contains("nothing came nearer") && nothing.contains("hint:"), "{nothing}");
    let (code, asked, error) =
        answered(&sandbox, &["calibrate", "lidar", "--before-s", "0.5", "--after-s", "0.5"], "\n\n");
    assert!(asked.contains("Keep the space ahead of the car free") && asked.contains("Put a box"), "{asked}");
    assert!(code == Some(1) && error.contains("nothing came nearer"), "{code:?}: {error}");
    run.interrupt();

    let a_box = "boxes:\n  - { x_m: 0.9, y_m: 0.02, yaw_deg: 0, length_m: 0.2, width_m: 0.3, height_m: 0.4, colour: [1, 2, 3] }";
    let with_box = track(&sandbox, "box.yaml", a_box);
    let (file, run) = launch(&sandbox, &graph(&with_box, &[backwards, stands]));
    // The posts of the camera stand at 9 cm behind.
    let box_ahead = || {
        let line = sandbox.carril(&["echo", "sectors/sectors", "-n", "1", "--json"]).expect(0);
        let sectors = json(line.lines().next().unwrap_or_default());
        let sectors = sectors["value"]["sectors"].as_array().cloned().unwrap_or_default();
        let front = sectors.iter().find(|sector| sector["name"] == "front").expect("a sector by default");
        front["nearest_m"].as_f64().is_some_and(|range| (0.4..1.0).contains(&range))
    };
    assert!(!box_ahead(), "before: it is taken to be behind");
    let full = record("box.json");
    let told = sandbox.carril(&["calibrate", "lidar", "--before", &empty, "--after", &full, "--save"]).expect(0);
    assert!(told.contains("proposal: sectors.mounting_deg 180, so that this is ahead of the car"), "{told}");
    sandbox.carril(&["set", "sectors", "mounting_deg=180"]).expect(0);
    assert!(box_ahead(), "with what was found it is ahead");
    run.interrupt();
    let saved = std::fs::read_to_string(sandbox.path().join(FILE)).expect("it was saved");
    assert!(saved.contains("sectors: { mounting_deg: 180 }") && saved.contains("what: lidar"), "{saved}");
    let checked = sandbox.carril(&["get", "sectors", "mounting_deg", "--graph", &file]).expect(0);
    assert_eq!(checked.trim(), "180", "in force at the next start");
    let left =
        ["calibrate", "lidar", "--before", &empty, "--after", &full, "--graph", &file, "--where", "left", "--json"];
    assert_eq!(json(&sandbox.carril(&left).expect(0))["mounting_deg"], -90, "had it stood on the left");
}

#[test]
fn what_is_asked_for_wrongly_is_refused_with_words() {
    let sandbox = Sandbox::new();
    let file = sandbox.write("graph.yaml", patient_graph(&[])).display().to_string();
    let hsv = patient_graph(&[("threshold: 190", "marking: { hsv: { h: [90, 130] } }")]);
    let hsv = sandbox.write("hsv.yaml", hsv).display().to_string();
    let text = sandbox.write("no.json", "{\"value\": 3}").display().to_string();
    let picture = sandbox.write("no.png", "no picture").display().to_string();
    let lane = |args: &[&'static str]| [&["calibrate", "lane"], args].concat();
    let images = |path: &str| {
        vec!["calibrate", "lane", "--graph", &file, "--images"]
            .into_iter()
            .map(str::to_owned)
            .chain([path.to_owned()])
            .collect::<Vec<_>>()
    };
    let owned = |args: Vec<&str>| args.into_iter().map(str::to_owned).collect::<Vec<_>>();
    let cases: Vec<(Vec<String>, i32, &str)> = vec![
        (owned(lane(&[])), 1, "no graph is running"),
        (owned(lane(&["--seconds", "0"])), 2, "allowed is 0.1 to 60 s"),
        (owned(lane(&["--graph", "nobody.yaml"])), 2, "there is no file `nobody.yaml`"),
        (owned(vec!["calibrate", "lane", "--graph", &file]), 1, "in which nothing moves"),
        (owned(vec!["calibrate", "lane", "--graph", &hsv, "--images", "x"]), 1, "told by its colour"),
        (images("nobody"), 1, "`nobody` does not exist"),
        (images("/dev/video0"), 1, "is a device, not a file"),
        (images(&picture), 1, "cannot be read as an image"),
        ([images("x"), owned(vec!["--node", "wrold"])].concat(), 1, "there is no node `wrold`"),
        ([images("x"), owned(vec!["--node", "world"])].concat(), 1, "is sim-world, allowed is"),
        (owned(vec!["calibrate", "lidar", "--before", &text, "--graph", &file]), 2, "--after"),
        (
            owned(vec!["calibrate", "lidar", "--before", &text, "--after", &text, "--graph", &file]),
            1,
            "line 1: no scan",
        ),
        (
            owned(vec!["calibrate", "lidar", "--before", "nobody", "--after", &text, "--graph", &file]),
            1,
            "cannot read `nobody`",
        ),
        (owned(vec!["calibrate", "lidar", "--where", "above"]), 2, "[possible values: ahead, left, right, behind]"),
    ];
    for (args, code, says) in cases {
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        let error = sandbox.carril(&args).expect_error(code);
        assert!(error.contains(says), "{args:?}: `{says}` in {error}");
    }
}

/// A picture of two bright lines on a dark floor.
fn road(sandbox: &Sandbox) -> String {
    let mut pixels = b"P5 160 120 255\n".to_vec();
    let bright = |x: u32| (30..35).contains(&x) || (120..125).contains(&x);
    pixels.extend((0..160 * 120_u32).map(|i| if bright(i % 160) { 220 } else { 50 + (i * 7919 % 5) as u8 }));
    sandbox.write("road.pgm", pixels).display().to_string()
}

#[test]
fn results_go_where_they_belong_or_it_says_how() {
    let sandbox = Sandbox::new();
    let file = sandbox.write("graph.yaml", patient_graph(&[])).display().to_string();
    let road = road(&sandbox);
    let calibrate =
        |more: &[&str]| sandbox.carril(&[&["calibrate", "lane", "--images", &road, "--graph", &file], more].concat());
    let told = calibrate(&[]).expect(0);
    assert!(told.contains("add `calibration: car1.calibration.yaml` at the top level"), "{told}");
    let error = calibrate(&["--save"]).expect_error(1);
    assert!(error.contains("names no calibration file") && error.contains("hint: add"), "{error}");
    let other = sandbox.path().join("other.yaml").display().to_string();
    let told = calibrate(&["--save", "--file", &other]).expect(0);
    assert!(told.contains("add `calibration: other.yaml` at the top level"), "{told}");
    let question = calibrate(&["--file", &other]);
    assert!(question.stdout.contains("Save lane.threshold"), "it asks: {}", question.stdout);
    let error = question.expect_error(1);
    assert!(error.contains("nothing was stored"), "nobody answers: {error}");
    assert_eq!(std::fs::read_to_string(&other).expect("saved once").matches("- when:").count(), 1, "once");

    let args = ["calibrate", "lane", "--images", &road, "--graph", &file, "--file", &other];
    let records = || std::fs::read_to_string(&other).expect("saved").matches("- when:").count();
    let (code, asked, _) = answered(&sandbox, &args, "n\n");
    assert!((code, records()) == (Some(0), 1) && asked.contains("nothing was saved"), "no: {asked}");
    let (code, asked, _) = answered(&sandbox, &args, "perhaps\ny\n");
    assert!((code, records()) == (Some(0), 2) && asked.contains("got `perhaps`"), "asked again, then saved: {asked}");

    let before = "nodes: { lane: { threshold: 190 }, nobody: { a: 1 } }\n";
    std::fs::write(&other, before).expect("writable");
    let error = calibrate(&["--save", "--file", &other]).expect_error(1);
    assert!(error.contains("the graph has no node `nobody`") && error.contains("other.yaml:1:"), "{error}");
    assert_eq!(std::fs::read_to_string(&other).expect("there"), before, "what is wrong stays as it is, and is told");
}

#[test]
fn a_value_below_a_calibrated_one_is_not_saved_in_the_graph() {
    let sandbox = Sandbox::new();
    sandbox.write(FILE, "nodes: { lane: { threshold: 175 } }\n");
    let (file, run) = launch(&sandbox, &graph("oval", &[]));
    let before = std::fs::read_to_string(&file).expect("it is there");
    assert_eq!(sandbox.carril(&["get", "lane", "threshold"]).expect(0).trim(), "175", "processes have it");
    let error = sandbox.carril(&["set", "lane", "threshold=180", "--save"]).expect_error(1);
    assert!(error.contains("is 175 in the calibration file") && error.contains("hint:"), "{error}");
    assert_eq!(std::fs::read_to_string(&file).expect("it is there"), before, "untouched");
    sandbox.write(FILE, "nodes: { lane: { threshold: 170 } }\n");
    let plan = sandbox.carril(&["apply", &file, "--dry-run"]).expect(0);
    assert!(plan.contains("threshold"), "a new calibration is a difference: {plan}");
    run.interrupt();
}
