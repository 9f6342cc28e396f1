//! `carril operators [NAME]`: the kinds of operators, their ports and what can be configured.

use anyhow::{Result, bail};
use carril_runtime::{InputSpec, OperatorKind, OutputSpec, Registry};
use clap::Args;
use serde_json::{Value, json};

use crate::common::report::Report;
use crate::common::{output, suggest};

/// Arguments of `carril operators`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril operators                    every kind with its summary
  carril operators lane-detector      ports and configuration of one kind
  carril operators --json | jq '.[].name'")]
pub struct OperatorsArgs {
    /// Kind of operator, as in `operator:` of the graph file; all kinds when left out
    name: Option<String>,
    /// JSON, with the whole schema of the configuration
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &OperatorsArgs, registry: &Registry) -> Result<()> {
    let kinds: Vec<&OperatorKind> = match &args.name {
        Some(name) => vec![find(registry, name)?],
        None => registry.iter().map(AsRef::as_ref).collect(),
    };
    if args.json {
        return output::json(&kinds.into_iter().map(to_json).collect::<Vec<_>>());
    }
    if let (Some(_), [kind]) = (&args.name, &kinds[..]) {
        return output::text(describe(kind));
    }
    let ports = |names: Vec<&str>| if names.is_empty() { "-".to_owned() } else { names.join(", ") };
    let row = |kind: &&OperatorKind| {
        let inputs = ports(kind.inputs.iter().map(|port| port.name).collect());
        let outputs = ports(kind.outputs.iter().map(|port| port.name).collect());
        vec![kind.name.to_owned(), inputs, outputs, kind.summary.to_owned()]
    };
    let rows: Vec<_> = kinds.iter().map(row).collect();
    output::text(output::table(&["OPERATOR", "INPUTS", "OUTPUTS", "WHAT IT DOES"], &rows))?;
    output::line("\n`carril operators NAME` shows types, configuration and defaults.")
}

fn find<'a>(registry: &'a Registry, name: &str) -> Result<&'a OperatorKind> {
    if let Some(kind) = registry.get(name) {
        return Ok(kind);
    }
    let names: Vec<&str> = registry.iter().map(|kind| kind.name).collect();
    let hint = suggest::hint(name, names.iter().copied(), "");
    bail!("there is no operator `{name}`; known are {}{hint}", names.join(", "));
}

fn to_json(kind: &OperatorKind) -> Value {
    let input = |port: &InputSpec| {
        json!({
            "name": port.name, "type": port.message_type.to_string(), "doc": port.doc, "triggers": port.triggers,
            "optional": port.optional, "external": port.external,
        })
    };
    let output = |port: &OutputSpec| {
        json!({
            "name": port.name, "type": port.message_type.to_string(), "doc": port.doc, "on_demand": port.on_demand,
        })
    };
    json!({
        "name": kind.name, "summary": kind.summary, "state_version": kind.state_version,
        "inputs": kind.inputs.iter().map(input).collect::<Vec<_>>(),
        "outputs": kind.outputs.iter().map(output).collect::<Vec<_>>(),
        "config": kind.config_schema(),
    })
}

fn describe(kind: &OperatorKind) -> Report {
    let mut report = Report::default();
    report.line(format_args!("{}: {}", kind.name, kind.summary));
    report.line("\ninputs");
    report.text(&output::rows(&kind.inputs.iter().map(input_row).collect::<Vec<_>>()));
    report.line("\noutputs");
    report.text(&output::rows(&kind.outputs.iter().map(output_row).collect::<Vec<_>>()));
    report.line("\nconfig");
    let schema = kind.config_schema();
    let mut fields = Vec::new();
    collect(&schema, &schema, "", 0, &mut fields);
    if fields.is_empty() {
        report.line("  none");
    }
    for field in fields {
        let facts = [field.kind, field.range, field.default].into_iter().filter(|fact| !fact.is_empty());
        report.line(format_args!("  {}: {}", field.name, facts.collect::<Vec<_>>().join(", ")));
        report.text(&output::wrapped(&field.doc, 6));
    }
    report
}

fn input_row(port: &InputSpec) -> Vec<String> {
    let mut facts = vec![if port.optional { "optional" } else { "required" }];
    facts.push(if port.triggers { "triggers a step" } else { "read when stepping" });
    if port.external {
        facts.push("`carril pub` may write it");
    }
    vec![port.name.to_owned(), port.message_type.name.to_string(), facts.join(", "), port.doc.clone()]
}

fn output_row(port: &OutputSpec) -> Vec<String> {
    let facts = if port.on_demand { "only while somebody reads it" } else { "" };
    vec![port.name.to_owned(), port.message_type.name.to_string(), facts.to_owned(), port.doc.clone()]
}

/// How deep fields of fields are listed.
const DEEPEST: usize = 4;

/// One value that can be configured.
struct Field {
    name: String,
    kind: String,
    range: String,
    default: String,
    doc: String,
}

/// Every field. Fields of fields get dotted names, `sectors[].from_deg`.
fn collect(root: &Value, object: &Value, prefix: &str, depth: usize, fields: &mut Vec<Field>) {
    let Some(properties) = resolve(root, object)["properties"].as_object() else { return };
    for (name, schema) in properties {
        let name = format!("{prefix}{name}");
        let default = match &schema["default"] {
            Value::Null => String::new(),
            Value::Array(items) if items.len() > 3 => format!("default {} items, see --json", items.len()),
            default => format!("default {default}"),
        };
        let doc = [schema, resolve(root, schema)].iter().find_map(|part| part["description"].as_str());
        let doc = doc.unwrap_or("").replace('\n', " ");
        let (kind, range) = (type_text(root, schema), range_text(root, schema));
        fields.push(Field { name: name.clone(), kind, range, default, doc });
        if depth < DEEPEST {
            collect(root, unwrap_option(schema), &format!("{name}."), depth + 1, fields);
            collect(root, &resolve(root, unwrap_option(schema))["items"], &format!("{name}[]."), depth + 1, fields);
        }
    }
}

/// Follows `$ref`s into `$defs`.
fn resolve<'a>(root: &'a Value, mut schema: &'a Value) -> &'a Value {
    for _ in 0..DEEPEST {
        let Some(target) = schema["$ref"].as_str().and_then(|path| path.strip_prefix('#')) else { break };
        schema = root.pointer(target).unwrap_or(&Value::Null);
    }
    schema
}

/// `Option<T>` is `anyOf: [T, null]`.
fn unwrap_option(schema: &Value) -> &Value {
    let Some(choices) = schema["anyOf"].as_array() else { return schema };
    choices.iter().find(|choice| choice["type"] != "null").unwrap_or(schema)
}

fn type_text(root: &Value, schema: &Value) -> String {
    let schema = resolve(root, schema);
    if let Some(choices) = schema["enum"].as_array() {
        return choices.iter().map(|choice| choice.as_str().unwrap_or("?")).collect::<Vec<_>>().join(" | ");
    }
    if let Some(constant) = schema["const"].as_str() {
        return constant.to_owned();
    }
    for several in ["anyOf", "oneOf"] {
        if let Some(choices) = schema[several].as_array() {
            return choices.iter().map(|choice| type_text(root, choice)).collect::<Vec<_>>().join(" | ");
        }
    }
    match &schema["type"] {
        Value::Array(kinds) => kinds.iter().filter_map(Value::as_str).collect::<Vec<_>>().join(" | "),
        Value::String(kind) if kind == "array" => format!("list of {}", type_text(root, &schema["items"])),
        Value::String(kind) if kind == "object" && schema["properties"].as_object().is_some_and(|p| p.len() == 1) => {
            let name = schema["properties"].as_object().and_then(|p| p.keys().next()).map_or("", String::as_str);
            format!("{{ {name}: .. }}")
        }
        Value::String(kind) => kind.clone(),
        _ => "any".to_owned(),
    }
}

fn range_text(root: &Value, schema: &Value) -> String {
    let schema = resolve(root, unwrap_option(schema));
    let unsigned = schema["format"].as_str().is_some_and(|format| format.starts_with("uint"));
    match (&schema["minimum"], &schema["maximum"]) {
        (Value::Null, Value::Null) => String::new(),
        (min, Value::Null) if unsigned && min == 0 => String::new(),
        (min, Value::Null) => format!("at least {min}"),
        (Value::Null, max) => format!("at most {max}"),
        (min, max) => format!("{min} to {max}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_fields_of_fields_with_type_default_and_range() {
        let schema = json!({
            "properties": {
                "mode": { "$ref": "#/$defs/Mode", "default": "bright", "description": "What marks the lane." },
                "limit": { "type": ["integer", "null"], "minimum": 0, "maximum": 255 },
                "sectors": { "type": "array", "items": { "$ref": "#/$defs/Sector" } },
            },
            "$defs": {
                "Mode": { "enum": ["bright", "dark"] },
                "Sector": { "type": "object", "properties": { "from_deg": { "type": "number" }, "to_deg": { "type": "number" } } },
            },
        });
        let mut fields = Vec::new();
        collect(&schema, &schema, "", 0, &mut fields);
        let text = |field: Field| [field.name, field.kind, field.range, field.default, field.doc].join(";");
        let rows: Vec<String> = fields.into_iter().map(text).collect();
        let expected = [
            "limit;integer | null;0 to 255;;",
            "mode;bright | dark;;default \"bright\";What marks the lane.",
            "sectors;list of object;;;",
            "sectors[].from_deg;number;;;",
            "sectors[].to_deg;number;;;",
        ];
        assert_eq!(rows, expected, "one row per field");
    }

    #[test]
    fn a_schema_that_refers_to_itself_ends() {
        let schema = json!({ "properties": { "a": { "$ref": "#" } } });
        let mut fields = Vec::new();
        collect(&schema, &schema, "", 0, &mut fields);
        assert_eq!(fields.len(), DEEPEST + 1, "the depth is bounded");
    }
}
