//! What runs in a node: one operator that exists, or one binary that exists.

use std::path::Path;

use crate::graph::draft::{Draft, DraftBody, Report};
use crate::graph::suggest;

pub(super) fn operator_or_exec(draft: &Draft<'_>, report: &mut Report<'_>) {
    if draft.nodes.is_empty() && !draft.root.locate(&["nodes"]).value.keys().any(|_| true) {
        let hint = "write `nodes:` and below it a node, for example `world: { operator: sim-world }`".to_owned();
        report.error(draft.key_at(&["nodes"]), "no-nodes", "the graph has no nodes".into(), Some(hint));
    }
    for node in &draft.nodes {
        let given = |key| draft.has(&["nodes", node.name, key]);
        let message = match (given("operator"), given("exec")) {
            (true, true) => format!("node `{}` has both `operator` and `exec`", node.name),
            (false, false) => format!("node `{}` has neither `operator` nor `exec`", node.name),
            _ => continue,
        };
        let hint = "`operator: KIND` for an operator of ours, `exec: PATH` for a binary of your own".to_owned();
        let place = if given("exec") {
            draft.key_at(&["nodes", node.name, "exec"])
        } else {
            draft.key_at(&["nodes", node.name])
        };
        report.error(place, "operator-or-exec", message, Some(hint));
    }
}

pub(super) fn known_operator(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let Some(kind) = &node.raw.operator else { continue };
        if draft.registry.get(kind).is_some() {
            continue;
        }
        let message = format!("node `{}`: there is no operator `{}`", node.name, suggest::shorten(kind));
        let hint = suggest::hint(kind, draft.registry.iter().map(|kind| kind.name));
        report.error(draft.at(&["nodes", node.name, "operator"]), "unknown-operator", message, hint);
    }
}

pub(super) fn executable_exists(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let DraftBody::Exec(path) = &node.body else { continue };
        if let Some(wrong) = why_not_executable(path) {
            let message = format!("node `{}`: `{}` {wrong}", node.name, path.display());
            let hint = "build it first; the path begins at the folder of the graph file".to_owned();
            report.error(draft.at(&["nodes", node.name, "exec"]), "missing-executable", message, Some(hint));
        }
    }
}

fn why_not_executable(path: &Path) -> Option<&'static str> {
    use std::os::unix::fs::PermissionsExt;
    let Ok(metadata) = std::fs::metadata(path) else { return Some("does not exist") };
    if !metadata.is_file() {
        return Some("is no file");
    }
    (metadata.permissions().mode() & 0o111 == 0).then_some("is not executable (`chmod +x` makes it so)")
}
