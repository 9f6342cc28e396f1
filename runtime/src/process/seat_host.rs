//! Answers what the supervisor asks while a node of this process is replaced, or is to come here.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use carril_messages::{Header, Key};

use crate::clock::Clock;
use crate::executor::live::{Executor, FreezeTerms, MutedOutput, ProbationTerms, RETIRE_PATIENCE, STEP_PATIENCE};
use crate::handover::Handover;
use crate::positions::Positions;
use crate::realtime;
use crate::registry::Registry;
use crate::seats::{
    HandedOver, NotTakenOver, SeatAnswer, SeatName, SeatQuestion, SeatStatus, ToldStep, TrialTerms, decode, encode,
    seat_key, steps_key,
};
use crate::shadow::Comparer;
use crate::supervisor::plan::Plan;
use crate::transport::Guard;
use crate::transport::zenoh::{Question, ZenohTransport};

/// An instance that is to stop goes on for so long at most, until it has received what its successor has received.
pub(crate) const CATCH_UP_PATIENCE: Duration = Duration::from_secs(2);
/// A neighbour that has not answered after this is asked again.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// A neighbour has this long to answer.
const NEIGHBOUR_PATIENCE: Duration = Duration::from_secs(5);

/// What a candidate and its comparison need.
struct Trial {
    comparer: Arc<Comparer>,
    /// Ports to compare.
    ports: Vec<&'static str>,
    guards: Vec<Guard>,
    /// The active instance that is compared with, in this process.
    tapped: Option<SeatName>,
}

/// Answers questions about seats.
#[derive(Clone)]
pub(super) struct SeatHost(Arc<Inner>);

struct Inner {
    process: String,
    robot: String,
    executor: Arc<Executor>,
    transport: ZenohTransport,
    clock: Arc<dyn Clock>,
    registry: Registry,
    trials: Mutex<HashMap<(String, u32), Trial>>,
    /// Predecessors that hear of the steps of their successors.
    attending: Mutex<HashMap<(String, u32), Guard>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn id(seat: &SeatName) -> (String, u32) {
    (seat.node.clone(), seat.number)
}

impl SeatHost {
    pub(super) fn new(
        process: &str,
        robot: &str,
        executor: Arc<Executor>,
        transport: &ZenohTransport,
        clock: &Arc<dyn Clock>,
        registry: &Registry,
    ) -> Self {
        Self(Arc::new(Inner {
            process: process.to_owned(),
            robot: robot.to_owned(),
            executor,
            transport: transport.clone(),
            clock: Arc::clone(clock),
            registry: registry.clone(),
            trials: Mutex::default(),
            attending: Mutex::default(),
        }))
    }

    /// Answers on a thread of its own: building an operator may take its time.
    pub(super) fn hear(&self, question: Question) {
        let inner = Arc::clone(&self.0);
        std::thread::spawn(move || {
            let answer = decode::<SeatQuestion>(&question.bytes()).map_err(|error| error.to_string());
            let answer = answer.and_then(|asked| inner.answer(asked));
            question.answer(answer.and_then(|answer| encode(&answer).map_err(|error| error.to_string())));
        });
    }
}

impl Inner {
    fn answer(&self, question: SeatQuestion) -> Result<SeatAnswer, String> {
        let executor = &self.executor;
        match question {
            SeatQuestion::Outputs => executor.outputs(STEP_PATIENCE).map(SeatAnswer::Outputs),
            SeatQuestion::Snapshot(seat) => {
                let (version, state) = executor.snapshot(&seat, STEP_PATIENCE)?;
                Ok(SeatAnswer::State(version, state))
            }
            SeatQuestion::Prepare { seat, plan, state, may_err, neighbours } => {
                self.prepare(&seat, &plan, (state.as_ref(), may_err), &neighbours)
            }
            SeatQuestion::ListenOutsideTo(writer) => executor.listen_outside_to(&writer).map(|()| SeatAnswer::Done),
            SeatQuestion::Identity => Ok(SeatAnswer::Identity(self.transport.identity())),
            SeatQuestion::Connect { identity, endpoint } => {
                self.transport.connect(&identity, &endpoint).map_err(|error| error.to_string())?;
                Ok(SeatAnswer::Done)
            }
            SeatQuestion::ServeReliably { seat, port } => {
                executor.serve_reliably(&seat, &port, STEP_PATIENCE).map(|()| SeatAnswer::Done)
            }
            SeatQuestion::Compare { candidate, beside } => self.compare(&candidate, beside).map(|()| SeatAnswer::Done),
            SeatQuestion::Status(seat) => self.status(&seat).map(SeatAnswer::Status),
            SeatQuestion::Hold(seat) => executor.hold(&seat, STEP_PATIENCE).map(SeatAnswer::Held),
            SeatQuestion::Attend { seat, successor } => self.attend(&seat, successor).map(|()| SeatAnswer::Done),
            SeatQuestion::Freeze { seat, at_least, fresh, let_go, rests } => {
                let terms = FreezeTerms { fresh, let_go, rests };
                let (handover, latency) = executor.freeze(&seat, &at_least, terms, CATCH_UP_PATIENCE)?;
                Ok(SeatAnswer::Handover(Box::new(handover), latency))
            }
            SeatQuestion::Activate { seat, handover, trial } => {
                self.activate(&seat, *handover, trial).map(|()| SeatAnswer::Done)
            }
            SeatQuestion::TakeOver { candidate, active, fresh, let_go, rewired, trial } => {
                let freeze = FreezeTerms { fresh, let_go, rests: !rewired.is_empty() };
                Ok(SeatAnswer::TakenOver(self.take_over(&candidate, &active, freeze, &rewired, trial)))
            }
            SeatQuestion::CameOut { seat, with_successors } => {
                executor.came_out(&seat, with_successors, STEP_PATIENCE).map(SeatAnswer::CameOut)
            }
            SeatQuestion::Commit(seat) => executor.commit(&seat, STEP_PATIENCE).map(|()| SeatAnswer::Done),
            SeatQuestion::Thaw { seat, repeat_last } => {
                executor.thaw(&seat, repeat_last, STEP_PATIENCE)?;
                lock(&self.attending).remove(&id(&seat));
                Ok(SeatAnswer::Done)
            }
            SeatQuestion::Retire(seat) => {
                self.end_comparison(&seat);
                lock(&self.attending).remove(&id(&seat));
                executor.retire(&seat, RETIRE_PATIENCE).map(|()| SeatAnswer::Done)
            }
            SeatQuestion::SetConfig(seat, config) => {
                let config = serde_json::from_str(&config).map_err(|error| error.to_string())?;
                executor.set_config(&seat, config, STEP_PATIENCE).map(|()| SeatAnswer::Done)
            }
        }
    }

    fn prepare(
        &self,
        seat: &SeatName,
        plan: &str,
        (state, may_err): (Option<&(u32, Vec<u8>)>, bool),
        neighbours: &[String],
    ) -> Result<SeatAnswer, String> {
        let plan: Plan = serde_json::from_str(plan).map_err(|error| format!("the plan makes no sense: {error}"))?;
        let graph = plan.graph(&self.process, &self.registry).map_err(|error| error.to_string())?;
        if graph.node(&seat.node).is_some_and(|node| node.lock_memory)
            && let Some(warning) = realtime::lock_memory(&self.process)
        {
            tracing::warn!("{warning}");
        }
        let kind = graph.node(&seat.node).and_then(|node| node.kind());
        let specs = kind.map(|kind| kind.outputs.clone()).unwrap_or_default();
        let ports = specs.iter().filter(|spec| !spec.on_demand).map(|spec| spec.name).collect();
        let comparer = Arc::new(Comparer::default());
        let hear = Arc::clone(&comparer);
        let muted: MutedOutput = Arc::new(move |port, header, message| hear.candidate(port, header, message.as_ref()));
        let prepared = self.executor.prepare(&graph, seat, (state, may_err), muted)?;
        lock(&self.trials).insert(id(seat), Trial { comparer, ports, guards: Vec::new(), tapped: None });
        for neighbour in neighbours {
            let outputs = self.meet(neighbour)?;
            self.executor.expect_before(seat, &outputs);
        }
        Ok(SeatAnswer::Prepared { exclusive: prepared.exclusive, state_version: prepared.state_version })
    }

    /// Returns when a neighbour knows all that was declared here: its answer comes after that on the same link. It says how far
    /// its outputs were then.
    fn meet(&self, process: &str) -> Result<Vec<(String, Positions)>, String> {
        if process == self.process {
            return Ok(Vec::new());
        }
        let question = encode(&SeatQuestion::Outputs).map_err(|error| error.to_string())?;
        let deadline = std::time::Instant::now() + NEIGHBOUR_PATIENCE;
        loop {
            // Without a link there is no answer, at once; the link is coming up.
            let answers = self.transport.ask(&seat_key(&self.robot, process), question.clone(), ASK_AGAIN);
            match answers.map_err(|error| error.to_string())?.into_iter().next() {
                Some(answer) => {
                    return match decode(&answer?).map_err(|error| error.to_string())? {
                        SeatAnswer::Outputs(outputs) => Ok(outputs),
                        other => Err(format!("process `{process}`: unexpected answer: {other:?}")),
                    };
                }
                None if std::time::Instant::now() < deadline => std::thread::sleep(Duration::from_millis(2)),
                None => {
                    let (links, patience) = (self.transport.links(), NEIGHBOUR_PATIENCE.as_secs());
                    return Err(format!(
                        "process `{process}` did not answer the candidate within {patience} s; it has {links} links"
                    ));
                }
            }
        }
    }

    /// Compares with the active instance, in this process or elsewhere.
    fn compare(&self, candidate: &SeatName, beside: Option<u32>) -> Result<(), String> {
        let mut trials = lock(&self.trials);
        let trial = trials.get_mut(&id(candidate)).ok_or_else(|| format!("node `{}`: no trial", candidate.node))?;
        if let Some(number) = beside {
            let active = SeatName { node: candidate.node.clone(), number };
            let hear = Arc::clone(&trial.comparer);
            let tap: MutedOutput = Arc::new(move |port, header, message| hear.active(port, header, message.as_ref()));
            self.executor.tap(&active, Some(tap), STEP_PATIENCE)?;
            trial.tapped = Some(active);
            return Ok(());
        }
        for port in trial.ports.clone() {
            let (hear, key) = (Arc::clone(&trial.comparer), Key::new(&self.robot, &candidate.node, port).to_string());
            let guard = self.transport.watch(&key, move |_, header, payload| {
                if let Ok(header) = Header::decode(header) {
                    hear.active_wire(port, &header, &payload);
                }
            });
            trial.guards.push(guard.map_err(|error| error.to_string())?);
        }
        Ok(())
    }

    fn activate(&self, seat: &SeatName, handover: Handover, trial: TrialTerms) -> Result<(), String> {
        self.end_comparison(seat);
        let TrialTerms { outputs, overruns, may_err } = trial;
        let terms = ProbationTerms { outputs, overruns, may_err, tell: self.tell(seat) };
        self.executor.activate(seat, handover, terms, STEP_PATIENCE)
    }

    /// As the supervisor does it for two processes, in one go: the pause is shorter by all its questions.
    fn take_over(
        &self,
        candidate: &SeatName,
        active: &SeatName,
        freeze: FreezeTerms,
        rewired: &[String],
        trial: TrialTerms,
    ) -> Result<HandedOver, NotTakenOver> {
        let executor = &self.executor;
        let failed = |may_have_stopped: bool| move |reason: String| NotTakenOver { may_have_stopped, reason };
        let mut at_least = executor.hold(candidate, STEP_PATIENCE).map_err(failed(false))?;
        at_least.retain(|(input, _)| !rewired.contains(input));
        let (mut handover, latency_us) =
            executor.freeze(active, &at_least, freeze, CATCH_UP_PATIENCE).map_err(failed(true))?;
        handover.inputs.retain(|input| !rewired.contains(&input.port));
        let state_bytes = handover.state_bytes();
        let handed = HandedOver { queued: handover.queued(), state_bytes, latency_us };
        self.activate(candidate, handover, trial).map_err(failed(true))?;
        Ok(handed)
    }

    fn end_comparison(&self, seat: &SeatName) {
        if let Some(trial) = lock(&self.trials).remove(&id(seat))
            && let Some(active) = trial.tapped
            && let Err(error) = self.executor.tap(&active, None, STEP_PATIENCE)
        {
            tracing::debug!("{error}");
        }
    }

    fn status(&self, seat: &SeatName) -> Result<SeatStatus, String> {
        let ms = |duration: Duration| duration.as_secs_f64() * 1e3;
        let (busy, waiting) = self.executor.busy_and_waiting(seat, self.clock.now())?;
        let comparison = lock(&self.trials).get(&id(seat)).map(|trial| trial.comparer.comparison()).unwrap_or_default();
        let steps = if busy.is_none() { self.executor.steps_of(seat, STEP_PATIENCE) } else { None }.unwrap_or_default();
        Ok(SeatStatus {
            busy_ms: busy.map(ms),
            waiting_ms: waiting.map(ms),
            good_steps: steps.good,
            failing: steps.failing,
            down: steps.down,
            active_outputs: comparison.active,
            outputs: comparison.candidate,
            compared: comparison.compared,
            different: comparison.different,
            largest_difference: comparison.largest,
            latency_us: steps.latency_us,
        })
    }

    fn attend(&self, seat: &SeatName, successor: u32) -> Result<(), String> {
        let (executor, hearing) = (Arc::clone(&self.executor), seat.clone());
        let guard = self.transport.watch(&steps_key(&self.robot, &seat.node), move |_, _, payload| {
            if let Ok(told) = decode::<ToldStep>(&payload)
                && told.seat == successor
            {
                executor.hear_of_step(&hearing, told.record);
            }
        });
        lock(&self.attending).insert(id(seat), guard.map_err(|error| error.to_string())?);
        Ok(())
    }

    fn tell(&self, seat: &SeatName) -> Box<dyn Fn(crate::handover::StepRecord) + Send> {
        let (transport, key, number) = (self.transport.clone(), steps_key(&self.robot, &seat.node), seat.number);
        Box::new(move |record| {
            let told = encode(&ToldStep { seat: number, record }).map(|bytes| transport.put(&key, None, bytes));
            if !matches!(told, Ok(Ok(()))) {
                tracing::warn!("a step cannot be told on `{key}`");
            }
        })
    }
}
