//! What must be done to a running graph so that it becomes another one: node by node, in words that people read before they agree.
//! Pure.

use std::collections::HashMap;
use std::time::Duration;

use serde_json::Value;

use crate::control_plane::{Action, Difference, NodeChange};
use crate::graph::{Budget, Edge};
use crate::mailbox::QueuePolicy;
use crate::parameters::{parameters, shown};
use crate::supervisor::live::operator_name;
use crate::supervisor::plan::{Built, Plan, PlanBody, PlanNode};

/// What the rule of restarts is called.
pub(super) const RESTART: &str = "restart";

/// A plan, and the configuration of each node with the defaults filled in, as far as it is known.
pub(super) struct Side<'a> {
    pub plan: &'a Plan,
    pub effective: &'a HashMap<String, Value>,
}

impl Side<'_> {
    fn config(&self, node: &PlanNode) -> Value {
        self.effective.get(&node.name).cloned().unwrap_or_else(|| node.config.clone())
    }
}

/// The changes from `running` to `wanted`: nodes that come and nodes that change in the order of `wanted`, then those that go.
pub(super) fn changes(running: &Side<'_>, wanted: &Side<'_>) -> Vec<NodeChange> {
    let come_or_change = wanted.plan.nodes.iter().filter_map(|after| match running.plan.node(&after.name) {
        Some(before) => changed(running, before, wanted, after),
        None => Some(added(after)),
    });
    let gone = running.plan.nodes.iter().filter(|before| wanted.plan.node(&before.name).is_none());
    come_or_change.chain(gone.map(removed)).collect()
}

fn added(node: &PlanNode) -> NodeChange {
    let mut found = Found::default();
    found.come("runs", body_text(&node.body));
    found.come("process", node.process.clone());
    for edge in &node.inputs {
        found.come(&format!("inputs.{}", edge.input), edge_text(edge));
    }
    found.compare_lists("budgets", &[], &budgets(node));
    NodeChange { node: node.name.clone(), actions: vec![Action::Add], differences: found.0 }
}

fn removed(node: &PlanNode) -> NodeChange {
    let mut found = Found::default();
    found.0.push(Difference { what: "runs".into(), before: Some(body_text(&node.body)), after: None });
    NodeChange { node: node.name.clone(), actions: vec![Action::Remove], differences: found.0 }
}

/// `None`: the node stays as it is.
fn changed(running: &Side<'_>, before: &PlanNode, wanted: &Side<'_>, after: &PlanNode) -> Option<NodeChange> {
    let (mut actions, mut all) = (Vec::new(), Found::default());
    let mut look = |action: Action, compare: &dyn Fn(&mut Found)| {
        let known = all.0.len();
        compare(&mut all);
        if all.0.len() > known {
            actions.push(action);
        }
    };
    look(Action::Replace, &|found| body(before, after, found));
    look(Action::Reconfigure, &|found| config(&running.config(before), &wanted.config(after), found));
    look(Action::Rewire, &|found| inputs(before, after, found));
    look(Action::Move, &|found| found.compare("process", before.declared_process(), after.declared_process()));
    look(Action::Settings, &|found| {
        let on = |node: &PlanNode| node.machine.clone().unwrap_or_else(|| "the car".into());
        found.compare("machine", &on(before), &on(after));
        settings(before, after, found);
        found.compare_lists("budgets", &budgets(before), &budgets(after));
    });
    (!actions.is_empty()).then(|| NodeChange { node: after.name.clone(), actions, differences: all.0 })
}

fn body(before: &PlanNode, after: &PlanNode, found: &mut Found) {
    found.compare("runs", &body_text(&before.body), &body_text(&after.body));
    if let (PlanBody::Exec { built: old, .. }, PlanBody::Exec { built: new, .. }) = (&before.body, &after.body)
        && old.source == new.source
    {
        found.compare("build", &build_text(old), &build_text(new));
    }
}

fn config(before: &Value, after: &Value, found: &mut Found) {
    let values = |config: &Value| {
        let all = parameters(&Value::Null, config).into_iter();
        all.map(|parameter| (parameter.path, shown(&parameter.value))).collect::<Vec<_>>()
    };
    found.compare_maps("", &values(before), &values(after));
}

fn inputs(before: &PlanNode, after: &PlanNode, found: &mut Found) {
    let edges = |node: &PlanNode| {
        let edges = node.inputs.iter();
        edges.map(|edge| (edge.input.clone(), edge_text(edge))).collect::<Vec<_>>()
    };
    found.compare_maps("inputs.", &edges(before), &edges(after));
}

fn settings(before: &PlanNode, after: &PlanNode, found: &mut Found) {
    let all = |node: &PlanNode| {
        let restart = &node.restart;
        let (policy, window) = (format!("{:?}", restart.policy).to_lowercase(), ms(restart.window));
        [
            ("period_ms", node.period.map_or_else(|| "none".to_owned(), ms)),
            ("deadline_ms", node.deadline.map_or_else(|| "none".to_owned(), ms)),
            ("on_overrun", format!("{:?}", node.on_overrun).to_lowercase()),
            (RESTART, format!("{policy}, at most {} in {window} ms", restart.max)),
            ("priority", node.priority.map_or_else(|| "none".to_owned(), |priority| priority.to_string())),
            ("cpus", format!("{:?}", node.cpus)),
            ("lock_memory", node.lock_memory.to_string()),
        ]
    };
    for ((name, old), (_, new)) in all(before).into_iter().zip(all(after)) {
        found.compare(name, &old, &new);
    }
}

/// `lane-detector`, `my-lane in ./target/release/my-lane`
fn body_text(body: &PlanBody) -> String {
    match body {
        PlanBody::Exec { built, .. } => format!("{} in {}", operator_name(body), built.source.display()),
        PlanBody::Operator(_) | PlanBody::Elsewhere => operator_name(body),
    }
}

fn build_text(built: &Built) -> String {
    format!("{} B, written at {:.3} s", built.bytes, built.modified.as_secs_f64())
}

/// `world/camera`, `ticker/number, queue 1000, reliable`. The delay is left out: it is of no account when a graph runs live.
fn edge_text(edge: &Edge) -> String {
    let mut text = edge.from.to_string();
    if edge.queue != QueuePolicy::LATEST {
        text = format!("{text}, queue {}", edge.queue.capacity);
    }
    if let Some(max_age) = edge.max_age {
        text = format!("{text}, max_age_ms {}", ms(max_age));
    }
    if edge.reliable {
        text.push_str(", reliable");
    }
    text
}

fn budgets(node: &PlanNode) -> Vec<String> {
    node.budgets.iter().map(budget_text).collect()
}

fn budget_text(budget: &Budget) -> String {
    let then = if budget.stops { "stop" } else { "warn" };
    format!("{} to {}: {} ms, {then}", budget.from, budget.to, ms(budget.max_age))
}

fn ms(duration: Duration) -> String {
    shown(&(duration.as_secs_f64() * 1e3).into())
}

#[derive(Default)]
struct Found(Vec<Difference>);

impl Found {
    fn come(&mut self, what: &str, after: String) {
        self.0.push(Difference { what: what.to_owned(), before: None, after: Some(after) });
    }

    fn compare(&mut self, what: &str, before: &str, after: &str) {
        if before != after {
            let (before, after) = (Some(before.to_owned()), Some(after.to_owned()));
            self.0.push(Difference { what: what.to_owned(), before, after });
        }
    }

    fn compare_maps(&mut self, prefix: &str, before: &[(String, String)], after: &[(String, String)]) {
        let get = |map: &[(String, String)], key: &str| map.iter().find(|(k, _)| k == key).map(|(_, v)| v.clone());
        let keys = before.iter().chain(after).map(|(key, _)| key);
        let mut seen: Vec<&String> = Vec::new();
        for key in keys {
            if seen.contains(&key) {
                continue;
            }
            seen.push(key);
            let (before, after) = (get(before, key), get(after, key));
            if before != after {
                self.0.push(Difference { what: format!("{prefix}{key}"), before, after });
            }
        }
    }

    fn compare_lists(&mut self, what: &str, before: &[String], after: &[String]) {
        let only_in = |own: &[String], other: &[String]| -> Vec<String> {
            own.iter().filter(|text| !other.contains(text)).cloned().collect()
        };
        for gone in only_in(before, after) {
            self.0.push(Difference { what: what.to_owned(), before: Some(gone), after: None });
        }
        for come in only_in(after, before) {
            self.come(what, come);
        }
    }
}
