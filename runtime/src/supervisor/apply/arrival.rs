//! A node that is new in the running graph: shadow, then probation, as in a swap, with nobody before it.

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
    receipt: &'a mut Receipt,
}

impl<'a> Arrival<'a> {
    pub(in crate::supervisor) fn new(
        changes: &'a Changes,
        node: PlanNode,
        terms: SwapTerms,
        receipt: &'a mut Receipt,
    ) -> Self {
        Self { changes, candidate: Candidate::new(changes, node, terms), receipt }
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
        let (place, neighbours) = {
            let mut live = self.changes.live.lock();
            let place = live.place(None, &self.candidate.node);
            (place, live.plan.with(&self.candidate.node).neighbours(&self.candidate.node.name))
        };
        self.candidate.move_in(place, &neighbours)?;
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
        self.changes.live.lock().remove(&self.candidate.node.name);
        let _ = self.changes.monitor.send(Message::Replanned);
        self.candidate.end_host();
    }
}
