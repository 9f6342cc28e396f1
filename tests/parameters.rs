//! What schemas say of parameters, held against what operators do: every number has a text, a unit (or says that it has none) and
//! a range, and the operator's check refuses just what lies outside of it.

use std::path::Path;

use carril_runtime::parameters::{Parameter, parameters, with_values};
use carril_runtime::{OperatorKind, Registry};
use serde_json::{Map, Value, json};

fn registry() -> Registry {
    carril_operators::registry().and(carril_bridge::registry()).and(carril_simulator::registry())
}

/// Configurations that show every parameter of a kind, optional ones and other choices too.
fn examples(kind: &str) -> Vec<Value> {
    match kind {
        "camera" => vec![json!({ "source": "/dev/video0", "width": 640, "height": 480 })],
        "mcu-link" => vec![
            json!({ "port": "sim:mcu", "baud": 500_000 }),
            json!({ "port": "/dev/ttyUSB0", "protocol": "rosserial", "stock": {} }),
        ],
        "sim-avr" => vec![json!({ "program": "simulated-chip", "elf": "firmware.elf" })],
        "lane-detector" => vec![json!({ "metres_per_px": 0.1 }), json!({ "marking": { "hsv": { "h": [10, 20] } } })],
        "lane-lines" => vec![json!({}), json!({ "marking": { "hsv": { "h": [10, 20] } } })],
        "lidar-sectors" => vec![json!({ "masks": [{ "from_deg": 10, "to_deg": 20 }] })],
        "traffic-light" => vec![json!({ "stop_line": {} })],
        "rplidar" => vec![json!({ "port": "sim:lidar" })],
        "sim-world" => vec![json!({ "estop_pressed_s": [[1, 2]], "obstacles": [{ "along_m": 4 }] })],
        _ => vec![json!({})],
    }
}

/// What must be set besides, so that a parameter can reach the ends of its range.
fn company(kind: &str, path: &str) -> Value {
    match (kind, path) {
        ("decision", "cruise_speed_m_s" | "coast_speed_m_s") => json!({ "max_speed_m_s": 20 }),
        ("decision", "overtake.change_min_m") => json!({ "overtake": { "change_max_m": 20 } }),
        ("decision", "overtake.change_max_m") => json!({ "overtake": { "change_min_m": 0.3 } }),
        ("decision", "obstacle_clear_m") => json!({ "obstacle_stop_m": 1e-13 }),
        ("lane-detector" | "lane-lines", "row_near") => json!({ "row_far": 0 }),
        ("traffic-light", "max_radius_px") => json!({ "min_radius_px": 1 }),
        ("rplidar", "range_max_m") => json!({ "range_min_m": 0 }),
        _ => json!({}),
    }
}

/// Whether the check accepts the value at the path, whatever it says of other values.
fn accepts(kind: &OperatorKind, config: &Value, path: &str, value: Value) -> bool {
    let mut values = Map::from_iter([(path.to_owned(), value)]);
    values.extend(company(kind.name, path).as_object().expect("a map").clone());
    let config = with_values(config, &values).expect("the path is there");
    let found = kind.check_config(&config, Path::new("."), false);
    !found.iter().any(|finding| path.starts_with(&finding.path.join(".")))
}

/// `value` moved a little: up with `1`, down with `-1`.
fn beside(value: f64, direction: f64, whole: bool) -> Value {
    if whole { json!((value + direction) as i64) } else { json!(value + direction * value.abs().max(1e-6) * 1e-6) }
}

fn number(value: f64, whole: bool) -> Value {
    if whole { json!(value as i64) } else { json!(value) }
}

/// Paths of the numbers in a parameter; a list of numbers has several.
fn numbers(parameter: &Parameter) -> Vec<(String, bool)> {
    let is_whole = |value: &Value| value.is_i64() || value.is_u64();
    match &parameter.value {
        Value::Array(items) if items.iter().all(Value::is_number) && !items.is_empty() => {
            vec![(format!("{}.0", parameter.path), is_whole(&items[0]))]
        }
        value if value.is_number() => vec![(parameter.path.clone(), is_whole(value))],
        _ => Vec::new(),
    }
}

#[test]
fn every_number_has_text_unit_and_a_range_that_its_check_agrees_with() {
    let mut checked = 0;
    for kind in registry().iter() {
        let schema = kind.config_schema();
        for config in examples(kind.name) {
            let config = kind.effective_config(&config);
            for parameter in parameters(&schema, &config) {
                let name = format!("{} {}", kind.name, parameter.path);
                assert!(!parameter.text.is_empty(), "{name}: no text; write a doc comment");
                for (path, whole) in numbers(&parameter) {
                    checked += 1;
                    assert!(
                        says_unit(&schema, &parameter),
                        "{name}: no `unit`; `extend(\"unit\" = \"\")` if it has none"
                    );
                    check_range(kind, &config, &parameter, &path, whole);
                }
            }
        }
    }
    assert!(checked > 80, "only {checked} numbers were found");
}

/// A unit, or that there is none.
fn says_unit(schema: &Value, parameter: &Parameter) -> bool {
    let last = parameter.path.split('.').rfind(|part| part.parse::<usize>().is_err()).expect("a name");
    parameter.unit.is_some() || every_property(schema, last).iter().any(|property| property.get("unit").is_some())
}

fn every_property<'a>(schema: &'a Value, name: &str) -> Vec<&'a Value> {
    let definitions = schema["$defs"].as_object().into_iter().flat_map(|all| all.values());
    definitions.chain([schema]).filter_map(|object| object["properties"].get(name)).collect()
}

fn check_range(kind: &OperatorKind, config: &Value, parameter: &Parameter, path: &str, whole: bool) {
    let name = format!("{} {path}", kind.name);
    let range = &parameter.range;
    let bound = |bound: &Option<Value>| bound.as_ref().and_then(Value::as_f64);
    assert!(range.minimum.is_some() || range.exclusive_minimum.is_some(), "{name}: the schema has no lower bound");
    if let Some(min) = bound(&range.minimum) {
        assert!(
            accepts(kind, config, path, number(min, whole)),
            "{name}: {min} is in the schema's range, the check refuses it"
        );
        let below = beside(min, -1.0, whole);
        assert!(
            !accepts(kind, config, path, below.clone()),
            "{name}: {below} is outside of the schema's range, the check takes it"
        );
    }
    if let Some(min) = bound(&range.exclusive_minimum) {
        assert!(
            !accepts(kind, config, path, number(min, whole)),
            "{name}: {min} is outside of the schema's range, the check takes it"
        );
        let above = beside(min, 1.0, whole);
        assert!(
            accepts(kind, config, path, above.clone()),
            "{name}: {above} is in the schema's range, the check refuses it"
        );
    }
    if let Some(max) = bound(&range.maximum) {
        assert!(
            accepts(kind, config, path, number(max, whole)),
            "{name}: {max} is in the schema's range, the check refuses it"
        );
        let above = beside(max, 1.0, whole);
        assert!(
            !accepts(kind, config, path, above.clone()),
            "{name}: {above} is outside of the schema's range, the check takes it"
        );
    } else {
        // Spans of time end after they begin: no bound of their own.
        let unbounded = path == "estop_pressed_s.0.0" || accepts(kind, config, path, number(1e12, whole));
        assert!(unbounded, "{name}: the schema has no upper bound, the check has");
    }
}

#[test]
fn effective_configurations_have_every_default_and_mean_the_same() {
    for kind in registry().iter() {
        for config in examples(kind.name) {
            let effective = kind.effective_config(&config);
            assert_eq!(kind.check_shape(&effective), None, "{}: its own words", kind.name);
            assert_eq!(kind.effective_config(&effective), effective, "{}: nothing is left to fill in", kind.name);
            let required: Map<String, Value> = config.as_object().expect("a map").clone();
            let again = with_values(&effective, &required).expect("the paths are there");
            assert_eq!(kind.effective_config(&again), effective, "{}: what was given stays", kind.name);
        }
    }
    let mcu = registry();
    let mcu = mcu.get("sim-mcu").expect("it is there");
    assert_eq!(mcu.effective_config(&Value::Null)["battery_low_v"], json!(6.4), "as a person would write it");
}
