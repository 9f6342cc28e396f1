//! `carril check`, `graph`, `schema` and `operators`: good and bad files, what is printed where, exit codes.

mod support;

use serde_json::Value;
use support::{Sandbox, neutral};

/// The default graph with three mistakes, far from each other.
const BAD: &str = "\
robot: car1
nodes:
  world:
    operator: sim-world
    config: { track: PROJECT/tracks/oval.yaml }
  lane:
    operator: lane-detecter
    inputs: { image: world/camrea }
  sectors:
    operator: lidar-sectors
    inputs: { scan: world/camera }
";

fn bad_file(sandbox: &Sandbox) -> String {
    let text = BAD.replace("PROJECT", &support::project().display().to_string());
    sandbox.write("bad.yaml", text).display().to_string()
}

#[test]
fn a_clean_file_says_so_and_ends_with_0() {
    let outcome = Sandbox::new().carril(&["check", "dataflow.yaml"]);
    assert_eq!(outcome.stderr, "", "nothing on standard error");
    let expected = "dataflow.yaml: ok: 7 nodes in 7 processes, 8 connections, 1 budget\n";
    assert_eq!(outcome.expect(0), expected, "what is in it");
}

#[test]
fn every_graph_that_ships_is_clean() {
    let sandbox = Sandbox::new();
    let mut graphs = vec![support::project().join("dataflow.yaml")];
    for entry in std::fs::read_dir(support::project().join("dataflows")).expect("the project has dataflows/") {
        graphs.push(entry.expect("the folder can be read").path());
    }
    graphs.retain(|path| path.extension().is_some_and(|extension| extension == "yaml"));
    assert!(graphs.len() >= 4, "the graphs are found: {graphs:?}");
    for graph in graphs {
        sandbox.carril(&["check", &graph.display().to_string()]).expect(0);
    }
}

#[test]
fn every_problem_has_a_place_and_a_hint() {
    let sandbox = Sandbox::new();
    let outcome = sandbox.carril(&["check", &bad_file(&sandbox)]);
    assert_eq!(outcome.stderr, "", "problems are the result: they go to standard output");
    let report = neutral(&outcome.report()).replace(&sandbox.path().display().to_string(), "SANDBOX");
    assert_eq!(outcome.code, Some(1), "{report}");
    for part in ["bad.yaml:7:15", "bad.yaml:8:22", "lane-detector", "world/camera"] {
        assert!(report.contains(part), "`{part}` is missing:\n{report}");
    }
    insta::assert_snapshot!("check_bad", report);
}

#[test]
fn json_has_the_same_problems() {
    let sandbox = Sandbox::new();
    let json = sandbox.carril(&["check", "--json", &bad_file(&sandbox)]).expect(1);
    let problems: Value = serde_json::from_str(&json).expect("one JSON value");
    let places: Vec<_> = problems.as_array().expect("a list").iter().map(|p| (&p["line"], &p["column"])).collect();
    assert!(places.contains(&(&7.into(), &15.into())) && places.contains(&(&8.into(), &22.into())), "{places:?}");
    let clean = sandbox.carril(&["check", "--json", "dataflow.yaml"]).expect(0);
    assert_eq!(clean, "[]\n", "no problems, no words");
}

#[test]
fn an_override_is_checked_like_the_file() {
    let sandbox = Sandbox::new();
    let outcome = sandbox.carril(&["check", "dataflow.yaml", "--set", "lane.threshold=300"]).expect(1);
    assert!(
        outcome.contains("--set lane.threshold=300") && outcome.contains("255"),
        "where and what is allowed: {outcome}"
    );
    let unknown = sandbox.carril(&["check", "dataflow.yaml", "--set", "lane.treshold=180"]).expect(1);
    assert!(unknown.contains("did you mean `threshold`?"), "a misspelt key is no silent default: {unknown}");
    sandbox.carril(&["check", "dataflow.yaml", "--set", "lane.threshold=180"]).expect(0);
}

#[test]
fn devices_are_looked_for_only_when_asked() {
    let sandbox = Sandbox::new();
    let graph = "robot: car1\nnodes:\n  camera:\n    operator: camera\n    config: { source: /dev/video-of-nobody }\n";
    let file = sandbox.write("camera.yaml", graph).display().to_string();
    sandbox.carril(&["check", &file]).expect(0);
    let problems = sandbox.carril(&["check", &file, "--devices"]).expect(1);
    assert!(problems.contains("/dev/video-of-nobody"), "it names the device: {problems}");
}

#[test]
fn several_files_are_all_checked() {
    let sandbox = Sandbox::new();
    let output = sandbox.carril(&["check", "dataflow.yaml", &bad_file(&sandbox)]).expect(1);
    assert!(output.contains("dataflow.yaml: ok") && output.contains("bad.yaml:7:15"), "{output}");
}

#[test]
fn files_that_are_no_graphs_are_refused_with_words() {
    let sandbox = Sandbox::new();
    let files: [(&str, Vec<u8>); 4] = [
        ("empty.yaml", Vec::new()),
        ("binary.yaml", (0..=255).collect()),
        ("list.yaml", b"- a\n- b\n".to_vec()),
        ("huge.yaml", vec![b'#'; 10 << 20]),
    ];
    for (name, content) in files {
        let file = sandbox.write(name, content).display().to_string();
        let output = sandbox.carril(&["check", &file]).expect(1);
        assert!(output.contains(name), "the file is named: {output}");
    }
}

#[test]
fn a_graph_that_shall_run_shows_its_problems_on_standard_error() {
    let sandbox = Sandbox::new();
    for command in ["run", "sim", "graph"] {
        let outcome = sandbox.carril(&[command, &bad_file(&sandbox)]);
        assert_eq!(outcome.stdout, "", "{command}: nothing ran");
        let error = outcome.expect_error(1);
        assert!(error.contains("bad.yaml:7:15"), "{command}: {error}");
    }
}

#[test]
fn the_graph_has_three_forms() {
    let sandbox = Sandbox::new();
    let mermaid = sandbox.carril(&["graph", "dataflow.yaml"]).expect(0);
    assert!(mermaid.contains("flowchart") && mermaid.contains("lane-detector"), "{mermaid}");
    let dot = sandbox.carril(&["graph", "dataflow.yaml", "--format", "dot"]).expect(0);
    assert!(dot.starts_with("digraph") && dot.trim_end().ends_with('}'), "{dot}");
    let json = sandbox.carril(&["graph", "dataflow.yaml", "--format", "json"]).expect(0);
    let json: Value = serde_json::from_str(&json).expect("one JSON value");
    assert_eq!(json["nodes"].as_array().map(Vec::len), Some(7), "{json}");
}

#[test]
fn the_schema_knows_operators_and_their_configuration() {
    let schema = Sandbox::new().carril(&["schema"]).expect(0);
    let _: Value = serde_json::from_str(&schema).expect("one JSON value");
    for name in ["lane-detector", "row_far", "budgets", "on_overrun"] {
        assert!(schema.contains(&format!("\"{name}\"")), "`{name}` is missing");
    }
}

#[test]
fn operators_are_described_from_their_types() {
    let sandbox = Sandbox::new();
    let list = sandbox.carril(&["operators"]).expect(0);
    for kind in [
        "actuator",
        "camera",
        "decision",
        "lane-detector",
        "lane-lines",
        "lidar-sectors",
        "mcu-link",
        "rplidar",
        "sim-mcu",
        "sim-rplidar",
        "sim-world",
        "traffic-light",
    ] {
        assert!(list.lines().any(|line| line.starts_with(kind)), "`{kind}` in\n{list}");
    }
    let lane = sandbox.carril(&["operators", "lane-detector"]).expect(0);
    for part in ["image", "carril/Image", "carril/LaneEstimate", "row_far", "default 0.75"] {
        assert!(lane.contains(part), "`{part}` in\n{lane}");
    }
    let error = sandbox.carril(&["operators", "lane-detecter"]).expect_error(1);
    assert!(error.contains("did you mean `lane-detector`?"), "{error}");
}

#[test]
fn a_reader_that_goes_away_ends_the_command_quietly() {
    let sandbox = Sandbox::new();
    let mut child = sandbox
        .command(&["schema"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("it starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("it ends");
    assert_eq!((output.status.code(), &output.stderr[..]), (Some(0), &b""[..]), "as `carril schema | head -0`");
}
