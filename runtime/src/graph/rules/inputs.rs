//! Inputs read outputs that exist, and every input that must be connected is.

use crate::graph::draft::{Draft, DraftEdge, DraftNode, Report, Target};
use crate::graph::marked::Tree;
use crate::graph::suggest;

use super::names::bad_chunk;

pub(super) fn known_outputs(draft: &Draft<'_>, report: &mut Report<'_>) {
    let outputs = draft.all_outputs();
    for node in &draft.nodes {
        for edge in &node.edges {
            if report.full() {
                return;
            }
            check_source(draft, node, edge, &outputs, report);
        }
    }
}

fn check_source(
    draft: &Draft<'_>,
    node: &DraftNode<'_>,
    edge: &DraftEdge<'_>,
    outputs: &[String],
    report: &mut Report<'_>,
) {
    let path = ["nodes", node.name, "inputs", edge.input, "from"];
    let Some(from) = edge.from else {
        if !draft.has(&path) || draft.root.locate(&path).value.is_null() {
            let message =
                format!("node `{}`: input `{}` does not say what it reads: `from` is missing", node.name, edge.input);
            report.error(draft.key_at(&path[..4]), "missing-key", message, Some("write `from: node/port`".into()));
        }
        return;
    };
    if let Some((rule, reason, hint)) = explain(draft, from, outputs) {
        let (node, input, from) = (node.name, edge.input, suggest::shorten(from));
        report.error(draft.at(&path), rule, format!("node `{node}`: input `{input}` reads `{from}`, {reason}"), hint);
    }
}

/// What is wrong with a `node/port` that shall be an output.
pub(super) fn explain(
    draft: &Draft<'_>,
    from: &str,
    outputs: &[String],
) -> Option<(&'static str, String, Option<String>)> {
    let all = || suggest::hint(from, outputs.iter().map(String::as_str));
    match draft.output(from) {
        Target::Malformed => Some(("invalid-name", "which is no `node/port`".into(), all())),
        Target::NoNode(_) | Target::Unclear if bad_chunk(from).is_some() => {
            Some(("invalid-name", format!("but {}", bad_chunk(from)?), all()))
        }
        Target::NoNode(name) => {
            let nodes = draft.nodes.iter().map(|node| node.name);
            let nearest = suggest::nearest(from, outputs.iter().map(String::as_str));
            let hint =
                nearest.map(|nearest| format!("did you mean `{nearest}`?")).or_else(|| suggest::hint(name, nodes));
            Some(("unknown-node", format!("but there is no node `{}`", suggest::shorten(name)), hint))
        }
        Target::NoPort(source) => {
            let own: Vec<String> =
                source.kind()?.outputs.iter().map(|port| format!("{}/{}", source.name, port.name)).collect();
            let hint = match suggest::nearest(from, own.iter().map(String::as_str)) {
                Some(nearest) => Some(format!("did you mean `{nearest}`?")),
                None => Some(match suggest::list(own.iter().map(String::as_str)) {
                    Some(list) => format!("`{}` publishes {list}", source.name),
                    None => format!("`{}` publishes nothing", source.name),
                }),
            };
            Some(("unknown-port", "which nothing publishes".into(), hint))
        }
        Target::Unclear | Target::Output(..) => None,
    }
}

pub(super) fn known_inputs(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let (Some(kind), Some(inputs)) = (node.kind(), &node.raw.inputs) else { continue };
        for input in inputs.keys().filter(|input| kind.input(input).is_none()) {
            let input = input.as_str();
            let message =
                format!("node `{}`: operator `{}` has no input `{}`", node.name, kind.name, suggest::shorten(input));
            let hint = suggest::hint(input, kind.inputs.iter().map(|port| port.name));
            let hint = hint.or_else(|| Some(format!("`{}` has no inputs", kind.name)));
            report.error(draft.key_at(&["nodes", node.name, "inputs", input]), "unknown-port", message, hint);
        }
    }
}

pub(super) fn required_inputs_connected(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let Some(kind) = node.kind() else { continue };
        for port in kind.inputs.iter().filter(|port| !port.optional) {
            // A misspelt input is reported as such; that its right name is missing then needs no line of its own.
            let path = ["nodes", node.name, "inputs", port.name];
            let misspelt = || node.edges.iter().any(|edge| suggest::nearest(edge.input, [port.name]).is_some());
            let inputs_wrong = || matches!(draft.root.locate(&path[..3]).value.tree, Tree::Bad);
            if draft.has(&path) || inputs_wrong() || misspelt() {
                continue;
            }
            let message =
                format!("node `{}`: input `{}` ({}) is not connected", node.name, port.name, port.message_type);
            let hint = hint_for(draft, node, port);
            report.error(draft.key_at(&path[..3]), "unconnected-input", message, Some(hint));
        }
    }
}

fn hint_for(draft: &Draft<'_>, node: &DraftNode<'_>, port: &crate::ports::InputSpec) -> String {
    let matching = draft.nodes.iter().filter(|other| other.name != node.name).find_map(|other| {
        let output = other.kind()?.outputs.iter().find(|output| output.message_type == port.message_type)?;
        Some(format!("{}/{}", other.name, output.name))
    });
    let from = matching.unwrap_or_else(|| "node/port".into());
    format!("write `inputs: {{ {}: {from} }}`", port.name)
}
