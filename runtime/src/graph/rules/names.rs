//! Names are chunks of key expressions; no two ports may come to the same key.

use std::collections::HashMap;

use carril_messages::{SourceId, key};

use crate::graph::draft::{Draft, DraftNode, Report, split_port};
use crate::graph::marked::Place;

pub(super) fn valid_names(draft: &Draft<'_>, report: &mut Report<'_>) {
    match draft.robot {
        Some(robot) => check(draft.at(&["robot"]), robot, "robot", report),
        None if draft.has(&["robot"]) && !draft.root.locate(&["robot"]).value.is_null() => {}
        None => report_missing_robot(draft, report),
    }
    for node in &draft.nodes {
        let name = node.name;
        check(draft.key_at(&["nodes", name]), name, "node", report);
        if let Some(process) = &node.raw.process {
            check(draft.at(&["nodes", name, "process"]), process, &format!("node `{name}`: process"), report);
        }
        if let Some(machine) = &node.raw.machine {
            check(draft.at(&["nodes", name, "machine"]), machine, &format!("node `{name}`: machine"), report);
        }
        // Where the operator is known, its ports are what inputs are compared with.
        for edge in node.edges.iter().filter(|_| node.kind().is_none()) {
            let place = draft.key_at(&["nodes", name, "inputs", edge.input]);
            check(place, edge.input, &format!("node `{name}`: input"), report);
        }
    }
}

fn check(place: &Place, name: &str, what: &str, report: &mut Report<'_>) {
    if let Err(error) = key::check_name(name) {
        report.error(place, "invalid-name", format!("{what}: {error}"), None);
    }
}

fn report_missing_robot(draft: &Draft<'_>, report: &mut Report<'_>) {
    let hint = "write `robot: car1` at the top; it is the second chunk of every key expression".to_owned();
    report.error(draft.key_at(&["robot"]), "missing-key", "`robot` is missing".into(), Some(hint));
}

/// The key of an output is that of no other output, and of no input that takes samples from outside.
pub(super) fn unique_keys(draft: &Draft<'_>, report: &mut Report<'_>) {
    let mut sources: HashMap<SourceId, String> = HashMap::new();
    for node in &draft.nodes {
        for (name, what) in clashing_ports(node) {
            let robot = draft.robot.unwrap_or("<robot>");
            let key = format!("carril/{robot}/{}/{name}", node.name);
            let message = format!("node `{}`: {what} come to the same key `{key}`", node.name);
            let hint = "the operator must name one of its ports otherwise".to_owned();
            report.error(draft.key_at(&["nodes", node.name]), "duplicate-key-expression", message, Some(hint));
        }
        for port in node.kind().iter().flat_map(|kind| &kind.outputs) {
            let text = format!("{}/{}", node.name, port.name);
            let clash = sources.insert(SourceId::of(node.name, port.name), text.clone());
            if let Some(other) = clash.filter(|other| *other != text) {
                let message = format!("outputs `{other}` and `{text}` have the same 32-bit source id");
                let hint = "give one of the nodes another name".to_owned();
                report.error(draft.key_at(&["nodes", node.name]), "duplicate-source-id", message, Some(hint));
            }
        }
    }
}

/// Ports of one node that share a name and so a key.
fn clashing_ports<'a>(node: &'a DraftNode<'_>) -> Vec<(&'a str, String)> {
    let Some(kind) = node.kind() else { return Vec::new() };
    let mut clashes = Vec::new();
    for (index, port) in kind.outputs.iter().enumerate() {
        if kind.outputs[..index].iter().any(|other| other.name == port.name) {
            clashes.push((port.name, format!("two outputs `{}`", port.name)));
        }
        if kind.inputs.iter().any(|input| input.external && input.name == port.name) {
            clashes.push((port.name, format!("output `{0}` and external input `{0}`", port.name)));
        }
    }
    clashes
}

/// For other rules: whether both chunks of `node/port` are names.
pub(super) fn bad_chunk(text: &str) -> Option<String> {
    let (node, port) = split_port(text)?;
    [node, port].into_iter().find_map(|chunk| key::check_name(chunk).err()).map(|error| error.to_string())
}
