//! A node of a lockstep run, with what waits for it and who reads it.

use std::collections::VecDeque;
use std::time::Duration;

use carril_messages::{Control, Health, Stamp};

use crate::graph::{GraphNode, OnOverrun};
use crate::node::{Node, Published};
use crate::operator::Trigger;
use crate::ports::OutputSpec;

/// A node of a lockstep run.
pub(super) struct Slot {
    pub(super) node: Node,
    pub(super) period: Option<Duration>,
    pub(super) latency: Duration,
    pub(super) on_overrun: OnOverrun,
    /// Multiples of the period that have come.
    periods: u64,
    /// Its modelled computing goes on.
    pub(super) busy: bool,
    /// What queued up is dropped when it is free again, and the next period left out.
    pub(super) skips: bool,
    skips_next_period: bool,
    /// Steps that wait until it is free.
    pub(super) waiting: VecDeque<Trigger>,
    /// Which triggers are due or waiting already; control words count each for itself.
    asked: [bool; 3],
    pub(super) controls: VecDeque<Control>,
    pub(super) cost: Duration,
    pub(super) outputs: Vec<OutputSlot>,
}

/// Hears every sample of an output.
pub(super) type Subscriber = Box<dyn FnMut(&Published)>;

/// An output, and who reads it.
pub(super) struct OutputSlot {
    pub(super) key: String,
    pub(super) readers: Vec<Reader>,
    pub(super) subscribers: Vec<Subscriber>,
    pub(super) last: Option<Published>,
    /// Of payload, so far.
    pub(super) bytes: u64,
}

/// An input that reads an output.
#[derive(Clone, Copy)]
pub(super) struct Reader {
    pub(super) node: usize,
    pub(super) input: usize,
    pub(super) delay: Duration,
    pub(super) triggers: bool,
}

/// Index into [`Slot::asked`]; `None`: each word counts.
fn asked_index(trigger: Trigger) -> Option<usize> {
    match trigger {
        Trigger::Input => Some(0),
        Trigger::Period => Some(1),
        Trigger::Wake => Some(2),
        Trigger::Control => None,
    }
}

impl Slot {
    pub(super) fn new(built: Node, node: &GraphNode) -> Self {
        let output = |port: &OutputSpec| OutputSlot {
            key: format!("{}/{}", node.name, port.name),
            readers: Vec::new(),
            subscribers: Vec::new(),
            last: None,
            bytes: 0,
        };
        Self {
            outputs: built.outputs().iter().map(output).collect(),
            node: built,
            period: node.period.filter(|period| !period.is_zero()),
            latency: node.modelled_latency,
            on_overrun: node.on_overrun,
            periods: 0,
            busy: false,
            skips: false,
            skips_next_period: false,
            waiting: VecDeque::new(),
            asked: [false; 3],
            controls: VecDeque::new(),
            cost: Duration::ZERO,
        }
    }

    /// How the node did over the whole run.
    pub(super) fn health(&mut self, now: Stamp) -> Health {
        let outputs = &self.outputs;
        self.node.take_health(now, &|port| outputs[port].bytes)
    }

    /// Says that a step is due for this reason. `false`: it is so already.
    pub(super) fn ask(&mut self, trigger: Trigger) -> bool {
        asked_index(trigger).is_none_or(|index| !std::mem::replace(&mut self.asked[index], true))
    }

    /// Says that the step for this reason runs now, or never. `true`: it was due.
    pub(super) fn answer(&mut self, trigger: Trigger) -> bool {
        asked_index(trigger).is_some_and(|index| std::mem::take(&mut self.asked[index]))
    }

    /// The period has come: when the next one does.
    pub(super) fn next_period(&mut self) -> Option<Stamp> {
        self.periods += 1;
        let next_ns = self.period?.as_nanos().saturating_mul(u128::from(self.periods));
        Some(Stamp::from_nanos(i64::try_from(next_ns).unwrap_or(i64::MAX)))
    }

    /// Whether the period that has come is left out: after an overrun that skips, or because the step of an earlier one still waits.
    pub(super) fn leaves_period_out(&mut self) -> bool {
        let skipped = std::mem::take(&mut self.skips_next_period);
        skipped || asked_index(Trigger::Period).is_some_and(|index| self.asked[index])
    }

    /// `on_overrun: skip`: what queued up during the step is dropped, and one period is left out: the one that waits, else the next.
    pub(super) fn skip_backlog(&mut self) {
        self.node.mailboxes().iter().for_each(|mailbox| mailbox.clear());
        self.waiting.retain(|trigger| !matches!(trigger, Trigger::Input | Trigger::Period));
        self.answer(Trigger::Input);
        let one_waited = self.answer(Trigger::Period);
        self.node.count_missed_periods(u64::from(one_waited));
        self.skips_next_period = !one_waited;
    }
}
