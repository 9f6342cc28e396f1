//! Operator `lidar-sectors`: a scan reduced to named sectors around the car. Keeps no state; never guesses what a ray that
//! measured nothing might have seen.

pub mod orientation;
#[cfg(test)]
mod tests;

use std::f64::consts::{PI, TAU};

use carril_messages::{LaserScan, MAX_SCAN_POINTS, Sector, Sectors};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A ray this close outside an edge still belongs to the sector: bearings come from 32-bit sums. 0.006 degrees.
const EDGE_TOLERANCE_RAD: f64 = 1e-4;

/// Configuration of the lidar sectors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LidarSectorsConfig {
    /// The sectors, 1 to 32 of them. They may overlap.
    #[schemars(length(min = 1, max = 32))]
    pub sectors: Vec<SectorConfig>,
    /// Direction of the lidar's x axis in the body frame, degrees, + counter-clockwise, -360 to 360. 180: mounted backwards.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub mounting_deg: f64,
    /// Directions in which the lidar sees the car itself; rays there belong to no sector.
    pub masks: Vec<MaskConfig>,
    /// Nearer returns are ignored, m, 0 to 10; the device's own minimum holds as well.
    #[schemars(range(min = 0, max = 10), extend("unit" = "m"))]
    pub min_range_m: f64,
}

/// A sector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SectorConfig {
    /// Its name: `front`. Unique.
    pub name: String,
    /// Right edge, degrees, body frame, 0 is ahead, + is left, -360 to 360.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub from_deg: f64,
    /// Left edge, degrees, body frame, -360 to 360. The sector runs counter-clockwise from `from_deg` to here: 150 to -150 is behind.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub to_deg: f64,
    /// Returns up to here count as being within the sector, m, > 0 to 100.
    #[serde(default = "default_limit_m")]
    #[schemars(range(max = 100), extend("exclusiveMinimum" = 0, "unit" = "m"))]
    pub limit_m: f64,
    /// So many returns within the limit make the sector occupied; fewer are noise. 1 to 65536.
    #[serde(default = "default_min_returns")]
    #[schemars(range(min = 1, max = MAX_SCAN_POINTS), extend("unit" = "returns"))]
    pub min_returns: u32,
}

/// A range of directions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MaskConfig {
    /// Right edge, degrees, body frame, + is left, -360 to 360.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub from_deg: f64,
    /// Left edge, degrees, body frame, -360 to 360.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub to_deg: f64,
}

fn default_limit_m() -> f64 {
    1.0
}

fn default_min_returns() -> u32 {
    3
}

impl Default for LidarSectorsConfig {
    fn default() -> Self {
        let sector = |name: &str, from_deg, to_deg, limit_m| SectorConfig {
            name: name.into(),
            from_deg,
            to_deg,
            limit_m,
            min_returns: default_min_returns(),
        };
        Self {
            sectors: vec![
                sector("front", -30.0, 30.0, 1.0),
                sector("front-left", 30.0, 75.0, 0.6),
                sector("left", 75.0, 105.0, 0.6),
                sector("rear", 150.0, -150.0, 0.6),
                sector("right", -105.0, -75.0, 0.6),
                sector("front-right", -75.0, -30.0, 0.6),
            ],
            mounting_deg: 0.0,
            masks: Vec::new(),
            min_range_m: 0.05,
        }
    }
}

impl OperatorConfig for LidarSectorsConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.require((1..=32).contains(&self.sectors.len()), "sectors", || {
            format!("got {} sectors, allowed is 1 to 32", self.sectors.len())
        });
        for (index, sector) in self.sectors.iter().enumerate() {
            let at = |field: &str| format!("sectors.{index}.{field}");
            let taken = self.sectors[..index].iter().any(|other| other.name == sector.name);
            findings.require(!taken, &at("name"), || format!("`{}` is the name of an earlier sector", sector.name));
            findings.require(!sector.name.is_empty() && sector.name.len() <= 64, &at("name"), || {
                format!("got {} characters, allowed is 1 to 64", sector.name.len())
            });
            check_edges(findings, &format!("sectors.{index}"), sector.from_deg, sector.to_deg);
            findings.require(sector.limit_m > 0.0 && sector.limit_m <= 100.0, &at("limit_m"), || {
                format!("got {} m, allowed is more than 0, up to 100 m", sector.limit_m)
            });
            findings.range(&at("min_returns"), f64::from(sector.min_returns), 1.0, MAX_SCAN_POINTS as f64, "returns");
        }
        findings.range("mounting_deg", self.mounting_deg, -360.0, 360.0, "degrees");
        for (index, mask) in self.masks.iter().enumerate() {
            check_edges(findings, &format!("masks.{index}"), mask.from_deg, mask.to_deg);
        }
        findings.range("min_range_m", self.min_range_m, 0.0, 10.0, "m");
    }
}

fn check_edges(findings: &mut Findings<'_>, field: &str, from_deg: f64, to_deg: f64) {
    findings.range(&format!("{field}.from_deg"), from_deg, -360.0, 360.0, "degrees");
    findings.range(&format!("{field}.to_deg"), to_deg, -360.0, 360.0, "degrees");
    findings.require(from_deg != to_deg, &format!("{field}.to_deg"), || {
        format!("got {to_deg} degrees like `from_deg`, which is no width; all around is -180 to 180")
    });
}

/// A range of directions, from its right edge counter-clockwise.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Arc {
    /// Right edge, rad, -π to π.
    from_rad: f64,
    /// > 0 to 2π.
    width_rad: f64,
}

impl Arc {
    fn from_degrees(from_deg: f64, to_deg: f64) -> Self {
        let width = (to_deg - from_deg).rem_euclid(360.0);
        let width_deg = if width == 0.0 { 360.0 } else { width };
        Self { from_rad: wrap(from_deg.to_radians()), width_rad: width_deg.to_radians() }
    }

    /// `bearing_rad` is wrapped to -π to π.
    fn contains(self, bearing_rad: f64) -> bool {
        let beyond = bearing_rad - self.from_rad;
        let beyond = if beyond < -EDGE_TOLERANCE_RAD { beyond + TAU } else { beyond };
        beyond <= self.width_rad + EDGE_TOLERANCE_RAD || beyond >= TAU - EDGE_TOLERANCE_RAD
    }
}

/// An angle between -π and π.
fn wrap(angle_rad: f64) -> f64 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}

/// What a ray says.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Ray {
    /// Nothing within the device's reach.
    Free,
    /// A return at this range, m.
    Return(f32),
    /// No measurement, or nearer than can be measured.
    Blind,
}

/// What is being collected for one sector.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    rays: u32,
    measured: u32,
    within: u32,
    nearest: Option<(f32, f64)>,
}

/// Reduces scans to sectors.
pub struct LidarSectors {
    sectors: Vec<(SectorConfig, Arc)>,
    masks: Vec<Arc>,
    mounting_rad: f64,
    min_range_m: f64,
}

impl LidarSectors {
    /// From a configuration that has passed its check.
    pub fn from_config(config: LidarSectorsConfig) -> Self {
        let sectors = config.sectors.into_iter().map(|sector| {
            let arc = Arc::from_degrees(sector.from_deg, sector.to_deg);
            (sector, arc)
        });
        Self {
            sectors: sectors.collect(),
            masks: config.masks.iter().map(|mask| Arc::from_degrees(mask.from_deg, mask.to_deg)).collect(),
            mounting_rad: config.mounting_deg.to_radians(),
            min_range_m: config.min_range_m,
        }
    }

    /// What lies in the sectors, or what is wrong with the scan.
    pub fn reduce(&self, scan: &LaserScan) -> Result<Sectors, String> {
        check_scan(scan)?;
        let mut tallies = vec![Tally::default(); self.sectors.len()];
        for (index, range) in scan.ranges_m.iter().enumerate() {
            let angle = f64::from(scan.angle_min_rad) + index as f64 * f64::from(scan.angle_increment_rad);
            let bearing = wrap(angle + self.mounting_rad);
            if self.masks.iter().any(|mask| mask.contains(bearing)) {
                continue;
            }
            let ray = self.ray(scan, *range);
            for ((sector, arc), tally) in self.sectors.iter().zip(&mut tallies) {
                if arc.contains(bearing) {
                    tally.add(ray, bearing, sector.limit_m);
                }
            }
        }
        let sectors = self.sectors.iter().zip(tallies);
        Ok(Sectors { sectors: sectors.map(|((sector, arc), tally)| tally.finish(sector, *arc)).collect() })
    }

    fn ray(&self, scan: &LaserScan, range_m: f32) -> Ray {
        let nearest = f64::from(scan.range_min_m).max(self.min_range_m);
        if range_m.is_nan() || range_m <= 0.0 || f64::from(range_m) < nearest {
            Ray::Blind
        } else if range_m > scan.range_max_m || range_m.is_infinite() {
            Ray::Free
        } else {
            Ray::Return(range_m)
        }
    }
}

impl Tally {
    fn add(&mut self, ray: Ray, bearing_rad: f64, limit_m: f64) {
        self.rays += 1;
        self.measured += u32::from(ray != Ray::Blind);
        if let Ray::Return(range_m) = ray {
            self.within += u32::from(f64::from(range_m) <= limit_m);
            if self.nearest.is_none_or(|(nearest, _)| range_m < nearest) {
                self.nearest = Some((range_m, bearing_rad));
            }
        }
    }

    fn finish(self, sector: &SectorConfig, arc: Arc) -> Sector {
        Sector {
            name: sector.name.clone(),
            from_rad: arc.from_rad as f32,
            to_rad: (arc.from_rad + arc.width_rad) as f32,
            nearest_m: self.nearest.map(|(range, _)| range),
            nearest_bearing_rad: self.nearest.map(|(_, bearing)| bearing as f32),
            returns_within: self.within,
            occupied: self.within >= sector.min_returns,
            coverage: if self.rays == 0 { 0.0 } else { self.measured as f32 / self.rays as f32 },
        }
    }
}

fn check_scan(scan: &LaserScan) -> Result<(), String> {
    let points = scan.ranges_m.len();
    if points > MAX_SCAN_POINTS {
        return Err(format!("the scan has {points} points, allowed are at most {MAX_SCAN_POINTS}"));
    }
    let angles = [("angle_min_rad", scan.angle_min_rad), ("angle_increment_rad", scan.angle_increment_rad)];
    for (field, angle) in angles {
        if angle.is_nan() || angle.abs() > 100.0 {
            return Err(format!("the scan's `{field}` is {angle}, allowed is -100 to 100 rad"));
        }
    }
    if !(scan.range_min_m >= 0.0 && scan.range_min_m <= scan.range_max_m) {
        let (min, max) = (scan.range_min_m, scan.range_max_m);
        return Err(format!("the scan measures from {min} to {max} m, allowed is 0 <= `range_min_m` <= `range_max_m`"));
    }
    Ok(())
}

carril_runtime::inputs! {
    /// What the lidar sectors read.
    pub struct LidarSectorsInputs {
        /// Scans of a planar lidar.
        scan: LaserScan,
    }
}

carril_runtime::outputs! {
    /// What the lidar sectors give.
    pub struct LidarSectorsOutputs {
        /// The sectors, in the order of the configuration; one message per scan.
        sectors: Sectors,
    }
}

impl Operator for LidarSectors {
    const KIND: &'static str = "lidar-sectors";
    const SUMMARY: &'static str =
        "what lies around the car: nearest return and occupancy of named sectors of a lidar scan";

    type Config = LidarSectorsConfig;
    type Inputs = LidarSectorsInputs;
    type Outputs = LidarSectorsOutputs;

    fn new(config: LidarSectorsConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self::from_config(config))
    }

    fn step(
        &mut self,
        inputs: &mut LidarSectorsInputs,
        outputs: &mut LidarSectorsOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        let mut refused = Ok(());
        while let Some(scan) = inputs.scan.take() {
            match self.reduce(&scan) {
                Ok(sectors) => outputs.sectors.send(sectors),
                Err(reason) => refused = Err(StepError::new(reason)),
            }
        }
        refused
    }

    carril_runtime::stateless!();
}
