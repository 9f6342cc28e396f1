//! The quickest way of a sample through the graph, and the age that it reaches on it at worst.
//!
//! Each hop costs the writer's modelled latency and the edge's delay. A reader that is not triggered by the hop, or that also has a
//! period, reads a sample again until the next one comes: then the sensor's interval counts, once. A reader that is not triggered
//! waits for its own period besides.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

use super::timing::interval;
use crate::graph::draft::{Draft, DraftEdge, DraftNode, show};

/// Where a way ends.
#[derive(Clone, Copy)]
pub(super) enum End<'a> {
    /// At this input of a node.
    Input(usize, &'a str),
    /// At an output of a node.
    Output(usize),
}

/// The age that samples reach on the quickest way.
pub(super) struct Way {
    pub(super) age: Duration,
    /// What it is the sum of, for people.
    pub(super) terms: Vec<String>,
}

/// How a node is reached: with which age, from which node, and by which of its edges. `None`: it is where the way begins.
#[derive(Clone, Copy)]
struct Arrival {
    age: Duration,
    hop: Option<Hop>,
}

#[derive(Clone, Copy)]
struct Hop {
    writer: usize,
    /// A node up to the writer holds samples.
    held: bool,
    reader: usize,
    edge: usize,
}

struct Search<'a> {
    draft: &'a Draft<'a>,
    source: usize,
    from: &'a str,
    end: End<'a>,
    sensor_interval: Duration,
    /// For each node its readers, with the index of their edge.
    readers: Vec<Vec<(usize, usize)>>,
    /// The best arrival at each node: nobody on the way holds samples, and somebody does.
    best: Vec<[Option<Arrival>; 2]>,
    at_end: Option<Arrival>,
}

/// The quickest way from the output `from` of node `source` to `end`; `None`: there is none.
pub(super) fn quickest_way(draft: &Draft<'_>, source: usize, from: &str, end: End<'_>) -> Option<Way> {
    let mut search = Search {
        draft,
        source,
        from,
        end,
        sensor_interval: interval(draft, source, 0).unwrap_or_default(),
        readers: readers(draft),
        best: vec![[None; 2]; draft.nodes.len()],
        at_end: None,
    };
    search.run();
    let last = search.at_end?;
    Some(Way { age: last.age, terms: search.terms(last) })
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

/// Whether the reader of an edge reads samples again after they came.
fn holds(reader: &DraftNode<'_>, edge: &DraftEdge<'_>) -> bool {
    !reader.triggers(edge) || reader.period.is_some()
}

/// How long a sample waits for a reader that it does not trigger.
fn wait(reader: &DraftNode<'_>, edge: &DraftEdge<'_>) -> Duration {
    if reader.triggers(edge) { Duration::ZERO } else { reader.period.unwrap_or_default() }
}

impl Search<'_> {
    /// Dijkstra's algorithm; the index of the node decides between equal ages.
    fn run(&mut self) {
        self.best[self.source][0] = Some(Arrival { age: Duration::ZERO, hop: None });
        let mut queue = BinaryHeap::from([Reverse((Duration::ZERO, self.source, false))]);
        while let Some(Reverse((age, node, held))) = queue.pop() {
            let Some(arrival) = self.best[node][usize::from(held)].filter(|best| best.age >= age) else { continue };
            if matches!(self.end, End::Output(last) if last == node) {
                self.arrive_at_end(Arrival { age: age + self.draft.nodes[node].latency(), hop: arrival.hop });
            }
            for index in 0..self.readers[node].len() {
                let (reader, edge) = self.readers[node][index];
                if arrival.hop.is_none() && self.draft.nodes[reader].edges[edge].from != Some(self.from) {
                    continue;
                }
                queue.extend(self.follow(age, Hop { writer: node, held, reader, edge }).map(Reverse));
            }
        }
    }

    /// Goes on to a reader. Gives what is to be looked at next, if this is the best way to it so far.
    fn follow(&mut self, age: Duration, hop: Hop) -> Option<(Duration, usize, bool)> {
        let (writer, reader) = (&self.draft.nodes[hop.writer], &self.draft.nodes[hop.reader]);
        let edge = &reader.edges[hop.edge];
        let mut age = age + writer.latency() + edge.delay().unwrap_or_default() + wait(reader, edge);
        if holds(reader, edge) && !hop.held {
            age += self.sensor_interval;
        }
        let held = hop.held || holds(reader, edge);
        let arrival = Arrival { age, hop: Some(hop) };
        if matches!(self.end, End::Input(node, port) if node == hop.reader && port == edge.input) {
            self.arrive_at_end(arrival);
        }
        let best = &mut self.best[hop.reader][usize::from(held)];
        if best.is_some_and(|best| best.age <= age) {
            return None;
        }
        *best = Some(arrival);
        Some((age, hop.reader, held))
    }

    fn arrive_at_end(&mut self, arrival: Arrival) {
        if self.at_end.is_none_or(|best| arrival.age < best.age) {
            self.at_end = Some(arrival);
        }
    }

    /// The hops that led to an arrival, in their order.
    fn hops(&self, last: Arrival) -> Vec<Hop> {
        let mut hops: Vec<Hop> =
            std::iter::successors(last.hop, |hop| self.best[hop.writer][usize::from(hop.held)]?.hop).collect();
        hops.reverse();
        hops
    }

    fn terms(&self, last: Arrival) -> Vec<String> {
        let mut terms = Vec::new();
        let mut add = |duration: Duration, what: String| {
            if !duration.is_zero() {
                terms.push(format!("{} ({what})", show(duration)));
            }
        };
        for hop in self.hops(last) {
            let (writer, reader) = (&self.draft.nodes[hop.writer], &self.draft.nodes[hop.reader]);
            let edge = &reader.edges[hop.edge];
            add(writer.latency(), format!("latency of `{}`", writer.name));
            add(edge.delay().unwrap_or_default(), format!("delay into `{}/{}`", reader.name, edge.input));
            if holds(reader, edge) && !hop.held {
                add(self.sensor_interval, format!("period of `{}`", self.draft.nodes[self.source].name));
            }
            add(wait(reader, edge), format!("period of `{}`", reader.name));
        }
        if let End::Output(node) = self.end {
            add(self.draft.nodes[node].latency(), format!("latency of `{}`", self.draft.nodes[node].name));
        }
        terms
    }
}
