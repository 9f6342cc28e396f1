//! Who connects to whom: processes that share an edge, directly. Pure.

use crate::graph::Graph;

/// To whom `process` connects. Of two processes that share an edge, the one that comes later in the graph connects to the
/// earlier one, so that there is one link, not two.
pub fn to_connect(graph: &Graph, process: &str) -> Vec<String> {
    let order = graph.processes();
    let rank = |name: &str| order.iter().position(|other| *other == name);
    let own_rank = rank(process);
    let mut found: Vec<String> = Vec::new();
    let process_of = |node: &str| graph.node(node).map(|node| node.process.as_str());
    for node in &graph.nodes {
        for edge in &node.inputs {
            let Some(writer) = process_of(&edge.from.node) else { continue };
            let other = match (writer == process, node.process == process) {
                (true, false) => node.process.as_str(),
                (false, true) => writer,
                _ => continue,
            };
            if rank(other) < own_rank && !found.iter().any(|name| name == other) {
                found.push(other.to_owned());
            }
        }
    }
    found
}
