//! The graph as it runs now: the plan, which instance of each node is the node, and what was before.

use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::Value;

use super::candidate::Place;
use super::plan::{Plan, PlanBody, PlanNode};
use crate::control_plane::{InputEntry, LiveGraph, LiveNode, NodeEntry, OutputEntry};
use crate::describe::kind_of;
use crate::registry::{OperatorKind, Registry};

/// Versions of a node that are kept to go back to.
const KEPT_VERSIONS: usize = 16;

/// The live graph, shared by the supervisor's threads.
#[derive(Clone)]
pub(super) struct SharedLive(Arc<Mutex<Live>>);

pub(super) struct Live {
    pub plan: Plan,
    pub registry: Registry,
    nodes: HashMap<String, NodeLife>,
    next_seat: u32,
    next_process: u32,
    /// Names that processes of this run have or had.
    processes: HashSet<String>,
    /// The whole graph is being changed.
    applying: bool,
}

/// What there is to know of a node besides its plan.
pub(super) struct NodeLife {
    version: u32,
    /// The instance that is the node; 0: the first of its process.
    seat: u32,
    before: Vec<(u32, PlanNode)>,
    /// The change that is under way.
    change: Option<String>,
}

impl SharedLive {
    /// The graph, for people and tools.
    pub(super) fn graph(&self) -> LiveGraph {
        let (path, nodes): (_, Vec<_>) = {
            let live = self.lock();
            let known = |node: &PlanNode| {
                let (version, kind) = (live.version(&node.name), live.kind(&node.body));
                (node.clone(), version, kind, live.fitting(node))
            };
            (live.plan.path.clone(), live.plan.nodes.iter().map(known).collect())
        };
        // Unlocked: a binary of the user's own has some seconds to tell its defaults.
        let nodes = nodes.into_iter();
        let nodes = nodes.map(|(node, version, kind, fitting)| live_node(node, version, kind.as_deref(), fitting));
        LiveGraph { graph: path, nodes: nodes.collect() }
    }

    pub(super) fn new(plan: Plan, registry: &Registry) -> Self {
        let life =
            |node: &PlanNode| (node.name.clone(), NodeLife { version: 1, seat: 0, before: Vec::new(), change: None });
        let nodes = plan.nodes.iter().map(life).collect();
        let processes = plan.nodes.iter().map(|node| node.process.clone()).collect();
        let registry = registry.clone();
        let live = Live { plan, registry, nodes, next_seat: 1, next_process: 2, processes, applying: false };
        Self(Arc::new(Mutex::new(live)))
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Live> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins a change of the whole graph, which ends with the guard. `Err`: a change is under way.
    pub(super) fn begin_apply(&self) -> Result<Applying<'_>, String> {
        self.lock().begin_apply()?;
        Ok(Applying(self))
    }
}

/// The whole graph is being changed: other changes are refused.
pub(super) struct Applying<'a>(&'a SharedLive);

impl Drop for Applying<'_> {
    fn drop(&mut self) {
        self.0.lock().applying = false;
    }
}

impl Live {
    /// A process starts: its nodes are the first instances again.
    pub(super) fn begin_process(&mut self, process: &str) {
        for node in self.plan.nodes.iter().filter(|node| node.process == process) {
            if let Some(life) = self.nodes.get_mut(&node.name) {
                life.seat = 0;
            }
        }
    }

    pub(super) fn seat(&self, node: &str) -> u32 {
        self.nodes.get(node).map_or(0, |life| life.seat)
    }

    pub(super) fn version(&self, node: &str) -> u32 {
        self.nodes.get(node).map_or(0, |life| life.version)
    }

    /// A number for another instance.
    pub(super) fn new_seat(&mut self) -> u32 {
        self.next_seat += 1;
        self.next_seat - 1
    }

    /// A name for another process: that of the graph, with a number behind it if there was one of that name.
    fn new_process(&mut self, declared: &str) -> String {
        let name = if self.processes.contains(declared) {
            self.next_process += 1;
            format!("{declared}.{}", self.next_process - 1)
        } else {
            declared.to_owned()
        };
        self.processes.insert(name.clone());
        name
    }

    /// Where the next version of a node runs, or a node that is new (`before`: `None`). It stays in its process while that is the
    /// right program and the graph does not move it; else it joins the nodes that the graph puts into the same process. `up`: whether a
    /// process is there; into others nobody comes.
    pub(super) fn place(&mut self, before: Option<&PlanNode>, after: &PlanNode, up: &dyn Fn(&str) -> bool) -> Place {
        let declared = after.declared_process();
        let stays =
            before.filter(|before| before.declared_process() == declared && before.body.same_program(&after.body));
        let stays = stays.filter(|before| up(&before.process));
        if let Some(before) = stays {
            return Place::Running(before.process.clone());
        }
        let own_binary = matches!(after.body, PlanBody::Exec { .. });
        let joins = |node: &&PlanNode| {
            let ours = matches!(node.body, PlanBody::Operator(_));
            node.name != after.name && ours && node.declared_process() == declared && up(&node.process)
        };
        let together = self.plan.nodes.iter().find(joins).map(|node| node.process.clone());
        match together.filter(|_| !own_binary) {
            Some(process) => Place::Running(process),
            None => Place::New { process: self.new_process(declared), own_binary },
        }
    }

    /// Begins a change of a node. `Err`: another one is under way.
    pub(super) fn begin_change(&mut self, node: &str, what: &str) -> Result<(), String> {
        if self.applying {
            return Err("the whole graph is being changed (apply); wait for its receipt".into());
        }
        if let Some(reason) = self.plan.node(node).and_then(|known| self.not_here(known)) {
            return Err(reason);
        }
        let known: Vec<&str> = self.plan.nodes.iter().map(|node| node.name.as_str()).collect();
        let Some(life) = self.nodes.get_mut(node) else {
            return Err(format!("there is no node `{node}`; there are {}", known.join(", ")));
        };
        if let Some(other) = &life.change {
            Err(format!("another change of node `{node}` is under way ({other}); wait for its receipt"))
        } else {
            life.change = Some(what.to_owned());
            Ok(())
        }
    }

    /// Why a node cannot be changed here, if it runs elsewhere.
    fn not_here(&self, node: &PlanNode) -> Option<String> {
        self.plan.is_elsewhere(node).then(|| match &node.machine {
            Some(machine) => format!("node `{}` runs on machine `{machine}`: change it there", node.name),
            None => format!("node `{}` runs on the car: change it there", node.name),
        })
    }

    pub(super) fn end_change(&mut self, node: &str) {
        if let Some(life) = self.nodes.get_mut(node) {
            life.change = None;
        }
    }

    fn begin_apply(&mut self) -> Result<(), String> {
        if self.applying {
            return Err("another change of the whole graph is under way (apply); wait for its receipt".into());
        }
        let busy = self.nodes.iter().find_map(|(node, life)| Some((node, life.change.as_ref()?)));
        if let Some((node, what)) = busy {
            return Err(format!("a change of node `{node}` is under way ({what}); wait for its receipt"));
        }
        self.applying = true;
        Ok(())
    }

    /// A node is another one from now on, or new in the graph.
    pub(super) fn replace(&mut self, node: &PlanNode, seat: u32) {
        let fresh = || NodeLife { version: 1, seat, before: Vec::new(), change: None };
        self.nodes.entry(node.name.clone()).or_insert_with(fresh).seat = seat;
        self.plan = self.plan.with(node);
    }

    /// A node is no longer in the graph. Gives what [`Live::put_back`] needs.
    pub(super) fn remove(&mut self, node: &str) -> Option<(PlanNode, NodeLife)> {
        let at = self.plan.nodes.iter().position(|known| known.name == node)?;
        let life = self.nodes.remove(node)?;
        Some((self.plan.nodes.remove(at), life))
    }

    /// A node is in the graph again, as it was.
    pub(super) fn put_back(&mut self, (node, life): (PlanNode, NodeLife)) {
        self.nodes.insert(node.name.clone(), life);
        self.plan.nodes.push(node);
    }

    /// A change is final: what was before can be gone back to.
    pub(super) fn keep_before(&mut self, before: PlanNode) {
        if let Some(life) = self.nodes.get_mut(&before.name) {
            life.before.push((life.version, before));
            if life.before.len() > KEPT_VERSIONS {
                life.before.remove(0);
            }
            life.version += 1;
        }
    }

    /// What a node was before the last change.
    pub(super) fn before(&self, node: &str) -> Option<&(u32, PlanNode)> {
        self.nodes.get(node)?.before.last()
    }

    /// The last change was a restart: the version is the one that it was.
    pub(super) fn forget_restart(&mut self, node: &str) {
        if let Some(life) = self.nodes.get_mut(node) {
            life.before.pop();
            life.version = life.version.saturating_sub(1);
        }
    }

    /// The last change was taken back: it never was.
    pub(super) fn forget_last_change(&mut self, node: &str) {
        if let Some(life) = self.nodes.get_mut(node) {
            // The change, and the one back.
            life.before.pop();
            life.before.pop();
            life.version = life.version.saturating_sub(2);
        }
    }

    /// The names of the nodes, in their order.
    pub(super) fn order(&self) -> Vec<String> {
        self.plan.nodes.iter().map(|node| node.name.clone()).collect()
    }

    /// Puts the nodes into this order.
    pub(super) fn put_in_order(&mut self, order: &[String]) {
        self.plan.nodes.sort_by_key(|node| order.iter().position(|name| *name == node.name).unwrap_or(usize::MAX));
    }

    /// That version is the current one again: the change after it is forgotten.
    pub(super) fn forget_last_before(&mut self, node: &str) {
        if let Some(life) = self.nodes.get_mut(node) {
            life.before.pop();
        }
    }

    /// The kind of a node's operator; `None`: it is in another program, or unknown here.
    pub(super) fn kind(&self, body: &PlanBody) -> Option<Arc<OperatorKind>> {
        match body {
            PlanBody::Operator(kind) => self.registry.get(kind).cloned(),
            PlanBody::Exec { path, operator, .. } => Some(Arc::new(kind_of(path, operator, &self.plan.base_dir))),
            PlanBody::Elsewhere => None,
        }
    }

    /// The nodes of a plan with the kinds of their operators.
    pub(super) fn kinds(&self, plan: &Plan) -> Vec<(PlanNode, Option<Arc<OperatorKind>>)> {
        plan.nodes.iter().map(|node| (node.clone(), self.kind(&node.body))).collect()
    }

    /// The entries of all nodes in the run file.
    pub(super) fn node_entries(&self) -> Vec<NodeEntry> {
        self.plan.nodes.iter().filter_map(|node| self.node_entry(&node.name)).collect()
    }

    /// The entry of a node in the run file.
    pub(super) fn node_entry(&self, name: &str) -> Option<NodeEntry> {
        let node = self.plan.node(name)?;
        let (inputs, outputs) = match self.kind(&node.body) {
            Some(kind) => ports(node, &kind),
            None => self.ports_by_edges(node),
        };
        Some(NodeEntry {
            name: name.to_owned(),
            operator: operator_name(&node.body),
            exec: program(&node.body).map(Path::to_owned),
            process: node.process.clone(),
            machine: node.machine.clone(),
            inputs,
            outputs,
        })
    }

    /// What the edges of a node say of its ports, where nothing else does: its binary is on another machine.
    fn ports_by_edges(&self, node: &PlanNode) -> (Vec<InputEntry>, Vec<OutputEntry>) {
        let inputs = node.inputs.iter().filter_map(|edge| {
            let writer = self.kind(&self.plan.node(&edge.from.node)?.body)?;
            let spec = &writer.outputs[writer.output(&edge.from.port)?];
            let (port, message_type) = (edge.input.clone(), spec.message_type.name.to_string());
            Some(InputEntry { port, message_type, from: Some(edge.from.to_string()), external: false })
        });
        let mut outputs: Vec<OutputEntry> = Vec::new();
        for (reader, edge) in self.plan.readers_of(&node.name) {
            let Some(kind) = self.kind(&reader.body) else { continue };
            let Some(at) = kind.input(&edge.input) else { continue };
            if !outputs.iter().any(|known| known.port == edge.from.port) {
                let message_type = kind.inputs[at].message_type.name.to_string();
                outputs.push(OutputEntry { port: edge.from.port.clone(), message_type, on_demand: false });
            }
        }
        (inputs.collect(), outputs)
    }

    /// Output ports that are always served, by node.
    pub(super) fn plain_outputs(&self, node: &str) -> Vec<String> {
        let entry = self.node_entry(node);
        let outputs = entry.iter().flat_map(|entry| &entry.outputs);
        outputs.filter(|output| !output.on_demand).map(|output| output.port.clone()).collect()
    }
}

/// The ports of a node, as its operator has them.
fn ports(node: &PlanNode, kind: &OperatorKind) -> (Vec<InputEntry>, Vec<OutputEntry>) {
    let from = |port: &str| node.inputs.iter().find(|edge| edge.input == port).map(|edge| edge.from.to_string());
    let inputs = kind.inputs.iter().map(|spec| InputEntry {
        port: spec.name.to_owned(),
        message_type: spec.message_type.name.to_string(),
        from: from(spec.name),
        external: spec.external,
    });
    let outputs = kind.outputs.iter().map(|spec| OutputEntry {
        port: spec.name.to_owned(),
        message_type: spec.message_type.name.to_string(),
        on_demand: spec.on_demand,
    });
    (inputs.collect(), outputs.collect())
}

/// How people call what runs in a node.
pub(super) fn operator_name(body: &PlanBody) -> String {
    match body {
        PlanBody::Operator(kind) => kind.clone(),
        PlanBody::Exec { operator, .. } => operator.name.clone(),
        PlanBody::Elsewhere => String::new(),
    }
}

fn program(body: &PlanBody) -> Option<&Path> {
    match body {
        PlanBody::Exec { path, .. } => Some(path),
        PlanBody::Operator(_) | PlanBody::Elsewhere => None,
    }
}

fn live_node(node: PlanNode, version: u32, kind: Option<&OperatorKind>, fitting: Vec<String>) -> LiveNode {
    LiveNode {
        operator: operator_name(&node.body),
        exec: program(&node.body).map(Path::to_owned),
        version,
        config: kind.map_or_else(|| node.config.clone(), |kind| kind.effective_config(&node.config)),
        schema: kind.map_or(Value::Null, OperatorKind::config_schema),
        fitting,
        name: node.name,
    }
}
