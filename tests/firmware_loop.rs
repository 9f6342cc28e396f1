//! The simulated car with the real firmware in the loop: `dataflows/firmware-in-the-loop.yaml`, in lockstep and live. Built by
//! `./dev firmware`; without it these tests say that they are skipped, and when thorough they fail.

mod support;

use serde_json::Value;
use support::car::patient;
use support::{Sandbox, project_file, thorough};

const GRAPH: &str = "dataflows/firmware-in-the-loop.yaml";

fn is_built() -> bool {
    let missing = ["simulated-chip", "firmware.elf"]
        .map(|name| project_file(&format!("target/firmware/{name}")))
        .into_iter()
        .find(|path| !std::path::Path::new(path).is_file());
    let Some(missing) = missing else { return true };
    assert!(!thorough::is_thorough(), "there is no `{missing}`; `./dev firmware` builds it");
    println!("skipped: there is no `{missing}`; `./dev firmware` builds it");
    false
}

#[test]
fn laps_the_oval_in_lockstep() {
    if !is_built() {
        return;
    }
    let laps = thorough::count(1, 10);
    // Ten laps take longer than anything else that the tests wait for.
    let args = ["sim", GRAPH, "--laps", &laps.to_string(), "--seconds", "400", "--json"];
    let output = Sandbox::new().command(&args).output().expect("it starts");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
    let summary: Value = serde_json::from_str(&text).expect("the summary is JSON");
    assert_eq!(summary["laps"], laps, "{summary}");
    assert_eq!((&summary["departures"], &summary["collisions"]), (&Value::from(0), &Value::from(0)), "{summary}");
    assert!(summary["cross_track_rms_m"].as_f64() <= Some(0.03), "in the middle of its lane, m: {summary}");
    assert_eq!(summary["errors"], 0, "{summary}");
}

#[test]
fn drives_in_real_time() {
    if !is_built() {
        return;
    }
    let (duration, distance_m) = thorough::count(("8s", 1.0), ("30s", 7.0));
    let sandbox = Sandbox::new();
    let text = std::fs::read_to_string(project_file(GRAPH)).expect("the graph is there");
    let graph = sandbox.write("firmware.yaml", patient(text.replace("../", &project_file("")), &[]));
    let stdout = sandbox.carril(&["run", &graph.display().to_string(), "--for", duration, "--json"]).expect(0);
    let last = stdout.lines().last().expect("a summary");
    let summary: Value = serde_json::from_str(last).expect("the summary is JSON");
    let progress = &summary["summary"]["progress"];
    assert!(progress["distance_m"].as_f64() >= Some(distance_m), "{distance_m} m in {duration}: {progress}");
    assert_eq!((&progress["departures"], &progress["collisions"]), (&Value::from(0), &Value::from(0)), "{progress}");
}

#[test]
fn without_the_firmware_the_node_says_what_to_do() {
    let sandbox = Sandbox::new();
    let text = std::fs::read_to_string(project_file(GRAPH)).expect("the graph is there");
    let text = text.replace("../target/firmware/", "../nowhere/").replace("../", &project_file(""));
    let graph = sandbox.write("firmware.yaml", text).display().to_string();
    let checked = sandbox.carril(&["check", &graph, "--devices"]).expect(1);
    assert!(checked.matches("`./dev firmware` builds it").count() == 2, "program and ELF: {checked}");
    sandbox.carril(&["check", &graph]).expect(0);
    let error = sandbox.carril(&["sim", &graph, "--seconds", "1"]).expect_error(1);
    assert!(error.contains("simulated-chip`; `./dev firmware` builds it"), "{error}");
}
