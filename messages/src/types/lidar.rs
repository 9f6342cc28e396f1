//! What the lidar sees, point by point and by named sectors.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// No scan has more points.
pub const MAX_SCAN_POINTS: usize = 65_536;

/// One rotation of a planar lidar.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LaserScan {
    /// Angle of the first point, rad, sensor frame (x forward, + counter-clockwise).
    pub angle_min_rad: f32,
    /// From one point to the next, rad, + counter-clockwise.
    pub angle_increment_rad: f32,
    /// Duration of the rotation, s, > 0. The header's origin is its end.
    pub scan_time_s: f32,
    /// Nearest range that the device measures, m.
    pub range_min_m: f32,
    /// Farthest range that the device measures, m.
    pub range_max_m: f32,
    /// Ranges, m, point by point. `+inf`: nothing within reach (REP-117). `NaN`: no measurement. `-inf`: too near.
    pub ranges_m: Vec<f32>,
}

crate::message!(LaserScan, "carril/LaserScan", 1);

/// What lies in one named sector around the car.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Sector {
    /// Name from the configuration: `front`.
    pub name: String,
    /// Right edge, rad, body frame, + left.
    pub from_rad: f32,
    /// Left edge, rad, body frame, >= `from_rad`.
    pub to_rad: f32,
    /// Nearest return, m from the lidar; `None` when the sector has no return within the device's reach.
    pub nearest_m: Option<f32>,
    /// Direction of the nearest return, rad, body frame, + left.
    pub nearest_bearing_rad: Option<f32>,
    /// Returns nearer than the sector's limit.
    pub returns_within: u32,
    /// At least the configured number of returns within the limit.
    pub occupied: bool,
    /// Share of the sector's rays that measured anything at all (`inf` counts: it says "free"), 0 to 1. 0: the sector is blind.
    pub coverage: f32,
}

/// A scan reduced to named sectors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Sectors {
    /// In the order of the configuration.
    pub sectors: Vec<Sector>,
}

crate::message!(Sectors, "carril/Sectors", 1);

impl Sectors {
    /// The sector of that name.
    pub fn get(&self, name: &str) -> Option<&Sector> {
        self.sectors.iter().find(|sector| sector.name == name)
    }
}
