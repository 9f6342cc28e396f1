//! Nodes that share an OS process share what a process has only once: locked memory, restarts, and the binary.

use std::collections::BTreeMap;

use crate::graph::draft::{Draft, DraftBody, DraftNode, Report};

pub(super) fn one_setting_per_process(draft: &Draft<'_>, report: &mut Report<'_>) {
    let mut processes: BTreeMap<&str, Vec<&DraftNode<'_>>> = BTreeMap::new();
    for node in &draft.nodes {
        processes.entry(process_of(node)).or_default().push(node);
    }
    for (process, nodes) in processes.iter().filter(|(_, nodes)| nodes.len() > 1) {
        alone_when_exec(draft, process, nodes, report);
        same_machine(draft, process, nodes, report);
        same_setting(draft, process, nodes, "lock_memory", |node| node.raw.lock_memory, report);
        same_setting(draft, process, nodes, "restart", |node| node.raw.restart, report);
    }
}

pub(crate) fn process_of<'a>(node: &DraftNode<'a>) -> &'a str {
    node.raw.process.as_deref().unwrap_or(node.name)
}

fn alone_when_exec(draft: &Draft<'_>, process: &str, nodes: &[&DraftNode<'_>], report: &mut Report<'_>) {
    for node in nodes.iter().filter(|node| matches!(node.body, DraftBody::Exec(..) | DraftBody::Away(_))) {
        let others: Vec<_> =
            nodes.iter().filter(|other| other.name != node.name).map(|other| format!("`{}`", other.name)).collect();
        let message = format!(
            "node `{}` is a binary of its own and cannot share the process `{process}` with {}",
            node.name,
            others.join(", ")
        );
        let hint = "give one of them another `process`".to_owned();
        report.error(draft.at(&["nodes", node.name, "process"]), "shared-process", message, Some(hint));
    }
}

/// A process runs on one machine, and one that is not written down is the car.
fn same_machine(draft: &Draft<'_>, process: &str, nodes: &[&DraftNode<'_>], report: &mut Report<'_>) {
    let words = |node: &DraftNode<'_>| match node.machine() {
        Some(machine) => format!("on machine `{machine}`"),
        None => "on the car".to_owned(),
    };
    let Some((first, others)) = nodes.split_first() else { return };
    for other in others.iter().filter(|other| other.machine() != first.machine()) {
        let (name, here, there) = (other.name, words(other), words(first));
        let message =
            format!("node `{name}` is {here}, but node `{}` in the same process `{process}` is {there}", first.name);
        let hint = "give both the same `machine`, or one of them another `process`".to_owned();
        report.error(draft.key_at(&["nodes", name, "machine"]), "shared-process", message, Some(hint));
    }
}

fn same_setting<T: PartialEq>(
    draft: &Draft<'_>,
    process: &str,
    nodes: &[&DraftNode<'_>],
    key: &str,
    setting: impl Fn(&DraftNode<'_>) -> Option<T>,
    report: &mut Report<'_>,
) {
    let mut given = nodes.iter().filter_map(|node| Some((node.name, setting(node)?)));
    let Some((first, value)) = given.next() else { return };
    for (other, _) in given.filter(|(_, other)| *other != value) {
        let message =
            format!("node `{other}`: `{key}` differs from that of node `{first}` in the same process `{process}`");
        let hint = format!(
            "`{key}` belongs to the process: write it for one of its nodes only, or give one another `process`"
        );
        report.error(draft.key_at(&["nodes", other, key]), "shared-process", message, Some(hint));
    }
}
