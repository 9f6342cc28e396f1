//! Budgets: both ends exist, the first reaches the second, and the way between them is not slower than the limit.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

use super::inputs::explain;
use super::timing::interval;
use crate::graph::draft::{Draft, DraftBudget, Report, Target, millis, show, split_port};
use crate::graph::suggest;

/// Where a budget ends.
#[derive(Clone, Copy)]
enum End<'a> {
    Input(usize, &'a str),
    Output(usize),
}

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
    if let Target::Output(index, Some(_)) = draft.output(to) {
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
    let Some(kind) = node.kind() else {
        return if node.raw.exec.is_some() { Ok(End::Output(index)) } else { Err(None) };
    };
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
        if let Some(max_age) = budget.raw.max_age_ms.and_then(millis)
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

/// The age that samples reach on the quickest way.
struct Way {
    age: Duration,
    terms: Vec<String>,
}

/// Each hop costs the producer's modelled latency and the edge's delay. A reader that is not triggered by the hop, or that also
/// has a period, reads samples again until the next exposure: then the sensor's interval counts, once, and the reader's period
/// counts when it waits for it.
fn quickest_way(draft: &Draft<'_>, source: usize, from: &str, end: End<'_>) -> Option<Way> {
    // State: node, and whether a reader on the way holds samples. Ordered by age, then by index, so that it is deterministic.
    let sensor_interval = interval(draft, source, 0).unwrap_or_default();
    let mut best: Vec<[Option<(Duration, usize, bool, usize)>; 2]> = vec![[None; 2]; draft.nodes.len()];
    let mut queue = BinaryHeap::from([Reverse((Duration::ZERO, source, false))]);
    best[source][0] = Some((Duration::ZERO, source, false, usize::MAX));
    let readers = readers(draft);
    let mut arrival: Option<(Duration, usize, bool, usize)> = None;
    while let Some(Reverse((age, node, held))) = queue.pop() {
        if best[node][usize::from(held)].is_some_and(|known| known.0 < age) {
            continue;
        }
        if matches!(end, End::Output(last) if last == node) {
            let total = age + draft.nodes[node].latency();
            keep(&mut arrival, (total, node, held, usize::MAX));
        }
        for &(reader, edge) in &readers[node] {
            let input = &draft.nodes[reader].edges[edge];
            if node == source && input.from != Some(from) && age.is_zero() && !held {
                continue;
            }
            let (cost, holds) = hop(draft, node, reader, edge);
            let mut next = age + cost;
            let held_next = held || holds;
            if holds && !held {
                next += sensor_interval;
            }
            if matches!(end, End::Input(last, port) if last == reader && port == input.input) {
                keep(&mut arrival, (next, node, held, edge));
            }
            let known = &mut best[reader][usize::from(held_next)];
            if known.is_none_or(|known| next < known.0) {
                *known = Some((next, node, held, edge));
                queue.push(Reverse((next, reader, held_next)));
            }
        }
    }
    arrival.map(|last| Way { age: last.0, terms: terms(draft, source, &best, last, end) })
}

fn keep(arrival: &mut Option<(Duration, usize, bool, usize)>, new: (Duration, usize, bool, usize)) {
    if arrival.is_none_or(|known| new.0 < known.0) {
        *arrival = Some(new);
    }
}

fn readers(draft: &Draft<'_>) -> Vec<Vec<(usize, usize)>> {
    let mut readers = vec![Vec::new(); draft.nodes.len()];
    for (reader, node) in draft.nodes.iter().enumerate() {
        for (edge, input) in node.edges.iter().enumerate() {
            if let Some(source) = draft.source(input) {
                readers[source].push((reader, edge));
            }
        }
    }
    readers
}

/// What a hop adds to the age, and whether its reader holds samples.
fn hop(draft: &Draft<'_>, writer: usize, reader: usize, edge: usize) -> (Duration, bool) {
    let (writer, reader) = (&draft.nodes[writer], &draft.nodes[reader]);
    let input = &reader.edges[edge];
    let waits = if reader.triggers(input) { Duration::ZERO } else { reader.period.unwrap_or_default() };
    let holds = !reader.triggers(input) || reader.period.is_some();
    (writer.latency() + input.delay().unwrap_or_default() + waits, holds)
}

/// The parts of the sum, for the message.
fn terms(
    draft: &Draft<'_>,
    source: usize,
    best: &[[Option<(Duration, usize, bool, usize)>; 2]],
    last: (Duration, usize, bool, usize),
    end: End<'_>,
) -> Vec<String> {
    let mut hops = Vec::new();
    let (mut reader, mut step) = match end {
        End::Input(node, _) => (node, Some(last)),
        End::Output(node) => (node, best[node][usize::from(last.2)]),
    };
    while let Some((_, writer, held, edge)) = step.filter(|step| step.3 != usize::MAX) {
        hops.push((writer, reader, edge, held));
        (reader, step) = (writer, best[writer][usize::from(held)]);
    }
    hops.reverse();
    let mut terms = Vec::new();
    let mut add = |duration: Duration, what: String| {
        if !duration.is_zero() {
            terms.push(format!("{} ({what})", show(duration)));
        }
    };
    if hops.iter().any(|&(writer, reader, edge, held)| !held && hop(draft, writer, reader, edge).1) {
        add(interval(draft, source, 0).unwrap_or_default(), format!("period of `{}`", draft.nodes[source].name));
    }
    for (writer, reader, edge, _) in hops {
        let (writer, reader) = (&draft.nodes[writer], &draft.nodes[reader]);
        let input = &reader.edges[edge];
        add(writer.latency(), format!("latency of `{}`", writer.name));
        add(input.delay().unwrap_or_default(), format!("delay into `{}/{}`", reader.name, input.input));
        if !reader.triggers(input) {
            add(reader.period.unwrap_or_default(), format!("period of `{}`", reader.name));
        }
    }
    if let End::Output(node) = end {
        add(draft.nodes[node].latency(), format!("latency of `{}`", draft.nodes[node].name));
    }
    terms
}
