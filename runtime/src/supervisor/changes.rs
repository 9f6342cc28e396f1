//! Takes requests to change the running graph, one thread each, and writes their receipts.

use std::path::{Path, PathBuf};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use serde_json::{Map, Value};

use super::candidate::unexpected;
use super::live::{SharedLive, operator_name};
use super::monitor::Message;
use super::plan::{Built, PlanBody, PlanNode};
use crate::clock::Clock;
use crate::control_plane::{
    Change, Outcome, ProcessEntry, Receipt, RunFile, SwapRequest, SwapTerms, apply_key, change_key, graph_key,
    receipts_key,
};
use crate::executor::live::STEP_PATIENCE;
use crate::graph::{apply_value, operator_in};
use crate::parameters::fill_in_list;
use crate::seats::{SeatAnswer, SeatName, SeatQuestion, SeatStatus, decode, encode, seat_key};
use crate::transport::zenoh::{Question, ZenohTransport};
use crate::transport::{Guard, TransportError};

/// A process has this long to answer, beyond what its steps need; also on an overloaded machine.
pub(super) const ANSWER_PATIENCE: std::time::Duration = std::time::Duration::from_secs(5);
/// How often an instance whose step runs is asked again.
const STATUS_POLL: std::time::Duration = std::time::Duration::from_millis(2);

/// What every change needs.
#[derive(Clone)]
pub(super) struct Changes {
    pub robot: String,
    pub run: Arc<Mutex<RunFile>>,
    pub live: SharedLive,
    pub transport: ZenohTransport,
    pub clock: Arc<dyn Clock>,
    pub monitor: Sender<Message>,
    /// Folder of the run.
    pub dir: PathBuf,
}

/// Why a change did not go through.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Failure {
    pub phase: &'static str,
    pub reason: String,
    /// Something had been changed, and was taken back.
    pub rolled_back: bool,
}

impl Failure {
    pub(super) fn refused(reason: impl Into<String>) -> Self {
        Self { phase: "request", reason: reason.into(), rolled_back: false }
    }

    pub(super) fn note(self, receipt: &mut Receipt) {
        receipt.outcome = if self.rolled_back { Outcome::RolledBack } else { Outcome::Refused };
        receipt.phase = Some(self.phase.to_owned());
        receipt.reason = Some(self.reason);
    }
}

impl Changes {
    pub(super) fn new(
        run: &Arc<Mutex<RunFile>>,
        live: SharedLive,
        transport: &ZenohTransport,
        clock: &Arc<dyn Clock>,
        monitor: &Sender<Message>,
        dir: &Path,
    ) -> Self {
        let (transport, clock, monitor) = (transport.clone(), Arc::clone(clock), monitor.clone());
        let robot = run.lock().unwrap_or_else(PoisonError::into_inner).robot.clone();
        Self { robot, run: Arc::clone(run), live, transport, clock, monitor, dir: dir.to_owned() }
    }

    /// Answers requests.
    pub(super) fn listen(&self) -> Result<Vec<Guard>, TransportError> {
        let (changes, applying, live) = (self.clone(), self.clone(), self.live.clone());
        Ok(vec![
            self.transport.answer(&apply_key(&self.robot), move |question| {
                let changes = applying.clone();
                std::thread::spawn(move || changes.hear_of_graph(question));
            })?,
            self.transport.answer(&change_key(&self.robot), move |question| {
                let changes = changes.clone();
                std::thread::spawn(move || changes.hear(question));
            })?,
            self.transport.answer(&graph_key(&self.robot), move |question| {
                let live = live.clone();
                std::thread::spawn(move || {
                    question.answer(serde_json::to_vec(&live.graph()).map_err(|error| error.to_string()));
                });
            })?,
        ])
    }

    fn hear(&self, question: Question) {
        let answer = match serde_json::from_slice::<Change>(&question.bytes()) {
            Ok(change) => serde_json::to_vec(&self.carry_out(change)).map_err(|error| error.to_string()),
            Err(error) => Err(format!("this is no change that this version of carril knows: {error}")),
        };
        question.answer(answer);
    }

    fn hear_of_graph(&self, question: Question) {
        let answer = match serde_json::from_slice(&question.bytes()) {
            Ok(request) => serde_json::to_vec(&self.apply(request)).map_err(|error| error.to_string()),
            Err(error) => Err(format!("this is no graph that this version of carril knows: {error}")),
        };
        question.answer(answer);
    }

    /// Carries a change out. Its receipt is answered, published and logged.
    pub(super) fn carry_out(&self, change: Change) -> Receipt {
        let (node, what) = match &change {
            Change::Set { node, .. } => (node.clone(), "set"),
            Change::Swap(request) if request.terms.compare_only => (request.node.clone(), "shadow"),
            Change::Swap(request) => (request.node.clone(), "swap"),
            Change::Rollback { node, .. } => (node.clone(), "rollback"),
            Change::Restart { node, .. } => (node.clone(), "restart"),
        };
        let mut receipt = self.blank(&node, what);
        let begun = self.live.lock().begin_change(&node, what);
        let result = if let Err(reason) = begun {
            Err(Failure::refused(reason))
        } else {
            let result = match change {
                Change::Set { node, values } => self.set(&node, &values, &mut receipt),
                Change::Swap(request) => self.swap(&request, &mut receipt),
                Change::Rollback { node, terms } => self.roll_back(&node, terms, &mut receipt),
                Change::Restart { node, terms } => self.restart(&node, terms, &mut receipt),
            };
            self.live.lock().end_change(&node);
            result
        };
        if let Err(failure) = result {
            failure.note(&mut receipt);
        }
        self.tell(&receipt);
        receipt
    }

    pub(super) fn blank(&self, node: &str, what: &str) -> Receipt {
        let live = self.live.lock();
        let from = live.plan.node(node).map(|known| in_words(live.version(node), known)).unwrap_or_default();
        Receipt {
            node: node.to_owned(),
            what: what.to_owned(),
            outcome: Outcome::Done,
            stamp: self.clock.now(),
            to: from.clone(),
            from,
            ..Receipt::default()
        }
    }

    pub(super) fn tell(&self, receipt: &Receipt) {
        match &receipt.reason {
            None => tracing::info!("node `{}`: {}: {} -> {}", receipt.node, receipt.what, receipt.from, receipt.to),
            Some(reason) => tracing::warn!("node `{}`: {} did not go through: {reason}", receipt.node, receipt.what),
        }
        let put = serde_json::to_vec(receipt).map(|bytes| self.transport.put(&receipts_key(&self.robot), None, bytes));
        if !matches!(put, Ok(Ok(()))) {
            tracing::debug!("the receipt cannot be put");
        }
        // The monitor ends last.
        let _ = self.monitor.send(Message::Changed(Box::new(receipt.clone())));
    }

    /// Asks a process about one of its seats.
    pub(super) fn ask(&self, process: &str, question: &SeatQuestion) -> Result<SeatAnswer, String> {
        self.ask_for(process, question, ANSWER_PATIENCE)
    }

    pub(super) fn ask_for(
        &self,
        process: &str,
        question: &SeatQuestion,
        patience: std::time::Duration,
    ) -> Result<SeatAnswer, String> {
        let key = seat_key(&self.robot, process);
        let question = encode(question).map_err(|error| error.to_string())?;
        let answers = self.transport.ask(&key, question, patience).map_err(|error| error.to_string())?;
        let answer = answers.into_iter().next().ok_or_else(|| format!("process `{process}` does not answer"))?;
        let answer = answer.map_err(|reason| format!("process `{process}`: {reason}"))?;
        decode(&answer).map_err(|error| format!("process `{process}`: {error}"))
    }

    /// How an instance is doing, from between two steps: while one runs, what they came to is not known. One that hangs is left.
    pub(super) fn status_between_steps(&self, process: &str, seat: &SeatName) -> Result<SeatStatus, String> {
        let began = Instant::now();
        loop {
            match self.ask(process, &SeatQuestion::Status(seat.clone()))? {
                SeatAnswer::Status(status) if status.busy_ms.is_some() && began.elapsed() < STEP_PATIENCE => {
                    std::thread::sleep(STATUS_POLL);
                }
                SeatAnswer::Status(status) => return Ok(status),
                other => return Err(unexpected(&other)),
            }
        }
    }

    /// Whether a process is there.
    pub(super) fn is_up(&self, process: &str) -> bool {
        let run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
        run.processes.iter().any(|entry| entry.name == process && entry.pid.is_some())
    }

    /// Links two processes that come to share an edge. One that is down links itself when it is started again.
    pub(super) fn link(&self, from: &str, to: &str) -> Result<(), String> {
        let entry = |process: &str| {
            let run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
            let entry = run.processes.iter().find(|entry| entry.name == process).cloned();
            entry.ok_or_else(|| format!("there is no process `{process}`"))
        };
        let (one, other) = (entry(from)?, entry(to)?);
        let knows = |one: &ProcessEntry, other: &ProcessEntry| one.connect.contains(&other.endpoint);
        if knows(&one, &other) || knows(&other, &one) {
            return Ok(());
        }
        if other.pid.is_some() {
            let SeatAnswer::Identity(identity) = self.ask(to, &SeatQuestion::Identity)? else {
                return Err(format!("process `{to}` does not say who it is"));
            };
            self.ask(from, &SeatQuestion::Connect { identity, endpoint: other.endpoint.clone() })?;
        }
        let mut run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
        for entry in &mut run.processes {
            // Whichever of them is started anew connects to the other.
            if entry.name == from {
                entry.connect.push(other.endpoint.clone());
            } else if entry.name == to {
                entry.connect.push(one.endpoint.clone());
            }
        }
        drop(run);
        let _ = self.monitor.send(Message::Linked);
        Ok(())
    }

    /// The writers of its reliable inputs keep their samples for readers in other processes: they may have had none there.
    pub(super) fn serve_reliably(&self, node: &PlanNode) -> Result<(), String> {
        for edge in node.inputs.iter().filter(|edge| edge.reliable) {
            let writer = {
                let live = self.live.lock();
                live.plan.node(&edge.from.node).map(|writer| (writer.process.clone(), live.seat(&writer.name)))
            };
            let Some((process, number)) = writer.filter(|(process, _)| *process != node.process) else { continue };
            let seat = SeatName { node: edge.from.node.clone(), number };
            self.ask(&process, &SeatQuestion::ServeReliably { seat, port: edge.from.port.clone() })?;
        }
        Ok(())
    }

    /// A node is another one from now on, or new in the graph.
    pub(super) fn replan(&self, node: &PlanNode, seat: u32) {
        self.live.lock().replace(node, seat);
        let _ = self.monitor.send(Message::Replanned);
    }

    /// A node that has gone elsewhere may leave an empty process behind.
    pub(super) fn end_if_empty(&self, process: &str) {
        if !self.live.lock().plan.has_nodes_in(process) {
            let _ = self.monitor.send(Message::EndProcess { process: process.to_owned(), at_once: false });
        }
    }

    pub(super) fn plan_node(&self, node: &str) -> Result<PlanNode, Failure> {
        self.live.lock().plan.node(node).cloned().ok_or_else(|| Failure::refused(format!("there is no node `{node}`")))
    }

    /// Checks the configuration of a node as the graph's checker does.
    pub(super) fn check(&self, node: &PlanNode) -> Result<(), Failure> {
        let (kind, base_dir) = {
            let live = self.live.lock();
            let kind = live.kind(&node.body).ok_or_else(|| {
                let known: Vec<&str> = live.registry.iter().map(|kind| kind.name).collect();
                let (name, known) = (operator_name(&node.body), known.join(", "));
                Failure::refused(format!("there is no operator `{name}`; there are {known}"))
            })?;
            (kind, live.plan.base_dir.clone())
        };
        // Unlocked: a binary of the user's own has some seconds to answer.
        let findings = kind.check_config(&node.config, &base_dir, false);
        if findings.is_empty() {
            return Ok(());
        }
        let each = findings.iter().map(|finding| {
            let place = if finding.path.is_empty() { "config".to_owned() } else { finding.path.join(".") };
            let hint = finding.hint.as_ref().map(|hint| format!(" ({hint})")).unwrap_or_default();
            format!("{place}: {}{hint}", finding.message)
        });
        Err(Failure::refused(each.collect::<Vec<_>>().join("; ")))
    }

    fn put_values(&self, node: &mut PlanNode, values: &Map<String, Value>) -> Result<(), Failure> {
        let kind = self.live.lock().kind(&node.body);
        for (path, value) in values {
            if let Some(kind) = &kind {
                let effective = kind.effective_config(&node.config);
                fill_in_list(&mut node.config, &effective, path);
            }
            apply_value(&mut node.config, path, value.clone()).map_err(Failure::refused)?;
        }
        Ok(())
    }

    /// A period that came from the old configuration comes from the new one.
    fn follow_period(&self, before: &PlanNode, after: &mut PlanNode) {
        let (old, new) = {
            let live = self.live.lock();
            (live.kind(&before.body), live.kind(&after.body))
        };
        if let (Some(old), Some(new)) = (old, new)
            && before.period == old.period(&before.config)
        {
            after.period = new.period(&after.config);
        }
    }

    fn set(&self, node: &str, values: &Map<String, Value>, receipt: &mut Receipt) -> Result<(), Failure> {
        let began = Instant::now();
        let before = self.plan_node(node)?;
        let mut after = before.clone();
        self.put_values(&mut after, values)?;
        self.follow_period(&before, &mut after);
        receipt.to = in_words(self.live.lock().version(node) + 1, &after);
        self.check(&after)?;
        let seat = SeatName { node: node.to_owned(), number: self.live.lock().seat(node) };
        let config = after.config.to_string();
        let failed = |reason| Failure { phase: "set", reason: self.better_reason(&before, reason), rolled_back: false };
        self.ask(&before.process, &SeatQuestion::SetConfig(seat.clone(), config)).map_err(failed)?;
        receipt.took_ms = Some(began.elapsed().as_secs_f64() * 1e3);
        let mut live = self.live.lock();
        live.replace(&after, seat.number);
        live.keep_before(before);
        drop(live);
        let _ = self.monitor.send(Message::Replanned);
        Ok(())
    }

    fn swap(&self, request: &SwapRequest, receipt: &mut Receipt) -> Result<(), Failure> {
        let before = self.plan_node(&request.node)?;
        let mut after = before.clone();
        match (&request.operator, &request.exec) {
            (Some(_), Some(_)) => return Err(Failure::refused("name an operator or a binary, not both")),
            (Some(operator), None) => {
                // Another operator has other parameters.
                if after.body != PlanBody::Operator(operator.clone()) {
                    after.config = Value::Null;
                }
                after.body = PlanBody::Operator(operator.clone());
            }
            (None, Some(exec)) => {
                if !matches!(before.body, PlanBody::Exec { .. }) {
                    after.config = Value::Null;
                }
                let operator = operator_in(exec, &request.node).map_err(Failure::refused)?;
                let built = Built::of(exec);
                after.body = PlanBody::Exec { path: exec.clone(), built, operator: Box::new(operator) };
            }
            (None, None) => {}
        }
        if before.body.same_operator(&after.body) {
            // It may run from a copy.
            after.body.clone_from(&before.body);
        }
        self.put_values(&mut after, &request.values)?;
        self.follow_period(&before, &mut after);
        receipt.to = in_words(self.live.lock().version(&request.node) + 1, &after);
        self.check(&after)?;
        let plan = self.live.lock().plan.with(&after);
        self.check_ports(&plan, &after)?;
        self.replace(before, after, request.terms.clone(), receipt)
    }

    fn roll_back(&self, node: &str, terms: SwapTerms, receipt: &mut Receipt) -> Result<(), Failure> {
        let before = self.plan_node(node)?;
        let Some((_, after)) = self.live.lock().before(node).cloned() else {
            return Err(Failure::refused(format!("node `{node}` was not changed since the start of the run")));
        };
        receipt.to = in_words(self.live.lock().version(node) + 1, &after);
        let plan = self.live.lock().plan.with(&after);
        self.check_ports(&plan, &after)?;
        self.replace(before, after, terms, receipt)?;
        let mut live = self.live.lock();
        // The swap has put the version just left on top of the one that is back.
        live.forget_last_before(node);
        live.forget_last_before(node);
        Ok(())
    }
}

/// A version of a node in words.
pub(super) fn in_words(version: u32, node: &PlanNode) -> String {
    let config = if node.config.is_null() { String::new() } else { format!(" {}", node.config) };
    format!("{version}: {}{config}", operator_name(&node.body))
}
