//! Starts a node again. One that is down has nothing to hand over: the new instance comes as one that is new in the graph, in a process
//! that is up. So a node that gave up can be swapped, too: by the version that mends it.

use std::sync::mpsc::channel;

use carril_messages::NodeState;

use super::apply::Arrival;
use super::changes::{ANSWER_PATIENCE, Changes, Failure};
use super::monitor::Message;
use super::plan::PlanNode;
use super::swap::Swap;
use crate::control_plane::{Receipt, SwapTerms};
use crate::seats::{SeatName, SeatQuestion};

/// Whether a node can hand over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Condition {
    /// It runs, or hangs.
    Up,
    /// It is being started again.
    Coming,
    /// It stays down.
    Down(NodeState),
}

impl Changes {
    /// The same version anew. With its state if it runs, unless `terms` say otherwise; without if it is down.
    pub(super) fn restart(&self, node: &str, terms: SwapTerms, receipt: &mut Receipt) -> Result<(), Failure> {
        let planned = self.plan_node(node)?;
        self.replace(planned.clone(), planned, terms, receipt)?;
        // It is the version that it was.
        self.live.lock().forget_restart(node);
        Ok(())
    }

    /// Another version takes over from the one that runs, or comes in the place of the one that is down.
    pub(super) fn replace(
        &self,
        before: PlanNode,
        after: PlanNode,
        terms: SwapTerms,
        receipt: &mut Receipt,
    ) -> Result<(), Failure> {
        let process = before.process.clone();
        match self.condition(&before) {
            Condition::Up => Swap::new(self, before, after, terms, receipt).run()?,
            Condition::Coming => return Err(Failure::refused(coming(&before.name))),
            Condition::Down(state) if terms.compare_only => {
                let (node, state) = (&before.name, words(state));
                let reason =
                    format!("node `{node}` {state}: there is nothing to compare with; start it: carril restart {node}");
                return Err(Failure::refused(reason));
            }
            Condition::Down(state) => {
                receipt.from = format!("{}; it {}", receipt.from, words(state));
                self.come_in_its_place(before, after, terms, receipt)?;
            }
        }
        self.end_if_empty(&process);
        Ok(())
    }

    fn come_in_its_place(
        &self,
        before: PlanNode,
        after: PlanNode,
        terms: SwapTerms,
        receipt: &mut Receipt,
    ) -> Result<(), Failure> {
        let old = SeatName { node: before.name.clone(), number: self.live.lock().seat(&before.name) };
        Arrival::new(self, after, terms, receipt).in_place_of(before.clone()).run()?;
        // What is left of it in a process that is up.
        if self.is_up(&before.process)
            && let Err(error) = self.ask(&before.process, &SeatQuestion::Retire(old))
        {
            tracing::debug!("{error}");
        }
        self.live.lock().keep_before(before);
        Ok(())
    }

    /// Refuses what needs a node that runs, and says what to do.
    pub(super) fn needs_running(&self, node: &PlanNode) -> Result<(), Failure> {
        match self.condition(node) {
            Condition::Up => Ok(()),
            Condition::Coming => Err(Failure::refused(coming(&node.name))),
            Condition::Down(state) => Err(Failure::refused(down(&node.name, state))),
        }
    }

    /// Why a node did not do what it was asked for: perhaps it does not run.
    pub(super) fn better_reason(&self, node: &PlanNode, reason: String) -> String {
        self.needs_running(node).map_or_else(|failure| failure.reason, |()| reason)
    }

    /// What the supervisor sees of the process, and of the node in it what that says.
    fn condition(&self, node: &PlanNode) -> Condition {
        let (answer, state) = channel();
        // The monitor ends last.
        let _ = self.monitor.send(Message::Look { process: node.process.clone(), answer });
        let seen = state.recv_timeout(ANSWER_PATIENCE).ok().flatten().or_else(|| {
            let seat = SeatName { node: node.name.clone(), number: self.live.lock().seat(&node.name) };
            self.status_between_steps(&node.process, &seat).ok().and_then(|status| status.down)
        });
        match seen {
            Some(state @ (NodeState::GaveUp | NodeState::Stopped)) => Condition::Down(state),
            Some(NodeState::Starting | NodeState::Restarting) => Condition::Coming,
            Some(NodeState::Running | NodeState::Faulted | NodeState::Away) | None => Condition::Up,
        }
    }
}

fn words(state: NodeState) -> &'static str {
    if state == NodeState::GaveUp { "gave up" } else { "is down" }
}

fn down(node: &str, state: NodeState) -> String {
    format!(
        "node `{node}` {}; start it again: carril restart {node}, or as another version: carril swap {node} --set PATH=VALUE",
        words(state)
    )
}

fn coming(node: &str) -> String {
    format!("node `{node}` is being started again by itself; try again when it runs, or has given up")
}
