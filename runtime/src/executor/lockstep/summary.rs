//! What a lockstep run came to: for people, for `--json`, and for comparing two runs.

use carril_messages::{Health, Percentiles, Stamp};
use serde::Serialize;

/// What a lockstep run came to.
#[derive(Clone, Debug, Serialize)]
pub struct LockstepSummary {
    /// Seed of the run.
    pub seed: u64,
    /// Virtual time that has passed, s.
    pub virtual_s: f64,
    /// Real time that it took, s, from the first event on.
    pub wall_s: f64,
    /// Virtual time over real time. 0 when nothing ran.
    pub real_time_factor: f64,
    /// Steps of all nodes.
    pub steps: u64,
    /// XXH3-64 over all outputs of all nodes, 16 hex digits: the same seed gives the same hash.
    pub hash: String,
    /// Node by node, in the order of the graph.
    pub nodes: Vec<NodeSummary>,
    /// Times at which a node stopped the car, in order.
    pub faults: Vec<LockstepFault>,
}

/// What one node came to in a lockstep run.
#[derive(Clone, Debug, Serialize)]
pub struct NodeSummary {
    /// The node.
    pub node: String,
    /// Kind of its operator.
    pub operator: String,
    /// Steps.
    pub steps: u64,
    /// Samples sent, all ports.
    pub sent: u64,
    /// What its steps cost in all, ns on the real clock. Differs from run to run.
    pub cost_ns: u64,
    /// Steps that failed.
    pub errors: u64,
    /// Steps that took longer than the deadline, in virtual time.
    pub overruns: u64,
    /// Periods left out because the node was still busy.
    pub missed_periods: u64,
    /// Samples that came too old for an end-to-end budget.
    pub budget_violations: u64,
    /// Age of the oldest exposure at the end of the step, ms. `None`: nothing derived from a sensor.
    pub age_ms: Option<Percentiles>,
    /// Everything else that is known about the node; its windows cover the whole run.
    pub health: Health,
}

/// A node stopped the car.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LockstepFault {
    /// When, in virtual time.
    pub at: Stamp,
    /// The node.
    pub node: String,
    /// What happened, with the numbers.
    pub reason: String,
}

impl NodeSummary {
    pub(super) fn new(health: Health, cost_ns: u64) -> Self {
        Self {
            node: health.node.clone(),
            operator: health.operator.clone(),
            steps: health.steps,
            sent: health.sent,
            cost_ns,
            errors: health.errors,
            overruns: health.overruns,
            missed_periods: health.missed_periods,
            budget_violations: health.budget_violations,
            age_ms: health.age_ms,
            health,
        }
    }
}

impl LockstepSummary {
    /// The summary of a node.
    pub fn node(&self, name: &str) -> Option<&NodeSummary> {
        self.nodes.iter().find(|node| node.node == name)
    }
}
