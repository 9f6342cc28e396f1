//! Scenario files: a graph, what is drawn anew for each drive of it, and what a drive and a series of drives must come to.
//!
//! Reading checks everything against the graph, with a place and a hint for each problem. [`Scenario::draw`] gives the values of one
//! drive: they depend on the scenario and the seed of the drive only. Driving is not done here.

mod distribution;
mod drawn;
mod raw;
mod read;
mod rules;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

pub use distribution::{Amount, Distribution, Normal, run_seed};
pub use drawn::Drawn;
pub use raw::{Require, Success};

/// A checked scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// The file it came from.
    pub path: PathBuf,
    /// The graph file, found from the folder of the scenario.
    pub graph: PathBuf,
    /// Longest virtual time of a drive, s.
    pub seconds: f64,
    /// A drive ends after so many laps. `None`: it lasts its whole time.
    pub laps: Option<u32>,
    /// Seed of noise in every drive. `None`: each drive has its own.
    pub seed: Option<u64>,
    /// `node.key` and its value in every drive, in the order of the keys.
    pub set: Vec<(String, serde_json::Value)>,
    /// `node.key` and what its value is drawn from, in the order of the keys.
    pub vary: Vec<(String, Distribution)>,
    /// Nodes and how long their steps take, ms.
    pub latency: Vec<(String, Amount)>,
    /// What a drive must come to.
    pub success: Success,
    /// What a series of drives must come to.
    pub require: Require,
}

impl Scenario {
    /// Whether drives of it differ.
    pub fn varies(&self) -> bool {
        self.seed.is_none() || !self.vary.is_empty() || self.latency.iter().any(|(_, ms)| ms.varies())
    }
}
