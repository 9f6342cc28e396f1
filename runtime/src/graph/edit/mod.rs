//! Writes values into the text of a graph file or a calibration file and leaves everything else as it is: comments, order, quotes, style. Pure: text
//! in, text out. The text that comes out is read again and must say just what was asked for; otherwise nothing comes out.

mod file;
mod record;
#[cfg(test)]
mod tests;

use std::ops::Range;

use serde_json::{Map, Value};
use thiserror::Error;

use super::flow::{double_quoted, entry, flow_text, single_quoted};
use super::marked::{Entries, Entry, Marked, Place, Tree};
use super::source::{MAX_FILE_BYTES, Source};
use super::{suggest, yaml};
use crate::parameters::{value_at, whole, with_values};

pub use file::{FileChange, FileChangeError};
pub(super) use record::append_record;

/// Why a value cannot be written into a graph file. The file stays as it is.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum EditError {
    /// The text is no YAML.
    #[error("line {line}: {reason}; `carril check` says more")]
    NotYaml {
        /// From 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// The file has no such node.
    #[error("the file has no node `{node}`")]
    NoNode {
        /// The node.
        node: String,
    },
    /// The value has an anchor or an alias: other places say the same.
    #[error(
        "line {line}: `{path}` is shared through an anchor or an alias (`&`, `*`), and a change here would show elsewhere too; edit the file by hand"
    )]
    Shared {
        /// From 1.
        line: usize,
        /// The value on the way that is shared.
        path: String,
    },
    /// The value stands on several lines.
    #[error(
        "line {line}: `{path}` stands on several lines; change its parts one by one (`{path}.x=..`), or edit the file by hand"
    )]
    SeveralLines {
        /// From 1.
        line: usize,
        /// The value.
        path: String,
    },
    /// There can be nothing at the path.
    #[error("{reason}")]
    WrongPath {
        /// Why not.
        reason: String,
    },
    /// The file is written in a way that is not understood here.
    #[error("line {line}: `{path}` cannot be written here without a change to something else; edit the file by hand")]
    Unsure {
        /// From 1.
        line: usize,
        /// The value.
        path: String,
    },
    /// No graph file is so large.
    #[error("the file would have {bytes} B, a graph file has at most {MAX_FILE_BYTES} B")]
    TooLarge {
        /// Its size.
        bytes: usize,
    },
}

/// The text of a graph file with other values in the configuration of a node. Keys of `values` are paths with dots.
/// `effective` is the configuration in force, with defaults: where a path leads into a list that the file leaves to its default,
/// the whole list is written.
pub fn edit(text: &str, node: &str, values: &Map<String, Value>, effective: &Value) -> Result<String, EditError> {
    let before = read(text)?;
    let nodes = before.marked.locate(&["nodes"]);
    if nodes.depth < 1 || !nodes.value.keys().any(|name| name == node) {
        return Err(EditError::NoNode { node: suggest::shorten(node).to_owned() });
    }
    let mut expected = before.marked.to_json();
    if !matches!(expected["nodes"][node], Value::Object(_) | Value::Null) {
        return Err(EditError::WrongPath { reason: format!("node `{}` is no map", suggest::shorten(node)) });
    }
    let mut edited = text.to_owned();
    for (path, value) in values {
        let now = read(&edited)?;
        let (path, value) = written_in_file(&now.marked, node, path, value, effective)?;
        let parts: Vec<&str> = ["nodes", node, "config"].into_iter().chain(path.split('.')).collect();
        let config = expected["nodes"][node]["config"].take();
        let changed = with_values(&config, &Map::from_iter([(path.clone(), value.clone())]));
        expected["nodes"][node]["config"] = changed.map_err(|reason| EditError::WrongPath { reason })?;
        let change = now.change(&parts, &value)?;
        edited = now.changed(&change, &expected, &path)?;
    }
    Ok(edited)
}

/// The text with another value at a path from its root.
pub(super) fn edit_at(text: &str, parts: &[&str], value: &Value) -> Result<String, EditError> {
    let now = read(text)?;
    let expected = with_values(&now.marked.to_json(), &Map::from_iter([(parts.join("."), value.clone())]));
    let expected = expected.map_err(|reason| EditError::WrongPath { reason })?;
    let change = now.change(parts, value)?;
    now.changed(&change, &expected, &for_people(parts))
}

/// What to write for a path: itself, or the whole list where the path leads into one that is not in the file.
fn written_in_file(
    root: &Marked,
    node: &str,
    path: &str,
    value: &Value,
    effective: &Value,
) -> Result<(String, Value), EditError> {
    let parts: Vec<&str> = path.split('.').collect();
    let in_file: Vec<&str> = ["nodes", node, "config"].into_iter().chain(parts.iter().copied()).collect();
    let known = root.locate(&in_file).depth.saturating_sub(3);
    for len in known + 1..parts.len() {
        let prefix = parts[..len].join(".");
        if let Some(list @ Value::Array(_)) = value_at(effective, &prefix) {
            let rest = parts[len..].join(".");
            let list = with_values(list, &Map::from_iter([(rest, value.clone())]));
            let list = list.map_err(|reason| EditError::WrongPath { reason })?;
            return Ok((prefix, whole(&list)));
        }
    }
    Ok((path.to_owned(), value.clone()))
}

/// Texts that come in at places of the old text, in order, each in place of a range.
struct Change(Vec<(Range<usize>, String)>);

impl Change {
    fn at(&self) -> usize {
        self.0.first().map_or(0, |(range, _)| range.start)
    }

    fn carried_out(&self, text: &str) -> String {
        let mut changed = String::with_capacity(text.len() + 64);
        let mut from = 0;
        for (range, fresh) in &self.0 {
            changed.extend([&text[from..range.start], fresh.as_str()]);
            from = range.end;
        }
        changed.push_str(&text[from..]);
        changed
    }
}

/// A text that could be read.
struct Document {
    source: Source,
    marked: Marked,
}

fn read(text: &str) -> Result<Document, EditError> {
    let source = Source::new(String::new(), text.to_owned());
    let (marked, problems) = yaml::read(&source);
    if let Some(problem) = problems.into_iter().next() {
        return Err(EditError::NotYaml { line: source.line_of(problem.span.start), reason: problem.message });
    }
    let marked = marked.ok_or_else(|| EditError::NotYaml { line: 1, reason: "the file is empty".into() })?;
    Ok(Document { source, marked })
}

impl Document {
    /// How `value` comes to stand at `path`.
    fn change(&self, path: &[&str], value: &Value) -> Result<Change, EditError> {
        let (mut at, mut key) = (&self.marked, None);
        for (depth, part) in path.iter().enumerate() {
            self.must_be_its_own(at, key, &path[..depth])?;
            let below = match &at.tree {
                Tree::Map(entries) => match entries.get(part) {
                    Some(entry) => (&entry.value, Some(entry)),
                    None => return self.insert(at, entries, path, depth, value),
                },
                Tree::List(items) => match part.parse().ok().and_then(|index: usize| items.get(index)) {
                    Some(item) => (item, None),
                    None => return Err(EditError::WrongPath { reason: format!("the list has {} items", items.len()) }),
                },
                Tree::Scalar(_) | Tree::Bad => {
                    return self.replace(at, key, &path[..depth], &nested(&path[depth..], value));
                }
            };
            (at, key) = below;
        }
        self.must_be_its_own(at, key, path)?;
        if holds_shared(at) {
            return Err(self.shared(at, key, path));
        }
        self.replace(at, key, path, value)
    }

    /// The text with a change. It must say what is expected then.
    fn changed(&self, change: &Change, expected: &Value, path: &str) -> Result<String, EditError> {
        let text = change.carried_out(self.text());
        if text.len() > MAX_FILE_BYTES {
            return Err(EditError::TooLarge { bytes: text.len() });
        }
        if !read(&text).is_ok_and(|after| after.marked.to_json() == *expected) {
            return Err(EditError::Unsure { line: self.source.line_of(change.at()), path: path.to_owned() });
        }
        Ok(text)
    }

    fn text(&self) -> &str {
        &self.source.text
    }

    fn must_be_its_own(&self, at: &Marked, key: Option<&Entry>, path: &[&str]) -> Result<(), EditError> {
        if at.shared { Err(self.shared(at, key, path)) } else { Ok(()) }
    }

    fn shared(&self, at: &Marked, key: Option<&Entry>, path: &[&str]) -> EditError {
        let place = key.map_or(&at.place, |entry| &entry.key_place);
        EditError::Shared { line: self.source.line_of(span(place).start), path: for_people(path) }
    }

    fn unsure(&self, at: usize, path: &[&str]) -> EditError {
        EditError::Unsure { line: self.source.line_of(at), path: for_people(path) }
    }

    /// In place of a value that is there.
    fn replace(&self, old: &Marked, key: Option<&Entry>, path: &[&str], value: &Value) -> Result<Change, EditError> {
        let text = self.text();
        let span = span(&old.place);
        let written = text[span.start..self.end_of(old, span.start).max(span.start)].trim_end();
        if written.is_empty() {
            let key = key.map(|entry| span_of_key(entry).end).ok_or_else(|| self.unsure(span.start, path))?;
            let colon = text[key..].find(':').filter(|&gap| text[key..key + gap].trim().is_empty());
            let at = key + colon.ok_or_else(|| self.unsure(key, path))? + 1;
            return Ok(Change(vec![(at..at, format!(" {}", flow_text(value)))]));
        }
        if written.contains('\n') {
            let begin = key.map_or(span.start, |entry| span_of_key(entry).start);
            return Err(EditError::SeveralLines { line: self.source.line_of(begin), path: for_people(path) });
        }
        if old.to_json() == *value {
            return Ok(Change(Vec::new()));
        }
        let fresh = match value {
            Value::String(word) if written.starts_with('"') => double_quoted(word),
            Value::String(word) if written.starts_with('\'') => {
                single_quoted(word).unwrap_or_else(|| double_quoted(word))
            }
            other => flow_text(other),
        };
        Ok(Change(vec![(span.start..span.start + written.len(), fresh)]))
    }

    /// A key that is not there yet, behind the last one of its map.
    fn insert(
        &self,
        map: &Marked,
        entries: &Entries,
        path: &[&str],
        depth: usize,
        value: &Value,
    ) -> Result<Change, EditError> {
        let text = self.text();
        let map_span = span(&map.place);
        let fresh = entry(path[depth], &flow_text(&nested(&path[depth + 1..], value)));
        let flow = text[map_span.clone()].starts_with('{');
        let Some(last) = entries.iter().last() else {
            let whole = map_span.start..self.end_of(map, map_span.start);
            return if flow && !text[whole.clone()].contains('#') {
                Ok(Change(vec![(whole, format!("{{ {fresh} }}"))]))
            } else {
                Err(self.unsure(map_span.start, path))
            };
        };
        let key = span_of_key(last);
        let end = self.end_of(&last.value, key.end);
        let line_start = text[..key.start].rfind('\n').map_or(0, |newline| newline + 1);
        let before_key = &text[line_start..key.start];
        if !flow {
            let indent = " ".repeat(before_key.chars().count());
            let (line_end, newline) = self.line_end(end);
            return Ok(Change(vec![(line_end..line_end, format!("{newline}{indent}{fresh}"))]));
        }
        if end <= key.end {
            return Err(self.unsure(key.start, path));
        }
        let (line_end, newline) = self.line_end(end);
        if !before_key.trim().is_empty() || line_end >= self.end_of(map, map_span.start) {
            let gap = if before_key.trim().is_empty() { format!(",{newline}{before_key}") } else { ", ".into() };
            return Ok(Change(vec![(end..end, gap + &fresh)]));
        }
        // A key to a line: the comment behind the last one stays with it.
        let has_comma = text[end..].trim_start().starts_with(',');
        let (comma, own_comma) = if has_comma { ("", ",") } else { (",", "") };
        let line = format!("{newline}{before_key}{fresh}{own_comma}");
        Ok(Change(vec![(end..end, comma.to_owned()), (line_end..line_end, line)]))
    }

    /// Behind the last byte of a value. It cannot lie before `floor`: behind its key, or where its list begins.
    fn end_of(&self, value: &Marked, floor: usize) -> usize {
        let (text, span) = (self.text(), span(&value.place));
        // An alias has the place of its anchor.
        if span.start < floor {
            return floor;
        }
        let last = match &value.tree {
            Tree::Map(entries) => entries.iter().last().map(|last| self.end_of(&last.value, span_of_key(last).end)),
            Tree::List(items) => items.last().map(|last| self.end_of(last, span.start)),
            Tree::Scalar(_) | Tree::Bad => return span.start + text[span].trim_end().len(),
        };
        match text[span.start..].chars().next() {
            Some('{') => self.closing(last.unwrap_or(span.start + 1), '}'),
            Some('[') => self.closing(last.unwrap_or(span.start + 1), ']'),
            _ => last.unwrap_or(floor),
        }
    }

    /// Behind the bracket that ends a flow map or list. The parser counts the comment behind it in.
    fn closing(&self, from: usize, bracket: char) -> usize {
        let (mut comment, mut blank) = (false, true);
        for (at, c) in self.text()[from..].char_indices() {
            comment = c != '\n' && (comment || (c == '#' && blank));
            blank = c.is_whitespace();
            if c == bracket && !comment {
                return from + at + 1;
            }
        }
        from
    }

    /// Where the line of a byte ends, and what ends it.
    fn line_end(&self, at: usize) -> (usize, &'static str) {
        let text = self.text();
        match text[at..].find('\n').map(|gap| at + gap) {
            Some(newline) if text[..newline].ends_with('\r') => (newline - 1, "\r\n"),
            Some(newline) => (newline, "\n"),
            None => (text.len(), if text.contains("\r\n") { "\r\n" } else { "\n" }),
        }
    }
}

/// `lane.config.threshold`
fn for_people(path: &[&str]) -> String {
    path.strip_prefix(&["nodes"]).unwrap_or(path).join(".")
}

/// `value` below the rest of a path.
fn nested(rest: &[&str], value: &Value) -> Value {
    let wrap = |inner: Value, part: &&str| Value::Object(Map::from_iter([((*part).to_owned(), inner)]));
    rest.iter().rev().fold(value.clone(), wrap)
}

/// Whether a value or anything in it is shared.
fn holds_shared(value: &Marked) -> bool {
    value.shared
        || match &value.tree {
            Tree::List(items) => items.iter().any(holds_shared),
            Tree::Map(entries) => entries.iter().any(|entry| holds_shared(&entry.value)),
            Tree::Scalar(_) | Tree::Bad => false,
        }
}

fn span_of_key(entry: &Entry) -> Range<usize> {
    span(&entry.key_place)
}

fn span(place: &Place) -> Range<usize> {
    match place {
        Place::File(span) => span.clone(),
        Place::Calibration(_) | Place::Set(_) => 0..0,
    }
}
