//! One node in its place: runs its steps, passes its outputs on, and acts on overruns, broken budgets and panics.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use carril_messages::{Control, Header, Health, NodeState};
use serde_json::Value;

use super::group::Group;
use super::role::{Gate, MutedOutput, Role};
use super::router::Readers;
use super::{Events, NodeEvent};
use crate::backoff::{Restarts, Verdict};
use crate::clock::Clock;
use crate::control_plane::FaultReport;
use crate::graph::OnOverrun;
use crate::node::{Node, Published, StepReport};
use crate::numbers::Numbers;
use crate::operator::{SetupError, Trigger};
use crate::ports::AnyMessage;
use crate::registry::{ErasedOperator, OperatorKind};
use crate::setup::{BufferPool, Setup};
use crate::transport::Publisher;

/// A step up to this long may run on the transport's thread: shorter than the wake-up of another thread would take.
const SHORT_STEP: Duration = Duration::from_micros(300);
/// So many short steps in a row make a node short: at first, and after a long one. A node that hangs in its first steps hangs on
/// its own thread, not on one that its process also needs to be spoken to.
const SHORT_STEPS_TO_TRUST: u32 = 64;
/// The same complaint of a node is logged at most this often.
const LOG_PAUSE: Duration = Duration::from_secs(5);

/// Builds the operator, at first and anew.
#[derive(Clone)]
pub(super) struct Recipe {
    pub kind: Arc<OperatorKind>,
    pub config: Value,
    pub setup: Setup,
}

impl Recipe {
    pub(super) fn build(&self) -> Result<Box<dyn ErasedOperator>, SetupError> {
        let built = catch_unwind(AssertUnwindSafe(|| self.kind.build(self.config.clone(), &self.setup)));
        built.unwrap_or_else(|panic| Err(SetupError::new(format!("it panicked: {}", text_of(panic.as_ref())))))
    }

    /// Whether an instance holds something that no second one can have.
    pub(super) fn exclusive(&self) -> bool {
        self.kind.exclusive(&self.config)
    }
}

/// What a panic said.
pub(super) fn text_of(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no message".into())
}

/// Where an output port leads.
pub(super) struct OutputPort {
    /// Name of the port: `lane`.
    pub port: &'static str,
    /// With its node: `lane/lane`.
    pub name: String,
    pub readers: Arc<Readers>,
    /// The group of its node: a reader on the same thread needs no wake-up.
    pub group: std::sync::Weak<Group>,
    pub publisher: Box<dyn Publisher>,
    /// Publishing may have to wait for a reader.
    pub reliable: bool,
    pub complained: AtomicBool,
    pub came_out: RefCell<CameOut>,
    /// Of payload, passed on to readers in other processes.
    pub bytes: Cell<u64>,
}

/// The sequence numbers that came out of a port.
#[derive(Default)]
pub(super) struct CameOut {
    /// From this instance.
    pub own: Numbers,
    /// From this instance and, by their word, from the successors that it follows.
    pub with_successors: Numbers,
}

impl OutputPort {
    pub(super) fn wanted(&self) -> bool {
        !self.readers.is_empty() || self.publisher.matched()
    }

    pub(super) fn publish(&self, header: &Arc<Header>, message: &Arc<dyn AnyMessage>) {
        let mut came_out = self.came_out.borrow_mut();
        came_out.own.add(header.epoch, header.seq);
        came_out.with_successors.add(header.epoch, header.seq);
        drop(came_out);
        self.readers.give(self.group.as_ptr(), header, message);
        if !self.publisher.matched() {
            return;
        }
        match self.publisher.publish(header, message.as_ref()) {
            Ok(bytes) => self.bytes.set(self.bytes.get() + bytes as u64),
            Err(error) if !self.complained.swap(true, Ordering::Relaxed) => {
                tracing::warn!("output `{}`: {error}; further failures are not logged", self.name);
            }
            Err(_) => {}
        }
    }
}

/// What the nodes of a group share.
pub(super) struct Surroundings {
    pub clock: Arc<dyn Clock>,
    pub buffers: Arc<dyn BufferPool>,
    pub events: Events,
    /// The process has only one node.
    pub alone: Arc<AtomicBool>,
}

/// What the group has to do after a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum After {
    /// Go on.
    Nothing,
    /// Leave out the next period.
    SkipPeriod,
    /// Revive the node then.
    ReviveAt(Instant),
    /// The next period begins then.
    PeriodAt(Instant),
}

/// A node in its place.
pub(super) struct Slot {
    pub node: Node,
    pub outputs: Vec<OutputPort>,
    pub period: Option<Duration>,
    pub on_overrun: OnOverrun,
    pub recipe: Recipe,
    pub restarts: Restarts,
    pub span: tracing::Span,
    pub role: Role,
    pub gate: Gate,
    /// Hears what it publishes: somebody compares.
    pub tap: Option<MutedOutput>,
    /// Its operator is gone, and so is what it held.
    pub vacant: bool,
    /// Its state when it handed over, for the case that it must be built anew.
    pub handed_state: Option<(u32, Vec<u8>)>,
    /// Which instance of the node this is; 0: the first of this process.
    pub seat: u32,
    state: State,
}

struct State {
    down: bool,
    /// A fault was reported; no other until `reset`.
    faulted: bool,
    short_steps_to_go: u32,
    last_logged: Option<Instant>,
}

impl Default for State {
    fn default() -> Self {
        Self { down: false, faulted: false, short_steps_to_go: SHORT_STEPS_TO_TRUST, last_logged: None }
    }
}

impl Slot {
    pub(super) fn new(
        node: Node,
        outputs: Vec<OutputPort>,
        (period, on_overrun): (Option<Duration>, OnOverrun),
        recipe: Recipe,
        restarts: Restarts,
    ) -> Self {
        let span = tracing::error_span!("node", name = node.name());
        Self {
            node,
            outputs,
            period,
            on_overrun,
            recipe,
            restarts,
            span,
            role: Role::Active,
            gate: Gate::new(),
            tap: None,
            vacant: false,
            handed_state: None,
            seat: 0,
            state: State::default(),
        }
    }

    /// Whether the node panicked and is not back yet.
    pub(super) fn is_down(&self) -> bool {
        self.state.down
    }

    /// Whether its steps are short enough for the transport's thread. Those that may wait for a reader never are: what the
    /// reader says would come in on that very thread.
    pub(super) fn is_short(&self) -> bool {
        self.state.short_steps_to_go == 0 && !self.outputs.iter().any(|output| output.reliable)
    }

    /// Passes on a word from a person; `false` when the node is down.
    pub(super) fn control(&mut self, control: Control, around: &Surroundings) -> (bool, After) {
        if matches!(self.role, Role::Retired) {
            return (true, After::Nothing);
        }
        if self.state.down {
            return (false, After::Nothing);
        }
        if let Role::Held(words) = &mut self.role {
            words.push(control);
            return (true, After::Nothing);
        }
        if control == Control::Reset {
            self.state.faulted = false;
        }
        let now = around.clock.now();
        let heard = catch_unwind(AssertUnwindSafe(|| self.node.control(control, now)));
        match heard {
            Ok(()) => (true, self.step(Trigger::Control, around)),
            Err(panic) => (false, self.panicked(panic.as_ref(), around)),
        }
    }

    /// Runs a step and acts on what came of it, if it is this instance's time to step.
    pub(super) fn step(&mut self, trigger: Trigger, around: &Surroundings) -> After {
        match &self.role {
            Role::Active => match self.run(trigger, around) {
                Ok(report) => self.judge(&report, around),
                Err(panic) => self.panicked(panic.as_ref(), around),
            },
            Role::Probation(_) => self.step_on_probation(trigger, around),
            Role::Shadow(_) => self.step_in_shadow(trigger, around),
            Role::Held(_) | Role::Following(_) | Role::Resting | Role::Retired => After::Nothing,
        }
    }

    fn run(&mut self, trigger: Trigger, around: &Surroundings) -> Result<StepReport, Box<dyn Any + Send>> {
        let _in_span = self.span.enter();
        let (node, outputs, gate, tap) = (&mut self.node, &self.outputs, &self.gate, &self.tap);
        let clock = around.clock.as_ref();
        catch_unwind(AssertUnwindSafe(|| {
            node.set_wanted(&|port| outputs[port].wanted());
            node.step(clock.now(), trigger, around.buffers.as_ref(), &|_| clock.now(), &mut |sample| {
                gate.pass(|| outputs[sample.port].publish(&sample.header, &sample.message));
                if let Some(hear) = tap {
                    hear(outputs[sample.port].port, &sample.header, &sample.message);
                }
            })
        }))
    }

    /// Runs a step and keeps back what it sends.
    pub(super) fn run_quietly(
        &mut self,
        trigger: Trigger,
        around: &Surroundings,
    ) -> Result<(StepReport, Vec<Published>), String> {
        let _in_span = self.span.enter();
        let (node, outputs, clock) = (&mut self.node, &self.outputs, around.clock.as_ref());
        let mut sent = Vec::new();
        let report = catch_unwind(AssertUnwindSafe(|| {
            node.set_wanted(&|port| outputs[port].wanted());
            node.step(clock.now(), trigger, around.buffers.as_ref(), &|_| clock.now(), &mut |s| sent.push(s))
        }));
        match report {
            Ok(report) => Ok((report, sent)),
            Err(panic) => Err(format!("a step panicked: {}", text_of(panic.as_ref()))),
        }
    }

    /// The operator panicked while nobody relied on it.
    pub(super) fn break_down(&mut self) {
        self.state.down = true;
    }

    fn judge(&mut self, report: &StepReport, around: &Surroundings) -> After {
        self.state.short_steps_to_go = if report.took > SHORT_STEP {
            SHORT_STEPS_TO_TRUST
        } else {
            self.state.short_steps_to_go.saturating_sub(1)
        };
        if let Some(error) = &report.error {
            self.complain(&format!("step failed: {error}"));
        }
        if let Some(stop) = &report.stop {
            let (age, max) = (stop.age.as_secs_f64() * 1e3, stop.max_age.as_secs_f64() * 1e3);
            self.fault(format!("port `{}`: samples are {age:.1} ms old, allowed are {max} ms", stop.port), around);
        }
        if !report.overrun {
            return After::Nothing;
        }
        let took = format!("a step took {:.3} ms, longer than its deadline", report.took.as_secs_f64() * 1e3);
        self.complain(&took);
        match self.on_overrun {
            OnOverrun::Warn => After::Nothing,
            OnOverrun::Skip => {
                self.node.mailboxes().iter().for_each(|mailbox| mailbox.clear());
                After::SkipPeriod
            }
            OnOverrun::Stop => {
                self.fault(took, around);
                After::Nothing
            }
        }
    }

    /// Stops this node at once, and has the process stop the car. Said once until `reset`.
    fn fault(&mut self, reason: String, around: &Surroundings) {
        if !self.state.faulted {
            self.state.faulted = true;
            let node = self.node.name().to_owned();
            tracing::error!("node `{node}` stops the car: {reason}");
            let (node_at_work, now) = (&mut self.node, around.clock.now());
            let _ = catch_unwind(AssertUnwindSafe(|| node_at_work.control(Control::EStop, now)));
            // The step that acts on it; what it reports is of the same kind as what brought us here.
            drop(self.run(Trigger::Control, around));
            // The process may be on its way down; then nobody is left to tell.
            let _ = around.events.send(NodeEvent::Fault(FaultReport { node, reason }));
        }
        self.node.set_state(NodeState::Faulted, around.clock.now());
    }

    fn panicked(&mut self, panic: &(dyn Any + Send), around: &Surroundings) -> After {
        let message = text_of(panic);
        if !matches!(self.role, Role::Active) {
            return self.fail_trial(format!("it panicked: {message}"), around);
        }
        let node = self.node.name().to_owned();
        self.state.down = true;
        let alone = around.alone.load(Ordering::Relaxed);
        let _ = around.events.send(NodeEvent::Panicked { node, message: message.clone(), alone });
        if alone { After::Nothing } else { self.schedule(&format!("a step panicked: {message}"), around) }
    }

    fn schedule(&mut self, reason: &str, around: &Surroundings) -> After {
        let (name, now, stamp) = (self.node.name(), Instant::now(), around.clock.now());
        match self.restarts.ended(true, now) {
            Verdict::After(pause) => {
                tracing::error!("node `{name}`: {reason}; it is built anew in {} ms", pause.as_millis());
                self.node.set_state(NodeState::Restarting, stamp);
                After::ReviveAt(now + pause)
            }
            Verdict::StayDown => {
                tracing::error!("node `{name}`: {reason}; its restart policy leaves it down");
                self.node.set_state(NodeState::Stopped, stamp);
                After::Nothing
            }
            Verdict::GiveUp => {
                let limit = self.restarts.limit();
                tracing::error!(
                    "node `{name}`: {reason}; given up, it was built anew {limit}; start it again: carril restart {name}"
                );
                self.node.set_state(NodeState::GaveUp, stamp);
                After::Nothing
            }
        }
    }

    /// Puts a fresh operator in the place of the one that panicked.
    pub(super) fn revive(&mut self, around: &Surroundings) -> After {
        match self.recipe.build() {
            Ok(operator) => {
                // The old operator may panic once more while it is dropped.
                let (node, now) = (&mut self.node, around.clock.now());
                let _ = catch_unwind(AssertUnwindSafe(|| node.revive(operator, now)));
                self.state = State::default();
                After::Nothing
            }
            Err(error) => self.schedule(&format!("it cannot be built: {error}"), around),
        }
    }

    /// How the node did since the last call.
    pub(super) fn health(&mut self, around: &Surroundings) -> Health {
        let outputs = &self.outputs;
        let health = self.node.take_health(around.clock.now(), &|port| outputs[port].bytes.get());
        Health { restarts: self.restarts.total(), ..health }
    }

    fn complain(&mut self, what: &str) {
        let now = Instant::now();
        if self.state.last_logged.is_none_or(|last| now.duration_since(last) >= LOG_PAUSE) {
            self.state.last_logged = Some(now);
            tracing::warn!("node `{}`: {what}", self.node.name());
        }
    }
}
