//! `path=value,path=value`: other values for a node's configuration. Commas within brackets and quotes belong to the value.

use anyhow::{Result, anyhow, bail};
use carril_runtime::graph::read_value;
use serde_json::{Map, Value};

/// Reads assignments; several texts count as one.
pub fn parse(texts: &[String]) -> Result<Map<String, Value>> {
    let mut values = Map::new();
    for assignment in texts.iter().flat_map(|text| split(text)) {
        let (path, value) = assignment
            .split_once('=')
            .ok_or_else(|| anyhow!("got `{assignment}`, expected `path=value`, for example `threshold=180`"))?;
        let path = path.trim();
        if path.is_empty() || path.split('.').any(str::is_empty) {
            bail!("got `{assignment}`, expected a path before `=`, for example `sectors.0.from_deg=-30`");
        }
        values.insert(path.to_owned(), read_value(value).map_err(|reason| anyhow!("`{path}`: {reason}"))?);
    }
    Ok(values)
}

fn split(text: &str) -> Vec<&str> {
    let (mut parts, mut start, mut depth, mut quote) = (Vec::new(), 0, 0_usize, None);
    for (at, letter) in text.char_indices() {
        match (quote, letter) {
            (Some(open), _) if letter == open => quote = None,
            (Some(_), _) => {}
            (None, '"' | '\'') => quote = Some(letter),
            (None, '[' | '{') => depth += 1,
            (None, ']' | '}') => depth = depth.saturating_sub(1),
            (None, ',') if depth == 0 => {
                parts.push(&text[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&text[start..]);
    parts
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn divides_at_commas_outside_of_values() {
        let values = parse(&["threshold=180,rows=[0.7, 0.8]".into(), "name='a,b'".into()]).expect("they are valid");
        assert_eq!(
            Value::Object(values),
            json!({ "threshold": 180, "rows": [0.7, 0.8], "name": "a,b" }),
            "all of them"
        );
    }

    #[test]
    fn says_what_it_expects() {
        for text in ["threshold", "=1", "a..b=1", "a=1,", "a=[1"] {
            let error = parse(&[text.to_owned()]).expect_err("it is not valid").to_string();
            assert!(error.contains("expected") || error.contains("YAML"), "{text}: {error}");
        }
    }
}
