//! A checked graph as a picture (Mermaid, Graphviz) or as JSON.

use std::fmt::Write;
use std::time::Duration;

use carril_messages::MessageType;
use serde_json::{Value, json};

use super::{Edge, Graph, GraphNode, OnOverrun, RestartPolicy};

/// As a Mermaid flowchart: processes as subgraphs, edges with port and type, budgets dashed.
pub fn to_mermaid(graph: &Graph) -> String {
    let mut text = format!("---\ntitle: {}\n---\nflowchart LR\n", graph.robot);
    let id = |name: &str| graph.nodes.iter().position(|node| node.name == name).unwrap_or_default();
    let node_line = |node: &GraphNode| format!("n{}[\"{}\"]\n", id(&node.name), node_text(node).join("<br/>"));
    for process in graph.processes() {
        let nodes: Vec<_> = graph.nodes.iter().filter(|node| node.process == process).collect();
        if is_shown(process, &nodes) {
            let _ = writeln!(text, "  subgraph p{}[\"process {process}\"]", id(&nodes[0].name));
            text.extend(nodes.iter().flat_map(|node| ["    ".to_owned(), node_line(node)]));
            text += "  end\n";
        } else {
            text.extend(nodes.iter().flat_map(|node| ["  ".to_owned(), node_line(node)]));
        }
    }
    for (node, edge) in edges(graph) {
        let label = edge_label(graph, node, edge).join("<br/>");
        let _ = writeln!(text, "  n{} -->|\"{label}\"| n{}", id(&edge.from.node), id(&node.name));
    }
    for budget in &graph.budgets {
        let (from, to) = (id(&budget.from.node), id(&budget.to.node));
        let _ = writeln!(text, "  n{from} -.->|\"{}\"| n{to}", budget_label(budget).join("<br/>"));
    }
    text
}

/// As a Graphviz graph: processes as clusters, edges with port and type, budgets dashed.
pub fn to_dot(graph: &Graph) -> String {
    let mut text = format!("digraph \"{}\" {{\n  rankdir=LR;\n  node [shape=box];\n", graph.robot);
    let node_line = |node: &GraphNode| {
        let text: Vec<String> = node_text(node).iter().map(|line| escape(line)).collect();
        format!("\"{}\" [label=\"{}\"];\n", node.name, text.join("\\n"))
    };
    for process in graph.processes() {
        let nodes: Vec<_> = graph.nodes.iter().filter(|node| node.process == process).collect();
        if is_shown(process, &nodes) {
            let _ = writeln!(text, "  subgraph \"cluster_{process}\" {{\n    label=\"process {process}\";");
            text.extend(nodes.iter().flat_map(|node| ["    ".to_owned(), node_line(node)]));
            text += "  }\n";
        } else {
            text.extend(nodes.iter().flat_map(|node| ["  ".to_owned(), node_line(node)]));
        }
    }
    for (node, edge) in edges(graph) {
        let label = edge_label(graph, node, edge).join("\\n");
        let _ = writeln!(text, "  \"{}\" -> \"{}\" [label=\"{label}\"];", edge.from.node, node.name);
    }
    for budget in &graph.budgets {
        let (from, to, label) = (&budget.from.node, &budget.to.node, budget_label(budget).join("\\n"));
        let _ = writeln!(text, "  \"{from}\" -> \"{to}\" [label=\"{label}\", style=dashed, constraint=false];");
    }
    text + "}\n"
}

/// As JSON, with everything that the file says and the defaults that it does not.
pub fn to_json(graph: &Graph) -> Value {
    let edges: Vec<Value> = edges(graph).map(|(node, edge)| edge_json(graph, node, edge)).collect();
    let budgets: Vec<Value> = graph
        .budgets
        .iter()
        .map(|budget| {
            json!({
                "from": budget.from.to_string(), "to": budget.to.to_string(), "max_age_ms": in_ms(budget.max_age),
                "on_violation": if budget.stops { "stop" } else { "warn" },
            })
        })
        .collect();
    let nodes: Vec<Value> = graph.nodes.iter().map(node_json).collect();
    json!({ "robot": graph.robot, "nodes": nodes, "edges": edges, "budgets": budgets })
}

/// A process is drawn when it says more than its only node.
fn is_shown(process: &str, nodes: &[&GraphNode]) -> bool {
    nodes.len() > 1 || nodes.iter().any(|node| node.name != process)
}

fn edges(graph: &Graph) -> impl Iterator<Item = (&GraphNode, &Edge)> {
    graph.nodes.iter().flat_map(|node| node.inputs.iter().map(move |edge| (node, edge)))
}

/// Name, what runs in it, and where, if that is not the car.
fn node_text(node: &GraphNode) -> Vec<String> {
    let body = Some(body_text(node)).filter(|text| !text.is_empty());
    let machine = node.machine.as_ref().map(|machine| format!("on {machine}"));
    [node.name.clone()].into_iter().chain(body).chain(machine).collect()
}

fn body_text(node: &GraphNode) -> String {
    node.exec()
        .map(|path| path.display().to_string())
        .or_else(|| node.kind().map(|kind| kind.name.to_owned()))
        .unwrap_or_default()
}

fn escape(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"")
}

/// Type of an edge, from whichever end tells its ports.
fn edge_type(graph: &Graph, node: &GraphNode, edge: &Edge) -> Option<MessageType> {
    let writer = graph.node(&edge.from.node).and_then(GraphNode::kind);
    let output = writer.and_then(|kind| kind.outputs.iter().find(|port| port.name == edge.from.port));
    let input = node.kind().and_then(|kind| kind.inputs.iter().find(|port| port.name == edge.input));
    output.map(|port| port.message_type.clone()).or_else(|| input.map(|port| port.message_type.clone()))
}

fn edge_label(graph: &Graph, node: &GraphNode, edge: &Edge) -> Vec<String> {
    let ports =
        if edge.from.port == edge.input { edge.input.clone() } else { format!("{} to {}", edge.from.port, edge.input) };
    let mut label = vec![ports];
    label.extend(edge_type(graph, node, edge).map(|message_type| message_type.name.into_owned()));
    if edge.queue.capacity > 1 {
        label.push(format!("queue {}", edge.queue.capacity));
    }
    label.extend(edge.max_age.map(|max_age| format!("at most {} ms old", in_ms(max_age))));
    label.extend(edge.delay.map(|delay| format!("delay {} ms", in_ms(delay))));
    label.extend(edge.reliable.then(|| "reliable".to_owned()));
    label
}

fn budget_label(budget: &super::Budget) -> Vec<String> {
    let action = if budget.stops { "else stop" } else { "else warn" };
    vec![
        format!("{} to {}", budget.from.port, budget.to.port),
        format!("within {} ms, {action}", in_ms(budget.max_age)),
    ]
}

fn edge_json(graph: &Graph, node: &GraphNode, edge: &Edge) -> Value {
    json!({
        "from": edge.from.to_string(), "to": format!("{}/{}", node.name, edge.input),
        "type": edge_type(graph, node, edge).map(|message_type| message_type.to_string()),
        "queue": edge.queue.capacity, "max_age_ms": edge.max_age.map(in_ms), "delay_ms": edge.delay.map(in_ms),
        "reliable": edge.reliable,
    })
}

fn node_json(node: &GraphNode) -> Value {
    let outputs = node.kind().map(|kind| &kind.outputs[..]).unwrap_or_default();
    let outputs: Vec<Value> =
        outputs.iter().map(|port| json!({ "port": port.name, "type": port.message_type.to_string() })).collect();
    let exec = node.exec().map(|path| path.display().to_string());
    let on_overrun = match node.on_overrun {
        OnOverrun::Warn => "warn",
        OnOverrun::Skip => "skip",
        OnOverrun::Stop => "stop",
    };
    let policy = match node.restart.policy {
        RestartPolicy::Never => "never",
        RestartPolicy::OnFailure => "on-failure",
        RestartPolicy::Always => "always",
    };
    json!({
        "name": node.name, "operator": node.kind().map(|kind| kind.name), "exec": exec, "config": node.config,
        "process": node.process, "machine": node.machine, "period_ms": node.period.map(in_ms), "deadline_ms": node.deadline.map(in_ms),
        "on_overrun": on_overrun, "priority": node.priority, "cpus": node.cpus, "lock_memory": node.lock_memory,
        "latency_ms": in_ms(node.modelled_latency), "outputs": outputs,
        "restart": { "policy": policy, "max": node.restart.max, "window_s": node.restart.window.as_secs_f64() },
    })
}

fn in_ms(duration: Duration) -> f64 {
    duration.as_nanos() as f64 / 1e6
}
