//! What the decision node is doing, and why.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::Stamp;

/// The states of the decision FSM.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum DriveState {
    /// Waits for `start`. Speed 0.
    #[default]
    Idle,
    /// Follows the lane.
    LaneFollow,
    /// Something stands in the way. Speed 0, goes on by itself when the way is clear.
    ObstacleStop,
    /// No usable lane, or the detector is silent. Speed 0 after a short coast, goes on by itself when the lane is back.
    LaneLost,
    /// Latched stop. Leaves only by `reset`.
    EStop,
    /// A person drives by hand.
    Manual,
    /// A traffic light is red: drives up to its stop line, stands, and goes on by itself when it is green.
    LightStop,
    /// Something slow is ahead in its lane and cannot be overtaken yet: stays behind it, or backs up when it stands too near.
    OvertakeWait,
    /// Changes over to the left lane, to overtake.
    OvertakeOut,
    /// Overtakes, in the left lane.
    OvertakePass,
    /// Changes back into its lane.
    OvertakeIn,
    /// Stands beside its lane, as something is in the way of the manoeuvre. Speed 0, goes on by itself when nothing is.
    OvertakeStop,
    /// Follows the lane and looks for a gap to park in.
    ParkSearch,
    /// Gets into a gap.
    ParkDrive,
    /// Stands in a gap.
    Parked,
    /// Parking has ended, with a reason. Speed 0; leaves only by `stop`.
    ParkStop,
}

impl DriveState {
    /// As on the wire and in the YAML: `lane-follow`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::LaneFollow => "lane-follow",
            Self::ObstacleStop => "obstacle-stop",
            Self::LaneLost => "lane-lost",
            Self::EStop => "e-stop",
            Self::Manual => "manual",
            Self::LightStop => "light-stop",
            Self::OvertakeWait => "overtake-wait",
            Self::OvertakeOut => "overtake-out",
            Self::OvertakePass => "overtake-pass",
            Self::OvertakeIn => "overtake-in",
            Self::OvertakeStop => "overtake-stop",
            Self::ParkSearch => "park-search",
            Self::ParkDrive => "park-drive",
            Self::Parked => "parked",
            Self::ParkStop => "park-stop",
        }
    }
}

/// The state of the decision node with the reason for it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DecisionState {
    /// The state.
    pub state: DriveState,
    /// When it was entered, on the car's clock.
    pub since: Stamp,
    /// Why it was entered, with the numbers that decided, for people: `front clear for 0.5 s (nearest 1.32 m)`.
    pub reason: String,
    /// Speed that the state asks for, m/s, + is forward.
    pub target_speed_m_s: f32,
    /// Steering before the actuator's limits, rad, body frame, + is left.
    pub steering_rad: f32,
    /// Transitions since the start of the node.
    pub transitions: u64,
}

crate::message!(DecisionState, "carril/DecisionState", 4);
