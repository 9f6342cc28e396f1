use std::path::Path;

use proptest::prelude::*;
use serde_json::json;

use super::*;

/// A file in every style at once.
const STYLES: &str = r#"robot: car1   # the car
nodes:
  flow: { operator: a, config: { a: 1, b: "x", }, inputs: {} }   # one line
  block:
    operator: b
    config:
      a: 1        # stays
      name: 'it''s'

      # about sectors
      sectors:
        - { name: front, from_deg: -30 }
        - name: left
          from_deg: 30   # degrees
      empty:
    deadline_ms: 10
  bare:
    operator: c   # no config at all
  wide:
    operator: d
    config: {
      a: 1,   # first
      b: [1, 2]   # last
    }
  base: { operator: e, config: &base { a: 1, deep: { x: 1 } } }
  copy: { operator: e, config: *base }
"#;

fn set(text: &str, node: &str, path: &str, value: Value) -> Result<String, EditError> {
    edit(text, node, &Map::from_iter([(path.to_owned(), value)]), &Value::Null)
}

/// The lines that are no more, and those that are new.
fn difference(old: &str, new: &str) -> (Vec<String>, Vec<String>) {
    let (mut old, mut new): (Vec<&str>, Vec<&str>) = (old.split('\n').collect(), new.split('\n').collect());
    while !old.is_empty() && old.first() == new.first() {
        (old, new) = (old.split_off(1), new.split_off(1));
    }
    while !old.is_empty() && old.last() == new.last() {
        (_, _) = (old.pop(), new.pop());
    }
    let owned = |lines: Vec<&str>| lines.into_iter().map(str::to_owned).collect();
    (owned(old), owned(new))
}

fn changed_lines(node: &str, path: &str, value: Value) -> String {
    let edited = set(STYLES, node, path, value).unwrap_or_else(|error| panic!("{node} {path}: {error}"));
    let (old, new) = difference(STYLES, &edited);
    format!("{}\n=>\n{}", old.join("\n"), new.join("\n"))
}

#[test]
fn a_value_changes_and_its_line_stays_as_it_was_written() {
    let line = |node, path, value| changed_lines(node, path, value);
    assert_eq!(
        line("flow", "a", json!(2.5)),
        "  flow: { operator: a, config: { a: 1, b: \"x\", }, inputs: {} }   # one line\n=>\n  flow: { operator: a, config: { \
         a: 2.5, b: \"x\", }, inputs: {} }   # one line",
        "in a flow map"
    );
    assert!(line("flow", "b", json!("y z")).contains("b: \"y z\", }"), "double quotes stay");
    assert_eq!(
        line("block", "a", json!("otsu")),
        "      a: 1        # stays\n=>\n      a: otsu        # stays",
        "a word"
    );
    assert_eq!(
        line("block", "name", json!("that's")),
        "      name: 'it''s'\n=>\n      name: 'that''s'",
        "single quotes"
    );
    assert_eq!(
        line("block", "sectors.1.from_deg", json!(-3)),
        "          from_deg: 30   # degrees\n=>\n          from_deg: -3   # degrees",
        "an item of a list"
    );
    assert!(
        line("block", "sectors.0.from_deg", json!(5)).ends_with("- { name: front, from_deg: 5 }"),
        "in both styles"
    );
    assert_eq!(line("block", "empty", json!(1)), "      empty:\n=>\n      empty: 1", "a key without a value");
    assert!(line("wide", "b", json!([3])).ends_with("      b: [3]   # last"), "a list");
    assert_eq!(set(STYLES, "flow", "a", json!(1)).as_deref(), Ok(STYLES), "what is there already changes nothing");
}

#[test]
fn a_new_key_comes_in_the_style_of_its_neighbours() {
    let line = |node, path, value| changed_lines(node, path, value);
    assert!(line("flow", "c", json!(true)).contains("{ a: 1, b: \"x\", c: true, }"), "in a flow map");
    assert_eq!(line("block", "z", json!(1)), "\n=>\n      z: 1".trim_start_matches(' '), "in a block map");
    assert_eq!(line("block", "sectors.1.limit_m", json!(2)), "\n=>\n          limit_m: 2", "in an item of a list");
    assert!(line("block", "sectors.0.limit_m", json!(2)).ends_with("from_deg: -30, limit_m: 2 }"), "in a flow item");
    assert_eq!(line("bare", "a.b", json!("x: y")), "\n=>\n    config: { a: { b: \"x: y\" } }", "no config at all");
    assert_eq!(line("block", "empty.x", json!(1)), "      empty:\n=>\n      empty: { x: 1 }", "in nothing");
    assert_eq!(
        line("wide", "c", json!(1)),
        "      b: [1, 2]   # last\n=>\n      b: [1, 2],   # last\n      c: 1",
        "a key to a line, and the comment stays with its key"
    );
}

#[test]
fn a_list_that_the_file_leaves_to_its_default_is_written_as_a_whole() {
    let effective =
        json!({ "sectors": [{ "name": "front", "from_deg": -30.0 }, { "name": "left", "from_deg": 30.0 }] });
    let values = Map::from_iter([("sectors.1.from_deg".to_owned(), json!(35))]);
    let edited = edit(STYLES, "bare", &values, &effective).expect("the list is known");
    let line = "    config: { sectors: [{ from_deg: -30, name: front }, { from_deg: 35, name: left }] }";
    assert_eq!(difference(STYLES, &edited), (vec![], vec![line.to_owned()]), "one line");
}

#[test]
fn what_would_change_something_else_is_refused_with_its_line() {
    let refused = |node, path, value| set(STYLES, node, path, value).expect_err("refused").to_string();
    assert!(
        refused("base", "a", json!(2)).starts_with("line 25: `base.config` is shared through an anchor"),
        "an anchor"
    );
    assert!(refused("copy", "a", json!(2)).contains("`copy.config` is shared"), "an alias");
    assert!(refused("copy", "new", json!(2)).contains("`copy.config` is shared"), "a new key in an alias");
    assert!(
        refused("block", "sectors", json!([])).starts_with("line 11: `block.config.sectors` stands on several lines"),
        "a block"
    );
    assert!(refused("block", "sectors.7.x", json!(1)).contains("the list has 2 items"), "beyond the end");
    assert!(refused("block", "a.b", json!(1)).contains("lies below a value that has no parts"), "below a number");
    assert_eq!(refused("nobody", "a", json!(1)), "the file has no node `nobody`", "another node");
    assert!(refused("flow", "b", json!("x".repeat(1 << 20))).contains("has at most 1048576 B"), "a megabyte");
    assert!(set("nodes: [", "a", "b", json!(1)).is_err_and(|e| e.to_string().starts_with("line ")), "no YAML");
}

#[test]
fn line_ends_stay_as_they_are() {
    let windows = "nodes:\r\n  a:\r\n    operator: x\r\n    config:\r\n      k: 1\r\n";
    let edited = set(windows, "a", "l", json!(2)).expect("it can");
    assert_eq!(edited, format!("{windows}      l: 2\r\n"), "as in the rest of the file");
    let without = windows.trim_end();
    assert_eq!(set(without, "a", "l", json!(2)), Ok(format!("{without}\r\n      l: 2")), "no line end at the end");
    let marked = "\u{feff}nodes: { ä: { config: { k: ü } } }\n";
    assert_eq!(
        set(marked, "ä", "k", json!("ö")),
        Ok(marked.replace('ü', "\"ö\"")),
        "positions are bytes, not characters"
    );
}

fn files() -> Vec<(String, String)> {
    let top = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let folders = ["dataflows", "tests/dataflows/good"].map(|folder| top.join(folder).read_dir().expect("it is there"));
    let mut paths: Vec<_> = folders.into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|ending| ending == "yaml"));
    paths.push(top.join("dataflow.yaml"));
    paths.sort();
    let read = |path: std::path::PathBuf| (path.display().to_string(), std::fs::read_to_string(&path).expect("text"));
    paths.into_iter().map(read).collect()
}

/// Every node with the paths of all that its configuration says.
fn places(text: &str) -> Vec<(String, String)> {
    fn leaves(value: &Value, path: &str, found: &mut Vec<String>) {
        let below = |part: &str| if path.is_empty() { part.to_owned() } else { format!("{path}.{part}") };
        match value {
            Value::Object(map) => map.iter().for_each(|(key, value)| leaves(value, &below(key), found)),
            Value::Array(items) => {
                items.iter().enumerate().for_each(|(index, item)| leaves(item, &below(&index.to_string()), found));
            }
            _ => found.push(path.to_owned()),
        }
    }
    let root = read(text).expect("a good file").marked.to_json();
    let nodes = root["nodes"].as_object().expect("a map").clone();
    let of_node = |(name, node): (String, Value)| {
        let mut paths = vec!["new_key".to_owned(), "new_map.new_key".to_owned()];
        if let Some(config) = node.get("config") {
            leaves(config, "", &mut paths);
        }
        paths.into_iter().filter(|path| !path.is_empty()).map(move |path| (name.clone(), path))
    };
    nodes.into_iter().flat_map(of_node).collect()
}

fn any_value() -> impl Strategy<Value = Value> {
    let scalar = prop_oneof![
        any::<i32>().prop_map(Value::from),
        any::<f64>().prop_filter("YAML has no others here", |n| n.is_finite()).prop_map(Value::from),
        any::<bool>().prop_map(Value::from),
        any::<String>().prop_map(Value::from),
        "[a-z:#{}, '\"]{0,12}".prop_map(Value::from),
    ];
    let list = proptest::collection::vec(scalar.clone(), 0..4).prop_map(Value::from);
    let map = proptest::collection::btree_map("[a-z]{1,6}", scalar.clone(), 0..3).prop_map(|map| json!(map));
    prop_oneof![4 => scalar, 1 => list, 1 => map]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_value_goes_into_any_place_of_any_file_and_no_other_line_changes(value in any_value(), pick in any::<usize>()) {
        for (name, text) in files().into_iter().chain([("styles".to_owned(), STYLES.to_owned())]) {
            let mut places = places(&text);
            places.retain(|(node, _)| !["base", "copy"].contains(&node.as_str()));
            let (node, path) = &places[pick % places.len()];
            let edited = set(&text, node, path, value.clone());
            prop_assert!(edited.is_ok(), "{name}: {node} {path}={value}: {edited:?}");
            let edited = edited.expect("checked above");
            let root = read(&edited).expect("the result is YAML").marked.to_json();
            prop_assert_eq!(value_at(&root["nodes"][node]["config"], path), Some(&value), "{}: {} {}", name, node, path);
            let (old, new) = difference(&text, &edited);
            prop_assert!(old.len() <= 1 && new.len() <= old.len() + 1, "{name}: {node} {path}: {old:?} => {new:?}");
        }
    }

    #[test]
    fn nothing_makes_it_panic(text in "[\\[\\]{}:,&*!|>'\"%#? \nab1-]{0,60}", path in "[a-z0-9.]{0,6}", value in any_value()) {
        let _ = set(&format!("nodes:\n  a: {text}\n"), "a", &path, value.clone());
        let _ = set(&format!("nodes:\n  a:\n    config:\n      {text}\n"), "a", &path, value);
    }
}
