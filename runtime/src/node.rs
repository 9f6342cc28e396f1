//! A node at work: operator, mailboxes, sequence numbers and statistics. Knows neither threads nor transports: an executor
//! decides when it steps and where its outputs go.

use std::sync::Arc;
use std::time::{Duration, Instant};

use carril_messages::{Control, Header, Health, InputHealth, Meta, NodeState, Origins, Percentiles, SourceId, Stamp};
use hdrhistogram::Histogram;

use crate::mailbox::{Mailbox, QueuePolicy};
use crate::operator::{Context, StepError, Trigger};
use crate::ports::{AnyMessage, InputSpec, OutputSpec, Provenance};
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
    window_start: Stamp,
    steps_before_window: u64,
    steps: u64,
    sent: u64,
    overruns: u64,
    missed_periods: u64,
    errors: u64,
    last_error: Option<String>,
    budget_violations: u64,
    step_ns: Histogram<u64>,
    latency_ns: Histogram<u64>,
    age_ns: Histogram<u64>,
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
        let stats = Stats::new();
        Self {
            name: name.into(),
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
        self.inputs.iter().zip(&self.mailboxes).any(|(input, mailbox)| input.spec.triggers && !mailbox.is_empty())
    }

    /// Says which outputs are read by somebody.
    pub fn set_wanted(&mut self, wanted: &dyn Fn(usize) -> bool) {
        self.operator.set_wanted(wanted);
    }

    /// Passes on a word from a person. The executor steps the node right after.
    pub fn control(&mut self, control: Control, now: Stamp) {
        self.operator.control(control, now);
    }

    /// The state as bytes, with its version.
    pub fn snapshot(&self) -> Result<(u32, Vec<u8>), carril_messages::CodecError> {
        self.operator.snapshot()
    }

    /// Puts a fresh operator in the place of one that panicked. Mailboxes and counters stay; sequence numbers begin again under
    /// the new epoch.
    pub fn revive(&mut self, operator: Box<dyn ErasedOperator>, epoch: u64) {
        self.operator = operator;
        self.epoch = epoch;
        self.next_seq.fill(0);
        let watches = self.input_watches.iter_mut().chain(&mut self.output_watches).flatten();
        watches.for_each(|watch| watch.in_a_row = 0);
        self.stats.state = NodeState::Running;
    }

    /// Counts periods in which the node came too late to step at all.
    pub fn count_missed_periods(&mut self, periods: u64) {
        self.stats.missed_periods += periods;
    }

    /// Sets the state that health reports.
    pub fn set_state(&mut self, state: NodeState) {
        self.stats.state = state;
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
        let mut report = StepReport::default();
        let newest_trigger = self.take_in(now, &mut report);
        let started = Instant::now();
        let inputs = &self.inputs;
        self.operator.begin(now, &|port| inputs[port].max_age);
        let result = self.operator.step(&Context::new(now, trigger, buffers));
        report.took = started.elapsed();
        let ended = done(report.took);
        let used = self.operator.take_used();
        self.send(ended, &used, &mut report, publish);
        self.stats.record(now, ended, newest_trigger, used.oldest());
        report.overrun = self.deadline.is_some_and(|deadline| ended.since(now).to_duration() > deadline);
        self.stats.overruns += u64::from(report.overrun);
        report.error = result.err();
        self.stats.record_result(report.error.as_ref());
        report
    }

    fn take_in(&mut self, now: Stamp, report: &mut StepReport) -> Option<Stamp> {
        let mut newest_trigger = None;
        for port in 0..self.mailboxes.len() {
            let mailbox = Arc::clone(&self.mailboxes[port]);
            while let Some(incoming) = mailbox.pop() {
                let header = Arc::clone(incoming.header());
                if self.breaks_budget(port, &header, now, report) {
                    continue;
                }
                if let Err(refusal) = self.operator.accept(port, incoming) {
                    mailbox.refuse(refusal.to_string());
                    continue;
                }
                if self.inputs[port].spec.triggers {
                    newest_trigger = newest_trigger.max(Some(header.stamp));
                }
            }
        }
        newest_trigger
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
            stats.sent += 1;
            publish(Published { port, header: Arc::new(header), message: outgoing.message });
        });
    }

    /// How the node did since the last call, and begins a new window. `process` and `pid` are the executor's to fill in.
    pub fn take_health(&mut self, now: Stamp) -> Health {
        let inputs = (0..self.inputs.len()).map(|port| self.input_health(port)).collect();
        let stats = &mut self.stats;
        let window_s = now.since(stats.window_start).as_secs_f64();
        let steps_in_window = stats.steps - stats.steps_before_window;
        let health = Health {
            node: self.name.clone(),
            operator: self.kind.clone(),
            state: stats.state,
            stamp: now,
            window_s,
            steps: stats.steps,
            rate_hz: if window_s > 0.0 { steps_in_window as f64 / window_s } else { 0.0 },
            sent: stats.sent,
            step_us: percentiles(&stats.step_ns, 1e3).unwrap_or_default(),
            latency_us: percentiles(&stats.latency_ns, 1e3),
            age_ms: percentiles(&stats.age_ns, 1e6),
            overruns: stats.overruns,
            missed_periods: stats.missed_periods,
            errors: stats.errors,
            last_error: stats.last_error.clone(),
            budget_violations: stats.budget_violations,
            inputs,
            ..Health::default()
        };
        stats.begin_window(now);
        health
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

impl Stats {
    fn new() -> Self {
        Self {
            state: NodeState::Running,
            window_start: Stamp::ZERO,
            steps_before_window: 0,
            steps: 0,
            sent: 0,
            overruns: 0,
            missed_periods: 0,
            errors: 0,
            last_error: None,
            budget_violations: 0,
            step_ns: histogram(),
            latency_ns: histogram(),
            age_ns: histogram(),
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

    fn record_result(&mut self, error: Option<&StepError>) {
        match error {
            Some(error) => {
                self.errors += 1;
                self.last_error = Some(error.to_string());
                self.state = NodeState::Faulted;
            }
            None if self.state == NodeState::Faulted => self.state = NodeState::Running,
            None => {}
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
