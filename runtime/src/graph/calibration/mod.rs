//! The calibration file of a car: values that go over the configurations of a graph, and when and how they were found. A graph names
//! it with `calibration:`; a graph whose file is not there yet runs with its own values.
//!
//! Values lie below `nodes`, like the configurations of a graph. Maps are merged key by key, everything else is replaced, and
//! `--set` goes over both. They keep their places, so that what is wrong with one is told at its line of the calibration file.

mod write;

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::draft::Report;
use super::marked::{Entry, Marked, Place, Tree};
use super::read::report_shape;
use super::source::{Kind, MAX_FILE_BYTES, Source, read_text, too_large};
use super::{shape, suggest, yaml};

pub use write::{CalibrationFile, edit_calibration};

/// Where a calibration file is, and what it would hold.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CalibrationText {
    /// What problems show.
    pub path: PathBuf,
    /// The text.
    pub text: String,
}

/// When and how something was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// UTC, ISO 8601: `2026-11-25T23:10:00Z`.
    pub when: String,
    /// What.
    pub what: Subject,
    /// How.
    pub how: How,
}

/// What was calibrated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Subject {
    /// What the lane detector takes for marking, or how its camera looks at the floor.
    Lane,
    /// How the lidar is mounted.
    Lidar,
    /// The stops and the middle of the steering servo.
    Servo,
    /// How far the car goes in a tick of the encoder.
    Encoder,
    /// Single parameters of the microcontroller.
    Chip,
}

/// How something was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct How {
    /// The command line.
    pub command: String,
    /// The figures that the values rest on.
    #[serde(default)]
    pub figures: Map<String, Value>,
}

impl Record {
    /// Of something that was found just now.
    pub fn now(what: Subject, command: String, figures: Map<String, Value>) -> Self {
        let when = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
        Self { when, what, how: How { command, figures } }
    }
}

/// The file as it is written. Values are looked at node by node, with the configurations that they go over.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawCalibration {
    nodes: Option<BTreeMap<String, Option<Map<String, Value>>>>,
    records: Option<Vec<RawRecord>>,
}

/// A [`Record`] as it is written; what must be there is said by a rule, so that one slip is one problem.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawRecord {
    when: Option<String>,
    #[serde(rename = "what")]
    _what: Option<Subject>,
    #[serde(rename = "how")]
    _how: Option<RawHow>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawHow {
    #[serde(rename = "command")]
    _command: Option<String>,
    #[serde(rename = "figures")]
    _figures: Option<Map<String, Value>>,
}

/// Lays the values of the calibration file over the configurations. The file that the graph names, be it there or not.
pub(super) fn apply(
    root: &mut Marked,
    base_dir: &Path,
    instead: Option<&CalibrationText>,
    report: &mut Report<'_>,
) -> Option<PathBuf> {
    let named = named(root, base_dir, report);
    let text = match (instead, &named) {
        (Some(CalibrationText { path, text }), _) => Some((path.clone(), text.clone())),
        (None, Some((path, place))) => read(path, place, report).map(|text| (path.clone(), text)),
        (None, None) => None,
    };
    if let Some((path, text)) = text {
        lay_over(root, &path, text, report);
    }
    named.map(|(path, _)| path)
}

/// The path that the graph names, and its place. Another shape than a text is reported with the rest of the graph.
fn named(root: &Marked, base_dir: &Path, report: &mut Report<'_>) -> Option<(PathBuf, Place)> {
    let located = root.locate(&["calibration"]);
    let (1, Tree::Scalar(Value::String(name))) = (located.depth, &located.value.tree) else { return None };
    let place = located.value.place.clone();
    if name.trim().is_empty() {
        let hint = "name a file, for example `car1.calibration.yaml`, or leave the key out".to_owned();
        let message = "`calibration`: got an empty text, allowed is the path of a file".to_owned();
        report.error(&place, "wrong-value", message, Some(hint));
        return None;
    }
    let path = if base_dir == Path::new(".") { PathBuf::from(name) } else { base_dir.join(name) };
    Some((path, place))
}

/// The text of the file. One that is not there is good to know and no problem: a graph is written before its car is calibrated.
fn read(path: &Path, place: &Place, report: &mut Report<'_>) -> Option<String> {
    let shown = path.display();
    if std::fs::metadata(path).is_err_and(|error| error.kind() == io::ErrorKind::NotFound) {
        let message = format!("there is no calibration file `{shown}` yet: the values of the graph hold");
        let hint = "`carril calibrate` writes it (docs/calibration.md)".to_owned();
        report.note(place, "not-calibrated", message, Some(hint));
        return None;
    }
    match read_text(path, Kind::Calibration) {
        Ok(text) => Some(text),
        Err(problem) if problem.line.is_some() => {
            report.problems.push(*problem);
            None
        }
        Err(problem) => {
            let message = format!("the calibration file `{shown}`: {}", problem.message);
            report.error(place, problem.rule, message, problem.hint);
            None
        }
    }
}

fn lay_over(root: &mut Marked, path: &Path, text: String, report: &mut Report<'_>) {
    let name = path.display().to_string();
    if text.len() > MAX_FILE_BYTES {
        report.problems.push(too_large(&name, text.len() as u64, Kind::Calibration));
        return;
    }
    let (values, problems) = yaml::read(&Source::new(name.clone(), text.clone()));
    report.calibrated_by(Source::new(name, text));
    for problem in problems {
        let hint = problem.hint.map(str::to_owned);
        report.error(&Place::Calibration(problem.span), problem.rule, problem.message, hint);
    }
    let Some(mut values) = values.filter(|values| !values.is_null()) else { return };
    values.replace_places(&in_calibration);
    if !matches!(values.tree, Tree::Map(_)) {
        let hint = Some("a calibration file is a map with `nodes` and `records`".to_owned());
        report.error(&values.place, "wrong-type", "the calibration file holds no map".into(), hint);
        return;
    }
    let mut on_problem = |root: &Marked, problem| report_shape(root, problem, report);
    let raw: Option<RawCalibration> = shape::read(&mut values, &[], &mut on_problem);
    let Some(raw) = raw else { return };
    check_records(&values, &raw, report);
    for node in raw.nodes.iter().flat_map(BTreeMap::keys) {
        merge_node(root, &values, node, report);
    }
}

fn in_calibration(place: &Place) -> Place {
    match place {
        Place::File(span) => Place::Calibration(span.clone()),
        other => other.clone(),
    }
}

fn check_records(values: &Marked, raw: &RawCalibration, report: &mut Report<'_>) {
    for (index, record) in raw.records.iter().flatten().enumerate() {
        let path = values.own_path(&["records".into(), index.to_string()]);
        for missing in [&["when"][..], &["what"], &["how"], &["how", "command"]] {
            let (missing, above) = (below(&path, missing), below(&path, &missing[..missing.len() - 1]));
            let is_map = values.has(&above) && matches!(values.locate(&above).value.tree, Tree::Map(_));
            if is_map && !values.has(&missing) {
                must_be_there(values, &missing, report);
            }
        }
        if let Some(when) = record.when.as_ref().filter(|when| humantime::parse_rfc3339(when).is_err()) {
            let (when, place) = (suggest::shorten(when), &values.locate(&below(&path, &["when"])).value.place);
            let message =
                format!("`{}.when`: got `{when}`, allowed is a time in UTC like 2026-11-25T23:10:00Z", path.join("."));
            report.error(place, "wrong-value", message, None);
        }
    }
}

fn below<'a>(path: &'a [String], rest: &[&'a str]) -> Vec<&'a str> {
    path.iter().map(String::as_str).chain(rest.iter().copied()).collect()
}

fn must_be_there(values: &Marked, path: &[&str], report: &mut Report<'_>) {
    let (key, above) = path.split_last().expect("no path is empty");
    let hint = format!("write `{key}: ...` here");
    let message = format!("`{}`: `{key}` is missing", above.join("."));
    report.error(&values.locate(above).value.place, "missing-key", message, Some(hint));
}

fn merge_node(root: &mut Marked, values: &Marked, node: &str, report: &mut Report<'_>) {
    let located = values.locate(&["nodes", node]);
    let place = located.key.unwrap_or(&located.value.place);
    let names: Vec<&str> = root.locate(&["nodes"]).value.keys().collect();
    if !names.contains(&node) {
        let hint = suggest::hint(node, names);
        report.error(place, "unknown-node", format!("the graph has no node `{}`", suggest::shorten(node)), hint);
        return;
    }
    // What has been reported as wrong, here or in the graph, stays out.
    let Tree::Map(_) = located.value.tree else { return };
    let Some(Marked { tree: Tree::Map(entries), .. }) = root.get_mut(&["nodes", node]) else { return };
    match entries.get_mut("config") {
        Some(config) if config.value.is_null() => config.value = located.value.clone(),
        Some(config) if matches!(config.value.tree, Tree::Map(_)) => merge(&mut config.value, located.value),
        Some(_) => {}
        None => {
            entries.push(Entry { key: "config".into(), key_place: place.clone(), value: located.value.clone() });
        }
    }
}

/// Maps key by key; everything else takes the place of what was there.
fn merge(into: &mut Marked, values: &Marked) {
    let (Tree::Map(into), Tree::Map(values)) = (&mut into.tree, &values.tree) else {
        *into = values.clone();
        return;
    };
    for entry in values.iter() {
        match into.get_mut(&entry.key) {
            Some(known) => {
                merge(&mut known.value, &entry.value);
                if !matches!(entry.value.tree, Tree::Map(_)) {
                    known.key_place = entry.key_place.clone();
                }
            }
            None => into.push(entry.clone()),
        }
    }
}

#[cfg(test)]
mod tests;
