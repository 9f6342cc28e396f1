//! A value as YAML on one line, as the reader in `yaml.rs` reads it again. Pure.

use std::fmt::Write;

use serde_json::Value;

use super::yaml::resolve_plain;

/// `{ hsv: { h: [90, 130] } }`, `"sim:mcu"`, `0.5`
pub fn flow_text(value: &Value) -> String {
    match value {
        Value::Null => "null".into(),
        Value::Bool(_) | Value::Number(_) => value.to_string(),
        Value::String(text) => quoted(text),
        Value::Array(items) => {
            let items: Vec<String> = items.iter().map(flow_text).collect();
            format!("[{}]", items.join(", "))
        }
        Value::Object(map) if map.is_empty() => "{}".into(),
        Value::Object(map) => {
            let entries: Vec<String> = map.iter().map(|(key, value)| entry(key, &flow_text(value))).collect();
            format!("{{ {} }}", entries.join(", "))
        }
    }
}

/// `key: value`
pub(super) fn entry(key: &str, value: &str) -> String {
    format!("{}: {value}", quoted(key))
}

/// A text, in quotes where it would mean something else without.
pub(super) fn quoted(text: &str) -> String {
    let ordinary = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '.' | '/' | '-');
    let begins_well = text.starts_with(|c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '.' | '/'));
    let stays_text = matches!(resolve_plain(text), Ok(Value::String(_)));
    if begins_well && stays_text && text.chars().all(ordinary) && !text.starts_with("...") {
        return text.to_owned();
    }
    double_quoted(text)
}

/// In double quotes.
pub(super) fn double_quoted(text: &str) -> String {
    let mut quoted = String::with_capacity(text.len() + 2);
    quoted.push('"');
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            '\n' => quoted.push_str("\\n"),
            '\t' => quoted.push_str("\\t"),
            // Control characters, line ends of Unicode, the byte order mark, and what YAML does not count as printable.
            c if c.is_control() || matches!(c, '\u{2028}' | '\u{2029}' | '\u{feff}' | '\u{fffe}' | '\u{ffff}') => {
                let _ = write!(quoted, "\\u{:04x}", c as u32);
            }
            c => quoted.push(c),
        }
    }
    quoted.push('"');
    quoted
}

/// In single quotes; `None`: it has characters that only double quotes can hold.
pub(super) fn single_quoted(text: &str) -> Option<String> {
    let plain = double_quoted(text).replace("\\\\", "\\").replace("\\\"", "\"");
    (plain[1..plain.len() - 1] == *text).then(|| format!("'{}'", text.replace('\'', "''")))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::graph::{source::Source, yaml};

    fn read(text: &str) -> Option<Value> {
        let (root, problems) = yaml::read(&Source::new("test.yaml".into(), text.into()));
        problems.is_empty().then(|| root.map(|root| root.to_json())).flatten()
    }

    #[test]
    fn quotes_only_what_needs_it() {
        let value = json!({ "port": "sim:mcu", "source": "/dev/video0", "on": true, "word": "true", "h": [170, 10], "n": null });
        let expected = r#"{ h: [170, 10], n: null, on: true, port: "sim:mcu", source: /dev/video0, word: "true" }"#;
        assert_eq!(flow_text(&value), expected, "as a person would write it");
        assert_eq!(single_quoted("it's"), Some("'it''s'".into()), "single quotes");
        assert_eq!(single_quoted("a\nb"), None, "which cannot hold a line end");
    }

    proptest! {
        #[test]
        fn every_text_comes_back(text in any::<String>()) {
            prop_assert_eq!(read(&format!("a: {}", quoted(&text))), Some(json!({ "a": text })));
            if let Some(single) = single_quoted(&text) {
                prop_assert_eq!(read(&format!("{{ a: {single} }}")), Some(json!({ "a": text })));
            }
        }

        #[test]
        fn every_number_comes_back(number in any::<f64>().prop_filter("YAML has no others here", |n| n.is_finite())) {
            prop_assert_eq!(read(&format!("a: {}", flow_text(&json!(number)))), Some(json!({ "a": number })));
        }
    }
}
