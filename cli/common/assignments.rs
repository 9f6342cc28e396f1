//! `path=value,path=value`: other values for a node's configuration, as commands take them.

use anyhow::Result;
use carril_runtime::graph::parse_values;
use serde_json::{Map, Value};

use super::graph_file::Usage;

/// Reads assignments; several texts count as one. What is none is a wrong command line.
pub fn parse(texts: &[String]) -> Result<Map<String, Value>> {
    let mut values = Map::new();
    for text in texts {
        for (path, value) in parse_values(text).map_err(|error| Usage(error.to_string()))? {
            if values.insert(path.clone(), value).is_some() {
                return Err(Usage(format!("`{path}` is given twice")).into());
            }
        }
    }
    Ok(values)
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
