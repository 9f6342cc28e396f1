//! How an instance of a node becomes the node, and how its predecessor takes over again.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use carril_messages::Stamp;

use super::NodeEvent;
use super::role::{FreezeTerms, Probation, ProbationTerms, Role};
use super::slot::{After, Slot, Surroundings, text_of};
use crate::handover::{Handover, StepRecord};
use crate::node::Published;
use crate::operator::Trigger;
use crate::positions::Positions;
use crate::registry::vacant;

/// What an instance on trial has to say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrialNews {
    /// The node.
    pub node: String,
    /// The instance.
    pub seat: u32,
    /// `Ok`: it has passed its probation. `Err`: why it failed; it has stopped.
    pub result: Result<(), String>,
}

impl Slot {
    /// Nothing of it comes out any more, its operator and what that held are gone.
    pub(super) fn retire(&mut self) {
        self.gate.shut();
        self.role = Role::Retired;
        self.vacate();
    }

    fn vacate(&mut self) {
        self.vacant = true;
        let node = &mut self.node;
        // An operator that has panicked may panic once more while it is dropped.
        let _ = catch_unwind(AssertUnwindSafe(|| node.install(vacant())));
    }

    /// Ends the trial of this instance.
    pub(super) fn fail_trial(&mut self, reason: String, around: &Surroundings) -> After {
        self.break_down();
        self.retire();
        let (node, seat) = (self.node.name().to_owned(), self.seat);
        // The process may be on its way down; then nobody is left to tell.
        let _ = around.events.send(NodeEvent::Trial(TrialNews { node, seat, result: Err(reason) }));
        After::Nothing
    }

    pub(super) fn step_in_shadow(&mut self, trigger: Trigger, around: &Surroundings) -> After {
        let (report, sent) = match self.run_quietly(trigger, around) {
            Ok(done) => done,
            Err(panic) => return self.fail_trial(panic, around),
        };
        let may_err = matches!(&self.role, Role::Shadow(shadow) if shadow.may_err);
        if let Some(error) = report.error.filter(|_| !may_err) {
            return self.fail_trial(format!("a step failed: {error}"), around);
        }
        if let Err(garbage) = self.check_outputs(&sent) {
            return self.fail_trial(garbage, around);
        }
        let Role::Shadow(shadow) = &self.role else { return After::Nothing };
        for sample in &sent {
            (shadow.hear)(self.node.outputs()[sample.port].name, &sample.header, &sample.message);
        }
        After::Nothing
    }

    pub(super) fn step_on_probation(&mut self, trigger: Trigger, around: &Surroundings) -> After {
        let began = around.clock.now();
        let (report, sent) = match self.run_quietly(trigger, around) {
            Ok(done) => done,
            Err(panic) => return self.fail_trial(panic, around),
        };
        if let Err(garbage) = self.check_outputs(&sent) {
            return self.fail_trial(garbage, around);
        }
        if let Some(stop) = &report.stop {
            let (age, max) = (stop.age.as_secs_f64() * 1e3, stop.max_age.as_secs_f64() * 1e3);
            return self.fail_trial(
                format!("port `{}`: samples are {age:.1} ms old, allowed are {max} ms", stop.port),
                around,
            );
        }
        let Role::Probation(probation) = &mut self.role else { return After::Nothing };
        match &report.error {
            Some(error) if !probation.terms.may_err => {
                return self.fail_trial(format!("a step failed: {error}"), around);
            }
            _ => {}
        }
        let outputs = &self.outputs;
        let came_out = self.gate.pass(|| {
            for sample in &sent {
                outputs[sample.port].publish(&sample.header, &sample.message);
            }
        });
        if !came_out {
            return After::Nothing;
        }
        let record = self.node.record(probation.next_number, began, trigger);
        probation.next_number += 1;
        (probation.terms.tell)(record);
        if report.overrun {
            if probation.terms.overruns == 0 {
                let took = report.took.as_secs_f64() * 1e3;
                return self
                    .fail_trial(format!("too many steps miss the deadline; the last one took {took:.1} ms"), around);
            }
            probation.terms.overruns -= 1;
        }
        let was_due = probation.terms.outputs > 0;
        probation.terms.outputs = probation.terms.outputs.saturating_sub(sent.len() as u64);
        if was_due && probation.terms.outputs == 0 {
            let (node, seat) = (self.node.name().to_owned(), self.seat);
            let _ = around.events.send(NodeEvent::Trial(TrialNews { node, seat, result: Ok(()) }));
        }
        After::Nothing
    }

    /// Whether everybody could read what a step sent. Only on trial: it costs.
    fn check_outputs(&self, sent: &[Published]) -> Result<(), String> {
        for sample in sent {
            let port = self.node.outputs()[sample.port].name;
            crate::shadow::check(&sample.header, sample.message.as_ref())
                .map_err(|reason| format!("port `{port}`: it publishes garbage: {reason}"))?;
        }
        Ok(())
    }

    /// Takes nothing from now on and keeps everything. Says from where on it has everything.
    pub(super) fn hold(&mut self) -> Result<Vec<(String, Positions)>, String> {
        match self.role {
            Role::Shadow(_) | Role::Held(_) => {
                self.node.keep_all(true);
                self.role = Role::Held(Vec::new());
                Ok(self.node.received())
            }
            ref other => Err(format!("it is not in shadow, but {}", other.name())),
        }
    }

    /// Stops as soon as it has received what its successor will not keep, and hands over. `Ok(None)`: not yet.
    pub(super) fn freeze(
        &mut self,
        at_least: &[(String, Positions)],
        FreezeTerms { fresh, let_go, rests }: FreezeTerms,
        (due, around): (Option<Instant>, &Surroundings),
    ) -> Result<Option<Handover>, String> {
        if !self.role.is_the_node() || self.is_down() {
            let role = if self.is_down() { "down" } else { self.role.name() };
            return Err(format!("it does not run: it is {role}"));
        }
        if !self.node.has_received(at_least) {
            return Ok(None);
        }
        self.node.keep_all(true);
        let now = around.clock.now();
        let next_period = due.map(|due| now + due.saturating_duration_since(Instant::now()));
        let handover = match self.node.hand_over(fresh, next_period) {
            Ok(handover) => handover,
            Err(error) => {
                self.node.wait_is_over();
                return Err(format!("its state cannot be written: {error}"));
            }
        };
        if rests {
            self.node.keep_all(false);
            self.role = Role::Resting;
        } else {
            self.role = Role::Following(VecDeque::new());
        }
        if let_go {
            self.handed_state = self.node.snapshot().ok();
            self.vacate();
        }
        Ok(Some(handover))
    }

    /// Becomes the node, on probation.
    pub(super) fn activate(
        &mut self,
        handover: Handover,
        terms: ProbationTerms,
        around: &Surroundings,
    ) -> Result<After, String> {
        let Role::Held(words) = &mut self.role else { return Err(format!("it is not held, but {}", self.role.name())) };
        let words = std::mem::take(words);
        if self.vacant {
            let operator = self.recipe.build().map_err(|error| format!("it cannot be built: {error}"))?;
            self.node.install(operator);
            self.vacant = false;
        }
        let next_period = handover.next_period;
        let (node, now) = (&mut self.node, around.clock.now());
        let taken = catch_unwind(AssertUnwindSafe(|| node.take_over(handover, now)));
        match taken {
            Ok(Ok(())) => {}
            Ok(Err(refused)) => {
                self.retire();
                return Err(format!("it refuses the state: {refused}"));
            }
            Err(panic) => {
                self.retire();
                return Err(format!("it panicked while it took over the state: {}", text_of(panic.as_ref())));
            }
        }
        self.role = Role::Probation(Probation { terms, next_number: 0 });
        for word in words {
            self.control(word, around);
        }
        let due = next_period.map(|due| Instant::now() + remaining(due, around.clock.now()));
        Ok(due.map_or(After::Nothing, After::PeriodAt))
    }

    /// Its successor has made a step.
    pub(super) fn hear_of_step(&mut self, record: StepRecord, around: &Surroundings) {
        for (port, next) in &record.next_seq {
            if let Some(output) = self.outputs.iter().find(|output| output.port == port) {
                output.came_out.borrow_mut().with_successors.extend_to(self.node.epoch(), *next);
            }
        }
        match &mut self.role {
            Role::Following(records) => {
                records.push_back(record);
                self.follow(around);
            }
            Role::Resting => self.node.set_next_seq(&record.next_seq),
            _ => {}
        }
    }

    /// Makes the steps of its successor, all but the last, as far as the samples are here.
    pub(super) fn follow(&mut self, around: &Surroundings) {
        while let Role::Following(records) = &mut self.role {
            let Some(record) = (records.len() > 1).then(|| &records[0]) else { return };
            if !self.node.has_received(&record.consumed) {
                return;
            }
            let Some(record) = records.pop_front() else { return };
            self.make_step(&record, false, around);
        }
    }

    fn make_step(&mut self, record: &StepRecord, publish: bool, around: &Surroundings) {
        if self.vacant || self.is_down() {
            self.node.set_next_seq(&record.next_seq);
            return;
        }
        let (node, outputs, clock) = (&mut self.node, &self.outputs, around.clock.as_ref());
        let span = self.span.enter();
        let made = catch_unwind(AssertUnwindSafe(|| {
            node.set_wanted(&|port| publish && outputs[port].wanted());
            node.follow(record, around.buffers.as_ref(), &|_| clock.now(), &mut |sample| {
                if publish {
                    outputs[sample.port].publish(&sample.header, &sample.message);
                }
            })
        }));
        drop(span);
        if let Err(panic) = made {
            let text = text_of(panic.as_ref());
            tracing::error!("node `{}`: the version before panicked while it followed: {text}", self.node.name());
            self.break_down();
        }
    }

    /// Is the node again. `repeat_last`: the successor died, so that the outputs of its last step may not have come out; they
    /// are published with the same numbers, and readers leave out what they have.
    pub(super) fn thaw(&mut self, repeat_last: bool, around: &Surroundings) -> Result<(), String> {
        match &mut self.role {
            Role::Following(records) => {
                let records = std::mem::take(records);
                let last = records.len().saturating_sub(1);
                for (at, record) in records.iter().enumerate() {
                    self.make_step(record, repeat_last && at == last, around);
                }
            }
            Role::Resting => {}
            role if role.is_the_node() => return Ok(()),
            other => return Err(format!("it is {}", other.name())),
        }
        if self.vacant {
            self.rebuild()?;
        }
        self.role = Role::Active;
        self.node.wait_is_over();
        Ok(())
    }

    /// Builds the operator anew, with the state that it had handed over.
    fn rebuild(&mut self) -> Result<(), String> {
        let mut operator = self.recipe.build().map_err(|error| format!("it cannot be built again: {error}"))?;
        if let Some((version, state)) = &self.handed_state {
            operator.restore(*version, state).map_err(|error| format!("it refuses its own state: {error}"))?;
        }
        self.node.install(operator);
        self.vacant = false;
        Ok(())
    }

    /// Its probation is over.
    pub(super) fn commit(&mut self) {
        if matches!(self.role, Role::Probation(_)) {
            self.role = Role::Active;
        }
    }

    /// Goes on with another configuration, between two steps. On failure nothing has changed. A period that comes from the
    /// configuration follows it.
    pub(super) fn set_config(&mut self, config: serde_json::Value) -> Result<After, String> {
        if !self.role.is_the_node() || self.is_down() {
            return Err(format!("node `{}` does not run now; try again in a moment", self.node.name()));
        }
        let before = std::mem::replace(&mut self.recipe.config, config);
        if let Err(reason) = self.reconfigure() {
            self.recipe.config = before;
            return Err(reason);
        }
        let kind = &self.recipe.kind;
        let (old, new) = (kind.period(&before), kind.period(&self.recipe.config));
        if old == new || self.period != old {
            return Ok(After::Nothing);
        }
        self.period = new;
        Ok(new.map_or(After::Nothing, |period| After::PeriodAt(Instant::now() + period)))
    }

    fn reconfigure(&mut self) -> Result<(), String> {
        let node = &mut self.node;
        let config = &self.recipe.config;
        let done = catch_unwind(AssertUnwindSafe(|| node.reconfigure(config)));
        match done {
            Ok(Some(result)) => return result.map_err(|error| error.to_string()),
            Ok(None) => {}
            Err(panic) => return Err(format!("it panicked: {}", text_of(panic.as_ref()))),
        }
        if self.recipe.exclusive() {
            return Err("its device must be let go for that: use `carril swap`".into());
        }
        let operator = self.recipe.build().map_err(|error| error.to_string())?;
        let node = &mut self.node;
        match catch_unwind(AssertUnwindSafe(|| node.replace(operator))) {
            Ok(Ok(_before)) => Ok(()),
            Ok(Err(error)) => Err(format!("the state cannot be taken over: {error}")),
            Err(panic) => Err(format!("it panicked: {}", text_of(panic.as_ref()))),
        }
    }
}

fn remaining(due: Stamp, now: Stamp) -> std::time::Duration {
    if due > now { due.since(now).to_duration() } else { std::time::Duration::ZERO }
}
