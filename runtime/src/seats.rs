//! What the supervisor asks of a process while a node is being replaced, and what the process answers. On the key
//! `carril/<robot>/@/seat/<process>`, in the codec of all messages. An instance of a node sits in a *seat*; a process may have two
//! of one node for a while.

use carril_messages::{CodecError, NodeState, Percentiles, codec, key};
use serde::{Deserialize, Serialize};

use crate::handover::{Handover, StepRecord};
use crate::numbers::Numbers;
use crate::positions::Positions;

/// Which instance of which node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeatName {
    /// The node.
    pub node: String,
    /// The instance; 0: the first of its process.
    pub number: u32,
}

/// A question.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum SeatQuestion {
    /// How far are your outputs? Whoever answers has heard all that the asker declared before, so that the asker gets every later
    /// sample.
    Outputs,
    /// The state of a node, for a candidate to begin with.
    Snapshot(SeatName),
    /// Build a candidate; it runs in shadow.
    Prepare {
        /// Where.
        seat: SeatName,
        /// The plan of the run with the candidate in it, as JSON.
        plan: String,
        /// The state to begin with.
        state: Option<(u32, Vec<u8>)>,
        /// Its steps may fail: those of the active instance do, too.
        may_err: bool,
        /// Processes that must have heard of its inputs before it is ready.
        neighbours: Vec<String>,
    },
    /// Read the outputs of a node from other processes, too: it is about to leave this one.
    ListenOutsideTo(String),
    /// Who are you on your links?
    Identity,
    /// Open a link to another process.
    Connect {
        /// What it says it is.
        identity: String,
        /// Where it listens.
        endpoint: String,
    },
    /// Keep what an output sends until its readers in other processes have it: one of them is about to read it reliably.
    ServeReliably {
        /// Who.
        seat: SeatName,
        /// The output.
        port: String,
    },
    /// Compare the outputs of the active instance with those of the candidate in shadow here.
    Compare {
        /// The candidate.
        candidate: SeatName,
        /// The active instance, if it sits in this process, too.
        beside: Option<u32>,
    },
    /// How does it do?
    Status(SeatName),
    /// Candidate: take nothing from now on, keep everything.
    Hold(SeatName),
    /// Hear of the steps of a successor: asked before there is one.
    Attend {
        /// Who.
        seat: SeatName,
        /// The instance that is to succeed.
        successor: u32,
    },
    /// Active instance: stop when you have received this, and hand over.
    Freeze {
        /// Who.
        seat: SeatName,
        /// What it must have received before it stops, by input.
        at_least: Vec<(String, Positions)>,
        /// Without the state.
        fresh: bool,
        /// Let go of the device.
        let_go: bool,
        /// Rest until it is to go on: it cannot follow its successor, which gets other inputs, or there is none.
        rests: bool,
    },
    /// Candidate: become the node.
    Activate {
        /// Who.
        seat: SeatName,
        /// From the predecessor.
        handover: Box<Handover>,
        /// The conditions of its probation.
        trial: TrialTerms,
    },
    /// `Hold`, `Freeze` and `Activate` at once, for two instances in the same process: what is handed over stays in it.
    TakeOver {
        /// The candidate.
        candidate: SeatName,
        /// The active instance.
        active: SeatName,
        /// As for `Freeze`.
        fresh: bool,
        /// As for `Freeze`.
        let_go: bool,
        /// Inputs that read another output than before: what waits there is of no use to the candidate.
        rewired: Vec<String>,
        /// The conditions of the probation.
        trial: TrialTerms,
    },
    /// Which sequence numbers came out of your outputs?
    CameOut {
        /// Who.
        seat: SeatName,
        /// Also those of the successors that it follows, by their word.
        with_successors: bool,
    },
    /// The probation is over.
    Commit(SeatName),
    /// Predecessor: be the node again.
    Thaw {
        /// Who.
        seat: SeatName,
        /// The successor died: publish the outputs of its last step again.
        repeat_last: bool,
    },
    /// Nothing of this instance comes out any more. Answered even while a step hangs.
    Retire(SeatName),
    /// Go on with another configuration, JSON, between two steps.
    SetConfig(SeatName, String),
}

/// The conditions of a probation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrialTerms {
    /// It ends after so many outputs.
    pub outputs: u64,
    /// So many steps may miss their deadline.
    pub overruns: u64,
    /// Steps may fail.
    pub may_err: bool,
}

/// What was handed over within a process.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HandedOver {
    /// Inputs that waited.
    pub queued: u64,
    /// Bytes of state.
    pub state_bytes: Option<u64>,
    /// Latencies of the predecessor of late.
    pub latency_us: Option<Percentiles>,
}

/// Why a candidate did not take over.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NotTakenOver {
    /// The active instance may have stopped.
    pub may_have_stopped: bool,
    /// Why.
    pub reason: String,
}

/// The answer.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum SeatAnswer {
    /// Done.
    Done,
    /// What the outputs of the process have sent, by name: `world/camera`.
    Outputs(Vec<(String, Positions)>),
    /// Who a process is on its links.
    Identity(String),
    /// The state, with its version.
    State(u32, Vec<u8>),
    /// A candidate is built.
    Prepared {
        /// It holds a device, is not built before it takes over, and runs no shadow.
        exclusive: bool,
        /// Version of its state.
        state_version: u32,
    },
    /// From where on a candidate has everything, by input.
    Held(Vec<(String, Positions)>),
    /// What the predecessor hands over, and its latencies of late.
    Handover(Box<Handover>, Option<Percentiles>),
    /// Whether a candidate took over within the process.
    TakenOver(Result<HandedOver, NotTakenOver>),
    /// The sequence numbers that came out of an instance, by port.
    CameOut(Vec<(String, Numbers)>),
    /// How an instance does.
    Status(SeatStatus),
}

/// How an instance does.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeatStatus {
    /// For how long its step has been running, ms.
    pub busy_ms: Option<f64>,
    /// For how long its oldest triggering sample has been waiting, ms.
    pub waiting_ms: Option<f64>,
    /// Steps that went well since it began, or since it took over.
    pub good_steps: u64,
    /// What its last step said, if that failed.
    pub failing: Option<String>,
    /// Its operator panicked, and is not back yet, or never will be.
    pub down: Option<NodeState>,
    /// In shadow: outputs of the active instance.
    pub active_outputs: u64,
    /// In shadow: outputs of the candidate.
    pub outputs: u64,
    /// Outputs compared in shadow.
    pub compared: u64,
    /// Of these, different.
    pub different: u64,
    /// The largest difference.
    pub largest_difference: Option<(String, f64)>,
    /// Latencies since it was asked last, us.
    pub latency_us: Option<Percentiles>,
}

/// Encodes a question or an answer.
pub fn encode<T: Serialize>(value: &T) -> Result<Vec<u8>, CodecError> {
    codec::encode(value)
}

/// Reads a question or an answer.
pub fn decode<T: serde::de::DeserializeOwned>(bytes: &[u8]) -> Result<T, CodecError> {
    codec::decode(bytes)
}

/// A step of an instance on probation, on its way to its predecessor.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ToldStep {
    /// The instance that has made it.
    pub seat: u32,
    /// The step.
    pub record: StepRecord,
}

/// `carril/<robot>/@/seat/<process>`
pub fn seat_key(robot: &str, process: &str) -> String {
    key::control_key(robot, &format!("seat/{process}"))
}

/// `carril/<robot>/@/steps/<node>`: [`ToldStep`] of an instance on probation.
pub fn steps_key(robot: &str, node: &str) -> String {
    key::control_key(robot, &format!("steps/{node}"))
}

/// `carril/<robot>/@/trial/<node>`: [`TrialReport`] of an instance on trial; `*` for all.
pub fn trial_key(robot: &str, node: &str) -> String {
    key::control_key(robot, &format!("trial/{node}"))
}

/// An instance on trial has passed, or failed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrialReport {
    /// Which.
    pub seat: SeatName,
    /// Why it failed.
    pub result: Result<(), String>,
}
