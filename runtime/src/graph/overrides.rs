//! `--set node.key=value`: changes one value of a node's configuration without touching the file.

use serde_json::Value;
use thiserror::Error;

use super::draft::Report;
use super::marked::{Entries, Entry, Marked, Place, Tree};
use super::source::Source;
use super::{suggest, yaml};

/// One `--set node.key=value`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Override {
    /// The node.
    pub node: String,
    /// Path of the value below the node's `config`: `["sectors", "0", "from_deg"]`.
    pub key: Vec<String>,
    /// The value, as YAML.
    pub value: String,
}

/// Why an override is none.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("got `{got}`, expected `node.key=value`, for example `lane.threshold=180`")]
pub struct OverrideError {
    /// What was given.
    pub got: String,
}

impl Override {
    /// Reads `node.key=value`; the key may have several parts (`node.a.b=1`), the value is YAML.
    pub fn parse(text: &str) -> Result<Self, OverrideError> {
        let error = || OverrideError { got: suggest::shorten(text).to_owned() };
        let (path, value) = text.split_once('=').ok_or_else(error)?;
        let mut parts = path.split('.').map(|part| part.trim().to_owned());
        let node = parts.next().ok_or_else(error)?;
        let key: Vec<String> = parts.collect();
        if node.is_empty() || key.is_empty() || key.iter().any(String::is_empty) {
            return Err(error());
        }
        Ok(Self { node, key, value: value.to_owned() })
    }
}

impl std::fmt::Display for Override {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "--set {}.{}={}", self.node, self.key.join("."), self.value)
    }
}

/// Puts the overrides into the value of the file.
pub(crate) fn apply(root: &mut Marked, overrides: &[Override], report: &mut Report<'_>) {
    for change in overrides {
        let place = Place::Set(change.to_string().into());
        let Some(value) = parse_value(change, &place, report) else { continue };
        let names: Vec<&str> = root.locate(&["nodes"]).value.keys().collect();
        if !names.contains(&change.node.as_str()) {
            let hint = suggest::hint(&change.node, names);
            report.error(
                &place,
                "unknown-node",
                format!("there is no node `{}`", suggest::shorten(&change.node)),
                hint,
            );
            continue;
        }
        let node = root.get_mut(&["nodes", &change.node]).expect("the node was found above");
        let path: Vec<&str> = std::iter::once("config").chain(change.key.iter().map(String::as_str)).collect();
        if let Err(reason) = put(node, &path, value, &place) {
            report.error(&place, "wrong-override", format!("node `{}`: {reason}", change.node), None);
        }
    }
}

fn parse_value(change: &Override, place: &Place, report: &mut Report<'_>) -> Option<Marked> {
    let source = Source::new(String::new(), change.value.clone());
    let (value, problems) = yaml::read(&source);
    let failed = !problems.is_empty();
    for problem in problems {
        report.error(place, problem.rule, problem.message, problem.hint.map(str::to_owned));
    }
    let mut value = value.unwrap_or_else(|| Marked::null(place.clone()));
    replace_places(&mut value, place);
    (!failed).then_some(value)
}

fn replace_places(value: &mut Marked, place: &Place) {
    value.place = place.clone();
    match &mut value.tree {
        Tree::List(items) => items.iter_mut().for_each(|item| replace_places(item, place)),
        Tree::Map(entries) => {
            for entry in entries.iter_mut() {
                entry.key_place = place.clone();
                replace_places(&mut entry.value, place);
            }
        }
        Tree::Scalar(_) | Tree::Bad => {}
    }
}

/// Sets the value at `path` below `parent`; maps on the way are made, list items must exist.
fn put(parent: &mut Marked, path: &[&str], value: Marked, place: &Place) -> Result<(), String> {
    let Some((part, rest)) = path.split_first() else {
        *parent = value;
        return Ok(());
    };
    if parent.is_null() {
        parent.tree = Tree::Map(Entries::default());
    }
    match &mut parent.tree {
        Tree::List(items) => {
            let count = items.len();
            let item = part.parse().ok().and_then(|index: usize| items.get_mut(index));
            let item = item.ok_or_else(|| format!("got index `{part}`, the list has {count} items, counted from 0"))?;
            put(item, rest, value, place)
        }
        Tree::Map(entries) => {
            if entries.get(part).is_none() {
                let value = Marked::null(place.clone());
                entries.push(Entry { key: (*part).to_owned(), key_place: place.clone(), value });
            }
            let entry = entries.get_mut(part).ok_or_else(|| format!("`{part}` is not there"))?;
            put(&mut entry.value, rest, value, place)
        }
        Tree::Scalar(_) | Tree::Bad => Err(format!("`{part}` lies below a value that has no parts")),
    }
}

/// Sets the value at `path` (parts with dots between them) in a configuration; maps on the way are made, list items must exist.
pub fn apply_value(config: &mut Value, path: &str, value: Value) -> Result<(), String> {
    let mut place = config;
    for part in path.split('.') {
        if place.is_null() {
            *place = Value::Object(serde_json::Map::new());
        }
        place = match place {
            Value::Object(map) => map.entry(part).or_insert(Value::Null),
            Value::Array(items) => {
                let count = items.len();
                let item = part.parse().ok().and_then(|index: usize| items.get_mut(index));
                item.ok_or_else(|| format!("got index `{part}`, the list has {count} items, counted from 0"))?
            }
            _ => return Err(format!("`{part}` lies below a value that has no parts")),
        };
    }
    *place = value;
    Ok(())
}

/// Reads a value as people write it in a graph file.
pub fn read_value(text: &str) -> Result<Value, String> {
    let (value, problems) = yaml::read(&Source::new(String::new(), text.to_owned()));
    match problems.into_iter().next() {
        Some(problem) => Err(format!("`{}` is no YAML value: {}", suggest::shorten(text), problem.message)),
        None => Ok(value.map_or(Value::Null, |value| value.to_json())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_node_path_and_value() {
        let change = Override::parse("lane.bands.0=[0.7, 0.8]").expect("a valid override");
        assert_eq!((change.node.as_str(), &change.key[..]), ("lane", &["bands".to_owned(), "0".into()][..]), "path");
        assert_eq!(change.to_string(), "--set lane.bands.0=[0.7, 0.8]", "display undoes parse");
        assert_eq!(Override::parse("camera.source=a=b").map(|c| c.value), Ok("a=b".into()), "the first `=` divides");
    }

    #[test]
    fn refuses_what_has_no_node_key_or_value() {
        for text in ["", "lane", "lane=1", "lane.threshold", ".threshold=1", "lane.=1", "lane..x=1"] {
            assert!(Override::parse(text).is_err(), "`{text}` must be refused");
        }
    }
}
