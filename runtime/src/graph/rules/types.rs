//! Both ends of an edge have the same message type.

use crate::graph::draft::{Draft, Report, Target};

pub(super) fn same_types(draft: &Draft<'_>, report: &mut Report<'_>) {
    for node in &draft.nodes {
        for edge in &node.edges {
            let (Some(from), Some(input)) = (edge.from, node.input_spec(edge.input)) else { continue };
            let Target::Output(_, output) = draft.output(from) else { continue };
            if output.message_type == input.message_type {
                continue;
            }
            let message = format!(
                "node `{}`: input `{}` takes `{}`, but `{from}` gives `{}`",
                node.name, edge.input, input.message_type, output.message_type
            );
            let fits = draft.nodes.iter().flat_map(|other| {
                let outputs = other.kind().map(|kind| kind.outputs.clone()).unwrap_or_default();
                let outputs = outputs.into_iter().filter(|port| port.message_type == input.message_type);
                outputs.map(move |port| format!("`{}/{}`", other.name, port.name))
            });
            let fits: Vec<_> = fits.take(6).collect();
            let hint = match fits.len() {
                0 => format!("no node gives `{}`", input.message_type),
                _ => format!("`{}` comes from {}", input.message_type, fits.join(", ")),
            };
            let path = ["nodes", node.name, "inputs", edge.input, "from"];
            report.error(draft.at(&path), "type-mismatch", message, Some(hint));
        }
    }
}
