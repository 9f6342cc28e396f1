//! From a scenario file to a checked [`Scenario`].

use std::path::{Path, PathBuf};

use super::raw::RawScenario;
use super::{Scenario, rules};
use crate::graph::draft::Report;
use crate::graph::problem::{Problem, Problems};
use crate::graph::read::read_map;
use crate::graph::shape;
use crate::graph::source::{Kind, MAX_FILE_BYTES, Source, read_text, too_large};
use crate::registry::Registry;

const HINT: &str = "a scenario file is a map with `graph`, `seconds`, `vary`, `success` (docs/scenarios.md)";

impl Scenario {
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
    let mut on_problem = |root: &_, problem| crate::graph::read::report_shape(root, problem, report);
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
