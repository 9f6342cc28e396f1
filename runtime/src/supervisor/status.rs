//! What the supervisor makes of the health of all nodes. Pure.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use carril_messages::{Health, NodeState, Stamp};

use crate::control_plane::{FaultReport, MachineStatus, NodeEntry, Status};

/// A node that has not told its health for this long is stuck in a step, or its process is.
const SILENCE: Duration = Duration::from_secs(3);

/// The last that was heard of each node.
#[derive(Default)]
pub(super) struct Picture {
    /// The machine that the run is on; `None`: the car. It knows of the nodes elsewhere, too, other machines know their own.
    machine: Option<String>,
    nodes: Vec<Entry>,
    index: HashMap<String, usize>,
    machines: Vec<Machine>,
    pub fault: Option<FaultReport>,
}

/// Another machine, and since when it has been there, or gone.
struct Machine {
    status: MachineStatus,
    since: Instant,
}

struct Entry {
    process: String,
    /// The other machine that runs it.
    elsewhere: Option<String>,
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
    /// One of the run on this machine.
    pub(super) fn on(machine: Option<&str>) -> Self {
        Self { machine: machine.map(str::to_owned), ..Self::default() }
    }

    /// The graph has these nodes from now on; what is known of those that stay is kept.
    pub(super) fn follow(&mut self, nodes: &[NodeEntry], stamp: Stamp) {
        let on_car = self.machine.is_none();
        let mut known = std::mem::take(&mut self.nodes);
        for node in nodes.iter().filter(|node| on_car || node.machine == self.machine) {
            let at = known.iter().position(|entry| entry.health.node == node.name);
            let mut entry = at.map_or_else(|| Entry::new(&node.name), |at| known.swap_remove(at));
            if entry.process != node.process {
                entry.process.clone_from(&node.process);
                entry.heard = None;
            }
            entry.elsewhere = node.machine.clone().filter(|_| on_car);
            entry.health.process.clone_from(&node.process);
            entry.health.operator.clone_from(&node.operator);
            self.nodes.push(entry);
        }
        self.index = self.nodes.iter().enumerate().map(|(at, entry)| (entry.health.node.clone(), at)).collect();
        self.follow_machines(stamp);
    }

    fn follow_machines(&mut self, stamp: Stamp) {
        let mut known = std::mem::take(&mut self.machines);
        for entry in &self.nodes {
            let Some(machine) = &entry.elsewhere else { continue };
            let node = entry.health.node.clone();
            if let Some(listed) = self.machines.iter_mut().find(|listed| listed.status.machine == *machine) {
                listed.status.nodes.push(node);
                continue;
            }
            let at = known.iter().position(|before| before.status.machine == *machine);
            let fresh = || Machine {
                status: MachineStatus { machine: machine.clone(), joined: false, since: stamp, nodes: Vec::new() },
                since: Instant::now(),
            };
            let mut listed = at.map_or_else(fresh, |at| known.swap_remove(at));
            listed.status.nodes = vec![node];
            self.machines.push(listed);
        }
    }

    /// These machines have joined, no others. Those for which that is news.
    pub(super) fn joined(&mut self, joined: &[String], (now, stamp): (Instant, Stamp)) -> Vec<MachineStatus> {
        let mut news = Vec::new();
        for Machine { status, since } in &mut self.machines {
            let here = joined.contains(&status.machine);
            if here != status.joined {
                (status.joined, status.since, *since) = (here, stamp, now);
                news.push(status.clone());
            }
        }
        news
    }

    /// How a node elsewhere is seen from here: like one of a process that is up while its machine is there.
    fn far_view(machines: &[Machine], name: &str) -> ProcessView {
        let machine = machines.iter().find(|machine| machine.status.machine == name && machine.status.joined);
        let state = if machine.is_some() { None } else { Some(NodeState::Away) };
        ProcessView { state, restarts: 0, ready_since: machine.map(|machine| machine.since) }
    }

    /// A node told its health. One that is not in the graph is passed over.
    pub(super) fn hear(&mut self, health: Health, now: Instant) {
        if let Some(&at) = self.index.get(&health.node) {
            let entry = &mut self.nodes[at];
            // Where its processes are, another machine knows best.
            if entry.process == health.process || entry.elsewhere.is_some() {
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
        let machines = &self.machines;
        let shown = |entry: &mut Entry| {
            let process = match &entry.elsewhere {
                Some(machine) => Self::far_view(machines, machine),
                None => view(&entry.process),
            };
            entry.shown(now, stamp, process)
        };
        let nodes = self.nodes.iter_mut().map(shown).collect();
        let machines = self.machines.iter().map(|machine| machine.status.clone()).collect();
        Status { uptime_s: uptime.as_secs_f64(), nodes, fault: self.fault.clone(), machines }
    }
}

impl Entry {
    fn new(node: &str) -> Self {
        let health = Health { node: node.to_owned(), ..Health::default() };
        Self { process: String::new(), elsewhere: None, health, heard: None, seen: None }
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
        Entry { process: "lane".into(), elsewhere: None, health, heard, seen: None }
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

    fn node(name: &str, machine: Option<&str>) -> NodeEntry {
        NodeEntry {
            name: name.into(),
            operator: String::new(),
            exec: None,
            process: name.into(),
            machine: machine.map(str::to_owned),
            inputs: Vec::new(),
            outputs: Vec::new(),
        }
    }

    #[test]
    fn a_node_elsewhere_is_away_until_its_machine_joins_and_again_when_it_leaves() {
        let (now, stamp) = (Instant::now(), Stamp::from_nanos(5));
        let mut picture = Picture::on(None);
        picture.follow(&[node("world", None), node("lane", Some("laptop"))], stamp);
        let up = |_: &str| ProcessView { state: None, restarts: 0, ready_since: Some(now) };
        let states = |picture: &mut Picture| {
            let status = picture.status(Duration::ZERO, (now, stamp), &up);
            status.nodes.iter().map(|node| node.state).collect::<Vec<_>>()
        };
        assert_eq!(states(&mut picture), [NodeState::Running, NodeState::Away], "nobody has joined");
        let joined = picture.joined(&["laptop".into(), "stranger".into()], (now, stamp));
        assert_eq!((joined.len(), joined[0].joined, &joined[0].nodes[..]), (1, true, &["lane".to_owned()][..]), "news");
        let health =
            Health { node: "lane".into(), process: "lane.2".into(), state: NodeState::Faulted, ..Health::default() };
        picture.hear(health, now);
        assert_eq!(
            states(&mut picture),
            [NodeState::Running, NodeState::Faulted],
            "its own word, whatever its process"
        );
        assert!(picture.joined(&["laptop".into()], (now, stamp)).is_empty(), "no news");
        assert!(!picture.joined(&[], (now, stamp))[0].joined, "it has left");
        assert_eq!(states(&mut picture)[1], NodeState::Away, "and its node with it");
    }

    #[test]
    fn another_machine_knows_only_its_own_nodes() {
        let (now, stamp) = (Instant::now(), Stamp::from_nanos(5));
        let mut picture = Picture::on(Some("laptop"));
        picture.follow(&[node("world", None), node("lane", Some("laptop"))], stamp);
        let up = |_: &str| ProcessView { state: None, restarts: 0, ready_since: Some(now) };
        let status = picture.status(Duration::ZERO, (now, stamp), &up);
        assert_eq!(
            (status.nodes.len(), status.nodes[0].state),
            (1, NodeState::Running),
            "the car's are the car's affair"
        );
        assert!(status.machines.is_empty(), "and so are other machines");
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
