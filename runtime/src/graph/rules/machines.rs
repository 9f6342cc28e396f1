//! Nodes on other machines: they can join, what keeps the car safe stays on it, and nobody expects more of a link than it gives.

use crate::graph::draft::{Draft, DraftBody, DraftNode, Report};
use crate::graph::marked::Place;
use crate::graph::suggest;

/// `--machine NAME` names a machine that has something to run.
pub(super) fn machine_of_this_graph(draft: &Draft<'_>, report: &mut Report<'_>) {
    let Some(machine) = draft.machine else { return };
    let mut known: Vec<&str> = draft.nodes.iter().filter_map(DraftNode::machine).collect();
    known.sort_unstable();
    known.dedup();
    if known.contains(&machine) {
        return;
    }
    let message = format!("no node of the graph is placed on machine `{}`", suggest::shorten(machine));
    let hint = suggest::hint(machine, known.iter().copied());
    let hint = hint.or_else(|| Some(format!("`machine: {machine}` on a node places it there")));
    report.error(&Place::Set(format!("--machine {machine}").into()), "unknown-machine", message, hint);
}

/// Machines come in through the gateway.
pub(super) fn machines_can_join(draft: &Draft<'_>, report: &mut Report<'_>) {
    if draft.remote.is_some() || draft.has(&["remote"]) {
        return;
    }
    let placed = draft.nodes.iter().find_map(|node| Some((node.name, node.machine()?)));
    if let Some((name, machine)) = placed {
        let message = format!("node `{name}` is placed on machine `{machine}`, which can join only by way of `remote`");
        let hint = "add `remote: {}` to the graph: then the car listens for other machines (docs/remote.md)".to_owned();
        report.error(draft.at(&["nodes", name, "machine"]), "machine-cannot-join", message, Some(hint));
    }
}

/// A car must be able to stop, and to know that it must, when every other machine is gone.
pub(super) fn safety_stays_on_the_car(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let (Some(machine), Some(kind)) = (node.machine(), node.kind()) else { continue };
        if !kind.stays_on_car {
            continue;
        }
        let message = format!(
            "node `{}`: `{}` has hardware of the car or is part of what stops it, and cannot run on machine `{machine}`",
            node.name, kind.name
        );
        let hint = "remove `machine`; what it reads may come from another machine".to_owned();
        report.error(draft.at(&["nodes", node.name, "machine"]), "stays-on-the-car", message, Some(hint));
    }
}

/// What a link has no room for is dropped.
pub(super) fn links_keep_the_newest_only(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        for edge in &node.edges {
            if edge.raw.is_none_or(|raw| raw.reliable != Some(true)) || !draft.crosses(node, edge) {
                continue;
            }
            let message = format!(
                "node `{}`: input `{}` is `reliable`, but comes from another machine, and such a link keeps only the newest \
                 sample",
                node.name, edge.input
            );
            let hint = "remove `reliable`, or place both nodes on the same machine".to_owned();
            let path = ["nodes", node.name, "inputs", edge.input, "reliable"];
            report.error(draft.key_at(&path), "reliable-between-machines", message, Some(hint));
        }
    }
}

/// The binary of a node elsewhere need not be here; then its ports are what its edges say.
pub(super) fn what_is_not_checked_here(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let DraftBody::Away(refusal) = &node.body else { continue };
        let there = match node.machine() {
            Some(machine) => format!("`carril check --machine {machine}` there does"),
            None => "`carril check` on the car does".to_owned(),
        };
        let message =
            format!("node `{}`: its ports and configuration are not checked here: {}", node.name, refusal.message);
        report.note(draft.at(&["nodes", node.name, refusal.key]), "elsewhere", message, Some(there));
    }
}
