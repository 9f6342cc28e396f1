//! The JSON Schema of the graph file, for editors. Comes from the raw structs, so that it cannot say anything else than they do.

use serde_json::{Map, Value, json};

use super::raw::RawFile;
use crate::registry::{OperatorKind, Registry};

/// The JSON Schema of a graph file. With operators in `registry`, their names, ports and configurations are part of it.
pub fn schema(registry: &Registry) -> Value {
    let mut schema = schemars::schema_for!(RawFile).to_value();
    let pattern = schema["properties"]["robot"]["pattern"].clone();
    schema["properties"]["nodes"]["propertyNames"] = json!({ "pattern": pattern });
    let node = &mut schema["$defs"]["Node"];
    node["anyOf"] = json!([{ "required": ["operator"] }, { "required": ["exec"] }]);
    if registry.iter().next().is_none() {
        return schema;
    }
    let names: Vec<&str> = registry.iter().map(|kind| kind.name).collect();
    let mut kinds: Vec<Value> = registry.iter().map(|kind| of_kind(kind)).collect();
    // Beside `exec`, the operators are those of the binary.
    kinds.push(json!({
        "if": { "not": { "required": ["exec"] } },
        "then": { "properties": { "operator": { "enum": names } } },
    }));
    node["allOf"] = kinds.into();
    for kind in registry.iter() {
        let definitions = definitions_of(kind);
        if let Some(all) = schema["$defs"].as_object_mut() {
            all.extend(definitions);
        }
    }
    schema
}

/// What holds for a node with this operator.
fn of_kind(kind: &OperatorKind) -> Value {
    let mut config = kind.config_schema();
    if let Some(config) = config.as_object_mut() {
        config.remove("$schema");
        config.remove("$defs");
    }
    prefix_references(&mut config, kind.name);
    let inputs: Map<String, Value> = kind
        .inputs
        .iter()
        .map(|port| {
            let description = format!("{} (`{}`)", port.doc, port.message_type);
            (port.name.to_owned(), json!({ "$ref": "#/$defs/Input", "description": description }))
        })
        .collect();
    let inputs = json!({ "properties": inputs, "additionalProperties": false });
    json!({
        "if": {
            "properties": { "operator": { "const": kind.name } }, "required": ["operator"],
            "not": { "required": ["exec"] },
        },
        "then": { "description": kind.summary, "properties": { "config": config, "inputs": inputs } },
    })
}

/// The definitions that a configuration's schema refers to, under names that cannot clash with another operator's.
fn definitions_of(kind: &OperatorKind) -> Map<String, Value> {
    let mut schema = kind.config_schema();
    let Some(definitions) = schema.get_mut("$defs").and_then(Value::as_object_mut) else { return Map::new() };
    let definitions = std::mem::take(definitions);
    let rename = |(name, mut definition): (String, Value)| {
        prefix_references(&mut definition, kind.name);
        (format!("{}.{name}", kind.name), definition)
    };
    definitions.into_iter().map(rename).collect()
}

fn prefix_references(value: &mut Value, prefix: &str) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                match value {
                    Value::String(target) if key == "$ref" => {
                        if let Some(name) = target.strip_prefix("#/$defs/") {
                            *target = format!("#/$defs/{prefix}.{name}");
                        }
                    }
                    other => prefix_references(other, prefix),
                }
            }
        }
        Value::Array(items) => items.iter_mut().for_each(|item| prefix_references(item, prefix)),
        _ => {}
    }
}
