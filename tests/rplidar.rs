//! The simulated car with an RPLIDAR in the place of the world's own lidar: driver and device on a line, in lockstep and live.

mod support;

use serde_json::Value;
use support::{Sandbox, project};

const GRAPH: &str = "dataflows/rplidar-in-the-loop.yaml";

#[test]
fn the_car_laps_by_what_the_driver_says() {
    let summary = Sandbox::new().carril(&["sim", GRAPH, "--seconds", "45", "--json"]).expect(0);
    let summary: Value = serde_json::from_str(&summary).expect("JSON");
    assert!(summary["laps"].as_u64() >= Some(1), "{summary}");
    for count in ["departures", "collisions", "errors"] {
        assert_eq!(summary[count], 0, "{count}: {summary}");
    }
    let nodes = summary["nodes"].as_array().expect("nodes");
    let sent = |name: &str| nodes.iter().find(|node| node["node"] == name).map(|node| node["sent"].as_u64());
    assert!(sent("lidar").flatten() >= Some(400), "ten scans a second: {summary}");
}

#[test]
fn it_stops_for_a_box_that_the_driver_sees() {
    let sandbox = Sandbox::new();
    let oval = std::fs::read_to_string(project().join("tracks/oval.yaml")).expect("it ships");
    sandbox.write("boxed.yaml", format!("{oval}boxes:\n  - {{ x_m: 1.9, y_m: 0.0, length_m: 0.2, width_m: 0.3 }}\n"));
    let graph = std::fs::read_to_string(project().join(GRAPH)).expect("it ships");
    let graph = sandbox.write("graph.yaml", graph.replace("../tracks/oval.yaml", "boxed.yaml")).display().to_string();
    let summary = sandbox.carril(&["sim", &graph, "--seconds", "12", "--json"]).expect(0);
    let summary: Value = serde_json::from_str(&summary).expect("JSON");
    assert_eq!((&summary["state"], &summary["collisions"]), (&"obstacle-stop".into(), &0.into()), "{summary}");
}

#[test]
fn live_it_scans_over_a_terminal_and_the_scan_can_be_drawn() {
    let sandbox = Sandbox::new();
    let run = sandbox.launch(GRAPH, &[]);
    let scan = sandbox.carril(&["echo", "lidar/scan", "-n", "1", "--json"]).expect(0);
    let scan: Value = serde_json::from_str(scan.lines().next().unwrap_or_default()).expect("JSON");
    assert_eq!(scan["value"]["ranges_m"].as_array().map(Vec::len), Some(360), "{scan}");
    let plot = sandbox.carril(&["echo", "lidar/scan", "--plot", "-n", "1"]).expect(0);
    assert!(plot.contains(" returns, "), "{plot}");
    run.interrupt();
}
