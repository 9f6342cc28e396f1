//! Scenario files, good and bad, on a graph of one node.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::*;
use crate::{
    Context, Findings, NoInputs, NoOutputs, NoState, Operator, OperatorConfig, Registry, Setup, SetupError, StateError,
    StepError,
};

#[derive(Debug, Default, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct GainConfig {
    gain: f64,
}

impl OperatorConfig for GainConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("gain", self.gain, 0.0, 2.0, "");
    }
}

struct Gain;

impl Operator for Gain {
    const KIND: &'static str = "gain";
    const SUMMARY: &'static str = "Does nothing";
    type Config = GainConfig;
    type Inputs = NoInputs;
    type Outputs = NoOutputs;
    type State = NoState;

    fn new(_config: GainConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, _: &mut NoInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
        Ok(())
    }

    fn snapshot(&self) -> NoState {
        NoState
    }

    fn restore(&mut self, _: NoState) -> Result<(), StateError> {
        Ok(())
    }

    fn period(_: &GainConfig) -> Option<std::time::Duration> {
        Some(std::time::Duration::from_millis(10))
    }
}

/// A folder with a graph, and the scenario beside it.
struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("g.yaml"), "robot: car1\nnodes:\n  one: { operator: gain }\n")
            .expect("written");
        Self(folder)
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("s.yaml")
    }

    fn read(&self, text: &str) -> Result<Scenario, crate::graph::Problems> {
        Scenario::parse(text.to_owned(), &self.path(), &Registry::new().with::<Gain>())
    }

    /// `line:column message` of the first problem, and its hint.
    fn first(&self, text: &str) -> String {
        let problems = self.read(text).expect_err("it is wrong");
        let problem = problems.iter().next().expect("one at least");
        let at = problem.line.zip(problem.column).map(|(line, column)| format!("{line}:{column} "));
        let hint = problem.hint.as_ref().map(|hint| format!(" | {hint}"));
        format!("{}{}{}", at.unwrap_or_default(), problem.message, hint.unwrap_or_default())
    }
}

const GOOD: &str = "graph: g.yaml\nseconds: 5\nlaps: 2\nvary:\n  one.gain: { uniform: [0, 2] }\nlatency: { one: { uniform: [2, 12] } }\n\
                    success: { laps_min: 1 }\nrequire: { success_min: 0.9 }\n";

#[test]
fn reads_a_scenario_and_draws_from_it() {
    let bench = Bench::new();
    let scenario = bench.read(GOOD).unwrap_or_else(|problems| panic!("{problems}"));
    assert_eq!((scenario.seconds, scenario.laps), (5.0, Some(2)), "its head");
    assert_eq!(scenario.require.success_min, 0.9, "its verdict");
    let (drawn, again) = (scenario.draw(3), scenario.draw(3));
    assert_eq!(drawn, again, "one seed, one drive");
    let gain = drawn.values["one.gain"].as_f64().expect("a number");
    let latency = drawn.latency_ms["one"].as_f64().expect("a number");
    assert!((0.0..=2.0).contains(&gain) && (2.0..=12.0).contains(&latency), "{drawn:?}");
    let graph =
        scenario.graph_of(&drawn, &Registry::new().with::<Gain>()).unwrap_or_else(|problems| panic!("{problems}"));
    assert_eq!(graph.nodes[0].config, json!({ "gain": gain }), "the value reaches the node");
    assert_eq!(graph.nodes[0].modelled_latency, std::time::Duration::from_secs_f64(latency * 1e-3), "and the latency");
}

#[test]
fn says_where_and_what_is_wrong() {
    let bench = Bench::new();
    let head = "graph: g.yaml\nseconds: 5\n";
    let cases = [
        ("graph: g.yaml\nsecond: 5\nseconds: 5\n", "unknown key `second`"),
        ("graph: g.yaml\n", "`seconds` is missing"),
        ("", "the file is empty | a scenario file is a map"),
        ("graph: g.yaml\nseconds: 0\n", "2:10 `seconds`: got 0, allowed is 0.1 to 3600"),
        ("graph: no.yaml\nseconds: 5\n", "1:8 `graph`: "),
        (
            &format!("{head}vary:\n  one.gian: {{ uniform: [0, 1] }}\n"),
            "4:3 `vary.one.gian`: drawing 0.0: node `one`: ",
        ),
        (
            &format!("{head}vary:\n  two.gain: {{ uniform: [0, 1] }}\n"),
            "4:3 `vary.two.gain`: drawing 0.0: there is no node `two`",
        ),
        (
            &format!("{head}vary:\n  one.gain: {{ uniform: [0, 3] }}\n"),
            "drawing 3.0: node `one`: config `gain`: got 3, allowed is 0 to 2",
        ),
        (
            &format!("{head}vary:\n  one.gain: {{ uniform: [1, 0] }}\n"),
            "4:13 `vary.one.gain`: got [1, 0], expected [least, most]",
        ),
        (&format!("{head}vary:\n  one.gain: {{ unifrom: [1, 0] }}\n"), "got `unifrom`, allowed are `uniform`, "),
        (
            &format!("{head}vary:\n  one.gain: 3\n"),
            "4:13 `vary.one.gain`: got 3, allowed is a name, or a map with one key",
        ),
        (
            &format!("{head}vary:\n  gain: {{ uniform: [0, 1] }}\n"),
            "4:3 `vary`: got the key `gain`, expected `node.key`",
        ),
        (
            &format!("{head}set: {{ one.gain: 5 }}\n"),
            "3:18 `set.one.gain`: node `one`: config `gain`: got 5, allowed is 0 to 2",
        ),
        (
            &format!("{head}set: {{ one.gain: 1 }}\nvary: {{ one.gain: {{ uniform: [0, 1] }} }}\n"),
            "is given under `set` and under `vary`",
        ),
        (&format!("{head}latency: {{ two: 4 }}\n"), "3:12 `latency`: there is no node `two`"),
        (&format!("{head}latency: {{ one: -4 }}\n"), "3:17 `latency.one`: got -4, allowed is 0 to 10000 ms"),
        (&format!("{head}require: {{ success_min: 1.5 }}\n"), "`require.success_min`: got 1.5, allowed is 0 to 1"),
        (&format!("{head}laps: 1\nsuccess: {{ laps_min: 2 }}\n"), "4:22 `success.laps_min`: more laps are wanted"),
        (&format!("{head}success: {{ departure: 0 }}\n"), "unknown key `departure` | did you mean `departures`?"),
        (&format!("{head}success: {{ end_state: [lane_follow] }}\n"), "got `lane_follow`, allowed are "),
        (&format!("{head}success: {{ end_state: [] }}\n"), "3:23 `success.end_state`: got an empty list"),
    ];
    let mut wrong = Vec::new();
    for (text, expected) in cases {
        let first = bench.first(text);
        wrong.extend((!first.contains(expected)).then(|| format!("{text}\n got: {first}\nwant: {expected}")));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n\n"));
}

#[test]
fn a_number_that_is_not_finite_is_told_once() {
    let bench = Bench::new();
    let head = "graph: g.yaml\nseconds: 5\n";
    let cases = [
        ("graph: g.yaml\nseconds: .nan\n".to_owned(), "got `.nan`, which is no number"),
        (format!("{head}vary:\n  one.gain: {{ uniform: [0, .inf] }}\n"), "got `.inf`, which is infinite"),
        (format!("{head}vary:\n  one.gain: {{ normal: {{ mean: .nan, sd: 1 }} }}\n"), "got `.nan`, which is no number"),
        (format!("{head}latency: {{ one: -.inf }}\n"), "got `-.inf`, which is infinite"),
    ];
    for (text, expected) in cases {
        let problems = bench.read(&text).expect_err("it is wrong");
        let told: Vec<_> = problems.iter().map(|problem| problem.message.as_str()).collect();
        assert_eq!(told, [expected], "{text}");
    }
}

#[test]
fn scenario_files_are_told_from_graph_files() {
    let bench = Bench::new();
    let is_one = |text: &str| {
        std::fs::write(bench.path(), text).expect("written");
        Scenario::is_one(&bench.path())
    };
    assert!(is_one(GOOD) && is_one("graph: g.yaml\nsecond: 4\n"), "with a graph, be the rest wrong");
    assert!(!is_one("robot: car1\nnodes: {}\n") && !is_one("graph: a\nnodes: {}\n"), "with nodes");
    assert!(!is_one("") && !is_one("- graph\n"), "without anything");
}
