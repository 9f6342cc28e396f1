//! An instance that is to become a node: where it runs, its trial, and its end when it fails. Whether it takes the place of another
//! or is new in the graph is the affair of whoever brings it in: [`Swap`](super::swap::Swap), [`Arrival`](super::apply::Arrival).

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use super::changes::{Changes, Failure};
use super::monitor::{Host, HostNews, Message};
use super::plan::{PlanBody, PlanNode};
use crate::control_plane::SwapTerms;
use crate::handover::Handover;
use crate::positions::Positions;
use crate::seats::{
    HandedOver, NotTakenOver, SeatAnswer, SeatName, SeatQuestion, SeatStatus, TrialReport, TrialTerms, trial_key,
};
use crate::transport::Guard;

/// A process has this long to start.
const START_PATIENCE: Duration = Duration::from_secs(10);
/// A candidate that holds a device has this long to open it.
pub(super) const DEVICE_PATIENCE: Duration = Duration::from_secs(10);
/// An instance that is to hand over has this long: it goes on until it has received what its successor has received.
pub(super) const FREEZE_PATIENCE: Duration = Duration::from_secs(4);
/// A process that is killed has this long to be gone.
const DEATH_PATIENCE: Duration = Duration::from_secs(5);
/// How often a candidate is looked at.
const LOOK: Duration = Duration::from_millis(20);
/// One in so many steps on probation may miss its deadline.
const OVERRUN_SHARE: u64 = 10;

/// A version that has sent so many outputs is not silent, so that its successor must not be, either.
const NOT_SILENT: u64 = 3;

/// Where a candidate runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// In a process that is up.
    Running(String),
    /// In a process that is started for it.
    New {
        process: String,
        /// It is a binary of the user's own.
        own_binary: bool,
    },
}

pub(super) struct Candidate<'a> {
    changes: &'a Changes,
    pub node: PlanNode,
    pub seat: SeatName,
    pub terms: SwapTerms,
    /// It holds a device: it is built when it takes over, and runs no shadow.
    pub exclusive: bool,
    /// Its steps may fail: those of the version before do, too.
    pub may_err: bool,
    pub status: SeatStatus,
    /// The process that was started for it.
    host: Option<HostHandle>,
    reports: Receiver<TrialReport>,
    _reports_guard: Option<Guard>,
}

struct HostHandle {
    pid: u32,
    news: Receiver<HostNews>,
    dead: bool,
}

pub(super) fn failure(phase: &'static str, reason: impl Into<String>) -> Failure {
    Failure { phase, reason: reason.into(), rolled_back: false }
}

impl<'a> Candidate<'a> {
    pub(super) fn new(changes: &'a Changes, node: PlanNode, terms: SwapTerms) -> Self {
        let seat = SeatName { node: node.name.clone(), number: changes.live.lock().new_seat() };
        let (sender, reports) = channel();
        let guard = changes.transport.watch(&trial_key(&changes.robot, &node.name), move |_, _, payload| {
            if let Ok(report) = serde_json::from_slice(&payload) {
                // The trial may be over.
                let _ = sender.send(report);
            }
        });
        Self {
            changes,
            node,
            seat,
            terms,
            exclusive: false,
            may_err: false,
            status: SeatStatus::default(),
            host: None,
            reports,
            _reports_guard: guard.ok(),
        }
    }

    /// Whether a process was started for it.
    pub(super) fn has_own_host(&self) -> bool {
        self.host.is_some()
    }

    /// Goes where it is to run, with links to `neighbours`: processes.
    pub(super) fn move_in(&mut self, place: Place, neighbours: &[String]) -> Result<(), Failure> {
        match place {
            Place::Running(process) => {
                for neighbour in neighbours.iter().filter(|neighbour| **neighbour != process) {
                    self.changes.link(&process, neighbour).map_err(|reason| failure("start", reason))?;
                }
                self.node.process = process;
                Ok(())
            }
            Place::New { process, own_binary } => {
                self.node.process.clone_from(&process);
                let program = if own_binary { Some(self.keep_binary()?) } else { None };
                self.start_host(Host { process, program, connect: neighbours.to_vec() })
            }
        }
    }

    /// The binary as it is now: the user may build another one over it, and `rollback` must find this one.
    fn keep_binary(&mut self) -> Result<PathBuf, Failure> {
        let PlanBody::Exec { path, .. } = &mut self.node.body else {
            return Err(failure("start", "it is no binary of its own"));
        };
        let kept = keep(path, &self.changes.dir.join("bin").join(self.seat.number.to_string()));
        let kept = kept.map_err(|reason| failure("start", reason))?;
        path.clone_from(&kept);
        Ok(kept)
    }

    fn start_host(&mut self, host: Host) -> Result<(), Failure> {
        let (sender, news) = channel();
        // When the monitor is gone, the channel below says so.
        let _ = self.changes.monitor.send(Message::StartHost { host, news: sender });
        match news.recv_timeout(START_PATIENCE) {
            Ok(HostNews::Ready { pid }) => {
                self.host = Some(HostHandle { pid, news, dead: false });
                Ok(())
            }
            Ok(HostNews::Ended { how }) => Err(failure("start", format!("the candidate does not start: {how}"))),
            Err(_) => {
                self.end_process(true);
                Err(failure("start", format!("the candidate was not ready within {} s", START_PATIENCE.as_secs())))
            }
        }
    }

    fn end_process(&self, at_once: bool) {
        let _ = self.changes.monitor.send(Message::EndProcess { process: self.node.process.clone(), at_once });
    }

    fn ask(&self, question: &SeatQuestion) -> Result<SeatAnswer, String> {
        self.changes.ask(&self.node.process, question)
    }

    /// Is built, in shadow, and hears all that its `neighbours` send. The version of its state.
    pub(super) fn prepare(&mut self, state: Option<(u32, Vec<u8>)>, neighbours: Vec<String>) -> Result<u32, Failure> {
        let failed = |reason: String| failure("prepare", reason);
        self.changes.serve_reliably(&self.node).map_err(failed)?;
        let plan = self.changes.live.lock().plan.with(&self.node);
        let plan = serde_json::to_string(&plan).map_err(|error| failed(error.to_string()))?;
        let question =
            SeatQuestion::Prepare { seat: self.seat.clone(), plan, state, may_err: self.may_err, neighbours };
        let answer = self.changes.ask_for(&self.node.process, &question, START_PATIENCE);
        match answer.map_err(|reason| self.for_better_reason(failed(reason)))? {
            SeatAnswer::Prepared { exclusive, state_version } => {
                self.exclusive = exclusive;
                Ok(state_version)
            }
            other => Err(failed(unexpected(&other))),
        }
    }

    /// Runs in shadow for as long as was asked for. `active`: the instance that it is compared with.
    pub(super) fn shadow(&mut self, active: Option<(&str, u32)>) -> Result<(), Failure> {
        if self.exclusive && self.terms.compare_only {
            return Err(failure("shadow", "the node holds a device that no second instance can have"));
        }
        if self.exclusive || self.terms.shadow_ms == 0 {
            return Ok(());
        }
        if let Some((process, number)) = active {
            let beside = (process == self.node.process).then_some(number);
            let question = SeatQuestion::Compare { candidate: self.seat.clone(), beside };
            self.ask(&question).map_err(|reason| failure("shadow", reason))?;
        }
        self.watch("shadow", Duration::from_millis(self.terms.shadow_ms))?;
        let SeatStatus { active_outputs, outputs, .. } = self.status;
        if outputs == 0 && active_outputs >= NOT_SILENT {
            let reason =
                format!("it sends nothing, and the version that runs has sent {active_outputs} outputs meanwhile");
            return Err(failure("shadow", reason));
        }
        Ok(())
    }

    /// Takes nothing from now on and keeps everything. From where on it has everything, by input.
    pub(super) fn hold(&self) -> Result<Vec<(String, Positions)>, String> {
        match self.ask(&SeatQuestion::Hold(self.seat.clone()))? {
            SeatAnswer::Held(positions) => Ok(positions),
            other => Err(unexpected(&other)),
        }
    }

    fn trial(&self) -> TrialTerms {
        let outputs = self.terms.probation_outputs;
        TrialTerms { outputs, overruns: outputs / OVERRUN_SHARE, may_err: self.exclusive || self.may_err }
    }

    /// A device may take its time.
    pub(super) fn take_over_patience(&self) -> Duration {
        if self.exclusive { DEVICE_PATIENCE } else { Duration::from_secs(2) }
    }

    /// Becomes the node, on probation.
    pub(super) fn activate(&self, handover: Box<Handover>) -> Result<(), Failure> {
        let question = SeatQuestion::Activate { seat: self.seat.clone(), handover, trial: self.trial() };
        let answer = self.changes.ask_for(&self.node.process, &question, self.take_over_patience());
        answer.map(|_| ()).map_err(|reason| self.for_better_reason(failure("hand-over", reason)))
    }

    /// Becomes the node in the place of an instance in the same process, on probation.
    pub(super) fn take_over_from(&self, active: &SeatName, rewired: &[String]) -> Result<HandedOver, NotTakenOver> {
        let question = SeatQuestion::TakeOver {
            candidate: self.seat.clone(),
            active: active.clone(),
            fresh: self.terms.fresh,
            let_go: self.exclusive,
            rewired: rewired.to_vec(),
            trial: self.trial(),
        };
        let unknown = |reason: String| NotTakenOver { may_have_stopped: true, reason };
        match self.changes.ask_for(&self.node.process, &question, FREEZE_PATIENCE + self.take_over_patience()) {
            Ok(SeatAnswer::TakenOver(result)) => result,
            Ok(other) => Err(unknown(unexpected(&other))),
            Err(reason) => Err(unknown(reason)),
        }
    }

    pub(super) fn probation(&mut self) -> Result<(), Failure> {
        self.watch("probation", Duration::from_millis(self.terms.probation_ms))?;
        // Time for its device was given, and is up.
        match &self.status.failing {
            Some(error) if self.exclusive && !self.may_err && self.status.good_steps == 0 => {
                Err(failure("probation", format!("none of its steps has gone well: {error}")))
            }
            _ => Ok(()),
        }
    }

    /// Is the node for good; its process is one like any other from now on.
    pub(super) fn commit(&self) {
        if let Err(error) = self.ask(&SeatQuestion::Commit(self.seat.clone())) {
            tracing::debug!("{error}");
        }
        if self.host.is_some() {
            let _ = self.changes.monitor.send(Message::Adopt { process: self.node.process.clone() });
        }
    }

    /// Afterwards nothing of it comes out: it has said so, or its process is dead.
    pub(super) fn silence(&mut self) {
        let dead = self.host.as_ref().is_some_and(|host| host.dead);
        if !dead && self.ask(&SeatQuestion::Retire(self.seat.clone())).is_err() {
            self.kill_host();
        }
    }

    /// The process that was started for it goes.
    pub(super) fn end_host(&mut self) {
        if self.host.as_ref().is_some_and(|host| !host.dead) {
            self.kill_host();
        }
    }

    fn kill_host(&mut self) {
        self.end_process_of_host();
        let Some(host) = &mut self.host else { return };
        let deadline = Instant::now() + DEATH_PATIENCE;
        while !host.dead {
            match host.news.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(HostNews::Ended { .. }) => host.dead = true,
                Ok(HostNews::Ready { .. }) => {}
                Err(_) => break,
            }
        }
    }

    fn end_process_of_host(&self) {
        if self.host.is_some() {
            self.end_process(true);
        }
    }

    /// If it has said why it failed, or its process has died, that is the better reason.
    pub(super) fn for_better_reason(&self, failure: Failure) -> Failure {
        while let Ok(report) = self.reports.recv_timeout(LOOK) {
            if let (true, Err(reason)) = (report.seat == self.seat, report.result) {
                return Failure { reason, ..failure };
            }
        }
        let Some(host) = &self.host else { return failure };
        match host.news.recv_timeout(LOOK) {
            Ok(HostNews::Ended { how }) => Failure { reason: format!("its process died: {how}"), ..failure },
            _ => failure,
        }
    }

    /// Looks on until the time is up, the probation is passed, or it fails.
    fn watch(&mut self, phase: &'static str, time: Duration) -> Result<(), Failure> {
        let until = Instant::now() + time;
        let stall = Duration::from_millis(self.terms.stall_ms);
        let mut unanswered: Option<Instant> = None;
        loop {
            if self.has_passed(phase)? {
                // For its latencies.
                let _ = self.look(stall);
                return Ok(());
            }
            self.check_host(phase)?;
            match self.look(stall) {
                Ok(()) => unanswered = None,
                Err(reason) => {
                    let since = *unanswered.get_or_insert_with(Instant::now);
                    if since.elapsed() >= stall {
                        return Err(self.for_better_reason(failure(phase, reason)));
                    }
                }
            }
            self.check_stall(phase)?;
            let now = Instant::now();
            if now >= until {
                return Ok(());
            }
            std::thread::sleep(LOOK.min(until - now));
        }
    }

    /// Whether it has said that its probation is over.
    fn has_passed(&self, phase: &'static str) -> Result<bool, Failure> {
        while let Ok(report) = self.reports.try_recv() {
            match report.result {
                _ if report.seat != self.seat => {}
                Ok(()) => return Ok(phase == "probation"),
                Err(reason) => return Err(failure(phase, reason)),
            }
        }
        Ok(false)
    }

    fn check_host(&mut self, phase: &'static str) -> Result<(), Failure> {
        let Some(host) = &mut self.host else { return Ok(()) };
        if let Ok(HostNews::Ended { how }) = host.news.try_recv() {
            host.dead = true;
            return Err(failure(phase, format!("its process died: {how}")));
        }
        let limit = self.terms.memory_limit_mb;
        match own_memory_mb(host.pid).filter(|used| *used > limit) {
            Some(used) => {
                Err(failure(phase, format!("it uses {used} MB of memory, allowed are {limit} MB (--memory-limit-mb)")))
            }
            None => Ok(()),
        }
    }

    fn check_stall(&self, phase: &'static str) -> Result<(), Failure> {
        let too_long = |ms: Option<f64>| ms.filter(|ms| *ms > self.terms.stall_ms as f64);
        if let Some(busy) = too_long(self.status.busy_ms) {
            return Err(failure(phase, format!("it stalls: a step has been running for {busy:.0} ms")));
        }
        match too_long(self.status.waiting_ms) {
            Some(waiting) => Err(failure(phase, format!("it stalls: a sample has been waiting for {waiting:.0} ms"))),
            None => Ok(()),
        }
    }

    fn look(&mut self, patience: Duration) -> Result<(), String> {
        let question = SeatQuestion::Status(self.seat.clone());
        match self.changes.ask_for(&self.node.process, &question, patience)? {
            SeatAnswer::Status(status) => {
                let before = std::mem::replace(&mut self.status, status);
                if self.status.compared < before.compared {
                    // The comparison ended with the take-over; its result stays.
                    self.status.compared = before.compared;
                    self.status.different = before.different;
                    self.status.active_outputs = before.active_outputs;
                    self.status.outputs = before.outputs;
                    self.status.largest_difference = before.largest_difference;
                }
                self.status.latency_us = self.status.latency_us.or(before.latency_us);
                Ok(())
            }
            other => Err(unexpected(&other)),
        }
    }
}

pub(super) fn unexpected(answer: &SeatAnswer) -> String {
    format!("unexpected answer: {answer:?}")
}

/// Copies a binary into a folder, unless it is there already.
fn keep(path: &Path, dir: &Path) -> Result<PathBuf, String> {
    let name = path.file_name().ok_or_else(|| format!("`{}` names no file", path.display()))?;
    let copy = dir.join(name);
    if path == copy {
        return Ok(copy);
    }
    std::fs::create_dir_all(dir).map_err(|error| format!("`{}`: {error}", dir.display()))?;
    std::fs::copy(path, &copy)
        .map(|_| copy)
        .map_err(|error| format!("`{}`: {error}; build it first, and give its path", path.display()))
}

/// Memory of a process that it shares with no other, MB. `None`: it is gone.
fn own_memory_mb(pid: u32) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:"))?;
    let kb: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kb / 1024)
}
