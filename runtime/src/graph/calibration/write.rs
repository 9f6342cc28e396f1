//! Writes what was found into a calibration file: values in the place of those before, and a record at the end. Comments, order and
//! style of what is there stay; what comes out is read again and must say just what was asked for.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::{CalibrationText, Record};
use crate::graph::edit::{EditError, FileChange, FileChangeError, append_record, edit_at};
use crate::graph::flow::flow_text;

/// How a file begins that was not there.
const HEADER: &str = "# What is different from car to car. A graph takes it with `calibration: FILE`: its values go over those below `config`.\n\
    # Written by `carril calibrate` (docs/calibration.md); comments stay.\n";

/// The text of a calibration file with other values for a node and one more record. Keys of `values` are paths with dots; without any, only
/// the record is written.
pub fn edit_calibration(
    text: &str,
    node: &str,
    values: &Map<String, Value>,
    record: &Record,
) -> Result<String, EditError> {
    let mut text = if says_nothing(text) { begun(text, node, values) } else { text.to_owned() };
    for (path, value) in values {
        let parts: Vec<&str> = ["nodes", node].into_iter().chain(path.split('.')).collect();
        text = edit_at(&text, &parts, value)?;
    }
    append_record(&text, record)
}

/// Whether there are only comments.
fn says_nothing(text: &str) -> bool {
    text.trim_start_matches('\u{feff}').lines().all(|line| line.trim().is_empty() || line.trim_start().starts_with('#'))
}

fn begun(text: &str, node: &str, values: &Map<String, Value>) -> String {
    let header = if text.trim().is_empty() { HEADER.to_owned() } else { text.trim_end().to_owned() + "\n" };
    match values.iter().next() {
        Some((path, value)) => {
            let nested = path
                .split('.')
                .rev()
                .fold(value.clone(), |inner, part| Value::Object(Map::from_iter([(part.to_owned(), inner)])));
            format!("{header}\nnodes:\n  {node}: {}\n", flow_text(&nested))
        }
        None => format!("{header}\nrecords:\n"),
    }
}

/// A calibration file with the text that it shall have. Nothing is written before [`save`](Self::save).
pub struct CalibrationFile(FileChange);

impl CalibrationFile {
    /// Puts values and a record into the text of a file, which may not be there yet. What it holds already stays.
    pub fn prepare(
        path: &Path,
        node: &str,
        values: &Map<String, Value>,
        record: &Record,
    ) -> Result<Self, FileChangeError> {
        let change = |text: Option<&str>| edit_calibration(text.unwrap_or_default(), node, values, record);
        FileChange::prepare_or_create(path, change).map(Self)
    }

    /// For [`ReadOptions::calibration`](crate::graph::ReadOptions): a graph can be checked with it before it is written.
    pub fn text(&self) -> CalibrationText {
        CalibrationText { path: self.0.path().to_owned(), text: self.0.after().to_owned() }
    }

    /// The file.
    pub fn path(&self) -> PathBuf {
        self.0.path().to_owned()
    }

    /// Replaces the file in one step. Refused when somebody else has changed it meanwhile.
    pub fn save(&self) -> Result<(), FileChangeError> {
        self.0.save()
    }
}
