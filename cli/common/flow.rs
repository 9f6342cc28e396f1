//! The graph as it flows: nodes from sensors to wheels, each with what it reads, from where, how much of it, and what got lost. Pure.

use std::collections::{BTreeMap, BTreeSet};

use carril_messages::{Health, InputHealth, NodeState, OutputHealth};
use carril_runtime::control_plane::{NodeEntry, Status};
use serde::Serialize;

use super::report::Report;
use super::{drive, nodes, output};

/// A node and the edges that lead to it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stage {
    /// The node.
    pub node: String,
    /// Where it is in its life. `None`: nothing was heard of it yet.
    pub state: Option<NodeState>,
    /// Steps per second.
    pub rate_hz: f64,
    /// The inputs that read something.
    pub edges: Vec<FlowEdge>,
}

/// One edge, over the time between two looks.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FlowEdge {
    /// Input of the node.
    pub port: String,
    /// `world/camera`
    pub from: String,
    /// Samples that came, Hz. `None`: after the first look.
    pub rate_hz: Option<f64>,
    /// Their payloads, B/s. `None`: after the first look, or nothing was sent.
    pub bytes_s: Option<f64>,
    /// Samples that never arrived, since the node's process started.
    pub lost: u64,
    /// Samples that a newer one pushed out, or that were too old, since then.
    pub dropped: u64,
}

/// The stages of a run, sensors first. `before`: an earlier status, for what happened in between.
pub fn stages(entries: &[NodeEntry], before: Option<&Status>, now: &Status) -> Vec<Stage> {
    let looks = Looks { before, now };
    in_order(entries).into_iter().map(|entry| stage(entry, looks)).collect()
}

/// The two statuses that a flow is read from.
#[derive(Clone, Copy)]
struct Looks<'a> {
    before: Option<&'a Status>,
    now: &'a Status,
}

impl<'a> Looks<'a> {
    fn now(self, node: &str) -> Option<&'a Health> {
        of(self.now, node)
    }

    /// Both healths of a node.
    fn both(self, node: &str) -> Option<(&'a Health, &'a Health)> {
        Some((of(self.before?, node)?, of(self.now, node)?))
    }

    /// What a sample of an output has in between, B.
    fn mean_bytes(self, node: &str, port: &str) -> Option<f64> {
        let (before, now) = self.both(node)?;
        let (first, last) = (output(before, port)?, output(now, port)?);
        let (sent, bytes) = (last.sent.checked_sub(first.sent)?, last.bytes.checked_sub(first.bytes)?);
        (sent > 0).then(|| bytes as f64 / sent as f64)
    }

    /// Samples that came to an input in between, Hz.
    fn rate_hz(self, node: &str, port: &str) -> Option<f64> {
        let (before, now) = self.both(node)?;
        // A process that started anew counts from zero.
        let received = input(now, port)?.received.checked_sub(input(before, port)?.received)?;
        let seconds = now.stamp.since(before.stamp).as_secs_f64();
        (seconds > 0.0).then(|| received as f64 / seconds)
    }
}

fn of<'a>(status: &'a Status, node: &str) -> Option<&'a Health> {
    status.nodes.iter().find(|health| health.node == node)
}

fn input<'a>(health: &'a Health, port: &str) -> Option<&'a InputHealth> {
    health.inputs.iter().find(|input| input.port == port)
}

fn output<'a>(health: &'a Health, port: &str) -> Option<&'a OutputHealth> {
    health.outputs.iter().find(|output| output.port == port)
}

fn stage(entry: &NodeEntry, looks: Looks<'_>) -> Stage {
    let now = looks.now(&entry.name);
    let connected = entry.inputs.iter().filter_map(|input| Some((&input.port, input.from.as_ref()?)));
    let edges = connected.map(|(port, from)| {
        let rate_hz = looks.rate_hz(&entry.name, port);
        let sample_bytes = from.split_once('/').and_then(|(node, port)| looks.mean_bytes(node, port));
        let last = now.and_then(|health| input(health, port));
        FlowEdge {
            port: port.clone(),
            from: from.clone(),
            rate_hz,
            bytes_s: rate_hz.zip(sample_bytes).map(|(rate_hz, bytes)| rate_hz * bytes),
            lost: last.map_or(0, |input| input.lost),
            dropped: last.map_or(0, |input| input.dropped + input.stale),
        }
    });
    let edges = edges.collect();
    let rate_hz = now.map_or(0.0, |health| health.rate_hz);
    Stage { node: entry.name.clone(), state: now.map(|health| health.state), rate_hz, edges }
}

/// Each node after those that it reads; one of a loop comes when all others that could come have.
fn in_order(entries: &[NodeEntry]) -> Vec<&NodeEntry> {
    let reads: BTreeMap<&str, BTreeSet<&str>> = entries
        .iter()
        .map(|entry| {
            let from = entry.inputs.iter().filter_map(|input| input.from.as_deref()?.split('/').next());
            (entry.name.as_str(), from.filter(|from| *from != entry.name).collect())
        })
        .collect();
    let mut left: Vec<&NodeEntry> = entries.iter().collect();
    let mut ordered: Vec<&NodeEntry> = Vec::new();
    while !left.is_empty() {
        let waits = |entry: &&NodeEntry| {
            left.iter().filter(|other| reads[entry.name.as_str()].contains(other.name.as_str())).count()
        };
        let next = (0..left.len()).min_by_key(|at| waits(&left[*at])).unwrap_or(0);
        ordered.push(left.remove(next));
    }
    ordered
}

/// For people.
pub fn as_text(title: &str, stages: &[Stage], status: &Status) -> Report {
    let mut report = Report::default();
    report.line(title);
    let columns = ["NODE", "READS", "STATE", ">HZ", ">BANDWIDTH", ">LOST", ">DROPPED"];
    let rows: Vec<Vec<String>> = stages.iter().flat_map(rows).collect();
    report.text(&output::table(&columns, &rows));
    let fault = status.fault.iter().map(|fault| format!("STOPPED by {}: {}", fault.node, fault.reason));
    for line in fault.chain(nodes::complaints(&status.nodes)) {
        report.line(line);
    }
    report
}

fn rows(stage: &Stage) -> Vec<Vec<String>> {
    let state = stage.state.map_or("unheard", drive::state_name).to_owned();
    let head = vec![
        stage.node.clone(),
        String::new(),
        state,
        format!("{:.1}", stage.rate_hz),
        String::new(),
        String::new(),
        String::new(),
    ];
    let edge = |edge: &FlowEdge| {
        let number = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.1}"));
        let bandwidth = edge.bytes_s.map_or_else(|| "-".to_owned(), |bytes| format!("{}/s", output::bytes(bytes)));
        let reads = format!("{} <- {}", edge.port, edge.from);
        vec![
            String::new(),
            reads,
            String::new(),
            number(edge.rate_hz),
            bandwidth,
            edge.lost.to_string(),
            edge.dropped.to_string(),
        ]
    };
    std::iter::once(head).chain(stage.edges.iter().map(edge)).collect()
}

#[cfg(test)]
mod tests {
    use carril_messages::{InputHealth, Stamp};
    use carril_runtime::control_plane::InputEntry;

    use super::*;

    fn entry(name: &str, from: &[&str]) -> NodeEntry {
        let input = |from: &&str| InputEntry {
            port: "in".into(),
            message_type: "t".into(),
            from: Some((*from).to_owned()),
            external: false,
        };
        NodeEntry {
            name: name.into(),
            operator: String::new(),
            exec: None,
            machine: None,
            process: name.into(),
            inputs: from.iter().map(input).collect(),
            outputs: Vec::new(),
        }
    }

    fn health(node: &str, second: i64, received: u64, sent: u64) -> Health {
        Health {
            node: node.into(),
            stamp: Stamp::from_nanos(second * 1_000_000_000),
            inputs: vec![InputHealth { port: "in".into(), received, lost: 3, ..InputHealth::default() }],
            outputs: vec![OutputHealth { port: "out".into(), sent, bytes: sent * 100 }],
            ..Health::default()
        }
    }

    #[test]
    fn sensors_come_first_and_a_loop_ends_somewhere() {
        let entries = [
            entry("mcu", &["world/out"]),
            entry("bridge", &["lane/out"]),
            entry("lane", &["world/out"]),
            entry("world", &["mcu/out"]),
        ];
        let stages = stages(&entries, None, &Status::default());
        let order: Vec<&str> = stages.iter().map(|stage| stage.node.as_str()).collect();
        let at = |name: &str| order.iter().position(|node| *node == name);
        assert!(at("lane") < at("bridge") && order.len() == 4, "{order:?}");
    }

    #[test]
    fn an_edge_has_what_came_between_two_looks() {
        let entries = [entry("world", &[]), entry("lane", &["world/out"])];
        let status = |second, received, sent| Status {
            nodes: vec![health("world", second, 0, sent), health("lane", second, received, 0)],
            ..Status::default()
        };
        let (before, now) = (status(1, 10, 20), status(3, 70, 82));
        let edge = stages(&entries, Some(&before), &now)[1].edges[0].clone();
        assert_eq!((edge.rate_hz, edge.bytes_s, edge.lost), (Some(30.0), Some(3000.0), 3), "{edge:?}");
        let anew = stages(&entries, Some(&now), &before)[1].edges[0].clone();
        assert_eq!((anew.rate_hz, anew.bytes_s), (None, None), "counters that fell are those of another life");
        let text = as_text("car1", &stages(&entries, Some(&before), &now), &now).to_string();
        assert!(text.contains("in <- world/out") && text.contains("30.0") && text.contains("3.0 kB/s"), "{text}");
    }
}
