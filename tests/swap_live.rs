//! Nodes of the default graph are replaced while the car drives: every receipt is clean, every frame has exactly one lane
//! estimate, and no wheel leaves the lane. `CARRIL_SWAPS=200` swaps `lane` 200 times instead of 20.

mod support;

use std::collections::BTreeMap;

use serde_json::Value;
use support::{Running, Sandbox, program, project_file};

/// The default graph with the patience that a shared test machine needs.
fn launch(sandbox: &Sandbox) -> Running {
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
    let patient = changes.iter().fold(text, |text, (from, to)| text.replace(from, to));
    let file = sandbox.write("patient.yaml", patient).display().to_string();
    let mut run = sandbox.launch(&file, &[]);
    run.wait_for_output("the car drives", |output| output.contains("\"lane-follow\""));
    run
}

fn receipt(sandbox: &Sandbox, args: &[&str]) -> Value {
    let outcome = sandbox.carril(&[args, &["--json"]].concat());
    serde_json::from_str(&outcome.stdout).unwrap_or_else(|error| panic!("{error}: {}", outcome.report()))
}

#[track_caller]
fn swap(sandbox: &Sandbox, args: &[&str]) {
    let all = [&["swap"], args, &["--stall-ms", "2000"]].concat();
    let receipt = receipt(sandbox, &all);
    assert_eq!(receipt["outcome"], "done", "{args:?}: {receipt}");
    assert_eq!((&receipt["lost"], &receipt["duplicated"]), (&0.into(), &0.into()), "{args:?}: {receipt}");
}

fn progress(sandbox: &Sandbox) -> Value {
    let outcome = sandbox.carril(&["echo", "world/progress", "-n", "1", "--json", "--for", "10s"]);
    let line = outcome.stdout.lines().next().unwrap_or_default().to_owned();
    serde_json::from_str::<Value>(&line).unwrap_or_default()["value"].clone()
}

fn assert_in_the_lane(sandbox: &Sandbox) {
    let progress = progress(sandbox);
    assert_eq!((&progress["departures"], &progress["collisions"]), (&0.into(), &0.into()), "{progress}");
    assert!(progress["distance_m"].as_f64().is_some_and(|driven| driven > 1.0), "it has driven: {progress}");
}

#[test]
fn the_lane_detector_is_replaced_again_and_again_while_the_car_laps() {
    let swaps: u32 = std::env::var("CARRIL_SWAPS").ok().and_then(|count| count.parse().ok()).unwrap_or(20);
    let sandbox = Sandbox::new();
    let run = launch(&sandbox);
    let estimates = sandbox.start(&["echo", "lane/lane", "--json"]);
    for round in 0..swaps {
        let threshold = format!("threshold={}", 180 + round % 20);
        swap(&sandbox, &["lane", "--set", &threshold, "--shadow", "50ms", "--probation", "3"]);
    }
    assert_in_the_lane(&sandbox);
    let heard = estimates.interrupt().stdout;
    let mut seqs: Vec<u64> = heard
        .lines()
        .filter_map(|line| serde_json::from_str::<Value>(line).ok())
        .filter_map(|sample| sample["seq"].as_u64())
        .collect();
    assert!(seqs.len() as u32 > swaps, "the estimates were heard: {}", seqs.len());
    let first = seqs[0];
    seqs.sort_unstable();
    let expected: Vec<u64> = (first..first + seqs.len() as u64).collect();
    assert_eq!(seqs, expected, "each number once, none missing");
    run.interrupt().expect(0);
}

#[test]
fn every_node_can_be_replaced_while_the_car_drives() {
    let sandbox = Sandbox::new();
    let run = launch(&sandbox);
    let nodes: BTreeMap<&str, &str> = BTreeMap::from([
        ("actuator", "timeout_ms=1400"),
        ("bridge", "lease_ms=1400"),
        ("decision", "k_angle=0.88"),
        ("lane", "threshold=185"),
        ("mcu", "battery_low_v=6.1"),
        ("sectors", "sectors.2.from_deg=80"),
        ("world", "camera.rate_hz=30"),
    ]);
    for _ in 0..2 {
        for (node, values) in &nodes {
            swap(&sandbox, &[node, "--set", values, "--shadow", "50ms", "--probation", "3"]);
        }
    }
    let my_lane = program("my-lane").display().to_string();
    swap(&sandbox, &["lane", "--exec", &my_lane, "--shadow", "100ms"]);
    swap(&sandbox, &["lane", "--operator", "lane-detector", "--set", "threshold=190", "--fresh"]);
    assert_in_the_lane(&sandbox);
    run.interrupt().expect(0);
}

#[test]
fn a_bad_candidate_changes_nothing_for_the_car() {
    let sandbox = Sandbox::new();
    let run = launch(&sandbox);
    let binary = program("my-lane").display().to_string();
    let cases: [&[&str]; 4] = [
        &["swap", "lane", "--set", "threshold=300"],
        &["swap", "lane", "--operator", "lidar-sectors"],
        &["swap", "sectors", "--exec", &binary],
        &["swap", "lane", "--exec", "/bin/true"],
    ];
    for case in cases {
        let receipt = receipt(&sandbox, case);
        assert_eq!(receipt["outcome"], "refused", "{case:?}: {receipt}");
        assert!(receipt["reason"].as_str().is_some_and(|reason| !reason.is_empty()), "{case:?}: {receipt}");
    }
    let compared = receipt(&sandbox, &["shadow", "lane", "--set", "threshold=170", "--seconds", "1"]);
    assert_eq!(compared["outcome"], "compared", "{compared}");
    assert!(compared["compared"].as_u64() > Some(0), "{compared}");
    assert_in_the_lane(&sandbox);
    run.interrupt().expect(0);
}
