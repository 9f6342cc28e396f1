//! What a running graph tells about itself, and where: the run file for programs on the same machine, and the keys of the
//! control plane. Pure: names and types only.
//!
//! | key below `carril/<robot>/@/` | what |
//! |---|---|
//! | `run` | queryable of the supervisor: the [`RunFile`] as JSON |
//! | `health/<node>` | put once a second by the node's process: [`Health`](carril_messages::Health) with a header |
//! | `status` | put once a second by the supervisor: [`Status`] as JSON |
//! | `control/<process>` | queryable of each process: a [`Control`](carril_messages::Control) word as JSON in, a [`ControlReply`] as JSON out |
//! | `word` | put by the supervisor: every [`Control`](carril_messages::Control) word that was said to the nodes, as JSON |
//! | `live/<process>` | liveliness token of each process |
//! | `graph` | queryable of the supervisor: the graph as it runs now, [`LiveGraph`] as JSON |
//! | `change` | queryable of the supervisor: a [`Change`] as JSON in, a [`Receipt`] as JSON out |
//! | `apply` | queryable of the supervisor: an [`ApplyRequest`] as JSON in, an [`ApplyReceipt`] as JSON out |
//! | `applied` | put by the supervisor: the [`ApplyReceipt`] of every change of the whole graph, as JSON |
//! | `seat/<process>` | queryable of each process: what the supervisor asks while a node is replaced, see [`seats`](crate::seats) |
//! | `receipts` | put by the supervisor: the [`Receipt`] of every change, as JSON |
//! | `log` | put by the supervisor: every [`LogLine`] as JSON; queryable: the last of them |
//! | `said` | put by tools: a [`LogLine`] as JSON for the log |
//! | `gateway` | put once a second by the gateway: [`Who`](crate::control_plane::Who) as JSON |
//! | `who` | queryable of the supervisor: the last of those, or `null` |
//! | `fault` | put by a process whose node stops the car (budget, overrun): [`FaultReport`] as JSON |
//!
//! The gateway serves these to the outside, and beyond them:
//!
//! | key below `carril/<robot>/@/` | what |
//! |---|---|
//! | `clock` | queryable: the car's time, ns, as JSON |
//! | `access/<name>` | queryable: what that name may do: [`Access`](crate::control_plane::Access) as JSON |
//! | `as/<name>/change`, `apply`, `control`, `who`, `pub/<node>/<port>` | queryables for the holder of the key `name` alone |
//! | `as/<name>/machine/<machine>/join` | queryable for the key of that machine: a [`Join`](crate::machines::Join) as JSON in, again and again |
//! | `as/<name>/machine/<machine>/port/<node>/<port>` | put by the holder of that key: a sample of a node that the graph places there |
//! | `as/<name>/machine/<machine>/status` | put by it once a second: the [`Health`](carril_messages::Health) of its nodes as a JSON list |
//! | `as/<name>/machine/<machine>/fault` | put by it: [`FaultReport`] as JSON |
//! | `estop` | queryable: stops the car, for anybody who may read, unless the graph says otherwise |
//! | `json/<node>/<port>` | every port as JSON, while somebody reads it |

use std::path::{Path, PathBuf};

use carril_messages::{Health, Percentiles, Stamp, key};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Names the folder below which runs keep their folders. For tests and for machines with several users.
pub const RUN_DIR_VARIABLE: &str = "CARRIL_RUN_DIR";
/// Name of the run file in the folder of a run.
pub const RUN_FILE: &str = "run.json";

/// Folder below which runs keep their folders: `$CARRIL_RUN_DIR`, else `$XDG_RUNTIME_DIR/carril`, else `/tmp/carril-<user id>`.
/// Short on purpose: sockets live there, and their paths have at most 107 bytes.
pub fn runs_dir(user_id: u32) -> PathBuf {
    if let Some(dir) = std::env::var_os(RUN_DIR_VARIABLE) {
        return PathBuf::from(dir);
    }
    match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(dir) => Path::new(&dir).join("carril"),
        None => PathBuf::from(format!("/tmp/carril-{user_id}")),
    }
}

/// A running graph, as written to `<runs dir>/<robot>/run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunFile {
    /// The robot.
    pub robot: String,
    /// Process id of the supervisor.
    pub pid: u32,
    /// The graph file.
    pub graph: PathBuf,
    /// When the run began, on the car's clock.
    pub started: Stamp,
    /// The car's clock: its stamp when the machine's CLOCK_MONOTONIC reads zero.
    pub clock_zero: Stamp,
    /// Where the supervisor listens, as a Zenoh endpoint.
    pub endpoint: String,
    /// The machine that it runs on; `None`: the car.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
    /// The processes on this machine.
    pub processes: Vec<ProcessEntry>,
    /// The nodes.
    pub nodes: Vec<NodeEntry>,
}

/// One process of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProcessEntry {
    /// Its name.
    pub name: String,
    /// Where it listens, as a Zenoh endpoint.
    pub endpoint: String,
    /// To whom it connects, as Zenoh endpoints.
    pub connect: Vec<String>,
    /// Its process id; `None` while it is down.
    pub pid: Option<u32>,
}

/// One node of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeEntry {
    /// Its name.
    pub name: String,
    /// Kind of its operator.
    pub operator: String,
    /// The binary of the user's own that it runs in.
    pub exec: Option<PathBuf>,
    /// Name of its process.
    pub process: String,
    /// The machine that runs it; `None`: the car.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
    /// Its inputs.
    pub inputs: Vec<InputEntry>,
    /// Its outputs.
    pub outputs: Vec<OutputEntry>,
}

/// One input port of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InputEntry {
    /// Its name.
    pub port: String,
    /// `carril/Image`
    pub message_type: String,
    /// The output that it reads: `world/camera`. `None`: not connected.
    pub from: Option<String>,
    /// `carril pub` may feed it.
    pub external: bool,
}

/// One output port of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OutputEntry {
    /// Its name.
    pub port: String,
    /// `carril/Image`
    pub message_type: String,
    /// Made only while somebody reads it.
    pub on_demand: bool,
}

/// What the supervisor knows, once a second.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// Since the start of the run, s.
    pub uptime_s: f64,
    /// Every node's last health, with the supervisor's view of its state and restarts.
    pub nodes: Vec<Health>,
    /// Why the car was stopped, if a fault stopped it. Cleared by `reset`.
    pub fault: Option<FaultReport>,
    /// On the car: the machines that run nodes of its graph.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub machines: Vec<MachineStatus>,
}

/// A machine that runs nodes of a car's graph.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MachineStatus {
    /// Its name in the graph.
    pub machine: String,
    /// Whether it is there.
    pub joined: bool,
    /// Since when, on the car's clock.
    pub since: Stamp,
    /// The nodes that it runs.
    pub nodes: Vec<String>,
}

/// A node stops the car.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FaultReport {
    /// The node.
    pub node: String,
    /// What happened, with the numbers.
    pub reason: String,
}

/// The answer of a process to a control word.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ControlReply {
    /// The process.
    pub process: String,
    /// Nodes that heard it.
    pub nodes: Vec<String>,
}

/// The graph as it runs now.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveGraph {
    /// The graph file that the run began with.
    pub graph: PathBuf,
    /// The nodes, in the order of the graph.
    pub nodes: Vec<LiveNode>,
}

/// A node as it runs now.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveNode {
    /// Its name.
    pub name: String,
    /// Kind of its operator.
    pub operator: String,
    /// The binary of the user's own that it runs in.
    pub exec: Option<PathBuf>,
    /// 1 at the start of the run; one more with each change.
    pub version: u32,
    /// Its configuration with the defaults filled in.
    pub config: Value,
    /// JSON Schema of its configuration.
    pub schema: Value,
    /// The other kinds of operators of this build that fit in its place, as it is wired.
    #[serde(default)]
    pub fitting: Vec<String>,
}

/// A change of the running graph that somebody asks for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// Other values in the configuration of a node, taken over between two steps. Keys are paths with dots, as in
    /// `carril run --set`.
    Set {
        /// The node.
        node: String,
        /// Path to value.
        values: Map<String, Value>,
    },
    /// Another version of a node takes over while the graph runs.
    Swap(SwapRequest),
    /// The version before takes over again.
    Rollback {
        /// The node.
        node: String,
        /// How.
        terms: SwapTerms,
    },
    /// The same version anew. One that is down is started without its state.
    Restart {
        /// The node.
        node: String,
        /// How; [`SwapTerms::restart`].
        terms: SwapTerms,
    },
}

/// Another version of a node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SwapRequest {
    /// The node.
    pub node: String,
    /// Another operator of ours.
    pub operator: Option<String>,
    /// A binary of the user's own.
    pub exec: Option<PathBuf>,
    /// Other values in the configuration: path with dots to value.
    pub values: Map<String, Value>,
    /// How.
    pub terms: SwapTerms,
}

/// How a node is replaced.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SwapTerms {
    /// The candidate runs in shadow for so long before it takes over, ms.
    pub shadow_ms: u64,
    /// The probation ends after so many outputs ...
    pub probation_outputs: u64,
    /// ... or after this time, ms.
    pub probation_ms: u64,
    /// A step that runs, or a sample that waits, for longer is a stall, ms.
    pub stall_ms: u64,
    /// A candidate in a process of its own may use so much memory of its own, MB.
    pub memory_limit_mb: u64,
    /// Without the state of the predecessor.
    pub fresh: bool,
    /// Compare only: nothing is taken over.
    pub compare_only: bool,
}

impl SwapTerms {
    /// Those of a restart: without shadow. `fresh`: without the state.
    pub fn restart(fresh: bool) -> Self {
        Self { shadow_ms: 0, fresh, ..Self::default() }
    }
}

impl Default for SwapTerms {
    fn default() -> Self {
        Self {
            shadow_ms: 300,
            probation_outputs: 10,
            probation_ms: 2000,
            stall_ms: 150,
            memory_limit_mb: 1024,
            fresh: false,
            compare_only: false,
        }
    }
}

/// The graph as it shall be.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ApplyRequest {
    /// The checked graph as a [`Plan`](crate::supervisor::plan::Plan), in JSON.
    pub plan: Value,
    /// The text of its file, for people.
    pub text: String,
    /// How nodes are replaced.
    pub terms: SwapTerms,
    /// What the user has seen and agreed to; anything else is refused. `None`: only say what would be done.
    pub agreed: Option<Vec<NodeChange>>,
}

/// What becomes of a node when a graph is applied.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeChange {
    /// The node.
    pub node: String,
    /// What is done to it.
    pub actions: Vec<Action>,
    /// What differs.
    pub differences: Vec<Difference>,
}

/// What is done to a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Action {
    /// It is new.
    Add,
    /// It goes.
    Remove,
    /// Another operator, or another build of a binary of the user's own.
    Replace,
    /// Other values in its configuration.
    Reconfigure,
    /// Its inputs read other outputs, or in another way.
    Rewire,
    /// It runs in another process.
    Move,
    /// Period, deadline, priority, budgets and the like.
    Settings,
}

impl std::fmt::Display for Action {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Add => "add",
            Self::Remove => "remove",
            Self::Replace => "replace",
            Self::Reconfigure => "reconfigure",
            Self::Rewire => "rewire",
            Self::Move => "move",
            Self::Settings => "settings",
        })
    }
}

/// One thing that differs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Difference {
    /// `threshold`, `inputs.lane`, `process`
    pub what: String,
    /// As it is. `None`: it is not there.
    pub before: Option<String>,
    /// As it shall be. `None`: it goes.
    pub after: Option<String>,
}

/// How the change of a whole graph came out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ApplyReceipt {
    /// How it came out; refused or rolled back: every node is as it was.
    pub outcome: Outcome,
    /// The node at which it ended, when it did not go through.
    pub node: Option<String>,
    /// In which phase.
    pub phase: Option<String>,
    /// Why, and what to do.
    pub reason: Option<String>,
    /// When, on the car's clock.
    pub stamp: Stamp,
    /// What is to be done.
    pub changes: Vec<NodeChange>,
    /// Nodes that stay as they are.
    pub unchanged: Vec<String>,
    /// The receipts of what was done, and undone, in order.
    pub steps: Vec<Receipt>,
    /// From the request to the end, ms.
    pub took_ms: f64,
}

/// How a change came out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// It is in force.
    #[default]
    Done,
    /// Nothing has changed: it was refused before it began.
    Refused,
    /// It was taken back: what was there before goes on.
    RolledBack,
    /// The candidate was only compared.
    Compared,
    /// It was only said what would be done.
    Planned,
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Done => "done",
            Self::Refused => "refused",
            Self::RolledBack => "rolled back",
            Self::Compared => "compared",
            Self::Planned => "planned",
        })
    }
}

/// The receipt of a change.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Receipt {
    /// The node.
    pub node: String,
    /// What was asked for, in words: `swap`, `set`, `shadow`, `rollback`, `restart`; of a whole graph: `add`, `remove`, `rewire`, `undo`, ...
    pub what: String,
    /// How it came out.
    pub outcome: Outcome,
    /// In which phase it ended, when it did not go through.
    pub phase: Option<String>,
    /// Why it did not go through, and what to do.
    pub reason: Option<String>,
    /// When, on the car's clock.
    pub stamp: Stamp,
    /// The version before, in words: `1: lane-detector {"threshold": 190}`.
    pub from: String,
    /// The version after; as asked for, when it did not go through.
    pub to: String,
    /// From the request to the take-over, ms; without the time asked for in shadow.
    pub took_ms: Option<f64>,
    /// The longest pause between two outputs during the change, ms.
    pub gap_ms: Option<f64>,
    /// The usual pause between two outputs, ms.
    pub usual_gap_ms: Option<f64>,
    /// Inputs that waited and were handed over.
    pub queued: u64,
    /// Samples that were lost: inputs that no version has read, outputs that never appeared.
    pub lost: u64,
    /// Samples that were there twice.
    pub duplicated: u64,
    /// Bytes of state that were handed over.
    pub state_bytes: Option<u64>,
    /// Versions of the state: of the predecessor, of the successor.
    pub state_versions: Option<(u32, u32)>,
    /// From the newest triggering sample to the end of the step, us: of the predecessor.
    pub latency_before_us: Option<Percentiles>,
    /// The same of the successor.
    pub latency_after_us: Option<Percentiles>,
    /// Outputs that were compared in shadow.
    pub compared: u64,
    /// The largest difference in shadow: port and field, and how much.
    pub largest_difference: Option<(String, f64)>,
}

/// A line of the log of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogLine {
    /// When the supervisor heard it, on the car's clock.
    pub stamp: Stamp,
    /// How grave it is.
    pub level: LogLevel,
    /// The process that said it; the supervisor itself says what becomes of processes.
    pub process: String,
    /// What.
    pub text: String,
}

/// How grave a line of the log is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogLevel {
    /// Something does not work.
    Error,
    /// Something may not work.
    Warning,
    /// What happens.
    Info,
    /// For those who look for mistakes.
    Debug,
}

/// What somebody may do with a car.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Access {
    /// How much.
    pub level: AccessLevel,
    /// The name of the key; `None`: without one.
    pub name: Option<String>,
    /// Why so much and not more, for people.
    pub why: String,
}

/// How much somebody may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AccessLevel {
    /// Look on.
    Read,
    /// All: start, swap, set, drive, reset.
    Control,
}

/// Who is connected to a gateway, and who might be.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Who {
    /// Where the gateway and its servers listen.
    pub listening: Vec<String>,
    /// Those that are connected.
    pub connected: Vec<Connected>,
    /// Names with a key that counts.
    pub granted: Vec<String>,
    /// Names whose key was revoked.
    pub revoked: Vec<String>,
    /// Machines that have joined.
    #[serde(default)]
    pub machines: Vec<String>,
    /// What was refused since the start of the gateway.
    pub refused: u64,
    /// Samples that left the car, and their bytes.
    pub sent: (u64, u64),
    /// Images and other samples that a newer one replaced on the way out.
    pub dropped: (u64, u64),
}

/// Somebody who is connected to a gateway.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Connected {
    /// From where.
    pub address: String,
    /// By which way: `zenoh`, `dashboard`.
    pub by: String,
    /// The name of the key. `None`: a reader.
    pub name: Option<String>,
}

/// `carril/<robot>/@/who`
pub fn who_key(robot: &str) -> String {
    key::control_key(robot, "who")
}

/// What anybody may ask a gateway who may read, below `carril/<robot>/@/`.
pub const OPEN_QUESTIONS: [&str; 5] = ["run", "graph", "clock", "log", "access/*"];

/// `carril/<robot>/@/estop`: anybody may ask a gateway to stop the car, unless the graph says otherwise.
pub fn open_estop_key(robot: &str) -> String {
    key::control_key(robot, "estop")
}

/// `carril/<robot>/@/as/<name>/<path>`: what only the holder of the key `name` may ask a gateway.
pub fn granted_key(robot: &str, name: &str, path: &str) -> String {
    key::control_key(robot, &format!("as/{name}/{path}"))
}

/// `carril/<robot>/@/as/<name>/machine/<machine>/<path>`: what only the key of that machine may ask and put at a gateway.
pub fn machine_key(robot: &str, name: &str, machine: &str, path: &str) -> String {
    granted_key(robot, name, &format!("machine/{machine}/{path}"))
}

/// `carril/<robot>/@/access/<name>`: what that name may do.
pub fn access_key(robot: &str, name: &str) -> String {
    key::control_key(robot, &format!("access/{name}"))
}

/// `carril/<robot>/@/clock`: the car's time.
pub fn clock_key(robot: &str) -> String {
    key::control_key(robot, "clock")
}

/// `carril/<robot>/@/said`
pub fn said_key(robot: &str) -> String {
    key::control_key(robot, "said")
}

/// `carril/<robot>/@/gateway`
pub fn gateway_key(robot: &str) -> String {
    key::control_key(robot, "gateway")
}

/// `carril/<robot>/@/log`
pub fn log_key(robot: &str) -> String {
    key::control_key(robot, "log")
}

/// `carril/<robot>/@/json/<node>/<port>`
pub fn json_key(robot: &str, node: &str, port: &str) -> String {
    key::control_key(robot, &format!("json/{node}/{port}"))
}

/// `carril/<robot>/@/graph`
pub fn graph_key(robot: &str) -> String {
    key::control_key(robot, "graph")
}

/// `carril/<robot>/@/change`
pub fn change_key(robot: &str) -> String {
    key::control_key(robot, "change")
}

/// `carril/<robot>/@/apply`
pub fn apply_key(robot: &str) -> String {
    key::control_key(robot, "apply")
}

/// `carril/<robot>/@/applied`
pub fn applied_key(robot: &str) -> String {
    key::control_key(robot, "applied")
}

/// `carril/<robot>/@/receipts`
pub fn receipts_key(robot: &str) -> String {
    key::control_key(robot, "receipts")
}

/// `carril/<robot>/@/word`
pub fn word_key(robot: &str) -> String {
    key::control_key(robot, "word")
}

/// `carril/<robot>/@/run`
pub fn run_key(robot: &str) -> String {
    key::control_key(robot, "run")
}

/// `carril/<robot>/@/status`
pub fn status_key(robot: &str) -> String {
    key::control_key(robot, "status")
}

/// `carril/<robot>/@/fault`
pub fn fault_key(robot: &str) -> String {
    key::control_key(robot, "fault")
}

/// `carril/<robot>/@/health/<node>`; `*` for all.
pub fn health_key(robot: &str, node: &str) -> String {
    key::control_key(robot, &format!("health/{node}"))
}

/// `carril/<robot>/@/control/<process>`; `*` for all.
pub fn control_key(robot: &str, process: &str) -> String {
    key::control_key(robot, &format!("control/{process}"))
}

/// `carril/<robot>/@/live/<process>`; `*` for all.
pub fn live_key(robot: &str, process: &str) -> String {
    key::control_key(robot, &format!("live/{process}"))
}
