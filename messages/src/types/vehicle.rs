//! Where the car is, and how it does on its track.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Position and heading in the map frame (x east, y north, counter-clockwise).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Pose {
    /// m.
    pub x_m: f64,
    /// m.
    pub y_m: f64,
    /// rad, -pi to pi, 0 along x.
    pub yaw_rad: f64,
}

/// The motion of the car. Its point of reference is the middle of the rear axle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct VehicleState {
    /// Pose of the rear axle in the map.
    pub pose_in_map: Pose,
    /// Speed along the body's x axis, m/s.
    pub speed_m_s: f32,
    /// Turn rate, rad/s, + left.
    pub yaw_rate_rad_s: f32,
    /// Road-wheel angle as it is, not as commanded, rad, + left.
    pub steering_rad: f32,
}

crate::message!(VehicleState, "carril/VehicleState", 1);

/// The referee's view: how the car does on its track. Made by the simulator, which knows the truth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrackProgress {
    /// Whole laps driven.
    pub laps: u32,
    /// Duration of the last whole lap, s. `None` before the first.
    pub last_lap_s: Option<f64>,
    /// Path of the reference point since the start, m.
    pub distance_m: f64,
    /// Reference point against the middle of the lane, m, + when the car is left of it.
    pub cross_track_m: f32,
    /// Root mean square of it since the start, over distance, m.
    pub cross_track_rms_m: f32,
    /// Largest magnitude of it since the start, m.
    pub cross_track_max_m: f32,
    /// How often a wheel left the lane.
    pub departures: u32,
    /// A wheel is outside the lane now.
    pub outside: bool,
    /// How often the body touched something.
    pub collisions: u32,
    /// How near the body came to the nearest thing since the start, m; 0 when it touched. `None`: it never came within 1 m of one.
    pub clearance_min_m: Option<f32>,
    /// How often its front crossed a stop line while the traffic light had been red for a second.
    pub red_runs: u32,
    /// When it last stood before a stop line, at red: from its front to the line, m. `None` before the first time.
    pub stopped_before_line_m: Option<f32>,
}

crate::message!(TrackProgress, "carril/TrackProgress", 3);
