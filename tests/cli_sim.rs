//! `carril sim`: the default graph in lockstep. Same seed, same hash; the summary has every number that was promised.

mod support;

use serde_json::Value;
use support::Sandbox;

fn sim(args: &[&str]) -> Value {
    let mut all = vec!["sim", "dataflow.yaml", "--json"];
    all.extend(args);
    let output = Sandbox::new().carril(&all).expect(0);
    serde_json::from_str(&output).expect("the summary is one JSON value")
}

#[test]
fn one_seed_gives_one_hash() {
    let first = sim(&["--seconds", "2", "--seed", "7"]);
    let again = sim(&["--seconds", "2", "--seed", "7"]);
    let other = sim(&["--seconds", "2", "--seed", "8"]);
    assert_eq!(first["hash"], again["hash"], "same seed, same bytes");
    assert_ne!(first["hash"], other["hash"], "another seed, other noise");
    let hash = first["hash"].as_str().expect("the hash is a text");
    assert!(hash.len() == 16 && hash.chars().all(|digit| digit.is_ascii_hexdigit()), "in hex: {hash}");
}

#[test]
fn the_summary_is_complete() {
    let summary = sim(&["--seconds", "2"]);
    let numbers = [
        "/seconds",
        "/laps",
        "/departures",
        "/cross_track_rms_m",
        "/cross_track_max_m",
        "/collisions",
        "/age_ms/p50",
        "/age_ms/p99",
        "/overruns",
        "/real_time_factor",
    ];
    for path in numbers {
        assert!(summary.pointer(path).is_some_and(Value::is_number), "`{path}` in {summary}");
    }
    let nodes = summary["nodes"].as_array().expect("a list of nodes");
    assert_eq!(nodes.len(), 7, "every node: {summary}");
    for node in nodes {
        assert!(node["steps"].as_u64().is_some_and(|steps| steps > 0), "a node that never stepped: {node}");
        assert!(node["cost_us_per_step"].is_number(), "the cost of a step: {node}");
    }
}

#[test]
fn it_stops_after_the_laps_that_were_asked_for() {
    let sandbox = Sandbox::new();
    let output =
        sandbox.carril(&["sim", "dataflows/no-camera.yaml", "--seconds", "600", "--laps", "1", "--json"]).expect(0);
    let summary: Value = serde_json::from_str(&output).expect("the summary is one JSON value");
    assert_eq!(summary["laps"], 1, "{summary}");
    assert!(summary["seconds"].as_f64().is_some_and(|seconds| seconds < 600.0), "it ended before the time: {summary}");
}

#[test]
fn people_get_words() {
    let outcome = Sandbox::new().carril(&["sim", "dataflow.yaml", "--seconds", "1"]);
    assert_eq!(outcome.stderr, "", "no progress bar in a pipe");
    let text = outcome.expect(0);
    for word in ["real time", "laps", "cross-track", "age", "hash", "lane", "actuator"] {
        assert!(text.contains(word), "`{word}` in\n{text}");
    }
}

#[test]
fn a_binary_of_the_users_own_cannot_run_in_lockstep() {
    let sandbox = Sandbox::new();
    let program = support::project_file("tests/dataflows/programs/two.sh");
    let graph = format!("robot: car1\nnodes:\n  own: {{ exec: {program}, operator: idle }}\n");
    let file = sandbox.write("own.yaml", graph).display().to_string();
    let error = sandbox.carril(&["sim", &file]).expect_error(1);
    assert!(error.contains("`own`") && error.contains("carril run"), "names the node and what to do: {error}");
}
