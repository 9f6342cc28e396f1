//! Which operators fit in the place of a node: what is connected to its ports must stay connected, with the same types.

use super::changes::{Changes, Failure};
use super::live::{Live, operator_name};
use super::plan::{Plan, PlanBody, PlanNode};
use crate::graph::Edge;
use crate::registry::OperatorKind;

impl Changes {
    /// In `plan`, what is connected to the ports of a node must fit.
    pub(super) fn check_ports(&self, plan: &Plan, node: &PlanNode) -> Result<(), Failure> {
        let live = self.live.lock();
        let Some(kind) = live.kind(&node.body) else { return Ok(()) };
        let wrong = live.misfits(plan, node, &kind);
        if wrong.is_empty() {
            return Ok(());
        }
        let operator = operator_name(&node.body);
        Err(Failure::refused(format!("`{operator}` does not fit as node `{}`: {}", node.name, wrong.join("; "))))
    }
}

impl Live {
    /// The other kinds of this program that fit in the place of a node as it is wired. A node without any wires: none.
    pub(super) fn fitting(&self, node: &PlanNode) -> Vec<String> {
        if node.inputs.is_empty() && self.plan.readers_of(&node.name).next().is_none() {
            return Vec::new();
        }
        let others = self.registry.iter().filter(|kind| node.body != PlanBody::Operator(kind.name.to_owned()));
        let fitting = others.filter(|kind| self.misfits(&self.plan, node, kind).is_empty());
        fitting.map(|kind| kind.name.to_owned()).collect()
    }

    /// What does not fit when `kind` runs in the place of a node of `plan`, in words.
    fn misfits(&self, plan: &Plan, node: &PlanNode, kind: &OperatorKind) -> Vec<String> {
        let kind_of = |node: &PlanNode| self.kind(&node.body);
        let required = kind.inputs.iter().filter(|spec| !spec.optional);
        let loose = required.filter(|spec| !node.inputs.iter().any(|edge| edge.input == spec.name));
        let loose = loose.map(|spec| format!("its input `{}` would not be connected", spec.name));
        // What a binary on another machine publishes is known there only.
        let unknown = |edge: &Edge| plan.node(&edge.from.node).is_some_and(|from| from.body == PlanBody::Elsewhere);
        let inputs = node.inputs.iter().filter(|edge| !unknown(edge)).filter_map(|edge| {
            let writer = plan.node(&edge.from.node).and_then(kind_of);
            wrong_input(kind, edge, writer.as_deref())
        });
        let readers = plan.readers_of(&node.name);
        let outputs = readers.filter_map(|(reader, edge)| wrong_output(kind, edge, reader, kind_of(reader).as_deref()));
        inputs.chain(loose).chain(outputs).collect()
    }
}

fn wrong_input(kind: &OperatorKind, edge: &Edge, writer: Option<&OperatorKind>) -> Option<String> {
    let Some(at) = kind.input(&edge.input) else { return Some(format!("it has no input `{}`", edge.input)) };
    let taken = &kind.inputs[at].message_type;
    let Some((writer, at)) = writer.and_then(|writer| Some((writer, writer.output(&edge.from.port)?))) else {
        return Some(format!("its input `{}` reads `{}`, which nothing publishes", edge.input, edge.from));
    };
    let sent = &writer.outputs[at].message_type;
    (sent != taken).then(|| format!("its input `{}` takes {taken}, and `{}` gives {sent}", edge.input, edge.from))
}

/// A reader that is not known here takes what it gets.
fn wrong_output(
    kind: &OperatorKind,
    edge: &Edge,
    reader: &PlanNode,
    reader_kind: Option<&OperatorKind>,
) -> Option<String> {
    let port = &edge.from.port;
    let Some(at) = kind.output(port) else {
        return Some(format!("it has no output `{port}`, which `{}` reads", reader.name));
    };
    let given = &kind.outputs[at].message_type;
    let taken = reader_kind.and_then(|kind| Some(&kind.inputs[kind.input(&edge.input)?].message_type))?;
    (given != taken).then(|| format!("its output `{port}` gives {given}, and `{}` takes {taken}", reader.name))
}
