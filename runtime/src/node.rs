//! A node at work: operator, mailboxes, sequence numbers and statistics. Knows neither threads nor transports: an executor
//! decides when it steps and where its outputs go.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use carril_messages::{
    CodecError, Control, Header, Health, InputHealth, Meta, NodeState, Origins, OutputHealth, Percentiles, SourceId,
    Stamp,
};
use hdrhistogram::Histogram;

use crate::handover::{HandedInput, Handover, StepRecord, WireSample};
use crate::mailbox::{Mailbox, QueuePolicy};
use crate::operator::{Context, StateError, StepError, Trigger};
use crate::ports::{AnyMessage, Held, Incoming, InputSpec, OutputSpec, Provenance};
use crate::positions::Positions;
use crate::registry::ErasedOperator;
use crate::setup::BufferPool;

/// An end-to-end budget that ends at a port of this node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PortBudget {
    /// The sensor port whose exposures count.
    pub source: SourceId,
    /// Largest age when the node reads the sample (input), or sends it (output).
    pub max_age: Duration,
    /// Whether violations stop the car: [`VIOLATIONS_TO_STOP`] in a row do. At an input, a sample that breaks such a budget is
    /// withheld besides; at an output it is sent all the same, as it may be the very command to stop.
    pub stops: bool,
}

/// What a node must know of one of its edges.
#[derive(Clone, Debug)]
pub struct NodeInput {
    /// The port.
    pub spec: InputSpec,
    /// The queue.
    pub queue: QueuePolicy,
    /// Older samples are withheld.
    pub max_age: Option<Duration>,
    /// Budgets that end here.
    pub budgets: Vec<PortBudget>,
}

/// A sample on its way from a node to its readers.
#[derive(Clone, Debug)]
pub struct Published {
    /// Index of the output port.
    pub port: usize,
    /// The header; its metadata are filled in by the wire form.
    pub header: Arc<Header>,
    /// The message.
    pub message: Arc<dyn AnyMessage>,
}

/// A budget that stops the car.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BudgetStop {
    /// The port at which the budget ends.
    pub port: &'static str,
    /// Age of the last sample.
    pub age: Duration,
    /// The budget.
    pub max_age: Duration,
}

/// What a step came to.
#[derive(Debug, Default)]
pub struct StepReport {
    /// The step failed.
    pub error: Option<StepError>,
    /// It took longer than the deadline.
    pub overrun: bool,
    /// A budget whose `on_violation` is `stop` was broken [`VIOLATIONS_TO_STOP`] times in a row.
    pub stop: Option<BudgetStop>,
    /// Duration of the step, measured on the real clock.
    pub took: Duration,
}

/// So many samples in a row must break a budget before `on_violation: stop` stops the car: one hiccup only withholds a sample.
pub const VIOLATIONS_TO_STOP: u32 = 3;

/// A node at work.
pub struct Node {
    name: String,
    kind: String,
    operator: Box<dyn ErasedOperator>,
    inputs: Vec<NodeInput>,
    mailboxes: Vec<Arc<Mailbox>>,
    /// What was handed over and waits before all that is in the mailboxes.
    backlog: VecDeque<(usize, Incoming)>,
    consumed: Vec<Positions>,
    outputs: Vec<OutputSpec>,
    source_ids: Vec<SourceId>,
    next_seq: Vec<u64>,
    epoch: u64,
    deadline: Option<Duration>,
    input_watches: Vec<Vec<BudgetWatch>>,
    output_watches: Vec<Vec<BudgetWatch>>,
    stats: Stats,
}

/// A budget, and how often it was broken lately.
struct BudgetWatch {
    budget: PortBudget,
    port: &'static str,
    in_a_row: u32,
}

/// What a sample does to the budgets of its port.
#[derive(Default)]
struct Verdict {
    violations: u64,
    withhold: bool,
    stop: Option<BudgetStop>,
}

fn watch(port: &'static str, budgets: &[PortBudget]) -> Vec<BudgetWatch> {
    budgets.iter().map(|budget| BudgetWatch { budget: budget.clone(), port, in_a_row: 0 }).collect()
}

fn judge(watches: &mut [BudgetWatch], origins: &Origins, now: Stamp) -> Verdict {
    let mut verdict = Verdict::default();
    for BudgetWatch { budget, port, in_a_row } in watches {
        let Some(captured) = origins.of(budget.source) else { continue };
        let age = now.since(captured).to_duration();
        if age <= budget.max_age {
            *in_a_row = 0;
            continue;
        }
        *in_a_row += 1;
        verdict.violations += 1;
        verdict.withhold |= budget.stops;
        if budget.stops && *in_a_row == VIOLATIONS_TO_STOP {
            verdict.stop = Some(BudgetStop { port, age, max_age: budget.max_age });
        }
    }
    verdict
}

struct Stats {
    state: NodeState,
    since: Stamp,
    window_start: Stamp,
    steps_before_window: u64,
    steps: u64,
    /// By output port.
    sent: Vec<u64>,
    overruns: u64,
    missed_periods: u64,
    errors: u64,
    last_error: Option<String>,
    last_failed: bool,
    budget_violations: u64,
    step_ns: Histogram<u64>,
    latency_ns: Histogram<u64>,
    age_ns: Histogram<u64>,
    /// Latencies of the last window that had some.
    last_latency_us: Option<Percentiles>,
}

fn histogram() -> Histogram<u64> {
    let mut histogram = Histogram::new_with_bounds(1, 3_600_000_000_000, 2).expect("the bounds are valid");
    histogram.auto(true);
    histogram
}

fn percentiles(histogram: &Histogram<u64>, unit_ns: f64) -> Option<Percentiles> {
    (!histogram.is_empty()).then(|| Percentiles {
        p50: histogram.value_at_quantile(0.5) as f64 / unit_ns,
        p99: histogram.value_at_quantile(0.99) as f64 / unit_ns,
        max: histogram.max() as f64 / unit_ns,
    })
}

impl Node {
    /// Puts a node together. `epoch` identifies this life of it.
    pub fn new(
        name: &str,
        kind: &str,
        operator: Box<dyn ErasedOperator>,
        inputs: Vec<NodeInput>,
        outputs: Vec<OutputSpec>,
        deadline: Option<Duration>,
        epoch: u64,
    ) -> Self {
        let mailboxes = inputs.iter().map(|input| Arc::new(Mailbox::new(input.queue))).collect();
        let source_ids = outputs.iter().map(|port| SourceId::of(name, port.name)).collect();
        let next_seq = vec![0; outputs.len()];
        let input_watches = inputs.iter().map(|input| watch(input.spec.name, &input.budgets)).collect();
        let output_watches = outputs.iter().map(|_| Vec::new()).collect();
        let stats = Stats::since(Stamp::from_nanos(epoch as i64), outputs.len());
        let consumed = vec![Positions::default(); inputs.len()];
        Self {
            name: name.into(),
            backlog: VecDeque::new(),
            consumed,
            kind: kind.into(),
            operator,
            inputs,
            mailboxes,
            outputs,
            source_ids,
            next_seq,
            epoch,
            deadline,
            input_watches,
            output_watches,
            stats,
        }
    }

    /// With the budgets that end at its outputs, by index of the port.
    #[must_use]
    pub fn with_output_budgets(mut self, budgets: &[Vec<PortBudget>]) -> Self {
        self.output_watches =
            self.outputs.iter().zip(budgets).map(|(spec, budgets)| watch(spec.name, budgets)).collect();
        self
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The queues of its inputs, by index of the port; whoever delivers puts samples in there.
    pub fn mailboxes(&self) -> &[Arc<Mailbox>] {
        &self.mailboxes
    }

    /// Its inputs.
    pub fn inputs(&self) -> &[NodeInput] {
        &self.inputs
    }

    /// Its outputs.
    pub fn outputs(&self) -> &[OutputSpec] {
        &self.outputs
    }

    /// Whether a triggering input has something.
    pub fn triggered(&self) -> bool {
        self.has_backlog()
            || self
                .inputs
                .iter()
                .zip(&self.mailboxes)
                .any(|(input, mailbox)| input.spec.triggers && !mailbox.is_empty())
    }

    /// Says which outputs are read by somebody.
    pub fn set_wanted(&mut self, wanted: &dyn Fn(usize) -> bool) {
        self.operator.set_wanted(wanted);
    }

    /// Passes on a word from a person. The executor steps the node right after.
    pub fn control(&mut self, control: Control, now: Stamp) {
        self.operator.control(control, now);
    }

    /// Whether samples wait that a predecessor handed over. Each step takes one of them that triggers.
    pub fn has_backlog(&self) -> bool {
        !self.backlog.is_empty()
    }

    /// How far its inputs have come, by name of the port.
    pub fn received(&self) -> Vec<(String, Positions)> {
        let ports = self.inputs.iter().zip(&self.mailboxes);
        ports.map(|(input, mailbox)| (input.spec.name.to_owned(), mailbox.received())).collect()
    }

    /// Whether its inputs have come as far as `others`, by name of the port.
    pub fn has_received(&self, others: &[(String, Positions)]) -> bool {
        let ports = self.inputs.iter().zip(&self.mailboxes);
        ports.into_iter().all(|(input, mailbox)| {
            let other = others.iter().find(|(port, _)| port == input.spec.name);
            other.is_none_or(|(_, positions)| mailbox.received().cover(positions))
        })
    }

    /// Whether the mailboxes keep everything.
    pub fn keep_all(&self, keep: bool) {
        self.mailboxes.iter().for_each(|mailbox| mailbox.keep_all(keep));
    }

    /// What a successor needs; `fresh`: without the state.
    pub fn hand_over(&mut self, fresh: bool, next_period: Option<Stamp>) -> Result<Handover, CodecError> {
        let state = if fresh { None } else { Some(self.operator.snapshot()?) };
        let mut inputs = Vec::new();
        for (at, (held, mailbox)) in self.operator.held().into_iter().zip(&self.mailboxes).enumerate() {
            let (received, in_mailbox) = mailbox.waiting();
            let backlog = self.backlog.iter().filter(|(port, _)| *port == at).map(|(_, incoming)| incoming);
            let waiting = held.unread.iter().chain(backlog).chain(&in_mailbox).map(WireSample::of);
            let waiting = waiting.collect::<Result<_, _>>()?;
            let read = held.read.as_ref().map(WireSample::of).transpose()?;
            let (port, consumed) = (self.inputs[at].spec.name.to_owned(), self.consumed[at].clone());
            inputs.push(HandedInput { port, consumed, received, read, waiting });
        }
        Ok(Handover { state, epoch: self.epoch, next_seq: self.next_seq(), inputs, next_period })
    }

    /// Goes on where a predecessor stopped. What has come here since then is kept, what the predecessor had is not taken twice. An
    /// input that is not handed over keeps what it has.
    pub fn take_over(&mut self, handover: Handover, now: Stamp) -> Result<(), StateError> {
        if let Some((version, state)) = &handover.state {
            self.operator.restore(*version, state)?;
        }
        let mut held = self.operator.held();
        held.resize_with(self.inputs.len(), Held::default);
        self.backlog.clear();
        for input in handover.inputs {
            let Some(at) = self.inputs.iter().position(|own| own.spec.name == input.port) else { continue };
            let read = input.read.map(WireSample::read).transpose().map_err(StateError::new)?;
            held[at] = Held { read, ..Held::default() };
            for sample in input.waiting {
                self.backlog.push_back((at, sample.read().map_err(StateError::new)?));
            }
            let received = input.received;
            // What is still on its way to here, but was there before the hand-over, is not taken again.
            self.mailboxes[at].has_received(&received);
            let later = self.mailboxes[at].take_all().into_iter();
            let later = later.filter(|own| !received.has(own.header().epoch, own.header().seq));
            self.backlog.extend(later.map(|own| (at, own)));
            self.consumed[at] = input.consumed;
        }
        self.operator.take_held(held).map_err(StateError::new)?;
        self.keep_all(false);
        self.epoch = handover.epoch;
        self.set_next_seq(&handover.next_seq);
        self.forget_violations();
        self.stats = Stats { window_start: now, ..Stats::since(now, self.outputs.len()) };
        Ok(())
    }

    /// What waits becomes backlog, so that each sample gets a step of its own.
    pub fn wait_is_over(&mut self) {
        for (at, mailbox) in self.mailboxes.iter().enumerate() {
            self.backlog.extend(mailbox.take_all().into_iter().map(|incoming| (at, incoming)));
        }
        self.keep_all(false);
    }

    /// Next sequence number of each output port, by name.
    pub fn next_seq(&self) -> Vec<(String, u64)> {
        self.outputs.iter().zip(&self.next_seq).map(|(spec, next)| (spec.name.to_owned(), *next)).collect()
    }

    /// What its outputs have sent, by name: `world/camera`.
    pub fn sent(&self) -> Vec<(String, Positions)> {
        let sent = self.outputs.iter().zip(&self.next_seq).filter_map(|(spec, next)| {
            let mut positions = Positions::default();
            positions.advance(self.epoch, next.checked_sub(1)?);
            Some((format!("{}/{}", self.name, spec.name), positions))
        });
        sent.collect()
    }

    /// Its life: the epoch of what it sends.
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Sets the next sequence numbers, by name of the port.
    pub fn set_next_seq(&mut self, next_seq: &[(String, u64)]) {
        for (spec, next) in self.outputs.iter().zip(&mut self.next_seq) {
            if let Some((_, handed)) = next_seq.iter().find(|(port, _)| port == spec.name) {
                *next = *handed;
            }
        }
    }

    /// The step just made, for a predecessor that follows.
    pub fn record(&self, number: u64, now: Stamp, trigger: Trigger) -> StepRecord {
        let consumed = self.inputs.iter().zip(&self.consumed);
        let consumed = consumed.map(|(input, positions)| (input.spec.name.to_owned(), positions.clone())).collect();
        StepRecord { number, now, trigger, consumed, next_seq: self.next_seq() }
    }

    /// Another operator of the same kind goes on in this one's place, between two steps: the state and what the inputs hold go
    /// over. On failure nothing has changed.
    pub fn replace(&mut self, mut operator: Box<dyn ErasedOperator>) -> Result<Box<dyn ErasedOperator>, StateError> {
        let (version, state) = self.operator.snapshot().map_err(StateError::new)?;
        operator.restore(version, &state)?;
        operator.take_held(self.operator.held()).map_err(StateError::new)?;
        Ok(std::mem::replace(&mut self.operator, operator))
    }

    /// Puts an operator of the same ports in, as it is.
    pub fn install(&mut self, operator: Box<dyn ErasedOperator>) {
        self.operator = operator;
    }

    /// [`crate::Operator::reconfigure`]
    pub fn reconfigure(&mut self, config: &serde_json::Value) -> Option<Result<(), crate::operator::SetupError>> {
        self.operator.reconfigure(config)
    }

    /// Takes over the state of a predecessor, before the real hand-over: so a shadow begins where the active one is.
    pub fn restore(&mut self, version: u32, state: &[u8]) -> Result<(), StateError> {
        self.operator.restore(version, state)
    }

    fn forget_violations(&mut self) {
        let watches = self.input_watches.iter_mut().chain(&mut self.output_watches).flatten();
        watches.for_each(|watch| watch.in_a_row = 0);
    }

    /// The state as bytes, with its version.
    pub fn snapshot(&self) -> Result<(u32, Vec<u8>), carril_messages::CodecError> {
        self.operator.snapshot()
    }

    /// Puts a fresh operator in the place of one that panicked. Mailboxes and counters stay; sequence numbers begin again under
    /// a new epoch.
    pub fn revive(&mut self, operator: Box<dyn ErasedOperator>, now: Stamp) {
        self.operator = operator;
        self.epoch = now.as_nanos() as u64;
        self.next_seq.fill(0);
        self.forget_violations();
        self.stats.enter(NodeState::Running, now);
    }

    /// Counts periods in which the node came too late to step at all.
    pub fn count_missed_periods(&mut self, periods: u64) {
        self.stats.missed_periods += periods;
    }

    /// The state that health reports.
    pub fn state(&self) -> NodeState {
        self.stats.state
    }

    /// Sets the state that health reports.
    pub fn set_state(&mut self, state: NodeState, now: Stamp) {
        self.stats.enter(state, now);
    }

    /// Takes in what waits in the mailboxes and runs a step at `now`. What it sends goes to `publish`, stamped `done(step)`:
    /// the time at which the step has ended, given how long it took on the real clock.
    pub fn step(
        &mut self,
        now: Stamp,
        trigger: Trigger,
        buffers: &dyn BufferPool,
        done: &dyn Fn(Duration) -> Stamp,
        publish: &mut dyn FnMut(Published),
    ) -> StepReport {
        self.step_on(None, now, trigger, buffers, done, publish)
    }

    /// Makes the step that a successor has made: with the same time and the same samples.
    pub fn follow(
        &mut self,
        record: &StepRecord,
        buffers: &dyn BufferPool,
        done: &dyn Fn(Duration) -> Stamp,
        publish: &mut dyn FnMut(Published),
    ) -> StepReport {
        let seen: Vec<Positions> = self.inputs.iter().map(|input| seen_by(record, input.spec.name)).collect();
        let report = self.step_on(Some(&seen), record.now, record.trigger, buffers, done, publish);
        self.set_next_seq(&record.next_seq);
        report
    }

    fn step_on(
        &mut self,
        seen: Option<&[Positions]>,
        now: Stamp,
        trigger: Trigger,
        buffers: &dyn BufferPool,
        done: &dyn Fn(Duration) -> Stamp,
        publish: &mut dyn FnMut(Published),
    ) -> StepReport {
        let mut report = StepReport::default();
        let newest_trigger = self.take_in(seen, now, &mut report);
        let started = Instant::now();
        let inputs = &self.inputs;
        self.operator.begin(now, &|port| inputs[port].max_age);
        let result = self.operator.step(&Context::new(now, trigger, buffers));
        report.took = started.elapsed();
        let ended = done(report.took);
        let used = self.operator.take_used();
        self.send(ended, &used, &mut report, publish);
        self.operator.end();
        self.stats.record(now, ended, newest_trigger, used.oldest());
        report.overrun = self.deadline.is_some_and(|deadline| ended.since(now).to_duration() > deadline);
        self.stats.overruns += u64::from(report.overrun);
        report.error = result.err();
        self.stats.record_result(report.error.as_ref(), ended);
        report
    }

    fn take_in(&mut self, seen: Option<&[Positions]>, now: Stamp, report: &mut StepReport) -> Option<Stamp> {
        let mut newest_trigger = None;
        while let Some((port, incoming)) = self.next_of_backlog(seen) {
            let taken = self.take(port, incoming, now, report);
            newest_trigger = newest_trigger.max(taken);
            if taken.is_some() && seen.is_none() {
                return newest_trigger;
            }
        }
        for port in 0..self.mailboxes.len() {
            let mailbox = Arc::clone(&self.mailboxes[port]);
            let next = || seen.map_or_else(|| mailbox.pop(), |seen| mailbox.pop_seen(&seen[port]));
            while let Some(incoming) = next() {
                newest_trigger = newest_trigger.max(self.take(port, incoming, now, report));
            }
        }
        newest_trigger
    }

    fn next_of_backlog(&mut self, seen: Option<&[Positions]>) -> Option<(usize, Incoming)> {
        let Some(seen) = seen else { return self.backlog.pop_front() };
        let is_seen =
            |(port, incoming): &(usize, Incoming)| seen[*port].has(incoming.header().epoch, incoming.header().seq);
        let at = self.backlog.iter().position(is_seen)?;
        self.backlog.remove(at)
    }

    /// Gives a sample to the operator, unless its budget is broken or it is refused. Its stamp, if it triggers.
    fn take(&mut self, port: usize, incoming: Incoming, now: Stamp, report: &mut StepReport) -> Option<Stamp> {
        let header = Arc::clone(incoming.header());
        self.consumed[port].advance(header.epoch, header.seq);
        if self.breaks_budget(port, &header, now, report) {
            return None;
        }
        if let Err(refusal) = self.operator.accept(port, incoming) {
            self.mailboxes[port].refuse(refusal.to_string());
            return None;
        }
        self.inputs[port].spec.triggers.then_some(header.stamp)
    }

    /// Counts broken budgets; `true` when the sample must be withheld.
    fn breaks_budget(&mut self, port: usize, header: &Header, now: Stamp, report: &mut StepReport) -> bool {
        let verdict = judge(&mut self.input_watches[port], &header.origins, now);
        self.stats.budget_violations += verdict.violations;
        report.stop = verdict.stop.or(report.stop.take());
        verdict.withhold
    }

    fn send(&mut self, stamp: Stamp, used: &Origins, report: &mut StepReport, publish: &mut dyn FnMut(Published)) {
        let Self { operator, source_ids, next_seq, epoch, stats, output_watches, .. } = self;
        operator.drain(&mut |port, outgoing| {
            let origins = match outgoing.provenance {
                Provenance::Inputs => used.clone(),
                Provenance::Captured(captured) => Origins::captured(source_ids[port], captured),
            };
            let verdict = judge(&mut output_watches[port], &origins, stamp);
            stats.budget_violations += verdict.violations;
            report.stop = verdict.stop.or(report.stop.take());
            let message_type = outgoing.message.message_type();
            let header = Header { epoch: *epoch, seq: next_seq[port], stamp, origins, message_type, meta: Meta::new() };
            next_seq[port] += 1;
            stats.sent[port] += 1;
            publish(Published { port, header: Arc::new(header), message: outgoing.message });
        });
    }

    /// How the node did since the last call, and begins a new window. `process` and `pid` are the executor's to fill in; `bytes`: of
    /// payload that it has passed on from each output port.
    pub fn take_health(&mut self, now: Stamp, bytes: &dyn Fn(usize) -> u64) -> Health {
        let inputs = (0..self.inputs.len()).map(|port| self.input_health(port)).collect();
        let ports = self.outputs.iter().zip(&self.stats.sent).enumerate();
        let output = |(at, (spec, sent)): (usize, (&OutputSpec, &u64))| OutputHealth {
            port: spec.name.to_owned(),
            sent: *sent,
            bytes: bytes(at),
        };
        let outputs = ports.map(output).collect();
        let stats = &mut self.stats;
        let window_s = now.since(stats.window_start).as_secs_f64();
        let steps_in_window = stats.steps - stats.steps_before_window;
        let health = Health {
            node: self.name.clone(),
            operator: self.kind.clone(),
            state: stats.state,
            since: stats.since,
            stamp: now,
            window_s,
            steps: stats.steps,
            rate_hz: if window_s > 0.0 { steps_in_window as f64 / window_s } else { 0.0 },
            sent: stats.sent.iter().sum(),
            step_us: percentiles(&stats.step_ns, 1e3).unwrap_or_default(),
            latency_us: percentiles(&stats.latency_ns, 1e3),
            age_ms: percentiles(&stats.age_ns, 1e6),
            overruns: stats.overruns,
            missed_periods: stats.missed_periods,
            errors: stats.errors,
            last_error: stats.last_error.clone(),
            budget_violations: stats.budget_violations,
            inputs,
            outputs,
            ..Health::default()
        };
        stats.last_latency_us = health.latency_us.or(stats.last_latency_us);
        stats.begin_window(now);
        health
    }

    /// From the newest triggering sample to the end of the step, us: in this window, or in the last one if this one has only
    /// begun.
    pub fn recent_latency_us(&self) -> Option<Percentiles> {
        const ENOUGH_STEPS: u64 = 5;
        let current = percentiles(&self.stats.latency_ns, 1e3);
        let enough = self.stats.latency_ns.len() >= ENOUGH_STEPS;
        if enough { current } else { self.stats.last_latency_us.or(current) }
    }

    /// Steps that went well since the start or the take-over, and what the last step said if it failed.
    pub fn successes(&self) -> (u64, Option<&str>) {
        let failing = self.stats.last_failed.then_some(self.stats.last_error.as_deref()).flatten();
        (self.stats.steps.saturating_sub(self.stats.errors), failing)
    }

    fn input_health(&mut self, port: usize) -> InputHealth {
        let counts = self.mailboxes[port].counts();
        InputHealth {
            port: self.inputs[port].spec.name.to_owned(),
            received: counts.received,
            dropped: counts.dropped,
            lost: counts.lost,
            stale: self.operator.stale(port),
            refused: counts.refused,
            last_refusal: self.mailboxes[port].last_refusal(),
        }
    }
}

fn seen_by(record: &StepRecord, port: &str) -> Positions {
    let own = record.consumed.iter().find(|(name, _)| name == port);
    own.map(|(_, positions)| positions.clone()).unwrap_or_default()
}

impl Stats {
    /// Those of a node that runs since then, with so many outputs.
    fn since(since: Stamp, outputs: usize) -> Self {
        Self {
            state: NodeState::Running,
            since,
            window_start: Stamp::ZERO,
            steps_before_window: 0,
            steps: 0,
            sent: vec![0; outputs],
            overruns: 0,
            missed_periods: 0,
            errors: 0,
            last_error: None,
            last_failed: false,
            budget_violations: 0,
            step_ns: histogram(),
            latency_ns: histogram(),
            age_ns: histogram(),
            last_latency_us: None,
        }
    }

    fn record(&mut self, started: Stamp, ended: Stamp, triggered: Option<Stamp>, oldest: Option<Stamp>) {
        self.steps += 1;
        let add = |histogram: &mut Histogram<u64>, from: Stamp| {
            histogram.saturating_record(ended.since(from).as_nanos().max(1) as u64);
        };
        add(&mut self.step_ns, started);
        if let Some(stamp) = triggered {
            add(&mut self.latency_ns, stamp);
        }
        if let Some(stamp) = oldest {
            add(&mut self.age_ns, stamp);
        }
    }

    fn record_result(&mut self, error: Option<&StepError>, ended: Stamp) {
        self.last_failed = error.is_some();
        match error {
            Some(error) => {
                self.errors += 1;
                self.last_error = Some(error.to_string());
                self.enter(NodeState::Faulted, ended);
            }
            None if self.state == NodeState::Faulted => self.enter(NodeState::Running, ended),
            None => {}
        }
    }

    fn enter(&mut self, state: NodeState, now: Stamp) {
        if self.state != state {
            (self.state, self.since) = (state, now);
        }
    }

    fn begin_window(&mut self, now: Stamp) {
        self.window_start = now;
        self.steps_before_window = self.steps;
        self.step_ns.reset();
        self.latency_ns.reset();
        self.age_ns.reset();
    }
}
