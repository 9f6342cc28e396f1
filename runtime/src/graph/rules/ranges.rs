//! Numbers lie in their ranges (docs/graph.md), and a restart policy does what it says.

use std::ops::RangeInclusive;

use crate::graph::draft::{DEADLINE_MS, DELAY_MS, Draft, DraftNode, LATENCY_MS, MAX_AGE_MS, PERIOD_MS, Report};
use crate::graph::raw::{RawPolicy, RawQueue};

/// One number of the file.
struct Number<'a> {
    path: Vec<&'a str>,
    value: Option<f64>,
    range: RangeInclusive<f64>,
    unit: &'static str,
}

pub(super) fn numbers_in_range(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        for number in node_numbers(node).into_iter().chain(edge_numbers(node)) {
            check(draft, &number, &format!("node `{}`: ", node.name), report);
        }
        check_cpus(draft, node, report);
    }
    for budget in &draft.budgets {
        let path = vec!["budgets", &budget.index, "max_age_ms"];
        let number = Number { path, value: budget.raw.max_age_ms, range: MAX_AGE_MS, unit: " ms" };
        check(draft, &number, "budget: ", report);
    }
}

fn check(draft: &Draft<'_>, number: &Number<'_>, whose: &str, report: &mut Report<'_>) {
    let Number { path, value: Some(value), range, unit } = number else { return };
    if range.contains(value) {
        return;
    }
    let name = path.iter().skip(2).copied().collect::<Vec<_>>().join(".");
    let (min, max) = (range.start(), range.end());
    let message = format!("{whose}`{name}`: got {value}{unit}, allowed is {min} to {max}{unit}");
    report.error(draft.at(path), "out-of-range", message, None);
}

fn node_numbers<'a>(node: &DraftNode<'a>) -> Vec<Number<'a>> {
    let raw = node.raw;
    let number = |keys: &[&'static str], value, range, unit| {
        let path = ["nodes", node.name].into_iter().chain(keys.iter().copied()).collect();
        Number { path, value, range, unit }
    };
    let restart = raw.restart.unwrap_or_default();
    vec![
        number(&["period_ms"], raw.period_ms, PERIOD_MS, " ms"),
        number(&["deadline_ms"], raw.deadline_ms, DEADLINE_MS, " ms"),
        number(&["latency_ms"], raw.latency_ms, LATENCY_MS, " ms"),
        number(&["priority"], raw.priority.map(|n| n as f64), 1.0..=99.0, ""),
        number(&["restart", "max"], restart.max.map(|n| n as f64), 1.0..=1000.0, ""),
        number(&["restart", "window_s"], restart.window_s, 1.0..=86_400.0, " s"),
    ]
}

fn edge_numbers<'a>(node: &DraftNode<'a>) -> Vec<Number<'a>> {
    let mut numbers = Vec::new();
    for edge in &node.edges {
        let Some(raw) = edge.raw else { continue };
        let capacity = match raw.queue {
            Some(RawQueue::Capacity(capacity)) => Some(capacity as f64),
            Some(RawQueue::Latest(_)) | None => None,
        };
        for (key, value, range, unit) in [
            ("queue", capacity, 1.0..=1024.0, " samples"),
            ("max_age_ms", raw.max_age_ms, MAX_AGE_MS, " ms"),
            ("delay_ms", raw.delay_ms, DELAY_MS, " ms"),
        ] {
            numbers.push(Number { path: vec!["nodes", node.name, "inputs", edge.input, key], value, range, unit });
        }
    }
    numbers
}

fn check_cpus(draft: &Draft<'_>, node: &DraftNode<'_>, report: &mut Report<'_>) {
    let cpus = node.raw.cpus.as_deref().unwrap_or_default();
    for (index, &cpu) in cpus.iter().enumerate() {
        let index_text = index.to_string();
        let place = draft.at(&["nodes", node.name, "cpus", &index_text]);
        if !(0..1024).contains(&cpu) {
            let message = format!("node `{}`: `cpus`: got core {cpu}, allowed is 0 to 1023", node.name);
            report.error(place, "out-of-range", message, None);
        } else if cpus[..index].contains(&cpu) {
            let message = format!("node `{}`: `cpus`: core {cpu} is named twice", node.name);
            report.error(place, "out-of-range", message, None);
        }
    }
}

pub(super) fn restart_makes_sense(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        let Some(restart) = node.raw.restart else { continue };
        if restart.policy == Some(RawPolicy::Never) && (restart.max.is_some() || restart.window_s.is_some()) {
            let message = format!("node `{}`: with `policy: never`, `max` and `window_s` have no effect", node.name);
            let hint = "remove them, or choose `policy: on-failure`".to_owned();
            report.warning(draft.key_at(&["nodes", node.name, "restart"]), "no-effect", message, Some(hint));
        }
    }
}
