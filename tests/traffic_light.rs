//! The simulated car at traffic lights, in lockstep: stops before the line at red, goes on at green, and for nothing else that is red.

mod support;

use serde_json::Value;
use support::thorough;
use support::{Sandbox, project};

/// A straight with a light whose line crosses it at 4.3 m, and back.
fn track(phases: &str, offset_s: f64, more: &str) -> String {
    format!(
        "lane:\n  left: solid\n  right: solid\n  centre:\n    pieces:\n      - straight_m: 8.0\n      - left: {{ radius_m: 1.2, \
         angle_deg: 180 }}\n      - straight_m: 8.0\n      - left: {{ radius_m: 1.2, angle_deg: 180 }}\n{more}lights:\n  - {{ \
         along_m: 4.3, phases: [{phases}], offset_s: {offset_s} }}\nstart: {{ along_m: 0.3 }}\n"
    )
}

struct Drives {
    sandbox: Sandbox,
    graph: String,
}

impl Drives {
    fn new() -> Self {
        let sandbox = Sandbox::new();
        let graph = std::fs::read_to_string(project().join("dataflows/traffic-light.yaml")).expect("it ships");
        let graph = graph.replace("../tracks/traffic-light.yaml", "track.yaml");
        let graph = sandbox.write("graph.yaml", graph).display().to_string();
        Self { sandbox, graph }
    }

    /// The summary of so many seconds on that track.
    fn drive(&self, track: &str, seconds: f64, seed: u64, changes: &[String]) -> Value {
        self.sandbox.write("track.yaml", track);
        let (seconds, seed) = (seconds.to_string(), seed.to_string());
        let mut args = vec!["sim", &self.graph, "--seconds", &seconds, "--seed", &seed, "--json"];
        args.extend(changes.iter().flat_map(|change| ["--set", change.as_str()]));
        serde_json::from_str(&self.sandbox.carril(&args).expect(0)).expect("JSON")
    }
}

/// Numbers of a run, drawn anew each time and told when something fails.
struct Drawn(u64);

impl Drawn {
    fn new() -> Self {
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).expect("after 1970");
        let seed = now.as_nanos() as u64;
        println!("seed {seed}");
        Self(seed)
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * ((self.0 >> 11) as f64 / (1_u64 << 53) as f64)
    }
}

#[test]
fn at_red_it_stands_before_the_line_and_at_green_it_goes_on() {
    let drives = Drives::new();
    let mut drawn = Drawn::new();
    for _ in 0..thorough::count(6, 20) {
        let changes = [
            format!("world.start.left_m={}", drawn.between(-0.05, 0.05)),
            format!("world.start.along_m={}", drawn.between(0.0, 1.5)),
            format!("world.camera.lighting={}", if drawn.between(0.0, 1.0) < 0.5 { "even" } else { "dim-gradient" }),
            format!("decision.cruise_speed_m_s={}", drawn.between(0.3, 0.6)),
            format!("world.camera.noise_grey={}", drawn.between(0.0, 5.0)),
        ];
        let seed = drawn.between(1.0, 1e6) as u64;
        let summary = drives.drive(&track("{ red: 1000 }", 0.0, ""), 25.0, seed, &changes);
        let stood_m = summary["stopped_before_line_m"].as_f64();
        assert!(stood_m.is_some_and(|m| (0.05..=0.30).contains(&m)), "{changes:?}, seed {seed}: {stood_m:?} m");
        assert_eq!((&summary["red_runs"], &summary["state"]), (&0.into(), &"light-stop".into()), "{changes:?}");
        // The same drive, and the light turns green after a while.
        let summary = drives.drive(&track("{ red: 20 }, { green: 1000 }", 0.0, ""), 35.0, seed, &changes);
        let driven_m = summary["distance_m"].as_f64();
        assert!(driven_m.is_some_and(|m| m > 5.5), "{changes:?}, seed {seed}: it went on: {summary}");
        assert_eq!((&summary["red_runs"], &summary["state"]), (&0.into(), &"lane-follow".into()), "{changes:?}");
    }
}

#[test]
fn a_light_that_is_green_or_dark_and_red_things_that_are_no_light_do_not_stop_it() {
    let drives = Drives::new();
    let mut drawn = Drawn::new();
    for round in 0..thorough::count(6, 20) {
        let mut red_box = || {
            let (x, side) = (drawn.between(1.5, 7.5), if drawn.between(0.0, 1.0) < 0.7 { 1.0 } else { -1.0 });
            let (y, size) = (side * drawn.between(0.5, 0.8), drawn.between(0.03, 0.2));
            let (height, red) = (drawn.between(0.1, 0.5), drawn.between(150.0, 255.0) as u8);
            format!(
                "  - {{ x_m: {x:.3}, y_m: {y:.3}, yaw_deg: {:.0}, length_m: {size:.3}, width_m: {size:.3}, height_m: {height:.3}, \
                 colour: [{red}, 30, 30] }}\n",
                drawn.between(0.0, 90.0)
            )
        };
        let boxes: String = std::iter::once("boxes:\n".to_owned()).chain((0..4).map(|_| red_box())).collect();
        let phases = if round % 2 == 0 { "{ green: 1000 }" } else { "{ dark: 1000 }" };
        let summary = drives.drive(&track(phases, 0.0, &boxes), 16.0, drawn.between(1.0, 1e6) as u64, &[]);
        assert_eq!(summary["stopped_before_line_m"], Value::Null, "{boxes}");
        assert_eq!(summary["state"], "lane-follow", "{boxes}: {summary}");
        let driven_m = summary["distance_m"].as_f64();
        assert!(driven_m.is_some_and(|m| m > 7.0), "it never stood: {driven_m:?} m: {boxes}");
    }
}

#[test]
fn it_laps_the_track_that_ships_and_passes_no_red_light() {
    let summary =
        Sandbox::new().carril(&["sim", "dataflows/traffic-light.yaml", "--seconds", "90", "--json"]).expect(0);
    let summary: Value = serde_json::from_str(&summary).expect("JSON");
    assert!(summary["laps"].as_u64() >= Some(1), "{summary}");
    for count in ["red_runs", "departures", "collisions", "errors"] {
        assert_eq!(summary[count], 0, "{count}: {summary}");
    }
}
