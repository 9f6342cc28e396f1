//! Closed loop, in lockstep: the default graph keeps its lane, on every track and under both lightings, through the real
//! operators, the serial protocol and the model of the microcontroller. Same seed, same bytes.

mod support;

use serde_json::Value;
use support::{Sandbox, thorough};

/// What carril promises on every track, m: root mean square of the cross-track error.
const CROSS_TRACK_RMS_MAX_M: f64 = 0.05;

fn laps() -> u32 {
    thorough::count(2, 5)
}

/// Seeds of the random tracks: 40 drives in all, half of them in dim light.
fn random_tracks() -> impl Iterator<Item = String> {
    (1..=thorough::count(2, 20)).map(|seed| format!("random:{seed}"))
}

fn drive(track: &str, sets: &[&str]) -> Value {
    let (track, laps) = (format!("world.track={track}"), laps().to_string());
    let mut arguments = vec!["sim", "dataflow.yaml", "--json", "--laps", &laps, "--seconds", "600", "--set", &track];
    for set in sets {
        arguments.extend(["--set", set]);
    }
    let stdout = Sandbox::new().carril(&arguments).expect(0);
    serde_json::from_str(&stdout).expect("the summary is JSON")
}

#[track_caller]
fn assert_kept_its_lane(track: &str, summary: &Value) {
    let number = |name: &str| summary[name].as_f64().unwrap_or_else(|| panic!("{track}: `{name}` in {summary}"));
    assert_eq!(number("departures"), 0.0, "{track}: departures");
    assert_eq!(number("collisions"), 0.0, "{track}: collisions");
    assert!(number("laps") >= f64::from(laps()), "{track}: {} laps", number("laps"));
    let rms_m = number("cross_track_rms_m");
    assert!(rms_m <= CROSS_TRACK_RMS_MAX_M, "{track}: cross-track rms {rms_m} m, at most {CROSS_TRACK_RMS_MAX_M} m");
    assert_eq!(summary["faults"], Value::Array(Vec::new()), "{track}: faults");
}

#[test]
fn keeps_its_lane_on_the_oval() {
    assert_kept_its_lane("oval", &drive("oval", &[]));
}

#[test]
fn keeps_its_lane_through_s_bends() {
    assert_kept_its_lane("s-bends", &drive("s-bends", &[]));
}

#[test]
fn keeps_its_lane_on_random_tracks() {
    for track in random_tracks() {
        assert_kept_its_lane(&track, &drive(&track, &[]));
    }
}

#[test]
fn keeps_its_lane_on_random_tracks_in_light_that_defeats_a_fixed_threshold() {
    for track in random_tracks() {
        let summary = drive(&track, &["world.camera.lighting=dim-gradient", "lane.threshold=otsu"]);
        assert_kept_its_lane(&format!("{track}, dim"), &summary);
    }
}

#[test]
fn otsu_keeps_the_lane_where_light_defeats_a_fixed_threshold() {
    for track in ["oval", "s-bends"] {
        let summary = drive(track, &["world.camera.lighting=dim-gradient", "lane.threshold=otsu"]);
        assert_kept_its_lane(&format!("{track}, dim"), &summary);
    }
}

#[test]
fn a_fixed_threshold_stops_the_car_in_light_that_defeats_it() {
    let outcome = Sandbox::new().carril(&[
        "sim",
        "dataflow.yaml",
        "--json",
        "--seconds",
        "10",
        "--set",
        "world.camera.lighting=dim-gradient",
    ]);
    let summary: Value = serde_json::from_str(&outcome.expect(0)).expect("the summary is JSON");
    assert_eq!(summary["departures"], 0, "the car stands rather than leaves its lane: {summary}");
    assert_eq!(summary["state"], "lane-lost", "and says why: {summary}");
}

#[test]
fn one_seed_gives_the_same_bytes_and_another_gives_others() {
    let hash = |seed: &str| {
        let arguments = ["sim", "dataflow.yaml", "--json", "--seconds", "5", "--seed", seed];
        let summary: Value = serde_json::from_str(&Sandbox::new().carril(&arguments).expect(0)).expect("JSON");
        summary["hash"].clone()
    };
    let first = hash("7");
    assert_eq!(first, hash("7"), "two runs of one seed");
    assert_ne!(first, hash("8"), "another seed is another run");
}
