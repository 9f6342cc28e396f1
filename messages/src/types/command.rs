//! What the car shall do.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Set points for the next moments. Decision makes it, the actuator limits it, the bridge sends it on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Command {
    /// Road-wheel angle, rad, body frame, + is left. The 1:10 car's stops are ±0.349 (20°).
    pub steering_rad: f32,
    /// Speed of the car along its x axis, m/s, + is forward. 0 is stop.
    pub speed_m_s: f32,
}

crate::message!(Command, "carril/Command", 1);

impl Command {
    /// Whether both numbers are numbers. A command that is not finite must never reach a wheel.
    pub fn is_finite(&self) -> bool {
        self.steering_rad.is_finite() && self.speed_m_s.is_finite()
    }
}

/// What a person asks of the decision node: `carril pub decision/goal '{"cruise": {"speed_m_s": 0.4}}'`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Goal {
    /// Follow the lane at this speed.
    Cruise {
        /// m/s, forward, > 0. The decision node limits it to its own maximum.
        speed_m_s: f32,
    },
    /// Park in the next gap beside the lane that is long enough.
    Park(Parking),
}

crate::message!(Goal, "carril/Goal", 2);

/// How parked cars stand beside the lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Parking {
    /// Behind each other, along it.
    Parallel,
    /// Beside each other, across it.
    Perpendicular,
}

impl Parking {
    /// As on the wire and in the YAML: `parallel`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Parallel => "parallel",
            Self::Perpendicular => "perpendicular",
        }
    }
}
