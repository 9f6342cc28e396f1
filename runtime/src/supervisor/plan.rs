//! What the supervisor tells its processes: the checked graph, as JSON in the folder of the run. So no process reads and checks
//! the graph file again, a file edited meanwhile changes nothing, and a process needs to know only its own operators.

use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use thiserror::Error;

use crate::describe::OperatorDescription;
use crate::graph::{Budget, Edge, Graph, GraphNode, NodeBody, OnOverrun, Problems, Restart};
use crate::registry::Registry;

/// Name of the file in the folder of a run.
pub const PLAN_FILE: &str = "plan.json";

/// A run, as its processes need to know it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Seed of the run.
    pub seed: u64,
    pub(super) robot: String,
    pub(super) path: PathBuf,
    pub(super) base_dir: PathBuf,
    /// The machine that the processes are on; `None`: the car.
    #[serde(default)]
    pub(super) machine: Option<String>,
    pub(super) nodes: Vec<PlanNode>,
}

/// A node of a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct PlanNode {
    pub name: String,
    pub body: PlanBody,
    pub config: Value,
    pub inputs: Vec<Edge>,
    /// From `period_ms` in the graph file; else the operator says.
    pub period: Option<Duration>,
    pub deadline: Option<Duration>,
    pub on_overrun: OnOverrun,
    pub restart: Restart,
    /// Name of its OS process: as in the graph, or with a number behind it after a change: `lane.2`.
    pub process: String,
    /// The machine that runs it; `None`: the car.
    #[serde(default)]
    pub machine: Option<String>,
    pub priority: Option<u8>,
    pub cpus: Vec<usize>,
    pub lock_memory: bool,
    pub modelled_latency: Duration,
    /// The budgets that end at one of its ports.
    pub budgets: Vec<Budget>,
}

/// What runs in a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum PlanBody {
    Operator(String),
    /// A binary of the user's own, and what it says of its operator.
    Exec {
        path: PathBuf,
        /// Which build of which file it is; `path` may be a copy.
        built: Built,
        operator: Box<OperatorDescription>,
    },
    Elsewhere,
}

impl PlanBody {
    /// Whether the same program serves both.
    pub(super) fn same_program(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Exec { path, built, .. }, Self::Exec { path: other_path, built: other_built, .. }) => {
                path == other_path && built == other_built
            }
            (Self::Exec { .. }, _) | (_, Self::Exec { .. }) => false,
            _ => true,
        }
    }

    /// Whether both are the same operator, in the same build of the same file if it is a binary of the user's own.
    pub(super) fn same_operator(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Exec { built, operator, .. }, Self::Exec { built: other_built, operator: other_operator, .. }) => {
                built == other_built && operator.name == other_operator.name
            }
            _ => self == other,
        }
    }
}

/// A build of a binary of the user's own: building it anew changes its size or its time.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Built {
    /// The file that the user named.
    pub source: PathBuf,
    pub bytes: u64,
    /// When it was written, since the epoch of the file system.
    pub modified: Duration,
}

impl Built {
    /// The build that is there now. A file that is not there has no size and no time.
    pub(super) fn of(path: &Path) -> Self {
        let source = path.canonicalize().unwrap_or_else(|_| absolute(path));
        let Ok(known) = std::fs::metadata(path) else { return Self { source, ..Self::default() } };
        let modified = known.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        Self { source, bytes: known.len(), modified: modified.unwrap_or_default() }
    }
}

/// Why a process cannot make sense of a plan.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PlanError {
    /// The file cannot be read.
    #[error("`{}`: {reason}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// The file is no plan.
    #[error("`{}` is no plan of this version of carril: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: serde_json::Error,
    },
    /// The program does not have an operator that it is to run.
    #[error("node `{node}`: this program has no operator `{operator}`; it has {known}")]
    UnknownOperator {
        /// The node.
        node: String,
        /// The operator.
        operator: String,
        /// Those that it has.
        known: String,
    },
}

impl Plan {
    /// The plan of a run on the car.
    pub fn new(graph: &Graph, seed: u64) -> Self {
        Self {
            seed,
            robot: graph.robot.clone(),
            path: absolute(&graph.path),
            base_dir: absolute(&graph.base_dir),
            machine: None,
            nodes: graph.nodes.iter().map(|node| PlanNode::of(node, &graph.budgets)).collect(),
        }
    }

    /// The same for the run on another machine.
    #[must_use]
    pub(super) fn on(self, machine: Option<String>) -> Self {
        Self { machine, ..self }
    }

    /// Whether a node runs elsewhere.
    pub(super) fn is_elsewhere(&self, node: &PlanNode) -> bool {
        node.machine != self.machine
    }

    /// The same with a node put in, or in the place of the one of that name.
    pub(super) fn with(&self, node: &PlanNode) -> Self {
        let mut plan = self.clone();
        match plan.nodes.iter_mut().find(|known| known.name == node.name) {
            Some(known) => known.clone_from(node),
            None => plan.nodes.push(node.clone()),
        }
        plan
    }

    pub(super) fn node(&self, name: &str) -> Option<&PlanNode> {
        self.nodes.iter().find(|node| node.name == name)
    }

    /// The processes on this machine that share an edge with a node, its own among them if it does.
    pub(super) fn neighbours(&self, name: &str) -> Vec<String> {
        let mut found: Vec<String> = Vec::new();
        let mut add = |node: &str| {
            if let Some(node) = self.node(node)
                && node.name != name
                && !self.is_elsewhere(node)
                && !found.contains(&node.process)
            {
                found.push(node.process.clone());
            }
        };
        for node in &self.nodes {
            for edge in &node.inputs {
                if node.name == name {
                    add(&edge.from.node);
                } else if edge.from.node == name {
                    add(&node.name);
                }
            }
        }
        found
    }

    /// Who reads outputs of a node, and by which edges.
    pub(super) fn readers_of<'a>(&'a self, writer: &'a str) -> impl Iterator<Item = (&'a PlanNode, &'a Edge)> {
        let edges = self.nodes.iter().flat_map(|node| node.inputs.iter().map(move |edge| (node, edge)));
        edges.filter(move |(_, edge)| edge.from.node == writer)
    }

    /// Whether a process has nodes.
    pub(super) fn has_nodes_in(&self, process: &str) -> bool {
        self.nodes.iter().any(|node| node.process == process)
    }

    /// Reads the plan of a run.
    pub fn read(run_dir: &Path) -> Result<Self, PlanError> {
        let path = run_dir.join(PLAN_FILE);
        let text = std::fs::read(&path).map_err(|reason| PlanError::Read { path: path.clone(), reason })?;
        serde_json::from_slice(&text).map_err(|reason| PlanError::Malformed { path, reason })
    }

    /// The graph as `process` sees it: its own nodes with their operators, the others as far as edges go.
    pub fn graph(self, process: &str, registry: &Registry) -> Result<Graph, PlanError> {
        let budgets = self.nodes.iter().flat_map(|node| node.budgets.iter().cloned()).collect();
        let nodes = self.nodes.into_iter().map(|node| node.into_node(process, registry));
        Ok(Graph {
            robot: self.robot,
            path: self.path,
            base_dir: self.base_dir,
            text: String::new(),
            calibration: None,
            nodes: nodes.collect::<Result<_, _>>()?,
            budgets,
            remote: None,
            warnings: Problems::default(),
        })
    }
}

/// Whoever reads a plan may have another working directory.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

impl PlanNode {
    fn of(node: &GraphNode, budgets: &[Budget]) -> Self {
        Self {
            name: node.name.clone(),
            body: match &node.body {
                NodeBody::Operator(kind) => PlanBody::Operator(kind.name.to_owned()),
                NodeBody::Exec { path, kind } => {
                    let operator = Box::new(OperatorDescription::of(kind));
                    PlanBody::Exec { path: absolute(path), built: Built::of(path), operator }
                }
                NodeBody::Elsewhere => PlanBody::Elsewhere,
            },
            config: node.config.clone(),
            inputs: node.inputs.clone(),
            period: node.period,
            deadline: node.deadline,
            on_overrun: node.on_overrun,
            restart: node.restart,
            process: node.process.clone(),
            machine: node.machine.clone(),
            priority: node.priority,
            cpus: node.cpus.clone(),
            lock_memory: node.lock_memory,
            modelled_latency: node.modelled_latency,
            budgets: budgets.iter().filter(|budget| budget.to.node == node.name).cloned().collect(),
        }
    }

    /// Name of its process as the graph file has it: without the number that it may have been given after a change.
    pub(super) fn declared_process(&self) -> &str {
        self.process.split('.').next().unwrap_or(&self.process)
    }

    /// The inputs that read another output than in `before`, or are connected in only one of the two.
    pub(super) fn rewired(&self, before: &Self) -> Vec<String> {
        let reads = |node: &Self, input: &str| {
            let edge = node.inputs.iter().find(|edge| edge.input == input);
            edge.map(|edge| edge.from.clone())
        };
        let mut all: Vec<&String> = self.inputs.iter().chain(&before.inputs).map(|edge| &edge.input).collect();
        all.sort();
        all.dedup();
        all.into_iter().filter(|input| reads(self, input) != reads(before, input)).cloned().collect()
    }

    fn into_node(self, process: &str, registry: &Registry) -> Result<GraphNode, PlanError> {
        let body = if self.process == process { self.own_body(registry)? } else { NodeBody::Elsewhere };
        let period = match &body {
            NodeBody::Operator(kind) => self.period.or_else(|| kind.period(&self.config)),
            NodeBody::Exec { .. } | NodeBody::Elsewhere => self.period,
        };
        Ok(GraphNode {
            name: self.name,
            body,
            config: self.config,
            inputs: self.inputs,
            period,
            deadline: self.deadline,
            on_overrun: self.on_overrun,
            restart: self.restart,
            process: self.process,
            machine: self.machine,
            priority: self.priority,
            cpus: self.cpus,
            lock_memory: self.lock_memory,
            modelled_latency: self.modelled_latency,
        })
    }

    fn own_body(&self, registry: &Registry) -> Result<NodeBody, PlanError> {
        let operator = match &self.body {
            PlanBody::Operator(operator) => operator,
            PlanBody::Exec { operator, .. } => &operator.name,
            PlanBody::Elsewhere => return Ok(NodeBody::Elsewhere),
        };
        let kind = registry.get(operator).cloned().ok_or_else(|| {
            let names: Vec<String> = registry.iter().map(|kind| format!("`{}`", kind.name)).collect();
            let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            PlanError::UnknownOperator { node: self.name.clone(), operator: operator.clone(), known }
        })?;
        Ok(NodeBody::Operator(kind))
    }
}
