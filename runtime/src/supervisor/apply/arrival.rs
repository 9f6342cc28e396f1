//! A node that is new in the running graph, or comes in the place of one that is down: shadow, then probation, as in a swap, with nobody
//! before it who could hand over.

use std::time::{Duration, Instant};

use super::super::candidate::{Candidate, failure};
use super::super::changes::{Changes, Failure};
use super::super::monitor::Message;
use super::super::plan::PlanNode;
use crate::control_plane::{Receipt, SwapTerms};
use crate::handover::Handover;

pub(in crate::supervisor) struct Arrival<'a> {
    changes: &'a Changes,
    candidate: Candidate<'a>,
    /// The one that is down, and its seat.
    before: Option<(PlanNode, u32)>,
    receipt: &'a mut Receipt,
}

impl<'a> Arrival<'a> {
    pub(in crate::supervisor) fn new(
        changes: &'a Changes,
        node: PlanNode,
        terms: SwapTerms,
        receipt: &'a mut Receipt,
    ) -> Self {
        Self { changes, candidate: Candidate::new(changes, node, terms), before: None, receipt }
    }

    /// It comes in the place of this one, which is down.
    pub(in crate::supervisor) fn in_place_of(mut self, before: PlanNode) -> Self {
        let seat = self.changes.live.lock().seat(&before.name);
        self.before = Some((before, seat));
        self
    }

    /// Carries it through. On failure the graph is as it was.
    pub(in crate::supervisor) fn run(mut self) -> Result<(), Failure> {
        let began = Instant::now();
        let result = self.arrive();
        match &result {
            Ok(()) => {
                let shadow = if self.candidate.exclusive { 0 } else { self.candidate.terms.shadow_ms };
                let took = began.elapsed().saturating_sub(Duration::from_millis(shadow));
                self.receipt.took_ms = Some(took.as_secs_f64() * 1e3);
                self.receipt.latency_after_us = self.candidate.status.latency_us;
            }
            Err(_) => self.leave(),
        }
        result
    }

    fn arrive(&mut self) -> Result<(), Failure> {
        let up = |process: &str| self.changes.is_up(process);
        let (place, mut neighbours) = {
            let mut live = self.changes.live.lock();
            let place = live.place(self.before.as_ref().map(|(before, _)| before), &self.candidate.node, &up);
            (place, live.plan.with(&self.candidate.node).neighbours(&self.candidate.node.name))
        };
        self.candidate.move_in(place, &neighbours)?;
        // Those that are down need not hear of it: they begin after it.
        neighbours.retain(|neighbour| up(neighbour));
        self.candidate.prepare(None, neighbours)?;
        self.candidate.shadow(None)?;
        self.candidate.hold().map_err(|reason| failure("hand-over", reason))?;
        self.changes.replan(&self.candidate.node, self.candidate.seat.number);
        let epoch = self.changes.clock.now().as_nanos() as u64;
        self.candidate.activate(Box::new(Handover { epoch, ..Handover::default() }))?;
        self.candidate.probation()?;
        self.candidate.commit();
        Ok(())
    }

    fn leave(&mut self) {
        self.candidate.silence();
        if let Some((before, seat)) = &self.before {
            self.changes.replan(before, *seat);
        } else {
            self.changes.live.lock().remove(&self.candidate.node.name);
            let _ = self.changes.monitor.send(Message::Replanned);
        }
        self.candidate.end_host();
    }
}
