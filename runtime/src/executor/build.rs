//! From a node of the graph to a [`Node`] at work: its operator, the queues of its inputs, and the budgets that end at it. The same
//! for every executor; starts nothing.

use carril_messages::SourceId;
use thiserror::Error;

use crate::graph::{Budget, Graph, GraphNode, NodeBody};
use crate::mailbox::QueuePolicy;
use crate::node::{Node, NodeInput, PortBudget};
use crate::operator::SetupError;
use crate::registry::{ErasedOperator, OperatorKind};
use crate::setup::Setup;

/// Why a node cannot be built.
#[derive(Clone, Debug, Error)]
pub enum BuildError {
    /// It is a binary of the user's own: it builds its operator itself.
    #[error("node `{node}` is a binary of its own (`exec:`) and runs only live, in a process of its own")]
    Exec {
        /// The node.
        node: String,
    },
    /// Its operator refuses.
    #[error("node `{node}`: operator `{operator}` cannot start: {source}")]
    Setup {
        /// The node.
        node: String,
        /// Kind of the operator.
        operator: &'static str,
        /// What it says.
        source: SetupError,
    },
}

/// Builds a node. `epoch` identifies this life of it.
pub fn build_node(node: &GraphNode, graph: &Graph, setup: &Setup, epoch: u64) -> Result<Node, BuildError> {
    let NodeBody::Operator(kind) = &node.body else { return Err(BuildError::Exec { node: node.name.clone() }) };
    let operator = kind.build(node.config.clone(), setup).map_err(|source| BuildError::Setup {
        node: node.name.clone(),
        operator: kind.name,
        source,
    })?;
    Ok(node_of(node, graph, kind, operator, epoch))
}

/// Puts a node together around its operator.
pub(crate) fn node_of(
    node: &GraphNode,
    graph: &Graph,
    kind: &OperatorKind,
    operator: Box<dyn ErasedOperator>,
    epoch: u64,
) -> Node {
    let inputs = kind.inputs.iter().map(|spec| {
        let edge = node.inputs.iter().find(|edge| edge.input == spec.name);
        NodeInput {
            spec: spec.clone(),
            queue: edge.map_or(QueuePolicy::LATEST, |edge| edge.queue),
            max_age: edge.and_then(|edge| edge.max_age),
            // A budget to `actuator/command` means the output when input and output share a name, as in the graph's checker.
            budgets: if kind.output(spec.name).is_some() {
                Vec::new()
            } else {
                budgets_at(graph, &node.name, spec.name)
            },
        }
    });
    let inputs = inputs.collect();
    let output_budgets: Vec<_> = kind.outputs.iter().map(|spec| budgets_at(graph, &node.name, spec.name)).collect();
    let outputs = kind.outputs.clone();
    let built = Node::new(&node.name, kind.name, operator, inputs, outputs, node.deadline, epoch);
    built.with_output_budgets(&output_budgets)
}

/// The budgets of the graph that end at a port.
fn budgets_at(graph: &Graph, node: &str, port: &str) -> Vec<PortBudget> {
    let ends_here = |budget: &&Budget| budget.to.node == node && budget.to.port == port;
    let budgets = graph.budgets.iter().filter(ends_here);
    budgets
        .map(|budget| PortBudget {
            source: SourceId::of(&budget.from.node, &budget.from.port),
            max_age: budget.max_age,
            stops: budget.stops,
        })
        .collect()
}
