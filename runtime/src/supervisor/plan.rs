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
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Plan {
    /// Seed of the run.
    pub seed: u64,
    robot: String,
    path: PathBuf,
    base_dir: PathBuf,
    nodes: Vec<PlanNode>,
    budgets: Vec<Budget>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct PlanNode {
    name: String,
    body: PlanBody,
    config: Value,
    inputs: Vec<Edge>,
    period: Option<Duration>,
    deadline: Option<Duration>,
    on_overrun: OnOverrun,
    restart: Restart,
    process: String,
    priority: Option<u8>,
    cpus: Vec<usize>,
    lock_memory: bool,
    modelled_latency: Duration,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
enum PlanBody {
    Operator(String),
    Exec { path: PathBuf, operator: String },
    Elsewhere,
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
                NodeBody::Exec { path, kind } => PlanBody::Exec { path: path.clone(), operator: kind.name.to_owned() },
                NodeBody::Elsewhere => PlanBody::Elsewhere,
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
        let body = if self.process == process { self.own_body(registry)? } else { NodeBody::Elsewhere };
        Ok(GraphNode {
            name: self.name,
            body,
            config: self.config,
            inputs: self.inputs,
            period: self.period,
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
        let (PlanBody::Operator(operator) | PlanBody::Exec { operator, .. }) = &self.body else {
            return Ok(NodeBody::Elsewhere);
        };
        let kind = registry.get(operator).cloned().ok_or_else(|| {
            let names: Vec<String> = registry.iter().map(|kind| format!("`{}`", kind.name)).collect();
            let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            PlanError::UnknownOperator { node: self.name.clone(), operator: operator.clone(), known }
        })?;
        Ok(NodeBody::Operator(kind))
    }
}
