//! From a scenario file to a checked [`Scenario`].

use std::path::{Path, PathBuf};

use super::raw::RawScenario;
use super::{Scenario, rules};
use crate::graph::draft::Report;
use crate::graph::marked::Marked;
use crate::graph::problem::{Problem, Problems};
use crate::graph::read::{read_map, report_shape};
use crate::graph::shape::ShapeProblem;
use crate::graph::source::{Kind, MAX_FILE_BYTES, Source, read_text, too_large};
use crate::graph::{shape, yaml};
use crate::registry::Registry;

const HINT: &str = "a scenario file is a map with `graph`, `seconds`, `vary`, `success` (docs/scenarios.md)";

impl Scenario {
    /// Whether a file is meant as a scenario: a map with a `graph` and without `nodes`. A file that cannot be read is none.
    pub fn is_one(path: &Path) -> bool {
        let Ok(text) = read_text(path, Kind::Scenario) else { return false };
        let (root, _) = yaml::read(&Source::new(path.display().to_string(), text));
        root.is_some_and(|root| root.has(&["graph"]) && !root.has(&["nodes"]))
    }

    /// Reads and checks a scenario file. `Err` has every problem that was found.
    pub fn read(path: &Path, registry: &Registry) -> Result<Self, Problems> {
        match read_text(path, Kind::Scenario) {
            Ok(text) => Self::parse(text, path, registry),
            Err(problem) => Err(only(*problem)),
        }
    }

    /// Checks the text of a scenario file. `path` is what problems show, and where the graph is looked for; it is not opened.
    pub fn parse(text: String, path: &Path, registry: &Registry) -> Result<Self, Problems> {
        let name = path.display().to_string();
        if text.len() > MAX_FILE_BYTES {
            return Err(only(too_large(&name, text.len() as u64, Kind::Scenario)));
        }
        let source = Source::new(name, text);
        let mut report = Report::new(&source);
        let scenario = check(&source, path, registry, &mut report);
        let mut problems = report.problems;
        problems.sort(&source.name);
        match scenario {
            Some(scenario) if problems.errors() == 0 => Ok(scenario),
            _ => Err(problems),
        }
    }
}

fn only(problem: Problem) -> Problems {
    let mut problems = Problems::default();
    problems.push(problem);
    problems
}

fn check(source: &Source, path: &Path, registry: &Registry, report: &mut Report<'_>) -> Option<Scenario> {
    let mut root = read_map(source, HINT, report)?;
    let mut on_problem = |root: &Marked, problem: ShapeProblem| {
        // What has been taken out as wrong is missing in what is read: that is told once.
        if !root.locate(&problem.path).value.has_bad_part() || !root.has(&problem.path) {
            report_shape(root, problem, report);
        }
    };
    let raw: RawScenario = shape::read(&mut root, &[], &mut on_problem)?;
    let scenario = Scenario {
        path: path.to_owned(),
        graph: folder_of(path).join(&raw.graph),
        seconds: raw.seconds,
        laps: raw.laps,
        seed: raw.seed,
        set: raw.set.into_iter().flatten().collect(),
        vary: raw.vary.into_iter().flatten().collect(),
        latency: raw.latency.into_iter().flatten().collect(),
        success: raw.success.unwrap_or_default(),
        require: raw.require.unwrap_or_default(),
    };
    rules::check(scenario, &root, registry, report)
}

fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    }
}
