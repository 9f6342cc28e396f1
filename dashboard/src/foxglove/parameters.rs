//! The configuration of nodes as Foxglove's parameters, and back. Pure. Names are `node.path`: `lane.threshold`, `sectors.sectors.0.limit_m`.

use std::collections::BTreeMap;

use carril_runtime::control_plane::LiveNode;
use carril_runtime::parameters::parameters;
use foxglove::websocket::{Parameter, ParameterType, ParameterValue};
use serde_json::{Map, Number, Value};

/// Every value of every node, by its name. Values that are not given have no parameter.
pub fn of_graph(nodes: &[LiveNode]) -> BTreeMap<String, Parameter> {
    let of_node = |node: &LiveNode| {
        let name = node.name.clone();
        let found = parameters(&node.schema, &node.config).into_iter();
        found.map(move |one| (format!("{name}.{}", one.path), one.value)).collect::<Vec<_>>()
    };
    let all = nodes.iter().flat_map(of_node);
    all.filter_map(|(name, value)| Some((name.clone(), parameter(name, &value)?))).collect()
}

/// `None`: Foxglove cannot say it, or there is nothing to say.
fn parameter(name: String, value: &Value) -> Option<Parameter> {
    let value = to_foxglove(value)?;
    let is_float = |value: &ParameterValue| matches!(value, ParameterValue::Float64(_));
    let is_number = |value: &ParameterValue| is_float(value) || matches!(value, ParameterValue::Integer(_));
    // JSON does not tell 1.0 from 1: the type does.
    let (r#type, value) = match value {
        ParameterValue::Array(items) if items.iter().all(is_number) && items.iter().any(is_float) => {
            (Some(ParameterType::Float64Array), ParameterValue::Array(items.into_iter().map(as_float).collect()))
        }
        value if is_float(&value) => (Some(ParameterType::Float64), value),
        value => (None, value),
    };
    Some(Parameter { name, r#type, value: Some(value) })
}

fn as_float(value: ParameterValue) -> ParameterValue {
    match value {
        ParameterValue::Integer(whole) => ParameterValue::Float64(whole as f64),
        other => other,
    }
}

fn to_foxglove(value: &Value) -> Option<ParameterValue> {
    Some(match value {
        Value::Null => return None,
        Value::Bool(on) => ParameterValue::Bool(*on),
        Value::String(text) => ParameterValue::String(text.clone()),
        Value::Number(number) => match number.as_i64() {
            Some(whole) => ParameterValue::Integer(whole),
            None => ParameterValue::Float64(number.as_f64()?),
        },
        Value::Array(items) => ParameterValue::Array(items.iter().map(to_foxglove).collect::<Option<_>>()?),
        Value::Object(map) => ParameterValue::Dict(
            map.iter().filter_map(|(key, value)| Some((key.clone(), to_foxglove(value)?))).collect(),
        ),
    })
}

/// What a person sets, as the graph has it. `in_force`: the value that it replaces, whose kind of number it takes where that loses
/// nothing. The error says what is wrong.
pub fn from_foxglove(value: &ParameterValue, in_force: Option<&ParameterValue>) -> Result<Value, String> {
    let items_like = |at: usize| match in_force {
        Some(ParameterValue::Array(items)) => items.get(at).or(items.last()),
        _ => None,
    };
    Ok(match value {
        ParameterValue::Integer(whole) => (*whole).into(),
        ParameterValue::Float64(number) => {
            let whole = number.fract() == 0.0 && number.abs() < 1e15;
            match in_force {
                Some(ParameterValue::Integer(_)) if whole => (*number as i64).into(),
                _ => {
                    Value::Number(Number::from_f64(*number).ok_or_else(|| format!("got {number}, expected a number"))?)
                }
            }
        }
        ParameterValue::Bool(on) => (*on).into(),
        ParameterValue::String(text) => text.clone().into(),
        ParameterValue::Array(items) => {
            let values = items.iter().enumerate().map(|(at, item)| from_foxglove(item, items_like(at)));
            Value::Array(values.collect::<Result<_, _>>()?)
        }
        ParameterValue::Dict(map) => {
            let pairs = map.iter().map(|(key, value)| Ok((key.clone(), from_foxglove(value, None)?)));
            Value::Object(pairs.collect::<Result<_, String>>()?)
        }
    })
}

/// The wishes for one node.
#[derive(Debug, PartialEq)]
pub struct Wish {
    /// The node.
    pub node: String,
    /// Path below its configuration to value.
    pub values: Map<String, Value>,
}

/// Sorts what a person sets by node, in the order of their first wishes; and what cannot be wished for, with the reason.
pub fn wishes(asked: &[Parameter], in_force: &BTreeMap<String, Parameter>) -> (Vec<Wish>, Vec<(String, String)>) {
    let (mut wishes, mut refused): (Vec<Wish>, _) = (Vec::new(), Vec::new());
    for one in asked {
        match wish(one, in_force) {
            Ok((node, path, value)) => {
                let at = wishes.iter().position(|wish| wish.node == node).unwrap_or_else(|| {
                    wishes.push(Wish { node: node.to_owned(), values: Map::new() });
                    wishes.len() - 1
                });
                wishes[at].values.insert(path.to_owned(), value);
            }
            Err(reason) => refused.push((one.name.clone(), reason)),
        }
    }
    (wishes, refused)
}

fn wish<'a>(asked: &'a Parameter, in_force: &BTreeMap<String, Parameter>) -> Result<(&'a str, &'a str, Value), String> {
    let (node, path) = asked.name.split_once('.').ok_or("expected `node.path`, for example `lane.threshold`")?;
    let known = in_force.get(&asked.name).and_then(|known| known.value.as_ref());
    let value = asked.value.as_ref().ok_or("a parameter cannot be removed; set another value")?;
    Ok((node, path, from_foxglove(value, known)?))
}

/// Those whose values differ from before, or that are new.
pub fn changed(before: &BTreeMap<String, Parameter>, now: &BTreeMap<String, Parameter>) -> Vec<Parameter> {
    now.iter().filter(|(name, one)| before.get(*name) != Some(one)).map(|(_, one)| one.clone()).collect()
}

/// Those of these names, all for none.
pub fn named(all: &BTreeMap<String, Parameter>, names: &[String]) -> Vec<Parameter> {
    if names.is_empty() {
        return all.values().cloned().collect();
    }
    names.iter().filter_map(|name| all.get(name)).cloned().collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn node(name: &str, config: Value) -> LiveNode {
        let (name, operator, fitting) = (name.to_owned(), "any".to_owned(), Vec::new());
        LiveNode { name, operator, exec: None, version: 1, config, schema: json!({}), fitting }
    }

    fn graph() -> BTreeMap<String, Parameter> {
        let lane = json!({ "threshold": 190.0, "band_px": 3, "on": true, "marking": "bright", "scale": null, "hue": [170, 10] });
        let sectors = json!({ "sectors": [{ "name": "front", "limit_m": 1.5 }], "gains": [1, 0.5], "masks": [] });
        of_graph(&[node("lane", lane), node("sectors", sectors)])
    }

    #[test]
    fn every_value_becomes_a_parameter_of_its_kind() {
        let shown: Vec<String> =
            graph().values().map(|one| serde_json::to_string(one).expect("a parameter is JSON")).collect();
        let expected = [
            r#"{"name":"lane.band_px","value":3}"#,
            r#"{"name":"lane.hue","value":[170,10]}"#,
            r#"{"name":"lane.marking","value":"bright"}"#,
            r#"{"name":"lane.on","value":true}"#,
            r#"{"name":"lane.threshold","type":"float64","value":190.0}"#,
            r#"{"name":"sectors.gains","type":"float64_array","value":[1.0,0.5]}"#,
            r#"{"name":"sectors.masks","value":[]}"#,
            r#"{"name":"sectors.sectors.0.limit_m","type":"float64","value":1.5}"#,
            r#"{"name":"sectors.sectors.0.name","value":"front"}"#,
        ];
        assert_eq!(shown, expected, "no parameter for what is not given");
    }

    #[test]
    fn wishes_are_sorted_by_node_and_keep_the_kind_of_number() {
        let asked = [
            Parameter::float64("lane.band_px", 5.0),
            Parameter::integer("sectors.sectors.0.limit_m", 2),
            Parameter::float64("lane.threshold", 180.0),
            Parameter::string("lane.marking", "dark"),
            Parameter::float64_array("lane.hue", [1.0, 2.5]),
        ];
        let (wishes, refused) = wishes(&asked, &graph());
        assert_eq!(refused, Vec::<(String, String)>::new(), "all can be wished for");
        let lane = json!({ "band_px": 5, "threshold": 180.0, "marking": "dark", "hue": [1, 2.5] });
        assert_eq!((wishes[0].node.as_str(), Value::Object(wishes[0].values.clone())), ("lane", lane), "in one change");
        let sectors = json!({ "sectors.0.limit_m": 2 });
        assert_eq!(Value::Object(wishes[1].values.clone()), sectors, "the path below the node");
    }

    #[test]
    fn what_cannot_be_wished_for_is_named_with_the_reason() {
        let asked = [
            Parameter::empty("lane.threshold"),
            Parameter::integer("threshold", 3),
            Parameter::float64("lane.threshold", f64::NAN),
        ];
        let (wishes, refused) = wishes(&asked, &graph());
        assert!(wishes.is_empty(), "nothing is left to ask for: {wishes:?}");
        let reasons: Vec<&str> = refused.iter().map(|(_, reason)| reason.as_str()).collect();
        assert!(reasons[0].contains("cannot be removed"), "{reasons:?}");
        assert!(reasons[1].contains("node.path"), "{reasons:?}");
        assert!(reasons[2].contains("NaN"), "{reasons:?}");
    }

    #[test]
    fn news_are_what_differs() {
        let before = graph();
        let mut now = before.clone();
        now.insert("lane.band_px".into(), Parameter::integer("lane.band_px", 4));
        now.insert("new.value".into(), Parameter::integer("new.value", 1));
        let names: Vec<String> = changed(&before, &now).into_iter().map(|one| one.name).collect();
        assert_eq!(names, ["lane.band_px", "new.value"], "one changed, one is new");
        assert_eq!(named(&now, &["new.value".into(), "no.such".into()]).len(), 1, "unknown names are passed over");
        assert_eq!(named(&now, &[]).len(), now.len(), "no name asks for all");
    }
}
