//! The nodes that share one thread: who steps when.
//!
//! Whoever has something for a node raises its flag and then tries to take the group's lock. If it gets the lock it runs the
//! node; if not, whoever holds the lock looks at the flags again after letting go. So no wake-up is lost, and none is needed
//! while somebody is at work.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering, fence};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, TryLockError};
use std::thread::{JoinHandle, Thread};
use std::time::{Duration, Instant};

use carril_messages::{Control, Health};

use super::role::Role;
use super::slot::{After, Slot, Surroundings};
use crate::operator::Trigger;
use crate::realtime;

/// A triggering input has something.
const INPUT: u8 = 1;
/// A driver's thread called the waker.
const WAKE: u8 = 2;
/// Nothing to do: look again after this time anyway.
const IDLE: Duration = Duration::from_secs(3600);

/// A question to all nodes of a group, answered by its thread.
pub(super) enum Request {
    /// Hear this, and say who heard it.
    Control(Control, Sender<Heard>),
    /// How do you do? `None`: this instance is not the node.
    Health(Sender<Option<Health>>),
    /// Do this to a node, between two steps. Told: when its next period is due.
    Do(usize, Work),
}

/// Something to do to a node.
pub(super) type Work = Box<dyn FnOnce(&mut Slot, &Surroundings, Option<Instant>) -> After + Send>;

/// A node has heard a word.
pub(super) struct Heard {
    pub node: String,
    /// This instance is the node that the graph sees.
    pub is_the_node: bool,
}

/// Some nodes and their thread.
pub(super) struct Group {
    names: Vec<String>,
    /// SCHED_FIFO priority and cores, for a node that has a thread of its own.
    realtime: Option<(Option<u8>, Vec<usize>)>,
    flags: Vec<AtomicU8>,
    /// Steps of the node are too long for the transport's thread.
    long: Vec<AtomicBool>,
    requests: Mutex<VecDeque<Request>>,
    asked: AtomicBool,
    stopping: AtomicBool,
    /// Since when a step runs, ns on the machine's clock since the group was made; 0: none does.
    busy_since_ns: AtomicU64,
    made: Instant,
    thread: OnceLock<Thread>,
    core: Mutex<Core>,
}

#[derive(Default)]
struct Core {
    slots: Vec<Slot>,
    timers: BinaryHeap<Reverse<(Instant, usize, Alarm)>>,
    around: Option<Surroundings>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Alarm {
    Period,
    Revive,
}

/// On whose thread the nodes run.
#[derive(Clone, Copy, PartialEq, Eq)]
enum On {
    OwnThread,
    TransportThread,
}

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Starts the thread of a group.
pub(super) fn spawn(group: &Arc<Group>) -> std::io::Result<JoinHandle<()>> {
    let own = Arc::clone(group);
    let handle = std::thread::Builder::new().name(group.name()).spawn(move || own.run())?;
    // The thread may have set it already.
    let _ = group.thread.set(handle.thread().clone());
    group.unpark();
    Ok(handle)
}

impl Group {
    /// A group without its nodes: they need to know it before they can be built.
    pub(super) fn new(names: Vec<String>, realtime: Option<(Option<u8>, Vec<usize>)>) -> Arc<Self> {
        Arc::new(Self {
            realtime,
            flags: names.iter().map(|_| AtomicU8::new(0)).collect(),
            long: names.iter().map(|_| AtomicBool::new(false)).collect(),
            names,
            requests: Mutex::default(),
            asked: AtomicBool::new(false),
            stopping: AtomicBool::new(false),
            busy_since_ns: AtomicU64::new(0),
            made: Instant::now(),
            thread: OnceLock::new(),
            core: Mutex::default(),
        })
    }

    /// Puts the nodes in, in the order of the names.
    pub(super) fn fill(&self, slots: Vec<Slot>, around: Surroundings) {
        for (long, slot) in self.long.iter().zip(&slots) {
            long.store(!slot.is_short(), Ordering::Relaxed);
        }
        *lock(&self.core) = Core { slots, timers: BinaryHeap::new(), around: Some(around) };
    }

    /// Name of its first node.
    pub(super) fn name(&self) -> String {
        self.names.first().cloned().unwrap_or_default()
    }

    /// Its nodes.
    pub(super) fn nodes(&self) -> &[String] {
        &self.names
    }

    /// A node of this process has put something into a triggering mailbox. `own`: a node of this very group, whose runner looks
    /// at the flags again before it rests.
    pub(super) fn input_from_within(&self, index: usize, own: bool) {
        self.flags[index].fetch_or(INPUT, Ordering::SeqCst);
        if !own {
            self.unpark();
        }
    }

    /// The transport has put something into a triggering mailbox. Runs the step here if that is possible and quick.
    pub(super) fn input_from_outside(&self, index: usize) {
        self.flags[index].fetch_or(INPUT, Ordering::SeqCst);
        if self.realtime.is_some() || self.long[index].load(Ordering::Relaxed) {
            self.unpark();
            return;
        }
        loop {
            fence(Ordering::SeqCst);
            let mut core = match self.core.try_lock() {
                Ok(core) => core,
                Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
                Err(TryLockError::WouldBlock) => return,
            };
            let timers = core.timers.len();
            core.run_flagged(self, On::TransportThread);
            let new_timer = core.timers.len() != timers;
            drop(core);
            fence(Ordering::SeqCst);
            let short_one_waits = || {
                let waiting = |index: usize| self.flags[index].load(Ordering::Relaxed) == INPUT;
                (0..self.flags.len()).any(|index| waiting(index) && !self.long[index].load(Ordering::Relaxed))
            };
            if new_timer || self.asked.load(Ordering::Relaxed) || !short_one_waits() {
                if new_timer || self.has_work() {
                    self.unpark();
                }
                return;
            }
        }
    }

    /// A driver's thread has something for a node.
    pub(super) fn wake(&self, index: usize) {
        self.flags[index].fetch_or(WAKE, Ordering::SeqCst);
        self.unpark();
    }

    /// Asks the thread.
    pub(super) fn ask(&self, request: Request) {
        lock(&self.requests).push_back(request);
        self.asked.store(true, Ordering::SeqCst);
        self.unpark();
    }

    /// For how long the step that runs now has been running.
    pub(super) fn busy_for(&self) -> Option<Duration> {
        let since = self.busy_since_ns.load(Ordering::Relaxed);
        (since != 0).then(|| self.made.elapsed().saturating_sub(Duration::from_nanos(since)))
    }

    /// Lets the running step end, then the thread.
    pub(super) fn stop(&self) {
        self.stopping.store(true, Ordering::SeqCst);
        self.unpark();
    }

    fn unpark(&self) {
        if let Some(thread) = self.thread.get() {
            thread.unpark();
        }
    }

    fn has_work(&self) -> bool {
        self.asked.load(Ordering::Relaxed) || self.flags.iter().any(|flags| flags.load(Ordering::Relaxed) != 0)
    }

    fn run(&self) {
        let _ = self.thread.set(std::thread::current());
        let (priority, cpus) = self.realtime.clone().unwrap_or_default();
        for warning in realtime::apply_to_thread(&self.name(), priority, &cpus) {
            tracing::warn!("{warning}");
        }
        lock(&self.core).start_periods();
        while !self.stopping.load(Ordering::SeqCst) {
            let next = {
                let mut core = lock(&self.core);
                core.turn(self);
                core.timers.peek().map(|Reverse((due, ..))| *due)
            };
            fence(Ordering::SeqCst);
            if !self.has_work() {
                let pause = next.map_or(IDLE, |due| due.saturating_duration_since(Instant::now()));
                std::thread::park_timeout(pause);
            }
        }
        // Operators end on their own thread: they may hold devices.
        lock(&self.core).slots.clear();
    }

    fn take_requests(&self) -> VecDeque<Request> {
        self.asked.store(false, Ordering::SeqCst);
        std::mem::take(&mut lock(&self.requests))
    }
}

impl Core {
    fn start_periods(&mut self) {
        let now = Instant::now();
        for (index, slot) in self.slots.iter().enumerate() {
            if slot.period.is_some() {
                self.timers.push(Reverse((now, index, Alarm::Period)));
            }
        }
    }

    /// Does all there is to do.
    fn turn(&mut self, group: &Group) {
        loop {
            let mut busy = false;
            for request in group.take_requests() {
                busy = true;
                self.serve(group, request);
            }
            busy |= self.run_due(group);
            busy |= self.run_flagged(group, On::OwnThread);
            if !busy || group.stopping.load(Ordering::Relaxed) {
                return;
            }
        }
    }

    fn serve(&mut self, group: &Group, request: Request) {
        if let Request::Do(index, work) = request {
            let due = self.period_due(index);
            let (Some(around), Some(slot)) = (&self.around, self.slots.get_mut(index)) else { return };
            let after = work(slot, around, due);
            if slot.node.triggered() {
                group.flags[index].fetch_or(INPUT, Ordering::SeqCst);
            }
            self.follow(group, index, after);
            return;
        }
        for index in 0..self.slots.len() {
            let Some(around) = &self.around else { return };
            let slot = &mut self.slots[index];
            match &request {
                Request::Control(control, heard) => {
                    let is_the_node = slot.role.is_the_node();
                    let (did_hear, after) = slot.control(*control, around);
                    if did_hear {
                        // Whoever asked may have stopped waiting.
                        let _ = heard.send(Heard { node: slot.node.name().to_owned(), is_the_node });
                    }
                    self.follow(group, index, after);
                }
                Request::Health(reply) => {
                    let health = slot.role.is_the_node().then(|| slot.health(around));
                    let _ = reply.send(health);
                }
                Request::Do(..) => {}
            }
        }
    }

    fn period_due(&self, index: usize) -> Option<Instant> {
        let alarms = self.timers.iter().map(|Reverse(alarm)| alarm);
        alarms.filter(|(_, at, alarm)| (*at, *alarm) == (index, Alarm::Period)).map(|(due, ..)| *due).min()
    }

    /// Runs the nodes whose flags are up, in the order of the graph. `true`: there was something to do.
    fn run_flagged(&mut self, group: &Group, on: On) -> bool {
        let mut busy = false;
        for index in 0..self.slots.len() {
            let flags = &group.flags[index];
            let raised = flags.load(Ordering::Relaxed);
            if raised == 0 || (on == On::TransportThread && (raised & WAKE != 0 || !self.slots[index].is_short())) {
                continue;
            }
            busy = true;
            let raised = flags.swap(0, Ordering::SeqCst);
            if raised & WAKE != 0 {
                self.step(group, index, Trigger::Wake);
            }
            if let (Role::Following(_), Some(around)) = (&self.slots[index].role, &self.around) {
                // What it waits for may have come.
                self.slots[index].follow(around);
            } else if raised & INPUT != 0 && self.slots[index].node.triggered() {
                self.step(group, index, Trigger::Input);
            }
            if group.asked.load(Ordering::Relaxed) {
                return true;
            }
        }
        busy
    }

    fn run_due(&mut self, group: &Group) -> bool {
        let mut busy = false;
        while let Some(Reverse((due, index, alarm))) = self.timers.peek().copied() {
            let now = Instant::now();
            if due > now || group.asked.load(Ordering::Relaxed) {
                break;
            }
            busy = true;
            self.timers.pop();
            match alarm {
                Alarm::Period => self.period(group, index, due, now),
                Alarm::Revive => {
                    let Some(around) = &self.around else { return busy };
                    let after = self.slots[index].revive(around);
                    group.flags[index].fetch_or(INPUT, Ordering::SeqCst);
                    self.follow(group, index, after);
                }
            }
        }
        busy
    }

    /// A period has come. Times are absolute, so that nothing drifts; what was missed is counted, not caught up.
    fn period(&mut self, group: &Group, index: usize, due: Instant, now: Instant) {
        let slot = &mut self.slots[index];
        let Some(period) = slot.period.filter(|period| !period.is_zero()) else { return };
        let missed = now.duration_since(due).as_nanos() / period.as_nanos();
        let missed = u32::try_from(missed).unwrap_or(u32::MAX - 1);
        if slot.role.steps() {
            slot.node.count_missed_periods(u64::from(missed));
        }
        let next = due + period * (missed + 1);
        let skip = self.step(group, index, Trigger::Period) == After::SkipPeriod;
        let next = if skip { next + period } else { next };
        self.timers.push(Reverse((next, index, Alarm::Period)));
    }

    fn step(&mut self, group: &Group, index: usize, trigger: Trigger) -> After {
        let Some(around) = &self.around else { return After::Nothing };
        let slot = &mut self.slots[index];
        if slot.is_down() {
            return After::Nothing;
        }
        let began = group.made.elapsed().as_nanos().max(1) as u64;
        group.busy_since_ns.store(began, Ordering::Relaxed);
        let after = slot.step(trigger, around);
        group.busy_since_ns.store(0, Ordering::Relaxed);
        if slot.node.has_backlog() && slot.role.steps() {
            group.flags[index].fetch_or(INPUT, Ordering::SeqCst);
        }
        self.follow(group, index, after);
        after
    }

    fn follow(&mut self, group: &Group, index: usize, after: After) {
        group.long[index].store(!self.slots[index].is_short(), Ordering::Relaxed);
        match after {
            After::ReviveAt(due) => self.timers.push(Reverse((due, index, Alarm::Revive))),
            After::PeriodAt(due) => {
                self.timers.retain(|Reverse((_, at, alarm))| (*at, *alarm) != (index, Alarm::Period));
                self.timers.push(Reverse((due, index, Alarm::Period)));
            }
            After::Nothing | After::SkipPeriod => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicI64;
    use std::sync::mpsc::channel;

    use carril_messages::Stamp;
    use serde::{Deserialize, Serialize};

    use super::super::slot::Recipe;
    use super::*;
    use crate::backoff::Restarts;
    use crate::clock::Clock;
    use crate::graph::{OnOverrun, Restart};
    use crate::node::Node;
    use crate::operator::{Context, Operator, SetupError, StepError};
    use crate::ports::{NoInputs, NoOutputs};
    use crate::setup::{HeapPool, Setup};
    use crate::{Findings, OperatorConfig, OperatorKind};

    const PERIOD: Duration = Duration::from_millis(10);

    #[derive(Serialize, Deserialize, schemars::JsonSchema)]
    struct Nothing {}

    impl OperatorConfig for Nothing {
        fn check(&self, _: &mut Findings<'_>) {}
    }

    struct Idle;

    impl Operator for Idle {
        const KIND: &'static str = "idle";
        const SUMMARY: &'static str = "does nothing";
        type Config = Nothing;
        type Inputs = NoInputs;
        type Outputs = NoOutputs;

        fn new(_: Nothing, _: &Setup) -> Result<Self, SetupError> {
            Ok(Self)
        }

        fn step(&mut self, _: &mut NoInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
            Ok(())
        }

        crate::stateless!();
    }

    /// 1 ms passes whenever somebody looks: so a step takes 1 ms.
    #[derive(Default)]
    struct Hasty(AtomicI64);

    impl Clock for Hasty {
        fn now(&self) -> Stamp {
            Stamp::from_nanos(self.0.fetch_add(1_000_000, Ordering::Relaxed))
        }
    }

    /// When the period after the one at `due` comes, for a node whose step began `late` and takes 1 ms.
    fn next_period(on_overrun: OnOverrun, deadline: Duration, late: Duration) -> Duration {
        let recipe = Recipe {
            kind: Arc::new(OperatorKind::of::<Idle>()),
            config: serde_json::json!({}),
            setup: Setup::for_tests("idle"),
        };
        let operator = recipe.build().expect("it needs nothing");
        let node = Node::new("idle", "idle", operator, Vec::new(), Vec::new(), Some(deadline), 1);
        let restarts = Restarts::new(Restart::default());
        let slot = Slot::new(node, Vec::new(), (Some(PERIOD), on_overrun), recipe, restarts);
        let (events, _heard) = channel();
        let clock = Arc::new(Hasty::default());
        let around = Surroundings { clock, buffers: Arc::new(HeapPool), events, alone: Arc::default() };
        let group = Group::new(vec!["idle".into()], None);
        group.fill(vec![slot], around);
        let (mut core, due) = (lock(&group.core), Instant::now());
        core.period(&group, 0, due, due + late);
        core.timers.peek().map_or(Duration::MAX, |Reverse((next, ..))| *next - due)
    }

    #[test]
    fn an_overrun_that_skips_leaves_out_one_period() {
        let (short, long) = (Duration::from_micros(500), Duration::from_millis(2));
        let on_time = Duration::ZERO;
        assert_eq!(next_period(OnOverrun::Skip, short, on_time), PERIOD * 2, "too long: one is left out");
        assert_eq!(next_period(OnOverrun::Skip, long, on_time), PERIOD, "within the deadline: none");
        assert_eq!(next_period(OnOverrun::Warn, short, on_time), PERIOD, "only told: none");
        let late = PERIOD * 3 + PERIOD / 2;
        assert_eq!(next_period(OnOverrun::Warn, short, late), PERIOD * 4, "what was missed is not caught up");
        assert_eq!(next_period(OnOverrun::Skip, short, late), PERIOD * 5, "and one more is left out");
    }

    #[test]
    fn alarms_come_in_the_order_of_their_times() {
        let start = Instant::now();
        let mut timers = BinaryHeap::new();
        for (ms, index) in [(30, 0), (10, 1), (20, 2)] {
            timers.push(Reverse((start + Duration::from_millis(ms), index, Alarm::Period)));
        }
        let order: Vec<usize> = std::iter::from_fn(|| timers.pop()).map(|Reverse((_, index, _))| index).collect();
        assert_eq!(order, [1, 2, 0], "the earliest first");
    }
}
