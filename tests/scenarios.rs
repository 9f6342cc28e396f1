//! `carril scenarios run`: a series of drives is the same from the same seed, whatever number of threads drives it; the verdict is the
//! exit code; failing seeds are named, and shown again.

mod support;

use serde_json::Value;
use support::{Sandbox, project_file};

/// Short drives of the graph without a camera, which cannot leave its lane in this time.
fn scenario(sandbox: &Sandbox, more: &str) -> String {
    let graph = project_file("dataflow.yaml");
    let text = format!("graph: {graph}\nseconds: 2\nvary:\n  world.camera.noise_grey: {{ uniform: [0, 6] }}\n{more}");
    sandbox.write("drives.yaml", text).display().to_string()
}

fn lines(sandbox: &Sandbox, file: &str, jobs: &str) -> String {
    let out = sandbox.path().join(format!("jobs{jobs}.jsonl")).display().to_string();
    sandbox.carril(&["scenarios", "run", file, "--runs", "4", "--seed", "5", "--jobs", jobs, "--out", &out]).expect(0);
    std::fs::read_to_string(out).expect("the results are there")
}

#[test]
fn one_seed_gives_the_same_drives_on_one_thread_and_on_two() {
    let sandbox = Sandbox::new();
    let file = scenario(&sandbox, "");
    let one = lines(&sandbox, &file, "1");
    assert_eq!(one, lines(&sandbox, &file, "2"), "byte for byte");
    let drives: Vec<Value> = one.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect();
    assert_eq!(drives.len(), 4, "one line a drive: {one}");
    assert_ne!(drives[0]["hash"], drives[1]["hash"], "drives differ");
    assert!(drives[0]["drawn"]["values"]["world.camera.noise_grey"].is_number(), "what was drawn: {}", drives[0]);
}

#[test]
fn a_series_that_fails_names_its_seeds_and_ends_with_1() {
    let sandbox = Sandbox::new();
    let file = scenario(&sandbox, "success: { distance_min_m: 500 }\n");
    let arguments = ["scenarios", "run", &file, "--runs", "2", "--seed", "5", "--json"];
    let summary: Value = serde_json::from_str(&sandbox.carril(&arguments).expect(1)).expect("the summary is JSON");
    assert_eq!((&summary["runs"], &summary["succeeded"]), (&2.into(), &0.into()), "{summary}");
    let failure = &summary["failures"][0];
    assert!(failure["reasons"][0].as_str().is_some_and(|reason| reason.contains("wanted are 500 m")), "{failure}");
    let seed = failure["seed"].as_u64().expect("a seed").to_string();
    let text = sandbox.carril(&["scenarios", "run", &file, "--runs", "2", "--seed", "5"]).expect(1);
    assert!(text.contains(&seed) && text.contains("FAILED"), "seed {seed} in\n{text}");
}

#[test]
fn a_drive_is_shown_again_from_its_seed_with_the_same_hash_and_its_states() {
    let sandbox = Sandbox::new();
    let file = scenario(&sandbox, "");
    let results = lines(&sandbox, &file, "2");
    let drive: Value = serde_json::from_str(results.lines().nth(2).expect("four lines")).expect("a line of JSON");
    let seed = drive["seed"].as_u64().expect("a seed").to_string();
    let arguments = ["scenarios", "show", &file, "--seed", &seed];
    let shown: Value =
        serde_json::from_str(&sandbox.carril(&[&arguments[..], &["--json"]].concat()).expect(0)).expect("JSON");
    assert_eq!((&shown["hash"], &shown["drawn"]), (&drive["hash"], &drive["drawn"]), "the same drive");
    let timeline = shown["timeline"].as_array().expect("a timeline");
    assert!(timeline.iter().any(|change| change["state"] == "lane-follow"), "it drives: {timeline:?}");
    assert!(timeline.windows(2).all(|pair| pair[0]["state"] != pair[1]["state"]), "changes only: {timeline:?}");
    let text = sandbox.carril(&arguments).expect(0);
    let reason = timeline[0]["reason"].as_str().expect("a reason");
    for part in [reason, "world.camera.noise_grey", "success", drive["hash"].as_str().expect("a hash")] {
        assert!(text.contains(part), "`{part}` in\n{text}");
    }
}

#[test]
fn a_drive_that_fails_is_shown_with_its_reason_and_ends_with_1() {
    let sandbox = Sandbox::new();
    let file = scenario(&sandbox, "success: { distance_min_m: 500 }\n");
    let text = sandbox.carril(&["scenarios", "show", &file, "--seed", "5"]).expect(1);
    assert!(text.contains("FAILED") && text.contains("wanted are 500 m"), "{text}");
}

#[test]
fn a_wrong_scenario_is_refused_before_anything_drives() {
    let sandbox = Sandbox::new();
    let file = scenario(&sandbox, "require: { succes_min: 1 }\n");
    let error = sandbox.carril(&["scenarios", "run", &file]).expect_error(1);
    assert!(error.contains("unknown key `succes_min`") && error.contains("drives.yaml:5:"), "{error}");
    let error = sandbox.carril(&["scenarios", "run", "no-such.yaml"]).expect_error(2);
    assert!(error.contains("there is no file `no-such.yaml`"), "{error}");
}

#[test]
fn the_scenarios_that_come_along_are_clean() {
    for name in ["lanes", "oval"] {
        Sandbox::new().carril(&["scenarios", "run", name, "--runs", "1", "--seed", "3"]).expect(0);
    }
}

/// Drives with wheels that stand far to the left, which leave their lane, and with what has nothing to do with it.
fn leaves_its_lane(sandbox: &Sandbox) -> String {
    let more = "  world.vehicle.steering_offset_deg: { uniform: [17, 19] }\nlatency: { lane: { uniform: [1, 3] } }\n\
                success: { distance_min_m: 0.1 }\n";
    let file = scenario(sandbox, more);
    let text = std::fs::read_to_string(&file).expect("it is there").replace("seconds: 2", "seconds: 10");
    sandbox.write("drives.yaml", text).display().to_string()
}

#[test]
fn a_drive_that_fails_is_shrunk_to_a_file_that_fails_in_the_same_way() {
    let sandbox = Sandbox::new();
    let file = leaves_its_lane(&sandbox);
    let small = sandbox.path().join("small.yaml").display().to_string();
    let shrink = ["scenarios", "shrink", &file, "--seed", "5", "--out", &small];
    let told = sandbox.carril(&shrink).expect(0);
    assert!(told.contains("# departures, allowed are #"), "the kind of the failure:\n{told}");
    let text = std::fs::read_to_string(&small).expect("it was written");
    assert!(text.contains("world.vehicle.steering_offset_deg:"), "what makes it fail stays:\n{text}");
    let body: String = text.lines().filter(|line| !line.starts_with('#')).collect();
    for gone in ["vary", "noise_grey", "latency", "distance_min_m"] {
        assert!(!body.contains(gone), "`{gone}` is not needed:\n{text}");
    }
    assert!(text.contains("seed 5") && text.contains("departures, allowed are 0"), "where it came from:\n{text}");
    let summary: Value =
        serde_json::from_str(&sandbox.carril(&["scenarios", "run", &small, "--json"]).expect(1)).expect("JSON");
    let reasons = &summary["failures"][0]["reasons"];
    assert!(reasons[0].as_str().is_some_and(|reason| reason.contains("departures")), "one drive, same kind: {summary}");
    assert!(summary["seconds"].as_f64().is_some_and(|seconds| seconds < 10.0), "shorter: {summary}");
    let error = sandbox.carril(&shrink).expect_error(1);
    assert!(error.contains("exists already") && error.contains("--out"), "it is not overwritten: {error}");
}

#[test]
fn a_drive_that_succeeds_is_not_shrunk() {
    let sandbox = Sandbox::new();
    let file = scenario(&sandbox, "");
    let error = sandbox.carril(&["scenarios", "shrink", &file, "--seed", "5"]).expect_error(1);
    assert!(error.contains("seed 5") && error.contains("succeeds: there is nothing to shrink"), "{error}");
}

#[test]
fn check_tells_what_is_wrong_with_a_scenario_where_it_is() {
    let sandbox = Sandbox::new();
    let file = scenario(&sandbox, "");
    let text = sandbox.carril(&["check", &file]).expect(0);
    assert!(text.contains("drives.yaml: ok: a scenario of") && text.contains("1 value drawn"), "{text}");
    let file = scenario(&sandbox, "success: { departure: 0 }\n");
    let list: Value = serde_json::from_str(&sandbox.carril(&["check", &file, "--json"]).expect(1)).expect("JSON");
    let problem = &list[0];
    assert_eq!((&problem["line"], &problem["column"]), (&5.into(), &12.into()), "{list}");
    assert_eq!(problem["message"], "`success`: unknown key `departure`", "{list}");
    let error = sandbox.carril(&["check", &file, "--devices"]).expect_error(2);
    assert!(error.contains("`--devices` is for graph files"), "{error}");
}
