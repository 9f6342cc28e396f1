//! Help texts and wrong command lines: what a user sees who has only the binary.

mod support;

use support::Sandbox;

const COMMANDS: [&str; 25] = [
    "check",
    "graph",
    "schema",
    "operators",
    "run",
    "sim",
    "scenarios",
    "list",
    "info",
    "echo",
    "hz",
    "bw",
    "delay",
    "top",
    "pub",
    "params",
    "get",
    "set",
    "rollback",
    "shadow",
    "swap",
    "start",
    "stop",
    "estop",
    "reset",
];

#[test]
fn help_lists_every_command() {
    let help = Sandbox::new().carril(&["--help"]).expect(0);
    for command in COMMANDS {
        assert!(
            help.lines().any(|line| line.trim_start().starts_with(&format!("{command} "))),
            "`{command}` in\n{help}"
        );
    }
    assert!(!help.contains("run-dir"), "what the supervisor starts is not for people:\n{help}");
    insta::assert_snapshot!("help", help);
}

#[test]
fn every_command_has_help_with_examples() {
    let sandbox = Sandbox::new();
    for command in COMMANDS {
        let help = sandbox.carril(&[command, "--help"]).expect(0);
        assert!(help.contains(&format!("Usage: carril {command}")), "`{command}`:\n{help}");
        let (_, examples) = help.split_once("Example").unwrap_or_else(|| panic!("`{command}` has no example:\n{help}"));
        assert!(examples.contains(&format!("carril {command}")), "an example of `{command}` itself:\n{help}");
    }
}

#[test]
fn overrides_in_examples_exist() {
    let sandbox = Sandbox::new();
    let mut tried = 0;
    for command in ["run", "sim"] {
        let help = sandbox.carril(&[command, "--help"]).expect(0);
        let (_, examples) = help.split_once("Examples").expect("it has examples");
        let words: Vec<&str> = examples.split_whitespace().collect();
        for set in words.windows(2).filter(|pair| pair[0] == "--set") {
            sandbox.carril(&["check", "dataflow.yaml", "--set", set[1]]).expect(0);
            tried += 1;
        }
    }
    assert!(tried >= 3, "the examples have lost their overrides: {tried}");
}

#[test]
fn wrong_command_lines_end_with_2() {
    let sandbox = Sandbox::new();
    let wrong: [&[&str]; 9] = [
        &[],
        &["chekc"],
        &["check"],
        &["check", "dataflow.yaml", "--colour"],
        &["check", "dataflow.yaml", "--set", "lane=3"],
        &["run", "dataflow.yaml", "--for", "30"],
        &["hz"],
        &["echo", "lane/lane", "-n", "0"],
        &["graph", "dataflow.yaml", "--format", "svg"],
    ];
    for args in wrong {
        let error = sandbox.carril(args).expect_error(2);
        assert!(!error.is_empty(), "{args:?} says nothing");
    }
}

#[test]
fn a_mistyped_command_gets_a_suggestion() {
    let error = Sandbox::new().carril(&["chekc"]).expect_error(2);
    assert!(error.contains("'check'"), "{error}");
}

#[test]
fn a_span_without_a_unit_says_what_is_allowed() {
    let error = Sandbox::new().carril(&["run", "dataflow.yaml", "--for", "30"]).expect_error(2);
    assert!(error.contains("500ms, 30s or 2m"), "{error}");
}

#[test]
fn a_missing_graph_file_is_a_wrong_command_line() {
    let error = Sandbox::new().carril(&["check", "datafow.yaml"]).expect_error(2);
    assert!(
        error.contains("there is no file `datafow.yaml`") && error.contains("did you mean `dataflow.yaml`?"),
        "{error}"
    );
}

#[test]
fn without_a_run_every_command_says_how_to_start_one() {
    let sandbox = Sandbox::new();
    let lines: [&[&str]; 10] = [
        &["list"],
        &["info", "lane"],
        &["echo", "lane/lane"],
        &["hz", "lane/lane"],
        &["bw", "lane/lane"],
        &["delay", "lane/lane"],
        &["top", "-n", "1"],
        &["pub", "decision/goal", "{}"],
        &["estop"],
        &["start"],
    ];
    for args in lines {
        let error = sandbox.carril(args).expect_error(1);
        assert!(error.contains("carril run dataflow.yaml"), "{args:?}: {error}");
        assert_eq!(error.lines().filter(|line| line.starts_with("error: ")).count(), 1, "one error: {error}");
    }
}
