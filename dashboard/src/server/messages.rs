//! What passes between server and page, as `dashboard/protocol.md` has it. Pure.

use axum::extract::ws::Utf8Bytes;
use carril_messages::{Control, Header, Payload, Stamp, dynamic};
use carril_runtime::control_plane::{Access, LogLine, Receipt, RunFile, Status};
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::graph::{Drive, Sources};

/// Of the protocol.
pub const VERSION: u32 = 1;
/// No message of a page is larger, B.
pub const MAX_MESSAGE_BYTES: usize = 64 << 10;
/// No page asks for more keys at a time.
pub const MAX_KEYS: usize = 128;

/// A message from the page.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum FromPage {
    /// What it wants to see from now on.
    Subscribe {
        /// All of it.
        keys: Vec<Want>,
    },
    /// This image, and all that were sent before it, are on the screen or were passed over.
    Ack {
        /// Its key.
        key: String,
        /// Its number.
        seq: u64,
    },
    /// What time is it?
    Ping {
        /// Comes back.
        id: u64,
    },
    /// What is a pixel worth?
    Pixel {
        /// Comes back.
        id: u64,
        /// Of an image.
        key: String,
        /// Share of the width, from the left.
        x: f64,
        /// Share of the height, from the top.
        y: f64,
    },
    /// A word to the car.
    Control {
        /// Comes back.
        id: u64,
        /// The word.
        word: Word,
    },
    /// Other values.
    Set {
        /// Comes back.
        id: u64,
        /// The node.
        node: String,
        /// Path to value.
        values: Map<String, Value>,
    },
    /// Another version.
    Swap {
        /// Comes back.
        id: u64,
        /// The node.
        node: String,
        /// Another operator of ours.
        #[serde(default)]
        operator: Option<String>,
        /// Path to value.
        #[serde(default)]
        values: Map<String, Value>,
        /// Without the state of the one before.
        #[serde(default)]
        fresh: bool,
    },
    /// The version before.
    Rollback {
        /// Comes back.
        id: u64,
        /// The node.
        node: String,
    },
    /// The same version anew, without its state.
    Restart {
        /// Comes back.
        id: u64,
        /// The node.
        node: String,
    },
    /// A message for an input that is open to people.
    Pub {
        /// Comes back.
        id: u64,
        /// `decision/goal`
        key: String,
        /// The message.
        value: Value,
    },
    /// Drive like this for the next moment.
    Drive {
        /// Comes back.
        seq: u64,
        /// Road-wheel angle, rad, + is left. `None`: JSON has no NaN, it was `null`.
        steering_rad: Option<f64>,
        /// Speed, m/s, + is forward.
        speed_m_s: Option<f64>,
        /// The newest time of the car that its author had been shown, ms.
        seen_ms: f64,
    },
    /// Stop driving.
    DriveEnd,
}

/// Words to the car, as pages spell them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Word {
    /// Drive.
    Start,
    /// Stop and wait.
    Stop,
    /// Stop at once, for good.
    Estop,
    /// Clear what was latched.
    Reset,
}

impl From<Word> for Control {
    fn from(word: Word) -> Self {
        match word {
            Word::Start => Self::Start,
            Word::Stop => Self::Stop,
            Word::Estop => Self::EStop,
            Word::Reset => Self::Reset,
        }
    }
}

/// The only message of a second connection.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum FromView {
    /// Whose view it is to carry.
    View {
        /// What `hello` said.
        of: String,
    },
}

/// A key that a page wants to see.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Want {
    /// `node/port`
    pub key: String,
    /// At most so often a second.
    pub max_hz: f64,
    /// Of an image: at most so wide, px.
    #[serde(default)]
    pub width: Option<u32>,
    /// Of an image: 1 to 100.
    #[serde(default)]
    pub quality: Option<u32>,
}

/// Reads a message.
pub fn read(text: &str) -> Result<FromPage, String> {
    let message: FromPage = serde_json::from_str(text).map_err(|error| format!("not readable: {error}"))?;
    match &message {
        FromPage::Subscribe { keys } if keys.len() > MAX_KEYS => {
            Err(format!("{} keys at a time, allowed are {MAX_KEYS}", keys.len()))
        }
        _ => Ok(message),
    }
}

/// Node and port of a key, both of them names.
pub fn split(key: &str) -> Option<(&str, &str)> {
    let (node, port) = key.split_once('/')?;
    let named = |name| carril_messages::key::check_name(name).is_ok();
    (named(node) && named(port)).then_some((node, port))
}

/// ms of the car's clock. The same stamp gives the same number, whatever message carries it.
pub fn ms(stamp: Stamp) -> f64 {
    stamp.as_nanos() as f64 / 1e6
}

fn text(value: &Value) -> Utf8Bytes {
    value.to_string().into()
}

/// The first message.
pub fn hello(
    run: &RunFile,
    drive: Option<&Drive>,
    access: &Access,
    can_log_in: bool,
    estop_open: bool,
    view: Option<&str>,
    now: Stamp,
) -> Utf8Bytes {
    // Its name: where it lies is nobody's business.
    let graph = run.graph.file_name().unwrap_or_default().to_string_lossy();
    text(&json!({
        "type": "hello", "version": VERSION, "robot": run.robot, "graph": graph, "time_ms": ms(now),
        "access": access, "can_log_in": can_log_in, "estop_open": estop_open, "drive": terms(drive),
        "view": view,
    }))
}

/// How the car can be driven by hand from now on, if it can.
pub fn drive(drive: Option<&Drive>) -> Utf8Bytes {
    text(&json!({ "type": "drive_terms", "drive": terms(drive) }))
}

fn terms(drive: Option<&Drive>) -> Value {
    drive.map_or(Value::Null, |drive| {
        json!({
            "node": drive.node, "port": drive.port, "max_speed_m_s": drive.max_speed_m_s,
            "max_steering_rad": drive.max_steering_rad, "lease_ms": drive.lease.as_millis() as u64,
        })
    })
}

/// The status, with what this server itself has to say.
pub fn status(status: &Status, link: &Value, now: Stamp) -> Utf8Bytes {
    let mut value = json!(status);
    let nodes = value["nodes"].as_array_mut().map(std::mem::take).unwrap_or_default();
    let nodes = nodes.into_iter().map(|mut node| {
        node["measured_ms"] = node["stamp"].as_i64().map(|nanos| ms(Stamp::from_nanos(nanos))).into();
        node
    });
    value["nodes"] = nodes.collect();
    value["type"] = "status".into();
    value["time_ms"] = ms(now).into();
    value["link"] = link.clone();
    text(&value)
}

/// A sample that is no image.
pub fn sample(key: &str, header: &Header, payload: &Payload, sources: &Sources) -> Utf8Bytes {
    let (value, error) = match dynamic::to_json(header, payload) {
        Ok(value) => (value, None),
        Err(error) => (Value::Null, Some(error.to_string())),
    };
    // Where there is one exposure only, nothing is to be told apart.
    let several = header.origins.iter().nth(1).is_some();
    let named = header
        .origins
        .iter()
        .filter_map(|origin| Some((sources.get(&origin.source)?.clone(), ms(origin.stamp).into())));
    let origins: Option<Map<String, Value>> = several.then(|| named.collect());
    text(&json!({
        "type": "sample", "key": key, "message_type": header.message_type.name, "seq": header.seq,
        "time_ms": ms(header.stamp), "origin_ms": header.origins.oldest().map(ms), "value": value, "error": error, "origins": origins,
    }))
}

/// A line of the log.
pub fn log(line: &LogLine) -> Utf8Bytes {
    text(&json!({
        "type": "log", "time_ms": ms(line.stamp), "level": line.level, "process": line.process, "text": line.text,
    }))
}

/// How a change came out.
pub fn receipt(receipt: &Receipt) -> Utf8Bytes {
    text(&json!({ "type": "receipt", "receipt": receipt }))
}

/// What the viewer may do from now on.
pub fn access(access: &Access) -> Utf8Bytes {
    text(&json!({ "type": "access", "access": access }))
}

/// The answer to a request.
pub fn reply(id: u64, answer: Result<Value, String>) -> Utf8Bytes {
    text(&match answer {
        Ok(value) => json!({ "type": "reply", "id": id, "ok": true, "value": value }),
        Err(error) => json!({ "type": "reply", "id": id, "ok": false, "error": error }),
    })
}

/// The answer to a ping.
pub fn pong(id: u64, now: Stamp) -> Utf8Bytes {
    text(&json!({ "type": "pong", "id": id, "time_ms": ms(now) }))
}

/// The answer to a command by hand.
pub fn drive_ack(seq: u64, now: Stamp, error: Option<&str>) -> Utf8Bytes {
    text(&json!({ "type": "drive_ack", "seq": seq, "time_ms": ms(now), "applied": error.is_none(), "error": error }))
}

/// A message that was not readable.
pub fn refused(error: &str) -> Utf8Bytes {
    text(&json!({ "type": "refused", "error": error }))
}

/// The last message.
pub fn bye(reason: &str) -> Utf8Bytes {
    text(&json!({ "type": "bye", "reason": reason }))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn reads_every_message_of_the_protocol() {
        for line in [
            r#"{"type":"subscribe","keys":[{"key":"lane/lane","max_hz":30},{"key":"world/camera","max_hz":30,"width":480,"quality":70}]}"#,
            r#"{"type":"ack","key":"world/camera","seq":1}"#,
            r#"{"type":"ping","id":6}"#,
            r#"{"type":"pixel","id":7,"key":"world/camera","x":0.5,"y":0.25}"#,
            r#"{"type":"control","id":8,"word":"estop"}"#,
            r#"{"type":"set","id":9,"node":"lane","values":{"threshold":180}}"#,
            r#"{"type":"swap","id":10,"node":"lane","operator":null,"values":{"threshold":180},"fresh":false}"#,
            r#"{"type":"rollback","id":11,"node":"lane"}"#,
            r#"{"type":"restart","id":12,"node":"lane"}"#,
            r#"{"type":"pub","id":13,"key":"decision/goal","value":{"cruise":{"speed_m_s":0.4}}}"#,
            r#"{"type":"drive","seq":9,"steering_rad":0.1,"speed_m_s":null,"seen_ms":0}"#,
            r#"{"type":"drive_end"}"#,
        ] {
            read(line).unwrap_or_else(|error| panic!("{line}: {error}"));
        }
    }

    #[test]
    fn refuses_what_it_does_not_know() {
        for line in [
            "",
            "{",
            "[]",
            "3",
            "null",
            r#"{"type":"dance"}"#,
            r#"{"type":"ack","key":3,"seq":1}"#,
            r#"{"type":"ack","key":"a/b","seq":-1}"#,
            r#"{"type":"control","id":1,"word":"fly"}"#,
            r#"{"type":"drive","seq":1,"steering_rad":1e999,"speed_m_s":0,"seen_ms":0}"#,
        ] {
            assert!(read(line).is_err(), "{line}");
        }
        let many = json!({"type": "subscribe", "keys": vec![json!({"key": "a/b", "max_hz": 1}); MAX_KEYS + 1]});
        assert!(read(&many.to_string()).expect_err("too many").contains("allowed are 128"), "the limit is named");
    }

    #[test]
    fn keys_lead_to_ports_and_nowhere_else() {
        assert_eq!(split("lane/lane"), Some(("lane", "lane")), "a port");
        for key in ["", "lane", "/", "@/estop", "lane/*", "**", "lane/lane/x", "a b/c", "../x"] {
            assert_eq!(split(key), None, "`{key}`");
        }
    }

    proptest! {
        #[test]
        fn garbage_is_no_panic(line in ".{0,200}") {
            let _ = read(&line);
        }

        #[test]
        fn damaged_messages_are_no_panic(cut in 0..100_usize, put in ".{0,8}") {
            let line = r#"{"type":"swap","id":10,"node":"lane","operator":null,"values":{"threshold":180},"fresh":false}"#;
            let cut = cut.min(line.len());
            let _ = read(&format!("{}{put}{}", &line[..cut], &line[cut..]));
            let _ = read(&line[..cut]);
        }
    }
}
