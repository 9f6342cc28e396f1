//! Puts the nodes of a process together: who shares a thread with whom, which edges stay inside, and which come from elsewhere.

use std::cell::{Cell, RefCell};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use carril_messages::{Key, MessageType, Stamp};

use super::group::Group;
use super::role::Gate;
use super::router::{LocalReader, Router};
use super::slot::{OutputPort, Recipe, Slot, Surroundings};
use super::{Environment, Events, StartError};
use crate::backoff::Restarts;
use crate::executor::build::{BuildError, node_of};
use crate::graph::{Edge, Graph, GraphNode, NodeBody, PortRef};
use crate::mailbox::Mailbox;
use crate::node::{Node, NodeInput};
use crate::ports::Incoming;
use crate::positions::Positions;
use crate::registry::{ErasedOperator, vacant};
use crate::setup::{Setup, Waker};
use crate::transport::{Guard, Sink, expect_type};

/// The nodes in their groups, and their seats.
pub(super) struct Wired {
    pub groups: Vec<Arc<Group>>,
    pub seats: Vec<Seat>,
}

/// An instance of a node in its place.
pub(super) struct Seat {
    pub node: String,
    /// Tells the instances of a node apart; 0: the first of this process.
    pub number: u32,
    pub group: Arc<Group>,
    pub index: usize,
    ports: Vec<InputPort>,
    edges: Vec<Edge>,
    pub gate: Gate,
    /// Its subscriptions, and its places in the router.
    pub guards: Vec<Guard>,
    /// Edges that come from outside, by input.
    subscribed: Vec<String>,
    /// What was sent before this instance began to listen, by input.
    pub expected_before: Vec<(String, Positions)>,
}

struct InputPort {
    name: &'static str,
    message_type: MessageType,
    triggers: bool,
    external: bool,
    mailbox: Arc<Mailbox>,
}

/// What the nodes of a process share.
pub(super) struct Common<'a> {
    pub environment: &'a Environment,
    pub events: &'a Events,
    pub router: &'a Router,
    pub alone: &'a Arc<AtomicBool>,
}

/// Builds the nodes that a process begins with, in the order of the graph.
pub(super) fn build(graph: &Graph, nodes: &[&GraphNode], common: &Common<'_>) -> Result<Wired, StartError> {
    let groups = group(nodes);
    let local: Vec<&str> = nodes.iter().map(|node| node.name.as_str()).collect();
    let mut seats = Vec::new();
    for (group, members) in &groups {
        let mut slots = Vec::new();
        for (index, node) in members.iter().enumerate() {
            let recipe = recipe(graph, node, common.environment, group, index)?;
            let operator = build_operator(&recipe, node)?;
            let (seat, slot) = seat(graph, node, (recipe, operator), (group, index), &local, common)?;
            seats.push(seat);
            slots.push(slot);
        }
        group.fill(slots, surroundings(common));
    }
    Ok(Wired { groups: groups.into_iter().map(|(group, _)| group).collect(), seats })
}

/// Builds an instance that is to become a node, with a thread of its own. `vacant`: its operator is built when it takes over.
pub(super) fn build_candidate(
    graph: &Graph,
    node: &GraphNode,
    local: &[&str],
    vacant_now: bool,
    common: &Common<'_>,
    prepare: impl FnOnce(&mut Slot) -> Result<(), StartError>,
) -> Result<Seat, StartError> {
    let group = Group::new(vec![node.name.clone()], Some((node.priority, node.cpus.clone())));
    let recipe = recipe(graph, node, common.environment, &group, 0)?;
    let operator = if vacant_now { vacant() } else { build_operator(&recipe, node)? };
    let (seat, mut slot) = seat(graph, node, (recipe, operator), (&group, 0), local, common)?;
    slot.vacant = vacant_now;
    prepare(&mut slot)?;
    group.fill(vec![slot], surroundings(common));
    Ok(seat)
}

fn surroundings(common: &Common<'_>) -> Surroundings {
    Surroundings {
        clock: Arc::clone(&common.environment.clock),
        buffers: common.environment.transport.buffers(),
        events: common.events.clone(),
        alone: Arc::clone(common.alone),
    }
}

/// Nodes with a priority or cores of their own get a thread of their own; the others share one.
fn group<'a>(nodes: &[&'a GraphNode]) -> Vec<(Arc<Group>, Vec<&'a GraphNode>)> {
    let (special, shared): (Vec<&GraphNode>, Vec<&GraphNode>) =
        nodes.iter().partition(|node| node.priority.is_some() || !node.cpus.is_empty());
    let names = |nodes: &[&GraphNode]| nodes.iter().map(|node| node.name.clone()).collect();
    let mut groups = Vec::new();
    if !shared.is_empty() {
        groups.push((Group::new(names(&shared), None), shared));
    }
    for node in special {
        groups.push((Group::new(names(&[node]), Some((node.priority, node.cpus.clone()))), vec![node]));
    }
    groups
}

fn recipe(
    graph: &Graph,
    node: &GraphNode,
    environment: &Environment,
    group: &Arc<Group>,
    index: usize,
) -> Result<Recipe, StartError> {
    let NodeBody::Operator(kind) = &node.body else {
        return Err(BuildError::Exec { node: node.name.clone() }.into());
    };
    // Weak: an operator holds its waker, and the group holds the operator.
    let group = Arc::downgrade(group);
    let setup = Setup {
        robot: graph.robot.clone(),
        node: node.name.clone(),
        base_dir: graph.base_dir.clone(),
        run_dir: environment.run_dir.clone(),
        seed: environment.seed,
        waker: Waker::new(move || {
            if let Some(group) = group.upgrade() {
                group.wake(index);
            }
        }),
        clock: Arc::clone(&environment.clock),
        buffers: environment.transport.buffers(),
        memory_lines: None,
    };
    Ok(Recipe { kind: Arc::clone(kind), config: node.config.clone(), setup })
}

fn build_operator(recipe: &Recipe, node: &GraphNode) -> Result<Box<dyn ErasedOperator>, StartError> {
    let operator = recipe.kind.name;
    Ok(recipe.build().map_err(|source| BuildError::Setup { node: node.name.clone(), operator, source })?)
}

fn seat(
    graph: &Graph,
    node: &GraphNode,
    (recipe, operator): (Recipe, Box<dyn ErasedOperator>),
    (group, index): (&Arc<Group>, usize),
    local: &[&str],
    common: &Common<'_>,
) -> Result<(Seat, Slot), StartError> {
    let epoch = common.environment.clock.now().as_nanos() as u64;
    let built = node_of(node, graph, &recipe.kind, operator, epoch);
    let port = |(input, mailbox): (&NodeInput, &Arc<Mailbox>)| InputPort {
        name: input.spec.name,
        message_type: input.spec.message_type.clone(),
        triggers: input.spec.triggers,
        external: input.spec.external,
        mailbox: Arc::clone(mailbox),
    };
    let ports = built.inputs().iter().zip(built.mailboxes()).map(port).collect();
    let outputs = outputs(graph, &built, group, local, common)?;
    let timing = (node.period, node.on_overrun);
    let slot = Slot::new(built, outputs, timing, recipe, Restarts::new(node.restart));
    let seat = Seat {
        node: node.name.clone(),
        number: 0,
        group: Arc::clone(group),
        index,
        ports,
        edges: node.inputs.clone(),
        gate: slot.gate.clone(),
        guards: Vec::new(),
        subscribed: Vec::new(),
        expected_before: Vec::new(),
    };
    Ok((seat, slot))
}

fn outputs(
    graph: &Graph,
    node: &Node,
    group: &Arc<Group>,
    local: &[&str],
    common: &Common<'_>,
) -> Result<Vec<OutputPort>, StartError> {
    let mut ports = Vec::new();
    for spec in node.outputs() {
        let own = PortRef { node: node.name().to_owned(), port: spec.name.to_owned() };
        let edges = graph.nodes.iter().flat_map(|reader| reader.inputs.iter().map(move |edge| (reader, edge)));
        let reliable = edges
            .filter(|(reader, edge)| edge.from == own && !local.contains(&reader.name.as_str()))
            .any(|(_, edge)| edge.reliable);
        let key = Key::new(&graph.robot, node.name(), spec.name);
        let publisher = common.environment.transport.publish_on(&key, reliable);
        let publisher = publisher.map_err(|reason| StartError::Transport { node: node.name().to_owned(), reason })?;
        let readers = common.router.readers(&own.to_string());
        let group = Arc::downgrade(group);
        let (port, name) = (spec.name, own.to_string());
        ports.push(OutputPort {
            port,
            name,
            readers,
            group,
            publisher,
            reliable,
            complained: false.into(),
            came_out: RefCell::default(),
            bytes: Cell::new(0),
        });
    }
    Ok(ports)
}

/// Takes samples from the transport into a mailbox.
struct Inlet {
    mailbox: Arc<Mailbox>,
    message_type: MessageType,
    triggers: bool,
    group: Arc<Group>,
    index: usize,
}

impl Sink for Inlet {
    fn deliver(&self, incoming: Incoming) {
        // Before the mailbox: a foreign sample must not push a good one out.
        if let Err(refusal) = expect_type(incoming.header(), &self.message_type) {
            self.mailbox.refuse(refusal.to_string());
            return;
        }
        self.mailbox.push(incoming);
        if self.triggers {
            self.group.input_from_outside(self.index);
        }
    }

    fn refuse(&self, reason: String) {
        self.mailbox.refuse(reason);
    }
}

impl Seat {
    /// Notes what its writers had sent when it began to listen.
    pub(super) fn expect_before(&mut self, outputs: &[(String, Positions)]) {
        for edge in &self.edges {
            let sent = outputs.iter().find(|(output, _)| *output == edge.from.to_string());
            if let Some((_, positions)) = sent {
                self.expected_before.push((edge.input.clone(), positions.clone()));
            }
        }
    }

    /// Reads its inputs: from nodes of this process, and from elsewhere where the writer is not among `local`.
    pub(super) fn listen(&mut self, robot: &str, local: &[&str], common: &Common<'_>) -> Result<(), StartError> {
        for port in self.ports.iter().filter(|port| port.external) {
            let key = Key::new(robot, &self.node, port.name);
            let guard = self.subscribe(port, &key, false, common.environment)?;
            self.guards.push(guard);
        }
        for edge in self.edges.clone() {
            let Some(port) = self.ports.iter().find(|port| port.name == edge.input) else { continue };
            let (mailbox, group) = (Arc::clone(&port.mailbox), Arc::clone(&self.group));
            let reader = LocalReader { mailbox, triggers: port.triggers, group, index: self.index };
            let guard = common.router.add(&edge.from.to_string(), reader);
            self.guards.push(guard);
            if !local.contains(&edge.from.node.as_str()) {
                self.listen_outside(robot, &edge, common.environment)?;
            }
        }
        Ok(())
    }

    /// Reads the outputs of `writer` from elsewhere, too: it is about to leave this process.
    pub(super) fn listen_outside_to(
        &mut self,
        robot: &str,
        writer: &str,
        environment: &Environment,
    ) -> Result<(), StartError> {
        let edges: Vec<Edge> = self.edges.iter().filter(|edge| edge.from.node == writer).cloned().collect();
        edges.iter().try_for_each(|edge| self.listen_outside(robot, edge, environment))
    }

    fn listen_outside(&mut self, robot: &str, edge: &Edge, environment: &Environment) -> Result<(), StartError> {
        if self.subscribed.contains(&edge.input) {
            return Ok(());
        }
        let Some(port) = self.ports.iter().find(|port| port.name == edge.input) else { return Ok(()) };
        let key = Key::new(robot, &edge.from.node, &edge.from.port);
        let guard = self.subscribe(port, &key, edge.reliable, environment)?;
        self.guards.push(guard);
        self.subscribed.push(edge.input.clone());
        Ok(())
    }

    fn subscribe(
        &self,
        port: &InputPort,
        key: &Key,
        reliable: bool,
        environment: &Environment,
    ) -> Result<Guard, StartError> {
        let inlet = Arc::new(Inlet {
            mailbox: Arc::clone(&port.mailbox),
            message_type: port.message_type.clone(),
            triggers: port.triggers,
            group: Arc::clone(&self.group),
            index: self.index,
        });
        let guard = environment.transport.subscribe(key, reliable, inlet);
        guard.map_err(|reason| StartError::Transport { node: self.node.clone(), reason })
    }

    /// Age of the oldest sample that waits at a triggering input; `None`: nothing waits.
    pub(super) fn waiting_for(&self, now: Stamp) -> Option<Duration> {
        let triggering = self.ports.iter().filter(|port| port.triggers);
        let stamps = triggering.filter_map(|port| port.mailbox.oldest()).min();
        stamps.map(|stamp| now.since(stamp).to_duration())
    }
}
