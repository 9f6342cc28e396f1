//! JSON Schemas as Foxglove reads them: it knows objects, lists and plain values, each of one type, and no references. What a schema
//! of ours says beyond that is left out; the values are sent all the same.

use serde_json::{Map, Value, json};

/// References and choices are followed so deep.
const DEEPEST: u32 = 16;

/// The schema of a message: an object. A message that is none travels as `{"value": ..}`, see [`object`].
pub fn message_schema(schema: &Value) -> Value {
    match plain(schema, schema, 0) {
        Some(known) if known["type"] == "object" => known,
        Some(known) => json!({ "type": "object", "properties": { "value": known } }),
        None => json!({ "type": "object", "properties": {} }),
    }
}

/// A message as an object.
pub fn object(message: Value) -> Value {
    if message.is_object() { message } else { json!({ "value": message }) }
}

/// `None`: Foxglove has no word for it.
fn plain(root: &Value, schema: &Value, depth: u32) -> Option<Value> {
    if depth > DEEPEST {
        return None;
    }
    if let Some(path) = schema["$ref"].as_str() {
        return plain(root, root.pointer(path.strip_prefix('#')?)?, depth + 1);
    }
    for choice in ["anyOf", "oneOf", "allOf"] {
        if let Some(choices) = schema[choice].as_array() {
            return chosen(root, choices, depth);
        }
    }
    if let Some(of) = schema.get("const").or_else(|| schema["enum"].get(0)) {
        return of.is_string().then(|| json!({ "type": "string" }));
    }
    let mut known = match one_type(&schema["type"])? {
        "object" => json!({ "type": "object", "properties": properties(root, schema, depth) }),
        "array" => {
            let item = plain(root, schema.get("items")?, depth + 1)?;
            // Lists of lists are more than Foxglove can say.
            (item["type"] != "array").then(|| json!({ "type": "array", "items": item }))?
        }
        simple @ ("boolean" | "string" | "number" | "integer") => json!({ "type": simple }),
        _ => return None,
    };
    if let Some(text) = schema.get("description") {
        known["description"] = text.clone();
    }
    Some(known)
}

/// One of several: the only one beside `null`, or what they have in common.
fn chosen(root: &Value, choices: &[Value], depth: u32) -> Option<Value> {
    let known: Option<Vec<Value>> =
        choices.iter().filter(|one| one["type"] != "null").map(|one| plain(root, one, depth + 1)).collect();
    let mut known = known?.into_iter();
    let first = known.next()?;
    known.try_fold(first, |sum, next| match (&sum["type"], &next["type"]) {
        (Value::String(a), Value::String(b)) if a == "object" && b == "object" => {
            let mut both = sum["properties"].as_object()?.clone();
            both.extend(next["properties"].as_object()?.clone());
            Some(json!({ "type": "object", "properties": both }))
        }
        (a, b) => (a == b && a != "array").then_some(json!({ "type": a })),
    })
}

fn properties(root: &Value, schema: &Value, depth: u32) -> Map<String, Value> {
    let listed = schema["properties"].as_object().into_iter().flatten();
    listed.filter_map(|(name, below)| Some((name.clone(), plain(root, below, depth + 1)?))).collect()
}

/// The type, where there is one besides `null`.
fn one_type(types: &Value) -> Option<&str> {
    match types {
        Value::String(one) => Some(one),
        Value::Array(several) => {
            let mut others = several.iter().filter_map(Value::as_str).filter(|one| *one != "null");
            others.next().filter(|_| others.next().is_none())
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::dynamic;

    use super::*;

    /// What Foxglove's own reader of JSON Schemas asks for.
    fn assert_readable(schema: &Value, path: &str) {
        match schema["type"].as_str() {
            Some("object") => {
                let below = schema["properties"].as_object().unwrap_or_else(|| panic!("{path}: no properties"));
                below.iter().for_each(|(name, below)| assert_readable(below, &format!("{path}.{name}")));
            }
            Some("array") => {
                assert_ne!(schema["items"]["type"], "array", "{path}: a list of lists");
                assert_readable(&schema["items"], &format!("{path}[]"));
            }
            Some("boolean" | "string" | "number" | "integer") => {}
            other => panic!("{path}: type {other:?}"),
        }
    }

    #[test]
    fn every_type_of_ours_has_a_schema_that_foxglove_reads() {
        for known in dynamic::types() {
            let schema = message_schema(&(known.schema)());
            assert_eq!(schema["type"], "object", "{}", known.message_type);
            assert_readable(&schema, &known.message_type.name);
        }
    }

    fn properties_of(name: &str) -> Value {
        message_schema(&(dynamic::find(name).expect("it is ours").schema)())["properties"].clone()
    }

    #[test]
    fn optional_nested_and_named_values_keep_their_types() {
        let lane = properties_of("carril/LaneEstimate");
        assert_eq!(lane["threshold"]["type"], "integer", "an integer or null");
        assert_eq!(lane["lane"]["properties"]["far"]["properties"]["left_px"]["type"], "number", "through references");
        let state = properties_of("carril/DecisionState");
        assert_eq!(state["state"]["type"], "string", "one of several words");
        assert_eq!(state["transitions"]["type"], "integer", "a count");
        let goal = properties_of("carril/Goal");
        assert_eq!(goal["cruise"]["properties"]["speed_m_s"]["type"], "number", "one of several objects");
        assert_eq!(
            properties_of("carril/Sectors")["sectors"]["items"]["properties"]["name"]["type"],
            "string",
            "a list"
        );
        assert_eq!(
            properties_of("carril/Control"),
            json!({ "value": { "type": "string" } }),
            "no object: it is wrapped"
        );
    }

    #[test]
    fn what_cannot_be_said_is_left_out_and_loops_end() {
        let schema = json!({
            "type": "object",
            "properties": {
                "grid": { "type": "array", "items": { "type": "array", "items": { "type": "number" } } },
                "mixed": { "type": ["string", "number"] },
                "any": true,
                "lost": { "$ref": "#/$defs/Nowhere" },
                "again": { "$ref": "#/$defs/Loop" },
                "kept": { "type": "number" },
            },
            "$defs": { "Loop": { "$ref": "#/$defs/Loop" } },
        });
        assert_eq!(
            message_schema(&schema),
            json!({ "type": "object", "properties": { "kept": { "type": "number" } } }),
            "only what can be read"
        );
        assert_eq!(message_schema(&Value::Null), json!({ "type": "object", "properties": {} }), "no schema at all");
        assert_eq!(object(json!("start")), json!({ "value": "start" }), "a bare word is wrapped");
        assert_eq!(object(json!({ "a": 1 })), json!({ "a": 1 }), "an object is not");
    }
}
