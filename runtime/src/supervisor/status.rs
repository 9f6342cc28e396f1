//! What the supervisor makes of the health of all nodes. Pure.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use carril_messages::{Health, NodeState, Stamp};

use crate::control_plane::{FaultReport, NodeEntry, Status};

/// A node that has not told its health for this long is stuck in a step, or its process is.
const SILENCE: Duration = Duration::from_secs(3);

/// The last that was heard of each node.
#[derive(Default)]
pub(super) struct Picture {
    nodes: Vec<Entry>,
    index: HashMap<String, usize>,
    pub fault: Option<FaultReport>,
}

struct Entry {
    process: String,
    health: Health,
    heard: Option<Instant>,
    /// The state that the supervisor sees where the node says another one, and since when.
    seen: Option<(NodeState, Stamp)>,
}

/// Where a process is, as far as its nodes are concerned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ProcessView {
    /// Overrides what the nodes last said; `None`: the process is up.
    pub state: Option<NodeState>,
    pub restarts: u32,
    pub ready_since: Option<Instant>,
}

impl Picture {
    /// The graph has these nodes from now on; what is known of those that stay is kept.
    pub(super) fn follow(&mut self, nodes: &[NodeEntry]) {
        let mut known = std::mem::take(&mut self.nodes);
        for node in nodes {
            let at = known.iter().position(|entry| entry.health.node == node.name);
            let mut entry = at.map_or_else(|| Entry::new(&node.name), |at| known.swap_remove(at));
            if entry.process != node.process {
                entry.process.clone_from(&node.process);
                entry.heard = None;
            }
            entry.health.process.clone_from(&node.process);
            entry.health.operator.clone_from(&node.operator);
            self.nodes.push(entry);
        }
        self.index = self.nodes.iter().enumerate().map(|(at, entry)| (entry.health.node.clone(), at)).collect();
    }

    /// A node told its health. One that is not in the graph is passed over.
    pub(super) fn hear(&mut self, health: Health, now: Instant) {
        if let Some(&at) = self.index.get(&health.node) {
            let entry = &mut self.nodes[at];
            if entry.process == health.process {
                entry.health = health;
                entry.heard = Some(now);
            }
        }
    }

    /// The status at `now`; `stamp` is the same time on the car's clock.
    pub(super) fn status(
        &mut self,
        uptime: Duration,
        (now, stamp): (Instant, Stamp),
        view: &dyn Fn(&str) -> ProcessView,
    ) -> Status {
        let nodes = self.nodes.iter_mut().map(|entry| entry.shown(now, stamp, view(&entry.process))).collect();
        Status { uptime_s: uptime.as_secs_f64(), nodes, fault: self.fault.clone() }
    }
}

impl Entry {
    fn new(node: &str) -> Self {
        let health = Health { node: node.to_owned(), ..Health::default() };
        Self { process: String::new(), health, heard: None, seen: None }
    }

    /// With the time since when it is in a state that it does not know itself.
    fn shown(&mut self, now: Instant, stamp: Stamp, process: ProcessView) -> Health {
        let mut health = self.at(now, process);
        self.seen = (health.state != self.health.state).then(|| {
            let same = self.seen.filter(|(state, _)| *state == health.state);
            same.unwrap_or((health.state, stamp))
        });
        if let Some((_, since)) = self.seen {
            health.since = since;
        }
        health
    }

    fn at(&self, now: Instant, process: ProcessView) -> Health {
        let mut health = self.health.clone();
        health.restarts += process.restarts;
        if let Some(state) = process.state {
            health.state = state;
            health.rate_hz = 0.0;
            health.pid = None;
            return health;
        }
        if self.heard.is_none() {
            // Ready means that its nodes are built and at work; their first health is on its way.
            health.state = NodeState::Running;
        }
        let since = self.heard.max(process.ready_since);
        let silent = since.map_or(Duration::ZERO, |since| now.duration_since(since));
        if silent >= SILENCE {
            health.state = NodeState::Faulted;
            health.rate_hz = 0.0;
            health.last_error = Some(format!("silent for {} s: a step does not end", silent.as_secs()));
        }
        health
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(heard: Option<Instant>) -> Entry {
        let health = Health { state: NodeState::Running, rate_hz: 30.0, restarts: 1, ..Health::default() };
        Entry { process: "lane".into(), health, heard, seen: None }
    }

    #[test]
    fn a_dead_process_overrides_what_its_nodes_said() {
        let now = Instant::now();
        let view = ProcessView { state: Some(NodeState::Restarting), restarts: 2, ready_since: None };
        let health = entry(Some(now)).at(now, view);
        assert_eq!((health.state, health.rate_hz), (NodeState::Restarting, 0.0), "it does nothing now");
        assert_eq!(health.restarts, 3, "restarts of the process and of the node in it");
    }

    #[test]
    fn a_state_that_the_supervisor_sees_began_when_it_first_saw_it() {
        let now = Instant::now();
        let down = ProcessView { state: Some(NodeState::Restarting), restarts: 1, ready_since: None };
        let (first, later) = (Stamp::from_nanos(5), Stamp::from_nanos(9));
        let mut entry = entry(Some(now));
        entry.health.since = Stamp::from_nanos(1);
        assert_eq!(entry.shown(now, first, down).since, first, "it went down just now");
        assert_eq!(entry.shown(now, later, down).since, first, "and still is");
        let up = ProcessView { state: None, restarts: 1, ready_since: Some(now) };
        assert_eq!(entry.shown(now, later, up).since, Stamp::from_nanos(1), "the node's own word");
    }

    #[test]
    fn a_silent_node_is_stuck() {
        let start = Instant::now();
        let now = start + SILENCE;
        let up = ProcessView { state: None, restarts: 0, ready_since: Some(now) };
        assert_eq!(entry(None).at(now, up).state, NodeState::Running, "it has just started");
        let early = ProcessView { ready_since: Some(start), ..up };
        let health = entry(Some(start)).at(now, early);
        assert_eq!(health.state, NodeState::Faulted, "nothing was heard for too long");
        assert!(health.last_error.is_some_and(|error| error.contains("silent")), "and it says so");
    }
}
