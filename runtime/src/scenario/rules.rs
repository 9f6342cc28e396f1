//! What a scenario must satisfy beyond its shape: ranges, and that the graph takes every value that can be drawn.

use std::ops::RangeInclusive;

use super::drawn::override_of;
use super::{Distribution, Scenario};
use crate::graph::draft::{LATENCY_MS, Report};
use crate::graph::marked::{Marked, Place, Tree};
use crate::graph::problem::Problem;
use crate::graph::{Graph, Override, ReadOptions, suggest};
use crate::registry::Registry;

/// Allowed values of `seconds`.
const SECONDS: RangeInclusive<f64> = 0.1..=3600.0;
/// So many values of a `one-of` are tried on the graph.
const MAX_TRIED: usize = 32;

/// Gives the scenario when nothing is wrong with it.
pub(super) fn check(
    scenario: Scenario,
    root: &Marked,
    registry: &Registry,
    report: &mut Report<'_>,
) -> Option<Scenario> {
    let mut rules = Rules { scenario, root, registry, report };
    rules.numbers();
    rules.keys();
    rules.distributions();
    if rules.report.problems.errors() == 0 {
        rules.graph();
    }
    (rules.report.problems.errors() == 0).then_some(rules.scenario)
}

struct Rules<'a, 'b> {
    scenario: Scenario,
    root: &'a Marked,
    registry: &'a Registry,
    report: &'a mut Report<'b>,
}

impl Rules<'_, '_> {
    /// Reports at the value of a path, or at the last part of it that is there.
    fn error(&mut self, path: &[&str], rule: &'static str, message: &str, hint: Option<String>) {
        let place = self.place(path, false);
        self.report.error(&place, rule, format!("`{}`: {message}", path.join(".")), hint);
    }

    fn place(&self, path: &[&str], key: bool) -> Place {
        let located = self.root.locate(path);
        match located.key {
            Some(place) if key || located.value.place.is_blank() => place.clone(),
            _ => located.value.place.clone(),
        }
    }

    fn within(&mut self, path: &[&str], number: Option<f64>, allowed: RangeInclusive<f64>) {
        let Some(number) = number.filter(|number| !allowed.contains(number)) else { return };
        let message = format!("got {number}, allowed is {} to {}", allowed.start(), allowed.end());
        self.error(path, "out-of-range", &message, None);
    }

    fn numbers(&mut self) {
        let Scenario { seconds, laps, ref success, ref require, .. } = self.scenario;
        let success = success.clone();
        let success_min = require.success_min;
        self.within(&["seconds"], Some(seconds), SECONDS);
        self.within(&["laps"], laps.map(f64::from), 1.0..=1e6);
        self.within(&["success", "distance_min_m"], success.distance_min_m, 0.0..=1e5);
        self.within(&["success", "cross_track_rms_max_m"], success.cross_track_rms_max_m, 0.0..=10.0);
        self.within(&["success", "cross_track_max_m"], success.cross_track_max_m, 0.0..=10.0);
        self.within(&["require", "success_min"], Some(success_min), 0.0..=1.0);
        // Empty as it is written: what has been reported as wrong is left out of what was read.
        let written = &self.root.locate(&["success", "end_state"]).value.tree;
        if success.end_state.is_some() && matches!(written, Tree::List(states) if states.is_empty()) {
            let hint = Some("name the states that count, like `lane-follow`, or leave it out".to_owned());
            self.error(&["success", "end_state"], "wrong-value", "got an empty list: no drive could succeed", hint);
        }
        if success.laps_min.zip(laps).is_some_and(|(wanted, end)| wanted > end) {
            let message = "more laps are wanted than a drive has: it ends after `laps`".to_owned();
            self.error(&["success", "laps_min"], "out-of-range", &message, None);
        }
    }

    fn keys(&mut self) {
        let sections = [("set", self.keys_of("set")), ("vary", self.keys_of("vary"))];
        let set = sections[0].1.clone();
        for (section, keys) in sections {
            for key in keys {
                if Override::parse(&format!("{key}=0")).is_err() || key.contains('=') {
                    let place = self.place(&[section, &key], true);
                    let message = format!("`{section}`: got the key `{}`, expected `node.key`", suggest::shorten(&key));
                    let hint = Some("for example `world.camera.noise_grey`".to_owned());
                    self.report.error(&place, "wrong-key", message, hint);
                } else if section == "vary" && set.contains(&key) {
                    let place = self.place(&[section, &key], true);
                    let message = format!("`{key}` is given under `set` and under `vary`");
                    self.report.error(&place, "duplicate-key", message, Some("remove one of them".into()));
                }
            }
        }
    }

    fn keys_of(&self, section: &str) -> Vec<String> {
        if !self.root.has(&[section]) {
            return Vec::new();
        }
        self.root.locate(&[section]).value.keys().map(str::to_owned).collect()
    }

    fn distributions(&mut self) {
        for (key, distribution) in self.scenario.vary.clone() {
            if let Some(problem) = distribution.problem() {
                self.error(&["vary", &key], "wrong-distribution", &problem, None);
            }
        }
        for (node, ms) in self.scenario.latency.clone() {
            if let Some(problem) = ms.problem(*LATENCY_MS.start(), *LATENCY_MS.end(), "ms") {
                self.error(&["latency", &node], "wrong-distribution", &problem, None);
            }
        }
    }

    /// The graph must be clean with what is set, and take the ends of each distribution.
    fn graph(&mut self) {
        let Some(graph) = self.plain_graph() else { return };
        let names: Vec<&str> = graph.nodes.iter().map(|node| node.name.as_str()).collect();
        for (node, _) in self.scenario.latency.clone() {
            if !names.contains(&node.as_str()) {
                let place = self.place(&["latency", &node], true);
                let message = format!("`latency`: there is no node `{}` in the graph", suggest::shorten(&node));
                self.report.error(&place, "unknown-node", message, suggest::hint(&node, names.iter().copied()));
            }
        }
        for (key, distribution) in self.scenario.vary.clone() {
            self.try_values(&key, &distribution);
        }
    }

    fn plain_graph(&mut self) -> Option<Graph> {
        let overrides: Vec<Override> = self.scenario.set.iter().map(|(key, value)| override_of(key, value)).collect();
        let problems = match self.read_graph(overrides.clone()) {
            Ok(graph) => return Some(graph),
            Err(problems) => problems,
        };
        let mut told = false;
        for problem in &problems {
            let set = self.scenario.set.iter().zip(&overrides).find(|(_, set)| set.to_string() == problem.file);
            if let Some(((key, _), _)) = set {
                let (place, key) = (self.place(&["set", key], false), key.clone());
                self.report.error(
                    &place,
                    problem.rule,
                    format!("`set.{key}`: {}", problem.message),
                    problem.hint.clone(),
                );
                told = true;
            }
        }
        if !told {
            let first = problems.first_error();
            let hint = Some(format!("`carril check {}` tells more", self.scenario.graph.display()));
            self.error(&["graph"], "wrong-graph", &first.map(one_line).unwrap_or_default(), hint);
        }
        None
    }

    fn try_values(&mut self, key: &str, distribution: &Distribution) {
        for value in distribution.extremes().iter().take(MAX_TRIED) {
            let mut overrides: Vec<Override> =
                self.scenario.set.iter().map(|(key, value)| override_of(key, value)).collect();
            overrides.push(override_of(key, value));
            let Err(problems) = self.read_graph(overrides) else { continue };
            let Some(problem) = problems.first_error() else { continue };
            let place = self.place(&["vary", key], problem.rule == "unknown-node" || problem.rule == "unknown-key");
            let message = format!("`vary.{key}`: drawing {value}: {}", problem.message);
            self.report.error(&place, problem.rule, message, problem.hint.clone());
            return;
        }
    }

    fn read_graph(&self, overrides: Vec<Override>) -> Result<Graph, crate::graph::Problems> {
        Graph::read(&self.scenario.graph, self.registry, &ReadOptions { overrides, ..ReadOptions::default() })
    }
}

/// `dataflow.yaml:3:4: message`
fn one_line(problem: &Problem) -> String {
    match (problem.line, problem.column) {
        (Some(line), Some(column)) => format!("{}:{line}:{column}: {}", problem.file, problem.message),
        _ => format!("{}: {}", problem.file, problem.message),
    }
}
