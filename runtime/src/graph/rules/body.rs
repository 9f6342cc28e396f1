//! What runs in a node: an operator that exists, or a binary that exists and tells its operator.

use crate::graph::draft::{Draft, DraftBody, Report};
use crate::graph::suggest;

pub(super) fn operator_or_exec(draft: &Draft<'_>, report: &mut Report<'_>) {
    if draft.nodes.is_empty() && !draft.root.locate(&["nodes"]).value.keys().any(|_| true) {
        let hint = "write `nodes:` and below it a node, for example `world: { operator: sim-world }`".to_owned();
        report.error(draft.key_at(&["nodes"]), "no-nodes", "the graph has no nodes".into(), Some(hint));
    }
    for node in &draft.nodes {
        let given = |key| draft.has(&["nodes", node.name, key]);
        if !given("operator") && !given("exec") {
            let message = format!("node `{}` has neither `operator` nor `exec`", node.name);
            let hint = "`operator: KIND` for an operator of ours, `exec: PATH` for a binary of your own".to_owned();
            report.error(draft.key_at(&["nodes", node.name]), "operator-or-exec", message, Some(hint));
        }
    }
}

pub(super) fn known_operator(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let (Some(kind), None) = (&node.raw.operator, &node.raw.exec) else { continue };
        if draft.registry.get(kind).is_some() {
            continue;
        }
        let message = format!("node `{}`: there is no operator `{}`", node.name, suggest::shorten(kind));
        let hint = suggest::hint(kind, draft.registry.iter().map(|kind| kind.name));
        report.error(draft.at(&["nodes", node.name, "operator"]), "unknown-operator", message, hint);
    }
}

pub(super) fn binary_tells_its_operator(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let DraftBody::Refused(refusal) = &node.body else { continue };
        let message = format!("node `{}`: {}", node.name, refusal.message);
        report.error(draft.at(&["nodes", node.name, refusal.key]), refusal.rule, message, refusal.hint.clone());
    }
}
