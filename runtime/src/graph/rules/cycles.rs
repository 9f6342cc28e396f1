//! Every cycle has an edge with a declared delay; without one, its nodes would wait for each other within one moment.

use std::collections::{HashMap, VecDeque};

use crate::graph::draft::{Draft, Report};

/// Edges without a delay: for each node its readers, each with the name of the input.
struct Undelayed<'a>(Vec<Vec<(usize, &'a str)>>);

pub(super) fn cycles_have_a_delay(draft: &Draft<'_>, report: &mut Report<'_>) {
    let graph = Undelayed::new(draft);
    let mut reported = vec![false; draft.nodes.len()];
    for start in graph.on_or_between_cycles() {
        if reported[start] {
            continue;
        }
        let Some(cycle) = graph.shortest_cycle(start) else { continue };
        for &(node, _) in &cycle {
            reported[node] = true;
        }
        report_cycle(draft, start, &cycle, report);
    }
}

/// Longer cycles are cut in the middle.
const MAX_SHOWN: usize = 16;

/// `cycle` lists each node that the way from `start` reaches, with the input by which it does; the last is `start` itself.
fn report_cycle(draft: &Draft<'_>, start: usize, cycle: &[(usize, &str)], report: &mut Report<'_>) {
    let way = std::iter::once(start).chain(cycle.iter().map(|&(node, _)| node));
    let mut names: Vec<_> = way.map(|node| format!("`{}`", draft.nodes[node].name)).collect();
    if names.len() > MAX_SHOWN {
        names.splice(MAX_SHOWN - 2..names.len() - 1, ["...".to_owned()]);
    }
    let way = names.join(" -> ");
    let (node, input) = cycle[cycle.len() - 1];
    let node = &draft.nodes[node];
    let from = node.edges.iter().find(|edge| edge.input == input).and_then(|edge| edge.from).unwrap_or("node/port");
    let message = format!("the cycle {way} has no edge with a declared delay");
    let hint = format!("for example here: `{input}: {{ from: {from}, delay_ms: 5 }}`");
    report.error(draft.key_at(&["nodes", node.name, "inputs", input]), "cycle-without-delay", message, Some(hint));
}

impl<'a> Undelayed<'a> {
    fn new(draft: &'a Draft<'_>) -> Self {
        let mut readers = vec![Vec::new(); draft.nodes.len()];
        for (reader, node) in draft.nodes.iter().enumerate() {
            for edge in node.edges.iter().filter(|edge| edge.delay().is_none_or(|delay| delay.is_zero())) {
                if let Some(source) = draft.source(edge) {
                    readers[source].push((reader, edge.input));
                }
            }
        }
        Self(readers)
    }

    /// Leaves out, again and again, nodes that nothing flows into: what remains lies on a cycle or behind one.
    fn on_or_between_cycles(&self) -> Vec<usize> {
        let mut writers = vec![0_usize; self.0.len()];
        self.0.iter().flatten().for_each(|&(reader, _)| writers[reader] += 1);
        let mut free: Vec<usize> = (0..self.0.len()).filter(|&node| writers[node] == 0).collect();
        while let Some(node) = free.pop() {
            for &(reader, _) in &self.0[node] {
                writers[reader] -= 1;
                if writers[reader] == 0 {
                    free.push(reader);
                }
            }
        }
        (0..self.0.len()).filter(|&node| writers[node] > 0).collect()
    }

    /// Breadth first from `start` back to it.
    fn shortest_cycle(&self, start: usize) -> Option<Vec<(usize, &'a str)>> {
        let mut came_from: HashMap<usize, (usize, &str)> = HashMap::new();
        let mut queue = VecDeque::from([start]);
        while let Some(node) = queue.pop_front() {
            for &(reader, input) in &self.0[node] {
                if reader == start {
                    return Some(trace(&came_from, start, node, input));
                }
                came_from.entry(reader).or_insert_with(|| {
                    queue.push_back(reader);
                    (node, input)
                });
            }
        }
        None
    }
}

fn trace<'a>(
    came_from: &HashMap<usize, (usize, &'a str)>,
    start: usize,
    last: usize,
    input: &'a str,
) -> Vec<(usize, &'a str)> {
    let mut cycle = vec![(start, input)];
    let mut node = last;
    while node != start {
        let (previous, input) = came_from[&node];
        cycle.push((node, input));
        node = previous;
    }
    cycle.reverse();
    cycle
}
