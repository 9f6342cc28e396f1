//! What the decision is made from: the lane and the way ahead, boiled down from messages that may be late, damaged or absent.

use std::fmt;
use std::time::Duration;

use carril_messages::{Lane, LaneEstimate, Sectors, Stamp};
use serde::{Deserialize, Serialize};

use super::config::DecisionConfig;

/// What is known of the lane. Survives from step to step and is handed over.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LaneMemory {
    /// Exposure of the newest estimate; `None` before the first.
    pub captured: Option<Stamp>,
    /// Estimates in a row with a lane.
    pub good: u32,
    /// Estimates in a row without one.
    pub bad: u32,
    /// What was wrong with the last bad one.
    pub problem: Option<LaneProblem>,
}

/// What is wrong with an estimate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum LaneProblem {
    /// The detector says "no lane".
    NoLane,
    /// The detector does not trust it.
    LowQuality(f32),
    /// It holds numbers that are none.
    NotFinite,
}

impl fmt::Display for LaneProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoLane => f.write_str("no lane"),
            Self::LowQuality(quality) => write!(f, "lane quality {quality:.2}"),
            Self::NotFinite => f.write_str("a lane that is no number"),
        }
    }
}

impl LaneMemory {
    /// Takes in an estimate; gives the lane when it is to be believed.
    pub fn observe<'a>(
        &mut self,
        estimate: &'a LaneEstimate,
        captured: Stamp,
        config: &DecisionConfig,
    ) -> Option<&'a Lane> {
        self.captured = Some(captured);
        match judge(estimate, config) {
            Ok(lane) => {
                self.good = self.good.saturating_add(1);
                self.bad = 0;
                self.problem = None;
                Some(lane)
            }
            Err(problem) => {
                self.good = 0;
                self.bad = self.bad.saturating_add(1);
                self.problem = Some(problem);
                None
            }
        }
    }

    /// How long ago the newest estimate's exposure was; `None` before the first.
    pub fn age(&self, now: Stamp) -> Option<Duration> {
        self.captured.map(|captured| now.since(captured).to_duration())
    }
}

fn judge<'a>(estimate: &'a LaneEstimate, config: &DecisionConfig) -> Result<&'a Lane, LaneProblem> {
    let lane = estimate.lane.as_ref().ok_or(LaneProblem::NoLane)?;
    let ground = lane.ground.is_none_or(|ground| ground.is_finite());
    if !(lane.angle_rad.is_finite() && lane.distance_px.is_finite() && ground && estimate.quality.is_finite()) {
        return Err(LaneProblem::NotFinite);
    }
    if f64::from(estimate.quality) < config.min_quality {
        return Err(LaneProblem::LowQuality(estimate.quality));
    }
    Ok(lane)
}

/// The way ahead.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Front {
    /// Nothing in it, or only beyond `obstacle_clear_m`. The nearest return, m.
    Clear(Option<f32>),
    /// Something between `obstacle_stop_m` and `obstacle_clear_m`: no reason to stop, and none to go on.
    Near(f32),
    /// Something nearer than `obstacle_stop_m`: its distance, m, and the count of returns within the sector's limit.
    Blocked(f32, u32),
    /// Nothing is known, and why.
    Unknown(String),
    /// There is no lidar, and none is asked for.
    NoLidar,
}

/// Judges the newest sectors.
pub fn front_of(sectors: &Sectors, config: &DecisionConfig) -> Front {
    let name = &config.front_sector;
    let Some(sector) = sectors.get(name) else {
        let names: Vec<_> = sectors.sectors.iter().map(|sector| sector.name.as_str()).collect();
        return Front::Unknown(format!("the scan has no sector `{name}`, only `{}`", names.join("`, `")));
    };
    // A coverage that is no number counts as none.
    if sector.coverage.is_nan() || f64::from(sector.coverage) < config.min_coverage {
        return Front::Unknown(format!("sector `{name}` measured only {:.0} % of its rays", 100.0 * sector.coverage));
    }
    let Some(nearest) = sector.nearest_m.filter(|_| sector.occupied) else { return Front::Clear(sector.nearest_m) };
    if nearest.is_nan() || f64::from(nearest) <= config.obstacle_stop_m {
        Front::Blocked(nearest, sector.returns_within)
    } else if f64::from(nearest) > config.obstacle_clear_m {
        Front::Clear(Some(nearest))
    } else {
        Front::Near(nearest)
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Centroid, Sector};

    use super::*;

    fn estimate(quality: f32, angle_rad: f32) -> LaneEstimate {
        let centroid = Centroid { left_px: 0.0, ahead_px: 1.0, pixels: 5 };
        let lane = Lane { angle_rad, distance_px: 0.0, distance_m: None, ground: None, far: centroid, near: centroid };
        LaneEstimate { lane: Some(lane), quality, threshold: Some(190) }
    }

    #[test]
    fn counts_good_and_bad_estimates_in_a_row() {
        let (mut memory, config) = (LaneMemory::default(), DecisionConfig::default());
        for quality in [0.9, 0.8] {
            assert!(memory.observe(&estimate(quality, 0.1), Stamp::ZERO, &config).is_some(), "believed");
        }
        assert_eq!((memory.good, memory.bad), (2, 0), "two good ones");
        let none = LaneEstimate { lane: None, quality: 0.0, threshold: None };
        for (bad, problem) in [
            (none, LaneProblem::NoLane),
            (estimate(0.05, 0.1), LaneProblem::LowQuality(0.05)),
            (estimate(0.9, f32::NAN), LaneProblem::NotFinite),
            (estimate(f32::NAN, 0.1), LaneProblem::NotFinite),
        ] {
            assert!(memory.observe(&bad, Stamp::ZERO, &config).is_none(), "{bad:?}");
            assert_eq!((memory.good, memory.problem), (0, Some(problem)), "{bad:?}");
        }
        assert_eq!(memory.bad, 4, "four bad ones");
    }

    fn front(nearest_m: Option<f32>, occupied: bool, coverage: f32) -> Front {
        let sector = Sector {
            name: "front".into(),
            from_rad: -0.5,
            to_rad: 0.5,
            nearest_m,
            nearest_bearing_rad: nearest_m,
            returns_within: 4,
            occupied,
            coverage,
        };
        front_of(&Sectors { sectors: vec![sector] }, &DecisionConfig::default())
    }

    #[test]
    fn judges_the_way_ahead() {
        assert_eq!(front(None, false, 1.0), Front::Clear(None), "nothing there");
        assert_eq!(front(Some(0.3), false, 1.0), Front::Clear(Some(0.3)), "a speck is noise");
        assert_eq!(front(Some(0.5), true, 1.0), Front::Blocked(0.5, 4), "as near as `obstacle_stop_m`");
        assert_eq!(front(Some(0.6), true, 1.0), Front::Near(0.6), "in between");
        assert_eq!(front(Some(0.71), true, 1.0), Front::Clear(Some(0.71)), "beyond `obstacle_clear_m`");
        assert!(matches!(front(Some(f32::NAN), true, 1.0), Front::Blocked(..)), "occupied at no number is near");
        for coverage in [0.29, f32::NAN] {
            assert!(matches!(front(None, false, coverage), Front::Unknown(_)), "blind at {coverage}");
        }
        let none = front_of(&Sectors { sectors: Vec::new() }, &DecisionConfig::default());
        assert!(matches!(none, Front::Unknown(_)), "no such sector");
    }
}
