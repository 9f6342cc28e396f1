//! The parameters of an operator as people see them: each value of a configuration with its default, range, unit and text from
//! the JSON Schema. Also follows paths such as `sectors.2.from_deg`. Pure; the operator's own check has the last word.

use std::fmt;

use serde::Serialize;
use serde_json::{Map, Value};

use crate::graph::{apply_value, flow_text, suggest};

/// References and choices of a schema are followed so deep.
const DEEPEST: usize = 8;

/// One value of a configuration.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Parameter {
    /// `sectors.2.from_deg`
    pub path: String,
    /// As configured.
    pub value: Value,
    /// `None`: it must be given.
    pub default: Option<Value>,
    /// What may be set.
    #[serde(flatten)]
    pub range: Range,
    /// `m/s`; `None`: it has none.
    pub unit: Option<String>,
    /// What it does.
    pub text: String,
}

/// What may be set.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Range {
    /// Smallest number.
    pub minimum: Option<Value>,
    /// Largest number that is too small.
    pub exclusive_minimum: Option<Value>,
    /// Largest number.
    pub maximum: Option<Value>,
    /// Words, besides numbers or instead of them.
    pub words: Vec<String>,
}

impl fmt::Display for Range {
    /// `0 to 255 | otsu`, `> 0 to 1`, `>= 0`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let above = self.exclusive_minimum.as_ref().map(|min| format!("> {}", shown(min)));
        let from = above.or_else(|| self.minimum.as_ref().map(shown));
        let numbers = match (from, &self.maximum) {
            (Some(from), Some(max)) => Some(format!("{from} to {}", shown(max))),
            (Some(from), None) if self.exclusive_minimum.is_some() => Some(from),
            (Some(from), None) => Some(format!(">= {from}")),
            (None, Some(max)) => Some(format!("<= {}", shown(max))),
            (None, None) => None,
        };
        let choices: Vec<String> = numbers.into_iter().chain(self.words.iter().cloned()).collect();
        f.write_str(&choices.join(" | "))
    }
}

/// A value as people read it: YAML on one line, whole numbers without `.0`.
pub fn shown(value: &Value) -> String {
    match value {
        Value::Null => "none".into(),
        other => flow_text(&whole(other)),
    }
}

/// Whole numbers as integers, where that loses nothing.
pub(crate) fn whole(value: &Value) -> Value {
    match value {
        Value::Number(number) => match number.as_f64() {
            Some(float) if !number.is_i64() && !number.is_u64() && float.fract() == 0.0 && float.abs() < 1e15 => {
                (float as i64).into()
            }
            _ => value.clone(),
        },
        Value::Array(items) => items.iter().map(whole).collect(),
        Value::Object(map) => Value::Object(map.iter().map(|(key, value)| (key.clone(), whole(value))).collect()),
        other => other.clone(),
    }
}

/// Every parameter of a configuration whose defaults are filled in, in the order of its keys. A list of plain values is one
/// parameter, a list of maps has one for each value in it.
pub fn parameters(schema: &Value, config: &Value) -> Vec<Parameter> {
    let mut found = Vec::new();
    walk(schema, &Spot { schema, list: None, value: config, default: None, path: String::new() }, &mut found);
    found
}

/// A value on the way.
struct Spot<'a> {
    schema: &'a Value,
    /// Schema of the list that it is an item of.
    list: Option<&'a Value>,
    value: &'a Value,
    default: Option<&'a Value>,
    path: String,
}

fn walk(root: &Value, spot: &Spot<'_>, found: &mut Vec<Parameter>) {
    let parts: Vec<(String, &Value)> = match spot.value {
        Value::Object(map) => map.iter().map(|(key, value)| (key.clone(), value)).collect(),
        Value::Array(items) if items.iter().any(|item| item.is_object() || item.is_array()) => {
            items.iter().enumerate().map(|(index, item)| (index.to_string(), item)).collect()
        }
        _ => Vec::new(),
    };
    if parts.is_empty() && !spot.path.is_empty() {
        found.push(parameter(root, spot));
    }
    for (part, value) in parts {
        let schema = part_schema(root, spot.schema, &part).unwrap_or(&Value::Null);
        let own = facets(root, schema).into_iter().find_map(|facet| facet.get("default"));
        let default = spot.default.and_then(|default| part_of(default, &part)).or(own);
        let path = if spot.path.is_empty() { part } else { format!("{}.{part}", spot.path) };
        let list = spot.value.is_array().then_some(spot.schema);
        walk(root, &Spot { schema, list, value, default, path }, found);
    }
}

fn parameter(root: &Value, spot: &Spot<'_>) -> Parameter {
    let own = facets(root, spot.schema);
    let items: Vec<&Value> = own.iter().filter_map(|facet| facet.get("items")).collect();
    let items = items.into_iter().flat_map(|item| facets(root, item));
    let list = spot.list.into_iter().flat_map(|list| facets(root, list));
    let facets: Vec<&Value> = own.into_iter().chain(items).chain(list).collect();
    let text_of = |key: &str| facets.iter().find_map(|facet| facet[key].as_str());
    let unit = text_of("unit").filter(|unit| !unit.is_empty()).map(str::to_owned);
    let text = text_of("description").unwrap_or_default().replace('\n', " ");
    let (path, value) = (spot.path.clone(), spot.value.clone());
    Parameter { path, value, default: spot.default.cloned(), range: range(&facets), unit, text }
}

fn range(facets: &[&Value]) -> Range {
    let number = |key: &str| facets.iter().find_map(|facet| facet.get(key).filter(|value| value.is_number()).cloned());
    let exclusive_minimum = number("exclusiveMinimum");
    let minimum = number("minimum").filter(|_| exclusive_minimum.is_none());
    let mut words: Vec<String> = Vec::new();
    for facet in facets {
        let listed = facet["enum"].as_array().into_iter().flatten();
        words.extend(listed.chain(facet.get("const")).filter_map(Value::as_str).map(str::to_owned));
        if let (Some([key]), true) = (facet["required"].as_array().map(Vec::as_slice), facet["type"] == "object") {
            words.push(format!("{{ {}: .. }}", key.as_str().unwrap_or_default()));
        }
        if facet["type"] == "boolean" {
            words.extend(["true".to_owned(), "false".to_owned()]);
        }
    }
    Range { minimum, exclusive_minimum, maximum: number("maximum"), words }
}

/// A schema, what it refers to, and what it offers to choose from.
fn facets<'a>(root: &'a Value, schema: &'a Value) -> Vec<&'a Value> {
    let mut found = vec![schema];
    let mut from = 0;
    for _ in 0..DEEPEST {
        let mut next: Vec<&Value> = Vec::new();
        for facet in &found[from..] {
            let target = facet["$ref"].as_str().and_then(|path| path.strip_prefix('#'));
            next.extend(target.and_then(|path| root.pointer(path)));
            for several in ["anyOf", "oneOf", "allOf"] {
                next.extend(facet[several].as_array().into_iter().flatten());
            }
        }
        from = found.len();
        found.extend(next);
    }
    found
}

/// The schema of a key or an index below `schema`.
fn part_schema<'a>(root: &'a Value, schema: &'a Value, part: &str) -> Option<&'a Value> {
    facets(root, schema).into_iter().find_map(|facet| {
        let index = part.parse::<usize>().ok();
        let item = || index.and_then(|index| facet["prefixItems"].get(index).or_else(|| facet.get("items")));
        facet["properties"].get(part).or_else(item)
    })
}

fn part_of<'a>(value: &'a Value, part: &str) -> Option<&'a Value> {
    match value {
        Value::Array(items) => items.get(part.parse::<usize>().ok()?),
        other => other.get(part),
    }
}

/// The value at a path with dots. An empty path is the whole.
pub fn value_at<'a>(config: &'a Value, path: &str) -> Option<&'a Value> {
    path.split('.').filter(|part| !part.is_empty()).try_fold(config, part_of)
}

/// Why there can be nothing at `path`, with what was probably meant; `None`: there can. Keys are those of the schema, list
/// items those of the configuration.
pub fn unknown_path(schema: &Value, config: &Value, path: &str) -> Option<String> {
    let (mut at, mut value, mut parents) = (schema, Some(config), String::new());
    for part in path.split('.') {
        let whole = if parents.is_empty() { "the configuration".to_owned() } else { format!("`{parents}`") };
        if let Some(Value::Array(items)) = value
            && part.parse::<usize>().ok().is_none_or(|index| index >= items.len())
        {
            let part = suggest::shorten(part);
            return Some(format!("{whole} has {} items, counted from 0; got `{part}`", items.len()));
        }
        let Some(below) = part_schema(schema, at, part) else {
            let facets = facets(schema, at);
            let names: Vec<&str> = facets
                .iter()
                .filter_map(|facet| facet["properties"].as_object())
                .flat_map(Map::keys)
                .map(String::as_str)
                .collect();
            let hint = suggest::hint(part, names).unwrap_or_else(|| "it has no parts".to_owned());
            return Some(format!("{whole} has no `{}`; {hint}", suggest::shorten(part)));
        };
        (at, value) = (below, value.and_then(|value| part_of(value, part)));
        parents = if parents.is_empty() { part.to_owned() } else { format!("{parents}.{part}") };
    }
    None
}

/// Writes out the list that a path leads into, where a configuration leaves it to its default.
pub fn fill_in_list(config: &mut Value, effective: &Value, path: &str) {
    let ends = path.match_indices('.').map(|(at, _)| &path[..at]);
    let is_default_list =
        |prefix: &&str| value_at(effective, prefix).is_some_and(Value::is_array) && value_at(config, prefix).is_none();
    if let Some(prefix) = ends.into_iter().find(is_default_list)
        && let Some(list) = value_at(effective, prefix)
    {
        // A path that leads nowhere is reported where its value is put.
        let _ = apply_value(config, prefix, list.clone());
    }
}

/// A configuration with other values at some paths. Maps on the way are made; list items must be there.
pub fn with_values(config: &Value, values: &Map<String, Value>) -> Result<Value, String> {
    let mut changed = if config.is_null() { Value::Object(Map::new()) } else { config.clone() };
    for (path, value) in values {
        apply_value(&mut changed, path, value.clone())
            .map_err(|reason| format!("`{}`: {reason}", suggest::shorten(path)))?;
    }
    Ok(changed)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn schema() -> Value {
        json!({
            "properties": {
                "threshold": { "$ref": "#/$defs/Threshold", "default": 190.0, "description": "Divides." },
                "share": { "type": "number", "exclusiveMinimum": 0, "maximum": 1, "unit": "share", "default": 0.4 },
                "on": { "type": "boolean", "default": false },
                "hue": { "type": "array", "items": { "type": "integer", "minimum": 0, "maximum": 179 }, "unit": "half degrees" },
                "sectors": { "type": "array", "items": { "$ref": "#/$defs/Sector" }, "default": [{ "name": "front", "limit_m": 1.0 }] },
            },
            "$defs": {
                "Threshold": { "oneOf": [{ "type": "number", "minimum": 0, "maximum": 255 }, { "const": "otsu" }], "unit": "" },
                "Sector": { "properties": { "name": { "type": "string" }, "limit_m": { "type": "number", "unit": "m", "description": "Up to here." } } },
            },
        })
    }

    fn config() -> Value {
        json!({ "threshold": 180.0, "share": 0.4, "on": true, "hue": [170, 10],
            "sectors": [{ "name": "front", "limit_m": 2.5 }] })
    }

    #[test]
    fn every_value_has_its_default_range_unit_and_text() {
        let row = |one: Parameter| {
            let default = one.default.as_ref().map_or("-".into(), shown);
            format!(
                "{}={} [{default}] ({}) {} {}",
                one.path,
                shown(&one.value),
                one.range,
                one.unit.unwrap_or_default(),
                one.text
            )
        };
        let rows: Vec<String> = parameters(&schema(), &config()).into_iter().map(row).collect();
        let expected = [
            "hue=[170, 10] [-] (0 to 179) half degrees ",
            "on=true [false] (true | false)  ",
            "sectors.0.limit_m=2.5 [1] () m Up to here.",
            "sectors.0.name=front [front] ()  ",
            "share=0.4 [0.4] (> 0 to 1) share ",
            "threshold=180 [190] (0 to 255 | otsu)  Divides.",
        ];
        assert_eq!(rows, expected, "one row per value");
    }

    #[test]
    fn unknown_paths_are_named_with_what_was_meant() {
        let why = |path: &str| unknown_path(&schema(), &config(), path);
        assert_eq!(why("threshold"), None, "it is there");
        assert_eq!(why("sectors.0.limit_m"), None, "in a list");
        assert_eq!(
            why("treshold").as_deref(),
            Some("the configuration has no `treshold`; did you mean `threshold`?"),
            "key"
        );
        assert_eq!(
            why("sectors.1.limit_m").as_deref(),
            Some("`sectors` has 1 items, counted from 0; got `1`"),
            "index"
        );
        assert_eq!(
            why("sectors.0.limt_m").as_deref(),
            Some("`sectors.0` has no `limt_m`; did you mean `limit_m`?"),
            "below"
        );
        assert_eq!(why("share.x").as_deref(), Some("`share` has no `x`; it has no parts"), "below a number");
        assert!(why(&"x".repeat(1 << 20)).is_some_and(|text| text.len() < 300), "a forged name stays short");
    }

    #[test]
    fn values_are_put_where_they_belong_or_nothing_is() {
        let set = |path: &str, value: Value| with_values(&config(), &Map::from_iter([(path.to_owned(), value)]));
        assert_eq!(set("sectors.0.limit_m", json!(3)).expect("it is there")["sectors"][0]["limit_m"], 3, "in a list");
        assert_eq!(set("camera.width", json!(3)).expect("maps are made")["camera"]["width"], 3, "in a new map");
        assert!(
            set("sectors.1.limit_m", json!(3)).is_err_and(|why| why.contains("the list has 1 items")),
            "beyond the end"
        );
        assert!(set("share.x", json!(3)).is_err_and(|why| why.contains("has no parts")), "below a number");
        assert_eq!(value_at(&config(), "sectors.0.name"), Some(&json!("front")), "found again");
        assert_eq!(value_at(&config(), ""), Some(&config()), "the whole");
    }
}
