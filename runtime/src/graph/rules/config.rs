//! The configuration of each operator: every key and value of the wrong shape, then everything that its own check finds.

use crate::config::Finding;
use crate::graph::draft::{Draft, DraftNode, Report};
use crate::graph::marked::Tree;
use crate::graph::shape;
use crate::registry::OperatorKind;

/// So many values of the wrong shape are looked for in one configuration; each costs reading it once more.
const MAX_SHAPE_PROBLEMS: usize = 20;

pub(super) fn valid_config(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        if let Some(kind) = node.kind() {
            check_node(draft, node, kind, report);
        }
    }
}

fn check_node(draft: &Draft<'_>, node: &DraftNode<'_>, kind: &OperatorKind, report: &mut Report<'_>) {
    let path = ["nodes", node.name, "config"];
    let mut config = draft.root.locate(&path).value.clone();
    if !draft.has(&path) {
        config.tree = Tree::Scalar(serde_json::Value::Null);
    }
    let mut dropped = false;
    for _ in 0..MAX_SHAPE_PROBLEMS {
        let Some(finding) = kind.check_shape(&config.to_json()) else { break };
        let path = config.own_path(&finding.path);
        if !(dropped && finding.message.starts_with("missing field")) {
            report_shape(draft, node, &path, &finding.message, report);
        }
        match config.get_mut(&path) {
            Some(wrong) if !path.is_empty() && !matches!(wrong.tree, Tree::Bad) => wrong.tree = Tree::Bad,
            _ => return,
        }
        dropped = true;
    }
    let here = node.machine() == draft.machine;
    let found = kind.check_config(&config.to_json(), draft.base_dir, draft.probe_devices && here);
    for finding in found.into_iter().filter(|finding| here || !finding.missing_file) {
        // After something was left out, defaults stand in for it: what is not in the file is not the user's fault.
        if !dropped || config.has(&config.own_path(&finding.path)) {
            report_value(draft, node, &config.own_path(&finding.path), finding, report);
        }
    }
}

fn report_shape(draft: &Draft<'_>, node: &DraftNode<'_>, path: &[String], message: &str, report: &mut Report<'_>) {
    let problem = shape::explain(path, message);
    let full = full_path(node, path);
    let place = if problem.about_key { draft.key_at(&full) } else { draft.at(&full) };
    let named = if problem.rule == "unknown-key" { &path[..path.len().saturating_sub(1)] } else { path };
    report.error(place, problem.rule, format!("{}: {}", place_words(node, named), problem.message), problem.hint);
}

fn report_value(draft: &Draft<'_>, node: &DraftNode<'_>, path: &[String], finding: Finding, report: &mut Report<'_>) {
    let message = format!("{}: {}", place_words(node, path), finding.message);
    report.error(draft.at(&full_path(node, path)), "wrong-config", message, finding.hint);
}

fn full_path<'a>(node: &DraftNode<'a>, path: &'a [String]) -> Vec<&'a str> {
    ["nodes", node.name, "config"].into_iter().chain(path.iter().map(String::as_str)).collect()
}

fn place_words(node: &DraftNode<'_>, path: &[String]) -> String {
    if path.is_empty() {
        return format!("node `{}`: config", node.name);
    }
    format!("node `{}`: config `{}`", node.name, path.join("."))
}
