//! Periods, deadlines, latencies and ages that contradict each other.

use std::time::Duration;

use crate::graph::draft::{Draft, DraftEdge, DraftNode, Report, show};
use crate::graph::raw::RawQueue;

pub(super) fn steps_fit(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let deadline = node.deadline();
        let latency = Some(node.latency()).filter(|latency| !latency.is_zero());
        let mut at_most =
            |key: &str, what: &str, value: Option<Duration>, limit_what: &str, limit: Option<Duration>| {
                if let (Some(value), Some(limit)) = (value, limit)
                    && value > limit
                {
                    let (name, value, limit) = (node.name, show(value), show(limit));
                    let message = format!("node `{name}`: {what} of {value} is longer than {limit_what} of {limit}");
                    let hint = format!("every step would break it: at most {limit}");
                    report.error(draft.at(&["nodes", name, key]), "timing-cannot-hold", message, Some(hint));
                }
            };
        at_most("deadline_ms", "the deadline", deadline, "the period", node.period);
        at_most("latency_ms", "the modelled latency", latency, "the deadline", deadline);
        at_most("latency_ms", "the modelled latency", latency, "the period", node.period);
    }
}

/// How often a node steps, if that can be told: its period, else the shortest interval of what triggers it.
pub(super) fn interval(draft: &Draft<'_>, node: usize, depth: usize) -> Option<Duration> {
    const MAX_CHAIN: usize = 64;
    let node = &draft.nodes[node];
    if node.period.is_some() || depth > MAX_CHAIN {
        return node.period;
    }
    let mut triggers = node.edges.iter().filter(|edge| node.triggers(edge));
    // With several triggers the search would branch at each node; the first tells enough for a rule that may stay silent.
    match (triggers.next(), triggers.next()) {
        (Some(only), None) => interval(draft, draft.source(only)?, depth + 1),
        _ => None,
    }
}

pub(super) fn samples_stay_fresh(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        for edge in &node.edges {
            let Some(max_age) = edge.max_age() else { continue };
            if let Some((message, hint)) = too_old(draft, node, edge, max_age) {
                let path = ["nodes", node.name, "inputs", edge.input, "max_age_ms"];
                let message = format!("node `{}`: input `{}`: {message}", node.name, edge.input);
                report.error(draft.at(&path), "timing-cannot-hold", message, Some(hint));
            }
        }
    }
}

/// Why samples on this edge are older than `max_age` as a rule.
fn too_old(
    draft: &Draft<'_>,
    node: &DraftNode<'_>,
    edge: &DraftEdge<'_>,
    max_age: Duration,
) -> Option<(String, String)> {
    let source = draft.source(edge)?;
    let producer = &draft.nodes[source];
    let on_the_way = producer.latency() + edge.delay().unwrap_or_default();
    if on_the_way > max_age {
        let message =
            format!("`max_age_ms` is {}, but samples arrive {} after their capture", show(max_age), show(on_the_way));
        return Some((message, "none would ever be read; allow more, or lower the latency or delay".into()));
    }
    // A node that steps only when the sample arrives reads it fresh, however seldom that is.
    let held = !node.triggers(edge) || node.period.is_some();
    let every = interval(draft, source, 0).filter(|every| held && max_age < *every)?;
    let message =
        format!("`max_age_ms` is {}, but `{}` sends only every {}", show(max_age), producer.name, show(every));
    Some((message, format!("the sample would be missing most of the time; allow at least {}", show(every))))
}

pub(super) fn settings_have_an_effect(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let path = ["nodes", node.name, "on_overrun"];
        if node.raw.on_overrun.is_some() && !draft.has(&["nodes", node.name, "deadline_ms"]) {
            let message = format!("node `{}`: `on_overrun` has no effect without `deadline_ms`", node.name);
            report.warning(draft.key_at(&path), "no-effect", message, Some("add `deadline_ms`".into()));
        }
        for edge in &node.edges {
            let Some(raw) = edge.raw.filter(|raw| raw.reliable == Some(true)) else { continue };
            if !matches!(raw.queue, Some(RawQueue::Capacity(capacity)) if capacity > 1) {
                let path = ["nodes", node.name, "inputs", edge.input, "reliable"];
                let message = format!(
                    "node `{}`: input `{}` is `reliable`, but its queue holds one sample, and a newer one pushes it out",
                    node.name, edge.input
                );
                report.warning(draft.key_at(&path), "no-effect", message, Some("add `queue: 16`".into()));
            }
        }
    }
}
