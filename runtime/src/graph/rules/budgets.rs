//! Budgets: both ends exist, the first reaches the second, and the way between them is not slower than the limit.

use super::inputs::explain;
use super::way::{End, quickest_way};
use crate::graph::draft::{Draft, DraftBudget, Report, Target, show, split_port};
use crate::graph::suggest;

pub(super) fn budgets_reach(draft: &Draft<'_>, report: &mut Report<'_>) {
    let outputs = draft.all_outputs();
    for budget in &draft.budgets {
        if report.full() {
            return;
        }
        report_missing(draft, budget, report);
        if let Some(from) = &budget.raw.from
            && let Some((rule, reason, hint)) = explain(draft, from, &outputs)
        {
            let message = format!("budget: begins at `{}`, {reason}", suggest::shorten(from));
            report.error(draft.at(&["budgets", &budget.index, "from"]), rule, message, hint);
        }
        if let Some(to) = &budget.raw.to
            && let Err(Some((rule, message, hint))) = end(draft, to)
        {
            report.error(draft.at(&["budgets", &budget.index, "to"]), rule, format!("budget: {message}"), hint);
        }
    }
}

fn report_missing(draft: &Draft<'_>, budget: &DraftBudget<'_>, report: &mut Report<'_>) {
    let raw = budget.raw;
    for (key, missing) in
        [("from", raw.from.is_none()), ("to", raw.to.is_none()), ("max_age_ms", raw.max_age_ms.is_none())]
    {
        if missing && !draft.has(&["budgets", &budget.index, key]) {
            let hint = "a budget is `{ from: node/port, to: node/port, max_age_ms: 100 }`".to_owned();
            report.error(
                draft.at(&["budgets", &budget.index]),
                "missing-key",
                format!("budget: `{key}` is missing"),
                Some(hint),
            );
        }
    }
}

type Wrong = (&'static str, String, Option<String>);

/// Where `node/port` ends; `Err(None)`: reported elsewhere.
fn end<'a>(draft: &'a Draft<'_>, to: &'a str) -> Result<End<'a>, Option<Wrong>> {
    let shown = suggest::shorten(to);
    let Some((name, port)) = split_port(to) else {
        return Err(Some(("invalid-name", format!("ends at `{shown}`, which is no `node/port`"), None)));
    };
    if let Target::Output(index, _) = draft.output(to) {
        return Ok(End::Output(index));
    }
    let Some(index) = draft.node(name) else {
        let hint = suggest::hint(name, draft.nodes.iter().map(|node| node.name));
        let wrong =
            ("unknown-node", format!("ends at `{shown}`, but there is no node `{}`", suggest::shorten(name)), hint);
        return Err((!draft.has(&["nodes", name])).then_some(wrong));
    };
    let node = &draft.nodes[index];
    if node.edges.iter().any(|edge| edge.input == port) {
        return Ok(End::Input(index, port));
    }
    let Some(kind) = node.kind() else { return Err(None) };
    let ports = kind.outputs.iter().map(|port| port.name).chain(node.edges.iter().map(|edge| edge.input));
    let message = match kind.input(port) {
        Some(_) => format!("ends at the input `{shown}`, which is not connected"),
        None => format!("ends at `{shown}`, which is neither a connected input nor an output"),
    };
    Err(Some(("unknown-port", message, suggest::hint(port, ports.collect::<Vec<_>>()))))
}

pub(super) fn budgets_hold(draft: &Draft<'_>, report: &mut Report<'_>) {
    // An edge that is wrong itself may be the one that is missing on the way.
    let edges_unclear = draft.nodes.iter().flat_map(|node| &node.edges).any(|edge| draft.source(edge).is_none());
    for budget in &draft.budgets {
        let (Some(from), Some(to)) = (&budget.raw.from, &budget.raw.to) else { continue };
        let (Target::Output(source, _), Ok(end)) = (draft.output(from), end(draft, to)) else { continue };
        let place = ["budgets", budget.index.as_str(), "to"];
        let Some(way) = quickest_way(draft, source, from, end) else {
            if edges_unclear {
                continue;
            }
            let message = format!("budget: `{from}` does not reach `{to}`");
            let hint = "a budget follows the edges of the graph from a sensor's output; see `carril graph`".to_owned();
            report.error(draft.at(&place), "budget-cannot-hold", message, Some(hint));
            continue;
        };
        if let Some(max_age) = budget.max_age()
            && way.age > max_age
        {
            let message = format!(
                "budget: {} from `{from}` to `{to}` cannot hold: {} makes {}",
                show(max_age),
                way.terms.join(" + "),
                show(way.age)
            );
            let hint = format!("allow at least {}, or make the way quicker", show(way.age));
            report.error(
                draft.at(&["budgets", &budget.index, "max_age_ms"]),
                "budget-cannot-hold",
                message,
                Some(hint),
            );
        }
    }
}
