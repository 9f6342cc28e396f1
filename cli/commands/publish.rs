//! `carril pub NODE/PORT JSON`: puts messages on a port that is open to people.

use anyhow::{Result, anyhow, bail};
use carril_messages::{Encoded, MessageType, dynamic};

/// Checks `text` against the type of the port, and gives the message in its wire form.
fn encode(type_name: &str, text: &str) -> Result<(MessageType, Encoded)> {
    let Some(known) = dynamic::find(type_name) else {
        bail!("the port takes `{type_name}`, a type of your own; `carril pub` knows carril's types only");
    };
    let Some(from_json) = known.from_json else {
        bail!("the port takes `{type_name}`, which JSON cannot carry");
    };
    let value = serde_json::from_str(text)
        .map_err(|error| anyhow!("`{text}` is no JSON: {error}\n{}", allowed(type_name, &(known.schema)())))?;
    let encoded = from_json(value)
        .map_err(|error| anyhow!("`{text}` is no `{type_name}`: {error}\n{}", allowed(type_name, &(known.schema)())))?;
    Ok((known.message_type, encoded))
}

fn allowed(type_name: &str, schema: &serde_json::Value) -> String {
    let schema = serde_json::to_string_pretty(schema).unwrap_or_default();
    format!("hint: put the JSON in single quotes; `{type_name}` is\n{schema}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepts_what_the_type_allows() {
        let (message_type, _) = encode("carril/Goal", r#"{"cruise": {"speed_m_s": 0.4}}"#).expect("a goal");
        assert_eq!(message_type.name, "carril/Goal", "its type");
    }

    #[test]
    fn refusals_show_what_is_allowed() {
        for wrong in ["{", r#"{"cruise": {"speed": 0.4}}"#, "{}", "3"] {
            let error = encode("carril/Goal", wrong).expect_err("no goal").to_string();
            assert!(error.contains(wrong) && error.contains("\"speed_m_s\""), "what we got and the schema: {error}");
        }
        let image = encode("carril/Image", "{}").expect_err("pixels are no JSON").to_string();
        assert_eq!(image, "the port takes `carril/Image`, which JSON cannot carry", "images");
        assert!(encode("acme/Radar", "{}").is_err(), "a foreign type");
    }
}
