//! The newest message of a type in a lockstep drive.

use std::sync::Arc;

use carril_messages::Message;
use carril_runtime::executor::lockstep::Lockstep;
use carril_runtime::graph::Graph;

/// The newest message of a type, from whichever node gives it.
pub fn newest<T: Message>(lockstep: &Lockstep, graph: &Graph) -> Option<Arc<T>> {
    let (node, port) = source::<T>(graph)?;
    lockstep.last::<T>(node, port)
}

/// The first node, and its output, that gives messages of a type.
pub fn source<T: Message>(graph: &Graph) -> Option<(&str, &str)> {
    graph.nodes.iter().find_map(|node| {
        let port = node.kind()?.outputs.iter().find(|port| port.message_type == T::TYPE)?;
        Some((node.name.as_str(), port.name))
    })
}
