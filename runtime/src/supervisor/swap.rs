//! Puts another version of a node in the place of the one that runs: shadow, hand-over, probation, and back again when it fails.
//! One thread carries one swap through; the samples go past it.
//!
//! At any time exactly one instance may publish. It passes from one to the other only through `Freeze` and `Activate`, and
//! back only when the candidate is known to be silent: it said so, or its process is dead.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use super::candidate::{Candidate, FREEZE_PATIENCE, Place, failure, unexpected};
use super::changes::{Changes, Failure};
use super::observer::Observer;
use super::plan::PlanNode;
use crate::control_plane::{Outcome, Receipt, SwapTerms};
use crate::numbers::Numbers;
use crate::seats::{SeatAnswer, SeatName, SeatQuestion};

/// For the best moment to take over it is waited at most this long.
const LONGEST_WAIT_FOR_OUTPUT: Duration = Duration::from_millis(100);

pub(super) struct Swap<'a> {
    changes: &'a Changes,
    before: PlanNode,
    old: SeatName,
    candidate: Candidate<'a>,
    /// Inputs that read another output than before: what waits there is of no use to the candidate, and what comes there now the
    /// version before does not get.
    rewired: Vec<String>,
    /// Where the candidate runs, if that was said.
    place: Option<Place>,
    receipt: &'a mut Receipt,
}

impl<'a> Swap<'a> {
    pub(super) fn new(
        changes: &'a Changes,
        before: PlanNode,
        after: PlanNode,
        terms: SwapTerms,
        receipt: &'a mut Receipt,
    ) -> Self {
        let old = SeatName { node: before.name.clone(), number: changes.live.lock().seat(&before.name) };
        let rewired = after.rewired(&before);
        let candidate = Candidate::new(changes, after, terms);
        Self { changes, before, old, candidate, rewired, place: None, receipt }
    }

    /// The candidate runs there.
    pub(super) fn into(mut self, place: Place) -> Self {
        self.place = Some(place);
        self
    }

    /// Carries it through. The process of the version before stays, even when it is empty then.
    pub(super) fn run(mut self) -> Result<(), Failure> {
        let began = Instant::now();
        let ports = self.changes.live.lock().plain_outputs(&self.before.name);
        let observer = Observer::watch(&self.changes.transport, &self.changes.robot, &self.before.name, &ports)
            .map_err(|error| failure("request", error.to_string()))?;
        let result = self.trial(began, &observer);
        if result.is_err() || self.receipt.outcome == Outcome::Compared {
            self.count(&observer, false);
        }
        let status = &self.candidate.status;
        self.receipt.compared = status.compared;
        self.receipt.largest_difference.clone_from(&status.largest_difference);
        self.receipt.latency_after_us = status.latency_us;
        result
    }

    /// Writes what the observer has seen into the receipt. `taken_over`: both instances are asked what came out of them; else the
    /// version before knows it of both.
    fn count(&mut self, observer: &Observer, taken_over: bool) {
        // Before the question: what comes later is not looked at.
        let seen = observer.seen();
        let mut came_out = HashMap::<String, Numbers>::new();
        let mut ask = |process: &str, seat: &SeatName| {
            let question = SeatQuestion::CameOut { seat: seat.clone(), with_successors: !taken_over };
            // An instance that does not answer is dead; what it had to say is not known.
            let Ok(SeatAnswer::CameOut(ports)) = self.changes.ask(process, &question) else { return };
            for (port, numbers) in ports {
                came_out.entry(port).or_default().merge(&numbers);
            }
        };
        ask(&self.before.process, &self.old);
        if taken_over {
            ask(&self.candidate.node.process, &self.candidate.seat);
        }
        let observed = seen.observation(&came_out);
        self.receipt.gap_ms = observed.longest_gap_ms;
        self.receipt.usual_gap_ms = observed.usual_gap_ms;
        self.receipt.lost += observed.lost;
        self.receipt.duplicated += observed.duplicated;
    }

    fn trial(&mut self, began: Instant, observer: &Observer) -> Result<(), Failure> {
        let up = |process: &str| self.changes.is_up(process);
        let usual = || self.changes.live.lock().place(Some(&self.before), &self.candidate.node, &up);
        let place = self.place.take().unwrap_or_else(usual);
        let mut neighbours = self.changes.live.lock().plan.with(&self.candidate.node).neighbours(&self.before.name);
        if !neighbours.contains(&self.before.process) {
            neighbours.push(self.before.process.clone());
        }
        self.candidate.move_in(place, &neighbours)?;
        let active = (self.before.process.clone(), self.old.number);
        let prepared =
            self.prepare(neighbours).and_then(|()| self.candidate.shadow(Some((active.0.as_str(), active.1))));
        if let Err(failure) = prepared {
            self.drop_candidate();
            return Err(failure);
        }
        if self.candidate.terms.compare_only {
            if let Ok(status) = self.changes.status_between_steps(&self.before.process, &self.old) {
                self.receipt.latency_before_us = status.latency_us;
            }
            self.receipt.outcome = Outcome::Compared;
            self.drop_candidate();
            return Ok(());
        }
        self.take_over(observer)?;
        let shadow = Duration::from_millis(if self.candidate.exclusive { 0 } else { self.candidate.terms.shadow_ms });
        self.receipt.took_ms = Some(began.elapsed().saturating_sub(shadow).as_secs_f64() * 1e3);
        match self.candidate.probation() {
            Ok(()) => {
                self.count(observer, true);
                self.commit();
                Ok(())
            }
            Err(failure) => Err(self.roll_back(failure)),
        }
    }

    fn prepare(&mut self, neighbours: Vec<String>) -> Result<(), Failure> {
        let old_process = &self.before.process;
        let failed = |reason: String| failure("prepare", reason);
        self.changes
            .ask(old_process, &SeatQuestion::Attend { seat: self.old.clone(), successor: self.candidate.seat.number })
            .map_err(failed)?;
        if *old_process != self.candidate.node.process {
            let question = SeatQuestion::ListenOutsideTo(self.before.name.clone());
            self.changes.ask(old_process, &question).map_err(failed)?;
        }
        let status = self.changes.status_between_steps(old_process, &self.old).map_err(failed)?;
        self.candidate.may_err = status.failing.is_some();
        let state = if self.candidate.terms.fresh { None } else { self.snapshot().map_err(failed)? };
        let state = self.state_for_candidate(state).map_err(failed)?;
        let state_version = self.candidate.prepare(state, neighbours)?;
        if let Some((_, after)) = &mut self.receipt.state_versions {
            *after = state_version;
        }
        Ok(())
    }

    /// The state of another kind means nothing to the candidate. An empty one is not missed.
    fn state_for_candidate(&mut self, state: Option<(u32, Vec<u8>)>) -> Result<Option<(u32, Vec<u8>)>, String> {
        let live = self.changes.live.lock();
        let names = (live.kind(&self.before.body), live.kind(&self.candidate.node.body));
        let (Some(before), Some(after)) = names else { return Ok(state) };
        if before.state_name == after.state_name {
            return Ok(state);
        }
        match state {
            Some((_, bytes)) if !bytes.is_empty() => Err(format!(
                "the state of `{}` ({} B) means nothing to `{}`; swap without it: --fresh",
                before.name,
                bytes.len(),
                after.name
            )),
            _ => {
                self.candidate.terms.fresh = true;
                self.receipt.state_versions = None;
                Ok(None)
            }
        }
    }

    fn snapshot(&mut self) -> Result<Option<(u32, Vec<u8>)>, String> {
        match self.changes.ask(&self.before.process, &SeatQuestion::Snapshot(self.old.clone()))? {
            SeatAnswer::State(version, state) => {
                self.receipt.state_versions = Some((version, version));
                Ok(Some((version, state)))
            }
            other => Err(unexpected(&other)),
        }
    }

    fn take_over(&mut self, observer: &Observer) -> Result<(), Failure> {
        if self.before.process == self.candidate.node.process {
            self.take_over_within()
        } else {
            // What is handed over crosses two links: begun just after an output, that is done before the next one is due.
            observer.wait_for_output(LONGEST_WAIT_FOR_OUTPUT);
            self.take_over_between()
        }
    }

    fn take_over_within(&mut self) -> Result<(), Failure> {
        match self.candidate.take_over_from(&self.old, &self.rewired) {
            Ok(handed) => {
                self.receipt.queued = handed.queued;
                self.receipt.state_bytes = handed.state_bytes;
                self.receipt.latency_before_us = handed.latency_us;
                // From here on a process that is started again builds the new version.
                self.changes.replan(&self.candidate.node, self.candidate.seat.number);
                Ok(())
            }
            Err(failed) => {
                let reason = failure("hand-over", failed.reason);
                let reason = self.candidate.for_better_reason(reason);
                Err(if failed.may_have_stopped { self.roll_back(reason) } else { self.abandon(reason) })
            }
        }
    }

    fn take_over_between(&mut self) -> Result<(), Failure> {
        let mut at_least = match self.candidate.hold() {
            Ok(positions) => positions,
            Err(reason) => return Err(self.abandon(failure("hand-over", reason))),
        };
        at_least.retain(|(input, _)| !self.rewired.contains(input));
        let freeze = SeatQuestion::Freeze {
            seat: self.old.clone(),
            at_least,
            fresh: self.candidate.terms.fresh,
            let_go: self.candidate.exclusive,
            rests: !self.rewired.is_empty(),
        };
        let mut handover = match self.changes.ask_for(&self.before.process, &freeze, FREEZE_PATIENCE) {
            Ok(SeatAnswer::Handover(handover, latency)) => {
                self.receipt.latency_before_us = latency;
                handover
            }
            Ok(other) => return Err(self.abandon(failure("hand-over", unexpected(&other)))),
            // It may have stopped all the same.
            Err(reason) => return Err(self.roll_back(failure("hand-over", reason))),
        };
        handover.inputs.retain(|input| !self.rewired.contains(&input.port));
        self.receipt.queued = handover.queued();
        self.receipt.state_bytes = handover.state_bytes();
        // From here on a process that is started again builds the new version.
        self.changes.replan(&self.candidate.node, self.candidate.seat.number);
        self.candidate.activate(handover).map_err(|failed| self.roll_back(failed))
    }

    fn commit(&mut self) {
        self.candidate.commit();
        if let Err(error) = self.changes.ask(&self.before.process, &SeatQuestion::Retire(self.old.clone())) {
            tracing::debug!("{error}");
        }
        self.changes.live.lock().keep_before(self.before.clone());
    }

    /// Gives up before anything was taken over.
    fn abandon(&mut self, failed: Failure) -> Failure {
        let failed = self.candidate.for_better_reason(failed);
        self.drop_candidate();
        failed
    }

    /// The version before goes on. First the candidate must be silent.
    fn roll_back(&mut self, failure: Failure) -> Failure {
        self.candidate.silence();
        self.changes.replan(&self.before, self.old.number);
        let thaw = SeatQuestion::Thaw { seat: self.old.clone(), repeat_last: self.candidate.has_own_host() };
        let thawed = self.changes.ask_for(&self.before.process, &thaw, self.candidate.take_over_patience());
        self.candidate.end_host();
        let reason = match thawed {
            Ok(_) => failure.reason,
            Err(error) => format!("{}; and the version before does not go on: {error}", failure.reason),
        };
        Failure { reason, rolled_back: true, ..failure }
    }

    /// The candidate goes; the active instance no longer expects a successor.
    fn drop_candidate(&mut self) {
        self.candidate.silence();
        self.candidate.end_host();
        let thaw = SeatQuestion::Thaw { seat: self.old.clone(), repeat_last: false };
        if let Err(error) = self.changes.ask(&self.before.process, &thaw) {
            tracing::debug!("{error}");
        }
    }
}
