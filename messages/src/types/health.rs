//! How a node does. Each process publishes it once a second for each of its nodes, under `carril/<robot>/@/health/<node>`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::Stamp;

/// Where a node is in its life.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum NodeState {
    /// Not up yet.
    #[default]
    Starting,
    /// Works.
    Running,
    /// Its last step failed, or a budget or deadline made it stop.
    Faulted,
    /// Died; comes back after a pause.
    Restarting,
    /// Died too often; stays down until someone acts.
    GaveUp,
    /// Stopped in order.
    Stopped,
    /// Another machine runs it, and has not joined.
    Away,
}

/// Median, 99th percentile and maximum of a window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Percentiles {
    /// Half of the values are at most this.
    pub p50: f64,
    /// 99 of 100 values are at most this.
    pub p99: f64,
    /// All values are at most this.
    pub max: f64,
}

/// One input of a node. Counters run since the start of the node's process.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct InputHealth {
    /// The port.
    pub port: String,
    /// Samples that arrived.
    pub received: u64,
    /// Samples that a newer one pushed out before the node took them.
    pub dropped: u64,
    /// Samples that never arrived: gaps in the sequence numbers.
    pub lost: u64,
    /// Samples withheld because they were older than the edge's `max_age_ms`.
    pub stale: u64,
    /// Samples refused: another type, another version, damaged.
    pub refused: u64,
    /// Why the last one was refused.
    pub last_refusal: Option<String>,
}

/// One output of a node. Counters run since the start of the node's process, or since the node was replaced.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct OutputHealth {
    /// The port.
    pub port: String,
    /// Samples sent.
    pub sent: u64,
    /// Bytes of payload that left the process. What is read only within it is passed on as it is and counts nothing here; in
    /// lockstep the payloads of all samples count.
    pub bytes: u64,
}

/// How a node does. Counters run since the start of its process; rates and percentiles cover the last window.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Health {
    /// The node.
    pub node: String,
    /// Its operator's kind: `lane-detector`.
    pub operator: String,
    /// Its process: `vision`.
    pub process: String,
    /// Of the process; `None` in lockstep.
    pub pid: Option<u32>,
    /// Where it is in its life.
    pub state: NodeState,
    /// Since when it is in that state, on the car's clock.
    pub since: Stamp,
    /// When this was measured, on the car's clock.
    pub stamp: Stamp,
    /// Length of the window, s.
    pub window_s: f64,
    /// Steps.
    pub steps: u64,
    /// Steps per second in the window.
    pub rate_hz: f64,
    /// Samples sent, all ports.
    pub sent: u64,
    /// Duration of a step, µs.
    pub step_us: Percentiles,
    /// From the publication of the triggering sample to the end of the step, µs. `None`: no sample triggered.
    pub latency_us: Option<Percentiles>,
    /// Age of the oldest exposure at the end of the step, ms. `None`: nothing derived from a sensor.
    pub age_ms: Option<Percentiles>,
    /// Steps that took longer than the deadline.
    pub overruns: u64,
    /// Periods in which the node came too late to step at all.
    pub missed_periods: u64,
    /// Steps that failed.
    pub errors: u64,
    /// What the last failed step said.
    pub last_error: Option<String>,
    /// Samples that came too old for an end-to-end budget.
    pub budget_violations: u64,
    /// Times the node was started again. Filled in by the supervisor.
    pub restarts: u32,
    /// Large payloads of its process that found no room in shared memory, and were copied through the socket.
    pub pool_fallbacks: u64,
    /// Input by input.
    pub inputs: Vec<InputHealth>,
    /// Output by output.
    pub outputs: Vec<OutputHealth>,
}

crate::message!(Health, "carril/Health", 3);
