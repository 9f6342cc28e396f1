//! A scenario file as it is written. Unknown keys are refused; the rules are in `rules.rs`.

use std::collections::BTreeMap;

use carril_messages::DriveState;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::distribution::{Amount, Distribution};

/// A whole file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawScenario {
    pub graph: String,
    pub seconds: f64,
    pub laps: Option<u32>,
    pub seed: Option<u64>,
    pub set: Option<BTreeMap<String, Value>>,
    pub vary: Option<BTreeMap<String, Distribution>>,
    pub latency: Option<BTreeMap<String, Amount>>,
    pub success: Option<Success>,
    pub require: Option<Require>,
}

/// What a drive must come to. What is left out may be anything, but departures and contacts: none are allowed unless so many are.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Success {
    /// How often a wheel may leave the lane.
    pub departures: u32,
    /// How often the body may touch something.
    pub contacts: u32,
    /// How often a red light may be passed.
    pub red_runs: u32,
    /// Whole laps at least.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub laps_min: Option<u32>,
    /// Way driven at least, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distance_min_m: Option<f64>,
    /// Root mean square of the cross-track error at most, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cross_track_rms_max_m: Option<f64>,
    /// Largest cross-track error at most, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cross_track_max_m: Option<f64>,
    /// What the decision node does at the end: one of these.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub end_state: Option<Vec<DriveState>>,
}

/// What a series of drives must come to.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Require {
    /// Share of drives that succeed at least, 0 to 1.
    pub success_min: f64,
}

impl Default for Require {
    fn default() -> Self {
        Self { success_min: 1.0 }
    }
}
