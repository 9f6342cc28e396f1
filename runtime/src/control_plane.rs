//! What a running graph tells about itself, and where: the run file for programs on the same machine, and the keys of the
//! control plane. Pure: names and types only.
//!
//! | key below `carril/<robot>/@/` | what |
//! |---|---|
//! | `run` | queryable of the supervisor: the [`RunFile`] as JSON |
//! | `health/<node>` | put once a second by the node's process: [`Health`](carril_messages::Health) with a header |
//! | `status` | put once a second by the supervisor: [`Status`] as JSON |
//! | `control/<process>` | queryable of each process: a [`Control`](carril_messages::Control) word as JSON in, a [`ControlReply`] as JSON out |
//! | `live/<process>` | liveliness token of each process |
//! | `fault` | put by a process whose node stops the car (budget, overrun): [`FaultReport`] as JSON |

use std::path::{Path, PathBuf};

use carril_messages::{Health, Stamp, key};
use serde::{Deserialize, Serialize};

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
    /// The processes.
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
    /// Its process id; `None` while it is down.
    pub pid: Option<u32>,
}

/// One node of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeEntry {
    /// Its name.
    pub name: String,
    /// Kind of its operator, or the path of its binary.
    pub operator: String,
    /// Name of its process.
    pub process: String,
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
