//! Puts the nodes of a process together: who shares a thread with whom, which edges stay inside, and which come from elsewhere.

use std::sync::Arc;

use carril_messages::{Key, MessageType};

use super::group::Group;
use super::slot::{LocalReader, OutputPort, Rebuild, Slot, Surroundings};
use super::{Environment, Events, StartError};
use crate::backoff::Restarts;
use crate::executor::build::build_node;
use crate::graph::{Graph, GraphNode, NodeBody, PortRef};
use crate::mailbox::Mailbox;
use crate::node::{Node, NodeInput};
use crate::operator::SetupError;
use crate::ports::Incoming;
use crate::setup::{Setup, Waker};
use crate::transport::{Guard, Sink, expect_type};

/// The nodes in their groups, and their inputs.
pub(super) struct Wired {
    pub groups: Vec<Arc<Group>>,
    pub inputs: Vec<Place>,
}

/// A node, where it runs, and its mailboxes.
pub(super) struct Place {
    name: String,
    group: Arc<Group>,
    index: usize,
    ports: Vec<InputPort>,
}

struct InputPort {
    name: &'static str,
    message_type: MessageType,
    triggers: bool,
    external: bool,
    mailbox: Arc<Mailbox>,
}

/// Builds the nodes, in the order of the graph.
pub(super) fn build(
    graph: &Graph,
    nodes: &[&GraphNode],
    environment: &Environment,
    events: &Events,
) -> Result<Wired, StartError> {
    let groups = group(nodes);
    let mut built = Vec::new();
    let mut inputs = Vec::new();
    for (group, members) in &groups {
        for (index, node) in members.iter().enumerate() {
            let setup = setup(graph, node, environment, group, index);
            let epoch = environment.clock.now().as_nanos() as u64;
            let runtime_node = build_node(node, graph, &setup, epoch)?;
            inputs.push(place(&runtime_node, group, index));
            built.push((Arc::clone(group), *node, runtime_node, setup));
        }
    }
    let mut slots: Vec<(Arc<Group>, Slot)> = Vec::new();
    for (group, graph_node, node, setup) in built {
        let outputs = outputs(graph, &node, &group, &inputs, environment)?;
        let timing = (graph_node.period, graph_node.on_overrun);
        let restarts = Restarts::new(graph_node.restart);
        slots.push((group, Slot::new(node, outputs, timing, rebuild(graph_node, setup), restarts)));
    }
    for (group, _) in &groups {
        let (own, others) = slots.into_iter().partition::<Vec<_>, _>(|(of, _)| Arc::ptr_eq(of, group));
        slots = others;
        let around = Surroundings {
            clock: Arc::clone(&environment.clock),
            buffers: environment.transport.buffers(),
            events: events.clone(),
            alone: nodes.len() == 1,
        };
        group.fill(own.into_iter().map(|(_, slot)| slot).collect(), around);
    }
    Ok(Wired { groups: groups.into_iter().map(|(group, _)| group).collect(), inputs })
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

fn setup(graph: &Graph, node: &GraphNode, environment: &Environment, group: &Arc<Group>, index: usize) -> Setup {
    // Weak: an operator holds its waker, and the group holds the operator.
    let group = Arc::downgrade(group);
    Setup {
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
    }
}

fn rebuild(node: &GraphNode, setup: Setup) -> Rebuild {
    let (body, config) = (node.body.clone(), node.config.clone());
    Box::new(move || match &body {
        NodeBody::Operator(kind) => kind.build(config.clone(), &setup),
        NodeBody::Exec { .. } | NodeBody::Elsewhere => Err(SetupError::new("it runs in another process")),
    })
}

fn place(node: &Node, group: &Arc<Group>, index: usize) -> Place {
    let port = |(input, mailbox): (&NodeInput, &Arc<Mailbox>)| InputPort {
        name: input.spec.name,
        message_type: input.spec.message_type.clone(),
        triggers: input.spec.triggers,
        external: input.spec.external,
        mailbox: Arc::clone(mailbox),
    };
    let ports = node.inputs().iter().zip(node.mailboxes()).map(port).collect();
    Place { name: node.name().to_owned(), group: Arc::clone(group), index, ports }
}

impl Place {
    fn port(&self, name: &str) -> Option<&InputPort> {
        self.ports.iter().find(|port| port.name == name)
    }
}

fn outputs(
    graph: &Graph,
    node: &Node,
    group: &Arc<Group>,
    places: &[Place],
    environment: &Environment,
) -> Result<Vec<OutputPort>, StartError> {
    let mut ports = Vec::new();
    for spec in node.outputs() {
        let own = PortRef { node: node.name().to_owned(), port: spec.name.to_owned() };
        let mut readers = Vec::new();
        let mut reliable = false;
        for (reader, edge) in graph.nodes.iter().flat_map(|node| node.inputs.iter().map(move |edge| (node, edge))) {
            if edge.from != own {
                continue;
            }
            let Some(place) = places.iter().find(|place| place.name == reader.name) else {
                reliable |= edge.reliable;
                continue;
            };
            let Some(port) = place.port(&edge.input) else { continue };
            let (mailbox, own_group) = (Arc::clone(&port.mailbox), Arc::ptr_eq(&place.group, group));
            let (triggers, group) = (port.triggers, Arc::clone(&place.group));
            readers.push(LocalReader { mailbox, triggers, group, index: place.index, own_group });
        }
        let key = Key::new(&graph.robot, node.name(), spec.name);
        let publisher = environment.transport.publish_on(&key, reliable);
        let publisher = publisher.map_err(|reason| StartError::Transport { node: node.name().to_owned(), reason })?;
        ports.push(OutputPort { name: own.to_string(), readers, publisher, reliable, complained: false.into() });
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

/// Reads what comes from other processes: edges, and the keys of external inputs.
pub(super) fn subscribe(graph: &Graph, places: &[Place], environment: &Environment) -> Result<Vec<Guard>, StartError> {
    let mut guards = Vec::new();
    for place in places {
        let Some(node) = graph.node(&place.name) else { continue };
        let mut read = |port: &InputPort, key: &Key, reliable: bool| {
            let inlet = Arc::new(Inlet {
                mailbox: Arc::clone(&port.mailbox),
                message_type: port.message_type.clone(),
                triggers: port.triggers,
                group: Arc::clone(&place.group),
                index: place.index,
            });
            let guard = environment.transport.subscribe(key, reliable, inlet);
            guards.push(guard.map_err(|reason| StartError::Transport { node: place.name.clone(), reason })?);
            Ok::<_, StartError>(())
        };
        for edge in &node.inputs {
            let inside = places.iter().any(|other| other.name == edge.from.node);
            if let (false, Some(port)) = (inside, place.port(&edge.input)) {
                read(port, &Key::new(&graph.robot, &edge.from.node, &edge.from.port), edge.reliable)?;
            }
        }
        for port in place.ports.iter().filter(|port| port.external) {
            read(port, &Key::new(&graph.robot, &place.name, port.name), false)?;
        }
    }
    Ok(guards)
}
