//! Makes the running graph another one (`carril apply`): works out what differs, and carries it out node by node with the means of a
//! swap. Nodes that do not change are left alone. A node that fails takes back all that was done before it.
//!
//! What comes is there before what reads it, and what goes rests until everything else has worked out: then it can be undone.

mod arrival;
mod departure;
mod difference;

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use serde_json::Value;

pub(super) use self::arrival::Arrival;
use self::departure::Departed;
use self::difference::{RESTART, Side, changes};
use super::candidate::{Place, failure};
use super::changes::{Changes, Failure, in_words};
use super::monitor::Message;
use super::plan::{Plan, PlanNode};
use super::swap::Swap;
use crate::OperatorKind;
use crate::control_plane::{Action, ApplyReceipt, ApplyRequest, NodeChange, Outcome, Receipt, SwapTerms, applied_key};

impl Changes {
    /// Makes the running graph another one, or only says what would be done. The receipt is answered, published and logged.
    pub(super) fn apply(&self, request: ApplyRequest) -> ApplyReceipt {
        let began = Instant::now();
        let mut receipt = ApplyReceipt { stamp: self.clock.now(), ..ApplyReceipt::default() };
        let only_planned = request.agreed.is_none();
        let text = request.text.clone();
        let path = self.apply_to(request, &mut receipt);
        receipt.took_ms = began.elapsed().as_secs_f64() * 1e3;
        if !only_planned {
            self.tell_of_graph(&receipt, path, text);
        }
        receipt
    }

    fn apply_to(&self, request: ApplyRequest, receipt: &mut ApplyReceipt) -> PathBuf {
        let wanted = match self.wanted(&request.plan) {
            Ok(wanted) => wanted,
            Err(failed) => {
                note(receipt, None, failed);
                return PathBuf::new();
            }
        };
        let path = wanted.path.clone();
        let Some(agreed) = request.agreed else {
            receipt.outcome = Outcome::Planned;
            let wanted = self.compare(wanted, receipt);
            if let Err((node, failed)) = self.check_all(&wanted, &receipt.changes) {
                note(receipt, Some(node), failed);
            }
            return path;
        };
        let _applying = match self.live.begin_apply() {
            Ok(applying) => applying,
            Err(reason) => {
                note(receipt, None, Failure::refused(reason));
                return path;
            }
        };
        let wanted = self.compare(wanted, receipt);
        if receipt.changes == agreed {
            self.carry_out_all(&wanted, &request.terms, receipt);
        } else {
            let reason = "the running graph is no longer as it was when the plan was shown; look at it again";
            note(receipt, None, Failure::refused(reason));
        }
        path
    }

    /// The plan that somebody asks for, if it is one for this run.
    fn wanted(&self, plan: &Value) -> Result<Plan, Failure> {
        let wanted: Plan = serde_json::from_value(plan.clone()).map_err(|error| {
            Failure::refused(format!("this is no graph that this version of carril knows: {error}"))
        })?;
        let live = self.live.lock();
        if wanted.robot != live.plan.robot {
            let (got, runs) = (&wanted.robot, &live.plan.robot);
            return Err(Failure::refused(format!("the file is for robot `{got}`, and `{runs}` runs")));
        }
        if wanted.base_dir != live.plan.base_dir {
            let (got, runs) = (wanted.base_dir.display(), live.plan.base_dir.display());
            return Err(Failure::refused(format!(
                "the file lies in `{got}`, and the running graph began in `{runs}`: paths in configurations begin at the \
                 folder of the graph file; put the file there"
            )));
        }
        Ok(Plan { seed: live.plan.seed, ..wanted }.on(live.plan.machine.clone()))
    }

    /// Works out what differs. In the plan that comes back nodes keep what is only written in another way.
    fn compare(&self, mut wanted: Plan, receipt: &mut ApplyReceipt) -> Plan {
        let running = self.live.lock().plan.clone();
        for after in &mut wanted.nodes {
            let Some(before) = running.node(&after.name) else { continue };
            if before.body.same_operator(&after.body) {
                // It may run from a copy.
                after.body.clone_from(&before.body);
            }
        }
        let (effective, effective_wanted) = (self.effective(&running), self.effective(&wanted));
        let running = Side { plan: &running, effective: &effective };
        receipt.changes = changes(&running, &Side { plan: &wanted, effective: &effective_wanted });
        let stays = |node: &&PlanNode| !receipt.changes.iter().any(|change| change.node == node.name);
        receipt.unchanged = running.plan.nodes.iter().filter(stays).map(|node| node.name.clone()).collect();
        wanted
    }

    /// The configuration of each node with the defaults filled in. Not under the lock: a binary of the user's own has some seconds
    /// to tell its defaults.
    fn effective(&self, plan: &Plan) -> HashMap<String, Value> {
        let kinds = self.live.lock().kinds(plan);
        let effective = |(node, kind): (PlanNode, Option<Arc<OperatorKind>>)| {
            let config = kind.map_or_else(|| node.config.clone(), |kind| kind.effective_config(&node.config));
            (node.name, config)
        };
        kinds.into_iter().map(effective).collect()
    }

    fn check_all(&self, wanted: &Plan, changes: &[NodeChange]) -> Result<(), (String, Failure)> {
        for change in changes {
            let before = self.live.lock().plan.node(&change.node).cloned();
            let elsewhere = before.iter().chain(wanted.node(&change.node)).find(|node| wanted.is_elsewhere(node));
            if let Some(node) = elsewhere {
                let place =
                    node.machine.as_ref().map_or("the car".to_owned(), |machine| format!("machine `{machine}`"));
                let reason = format!(
                    "node `{}` belongs to {place}: end both runs, and start both again with the new graph",
                    change.node
                );
                return Err((change.node.clone(), Failure::refused(reason)));
            }
        }
        for node in changes.iter().filter_map(|change| wanted.node(&change.node)) {
            let checked = self.check(node).and_then(|()| self.check_ports(wanted, node));
            checked.map_err(|failed| (node.name.clone(), failed))?;
        }
        Ok(())
    }

    fn carry_out_all(&self, wanted: &Plan, terms: &SwapTerms, receipt: &mut ApplyReceipt) {
        let mut work = Work { changes: self, wanted, terms, done: Vec::new(), steps: Vec::new() };
        let planned = receipt.changes.clone();
        let checked = self.check_all(wanted, &planned);
        match checked.and_then(|()| work.carry_out(&planned)) {
            Ok(()) => receipt.outcome = Outcome::Done,
            Err((node, failed)) => note(receipt, Some(node), failed),
        }
        receipt.steps = work.steps;
    }

    fn tell_of_graph(&self, receipt: &ApplyReceipt, path: PathBuf, text: String) {
        match &receipt.reason {
            None => tracing::info!("the graph is that of `{}` now", path.display()),
            Some(reason) => tracing::warn!("apply did not go through: {reason}"),
        }
        let put = serde_json::to_vec(receipt).map(|bytes| self.transport.put(&applied_key(&self.robot), None, bytes));
        if !matches!(put, Ok(Ok(()))) {
            tracing::debug!("the receipt cannot be put");
        }
        // The monitor ends last.
        let _ = self.monitor.send(Message::Applied { path, text, receipt: Box::new(receipt.clone()) });
    }
}

fn note(receipt: &mut ApplyReceipt, node: Option<String>, failed: Failure) {
    receipt.outcome = if failed.rolled_back { Outcome::RolledBack } else { Outcome::Refused };
    receipt.node = node;
    receipt.phase = Some(failed.phase.to_owned());
    receipt.reason = Some(failed.reason);
}

/// What becomes of a node that is removed, in its receipt.
const GONE: &str = "gone";

/// The work on a graph.
struct Work<'a> {
    changes: &'a Changes,
    wanted: &'a Plan,
    terms: &'a SwapTerms,
    done: Vec<Done>,
    steps: Vec<Receipt>,
}

/// What was done, and how it was before.
enum Done {
    Added(String),
    Changed {
        before: PlanNode,
    },
    /// Only the supervisor's rules for it are other ones: nothing is built anew.
    Ruled {
        before: PlanNode,
    },
    Removed(Departed),
}

impl Work<'_> {
    /// Does everything, or nothing. `Err`: the node that failed.
    fn carry_out(&mut self, planned: &[NodeChange]) -> Result<(), (String, Failure)> {
        let order = self.changes.live.lock().order();
        for change in self.in_order(planned) {
            if let Err(failed) = self.step(change) {
                let rolled_back = !self.done.is_empty() || failed.rolled_back;
                let reason = self.undo().into_iter().fold(failed.reason, |reason, more| format!("{reason}; {more}"));
                self.changes.live.lock().put_in_order(&order);
                return Err((change.node.clone(), Failure { reason, rolled_back, ..failed }));
            }
        }
        self.finish();
        Ok(())
    }

    /// Devices that a new node may want are let go first. Then comes what is new, as others may read it; what goes comes last.
    fn in_order<'b>(&self, planned: &'b [NodeChange]) -> Vec<&'b NodeChange> {
        let is = |change: &NodeChange, action: Action| change.actions.contains(&action);
        let frees =
            planned.iter().any(|change| is(change, Action::Add) && self.holds_device(&change.node, self.wanted));
        let running = self.changes.live.lock().plan.clone();
        let rank = |change: &NodeChange| match () {
            () if is(change, Action::Remove) && frees && self.holds_device(&change.node, &running) => 0,
            () if is(change, Action::Add) => 1,
            () if is(change, Action::Remove) => 3,
            () => 2,
        };
        let mut ordered: Vec<&NodeChange> = planned.iter().collect();
        ordered.sort_by_key(|change| rank(change));
        ordered
    }

    fn holds_device(&self, node: &str, plan: &Plan) -> bool {
        let Some(node) = plan.node(node) else { return false };
        let kind = self.changes.live.lock().kind(&node.body);
        kind.is_some_and(|kind| kind.exclusive(&node.config))
    }

    fn step(&mut self, change: &NodeChange) -> Result<(), Failure> {
        let what: Vec<String> = change.actions.iter().map(ToString::to_string).collect();
        let mut receipt = self.changes.blank(&change.node, &what.join(", "));
        let result = self.do_step(change, &mut receipt);
        self.keep(receipt, result)
    }

    fn keep(&mut self, mut receipt: Receipt, result: Result<(), Failure>) -> Result<(), Failure> {
        if let Err(failed) = &result {
            failed.clone().note(&mut receipt);
        }
        self.changes.tell(&receipt);
        self.steps.push(receipt);
        result
    }

    fn do_step(&mut self, change: &NodeChange, receipt: &mut Receipt) -> Result<(), Failure> {
        let node = change.node.as_str();
        let before = self.changes.live.lock().plan.node(node).cloned();
        let after = self.wanted.node(node).cloned();
        match (before, after) {
            (None, Some(after)) => {
                receipt.to = in_words(1, &after);
                Arrival::new(self.changes, after, self.terms.clone(), receipt).run()?;
                self.done.push(Done::Added(node.to_owned()));
            }
            (Some(before), Some(after)) => {
                let (version, seat) = {
                    let live = self.changes.live.lock();
                    (live.version(node), live.seat(node))
                };
                if change.differences.iter().all(|difference| difference.what == RESTART) {
                    self.changes.replan(&PlanNode { restart: after.restart, ..before.clone() }, seat);
                    self.done.push(Done::Ruled { before });
                    return Ok(());
                }
                receipt.to = in_words(version + 1, &after);
                self.changes.needs_running(&before)?;
                Swap::new(self.changes, before.clone(), after, self.terms.clone(), receipt).run()?;
                self.done.push(Done::Changed { before });
            }
            (Some(_), None) => {
                receipt.to = GONE.into();
                self.done.push(Done::Removed(Departed::of(self.changes, node)?));
            }
            (None, None) => return Err(failure("request", format!("there is no node `{node}`"))),
        }
        Ok(())
    }

    /// All has gone well: what rests is let go.
    fn finish(&self) {
        for done in &self.done {
            match done {
                Done::Removed(departed) => departed.let_go(self.changes),
                Done::Changed { before } => self.changes.end_if_empty(&before.process),
                Done::Added(_) | Done::Ruled { .. } => {}
            }
        }
        let order: Vec<String> = self.wanted.nodes.iter().map(|node| node.name.clone()).collect();
        let mut live = self.changes.live.lock();
        live.put_in_order(&order);
        // This run is of that file from now on.
        live.plan.path.clone_from(&self.wanted.path);
    }

    /// Takes back what was done, the last first. What could not be taken back, in words.
    fn undo(&mut self) -> Vec<String> {
        let mut left = Vec::new();
        for done in std::mem::take(&mut self.done).into_iter().rev() {
            let node = done.node().to_owned();
            let mut receipt = self.changes.blank(&node, "undo");
            let result = self.undo_one(&done, &mut receipt);
            if let Err(failed) = self.keep(receipt, result) {
                left.push(format!("node `{node}` could not be put back: {}", failed.reason));
            }
            self.done.push(done);
        }
        left
    }

    fn undo_one(&self, done: &Done, receipt: &mut Receipt) -> Result<(), Failure> {
        let changes = self.changes;
        match done {
            Done::Added(node) => {
                receipt.to = GONE.into();
                Departed::of(changes, node)?.let_go(changes);
                Ok(())
            }
            Done::Removed(departed) => departed.come_back(changes),
            Done::Ruled { before } => {
                let seat = changes.live.lock().seat(&before.name);
                changes.replan(before, seat);
                Ok(())
            }
            Done::Changed { before } => {
                let live = changes.live.lock();
                let (now, version) = (live.plan.node(&before.name).cloned(), live.version(&before.name));
                drop(live);
                let now = now.ok_or_else(|| failure("undo", "it is gone"))?;
                receipt.to = in_words(version.saturating_sub(1), before);
                let (left, terms) = (now.process.clone(), SwapTerms { shadow_ms: 0, ..self.terms.clone() });
                let swap = Swap::new(changes, now, before.clone(), terms, receipt);
                // It is still up: it is ended when all is done.
                swap.into(Place::Running(before.process.clone())).run()?;
                changes.live.lock().forget_last_change(&before.name);
                changes.end_if_empty(&left);
                Ok(())
            }
        }
    }
}

impl Done {
    fn node(&self) -> &str {
        match self {
            Self::Added(node) => node,
            Self::Changed { before } | Self::Ruled { before } => &before.name,
            Self::Removed(departed) => departed.node(),
        }
    }
}
