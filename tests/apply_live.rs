//! `carril apply` on the default graph while the car drives, as a user types it: the plan, the question, what is done, and what is
//! undone. The car stays in its lane.

mod support;

use serde_json::Value;
use support::car::patient_graph;
use support::{Running, Sandbox, program};

/// With a filter of the user's own between the lane detector and the decision, the lidar in one process with its evaluation, and
/// another threshold.
fn changed() -> String {
    let filter = format!(
        "  smooth:\n    exec: {}\n    inputs: {{ lane: lane/lane }}\n\n  decision:  ",
        program("my-filter").display()
    );
    let text = patient_graph(&[]).replace("lane: lane/lane, sectors", "lane: smooth/lane, sectors");
    let text = text.replace("  decision:  ", &filter).replace("threshold: 190", "threshold: 185");
    text.replace("operator: lidar-sectors", "operator: lidar-sectors\n    process: lane")
}

fn launch(sandbox: &Sandbox) -> Running {
    let file = sandbox.write("patient.yaml", patient_graph(&[])).display().to_string();
    let mut run = sandbox.launch(&file, &[]);
    run.wait_for_output("the car drives", |output| output.contains("\"lane-follow\""));
    run
}

fn assert_in_the_lane(sandbox: &Sandbox) {
    let outcome = sandbox.carril(&["echo", "world/progress", "-n", "1", "--json", "--for", "10s"]);
    let line = outcome.stdout.lines().next().unwrap_or_default().to_owned();
    let progress = serde_json::from_str::<Value>(&line).unwrap_or_default()["value"].clone();
    assert_eq!((&progress["departures"], &progress["collisions"]), (&0.into(), &0.into()), "{progress}");
}

const PATIENCE: [&str; 3] = ["--stall-ms", "2000", "--yes"];

#[test]
fn the_running_car_becomes_another_graph_and_back() {
    let sandbox = Sandbox::new();
    let run = launch(&sandbox);
    let commands = sandbox.start(&["echo", "actuator/command", "--json"]);
    let file = sandbox.write("changed.yaml", changed()).display().to_string();
    let plan = sandbox.carril(&["apply", &file, "--dry-run"]).expect(0);
    let signs: Vec<&str> = plan.lines().filter(|line| line.starts_with(['+', '-', '~'])).collect();
    let expected =
        ["~ lane           reconfigure", "~ sectors        move", "+ smooth         add", "~ decision       rewire"];
    assert_eq!(signs, expected, "what is to be done:\n{plan}");
    assert!(plan.contains("- inputs.lane: lane/lane\n    + inputs.lane: smooth/lane"), "the edges:\n{plan}");
    assert!(plan.ends_with("4 nodes left alone: world, actuator, bridge, mcu\n"), "what stays:\n{plan}");
    let nobody = sandbox.carril(&["apply", &file]).expect_error(2);
    assert!(nobody.contains("--yes"), "without a terminal it wants to be told: {nobody}");
    let done = sandbox.carril(&[&["apply", file.as_str()], &PATIENCE[..]].concat()).expect(0);
    assert!(done.contains("apply done: 4 nodes changed"), "{done}");
    let heard = sandbox.carril(&["echo", "smooth/lane", "-n", "5", "--for", "20s"]).expect(0);
    assert!(heard.contains("lane at angle"), "the new node is at work: {heard}");
    let again = sandbox.carril(&["apply", &file, "--dry-run"]).expect(0);
    assert!(again.contains("nothing is to be done"), "{again}");
    let back = sandbox.path().join("patient.yaml").display().to_string();
    let back = sandbox.carril(&[&["apply", back.as_str()], &PATIENCE[..]].concat()).expect(0);
    assert!(back.contains("apply done"), "{back}");
    assert_in_the_lane(&sandbox);
    let mut epochs: Vec<u64> = (commands.interrupt().stdout.lines())
        .filter_map(|line| serde_json::from_str::<Value>(line).ok()?["epoch"].as_u64())
        .collect();
    epochs.dedup();
    assert_eq!(epochs.len(), 1, "a node that is left alone has one life");
    run.interrupt().expect(0);
}

#[test]
fn a_graph_that_fails_is_undone_and_the_car_drives_on() {
    let sandbox = Sandbox::new();
    let run = launch(&sandbox);
    // Its turn comes last, when everything else is done.
    let bad = format!(
        "\n  lane:\n    exec: {}\n    operator: bad-lane\n    inputs: {{ image: world/camera }}\n    config: {{ panic_at: 5 }}\n\nbudgets:",
        program("bad-operators").display()
    );
    let (before, lane) =
        changed().split_once("  lane:  ").map(|(a, b)| (a.to_owned(), b.to_owned())).expect("a node `lane`");
    let (_, after) = lane.split_once("\n\n").expect("nodes are apart");
    let text = format!("{before}{after}").replace("process: lane", "process: eyes").replace("\nbudgets:", &bad);
    let file = sandbox.write("failing.yaml", text).display().to_string();
    let outcome = sandbox.carril(&[&["apply", file.as_str(), "--json"], &PATIENCE[..]].concat());
    assert_eq!(outcome.code, Some(1), "{}", outcome.report());
    assert!(outcome.stderr.is_empty(), "it passes `carril check`: {}", outcome.report());
    let receipt: Value =
        outcome.stdout.lines().last().and_then(|line| serde_json::from_str(line).ok()).unwrap_or_default();
    assert_eq!((&receipt["outcome"], &receipt["node"]), (&"rolled_back".into(), &"lane".into()), "{receipt}");
    assert!(receipt["reason"].as_str().is_some_and(|reason| reason.contains("panic")), "{receipt}");
    let back = sandbox.path().join("patient.yaml").display().to_string();
    let plan = sandbox.carril(&["apply", &back, "--dry-run"]).expect(0);
    assert!(plan.contains("nothing is to be done"), "everything is as it was: {plan}");
    assert_in_the_lane(&sandbox);
    run.interrupt().expect(0);
}

#[test]
fn what_cannot_be_applied_is_said_with_its_place() {
    let sandbox = Sandbox::new();
    let wrong = sandbox.write("wrong.yaml", patient_graph(&[]).replace("lane/lane", "lane/lain")).display().to_string();
    let problems = sandbox.carril(&["apply", &wrong, "--yes"]).expect_error(1);
    assert!(
        problems.contains("lane/lain") && problems.contains("wrong.yaml:"),
        "as `carril check` says it: {problems}"
    );
    let right = sandbox.write("right.yaml", patient_graph(&[])).display().to_string();
    let nothing = sandbox.carril(&["apply", &right, "--yes"]).expect_error(1);
    assert!(nothing.contains("no graph is running"), "nothing runs: {nothing}");
}
