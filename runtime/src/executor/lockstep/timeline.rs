//! What happens when, in virtual time: events in the order of their time, and of their insertion within one time.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

use carril_messages::{Control, Stamp};

use crate::node::Published;
use crate::ports::Incoming;

/// Something that happens at a later time.
pub(super) enum Event {
    /// A node's period has come.
    Period(usize),
    /// A node's modelled computing has ended.
    Free(usize),
    /// A sample leaves its node.
    Publish(usize, Published),
    /// A sample arrives at the input of a node.
    Deliver { node: usize, input: usize, incoming: Incoming },
    /// A word from a person to all nodes.
    Control(Control),
}

struct Entry {
    at: Stamp,
    order: u64,
    event: Event,
}

/// The events that are still to come.
#[derive(Default)]
pub(super) struct Timeline {
    heap: BinaryHeap<Reverse<Entry>>,
    next_order: u64,
}

impl Timeline {
    pub(super) fn insert(&mut self, at: Stamp, event: Event) {
        let order = self.next_order;
        self.next_order += 1;
        self.heap.push(Reverse(Entry { at, order, event }));
    }

    /// Time of the next event.
    pub(super) fn next_at(&self) -> Option<Stamp> {
        self.heap.peek().map(|Reverse(entry)| entry.at)
    }

    pub(super) fn pop(&mut self) -> Option<(Stamp, Event)> {
        self.heap.pop().map(|Reverse(entry)| (entry.at, entry.event))
    }
}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Entry {}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        (self.at, self.order).cmp(&(other.at, other.order))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_by_time_then_by_insertion() {
        let mut timeline = Timeline::default();
        for (at, node) in [(5, 0), (3, 1), (5, 2), (3, 3)] {
            timeline.insert(Stamp::from_nanos(at), Event::Free(node));
        }
        let order: Vec<_> = std::iter::from_fn(|| timeline.pop())
            .map(|(at, event)| match event {
                Event::Free(node) => (at.as_nanos(), node),
                _ => unreachable!("only these were inserted"),
            })
            .collect();
        assert_eq!(order, [(3, 1), (3, 3), (5, 0), (5, 2)], "time first, then insertion");
    }
}
