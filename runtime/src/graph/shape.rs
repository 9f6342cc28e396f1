//! From a marked value to typed structs: finds every key and value of the wrong shape, not only the first, by leaving out what
//! was wrong and reading again. Also turns serde's words into ours.

use serde::de::DeserializeOwned;
use serde_json::Value;
use serde_path_to_error::Segment;

use super::marked::{Marked, Tree};
use super::problem::MAX_PROBLEMS;
use super::suggest;

/// A value of the wrong shape.
pub(crate) struct ShapeProblem {
    pub(crate) path: Vec<String>,
    pub(crate) rule: &'static str,
    pub(crate) message: String,
    pub(crate) hint: Option<String>,
    /// The key is meant, not its value.
    pub(crate) about_key: bool,
}

/// Reads a `T` from what stands at `base`. What has the wrong shape is reported, marked as bad in `root`, and left out. `None`: not
/// even the rest is a `T`.
pub(crate) fn read<T: DeserializeOwned>(
    root: &mut Marked,
    base: &[&str],
    report: &mut dyn FnMut(&Marked, ShapeProblem),
) -> Option<T> {
    let mut json = root.locate(base).value.to_json();
    for _ in 0..=MAX_PROBLEMS {
        let (json_path, message) = match serde_path_to_error::deserialize(&json) {
            Ok(value) => return Some(value),
            Err(error) => (segments(error.path()), error.into_inner().to_string()),
        };
        let own_path = root.locate(base).value.own_path(&json_path);
        let path: Vec<String> = base.iter().map(|&part| part.to_owned()).chain(own_path).collect();
        report(root, explain(&path, &message));
        match root.get_mut(&path) {
            Some(wrong) if !path.is_empty() && !matches!(wrong.tree, Tree::Bad) => wrong.tree = Tree::Bad,
            _ => return None,
        }
        remove(&mut json, &json_path)?;
    }
    None
}

/// Takes the value at `path` out. `None`: there is nothing, or it is `json` itself.
fn remove(json: &mut Value, path: &[String]) -> Option<Value> {
    let (last, parents) = path.split_last()?;
    let mut parent = json;
    for part in parents {
        parent = match parent {
            Value::Object(map) => map.get_mut(part)?,
            Value::Array(items) => items.get_mut(part.parse::<usize>().ok()?)?,
            _ => return None,
        };
    }
    match parent {
        Value::Object(map) => map.remove(last),
        Value::Array(items) => {
            last.parse().ok().filter(|&index: &usize| index < items.len()).map(|index| items.remove(index))
        }
        _ => None,
    }
}

/// A path of serde as a list of keys and indices.
pub(crate) fn segments(path: &serde_path_to_error::Path) -> Vec<String> {
    let part = |segment: &Segment| match segment {
        Segment::Map { key } => Some(key.clone()),
        Segment::Enum { variant } => Some(variant.clone()),
        Segment::Seq { index } => Some(index.to_string()),
        Segment::Unknown => None,
    };
    path.iter().filter_map(part).collect()
}

/// Says in our words what serde says in its own.
pub(crate) fn explain(path: &[String], message: &str) -> ShapeProblem {
    let problem =
        |rule, message: String, hint, about_key| ShapeProblem { path: path.to_vec(), rule, message, hint, about_key };
    if let Some(rest) = message.strip_prefix("unknown field ") {
        let (got, allowed) = names(rest);
        return problem(
            "unknown-key",
            format!("unknown key `{}`", suggest::shorten(&got)),
            Some(choose(&got, &allowed)),
            true,
        );
    }
    if let Some(rest) = message.strip_prefix("unknown variant ") {
        let (got, allowed) = names(rest);
        let message = format!("got `{}`, allowed are {}", suggest::shorten(&got), listed(&allowed));
        let hint =
            suggest::nearest(&got, allowed.iter().map(String::as_str)).map(|name| format!("did you mean `{name}`?"));
        return problem("wrong-value", message, hint, false);
    }
    if let Some(rest) = message.strip_prefix("missing field ") {
        let hint = format!("write `{}: ...` here", rest.trim_matches('`'));
        return problem("missing-key", format!("{rest} is missing"), Some(hint), true);
    }
    if message.contains("got several writers") {
        let hint = "name one `node/port`; to merge two outputs, put an operator in between".to_owned();
        return problem("several-writers", message.to_owned(), Some(hint), false);
    }
    for (prefix, rule) in
        [("invalid type: ", "wrong-type"), ("invalid value: ", "wrong-value"), ("invalid length ", "wrong-value")]
    {
        if let Some((got, expected)) = message.strip_prefix(prefix).and_then(|rest| rest.rsplit_once(", expected ")) {
            return problem(rule, format!("got {}, allowed is {}", got_words(got), type_words(expected)), None, false);
        }
    }
    problem("wrong-value", message.to_owned(), None, false)
}

/// The names in backticks: the first is what we got, the rest is what is allowed.
fn names(text: &str) -> (String, Vec<String>) {
    let (got, rest) = match text.rsplit_once(", expected ") {
        Some((got, rest)) => (got, rest),
        None => (text.split(", there are no").next().unwrap_or(text), ""),
    };
    let allowed = rest.split('`').skip(1).step_by(2).map(str::to_owned).collect();
    (got.trim_matches('`').to_owned(), allowed)
}

fn listed(allowed: &[String]) -> String {
    suggest::list(allowed.iter().map(String::as_str)).unwrap_or_else(|| "none".into())
}

fn choose(got: &str, allowed: &[String]) -> String {
    match suggest::nearest(got, allowed.iter().map(String::as_str)) {
        Some(nearest) => format!("did you mean `{nearest}`?"),
        None if allowed.is_empty() => "no keys are allowed here".into(),
        None => format!("allowed are {}", listed(allowed)),
    }
}

fn got_words(got: &str) -> String {
    if let Some(text) = got.strip_prefix("string ") {
        return format!("the text {}", suggest::shorten(text));
    }
    for kind in ["integer `", "floating point `", "boolean `"] {
        if let Some(value) = got.strip_prefix(kind) {
            return value.trim_end_matches('`').to_owned();
        }
    }
    match got {
        "null" | "unit value" => "nothing".into(),
        "sequence" => "a list".into(),
        "map" => "a map".into(),
        other => other.to_owned(),
    }
}

fn type_words(expected: &str) -> String {
    match expected {
        "f32" | "f64" => "a number".into(),
        "u8" => "a whole number from 0 to 255".into(),
        "u16" => "a whole number from 0 to 65535".into(),
        "u32" | "u64" | "usize" => "a whole number, 0 or more".into(),
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number".into(),
        "a boolean" => "`true` or `false`".into(),
        "a string" => "a text".into(),
        "a sequence" => "a list".into(),
        "string or map" => "a name, or a map with one key".into(),
        "a map" => "a map of keys and values".into(),
        other if other.starts_with("struct ") => "a map of keys and values".into(),
        other => other.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(message: &str) -> (String, Option<String>) {
        let problem = explain(&[], message);
        (problem.message, problem.hint)
    }

    #[test]
    fn speaks_of_texts_and_numbers_not_of_strings_and_u8() {
        let (message, _) = said("invalid type: string \"abc\", expected u8");
        assert_eq!(message, "got the text \"abc\", allowed is a whole number from 0 to 255", "wrong type");
        let (message, hint) = said("unknown field `treshold`, expected one of `threshold`, `mode`");
        assert_eq!(
            (message.as_str(), hint.as_deref()),
            ("unknown key `treshold`", Some("did you mean `threshold`?")),
            "key"
        );
        let (message, hint) = said("unknown variant `skp`, expected one of `warn`, `skip`, `stop`");
        assert_eq!(message, "got `skp`, allowed are `warn`, `skip`, `stop`", "variant");
        assert_eq!(hint.as_deref(), Some("did you mean `skip`?"), "hint of a variant");
    }
}
