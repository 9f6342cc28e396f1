//! The simulated car and what stands in its lane, in lockstep: it passes what leaves it a way, stands before what does not, and
//! touches nothing.

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

fn number(summary: &Value, name: &str) -> f64 {
    summary[name].as_f64().unwrap_or_else(|| panic!("no {name}: {summary}"))
}

#[test]
fn passes_what_stands_and_what_crawls() {
    // The second one lies opposite the car when it drives through the curve behind it.
    for (along_m, speed_m_s) in [(4.5, 0.0), (5.0, 0.0), (4.5, 0.15)] {
        let summary = drive(40, &json!([{ "along_m": along_m, "speed_m_s": speed_m_s }]), &[]);
        assert_eq!((&summary["state"], &summary["collisions"]), (&"lane-follow".into(), &0.into()), "{summary}");
        assert!(number(&summary, "distance_m") > 15.0, "it is far behind it: {summary}");
        assert!(number(&summary, "cross_track_max_m") > 0.25, "it went out of its lane for that: {summary}");
    }
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
