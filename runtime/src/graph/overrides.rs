//! `--set node.key=value`: changes one value of a node's configuration without touching the file.

use serde_json::{Map, Value};
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

/// Longest text of values for a running node, B.
pub const MAX_VALUES_BYTES: usize = 64 * 1024;

/// Why values for a running node are none.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ValuesError {
    /// There is no path, or no value.
    #[error("got `{got}`, expected `path=value`, for example `threshold=180`")]
    Form {
        /// What was given.
        got: String,
    },
    /// The value is no YAML, or a number that is not finite.
    #[error("`{path}`: {reason}")]
    Value {
        /// The path.
        path: String,
        /// What is wrong with its value.
        reason: String,
    },
    /// It is far too long.
    #[error("got {bytes} B, allowed are at most {MAX_VALUES_BYTES} B")]
    TooLong {
        /// How long it is.
        bytes: usize,
    },
}

/// Reads `path=value[,path=value...]`; the values are YAML. A comma divides only where another `path=` follows, so that lists
/// and maps need no quotes.
pub fn parse_values(text: &str) -> Result<Map<String, Value>, ValuesError> {
    if text.len() > MAX_VALUES_BYTES {
        return Err(ValuesError::TooLong { bytes: text.len() });
    }
    let mut values = Map::new();
    for assignment in divide(text) {
        let form = || ValuesError::Form { got: suggest::shorten(assignment.trim()).to_owned() };
        let (path, value) = assignment.split_once('=').ok_or_else(form)?;
        let path: Vec<&str> = path.split('.').map(str::trim).collect();
        if path.iter().any(|part| part.is_empty()) {
            return Err(form());
        }
        let path = path.join(".");
        let (value, problems) = yaml::read(&Source::new(String::new(), value.to_owned()));
        if let Some(problem) = problems.into_iter().next() {
            return Err(ValuesError::Value { path, reason: problem.message });
        }
        values.insert(path, value.map_or(Value::Null, |value| value.to_json()));
    }
    Ok(values)
}

/// Cuts at commas outside of quotes and brackets behind which `path=` stands.
fn divide(text: &str) -> Vec<&str> {
    let (mut parts, mut begin, mut depth, mut quote) = (Vec::new(), 0, 0_usize, None);
    let mut escaped = false;
    for (at, c) in text.char_indices() {
        match (quote, c) {
            (Some('"'), '\\') => {
                escaped = !escaped;
                continue;
            }
            (Some(open), c) if open == c && !escaped => quote = None,
            (None, '"' | '\'') if text[..at].ends_with(['=', ' ', ',', '[', '{', ':']) => quote = Some(c),
            (None, '[' | '{') => depth += 1,
            (None, ']' | '}') => depth = depth.saturating_sub(1),
            (None, ',') if depth == 0 && ends_here(&text[at + 1..]) => {
                parts.push(&text[begin..at]);
                begin = at + 1;
            }
            _ => {}
        }
        escaped = false;
    }
    parts.push(&text[begin..]);
    parts
}

/// Whether a value ends before the comma in front of `rest`: `path=` follows, or nothing.
fn ends_here(rest: &str) -> bool {
    let is_path = |c: char| c.is_alphanumeric() || matches!(c, '_' | '-' | '.');
    rest.trim().is_empty()
        || rest.split_once('=').is_some_and(|(path, _)| !path.trim().is_empty() && path.trim().chars().all(is_path))
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
    value.replace_places(&|_| place.clone());
    (!failed).then_some(value)
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
    fn reads_several_values_and_leaves_lists_and_quotes_whole() {
        let read = |text: &str| parse_values(text).map(|values| Value::Object(values).to_string());
        let several = r#"threshold=180, marking={hsv: {h: [1, 2]}},sectors.2.name="a,b=c",on=true"#;
        let expected = r#"{"marking":{"hsv":{"h":[1,2]}},"on":true,"sectors.2.name":"a,b=c","threshold":180}"#;
        assert_eq!(read(several).as_deref(), Ok(expected), "four values");
        assert_eq!(read("source=a,b").as_deref(), Ok(r#"{"source":"a,b"}"#), "a comma in a text");
        assert_eq!(read("port=").as_deref(), Ok(r#"{"port":null}"#), "nothing");
    }

    #[test]
    fn names_what_is_no_value() {
        let why = |text: &str| parse_values(text).expect_err("refused").to_string();
        assert_eq!(why("threshold"), "got `threshold`, expected `path=value`, for example `threshold=180`", "no value");
        assert!(why("=1").starts_with("got `=1`") && why("a..b=1").starts_with("got `a..b=1`"), "no path");
        assert_eq!(why("threshold=.nan"), "`threshold`: got `.nan`, which is no number", "no number");
        assert!(why("a=[1").starts_with("`a`: not valid YAML"), "{}", why("a=[1"));
        assert_eq!(
            why(&format!("a={}", "x".repeat(1 << 20))),
            "got 1048578 B, allowed are at most 65536 B",
            "a megabyte"
        );
    }

    #[test]
    fn refuses_what_has_no_node_key_or_value() {
        for text in ["", "lane", "lane=1", "lane.threshold", ".threshold=1", "lane.=1", "lane..x=1"] {
            assert!(Override::parse(text).is_err(), "`{text}` must be refused");
        }
    }
}
