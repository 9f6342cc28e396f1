//! The simulated car parks beside its lane, in lockstep: in a gap that is long enough, in none that is too short, and it touches nothing.

mod support;

use serde_json::Value;
use support::{Sandbox, project};

/// The track that ships, its second gap made as long as that, and what the drive comes to.
fn drive(gap_m: f64, seconds: u32, changes: &[&str]) -> Value {
    let sandbox = Sandbox::new();
    let graph = std::fs::read_to_string(project().join("dataflows/parking.yaml")).expect("it ships");
    let graph =
        sandbox.write("graph.yaml", graph.replace("../tracks/parking.yaml", "track.yaml")).display().to_string();
    let track = std::fs::read_to_string(project().join("tracks/parking.yaml")).expect("it ships");
    assert!(track.contains("x_m: 4.25") && track.contains("x_m: 4.70"), "the two cars before the second gap");
    let track = track.replace("x_m: 4.25", &format!("x_m: {:.3}", 3.70 + gap_m));
    sandbox.write("track.yaml", track.replace("x_m: 4.70", &format!("x_m: {:.3}", 4.15 + gap_m)));
    let seconds = seconds.to_string();
    let mut args = vec!["sim", &graph, "--seconds", &seconds, "--json"];
    args.extend(changes.iter().flat_map(|change| ["--set", *change]));
    serde_json::from_str(&sandbox.carril(&args).expect(0)).expect("JSON")
}

#[test]
fn parks_in_a_gap_that_is_long_enough() {
    let summary = drive(0.60, 90, &["world.vehicle.wheel_slip=0.03", "world.vehicle.steering_offset_deg=0.8"]);
    assert_eq!((&summary["state"], &summary["collisions"]), (&"parked".into(), &0.into()), "{summary}");
}

#[test]
fn stands_when_no_gap_is_long_enough() {
    let summary = drive(0.40, 40, &["decision.park.search_m=6"]);
    assert_eq!((&summary["state"], &summary["collisions"]), (&"park-stop".into(), &0.into()), "{summary}");
}

#[test]
fn without_a_goal_it_passes_every_gap() {
    let summary = drive(0.60, 15, &["decision.park.goal=null"]);
    assert_eq!((&summary["state"], &summary["departures"]), (&"lane-follow".into(), &0.into()), "{summary}");
}
