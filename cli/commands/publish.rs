//! `carril pub NODE/PORT JSON`: puts messages on a port that is open to people.

use std::time::{Duration, Instant};

use anyhow::{Result, anyhow, bail};
use carril_messages::{CodecError, Encoded, MessageType, dynamic};
use clap::Args;

use crate::common::live::Run;
use crate::common::way::Target;
use crate::common::{output, ports, time};

/// Arguments of `carril pub`.
#[derive(Args)]
#[command(after_help = "Only ports that their operator declares as open take messages; `carril list` shows them.

Examples:
  carril pub decision/goal '{\"cruise\": {\"speed_m_s\": 0.4}}'
  carril pub decision/goal '{\"cruise\": {\"speed_m_s\": 0.4}}' --rate 2 -n 10")]
pub struct PubArgs {
    /// The input port
    #[arg(value_name = "NODE/PORT")]
    port: String,
    /// The message, in single quotes
    #[arg(value_name = "JSON")]
    json: String,
    /// Messages per second; without -n until Ctrl-C
    #[arg(long, value_name = "HZ", value_parser = time::parse_rate)]
    rate: Option<f64>,
    /// How many messages [default: 1 without --rate]
    #[arg(short = 'n', long = "count", value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    #[command(flatten)]
    target: Target,
}

/// Runs it.
pub fn run(args: &PubArgs) -> Result<()> {
    let run = Run::connect(&args.target)?;
    let (node, input) = ports::to_write(run.file(), &args.port)?;
    let (message_type, encoded) = encode(&input.message_type, &args.json)?;
    let mut publisher = run.publisher(&node.name, &input.port, message_type);
    let count = args.count.unwrap_or(if args.rate.is_some() { u64::MAX } else { 1 });
    let period = Duration::from_secs_f64(1.0 / args.rate.unwrap_or(1.0));
    let begun = Instant::now();
    for sent in 0..count {
        let due = period.mul_f64(sent as f64);
        std::thread::sleep(due.saturating_sub(begun.elapsed()));
        publisher.put(encoded.clone())?;
        if sent == 0 {
            output::line(format_args!("published on {}: {}", args.port, args.json))?;
        }
    }
    Ok(())
}

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
    let encoded = from_json(value).map_err(|error| {
        let reason = match error {
            CodecError::Invalid { got, .. } => got,
            other => other.to_string(),
        };
        anyhow!("`{text}` is no `{type_name}`: {reason}\n{}", allowed(type_name, &(known.schema)()))
    })?;
    Ok((known.message_type, encoded))
}

fn allowed(type_name: &str, schema: &serde_json::Value) -> String {
    let mut schema = schema.clone();
    if let Some(object) = schema.as_object_mut() {
        object.retain(|key, _| !matches!(key.as_str(), "$schema" | "title"));
    }
    let schema = serde_json::to_string_pretty(&schema).unwrap_or_default();
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
