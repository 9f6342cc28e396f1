//! Where the lane lies, as seen in one image.
//!
//! Pixel coordinates are those of the car, not of the image: the origin is the middle of the bottom row, `ahead_px` counts
//! rows upwards (body x), `left_px` counts columns to the left (body y). So angles and distances are + to the left, like
//! every other angle in carril.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The mean position of the marking pixels in one band of rows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Centroid {
    /// Columns to the left of the middle of the image, px.
    pub left_px: f32,
    /// Rows above the bottom row, px.
    pub ahead_px: f32,
    /// Marking pixels that went into the mean, > 0.
    pub pixels: u32,
}

/// The straight line through both centroids.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Lane {
    /// Direction of the line against the car's, rad in the image plane, + when it leads to the left:
    /// `atan((far.left - near.left) / (far.ahead - near.ahead))`.
    pub angle_rad: f32,
    /// Distance of the line from the origin, px, + when it passes on the left:
    /// `(far.left - tan(angle) * far.ahead) * cos(angle)`.
    pub distance_px: f32,
    /// The same on the ground, m, body frame, + left. `None` without calibration.
    pub distance_m: Option<f32>,
    /// In the band that is farther from the car.
    pub far: Centroid,
    /// In the band that is nearer to the car.
    pub near: Centroid,
}

/// The answer of a lane detector to one image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LaneEstimate {
    /// The lane; `None` when there is no lane to be seen.
    pub lane: Option<Lane>,
    /// How much the detector trusts it, 0 (not at all) to 1. 0 when `lane` is `None`.
    pub quality: f32,
    /// The grey value that divided marking from floor, 0 to 255; `None` in colour mode.
    pub threshold: Option<u8>,
}

crate::message!(LaneEstimate, "carril/LaneEstimate", 1);
