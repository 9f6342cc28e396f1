//! An image in, an estimate out: ridges, fit, track, and the fields that people and programs know from `lane-detector`.

use carril_messages::{Centroid, GroundLane, Image, Lane, LaneEstimate, Stamp};
use serde::{Deserialize, Serialize};

use super::config::LaneLinesConfig;
use super::floor::{Floor, Row};
use super::ridges::{Ridge, Scratch};
use super::track::{Frame, Track};
use crate::odometry::Wheels;

/// What the detector remembers from frame to frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LaneMemory {
    track: Option<Track>,
}

/// The detector, without ports.
#[derive(Clone, Debug)]
pub struct Detector {
    config: LaneLinesConfig,
    /// The floor as images of the last size show it, and the rows that are searched.
    floor: Option<(Floor, Vec<Row>)>,
    scratch: Scratch,
    memory: LaneMemory,
}

impl Detector {
    /// From a configuration that has passed its check.
    pub fn new(config: LaneLinesConfig) -> Self {
        Self { config, floor: None, scratch: Scratch::default(), memory: LaneMemory::default() }
    }

    /// Finds the lane in an image that was exposed at `captured`, without odometry.
    pub fn see(&mut self, image: &Image, captured: Stamp) -> LaneEstimate {
        self.detect(image, captured, None)
    }

    pub(crate) fn detect(&mut self, image: &Image, captured: Stamp, wheels: Option<Wheels>) -> LaneEstimate {
        let (floor, rows) = match self.floor.take() {
            Some((floor, rows)) if floor.fits(image.width(), image.height()) => (floor, rows),
            _ => {
                let floor = Floor::new(image.width(), image.height(), self.config.camera);
                (floor, floor.rows(self.config.far_m, self.config.lane_width_m))
            }
        };
        self.scratch.search(image, &rows, floor.middle_column(), &self.config);
        let frame = Frame { ridges: &self.scratch.ridges, rows: rows.len(), captured };
        self.memory.track = Track::next(self.memory.track.take(), frame, wheels, &self.config);
        let estimate = match &self.memory.track {
            Some(track) => {
                let lane = lane(&track.ground(), &floor, image, &self.config, self.scratch.ridges.len());
                LaneEstimate { lane: Some(lane), quality: track.quality(&self.config) as f32, threshold: None }
            }
            None => LaneEstimate { lane: None, quality: 0.0, threshold: None },
        };
        self.floor = Some((floor, rows));
        estimate
    }

    pub(crate) fn memory(&self) -> &LaneMemory {
        &self.memory
    }

    /// Goes on where a predecessor stopped.
    pub(crate) fn remember(&mut self, memory: LaneMemory) -> Result<(), &'static str> {
        if !memory.track.as_ref().is_none_or(Track::is_finite) {
            return Err("the predecessor's lane is no number");
        }
        self.memory = memory;
        Ok(())
    }

    pub(crate) fn config(&self) -> &LaneLinesConfig {
        &self.config
    }

    pub(crate) fn floor(&self) -> Option<&Floor> {
        self.floor.as_ref().map(|(floor, _)| floor)
    }

    pub(crate) fn ridges(&self) -> &[Ridge] {
        &self.scratch.ridges
    }
}

/// The lane with the fields of the image plane: the line through the points at which its middle crosses two rows.
fn lane(ground: &GroundLane, floor: &Floor, image: &Image, config: &LaneLinesConfig, pixels: usize) -> Lane {
    let [far, near] = [config.row_far, config.row_near].map(|share| {
        let y = ((f64::from(image.height()) * share) as u32).min(image.height() - 1);
        let left_px = floor.row(y).map_or(0.0, |row| left_at(ground, row.ahead_m) / row.metres_per_px);
        let ahead_px = f64::from(image.height() - 1 - y);
        Centroid { left_px: left_px as f32, ahead_px: ahead_px as f32, pixels: pixels.max(1) as u32 }
    });
    let rise = f64::from(far.ahead_px - near.ahead_px).max(1.0);
    let angle = (f64::from(far.left_px - near.left_px) / rise).atan();
    let distance_px = (f64::from(far.left_px) - angle.tan() * f64::from(far.ahead_px)) * angle.cos();
    Lane {
        angle_rad: angle as f32,
        distance_px: distance_px as f32,
        distance_m: Some(ground.offset_m),
        ground: Some(*ground),
        far,
        near,
    }
}

/// How far to the left of the car's axis the lane's middle lies at `ahead_m`; beyond the end of a tight curve, where its tangent leads.
pub(crate) fn left_at(ground: &GroundLane, ahead_m: f64) -> f64 {
    let (mut s, mut point) = (0.0, ground.point_at(0.0));
    for _ in 0..8 {
        s += (ahead_m - point[0]).clamp(-0.3, 0.3);
        point = ground.point_at(s);
    }
    point[1]
}
