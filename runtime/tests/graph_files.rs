//! Reads the good and bad graph files of `tests/dataflows`. The expected texts of the bad ones are renewed by
//! `CARRIL_UPDATE=1 cargo test --release -p carril-runtime --no-default-features --test graph_files`.

mod support;
#[path = "../../tests/support/thorough.rs"]
mod thorough;

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use carril_runtime::Registry;
use carril_runtime::graph::calibration::CalibrationText;
use carril_runtime::graph::{Graph, OnOverrun, Override, Problems, ReadOptions, RestartPolicy, render};
use proptest::prelude::*;
use serde_json::Value;

const UPDATE: &str = "CARRIL_UPDATE=1 cargo test --release -p carril-runtime --no-default-features --test graph_files";

fn dataflows() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/dataflows")
}

fn yaml_files(folder: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dataflows().join(folder)).expect("the folder is part of the repository");
    let mut files: Vec<_> = entries.map(|entry| entry.expect("a readable folder").path()).collect();
    files.retain(|path| path.extension().is_some_and(|ext| ext == "yaml"));
    files.sort();
    files
}

fn read(path: &Path) -> Result<Graph, Problems> {
    Graph::read(path, &support::registry(), &ReadOptions::default())
}

#[test]
fn reads_every_good_file() {
    let files = yaml_files("good");
    assert!(!files.is_empty(), "there are good files");
    for path in files {
        if let Err(problems) = read(&path) {
            panic!("{} must be clean:\n{problems}", path.display());
        }
    }
}

#[test]
fn keeps_what_the_file_says() {
    let graph = read(&dataflows().join("good/oval.yaml")).expect("a good file");
    let names: Vec<_> = graph.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(
        names,
        ["world", "lane", "sectors", "decision", "actuator", "bridge", "mcu"],
        "in the order of the file"
    );
    assert_eq!(graph.processes(), ["world", "vision", "decision", "actuator", "bridge", "mcu"], "processes");
    let lane = graph.node("lane").expect("it is there");
    assert_eq!(lane.deadline, Some(Duration::from_millis(10)), "deadline");
    assert_eq!(
        (lane.on_overrun, lane.restart.policy, lane.restart.max),
        (OnOverrun::Warn, RestartPolicy::OnFailure, 5),
        "lane"
    );
    assert_eq!(lane.config["threshold"], 190, "config");
    let sectors = &graph.node("decision").expect("it is there").inputs[1];
    assert_eq!((sectors.queue.capacity, sectors.max_age), (4, Some(Duration::from_millis(500))), "edge");
    let world = graph.node("world").expect("it is there");
    assert_eq!(world.inputs[0].delay, Some(Duration::from_millis(5)), "delay");
    assert_eq!(world.period, Some(Duration::from_secs_f64(1.0 / 30.0)), "the operator's own period");
    assert_eq!(graph.node("mcu").and_then(|node| node.period), Some(Duration::from_millis(2)), "the file's period");
    let bridge = graph.node("bridge").expect("it is there");
    assert_eq!((bridge.priority, &bridge.cpus[..], bridge.lock_memory), (Some(50), &[0, 1][..], true), "bridge");
    assert_eq!((graph.budgets.len(), graph.budgets[0].stops, graph.budgets[1].stops), (2, true, false), "budgets");
    assert!(graph.warnings.is_empty(), "nothing strange: {}", graph.warnings);
}

/// Problems as people see them, without the folder of this machine.
fn rendered(problems: &Problems, folder: &Path) -> String {
    problems.to_string().replace(&format!("{}/", folder.display()), "")
}

#[test]
fn says_what_is_wrong_with_every_bad_file() {
    let folder = dataflows().join("bad");
    let (mut wrong, mut rules) = (Vec::new(), std::collections::BTreeSet::new());
    for path in yaml_files("bad") {
        let got = match read(&path) {
            Ok(graph) if graph.warnings.is_empty() => panic!("{} must not be clean", path.display()),
            Ok(graph) => graph.warnings,
            Err(problems) => problems,
        };
        rules.extend(got.iter().map(|problem| problem.rule));
        let expected = path.with_extension("expected");
        let text = rendered(&got, &folder);
        if std::env::var_os("CARRIL_UPDATE").is_some() {
            std::fs::write(&expected, &text).expect("the folder is writable");
        }
        if std::fs::read_to_string(&expected).unwrap_or_default() != text {
            wrong.push(format!("{}:\n{text}", path.display()));
        }
    }
    assert!(wrong.is_empty(), "renew and review with `{UPDATE}`:\n{}", wrong.join("\n"));
}

#[test]
fn overrides_change_the_config_and_name_themselves_in_problems() {
    let path = dataflows().join("good/oval.yaml");
    let with = |texts: &[&str]| {
        let overrides = texts.iter().map(|text| Override::parse(text).expect("a valid override")).collect();
        Graph::read(&path, &support::registry(), &ReadOptions { overrides, ..ReadOptions::default() })
    };
    let graph = with(&["lane.threshold=180", "decision.gains.angle=1.5"]).expect("both are allowed");
    assert_eq!(
        graph.node("lane").map(|node| node.config["threshold"].clone()),
        Some(180.into()),
        "a value that was there"
    );
    assert_eq!(graph.node("decision").map(|node| node.config["gains"]["angle"].clone()), Some(1.5.into()), "a new one");
    let problems = with(&["lane.threshold=300", "lnae.x=1", "lane.row_far=.nan"]).expect_err("all three are wrong");
    let json = problems.to_json();
    let files: Vec<_> = json.as_array().expect("a list").iter().map(|problem| problem["file"].clone()).collect();
    assert_eq!(problems.errors(), 3, "{problems}");
    assert!(
        files.contains(&"--set lane.threshold=300".into()),
        "the override stands in the place of a file: {files:?}"
    );
    assert!(problems.to_string().contains("did you mean `lane`?"), "{problems}");
    let problems =
        with(&["lane.threshold.low=1", "lane.bands=[]", "lane.bands.0.from=1"]).expect_err("two have no place");
    let rules: Vec<_> = problems.iter().map(|problem| (problem.rule, problem.file.as_str())).collect();
    let expected = [("wrong-override", "--set lane.threshold.low=1"), ("wrong-override", "--set lane.bands.0.from=1")];
    assert_eq!(rules, expected, "{problems}");
}

/// A graph beside its calibration file.
fn calibrated(calibration: &str, overrides: &[&str]) -> Result<Graph, Problems> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let graph = std::fs::read_to_string(dataflows().join("good/oval.yaml")).expect("a good file");
    let graph = graph.replace("../track.txt", &dataflows().join("track.txt").display().to_string());
    let path = folder.path().join("graph.yaml");
    std::fs::write(&path, format!("calibration: car1.calibration.yaml\n{graph}")).expect("writable");
    std::fs::write(folder.path().join("car1.calibration.yaml"), calibration).expect("writable");
    let overrides = overrides.iter().map(|text| Override::parse(text).expect("a valid override")).collect();
    Graph::read(&path, &support::registry(), &ReadOptions { overrides, ..ReadOptions::default() })
}

#[test]
fn calibration_goes_over_the_configuration_and_overrides_go_over_both() {
    let text = "nodes:\n  lane: { threshold: 175, bands: [] }\n  sectors:\n  decision: { gains: { angle: 1.5 } }\n";
    let config = |graph: &Graph, node: &str, key: &str| graph.node(node).map(|node| node.config[key].clone());
    let graph = calibrated(text, &[]).expect("allowed values");
    assert!(graph.calibration.as_ref().is_some_and(|path| path.ends_with("car1.calibration.yaml")), "its path");
    assert!(graph.warnings.is_empty(), "{}", graph.warnings);
    assert_eq!(config(&graph, "lane", "threshold"), Some(175.into()), "in the place of 190");
    assert_eq!(config(&graph, "lane", "row_far"), Some(0.75.into()), "what is not calibrated stays");
    assert_eq!(graph.node("decision").map(|node| node.config["gains"]["angle"].clone()), Some(1.5.into()), "new");
    assert_eq!(config(&graph, "decision", "auto_start"), Some(true.into()), "beside what was there");
    let graph = calibrated(text, &["lane.threshold=160"]).expect("allowed values");
    assert_eq!(config(&graph, "lane", "threshold"), Some(160.into()), "--set goes over both");
    for empty in ["", "# nothing yet\n", "nodes:\nrecords:\n", "nodes: {}"] {
        let graph = calibrated(empty, &[]).unwrap_or_else(|problems| panic!("{empty:?}: {problems}"));
        assert_eq!(config(&graph, "lane", "threshold"), Some(190.into()), "{empty:?}: nothing is calibrated");
    }
}

#[test]
fn a_wrong_calibration_is_told_at_its_own_line_beside_other_problems() {
    let problems =
        calibrated("nodes:\n  lane:\n    threshold: 300\n", &["lane.row_far=-1"]).expect_err("both are wrong");
    let places: Vec<_> = problems.iter().map(|problem| (problem.file.as_str(), problem.line, problem.column)).collect();
    assert_eq!(places.len(), 2, "{problems}");
    assert!(places[0].0.ends_with("car1.calibration.yaml"), "{places:?}");
    assert_eq!(
        (places[0].1, places[0].2, places[1]),
        (Some(3), Some(16), ("--set lane.row_far=-1", None, None)),
        "places"
    );
    let problems = calibrated(&"# x\n".repeat(300_000), &[]).expect_err("too large").to_string();
    assert!(problems.contains("a calibration file has at most 1048576 B"), "{problems}");
}

#[test]
fn a_calibration_can_be_tried_before_it_is_written() {
    let path = dataflows().join("good/oval.yaml");
    let with = |text: &str| {
        let calibration = Some(CalibrationText { path: "new.yaml".into(), text: text.to_owned() });
        Graph::read(&path, &support::registry(), &ReadOptions { calibration, ..ReadOptions::default() })
    };
    let graph = with("nodes: { lane: { threshold: 175 } }").expect("an allowed value");
    assert_eq!(graph.node("lane").map(|node| node.config["threshold"].clone()), Some(175.into()), "in force");
    let problems = with("nodes: { lane: { threshold: 375 } }").expect_err("too large").to_string();
    assert!(problems.contains("new.yaml:1:29"), "{problems}");
}

/// Compares with a committed file, or renews it.
fn same_as_file(path: &Path, text: &str) {
    if std::env::var_os("CARRIL_UPDATE").is_some() {
        std::fs::write(path, text).expect("the folder is writable");
    }
    let committed = std::fs::read_to_string(path).unwrap_or_default();
    assert!(
        committed == text,
        "{} has drifted; renew and review it with `{UPDATE}`. It should be:\n{text}",
        path.display()
    );
}

#[test]
fn the_committed_schema_is_that_of_the_code() {
    let schema = carril_runtime::graph::schema(&Registry::new());
    let text = serde_json::to_string_pretty(&schema).expect("JSON serialises") + "\n";
    same_as_file(&Path::new(env!("CARGO_MANIFEST_DIR")).join("schema/dataflow.schema.json"), &text);
}

/// Every reference of a schema leads somewhere.
fn check_references(value: &Value, root: &Value) {
    match value {
        Value::Object(map) => {
            if let Some(Value::String(target)) = map.get("$ref") {
                let pointer = target.trim_start_matches('#');
                assert!(root.pointer(pointer).is_some(), "`{target}` leads nowhere");
            }
            map.values().for_each(|value| check_references(value, root));
        }
        Value::Array(items) => items.iter().for_each(|item| check_references(item, root)),
        _ => {}
    }
}

#[test]
fn the_schema_knows_the_operators_it_is_given() {
    let schema = carril_runtime::graph::schema(&support::registry());
    check_references(&schema, &schema);
    let node = &schema["$defs"]["Node"];
    let rules = node["allOf"].as_array().expect("a list");
    let built_in =
        rules.iter().find(|rule| rule["if"]["not"]["required"][0] == "exec" && rule["if"]["required"].is_null());
    let names = &built_in.expect("a rule for built-in operators")["then"]["properties"]["operator"]["enum"];
    assert!(names.as_array().expect("a list").contains(&"lane-detector".into()), "{names:?}");
    let lane = rules.iter().find(|kind| kind["if"]["properties"]["operator"]["const"] == "lane-detector");
    let lane = &lane.expect("one per operator")["then"]["properties"];
    assert_eq!(lane["config"]["properties"]["bands"]["items"]["$ref"], "#/$defs/lane-detector.Band", "nested types");
    assert!(lane["inputs"]["properties"]["image"].is_object(), "ports: {}", lane["inputs"]);
}

#[test]
fn a_binary_is_known_like_an_operator_of_ours() {
    let graph = read(&dataflows().join("good/exec.yaml")).expect("a good file");
    let mine = graph.node("mine").expect("it is there");
    let kind = mine.kind().expect("its binary tells it");
    assert_eq!((kind.name, kind.state_version), ("steer", 1), "from its description");
    assert_eq!(mine.exec(), Some(dataflows().join("good/../run-me.sh").as_path()), "from the folder of the file");
    assert_eq!(mine.period, Some(Duration::from_millis(20)), "its own period, asked with its configuration");
    assert!(kind.inputs[1].external && !kind.inputs[1].triggers, "flags of ports: {:?}", kind.inputs[1]);
    let setup = carril_runtime::Setup::for_tests("mine");
    let error = kind.build(Value::Null, &setup).err().expect("it is not in this program").to_string();
    assert!(error.starts_with("`steer` runs only in its own binary"), "{error}");
    assert_eq!(graph.node("quiet").and_then(|node| node.kind()).map(|kind| kind.name), Some("idle"), "one of several");
    let json = render::to_json(&graph);
    let edge = json["edges"].as_array().and_then(|edges| edges.iter().find(|edge| edge["from"] == "mine/command"));
    assert_eq!(edge.map(|edge| edge["type"].clone()), Some("carril/Command v1".into()), "the type on its edge");
    assert_eq!(json["nodes"][1]["operator"], "steer", "{}", json["nodes"][1]);
}

/// A car whose lane detector, a binary of the user's own, is on a laptop.
fn two_machines(machine: Option<&str>) -> Result<Graph, Problems> {
    let text = "\
robot: car1
remote: {}
nodes:
  world: { operator: sim-world, config: { track: only/on/the/car.yaml } }
  mine: { exec: ../only/on/the/laptop, machine: laptop, inputs: { image: world/camera } }
  fast: { operator: lane-detector, machine: laptop, inputs: { image: { from: world/camera, max_age_ms: 80 } } }
  decision: { operator: decision, inputs: { lane: mine/lane, sectors: sectors/sectors } }
  sectors: { operator: lidar-sectors, inputs: { scan: world/scan } }
";
    let options = ReadOptions { machine: machine.map(str::to_owned), ..ReadOptions::default() };
    Graph::parse(text.to_owned(), &dataflows().join("good/x.yaml"), &support::registry(), &options)
}

#[test]
fn each_machine_needs_only_what_it_runs_itself() {
    let on_car = two_machines(None).expect_err("the car needs its track").to_string();
    assert!(on_car.contains("car.yaml` does not exist") && !on_car.contains("missing-executable"), "{on_car}");
    let on_laptop = two_machines(Some("laptop")).expect_err("the laptop needs its binary").to_string();
    assert!(on_laptop.contains("missing-executable") && !on_laptop.contains("car.yaml"), "{on_laptop}");
    let misspelt = two_machines(Some("lapotp")).expect_err("there is no such machine").to_string();
    assert!(misspelt.contains("--machine lapotp") && misspelt.contains("did you mean `laptop`?"), "{misspelt}");
}

#[test]
fn what_comes_from_another_machine_has_a_limit_of_age() {
    let path = dataflows().join("../../dataflows/two-machines.yaml");
    let text = std::fs::read_to_string(&path).expect("a shipped graph").replace("sim:mcu", "/dev/x");
    let text = text.replace(", seed: 1", "").replace("track: ../tracks/oval.yaml", "seed: 1");
    let text = text.split("budgets:").next().expect("before them").to_owned() + "remote: {}\n";
    let text = text.lines().filter(|line| !line.contains("config:")).collect::<Vec<_>>().join("\n");
    let graph = Graph::parse(text, &path, &support::registry(), &ReadOptions::default()).expect("it passes");
    let limit = |node: &str, input: &str| {
        let node = graph.node(node).expect("it is there");
        node.inputs.iter().find(|edge| edge.input == input).expect("connected").max_age
    };
    assert_eq!(limit("lane", "image"), Some(Duration::from_millis(500)), "to the laptop");
    assert_eq!(limit("decision", "lane"), Some(Duration::from_millis(500)), "and back");
    assert_eq!(limit("decision", "sectors"), None, "within the car");
    assert_eq!((graph.machines(), graph.processes_on(Some("laptop"))), (vec!["laptop"], vec!["lane"]), "there");
    assert_eq!(graph.processes_on(None).len(), 6, "here");
    assert!(render::to_mermaid(&graph).contains("lane<br/>lane-detector<br/>on laptop"), "drawn");
}

#[test]
fn a_program_built_with_the_runtime_describes_its_operators() {
    let description = carril_runtime::describe::of(&support::registry());
    let text = serde_json::to_string(&description).expect("JSON serialises");
    let back: carril_runtime::describe::Description = serde_json::from_str(&text).expect("and back");
    assert_eq!(back, description, "the same both ways");
    let lane = description.operators.iter().find(|operator| operator.name == "lane-detector").expect("registered");
    assert_eq!((lane.inputs[0].name, lane.has_defaults), ("image", true), "{lane:?}");
}

#[test]
fn draws_graphs() {
    let graph = read(&dataflows().join("good/oval.yaml")).expect("a good file");
    let folder = dataflows().join("drawn");
    same_as_file(&folder.join("oval.mmd"), &render::to_mermaid(&graph));
    same_as_file(&folder.join("oval.dot"), &render::to_dot(&graph));
    let json = serde_json::to_string_pretty(&render::to_json(&graph)).expect("JSON serialises") + "\n";
    same_as_file(&folder.join("oval.json"), &json);
    let exec = read(&dataflows().join("good/exec.yaml")).expect("a good file");
    let json = render::to_json(&exec);
    assert_eq!(json["edges"][1]["type"], "carril/Command v1", "the reader tells the type of an unknown writer: {json}");
    assert_eq!(
        exec.node("bridge").map(|node| node.restart.policy),
        Some(RestartPolicy::Always),
        "one restart per process"
    );
}

#[test]
fn refuses_a_file_of_ten_megabytes_without_reading_it_all() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("large.yaml");
    std::fs::write(&path, "# x\n".repeat(2_621_440)).expect("writable");
    let problems = read(&path).expect_err("too large");
    let problem = problems.iter().next().expect("one problem");
    assert_eq!(problem.message, "the file has 10485760 B, a graph file has at most 1048576 B", "{problems}");
    let problems = read(&folder.path().join("absent.yaml")).expect_err("not there");
    assert_eq!(problems.iter().next().map(|problem| problem.rule), Some("unreadable-file"), "{problems}");
    let problems = read(folder.path()).expect_err("a folder");
    assert_eq!(problems.iter().next().map(|problem| problem.rule), Some("unreadable-file"), "{problems}");
}

#[test]
fn a_file_full_of_problems_is_answered_with_the_first_hundred() {
    let mut text = String::from("robot: car1\nnodes:\n");
    for node in 0..15_000 {
        writeln!(text, "  n{node}: {{ operator: nonsense, inputs: {{ a: b{node}/c }} }}")
            .expect("a string takes everything");
    }
    let problems = Graph::parse(text, Path::new("full.yaml"), &support::registry(), &ReadOptions::default());
    let problems = problems.expect_err("nothing is right");
    assert_eq!(problems.iter().count(), 100, "the rest would push the first off the screen");
    assert!(problems.errors() >= 15_000, "but is counted: {}", problems.summary());
}

#[test]
fn devices_are_looked_for_only_when_asked() {
    let text = "robot: car1\nnodes: { camera: { operator: camera, config: { source: /dev/no-such-camera } } }\n";
    let parse = |probe_devices| {
        let options = ReadOptions { probe_devices, ..ReadOptions::default() };
        Graph::parse(text.to_owned(), Path::new("camera.yaml"), &support::registry(), &options)
    };
    assert!(parse(false).is_ok(), "a graph can be checked on another machine");
    let problems = parse(true).expect_err("no such device");
    assert!(problems.to_string().contains("no device at `/dev/no-such-camera`"), "{problems}");
}

#[test]
fn problems_serialise_for_programs() {
    let problems = read(&dataflows().join("bad/unknown-operator.yaml")).expect_err("a bad file");
    let json = &problems.to_json()[0];
    assert_eq!((&json["line"], &json["column"]), (&5.into(), &15.into()), "{json}");
    assert_eq!((&json["severity"], &json["rule"]), (&"error".into(), &"unknown-operator".into()), "{json}");
    assert_eq!(json["hint"], "did you mean `lane-detector`?", "{json}");
    assert!(json["file"].as_str().is_some_and(|file| file.ends_with("bad/unknown-operator.yaml")), "{json}");
    assert!(json["message"].is_string() && json.as_object().is_some_and(|map| map.len() == 7), "{json}");
}

/// A good or bad file with some bytes changed, removed or doubled.
fn mutated(seed: u64) -> Vec<u8> {
    let mut files = yaml_files("good");
    files.extend(yaml_files("bad"));
    let mut random = seed;
    let mut below = |n: usize| (support::next_random(&mut random) % n.max(1) as u64) as usize;
    let mut bytes = std::fs::read(&files[below(files.len())]).expect("readable");
    for _ in 0..=below(8) {
        let at = below(bytes.len() + 1);
        let end = (at + below(12)).min(bytes.len());
        match below(4) {
            0 => drop(bytes.splice(at..end, [])),
            1 => drop(bytes.splice(at..at, b"{}[]:,&*!|>'\"-#\n \t~0.".iter().copied().skip(below(20)).take(2))),
            2 => {
                let part = bytes[at..end].to_vec();
                drop(bytes.splice(at..at, part));
            }
            _ => bytes.iter_mut().skip(at).take(1).for_each(|byte| *byte = below(256) as u8),
        }
    }
    bytes
}

/// Every problem can be shown, and stands in the file.
fn check_problems(text: &str) {
    let lines = text.split('\n').count();
    let result =
        Graph::parse(text.to_owned(), &dataflows().join("good/x.yaml"), &support::registry(), &ReadOptions::default());
    if let Err(problems) = result {
        assert!(problems.errors() > 0 && !problems.to_string().is_empty(), "no graph, no problem: {text:?}");
        for problem in &problems {
            assert!(problem.line.is_none_or(|line| line >= 1 && line <= lines), "{problem}\n{text:?}");
        }
    }
}

#[test]
fn mutated_files_never_panic() {
    for seed in 0..thorough::count(300, 3000) {
        check_problems(&String::from_utf8_lossy(&mutated(seed)));
    }
}

proptest! {
    #[test]
    fn random_text_never_panics(text in any::<String>()) {
        check_problems(&text);
    }

    #[test]
    fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("random.yaml");
        std::fs::write(&path, bytes).expect("writable");
        prop_assert!(read(&path).is_err(), "random bytes are no graph");
    }
}
