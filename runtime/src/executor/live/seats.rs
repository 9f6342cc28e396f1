//! Instances that come and go while the process runs.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use carril_messages::{Key, NodeState, Percentiles, Stamp};
use serde_json::Value;

use super::Executor;
use super::group::{Group, Request, lock};
use super::role::{FreezeTerms, MutedOutput, ProbationTerms, Role, Shadow};
use super::slot::{After, OutputPort, Slot, Surroundings};
use super::wiring::{self, Seat};
use crate::graph::{Graph, NodeBody};
use crate::handover::{Handover, StepRecord};
use crate::numbers::Numbers;
use crate::positions::Positions;
use crate::seats::SeatName;

/// A step has this long to end before a node is asked in vain: long enough for a machine that is overloaded.
pub(crate) const STEP_PATIENCE: Duration = Duration::from_secs(1);
/// A step of an instance that goes has this long. Nothing of it comes out in any case, and its predecessor waits.
pub(crate) const RETIRE_PATIENCE: Duration = Duration::from_millis(250);
/// How often a node that is to stop is asked whether it has received everything.
const FREEZE_POLL: Duration = Duration::from_micros(200);

/// A candidate that was built.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Prepared {
    /// Its operator holds a device: it is built when it takes over, and runs no shadow.
    pub exclusive: bool,
    /// Version of its state.
    pub state_version: u32,
}

/// How the steps of an instance went.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Steps {
    /// Steps that went well since it began, or since it took over.
    pub good: u64,
    /// What the last step said, if it failed.
    pub failing: Option<String>,
    /// Its operator panicked, and is not back yet, or never will be.
    pub down: Option<NodeState>,
    /// From the newest triggering sample to the end of the step, of late, us.
    pub latency_us: Option<Percentiles>,
}

impl Executor {
    /// Builds a candidate for `seat`, in shadow; what it would publish goes to `muted`. It begins with `state`. `may_err`: its steps
    /// may fail, as those of the active instance do.
    pub fn prepare(
        &self,
        graph: &Graph,
        seat: &SeatName,
        (state, may_err): (Option<&(u32, Vec<u8>)>, bool),
        muted: MutedOutput,
    ) -> Result<Prepared, String> {
        let node = graph.node(&seat.node).ok_or_else(|| format!("the plan has no node `{}`", seat.node))?;
        let NodeBody::Operator(kind) = &node.body else {
            return Err(format!("node `{}` is a binary of its own", seat.node));
        };
        let exclusive = kind.exclusive(&node.config);
        let local = self.local_nodes();
        let local: Vec<&str> = local.iter().map(String::as_str).filter(|name| *name != seat.node).collect();
        let common = self.common();
        let mut refused = None;
        let built = wiring::build_candidate(graph, node, &local, exclusive, &common, |slot| {
            slot.seat = seat.number;
            if exclusive {
                slot.node.keep_all(true);
                slot.role = Role::Held(Vec::new());
                return Ok(());
            }
            if let Some((version, state)) = state {
                refused = slot.node.restore(*version, state).err();
            }
            slot.role = Role::Shadow(Shadow { hear: muted, may_err });
            Ok(())
        });
        let mut candidate = built.map_err(|error| error.to_string())?;
        if let Some(refused) = refused {
            return Err(format!("it refuses the state: {refused}; swap without it: --fresh"));
        }
        candidate.number = seat.number;
        self.spawn(Arc::clone(&candidate.group)).map_err(|error| error.to_string())?;
        candidate.listen(&self.robot, &local, &common).map_err(|error| error.to_string())?;
        lock(&self.seats).push(candidate);
        Ok(Prepared { exclusive, state_version: kind.state_version })
    }

    fn local_nodes(&self) -> Vec<String> {
        lock(&self.seats).iter().map(|seat| seat.node.clone()).collect()
    }

    /// Reads the outputs of `writer` from other processes, too.
    pub fn listen_outside_to(&self, writer: &str) -> Result<(), String> {
        let mut seats = lock(&self.seats);
        let each = |seat: &mut Seat| seat.listen_outside_to(&self.robot, writer, &self.environment);
        seats.iter_mut().try_for_each(each).map_err(|error| error.to_string())
    }

    /// From now on an output keeps its samples until its readers in other processes have them.
    pub fn serve_reliably(&self, seat: &SeatName, port: &str, patience: Duration) -> Result<(), String> {
        let name = port.to_owned();
        let known = self.at(seat, patience, move |slot, _, _| {
            let found = slot.outputs.iter().position(|output| output.port == name);
            (found.map(|at| (at, slot.outputs[at].reliable)), After::Nothing)
        })?;
        let (at, reliable) = known.ok_or_else(|| format!("node `{}` has no output `{port}`", seat.node))?;
        if reliable {
            return Ok(());
        }
        let key = Key::new(&self.robot, &seat.node, port);
        let publisher = self.environment.transport.publish_on(&key, true).map_err(|error| error.to_string())?;
        self.at(seat, patience, move |slot, _, _| {
            let output = &mut slot.outputs[at];
            (output.publisher, output.reliable) = (publisher, true);
            ((), After::Nothing)
        })
    }

    fn place(&self, seat: &SeatName) -> Result<(Arc<Group>, usize), String> {
        let seats = lock(&self.seats);
        let found = seats.iter().find(|other| other.node == seat.node && other.number == seat.number);
        found.map(|seat| (Arc::clone(&seat.group), seat.index)).ok_or_else(|| {
            format!("process `{}` has no instance {} of node `{}`", self.process, seat.number, seat.node)
        })
    }

    /// Does something to a node on its own thread, between two steps. What is not done within `patience` is not done later.
    fn at<R: Send + 'static>(
        &self,
        seat: &SeatName,
        patience: Duration,
        work: impl FnOnce(&mut Slot, &Surroundings, Option<Instant>) -> (R, After) + Send + 'static,
    ) -> Result<R, String> {
        let (group, index) = self.place(seat)?;
        let (sender, receiver) = channel();
        let claimed = Arc::new(AtomicBool::new(false));
        let claim = Arc::clone(&claimed);
        let work = move |slot: &mut Slot, around: &Surroundings, due: Option<Instant>| {
            if claim.swap(true, Ordering::SeqCst) {
                return After::Nothing;
            }
            let (result, after) = work(slot, around, due);
            // Whoever asked waits, as the claim was ours.
            let _ = sender.send(result);
            after
        };
        group.ask(Request::Do(index, Box::new(work)));
        match receiver.recv_timeout(patience) {
            Ok(result) => return Ok(result),
            Err(RecvTimeoutError::Timeout) if claimed.swap(true, Ordering::SeqCst) => {
                // It has begun just now.
                if let Ok(result) = receiver.recv_timeout(patience) {
                    return Ok(result);
                }
            }
            Err(_) => {}
        }
        Err(format!("node `{}`: a step does not end within {} ms", seat.node, patience.as_millis()))
    }

    /// The state of a node, with its version.
    pub fn snapshot(&self, seat: &SeatName, patience: Duration) -> Result<(u32, Vec<u8>), String> {
        self.at(seat, patience, |slot, _, _| (slot.node.snapshot(), After::Nothing))?
            .map_err(|error| format!("its state cannot be written: {error}"))
    }

    /// What the active instance publishes goes to `hear` as well; `None`: no longer.
    pub fn tap(&self, seat: &SeatName, hear: Option<MutedOutput>, patience: Duration) -> Result<(), String> {
        self.at(seat, patience, |slot, _, _| (slot.tap = hear, After::Nothing))
    }

    /// What the outputs of all nodes here have sent, by name.
    pub fn outputs(&self, patience: Duration) -> Result<Vec<(String, Positions)>, String> {
        let seats: Vec<SeatName> =
            lock(&self.seats).iter().map(|seat| SeatName { node: seat.node.clone(), number: seat.number }).collect();
        let mut all = Vec::new();
        for seat in seats {
            all.extend(self.at(&seat, patience, |slot, _, _| {
                let sent = if slot.role.is_the_node() { slot.node.sent() } else { Vec::new() };
                (sent, After::Nothing)
            })?);
        }
        Ok(all)
    }

    /// A candidate gets every sample of these outputs from these positions on; what was sent before, its predecessor must have.
    pub fn expect_before(&self, seat: &SeatName, outputs: &[(String, Positions)]) {
        let mut seats = lock(&self.seats);
        let own = seats.iter_mut().find(|other| other.node == seat.node && other.number == seat.number);
        if let Some(own) = own {
            own.expect_before(outputs);
        }
    }

    /// A candidate takes nothing from now on. From where on it has everything, by input.
    pub fn hold(&self, seat: &SeatName, patience: Duration) -> Result<Vec<(String, Positions)>, String> {
        let mut positions = self.at(seat, patience, |slot, _, _| (slot.hold(), After::Nothing))??;
        let seats = lock(&self.seats);
        let own = seats.iter().find(|other| other.node == seat.node && other.number == seat.number);
        for (input, before) in own.iter().flat_map(|own| &own.expected_before) {
            if let Some((_, position)) = positions.iter_mut().find(|(port, _)| port == input) {
                position.merge(before);
            }
        }
        Ok(positions)
    }

    /// The active instance stops as soon as it has received `at_least`, and hands over; with its latencies of late.
    pub fn freeze(
        &self,
        seat: &SeatName,
        at_least: &[(String, Positions)],
        terms: FreezeTerms,
        patience: Duration,
    ) -> Result<(Handover, Option<Percentiles>), String> {
        let (deadline, wanted) = (Instant::now() + patience, at_least);
        loop {
            let at_least = at_least.to_vec();
            let frozen = self.at(seat, patience.min(STEP_PATIENCE), move |slot, around, due| {
                let latency = slot.node.recent_latency_us();
                let frozen = slot.freeze(&at_least, terms, (due, around));
                (frozen.map(|handover| handover.map(|handover| (handover, latency))), After::Nothing)
            })??;
            if let Some(frozen) = frozen {
                return Ok(frozen);
            }
            if Instant::now() >= deadline {
                let has = self.at(seat, STEP_PATIENCE, |slot, _, _| (slot.node.received(), After::Nothing))?;
                return Err(format!(
                    "node `{}` did not receive what its successor has received within {} ms: it has {has:?}, needed is \
                     {wanted:?}",
                    seat.node,
                    patience.as_millis()
                ));
            }
            std::thread::sleep(FREEZE_POLL);
        }
    }

    /// A candidate becomes the node, on probation.
    pub fn activate(
        &self,
        seat: &SeatName,
        handover: Handover,
        terms: ProbationTerms,
        patience: Duration,
    ) -> Result<(), String> {
        self.at(seat, patience, move |slot, around, _| match slot.activate(handover, terms, around) {
            Ok(after) => (Ok(()), after),
            Err(reason) => (Err(reason), After::Nothing),
        })?
    }

    /// A successor has made a step. Comes on the transport's thread.
    pub fn hear_of_step(&self, seat: &SeatName, record: StepRecord) {
        if let Ok((group, index)) = self.place(seat) {
            let hear = move |slot: &mut Slot, around: &Surroundings, _: Option<Instant>| {
                slot.hear_of_step(record, around);
                After::Nothing
            };
            group.ask(Request::Do(index, Box::new(hear)));
        }
    }

    /// A predecessor is the node again.
    pub fn thaw(&self, seat: &SeatName, repeat_last: bool, patience: Duration) -> Result<(), String> {
        self.at(seat, patience, move |slot, around, _| (slot.thaw(repeat_last, around), After::Nothing))?
    }

    /// The sequence numbers that came out of an instance, by port; `with_successors`: and out of those that it follows, by their word.
    pub fn came_out(
        &self,
        seat: &SeatName,
        with_successors: bool,
        patience: Duration,
    ) -> Result<Vec<(String, Numbers)>, String> {
        self.at(seat, patience, move |slot, _, _| {
            let numbers = |output: &OutputPort| {
                let came_out = output.came_out.borrow();
                let numbers = if with_successors { &came_out.with_successors } else { &came_out.own };
                (output.port.to_owned(), numbers.clone())
            };
            (slot.outputs.iter().map(numbers).collect(), After::Nothing)
        })
    }

    /// A probation is over.
    pub fn commit(&self, seat: &SeatName, patience: Duration) -> Result<(), String> {
        self.at(seat, patience, |slot, _, _| (slot.commit(), After::Nothing))?;
        self.count();
        Ok(())
    }

    /// Takes an instance away. Nothing of it comes out any more, not even when a step of it hangs and ends later.
    pub fn retire(&self, seat: &SeatName, patience: Duration) -> Result<(), String> {
        let (group, _) = self.place(seat)?;
        let own = |other: &&Seat| other.node == seat.node && other.number == seat.number;
        let gate = lock(&self.seats).iter().find(own).map(|own| own.gate.clone());
        if let Some(gate) = gate {
            gate.shut();
        }
        let retired = self.at(seat, patience, |slot, _, _| (slot.retire(), After::Nothing));
        let gone = {
            let mut seats = lock(&self.seats);
            let at = seats.iter().position(|other| other.node == seat.node && other.number == seat.number);
            at.map(|at| seats.remove(at))
        };
        drop(gone);
        let last_of_its_group = !lock(&self.seats).iter().any(|other| Arc::ptr_eq(&other.group, &group));
        if last_of_its_group {
            group.stop();
            let mut threads = lock(&self.threads);
            let at = threads.iter().position(|(other, _)| Arc::ptr_eq(other, &group));
            let thread = at.map(|at| threads.swap_remove(at).1);
            drop(threads);
            match thread {
                // It ends when its step does, if ever.
                Some(thread) if retired.is_ok() => drop(thread.join()),
                _ => tracing::error!(
                    "node `{}`: a step of a failed version still runs in process `{}`",
                    seat.node,
                    self.process
                ),
            }
        }
        self.count();
        Ok(())
    }

    /// For how long the step of an instance has been running, and its oldest sample has been waiting. Asks no thread.
    pub fn busy_and_waiting(
        &self,
        seat: &SeatName,
        now: Stamp,
    ) -> Result<(Option<Duration>, Option<Duration>), String> {
        let seats = lock(&self.seats);
        let found = seats.iter().find(|other| other.node == seat.node && other.number == seat.number);
        let found = found.ok_or_else(|| format!("there is no instance {} of node `{}`", seat.number, seat.node))?;
        Ok((found.group.busy_for(), found.waiting_for(now)))
    }

    /// How the steps of an instance went.
    pub fn steps_of(&self, seat: &SeatName, patience: Duration) -> Option<Steps> {
        let steps = self.at(seat, patience, |slot, _, _| {
            let (good, failing) = slot.node.successes();
            let (failing, latency_us) = (failing.map(str::to_owned), slot.node.recent_latency_us());
            let down = slot.is_down().then(|| slot.node.state());
            let steps = Steps { good, failing, down, latency_us };
            (steps, After::Nothing)
        });
        steps.ok()
    }

    /// A node goes on with another configuration, between two steps.
    pub fn set_config(&self, seat: &SeatName, config: Value, patience: Duration) -> Result<(), String> {
        self.at(seat, patience, move |slot, _, _| match slot.set_config(config) {
            Ok(after) => (Ok(()), after),
            Err(reason) => (Err(reason), After::Nothing),
        })?
    }

    /// Whether there is an instance of a node left.
    pub fn is_empty(&self) -> bool {
        lock(&self.seats).is_empty()
    }

    fn count(&self) {
        let mut nodes = self.local_nodes();
        nodes.sort();
        nodes.dedup();
        self.alone.store(nodes.len() == 1, Ordering::Relaxed);
    }
}
