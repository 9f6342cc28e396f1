//! Operators in binaries of the user's own: `carril new operator` writes one that builds, is checked and drives; binaries that are
//! not what they should be are named by `carril check`, at the line that names them.

mod support;

use std::path::{Path, PathBuf};

use serde_json::Value;
use support::{Sandbox, cargo, program, project, project_file, thorough};

/// The default graph with a binary in the place of its lane detector, and patience for a shared test machine.
fn graph_with(sandbox: &Sandbox, exec: &Path, rest: &str) -> String {
    let text = std::fs::read_to_string(project_file("dataflow.yaml")).expect("the default graph is there");
    let changes = [
        ("operator: lane-detector", format!("exec: {}", exec.display())),
        ("    config: { threshold: 190, row_far: 0.75, row_near: 0.85 }\n", rest.to_owned()),
        ("    deadline_ms: 10\n", String::new()),
        ("tracks/oval.yaml", project_file("tracks/oval.yaml")),
        ("lease_ms: 200", "lease_ms: 1500".to_owned()),
        ("max_age_ms: 100", "max_age_ms: 3000".to_owned()),
        ("auto_start: true", "auto_start: true, lane_timeout_ms: 1500, sectors_timeout_ms: 3000".to_owned()),
    ];
    let text = changes.iter().fold(text, |text, (from, to)| {
        assert!(text.contains(from), "the default graph has `{from}`");
        text.replace(from, to)
    });
    sandbox.write("own.yaml", text).display().to_string()
}

/// Runs a graph for some seconds and gives what the car did.
#[track_caller]
fn drive(sandbox: &Sandbox, graph: &str) -> Value {
    let (duration, distance_m) = thorough::count(("6s", 1.0), ("12s", 2.0));
    let stdout = sandbox.carril(&["run", graph, "--for", duration, "--json"]).expect(0);
    let last: Value = serde_json::from_str(stdout.lines().last().expect("a summary")).expect("the summary is JSON");
    let progress = &last["summary"]["progress"];
    assert_eq!((&progress["departures"], &progress["collisions"]), (&0.into(), &0.into()), "in its lane: {last}");
    assert!(progress["distance_m"].as_f64() > Some(distance_m), "{duration} are more than {distance_m} m: {last}");
    last
}

/// Cargo for a crate outside the workspace, so that it uses what the workspace has compiled: the same features (those of `carril`,
/// which as a dependency without a library adds nothing else) and the same profile.
fn align_with_workspace(manifest: &Path) {
    let text = std::fs::read_to_string(manifest).expect("it was written");
    let own = format!("[dependencies]\ncarril = {{ path = \"{}\" }}\n", project().display());
    std::fs::write(manifest, text.replace("[dependencies]\n", &own)).expect("ours");
}

fn build(command: &str, manifest: &Path) -> String {
    let manifest = manifest.display().to_string();
    let mut cargo = cargo(&[command, "--manifest-path", &manifest]);
    let output = cargo.env("CARGO_PROFILE_RELEASE_CODEGEN_UNITS", "16").output().expect("cargo starts");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "cargo {command}:\n{said}\n{}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn a_new_operator_builds_passes_its_tests_is_checked_and_drives() {
    let sandbox = Sandbox::new();
    let crate_dir = sandbox.path().join("sketched-lane");
    let (path, runtime) = (crate_dir.display().to_string(), project_file("runtime"));
    let written = sandbox.carril(&["new", "operator", "sketched-lane", "--path", &path, "--runtime-path", &runtime]);
    let steps = written.expect(0);
    for part in ["cargo build --release", "exec: ", "carril swap lane --exec", "carril check"] {
        assert!(steps.contains(part), "`{part}` in the next steps:\n{steps}");
    }
    let manifest = crate_dir.join("Cargo.toml");
    // It compiles Zenoh once more: its dependencies have other features.
    if !thorough::is_thorough() {
        assert!(manifest.is_file() && crate_dir.join("src/main.rs").is_file(), "a crate is there");
        return;
    }
    align_with_workspace(&manifest);
    let tests = build("test", &manifest);
    assert!(tests.contains("test result: ok") && !tests.contains("running 0 tests"), "its own tests: {tests}");
    build("build", &manifest);
    let binary = Path::new(env!("CARGO_BIN_EXE_carril")).with_file_name("sketched-lane");
    let graph = graph_with(&sandbox, &binary, "    config: { level: 0.6 }\n");
    sandbox.carril(&["check", &graph]).expect(0);
    drive(&sandbox, &graph);
    // It stands in the workspace's own target folder.
    std::fs::remove_file(binary).expect("ours");
}

#[test]
fn the_example_drives_and_is_known_to_every_command() {
    let sandbox = Sandbox::new();
    let graph = graph_with(&sandbox, &program("my-lane"), "");
    drive(&sandbox, &graph);
    let drawn: Value =
        serde_json::from_str(&sandbox.carril(&["graph", &graph, "--format", "json"]).expect(0)).expect("JSON");
    let lane =
        drawn["nodes"].as_array().and_then(|nodes| nodes.iter().find(|node| node["name"] == "lane")).expect("a node");
    assert_eq!(lane["operator"], "my-lane", "{lane}");
    assert_eq!(lane["outputs"][0]["type"], "carril/LaneEstimate v2", "{lane}");
    let run = sandbox.launch(&graph, &[]);
    let info: Value = serde_json::from_str(&sandbox.carril(&["info", "lane", "--json"]).expect(0)).expect("JSON");
    assert_eq!(info["node"]["operator"], "my-lane", "{info}");
    assert!(info["node"]["exec"].as_str().is_some_and(|path| path.ends_with("/my-lane")), "{info}");
    assert_eq!(run.interrupt().code, Some(0), "Ctrl-C ends in order");
}

/// What `carril check` says of a graph whose `lane` is this binary.
#[track_caller]
fn refused(exec: &Path, rest: &str) -> String {
    let sandbox = Sandbox::new();
    let graph = graph_with(&sandbox, exec, rest);
    let said = sandbox.carril(&["check", &graph]).expect(1);
    let text = std::fs::read_to_string(&graph).expect("it was written");
    let node = text.lines().position(|line| line.contains("exec: ")).expect("the node is there");
    // Line numbers begin at 1; the node has at most three lines below `exec`.
    let in_node = |line: usize| said.contains(&format!("own.yaml:{line}:"));
    assert!((node + 1..=node + 4).any(in_node), "the place of the node:\n{said}");
    said
}

#[test]
fn a_binary_checks_its_own_configuration() {
    let bad = program("bad-operators");
    let said =
        refused(&bad, "    operator: bad-lane\n    config: { refuse_config: true, slow_ms: -1, panic_att: 3 }\n");
    for part in [
        "config: unknown key `panic_att`",
        "did you mean `panic_at`?",
        "config `refuse_config`: got true, allowed is false",
        "config `slow_ms`: got -1 ms, allowed is 0 to 10000 ms",
    ] {
        assert!(said.contains(part), "`{part}` in:\n{said}");
    }
    let said = refused(&bad, "    operator: bad-lane\n    config: { die_at_check: true }\n");
    assert!(said.contains("--check-config` failed (exit status: 101)"), "{said}");
}

#[test]
fn ports_that_do_not_fit_are_named() {
    let said = refused(&program("bad-operators"), "    operator: other-ports\n");
    let types = "input `image` takes `carril/LaserScan v1`, but `world/camera` gives `carril/Image v1`";
    assert!(said.contains(types), "{said}");
    assert!(said.contains("input `lane` reads `lane/lane`, which nothing publishes"), "{said}");
    assert!(said.contains("did you mean `lane/lanes`?"), "{said}");
}

#[test]
fn a_binary_with_several_operators_wants_a_name() {
    let said = refused(&program("bad-operators"), "");
    assert!(said.contains("has several operators: `bad-lane`, `other-ports`"), "{said}");
    assert!(said.contains("operator: bad-lane"), "what to do: {said}");
}

#[test]
fn programs_that_are_no_operators_are_named() {
    let carril = PathBuf::from(env!("CARGO_BIN_EXE_carril"));
    for (exec, says) in [
        (PathBuf::from("/bin/true"), "wrote no answer: it is empty"),
        (carril, "failed (exit status: 2)"),
        (PathBuf::from("./no-such-program"), "does not exist"),
    ] {
        let said = refused(&exec, "");
        assert!(said.contains(says), "{}: `{says}` in:\n{said}", exec.display());
    }
}

#[test]
fn what_cannot_start_ends_the_run_with_its_reason() {
    let sandbox = Sandbox::new();
    let rest = "    operator: bad-lane\n    config: { refuse_setup: true }\n";
    let graph = graph_with(&sandbox, &program("bad-operators"), rest);
    let error = sandbox.carril(&["run", &graph, "--for", "10s"]).expect_error(1);
    assert!(error.contains("operator `bad-lane` cannot start: told to refuse"), "{error}");
}

#[test]
fn a_new_operator_overwrites_nothing_and_has_a_sound_name() {
    let sandbox = Sandbox::new();
    let runtime = project_file("runtime");
    let new =
        |name: &str, path: &str| sandbox.carril(&["new", "operator", name, "--path", path, "--runtime-path", &runtime]);
    let path = sandbox.path().join("taken").display().to_string();
    std::fs::create_dir(&path).expect("ours");
    let error = new("my-filter", &path).expect_error(1);
    assert!(error.contains("is there already") && error.contains("--path"), "{error}");
    assert_eq!(std::fs::read_dir(&path).expect("ours").count(), 0, "nothing was written");
    for name in ["My-Lane", "fn", "a--b", "../x"] {
        let error = new(name, &sandbox.path().join("new").display().to_string()).expect_error(2);
        assert!(error.contains(name) && error.contains("allowed are"), "{name}: {error}");
    }
    let outcome = sandbox.carril(&["new", "operator", "x", "--path", "/tmp/x", "--runtime-path", "/tmp"]);
    assert!(outcome.expect_error(2).contains("`/tmp` is not the crate `carril-runtime`"), "another crate");
}
