//! The configuration of parking.

use carril_runtime::Findings;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::gap::Search;
use super::geometry::Car;
use super::plan::{Kind, Limits};
use crate::scan_points::BodyConfig;

/// How the car gets into a gap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// By arcs that are planned from what is measured, and corrected.
    #[default]
    Arcs,
    /// By the recipe of the seed: back to the right, back to the left, forward, each for its time. For comparison.
    Timed,
}

/// On which side of the lane the row is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Side {
    /// Right of the car.
    #[default]
    Right,
    /// Left of the car.
    Left,
}

/// How the car parks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ParkConfig {
    /// Parks as soon as it follows the lane, without a person's goal: `parallel` or `perpendicular`. For simulations.
    pub goal: Option<carril_messages::Parking>,
    /// By arcs, or by the clock.
    pub mode: Mode,
    /// The side of the lane on which the row is.
    pub side: Side,
    /// Speed along the lane while a gap is looked for, m/s, 0.02 to 2.
    #[schemars(range(min = 0.02, max = 2), extend("unit" = "m/s"))]
    pub search_speed_m_s: f64,
    /// The search is given up after this way, m, 0.5 to 1000.
    #[schemars(range(min = 0.5, max = 1000), extend("unit" = "m"))]
    pub search_m: f64,
    /// The row's flank is no farther to the side of the car's middle, m, 0.1 to 2.
    #[schemars(range(min = 0.1, max = 2), extend("unit" = "m"))]
    pub within_m: f64,
    /// Speed on the way into the gap, m/s, 0.02 to 1.
    #[schemars(range(min = 0.02, max = 1), extend("unit" = "m/s"))]
    pub speed_m_s: f64,
    /// Speed at the end of each move, m/s, 0.02 to 1.
    #[schemars(range(min = 0.02, max = 1), extend("unit" = "m/s"))]
    pub creep_m_s: f64,
    /// What plans keep from the neighbours, m, 0 to 0.5.
    #[schemars(range(min = 0, max = 0.5), extend("unit" = "m"))]
    pub margin_m: f64,
    /// A gap that takes more changes of direction is refused as too short, 1 to 50.
    #[schemars(range(min = 1, max = 50), extend("unit" = "moves"))]
    pub max_moves: u32,
    /// Plans leave so much of the steering to correct with, degrees, 0 to 10.
    #[schemars(range(min = 0, max = 10), extend("unit" = "degrees"))]
    pub reserve_deg: f64,
    /// So often the car corrects where it stands in the gap, 0 to 20.
    #[schemars(range(min = 0, max = 20), extend("unit" = "times"))]
    pub max_corrections: u32,
    /// It corrects while it stands farther beside its place than this, m, 0.002 to 0.2, ...
    #[schemars(range(min = 0.002, max = 0.2), extend("unit" = "m"))]
    pub tolerance_m: f64,
    /// ... or turned by more, degrees, 0.2 to 20.
    #[schemars(range(min = 0.2, max = 20), extend("unit" = "degrees"))]
    pub tolerance_deg: f64,
    /// At the end of its corrections, it has parked when it stands no farther beside its place, m, 0.002 to 0.5, ...
    #[schemars(range(min = 0.002, max = 0.5), extend("unit" = "m"))]
    pub accept_m: f64,
    /// ... and is turned by no more, degrees, 0.2 to 30.
    #[schemars(range(min = 0.2, max = 30), extend("unit" = "degrees"))]
    pub accept_deg: f64,
    /// Before each move the car stands and turns its wheels for so long, s, 0 to 5.
    #[schemars(range(min = 0, max = 5), extend("unit" = "s"))]
    pub settle_s: f64,
    /// On this way it comes back onto an arc, m, 0.02 to 2.
    #[schemars(range(min = 0.02, max = 2), extend("unit" = "m"))]
    pub settle_m: f64,
    /// From the command to stand to the stand, s, 0 to 2.
    #[schemars(range(min = 0, max = 2), extend("unit" = "s"))]
    pub stop_s: f64,
    /// An older scan counts as none, and ends parking, ms, 50 to 5000.
    #[schemars(range(min = 50, max = 5000), extend("unit" = "ms"))]
    pub scan_timeout_ms: f64,
    /// Older news of the wheels count as none, and end parking, ms, 50 to 5000.
    #[schemars(range(min = 50, max = 5000), extend("unit" = "ms"))]
    pub wheels_timeout_ms: f64,
    /// Who has not parked after this time has failed, s, 1 to 3600.
    #[schemars(range(min = 1, max = 3600), extend("unit" = "s"))]
    pub max_s: f64,
    /// The recipe of `mode: timed`.
    pub timed: TimedConfig,
}

/// Back to the right, back to the left, forward.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[expect(clippy::struct_field_names, reason = "the unit belongs to each name")]
pub struct TimedConfig {
    /// m/s, 0.02 to 1.
    #[schemars(range(min = 0.02, max = 1), extend("unit" = "m/s"))]
    pub speed_m_s: f64,
    /// Back with the wheels towards the row, s, 0 to 60.
    #[schemars(range(min = 0, max = 60), extend("unit" = "s"))]
    pub back_in_s: f64,
    /// Back with the wheels towards the lane, s, 0 to 60.
    #[schemars(range(min = 0, max = 60), extend("unit" = "s"))]
    pub back_out_s: f64,
    /// Forward, s, 0 to 60.
    #[schemars(range(min = 0, max = 60), extend("unit" = "s"))]
    pub forward_s: f64,
}

impl Default for TimedConfig {
    fn default() -> Self {
        Self { speed_m_s: 0.12, back_in_s: 5.0, back_out_s: 3.0, forward_s: 2.0 }
    }
}

impl Default for ParkConfig {
    fn default() -> Self {
        Self {
            goal: None,
            mode: Mode::Arcs,
            side: Side::Right,
            search_speed_m_s: 0.3,
            search_m: 20.0,
            within_m: 0.6,
            speed_m_s: 0.2,
            creep_m_s: 0.06,
            margin_m: 0.015,
            max_moves: 16,
            reserve_deg: 1.0,
            max_corrections: 6,
            tolerance_m: 0.010,
            tolerance_deg: 1.0,
            accept_m: 0.025,
            accept_deg: 2.5,
            settle_s: 0.3,
            settle_m: 0.12,
            stop_s: 0.1,
            scan_timeout_ms: 500.0,
            wheels_timeout_ms: 300.0,
            max_s: 180.0,
            timed: TimedConfig::default(),
        }
    }
}

impl ParkConfig {
    pub(in crate::decision) fn check(&self, findings: &mut Findings<'_>) {
        for (name, value, min, max, unit) in [
            ("search_speed_m_s", self.search_speed_m_s, 0.02, 2.0, "m/s"),
            ("search_m", self.search_m, 0.5, 1000.0, "m"),
            ("within_m", self.within_m, 0.1, 2.0, "m"),
            ("speed_m_s", self.speed_m_s, 0.02, 1.0, "m/s"),
            ("creep_m_s", self.creep_m_s, 0.02, 1.0, "m/s"),
            ("margin_m", self.margin_m, 0.0, 0.5, "m"),
            ("max_moves", f64::from(self.max_moves), 1.0, 50.0, "moves"),
            ("reserve_deg", self.reserve_deg, 0.0, 10.0, "degrees"),
            ("max_corrections", f64::from(self.max_corrections), 0.0, 20.0, "times"),
            ("tolerance_m", self.tolerance_m, 0.002, 0.2, "m"),
            ("tolerance_deg", self.tolerance_deg, 0.2, 20.0, "degrees"),
            ("accept_m", self.accept_m, 0.002, 0.5, "m"),
            ("accept_deg", self.accept_deg, 0.2, 30.0, "degrees"),
            ("settle_s", self.settle_s, 0.0, 5.0, "s"),
            ("settle_m", self.settle_m, 0.02, 2.0, "m"),
            ("stop_s", self.stop_s, 0.0, 2.0, "s"),
            ("scan_timeout_ms", self.scan_timeout_ms, 50.0, 5000.0, "ms"),
            ("wheels_timeout_ms", self.wheels_timeout_ms, 50.0, 5000.0, "ms"),
            ("max_s", self.max_s, 1.0, 3600.0, "s"),
            ("timed.speed_m_s", self.timed.speed_m_s, 0.02, 1.0, "m/s"),
            ("timed.back_in_s", self.timed.back_in_s, 0.0, 60.0, "s"),
            ("timed.back_out_s", self.timed.back_out_s, 0.0, 60.0, "s"),
            ("timed.forward_s", self.timed.forward_s, 0.0, 60.0, "s"),
        ] {
            findings.range(&format!("park.{name}"), value, min, max, unit);
        }
    }

    /// What plans keep to.
    pub(super) fn limits(&self) -> Limits {
        Limits { margin_m: self.margin_m, max_moves: self.max_moves }
    }

    /// What is looked for beside the car.
    pub(super) fn search(&self, body: &BodyConfig, kind: Kind) -> Search {
        let deep_m = match kind {
            Kind::Parallel => body.width_m,
            Kind::Perpendicular => body.front_m - body.rear_m,
        };
        Search {
            within_m: self.within_m,
            half_width_m: body.width_m / 2.0,
            depth_m: deep_m,
            least_m: body.width_m,
            lidar_m: body.lidar_forward_m,
        }
    }
}

/// The car as plans see it.
pub(super) fn car(body: &BodyConfig, wheelbase_m: f64, max_steering_deg: f64, reserve_deg: f64) -> Car {
    let curvature = |degrees: f64| degrees.to_radians().tan() / wheelbase_m;
    Car {
        wheelbase_m,
        front_m: body.front_m,
        rear_m: -body.rear_m,
        width_m: body.width_m,
        plan_curvature_per_m: curvature((max_steering_deg - reserve_deg).max(0.5 * max_steering_deg)),
        curvature_per_m: curvature(max_steering_deg),
    }
}
