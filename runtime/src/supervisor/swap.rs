//! Puts another version of a node in the place of the one that runs: shadow, hand-over, probation, and back again when it fails.
//! One thread carries one swap through; the samples go past it.
//!
//! At any time exactly one instance may publish. It passes from one to the other only through `Freeze` and `Activate`, and
//! back only when the candidate is known to be silent: it said so, or its process is dead.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use super::changes::{Changes, Failure};
use super::monitor::{Host, HostNews, Message};
use super::observer::Observer;
use super::plan::{PlanBody, PlanNode};
use crate::control_plane::{Outcome, Receipt, SwapTerms};
use crate::handover::Handover;
use crate::seats::{SeatAnswer, SeatName, SeatQuestion, SeatStatus, TrialReport, trial_key};
use crate::transport::Guard;

/// A process has this long to start.
const START_PATIENCE: Duration = Duration::from_secs(10);
/// A candidate that holds a device has this long to open it.
const DEVICE_PATIENCE: Duration = Duration::from_secs(10);
/// An instance that is to hand over has this long: it goes on until it has received what its successor has received.
const FREEZE_PATIENCE: Duration = Duration::from_secs(4);
/// A process that is killed has this long to be gone.
const DEATH_PATIENCE: Duration = Duration::from_secs(5);
/// How often a candidate is looked at.
const LOOK: Duration = Duration::from_millis(20);
/// One in so many steps on probation may miss its deadline.
const OVERRUN_SHARE: u64 = 10;

pub(super) struct Swap<'a> {
    changes: &'a Changes,
    before: PlanNode,
    after: PlanNode,
    terms: SwapTerms,
    receipt: &'a mut Receipt,
    old: SeatName,
    new: SeatName,
    /// The process of its own that the candidate came in.
    host: Option<HostHandle>,
    reports: Receiver<TrialReport>,
    _reports_guard: Option<Guard>,
    status: SeatStatus,
    exclusive: bool,
}

struct HostHandle {
    pid: u32,
    news: Receiver<HostNews>,
    dead: bool,
}

/// How a time of watching ended well.
#[derive(PartialEq, Eq)]
enum Watched {
    TimeIsUp,
    Passed,
}

impl<'a> Swap<'a> {
    pub(super) fn new(
        changes: &'a Changes,
        before: PlanNode,
        after: PlanNode,
        terms: SwapTerms,
        receipt: &'a mut Receipt,
    ) -> Self {
        let mut live = changes.live.lock();
        let old = SeatName { node: before.name.clone(), number: live.seat(&before.name) };
        let new = SeatName { node: before.name.clone(), number: live.new_seat() };
        drop(live);
        let (sender, reports) = channel();
        let guard = changes.transport.watch(&trial_key(&changes.robot, &before.name), move |_, _, payload| {
            if let Ok(report) = serde_json::from_slice(&payload) {
                // The swap may be over.
                let _ = sender.send(report);
            }
        });
        Self {
            changes,
            before,
            after,
            terms,
            receipt,
            old,
            new,
            host: None,
            reports,
            _reports_guard: guard.ok(),
            status: SeatStatus::default(),
            exclusive: false,
        }
    }

    /// Carries it through.
    pub(super) fn run(mut self) -> Result<(), Failure> {
        let began = Instant::now();
        let ports = self.changes.live.lock().plain_outputs(&self.before.name);
        let observer = Observer::watch(&self.changes.transport, &self.changes.robot, &self.before.name, &ports)
            .map_err(|error| failure("request", error.to_string()))?;
        let result = self.trial(began);
        let observed = observer.observation();
        self.receipt.gap_ms = observed.longest_gap_ms;
        self.receipt.usual_gap_ms = observed.usual_gap_ms;
        self.receipt.lost += observed.lost;
        self.receipt.duplicated += observed.duplicated;
        self.receipt.compared = self.status.compared;
        self.receipt.largest_difference.clone_from(&self.status.largest_difference);
        self.receipt.latency_after_us = self.status.latency_us;
        result
    }

    fn trial(&mut self, began: Instant) -> Result<(), Failure> {
        self.start_host()?;
        let prepared = self.prepare().and_then(|()| self.shadow());
        if let Err(failure) = prepared {
            self.drop_candidate();
            return Err(failure);
        }
        if self.terms.compare_only {
            let question = SeatQuestion::Status(self.old.clone());
            if let Ok(SeatAnswer::Status(status)) = self.changes.ask(&self.before.process, &question) {
                self.receipt.latency_before_us = status.latency_us;
            }
            self.receipt.outcome = Outcome::Compared;
            self.drop_candidate();
            return Ok(());
        }
        self.take_over()?;
        let shadow = Duration::from_millis(if self.exclusive { 0 } else { self.terms.shadow_ms });
        self.receipt.took_ms = Some(began.elapsed().saturating_sub(shadow).as_secs_f64() * 1e3);
        match self.probation() {
            Ok(()) => {
                self.commit();
                Ok(())
            }
            Err(failure) => Err(self.roll_back(failure)),
        }
    }

    /// A binary of the user's own, and what is to leave one, comes in a process of its own.
    fn start_host(&mut self) -> Result<(), Failure> {
        if self.before.body == self.after.body
            || matches!((&self.before.body, &self.after.body), (PlanBody::Operator(_), PlanBody::Operator(_)))
        {
            return Ok(());
        }
        let program = match &self.after.body {
            PlanBody::Exec { path, operator } => {
                let copy = self.keep_binary(path).map_err(|reason| failure("start", reason))?;
                self.after.body = PlanBody::Exec { path: copy.clone(), operator: operator.clone() };
                Some(copy)
            }
            PlanBody::Operator(_) | PlanBody::Elsewhere => None,
        };
        let mut live = self.changes.live.lock();
        let process = live.new_process(&self.before.process);
        let mut connect = live.plan.neighbours(&self.before.name);
        drop(live);
        if !connect.contains(&self.before.process) {
            connect.push(self.before.process.clone());
        }
        self.after.process.clone_from(&process);
        let (sender, news) = channel();
        let message = Message::StartHost { host: Host { process, program, connect }, news: sender };
        // When the monitor is gone, the channel below says so.
        let _ = self.changes.monitor.send(message);
        match news.recv_timeout(START_PATIENCE) {
            Ok(HostNews::Ready { pid }) => {
                self.host = Some(HostHandle { pid, news, dead: false });
                Ok(())
            }
            Ok(HostNews::Ended { how }) => Err(failure("start", format!("the candidate does not start: {how}"))),
            Err(_) => {
                let process = self.after.process.clone();
                let _ = self.changes.monitor.send(Message::EndProcess { process, at_once: true });
                Err(failure("start", format!("the candidate was not ready within {} s", START_PATIENCE.as_secs())))
            }
        }
    }

    /// The binary as it is now: the user may build another one over it, and `rollback` must find this one.
    fn keep_binary(&self, path: &Path) -> Result<PathBuf, String> {
        let dir = self.changes.dir.join("bin").join(self.new.number.to_string());
        let name = path.file_name().ok_or_else(|| format!("`{}` names no file", path.display()))?;
        let copy = dir.join(name);
        if path == copy {
            return Ok(copy);
        }
        std::fs::create_dir_all(&dir).map_err(|error| format!("`{}`: {error}", dir.display()))?;
        std::fs::copy(path, &copy)
            .map(|_| copy)
            .map_err(|error| format!("`{}`: {error}; build it first, and give its path", path.display()))
    }

    fn prepare(&mut self) -> Result<(), Failure> {
        let (old_process, new_process) = (self.before.process.clone(), self.after.process.clone());
        let failed = |reason: String| failure("prepare", reason);
        self.changes
            .ask(&old_process, &SeatQuestion::Attend { seat: self.old.clone(), successor: self.new.number })
            .map_err(failed)?;
        if old_process != new_process {
            let question = SeatQuestion::ListenOutsideTo(self.before.name.clone());
            self.changes.ask(&old_process, &question).map_err(failed)?;
        }
        let state = if self.terms.fresh { None } else { self.snapshot().map_err(failed)? };
        let state = self.state_for_candidate(state).map_err(failed)?;
        let (plan, mut neighbours) = {
            let live = self.changes.live.lock();
            let mut plan = live.plan.clone();
            if let Some(node) = plan.node_mut(&self.after.name) {
                node.clone_from(&self.after);
            }
            (plan, live.plan.neighbours(&self.before.name))
        };
        if !neighbours.contains(&old_process) {
            neighbours.push(old_process);
        }
        let plan = serde_json::to_string(&plan).map_err(|error| failed(error.to_string()))?;
        let question = SeatQuestion::Prepare { seat: self.new.clone(), plan, state, neighbours };
        match self
            .changes
            .ask_for(&new_process, &question, START_PATIENCE)
            .map_err(|reason| self.for_better_reason(failed(reason)))?
        {
            SeatAnswer::Prepared { exclusive, state_version } => {
                self.exclusive = exclusive;
                if let Some((before, _)) = self.receipt.state_versions {
                    self.receipt.state_versions = Some((before, state_version));
                }
                Ok(())
            }
            other => Err(failed(format!("unexpected answer: {other:?}"))),
        }
    }

    /// The state of another kind means nothing to the candidate. An empty one is not missed.
    fn state_for_candidate(&mut self, state: Option<(u32, Vec<u8>)>) -> Result<Option<(u32, Vec<u8>)>, String> {
        let live = self.changes.live.lock();
        let names = (live.kind(&self.before.body), live.kind(&self.after.body));
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
                self.terms.fresh = true;
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
            other => Err(format!("unexpected answer: {other:?}")),
        }
    }

    fn shadow(&mut self) -> Result<(), Failure> {
        if self.exclusive || self.terms.shadow_ms == 0 {
            return if self.exclusive && self.terms.compare_only {
                Err(failure("shadow", "the node holds a device that no second instance can have"))
            } else {
                Ok(())
            };
        }
        let beside = (self.before.process == self.after.process).then_some(self.old.number);
        let question = SeatQuestion::Compare { candidate: self.new.clone(), beside };
        self.changes.ask(&self.after.process, &question).map_err(|reason| failure("shadow", reason))?;
        let until = Instant::now() + Duration::from_millis(self.terms.shadow_ms);
        self.watch("shadow", until).map(|_| ())
    }

    fn take_over(&mut self) -> Result<(), Failure> {
        let at_least = match self.changes.ask(&self.after.process, &SeatQuestion::Hold(self.new.clone())) {
            Ok(SeatAnswer::Held(positions)) => positions,
            Ok(other) => return Err(self.abandon("hand-over", format!("unexpected answer: {other:?}"))),
            Err(reason) => return Err(self.abandon("hand-over", reason)),
        };
        let (seat, fresh, let_go) = (self.old.clone(), self.terms.fresh, self.exclusive);
        let handover = match self.changes.ask_for(
            &self.before.process,
            &SeatQuestion::Freeze { seat, at_least, fresh, let_go },
            FREEZE_PATIENCE,
        ) {
            Ok(SeatAnswer::Handover(handover, latency)) => {
                self.receipt.latency_before_us = latency;
                handover
            }
            Ok(other) => return Err(self.abandon("hand-over", format!("unexpected answer: {other:?}"))),
            Err(reason) => {
                // It may have stopped all the same.
                let failed = failure("hand-over", reason);
                return Err(self.roll_back(failed));
            }
        };
        self.note(&handover);
        // From here on a process that is started again builds the new version.
        self.replan(self.after.clone(), self.new.number);
        let patience = if self.exclusive { DEVICE_PATIENCE } else { Duration::from_secs(2) };
        let question = SeatQuestion::Activate {
            seat: self.new.clone(),
            handover,
            outputs: self.terms.probation_outputs,
            overruns: self.terms.probation_outputs / OVERRUN_SHARE,
            may_err: self.exclusive,
        };
        match self.changes.ask_for(&self.after.process, &question, patience) {
            Ok(_) => Ok(()),
            Err(reason) => {
                let failed = self.for_better_reason(failure("hand-over", reason));
                Err(self.roll_back(failed))
            }
        }
    }

    fn note(&mut self, handover: &Handover) {
        self.receipt.queued = handover.queued();
        self.receipt.state_bytes = handover.state.as_ref().map(|(_, state)| state.len() as u64);
    }

    fn probation(&mut self) -> Result<(), Failure> {
        let until = Instant::now() + Duration::from_millis(self.terms.probation_ms);
        self.watch("probation", until).map(|_| ())
    }

    fn commit(&mut self) {
        let results = [
            self.changes.ask(&self.after.process, &SeatQuestion::Commit(self.new.clone())),
            self.changes.ask(&self.before.process, &SeatQuestion::Retire(self.old.clone())),
        ];
        for error in results.into_iter().filter_map(Result::err) {
            tracing::debug!("{error}");
        }
        let mut live = self.changes.live.lock();
        live.keep_before(self.before.clone());
        let empty = !live.plan.has_nodes_in(&self.before.process);
        drop(live);
        if self.host.is_some() {
            let _ = self.changes.monitor.send(Message::Adopt { process: self.after.process.clone() });
        }
        if empty {
            let process = self.before.process.clone();
            let _ = self.changes.monitor.send(Message::EndProcess { process, at_once: false });
        }
    }

    /// Gives up before anything was taken over.
    fn abandon(&mut self, phase: &'static str, reason: String) -> Failure {
        let failed = self.for_better_reason(failure(phase, reason));
        self.drop_candidate();
        failed
    }

    /// The version before goes on. First the candidate must be silent.
    fn roll_back(&mut self, failure: Failure) -> Failure {
        self.silence_candidate();
        self.replan(self.before.clone(), self.old.number);
        let thaw = SeatQuestion::Thaw { seat: self.old.clone(), repeat_last: self.host.is_some() };
        let patience = if self.exclusive { DEVICE_PATIENCE } else { Duration::from_secs(2) };
        let thawed = self.changes.ask_for(&self.before.process, &thaw, patience);
        self.end_host();
        let reason = match thawed {
            Ok(_) => failure.reason,
            Err(error) => format!("{}; and the version before does not go on: {error}", failure.reason),
        };
        Failure { reason, rolled_back: true, ..failure }
    }

    fn replan(&self, node: PlanNode, seat: u32) {
        let name = node.name.clone();
        self.changes.live.lock().replace(node, seat);
        let _ = self.changes.monitor.send(Message::Replanned { node: name });
    }

    /// Afterwards nothing of the candidate comes out: it has said so, or its process is dead.
    fn silence_candidate(&mut self) {
        let dead = self.host.as_ref().is_some_and(|host| host.dead);
        if !dead && self.changes.ask(&self.after.process, &SeatQuestion::Retire(self.new.clone())).is_err() {
            self.kill_host();
        }
    }

    /// The candidate goes; the active instance no longer expects a successor.
    fn drop_candidate(&mut self) {
        self.silence_candidate();
        self.end_host();
        let thaw = SeatQuestion::Thaw { seat: self.old.clone(), repeat_last: false };
        if let Err(error) = self.changes.ask(&self.before.process, &thaw) {
            tracing::debug!("{error}");
        }
    }

    fn kill_host(&mut self) {
        let Some(host) = &mut self.host else { return };
        let process = self.after.process.clone();
        let _ = self.changes.monitor.send(Message::EndProcess { process, at_once: true });
        let deadline = Instant::now() + DEATH_PATIENCE;
        while !host.dead {
            match host.news.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(HostNews::Ended { .. }) => host.dead = true,
                Ok(HostNews::Ready { .. }) => {}
                Err(_) => break,
            }
        }
    }

    fn end_host(&mut self) {
        if self.host.as_ref().is_some_and(|host| !host.dead) {
            self.kill_host();
        }
    }

    /// If the candidate has said why it failed, or its process has died, that is the better reason.
    fn for_better_reason(&self, failure: Failure) -> Failure {
        while let Ok(report) = self.reports.recv_timeout(LOOK) {
            if let (true, Err(reason)) = (report.seat == self.new, report.result) {
                return Failure { reason, ..failure };
            }
        }
        let Some(host) = &self.host else { return failure };
        match host.news.recv_timeout(LOOK) {
            Ok(HostNews::Ended { how }) => Failure { reason: format!("its process died: {how}"), ..failure },
            _ => failure,
        }
    }

    /// Looks on until the time is up, the probation is passed, or the candidate fails.
    fn watch(&mut self, phase: &'static str, until: Instant) -> Result<Watched, Failure> {
        let mut unanswered: Option<Instant> = None;
        let stall = Duration::from_millis(self.terms.stall_ms);
        loop {
            while let Ok(report) = self.reports.try_recv() {
                if report.seat == self.new {
                    match report.result {
                        Ok(()) if phase == "probation" => {
                            // For its latencies; it has passed in any case.
                            let _ = self.look(stall);
                            return Ok(Watched::Passed);
                        }
                        Ok(()) => {}
                        Err(reason) => return Err(failure(phase, reason)),
                    }
                }
            }
            if let Some(host) = &mut self.host {
                if let Ok(HostNews::Ended { how }) = host.news.try_recv() {
                    host.dead = true;
                    return Err(failure(phase, format!("its process died: {how}")));
                }
                let limit = self.terms.memory_limit_mb;
                if let Some(used) = own_memory_mb(host.pid).filter(|used| *used > limit) {
                    let reason = format!("it uses {used} MB of memory, allowed are {limit} MB (--memory-limit-mb)");
                    return Err(failure(phase, reason));
                }
            }
            match self.look(stall) {
                Ok(()) => unanswered = None,
                Err(reason) => {
                    let since = *unanswered.get_or_insert_with(Instant::now);
                    if since.elapsed() >= stall {
                        return Err(self.for_better_reason(failure(phase, reason)));
                    }
                }
            }
            let ms = self.terms.stall_ms as f64;
            if let Some(busy) = self.status.busy_ms.filter(|busy| *busy > ms) {
                return Err(failure(phase, format!("it stalls: a step has been running for {busy:.0} ms")));
            }
            if let Some(waiting) = self.status.waiting_ms.filter(|waiting| *waiting > ms) {
                return Err(failure(phase, format!("it stalls: a sample has been waiting for {waiting:.0} ms")));
            }
            let now = Instant::now();
            if now >= until {
                return Ok(Watched::TimeIsUp);
            }
            std::thread::sleep(LOOK.min(until - now));
        }
    }

    fn look(&mut self, patience: Duration) -> Result<(), String> {
        let question = SeatQuestion::Status(self.new.clone());
        match self.changes.ask_for(&self.after.process, &question, patience)? {
            SeatAnswer::Status(status) => {
                let compared = status.compared.max(self.status.compared);
                let before = std::mem::replace(&mut self.status, status);
                if self.status.compared < compared {
                    // The comparison ended with the take-over; its result stays.
                    self.status.compared = compared;
                    self.status.different = before.different;
                    self.status.largest_difference = before.largest_difference;
                }
                self.status.latency_us = self.status.latency_us.or(before.latency_us);
                Ok(())
            }
            other => Err(format!("unexpected answer: {other:?}")),
        }
    }
}

fn failure(phase: &'static str, reason: impl Into<String>) -> Failure {
    Failure { phase, reason: reason.into(), rolled_back: false }
}

/// Memory of a process that it shares with no other, MB. `None`: it is gone.
fn own_memory_mb(pid: u32) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:"))?;
    let kb: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kb / 1024)
}
