//! Reads the good and bad graph files of `tests/dataflows`. The expected texts of the bad ones are renewed by
//! `CARRIL_UPDATE=1 cargo test --release -p carril-runtime --no-default-features --test graph_files`.

mod support;

use std::path::{Path, PathBuf};
use std::time::Duration;

use carril_runtime::graph::{Graph, OnOverrun, Override, Problems, ReadOptions, RestartPolicy};

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
}
