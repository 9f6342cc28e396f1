//! The simulated car and what stands in its lane, in lockstep: where there is no way past it, it stands and touches nothing.

mod support;

use serde_json::{Value, json};
use support::{Sandbox, project_file};

/// The graph that ships with these things on its road, and what the drive comes to.
fn drive(seconds: u32, obstacles: &Value, changes: &[&str]) -> Value {
    let (seconds, obstacles) = (seconds.to_string(), format!("world.obstacles={obstacles}"));
    let graph = project_file("dataflows/overtake.yaml");
    let mut args = vec!["sim", &graph, "--seconds", &seconds, "--json", "--set", &obstacles];
    args.extend(changes.iter().flat_map(|change| ["--set", *change]));
    serde_json::from_str(&Sandbox::new().carril(&args).expect(0)).expect("JSON")
}

#[test]
fn stands_while_both_lanes_are_taken() {
    let wall = json!([{ "along_m": 5.0 }, { "along_m": 5.0, "left_m": 0.4 }]);
    let summary = drive(40, &wall, &[]);
    assert_eq!((&summary["state"], &summary["collisions"]), (&"overtake-wait".into(), &0.into()), "{summary}");
}

#[test]
fn without_overtaking_it_stops_before_what_stands_there() {
    let summary = drive(30, &json!([{ "along_m": 5.0 }]), &["decision.overtake.enabled=false"]);
    assert_eq!((&summary["state"], &summary["collisions"]), (&"obstacle-stop".into(), &0.into()), "{summary}");
}
