//! The graph file as it is written, key by key, before any rule has looked at it. The JSON Schema of the file comes from here:
//! doc comments become its descriptions. Unknown keys are refused; nothing is required here, the rules say what is missing.

use std::collections::BTreeMap;
use std::fmt;

use schemars::JsonSchema;
use serde::de::value::MapAccessDeserializer;
use serde::de::{Error, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_json::Value;

/// A graph of nodes that drives a car.
///
/// The nodes are read one by one; a first look at the file takes them for granted.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Dataflow", description = "A graph of nodes that drives a car.")]
pub(crate) struct RawFile<N = RawNode> {
    /// Name of the robot: the second chunk of every key expression.
    #[schemars(required, regex(pattern = NAME_PATTERN), with = "String")]
    pub(crate) robot: Option<String>,
    /// File with the values and records of `carril calibrate`, from the folder of this file: `car1.calibration.yaml`. Its values go
    /// over those below `config`. It need not be there: then nothing is calibrated yet.
    pub(crate) calibration: Option<String>,
    /// The nodes by name.
    #[schemars(required, with = "BTreeMap<String, RawNode>")]
    pub(crate) nodes: Option<BTreeMap<String, N>>,
    /// End-to-end limits of age.
    pub(crate) budgets: Option<Vec<RawBudget>>,
    /// Access from other machines: gateway, dashboard, Foxglove. Without it, nothing listens beyond this machine; `{}` is enough for it.
    pub(crate) remote: Option<RawRemote>,
}

/// Access from other machines.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Remote")]
pub(crate) struct RawRemote {
    /// Where the gateway listens for readers; holders of a key use the next port, over TLS. Default: 0.0.0.0:7447.
    pub(crate) listen: Option<RawAddress>,
    /// Where the dashboard is served, or `off`. Default: 0.0.0.0:8080.
    pub(crate) dashboard: Option<RawAddress>,
    /// Where Foxglove connects (its port is 8765), or `off`. Default: off.
    pub(crate) foxglove: Option<RawAddress>,
    /// Who may read. Default: anyone. Control always needs a key of `carril grant`.
    pub(crate) read: Option<RawWho>,
    /// Who may say `estop`. Default: anyone who may read.
    pub(crate) estop: Option<RawWho>,
    /// Network interface on which the car answers those who look for it, `auto` (all) or `off`. Default: auto.
    pub(crate) scouting: Option<String>,
    /// How much of the images leaves the car.
    pub(crate) images: Option<RawRemoteImages>,
    /// Other samples of a port, at most so many a second, Hz. Default: 30.
    #[schemars(range(min = 0.1, max = 1000))]
    pub(crate) max_hz: Option<f64>,
}

/// Where something listens: `0.0.0.0:7447`, a port alone, or `off`.
#[derive(Clone, Debug, JsonSchema)]
#[schemars(rename = "Address", untagged)]
pub(crate) enum RawAddress {
    /// A port, on all addresses.
    Port(#[schemars(range(min = 0, max = 65535))] i64),
    /// An address with a port, or `off`.
    Text(String),
}

/// Who may do something from another machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(rename = "Who")]
pub(crate) enum RawWho {
    /// Anyone who reaches the car over the network.
    Anyone,
    /// Holders of a key of `carril grant`.
    Granted,
}

/// How much of the images leaves the car.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "RemoteImages")]
pub(crate) struct RawRemoteImages {
    /// At most so many a second, Hz. Default: 10.
    #[schemars(range(min = 0.1, max = 100))]
    pub(crate) max_hz: Option<f64>,
    /// Wider ones are scaled down, px. Default: 480.
    #[schemars(range(min = 16, max = 4096))]
    pub(crate) max_width: Option<i64>,
    /// JPEG quality. Default: 60.
    #[schemars(range(min = 1, max = 100))]
    pub(crate) quality: Option<i64>,
}

/// What `messages::key::check_name` allows.
const NAME_PATTERN: &str = "^[a-z][a-z0-9_-]{0,47}$";

/// One node: an operator of ours (`operator`) or one in a binary of your own (`exec`).
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Node")]
pub(crate) struct RawNode {
    /// Kind of the operator: `lane-detector`. Beside `exec`: which of the binary's operators, if it has several.
    pub(crate) operator: Option<String>,
    /// Path of a binary of your own, from the folder of the graph file. Checking the graph runs it with `--describe`.
    pub(crate) exec: Option<String>,
    /// Which output each input port reads.
    pub(crate) inputs: Option<BTreeMap<String, RawInput>>,
    /// Configuration of the operator.
    pub(crate) config: Option<Value>,
    /// How often it steps of its own accord, ms. Default: the operator's own period, if it has one.
    #[schemars(range(min = 0.1, max = 60_000))]
    pub(crate) period_ms: Option<f64>,
    /// Longest step, ms. Default: none.
    #[schemars(range(min = 0.01, max = 60_000))]
    pub(crate) deadline_ms: Option<f64>,
    /// What happens after a longer step. Default: warn.
    pub(crate) on_overrun: Option<RawOnOverrun>,
    /// What happens when the node dies. Nodes that share a process share this too.
    pub(crate) restart: Option<RawRestart>,
    /// Nodes with the same name here share an OS process. Default: the name of the node.
    #[schemars(regex(pattern = NAME_PATTERN))]
    pub(crate) process: Option<String>,
    /// Name of another machine that runs it: `carril run FILE --machine NAME` there joins the car. Default: the car runs it.
    #[schemars(regex(pattern = NAME_PATTERN))]
    pub(crate) machine: Option<String>,
    /// SCHED_FIFO priority. Default: the ordinary scheduler.
    #[schemars(range(min = 1, max = 99))]
    pub(crate) priority: Option<i64>,
    /// Cores that it may run on. Default: all.
    #[schemars(inner(range(min = 0, max = 1023)))]
    pub(crate) cpus: Option<Vec<i64>>,
    /// Keeps the pages of its process in memory (mlockall). Default: false.
    pub(crate) lock_memory: Option<bool>,
    /// How long a step takes in lockstep, ms, where computing takes no time otherwise. Default: 0.
    #[schemars(range(min = 0, max = 10_000))]
    pub(crate) latency_ms: Option<f64>,
}

/// What happens after a step that took longer than the deadline.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(rename = "OnOverrun")]
pub(crate) enum RawOnOverrun {
    /// It is counted and reported.
    Warn,
    /// Besides, what queued up meanwhile is dropped, and the next period is left out.
    Skip,
    /// Besides, the car stops (latched e-stop).
    Stop,
}

/// When a node that died is started again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Restart")]
pub(crate) struct RawRestart {
    /// In which cases. Default: on-failure.
    pub(crate) policy: Option<RawPolicy>,
    /// At most so often within the window. Default: 5.
    #[schemars(range(min = 1, max = 1000))]
    pub(crate) max: Option<i64>,
    /// The window, s. Default: 60.
    #[schemars(range(min = 1, max = 86_400))]
    pub(crate) window_s: Option<f64>,
}

/// In which cases a node is started again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[schemars(rename = "RestartPolicy")]
pub(crate) enum RawPolicy {
    /// Never.
    Never,
    /// When it died or failed.
    OnFailure,
    /// Whenever it ends.
    Always,
}

/// What an input reads: `node/port`, or a map with more about the edge.
#[derive(Debug, JsonSchema)]
#[schemars(rename = "Input", untagged)]
pub(crate) enum RawInput {
    /// `node/port`
    From(String),
    /// With more about the edge.
    Edge(RawEdge),
}

/// An edge into an input.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Edge")]
pub(crate) struct RawEdge {
    /// The output that the input reads: `node/port`.
    #[schemars(required, with = "String")]
    pub(crate) from: Option<String>,
    /// `latest` (a newer sample replaces one not read yet), or how many samples wait. Default: latest.
    pub(crate) queue: Option<RawQueue>,
    /// Samples whose oldest exposure is older are withheld, ms. Default: none are.
    #[schemars(range(min = 0.01, max = 3_600_000))]
    pub(crate) max_age_ms: Option<f64>,
    /// No sample may be lost on the way. Default: false.
    pub(crate) reliable: Option<bool>,
    /// Declared delay, ms: breaks a cycle, and is how late samples arrive in lockstep. Default: none.
    #[schemars(range(min = 0.01, max = 60_000))]
    pub(crate) delay_ms: Option<f64>,
}

/// `latest`, or how many samples wait.
#[derive(Clone, Copy, Debug, JsonSchema)]
#[schemars(rename = "Queue", untagged)]
pub(crate) enum RawQueue {
    /// `latest`
    Latest(RawLatest),
    /// How many samples wait; when full, the oldest goes.
    Capacity(#[schemars(range(min = 1, max = 1024))] i64),
}

/// A newer sample replaces one not read yet.
#[derive(Clone, Copy, Debug, JsonSchema)]
#[schemars(rename = "Latest", rename_all = "lowercase")]
pub(crate) enum RawLatest {
    /// A newer sample replaces one not read yet.
    Latest,
}

/// A limit of age from a sensor's output to an input or output.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Budget")]
pub(crate) struct RawBudget {
    /// The sensor's output: `node/port`.
    #[schemars(required, with = "String")]
    pub(crate) from: Option<String>,
    /// Where the age is measured: an input (when the node reads) or an output (when it is sent).
    #[schemars(required, with = "String")]
    pub(crate) to: Option<String>,
    /// The limit, ms.
    #[schemars(required, with = "f64", range(min = 0.01, max = 3_600_000))]
    pub(crate) max_age_ms: Option<f64>,
    /// What happens when it is broken. Default: warn.
    pub(crate) on_violation: Option<RawOnViolation>,
}

/// What happens when a budget is broken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(rename = "OnViolation")]
pub(crate) enum RawOnViolation {
    /// It is counted and reported.
    Warn,
    /// The sample is withheld; several in a row stop the car.
    Stop,
}

// Written out and not `#[serde(untagged)]`: that would lose the position of what is wrong inside.
impl<'de> Deserialize<'de> for RawInput {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct InputVisitor;
        impl<'de> Visitor<'de> for InputVisitor {
            type Value = RawInput;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("`node/port` or `{ from: node/port, ... }`")
            }

            fn visit_str<E: Error>(self, from: &str) -> Result<RawInput, E> {
                Ok(RawInput::From(from.to_owned()))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<RawInput, A::Error> {
                RawEdge::deserialize(MapAccessDeserializer::new(map)).map(RawInput::Edge)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, _seq: A) -> Result<RawInput, A::Error> {
                Err(A::Error::custom("an input reads one output, got several writers"))
            }
        }
        deserializer.deserialize_any(InputVisitor)
    }
}

impl<'de> Deserialize<'de> for RawAddress {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct AddressVisitor;
        impl Visitor<'_> for AddressVisitor {
            type Value = RawAddress;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an address with a port (`0.0.0.0:7447`), a port, or `off`")
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<RawAddress, E> {
                Ok(RawAddress::Text(text.to_owned()))
            }

            fn visit_u64<E: Error>(self, port: u64) -> Result<RawAddress, E> {
                Ok(RawAddress::Port(i64::try_from(port).unwrap_or(i64::MAX)))
            }

            fn visit_i64<E: Error>(self, port: i64) -> Result<RawAddress, E> {
                Ok(RawAddress::Port(port))
            }
        }
        deserializer.deserialize_any(AddressVisitor)
    }
}

impl<'de> Deserialize<'de> for RawQueue {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct QueueVisitor;
        impl Visitor<'_> for QueueVisitor {
            type Value = RawQueue;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("`latest` or a whole number from 1 to 1024")
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<RawQueue, E> {
                if text == "latest" {
                    return Ok(RawQueue::Latest(RawLatest::Latest));
                }
                Err(E::invalid_value(serde::de::Unexpected::Str(text), &self))
            }

            fn visit_u64<E: Error>(self, capacity: u64) -> Result<RawQueue, E> {
                Ok(RawQueue::Capacity(i64::try_from(capacity).unwrap_or(i64::MAX)))
            }

            fn visit_i64<E: Error>(self, capacity: i64) -> Result<RawQueue, E> {
                Ok(RawQueue::Capacity(capacity))
            }
        }
        deserializer.deserialize_any(QueueVisitor)
    }
}
