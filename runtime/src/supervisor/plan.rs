//! What the supervisor tells its processes: the checked graph, as JSON in the folder of the run. So no process reads and checks
//! the graph file again, a file edited meanwhile changes nothing, and a process needs to know only its own operators.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use thiserror::Error;

use crate::graph::{Budget, Edge, Graph, GraphNode, NodeBody, OnOverrun, Problems, Restart};
use crate::registry::Registry;

/// Name of the file in the folder of a run.
pub const PLAN_FILE: &str = "plan.json";

/// A run, as its processes need to know it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Seed of the run.
    pub seed: u64,
    robot: String,
    pub(super) path: PathBuf,
    pub(super) base_dir: PathBuf,
    pub(super) nodes: Vec<PlanNode>,
    pub(super) budgets: Vec<Budget>,
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
    pub priority: Option<u8>,
    pub cpus: Vec<usize>,
    pub lock_memory: bool,
    pub modelled_latency: Duration,
}

/// What runs in a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum PlanBody {
    Operator(String),
    Exec(PathBuf),
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
    /// A binary of the user's own does not say which of its operators it is to run.
    #[error("node `{node}`: this program must have one operator, or one named `{node}`; it has {known}")]
    Ambiguous {
        /// The node.
        node: String,
        /// Those that it has.
        known: String,
    },
}

impl Plan {
    /// The plan of a run.
    pub fn new(graph: &Graph, seed: u64) -> Self {
        Self {
            seed,
            robot: graph.robot.clone(),
            path: absolute(&graph.path),
            base_dir: absolute(&graph.base_dir),
            nodes: graph.nodes.iter().map(PlanNode::of).collect(),
            budgets: graph.budgets.clone(),
        }
    }

    pub(super) fn node(&self, name: &str) -> Option<&PlanNode> {
        self.nodes.iter().find(|node| node.name == name)
    }

    pub(super) fn node_mut(&mut self, name: &str) -> Option<&mut PlanNode> {
        self.nodes.iter_mut().find(|node| node.name == name)
    }

    /// The processes that share an edge with a node, its own among them if it does.
    pub(super) fn neighbours(&self, name: &str) -> Vec<String> {
        let mut found: Vec<String> = Vec::new();
        let mut add = |node: &str| {
            if let Some(node) = self.node(node)
                && node.name != name
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
        let nodes = self.nodes.into_iter().map(|node| node.into_node(process, registry));
        Ok(Graph {
            robot: self.robot,
            path: self.path,
            base_dir: self.base_dir,
            text: String::new(),
            nodes: nodes.collect::<Result<_, _>>()?,
            budgets: self.budgets,
            warnings: Problems::default(),
        })
    }
}

/// Processes have the supervisor's working directory; a path is made absolute all the same, for messages.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

impl PlanNode {
    fn of(node: &GraphNode) -> Self {
        Self {
            name: node.name.clone(),
            body: match &node.body {
                NodeBody::Operator(kind) => PlanBody::Operator(kind.name.to_owned()),
                NodeBody::Exec(path) => PlanBody::Exec(path.clone()),
            },
            config: node.config.clone(),
            inputs: node.inputs.clone(),
            period: node.period,
            deadline: node.deadline,
            on_overrun: node.on_overrun,
            restart: node.restart,
            process: node.process.clone(),
            priority: node.priority,
            cpus: node.cpus.clone(),
            lock_memory: node.lock_memory,
            modelled_latency: node.modelled_latency,
        }
    }

    fn into_node(self, process: &str, registry: &Registry) -> Result<GraphNode, PlanError> {
        let body = if self.process == process { self.own_body(registry)? } else { NodeBody::Exec(PathBuf::new()) };
        let period = match &body {
            // The operator's own period is not known to a checker that does not know the operator.
            NodeBody::Operator(kind) => self.period.or_else(|| kind.period(&self.config)),
            NodeBody::Exec(_) => self.period,
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
            priority: self.priority,
            cpus: self.cpus,
            lock_memory: self.lock_memory,
            modelled_latency: self.modelled_latency,
        })
    }

    fn own_body(&self, registry: &Registry) -> Result<NodeBody, PlanError> {
        let names: Vec<String> = registry.iter().map(|kind| format!("`{}`", kind.name)).collect();
        let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let node = self.name.clone();
        let kind = match &self.body {
            PlanBody::Operator(operator) => registry.get(operator).cloned().ok_or_else(|| {
                let (node, operator, known) = (node, operator.clone(), known);
                PlanError::UnknownOperator { node, operator, known }
            })?,
            PlanBody::Exec(_) => {
                let only = (names.len() == 1).then(|| registry.iter().next()).flatten();
                only.or_else(|| registry.get(&node)).cloned().ok_or(PlanError::Ambiguous { node, known })?
            }
        };
        Ok(NodeBody::Operator(kind))
    }
}
