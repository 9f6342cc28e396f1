//! The lockstep executor: one thread, virtual time from 0, deterministic to the byte, and as fast as the operators are.
//!
//! - A node steps at each multiple of its period, and when a triggering input has something: at the same virtual time, in the
//!   order in which nodes were triggered.
//! - What a step sends leaves the node after its modelled latency, and arrives after the edge's delay on top of that.
//! - While its modelled computing goes on, a node is busy: what comes meanwhile waits.
//!
//! Never asks the wall clock for anything that a node can see; measures it only to report what steps cost.

mod error;
mod hash;
mod slot;
mod summary;
mod timeline;

use std::collections::{HashMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Control, Header, Message, Meta, Origins, Stamp};

pub use self::error::LockstepError;
use self::error::{MAX_STEPS_AT_ONE_TIME, panic_message};
use self::hash::OutputHash;
use self::slot::{Reader, Slot};
pub use self::summary::{LockstepFault, LockstepSummary, NodeSummary};
use self::timeline::{Event, Timeline};
use super::build::build_node;
use crate::clock::VirtualClock;
use crate::graph::{Graph, GraphNode, NodeBody, OnOverrun};
use crate::lines::MemoryLines;
use crate::node::{Published, StepReport};
use crate::operator::Trigger;
use crate::ports::Incoming;
use crate::setup::{BufferPool, HeapPool, Setup, Waker};

/// How to run a graph in lockstep.
#[derive(Clone)]
pub struct LockstepOptions {
    /// Seed of the run; operators get it in their setup.
    pub seed: u64,
    /// Memory for large payloads.
    pub buffers: Arc<dyn BufferPool>,
}

impl Default for LockstepOptions {
    fn default() -> Self {
        Self { seed: 1, buffers: Arc::new(HeapPool) }
    }
}

/// A graph at work in lockstep.
pub struct Lockstep {
    seed: u64,
    now: Stamp,
    clock: Arc<VirtualClock>,
    buffers: Arc<dyn BufferPool>,
    lines: MemoryLines,
    woken: Arc<Woken>,
    slots: Vec<Slot>,
    by_name: HashMap<String, usize>,
    timeline: Timeline,
    /// Steps that are due now, in the order in which they were triggered.
    due: VecDeque<(usize, Trigger)>,
    steps_at_this_time: u64,
    outbox: Vec<Published>,
    hash: OutputHash,
    faults: Vec<LockstepFault>,
    ended: Option<LockstepError>,
    wall: Duration,
}

/// Nodes whose wakers were called.
#[derive(Default)]
struct Woken {
    any: AtomicBool,
    nodes: Mutex<Vec<usize>>,
}

impl Lockstep {
    /// Builds all nodes. Virtual time stands at 0; nothing has stepped yet.
    pub fn new(graph: &Graph, options: LockstepOptions) -> Result<Self, LockstepError> {
        let is_exec = |node: &&GraphNode| matches!(node.body, NodeBody::Exec { .. });
        let nodes: Vec<_> = graph.nodes.iter().filter(is_exec).map(|node| node.name.clone()).collect();
        if !nodes.is_empty() {
            return Err(LockstepError::Exec { nodes });
        }
        let mut lockstep = Self {
            seed: options.seed,
            now: Stamp::ZERO,
            clock: Arc::new(VirtualClock::default()),
            buffers: options.buffers,
            lines: MemoryLines::default(),
            woken: Arc::new(Woken::default()),
            slots: Vec::with_capacity(graph.nodes.len()),
            by_name: HashMap::new(),
            timeline: Timeline::default(),
            due: VecDeque::new(),
            steps_at_this_time: 0,
            outbox: Vec::new(),
            hash: OutputHash::new(),
            faults: Vec::new(),
            ended: None,
            wall: Duration::ZERO,
        };
        for node in &graph.nodes {
            lockstep.add(node, graph)?;
        }
        lockstep.connect(graph);
        Ok(lockstep)
    }

    fn add(&mut self, node: &GraphNode, graph: &Graph) -> Result<(), LockstepError> {
        let index = self.slots.len();
        let setup = self.setup(index, node, graph);
        let built = build_node(node, graph, &setup, 0)?;
        let slot = Slot::new(built, node);
        if slot.period.is_some() {
            self.timeline.insert(Stamp::ZERO, Event::Period(index));
        }
        self.by_name.insert(node.name.clone(), index);
        self.slots.push(slot);
        Ok(())
    }

    fn setup(&self, index: usize, node: &GraphNode, graph: &Graph) -> Setup {
        let woken = Arc::clone(&self.woken);
        let waker = Waker::new(move || {
            woken.nodes.lock().unwrap_or_else(PoisonError::into_inner).push(index);
            woken.any.store(true, Ordering::Release);
        });
        Setup {
            robot: graph.robot.clone(),
            node: node.name.clone(),
            base_dir: graph.base_dir.clone(),
            run_dir: None,
            seed: self.seed,
            waker,
            clock: Arc::clone(&self.clock) as _,
            buffers: Arc::clone(&self.buffers),
            memory_lines: Some(self.lines.clone()),
        }
    }

    fn connect(&mut self, graph: &Graph) {
        for (reader, node) in graph.nodes.iter().enumerate() {
            for edge in &node.inputs {
                let specs = self.slots[reader].node.inputs();
                let Some(input) = specs.iter().position(|input| input.spec.name == edge.input) else { continue };
                let triggers = specs[input].spec.triggers;
                let Ok((writer, port)) = self.output(&edge.from.node, &edge.from.port) else { continue };
                let delay = edge.delay.unwrap_or_default();
                self.slots[writer].outputs[port].readers.push(Reader { node: reader, input, delay, triggers });
            }
        }
        (0..self.slots.len()).for_each(|node| self.tell_wanted(node));
    }

    fn tell_wanted(&mut self, node: usize) {
        let Slot { node, outputs, .. } = &mut self.slots[node];
        node.set_wanted(&|port| !outputs[port].readers.is_empty() || !outputs[port].subscribers.is_empty());
    }

    fn output(&self, node: &str, port: &str) -> Result<(usize, usize), LockstepError> {
        let index = self.by_name.get(node).copied();
        let found = index.and_then(|index| {
            let outputs = self.slots[index].node.outputs();
            Some((index, outputs.iter().position(|output| output.name == port)?))
        });
        found.ok_or_else(|| LockstepError::NoPort { what: "output", node: node.to_owned(), port: port.to_owned() })
    }

    /// The virtual time.
    pub fn now(&self) -> Stamp {
        self.now
    }

    /// The serial lines in memory: to cut one, or to sit at one of its ends.
    pub fn lines(&self) -> &MemoryLines {
        &self.lines
    }

    /// Times at which a node stopped the car, so far.
    pub fn faults(&self) -> &[LockstepFault] {
        &self.faults
    }

    /// Calls `hear` with every sample of an output, when it leaves its node.
    pub fn subscribe(
        &mut self,
        node: &str,
        port: &str,
        hear: impl FnMut(&Published) + 'static,
    ) -> Result<(), LockstepError> {
        let (node, port) = self.output(node, port)?;
        self.slots[node].outputs[port].subscribers.push(Box::new(hear));
        self.tell_wanted(node);
        Ok(())
    }

    /// The newest sample of an output. `None`: nothing yet, no such output, or no `T`. Does not make the output wanted.
    pub fn last<T: Message>(&self, node: &str, port: &str) -> Option<Arc<T>> {
        let (node, port) = self.output(node, port).ok()?;
        let message = Arc::clone(&self.slots[node].outputs[port].last.as_ref()?.message);
        message.into_any().downcast().ok()
    }

    /// Puts a sample into an input now, as `carril pub` does from outside.
    pub fn put<T: Message>(&mut self, node: &str, input: &str, value: T) -> Result<(), LockstepError> {
        let no_port = || LockstepError::NoPort { what: "input", node: node.to_owned(), port: input.to_owned() };
        let index = self.by_name.get(node).copied().ok_or_else(no_port)?;
        let specs = self.slots[index].node.inputs();
        let port = specs.iter().position(|spec| spec.spec.name == input).ok_or_else(no_port)?;
        let triggers = specs[port].spec.triggers;
        let (origins, meta) = (Origins::none(), Meta::new());
        let header = Header { epoch: 0, seq: 0, stamp: self.now, origins, message_type: T::TYPE, meta };
        self.deliver(index, port, triggers, Incoming::Local(Arc::new(header), Arc::new(value)));
        Ok(())
    }

    /// Says a word to all nodes now.
    pub fn control(&mut self, control: Control) {
        for node in 0..self.slots.len() {
            self.slots[node].controls.push_back(control);
            self.ask(node, Trigger::Control);
        }
    }

    /// Says a word to all nodes at a time to come; at once when that has passed.
    pub fn control_at(&mut self, at: Stamp, control: Control) {
        self.timeline.insert(at.max(self.now), Event::Control(control));
    }

    /// Runs until virtual time stands at `end`, what happens at `end` included.
    pub fn run_until(&mut self, end: Stamp) -> Result<(), LockstepError> {
        let started = Instant::now();
        let result = self.run_to(end);
        self.wall += started.elapsed();
        result
    }

    fn run_to(&mut self, end: Stamp) -> Result<(), LockstepError> {
        self.ended.clone().map_or(Ok(()), Err)?;
        self.take_wakes();
        while !self.due.is_empty() || self.timeline.next_at().is_some_and(|at| at <= end) {
            self.advance()?;
        }
        if end > self.now {
            self.move_to(end);
        }
        Ok(())
    }

    /// Does the next thing: a step, a delivery, a word. Gives the time at which it happened, `None` when nothing is left to do.
    pub fn step_event(&mut self) -> Result<Option<Stamp>, LockstepError> {
        self.ended.clone().map_or(Ok(()), Err)?;
        self.take_wakes();
        if self.due.is_empty() && self.timeline.next_at().is_none() {
            return Ok(None);
        }
        let started = Instant::now();
        let result = self.advance();
        self.wall += started.elapsed();
        result.map(|()| Some(self.now))
    }

    /// Ends the run. Virtual time stands still from here on.
    pub fn finish(mut self) -> LockstepSummary {
        let (virtual_s, wall_s) = (self.now.as_secs_f64(), self.wall.as_secs_f64());
        let now = self.now;
        let nodes: Vec<_> =
            self.slots.iter_mut().map(|slot| NodeSummary::new(slot.health(now), slot.cost.as_nanos() as u64)).collect();
        LockstepSummary {
            seed: self.seed,
            virtual_s,
            wall_s,
            real_time_factor: if wall_s > 0.0 { virtual_s / wall_s } else { 0.0 },
            steps: nodes.iter().map(|node| node.steps).sum(),
            hash: format!("{:016x}", self.hash.value()),
            nodes,
            faults: self.faults,
        }
    }

    fn move_to(&mut self, at: Stamp) {
        if at > self.now {
            self.now = at;
            self.clock.advance_to(at);
            self.steps_at_this_time = 0;
        }
    }

    /// Events of this moment come before its steps: a node sees all that arrives at the moment at which it steps.
    fn advance(&mut self) -> Result<(), LockstepError> {
        let event_due = self.timeline.next_at().is_some_and(|at| self.due.is_empty() || at <= self.now);
        let result = if event_due {
            match self.timeline.pop() {
                Some((at, event)) => {
                    self.move_to(at);
                    self.happen(event)
                }
                None => Ok(()),
            }
        } else {
            match self.due.pop_front() {
                Some((node, trigger)) => self.step_or_wait(node, trigger),
                None => Ok(()),
            }
        };
        match &result {
            Ok(()) => self.take_wakes(),
            Err(error) => self.ended = Some(error.clone()),
        }
        result
    }

    fn happen(&mut self, event: Event) -> Result<(), LockstepError> {
        match event {
            Event::Period(node) => self.period(node),
            Event::Free(node) => self.free(node),
            Event::Publish(node, published) => return self.publish(node, published),
            Event::Deliver { node, input, incoming } => {
                let triggers = self.slots[node].node.inputs()[input].spec.triggers;
                self.deliver(node, input, triggers, incoming);
            }
            Event::Control(control) => self.control(control),
        }
        Ok(())
    }

    fn period(&mut self, node: usize) {
        let slot = &mut self.slots[node];
        let Some(next) = slot.next_period() else { return };
        if slot.leaves_period_out() {
            slot.node.count_missed_periods(1);
        } else {
            self.ask(node, Trigger::Period);
        }
        self.timeline.insert(next, Event::Period(node));
    }

    fn free(&mut self, node: usize) {
        let slot = &mut self.slots[node];
        slot.busy = false;
        if std::mem::take(&mut slot.skips) {
            slot.skip_backlog();
        }
        self.due.extend(slot.waiting.drain(..).map(|trigger| (node, trigger)));
    }

    /// Makes a step due, unless one for the same reason is due already.
    fn ask(&mut self, node: usize, trigger: Trigger) {
        let slot = &mut self.slots[node];
        if !slot.ask(trigger) {
            return;
        }
        if slot.busy {
            slot.waiting.push_back(trigger);
        } else {
            self.due.push_back((node, trigger));
        }
    }

    fn deliver(&mut self, node: usize, input: usize, triggers: bool, incoming: Incoming) {
        self.slots[node].node.mailboxes()[input].push(incoming);
        if triggers {
            self.ask(node, Trigger::Input);
        }
    }

    fn take_wakes(&mut self) {
        if !self.woken.any.load(Ordering::Acquire) || !self.woken.any.swap(false, Ordering::Acquire) {
            return;
        }
        let nodes = std::mem::take(&mut *self.woken.nodes.lock().unwrap_or_else(PoisonError::into_inner));
        for node in nodes {
            self.ask(node, Trigger::Wake);
        }
    }

    fn step_or_wait(&mut self, node: usize, trigger: Trigger) -> Result<(), LockstepError> {
        let slot = &mut self.slots[node];
        if slot.busy {
            slot.waiting.push_back(trigger);
            return Ok(());
        }
        slot.answer(trigger);
        match trigger {
            // Another step of this moment has taken the sample in already.
            Trigger::Input if !slot.node.triggered() => return Ok(()),
            Trigger::Control => {
                let Some(control) = slot.controls.pop_front() else { return Ok(()) };
                slot.node.control(control, self.now);
            }
            _ => {}
        }
        self.steps_at_this_time += 1;
        if self.steps_at_this_time > MAX_STEPS_AT_ONE_TIME {
            return Err(LockstepError::StandsStill { at: self.now, node: slot.node.name().to_owned() });
        }
        self.step(node, trigger)
    }

    fn step(&mut self, node: usize, trigger: Trigger) -> Result<(), LockstepError> {
        let (now, slot, mut outbox) = (self.now, &mut self.slots[node], std::mem::take(&mut self.outbox));
        let (latency, buffers) = (slot.latency, &*self.buffers);
        let step =
            || slot.node.step(now, trigger, buffers, &|_| now + latency, &mut |published| outbox.push(published));
        let report = catch_unwind(AssertUnwindSafe(step)).map_err(|panic| LockstepError::Panicked {
            node: self.slots[node].node.name().to_owned(),
            at: now,
            message: panic_message(&*panic),
        })?;
        self.slots[node].cost += report.took;
        if latency.is_zero() {
            for published in outbox.drain(..) {
                self.publish(node, published)?;
            }
        } else {
            self.slots[node].busy = true;
            self.timeline.insert(now + latency, Event::Free(node));
            for published in outbox.drain(..) {
                self.timeline.insert(now + latency, Event::Publish(node, published));
            }
        }
        self.outbox = outbox;
        self.act_on(node, report);
        Ok(())
    }

    fn publish(&mut self, node: usize, published: Published) -> Result<(), LockstepError> {
        let port = published.port;
        let output = &mut self.slots[node].outputs[port];
        let hashed = self.hash.update(&output.key, &published);
        output.bytes += hashed.map_err(|source| LockstepError::Encode { key: output.key.clone(), source })? as u64;
        for hear in &mut output.subscribers {
            hear(&published);
        }
        for index in 0..output.readers.len() {
            let Reader { node: reader, input, delay, triggers } = self.slots[node].outputs[port].readers[index];
            let incoming = Incoming::Local(Arc::clone(&published.header), Arc::clone(&published.message));
            if delay.is_zero() {
                self.deliver(reader, input, triggers, incoming);
            } else {
                self.timeline.insert(self.now + delay, Event::Deliver { node: reader, input, incoming });
            }
        }
        self.slots[node].outputs[port].last = Some(published);
        Ok(())
    }

    fn act_on(&mut self, node: usize, report: StepReport) {
        if report.stop.is_none() && !report.overrun {
            return;
        }
        let name = self.slots[node].node.name().to_owned();
        if let Some(stop) = report.stop {
            let (age, limit) = (stop.age.as_secs_f64() * 1e3, stop.max_age.as_secs_f64() * 1e3);
            self.stop_car(
                &name,
                format!("samples at `{name}/{}` are {age:.1} ms old, the budget is {limit:.1} ms", stop.port),
            );
        }
        if report.overrun {
            match self.slots[node].on_overrun {
                OnOverrun::Warn => {}
                OnOverrun::Skip => self.slots[node].skips = true,
                OnOverrun::Stop => {
                    let latency = self.slots[node].latency.as_secs_f64() * 1e3;
                    self.stop_car(&name, format!("a step took {latency:.1} ms, longer than the deadline"));
                }
            }
        }
    }

    fn stop_car(&mut self, node: &str, reason: String) {
        self.faults.push(LockstepFault { at: self.now, node: node.to_owned(), reason });
        self.control(Control::EStop);
    }
}
