//! Compares what a candidate in shadow would have published with what the active instance publishes.

use std::collections::{HashMap, VecDeque};
use std::sync::{Mutex, PoisonError};

use carril_messages::{CodecError, Encoded, Header, Origins, Payload, dynamic};
use serde_json::Value;

use crate::ports::AnyMessage;

/// Outputs of one side wait for their counterparts up to this many.
const WAITING: usize = 64;

/// Whether readers could read a message: it decodes, and its plain numbers are numbers. Types that are not ours pass.
pub(crate) fn check(header: &Header, message: &dyn AnyMessage) -> Result<(), String> {
    let encoded = message.encode().map_err(|error| error.to_string())?;
    let Some(known) = dynamic::find(&header.message_type.name) else { return Ok(()) };
    let shown = show(header, encoded).map_err(|error| error.to_string())?;
    let schema = (known.schema)();
    let Some(fields) = schema.get("properties").and_then(Value::as_object) else { return Ok(()) };
    let plain_number = |field: &Value| field.get("type").and_then(Value::as_str) == Some("number");
    let bad = fields.iter().find(|(name, field)| plain_number(field) && shown.get(*name).is_some_and(Value::is_null));
    bad.map_or(Ok(()), |(name, _)| Err(format!("field `{name}` is not a finite number")))
}

fn show(header: &Header, encoded: Encoded) -> Result<Value, CodecError> {
    let header = Header { meta: encoded.meta, ..header.clone() };
    dynamic::to_json(&header, &encoded.payload)
}

/// What came of a shadow.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Comparison {
    /// Outputs of the active instance, of any port.
    pub active: u64,
    /// Outputs of the candidate.
    pub candidate: u64,
    /// Outputs that both sides gave for the same exposures.
    pub compared: u64,
    /// Of these, how many differ at all.
    pub different: u64,
    /// Port and field of the largest difference between two numbers, and the difference, in the unit of the field.
    pub largest: Option<(String, f64)>,
}

/// Pairs the outputs of both sides by port and by the exposures that they derive from.
#[derive(Default)]
pub struct Comparer(Mutex<State>);

#[derive(Default)]
struct State {
    waiting: HashMap<(Side, String), VecDeque<(Origins, Value)>>,
    comparison: Comparison,
}

#[derive(Clone, Copy, PartialEq, Eq, Hash)]
enum Side {
    Active,
    Candidate,
}

impl Side {
    fn other(self) -> Self {
        match self {
            Self::Active => Self::Candidate,
            Self::Candidate => Self::Active,
        }
    }
}

impl Comparer {
    /// The candidate would have published this.
    pub fn candidate(&self, port: &str, header: &Header, message: &dyn AnyMessage) {
        self.message(Side::Candidate, port, header, message);
    }

    /// The active instance, in the same process, has published this.
    pub fn active(&self, port: &str, header: &Header, message: &dyn AnyMessage) {
        self.message(Side::Active, port, header, message);
    }

    /// The active instance, in another process, has published this.
    pub fn active_wire(&self, port: &str, header: &Header, payload: &Payload) {
        self.count(Side::Active);
        if let Ok(value) = dynamic::to_json(header, payload) {
            self.pair(Side::Active, port, header, value);
        }
    }

    /// What has come of it so far.
    pub fn comparison(&self) -> Comparison {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).comparison.clone()
    }

    fn count(&self, side: Side) {
        let comparison = &mut self.0.lock().unwrap_or_else(PoisonError::into_inner).comparison;
        match side {
            Side::Active => comparison.active += 1,
            Side::Candidate => comparison.candidate += 1,
        }
    }

    fn message(&self, side: Side, port: &str, header: &Header, message: &dyn AnyMessage) {
        self.count(side);
        if let Ok(value) = message.encode().and_then(|encoded| show(header, encoded)) {
            self.pair(side, port, header, value);
        }
    }

    fn pair(&self, side: Side, port: &str, header: &Header, value: Value) {
        let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let state = &mut *state;
        let others = state.waiting.entry((side.other(), port.to_owned())).or_default();
        if let Some(at) = others.iter().position(|(origins, _)| *origins == header.origins)
            && let Some((_, other)) = others.remove(at)
        {
            state.comparison.add(port, &value, &other);
            return;
        }
        let own = state.waiting.entry((side, port.to_owned())).or_default();
        own.push_back((header.origins.clone(), value));
        if own.len() > WAITING {
            own.pop_front();
        }
    }
}

impl Comparison {
    fn add(&mut self, port: &str, a: &Value, b: &Value) {
        self.compared += 1;
        self.different += u64::from(a != b);
        let mut largest = self.largest.take();
        largest_difference(port.to_owned(), a, b, &mut largest);
        self.largest = largest;
    }
}

/// Walks two values side by side.
fn largest_difference(path: String, a: &Value, b: &Value, largest: &mut Option<(String, f64)>) {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => {
            let difference = (a.as_f64().unwrap_or(0.0) - b.as_f64().unwrap_or(0.0)).abs();
            if difference > largest.as_ref().map_or(0.0, |(_, largest)| *largest) {
                *largest = Some((path, difference));
            }
        }
        (Value::Object(a), Value::Object(b)) => {
            for (name, a) in a {
                if let Some(b) = b.get(name) {
                    largest_difference(format!("{path}.{name}"), a, b, largest);
                }
            }
        }
        (Value::Array(a), Value::Array(b)) => {
            for (at, (a, b)) in a.iter().zip(b).enumerate() {
                largest_difference(format!("{path}.{at}"), a, b, largest);
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Command, Message, Meta, SourceId, Stamp};

    use super::*;

    fn header(captured_ns: i64) -> Header {
        let origins = Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(captured_ns));
        Header { epoch: 1, seq: 0, stamp: Stamp::ZERO, origins, message_type: Command::TYPE, meta: Meta::new() }
    }

    fn command(steering_rad: f32) -> Command {
        Command { steering_rad, ..Command::default() }
    }

    #[test]
    fn pairs_by_exposure_and_finds_the_largest_difference() {
        let comparer = Comparer::default();
        comparer.active("command", &header(1), &command(0.1));
        comparer.active("command", &header(2), &command(0.2));
        comparer.candidate("command", &header(2), &command(0.25));
        comparer.candidate("command", &header(1), &command(0.1));
        comparer.candidate("command", &header(3), &command(9.0));
        let comparison = comparer.comparison();
        assert_eq!((comparison.compared, comparison.different), (2, 1), "the third has no counterpart");
        let (field, difference) = comparison.largest.expect("there is a difference");
        assert_eq!(field, "command.steering_rad", "port and field");
        assert!((difference - 0.05).abs() < 1e-6, "got {difference}");
    }

    #[test]
    fn what_is_not_a_number_is_garbage() {
        assert_eq!(check(&header(1), &command(0.1)), Ok(()), "a good one");
        let found = check(&header(1), &command(f32::NAN));
        assert!(found.is_err_and(|reason| reason.contains("steering_rad")), "it names the field");
    }
}
