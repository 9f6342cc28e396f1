//! The checked graph: what remains when a graph file has passed every rule. Executors and tools work with this only.
//!
//! On the way: text ([`source`]) -> YAML with positions ([`yaml`], [`marked`]), with the values of [`calibration`] -> typed raw structs ([`raw`], [`shape`]) -> draft
//! with operators looked up ([`draft`]) -> rules ([`rules`]) -> [`Graph`] ([`read`]).

pub mod calibration;
pub(crate) mod draft;
mod edit;
mod exec;
mod flow;
pub(crate) mod marked;
mod overrides;
pub(crate) mod problem;
mod raw;
pub(crate) mod read;
pub mod remote;
pub mod render;
mod rules;
mod schema;
pub(crate) mod shape;
pub(crate) mod source;
pub(crate) mod suggest;
pub(crate) mod yaml;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use edit::{EditError, FileChange, FileChangeError, edit};
#[cfg(feature = "live")]
pub(crate) use exec::operator_in;
pub use flow::flow_text;
pub use overrides::{MAX_VALUES_BYTES, Override, OverrideError, ValuesError, apply_value, parse_values};
pub use problem::{MAX_PROBLEMS, Problem, Problems, Severity};
pub use read::ReadOptions;
pub use schema::schema;
pub(crate) use shape::segments as path_segments;
pub use source::MAX_FILE_BYTES;

use crate::mailbox::QueuePolicy;
use crate::registry::OperatorKind;

/// A graph that can run.
#[derive(Clone)]
pub struct Graph {
    /// Name of the robot: the second chunk of every key expression.
    pub robot: String,
    /// The file it came from.
    pub path: PathBuf,
    /// Folder where relative paths begin.
    pub base_dir: PathBuf,
    /// Its text, as read.
    pub text: String,
    /// The calibration file that it names, be it there or not.
    pub calibration: Option<PathBuf>,
    /// The nodes, in the order of the file.
    pub nodes: Vec<GraphNode>,
    /// End-to-end limits of age.
    pub budgets: Vec<Budget>,
    /// Access from other machines, if there is any.
    pub remote: Option<remote::Remote>,
    /// What the rules found strange, but not wrong.
    pub warnings: Problems,
}

/// One node.
#[derive(Clone)]
pub struct GraphNode {
    /// Its name.
    pub name: String,
    /// What runs in it.
    pub body: NodeBody,
    /// Configuration of the operator, calibration and overrides included. `null` when there is none.
    pub config: Value,
    /// Its connected inputs.
    pub inputs: Vec<Edge>,
    /// How often it steps of its own accord: from `period_ms`, else from the operator.
    pub period: Option<Duration>,
    /// Longest step.
    pub deadline: Option<Duration>,
    /// What happens after a longer one.
    pub on_overrun: OnOverrun,
    /// What happens when it dies.
    pub restart: Restart,
    /// Nodes with the same name share an OS process. By default the name of the node.
    pub process: String,
    /// The machine that runs it; `None`: the car.
    pub machine: Option<String>,
    /// SCHED_FIFO priority, 1 to 99.
    pub priority: Option<u8>,
    /// Cores that it may run on; empty: all.
    pub cpus: Vec<usize>,
    /// Keeps the pages of its process in memory (mlockall).
    pub lock_memory: bool,
    /// How long a step takes in lockstep, where computing takes no time otherwise.
    pub modelled_latency: Duration,
}

/// What runs in a node.
#[derive(Clone)]
pub enum NodeBody {
    /// An operator of ours.
    Operator(Arc<OperatorKind>),
    /// An operator in a binary of the user's own, as that describes it.
    Exec {
        /// The binary.
        path: PathBuf,
        /// Its operator.
        kind: Arc<OperatorKind>,
    },
    /// Something in another process or on another machine, which is known here by its edges only.
    Elsewhere,
}

/// A port of a node.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct PortRef {
    /// The node.
    pub node: String,
    /// The port.
    pub port: String,
}

impl std::fmt::Display for PortRef {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.node, self.port)
    }
}

/// A connection into an input port.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Edge {
    /// The input port.
    pub input: String,
    /// The output port that it reads.
    pub from: PortRef,
    /// The queue in front of the input.
    pub queue: QueuePolicy,
    /// Samples whose oldest exposure is older are withheld.
    pub max_age: Option<Duration>,
    /// No sample may be lost on the way: gaps are noticed and filled.
    pub reliable: bool,
    /// Declared delay: breaks a cycle, and is how late samples arrive in lockstep.
    pub delay: Option<Duration>,
}

/// What happens after a step that took longer than the deadline.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum OnOverrun {
    /// It is counted and reported.
    #[default]
    Warn,
    /// Besides, what queued up meanwhile is dropped, and the next period is left out.
    Skip,
    /// Besides, the car stops (latched e-stop).
    Stop,
}

/// When a node that died is started again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Restart {
    /// In which cases.
    pub policy: RestartPolicy,
    /// At most so often within the window; then the supervisor gives up.
    pub max: u32,
    /// The window.
    pub window: Duration,
}

impl Default for Restart {
    fn default() -> Self {
        Self { policy: RestartPolicy::OnFailure, max: 5, window: Duration::from_secs(60) }
    }
}

/// In which cases a node is started again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum RestartPolicy {
    /// Never.
    Never,
    /// When it died or failed, not when it ended in order.
    #[default]
    OnFailure,
    /// Whenever it ends.
    Always,
}

/// A limit of age from a sensor's port to an input or output port.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Budget {
    /// The sensor's output port.
    pub from: PortRef,
    /// Where the age is measured: an input port (when the node reads the sample), or an output port (when it is sent).
    pub to: PortRef,
    /// The limit.
    pub max_age: Duration,
    /// Whether breaking it stops the car; otherwise it is counted and reported.
    pub stops: bool,
}

impl Graph {
    /// The node of that name.
    pub fn node(&self, name: &str) -> Option<&GraphNode> {
        self.nodes.iter().find(|node| node.name == name)
    }

    /// The names of its processes, in the order of their first nodes.
    pub fn processes(&self) -> Vec<&str> {
        let mut names = Vec::new();
        for node in &self.nodes {
            if !names.contains(&node.process.as_str()) {
                names.push(node.process.as_str());
            }
        }
        names
    }

    /// The processes of one machine, in the same order; `None`: of the car.
    pub fn processes_on(&self, machine: Option<&str>) -> Vec<&str> {
        let here = |process: &&str| self.nodes.iter().any(|node| node.process == *process && node.is_on(machine));
        self.processes().into_iter().filter(here).collect()
    }

    /// The machines besides the car, in the order of their first nodes.
    pub fn machines(&self) -> Vec<&str> {
        let mut names = Vec::new();
        for machine in self.nodes.iter().filter_map(|node| node.machine.as_deref()) {
            if !names.contains(&machine) {
                names.push(machine);
            }
        }
        names
    }

    /// Whether the two ends of an edge are on different machines.
    pub fn crosses(&self, node: &GraphNode, edge: &Edge) -> bool {
        self.node(&edge.from.node).is_some_and(|writer| writer.machine != node.machine)
    }
}

impl std::fmt::Debug for Graph {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let nodes: Vec<_> = self.nodes.iter().map(|node| &node.name).collect();
        f.debug_struct("Graph")
            .field("robot", &self.robot)
            .field("path", &self.path)
            .field("nodes", &nodes)
            .finish_non_exhaustive()
    }
}

impl GraphNode {
    /// Whether that machine runs it; `None`: the car.
    pub fn is_on(&self, machine: Option<&str>) -> bool {
        self.machine.as_deref() == machine
    }

    /// The operator's kind, be it built in or in a binary of the user's own. `None`: it is [`NodeBody::Elsewhere`].
    pub fn kind(&self) -> Option<&Arc<OperatorKind>> {
        match &self.body {
            NodeBody::Operator(kind) | NodeBody::Exec { kind, .. } => Some(kind),
            NodeBody::Elsewhere => None,
        }
    }

    /// The binary of the user's own that it runs in.
    pub fn exec(&self) -> Option<&Path> {
        match &self.body {
            NodeBody::Exec { path, .. } => Some(path),
            NodeBody::Operator(_) | NodeBody::Elsewhere => None,
        }
    }
}
