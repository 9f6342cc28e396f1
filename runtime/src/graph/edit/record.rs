//! Writes a record to the end of the list `records` of a calibration file.

use serde_json::{Value, json};

use super::{Change, Document, EditError, read, span};
use crate::graph::calibration::Record;
use crate::graph::flow::{flow_text, quoted};
use crate::graph::marked::{Marked, Tree};

/// What it lies below.
const KEY: &str = "records";

/// The text with one more record.
pub(crate) fn append_record(text: &str, record: &Record) -> Result<String, EditError> {
    let now = read(text)?;
    let mut expected = now.marked.to_json();
    if expected[KEY].is_null() {
        expected[KEY] = json!([]);
    }
    let Some(records) = expected[KEY].as_array_mut() else {
        return Err(EditError::WrongPath { reason: format!("`{KEY}` is no list") });
    };
    records.push(serde_json::to_value(record).expect("texts and numbers always serialise"));
    let change = now.append(record)?;
    now.changed(&change, &expected, KEY)
}

impl Document {
    fn append(&self, record: &Record) -> Result<Change, EditError> {
        let Tree::Map(entries) = &self.marked.tree else {
            return Err(EditError::WrongPath { reason: "the file is no map".to_owned() });
        };
        let Some(entry) = entries.get(KEY) else {
            let end = self.text().len();
            let (_, newline) = self.line_end(end);
            let gap = if self.text().ends_with('\n') { "" } else { newline };
            return Ok(Change(vec![(end..end, format!("{gap}{KEY}:{}{newline}", block(record, "  ", newline)))]));
        };
        self.must_be_its_own(&entry.value, Some(entry), &[KEY])?;
        match &entry.value.tree {
            Tree::List(items) if !items.is_empty() => Ok(self.behind(&items[items.len() - 1], record)),
            _ => self.as_first(&entry.value, span(&entry.key_place).end, record),
        }
    }

    /// Behind the last one, in its style.
    fn behind(&self, last: &Marked, record: &Record) -> Change {
        let begin = span(&last.place).start;
        let end = self.end_of(last, begin);
        let line_start = self.text()[..begin].rfind('\n').map_or(0, |newline| newline + 1);
        let before = &self.text()[line_start..begin];
        if before.trim() != "-" {
            return Change(vec![(end..end, format!(", {}", flow(record)))]);
        }
        let indent = &before[..before.len() - before.trim_start().len()];
        let (line_end, newline) = self.line_end(end);
        Change(vec![(line_end..line_end, block(record, indent, newline))])
    }

    /// In the place of nothing or of `[]`.
    fn as_first(&self, nothing: &Marked, key_end: usize, record: &Record) -> Result<Change, EditError> {
        let start = span(&nothing.place).start.max(key_end);
        let text = self.text();
        if matches!(nothing.tree, Tree::List(_)) {
            let whole = start..self.end_of(nothing, start);
            return Ok(Change(vec![(whole, format!("[{}]", flow(record)))]));
        }
        let written = &text[span(&nothing.place)];
        if !written.trim().is_empty() {
            return Err(self.unsure(start, &[KEY]));
        }
        let (line_end, newline) = self.line_end(key_end);
        Ok(Change(vec![(line_end..line_end, block(record, "  ", newline))]))
    }
}

/// On lines of its own, each behind a line end.
fn block(record: &Record, indent: &str, newline: &str) -> String {
    let what = serde_json::to_value(record.what).unwrap_or(Value::Null);
    let lines = [
        format!("- when: {}", quoted(&record.when)),
        format!("  what: {}", flow_text(&what)),
        "  how:".to_owned(),
        format!("    command: {}", quoted(&record.how.command)),
        format!("    figures: {}", flow_text(&Value::Object(record.how.figures.clone()))),
    ];
    lines.iter().flat_map(|line| [newline, indent, line.as_str()]).collect()
}

/// On one line.
fn flow(record: &Record) -> String {
    flow_text(&serde_json::to_value(record).expect("texts and numbers always serialise"))
}
