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

/// The lane on the floor: a curve whose curvature changes evenly along it (a clothoid). Body frame: the origin is the middle of the
/// rear axle, x forward, y left; everything is + to the left. `s` is the way along the lane's middle from its point nearest to the
/// origin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GroundLane {
    /// Distance of the lane's middle from the origin, m, + when it passes on the left.
    pub offset_m: f32,
    /// Direction of the lane's middle at `s` = 0 against the car's, rad, + when it leads to the left.
    pub heading_rad: f32,
    /// Curvature at `s` = 0, 1/m, + in a left curve.
    pub curvature_per_m: f32,
    /// Change of the curvature along the lane, 1/m².
    pub curvature_rate_per_m2: f32,
    /// Between the middles of the lines on both sides, m.
    pub width_m: f32,
    /// How far ahead of the origin the farthest marking was seen that went into it, m. 0 when none was.
    pub seen_m: f32,
    /// The line on the left was seen.
    pub left_seen: bool,
    /// The line on the right was seen.
    pub right_seen: bool,
    /// Way that the car has driven since it last saw any line, m: 0 when it sees one.
    pub bridged_m: f32,
}

impl GroundLane {
    /// Whether every number is a number.
    pub fn is_finite(&self) -> bool {
        [self.offset_m, self.heading_rad, self.curvature_per_m, self.curvature_rate_per_m2, self.width_m, self.seen_m]
            .into_iter()
            .chain([self.bridged_m])
            .all(f32::is_finite)
    }

    /// The point of the lane's middle at `s_m`, ahead and left, m. Negative `s_m` lies behind the car.
    pub fn point_at(&self, s_m: f64) -> [f64; 2] {
        const STEPS: u32 = 16;
        let (offset, heading) = (f64::from(self.offset_m), f64::from(self.heading_rad));
        let (mut x, mut y) = (-offset * heading.sin(), offset * heading.cos());
        let step = s_m / f64::from(STEPS);
        for index in 0..STEPS {
            let direction = self.direction_at((f64::from(index) + 0.5) * step);
            x += direction.cos() * step;
            y += direction.sin() * step;
        }
        [x, y]
    }

    /// The point ahead on the lane's middle that is `distance_m` away from `from`; where the lane is farther away than that, the point
    /// of it beside `from`. Both ahead and left of the origin, m.
    pub fn point_away_from(&self, from: [f64; 2], distance_m: f64) -> [f64; 2] {
        let away = |s: f64| {
            let [x, y] = self.point_at(s);
            (x - from[0]).hypot(y - from[1])
        };
        // `from` lies near the origin: a few steps along the lane lead to the point beside it.
        let mut beside = 0.0;
        for _ in 0..4 {
            let [x, y] = self.point_at(beside);
            let direction = self.direction_at(beside);
            beside += (from[0] - x) * direction.cos() + (from[1] - y) * direction.sin();
        }
        if away(beside) >= distance_m {
            return self.point_at(beside);
        }
        // A lane that turns back within the distance is followed for at most this long.
        let (mut low, mut high) = (beside, beside + 1.5 * distance_m);
        if away(high) < distance_m {
            return self.point_at(high);
        }
        for _ in 0..20 {
            let middle = f64::midpoint(low, high);
            if away(middle) < distance_m {
                low = middle;
            } else {
                high = middle;
            }
        }
        self.point_at(high)
    }

    /// Direction of the lane's middle at `s_m` against the car's, rad.
    pub fn direction_at(&self, s_m: f64) -> f64 {
        let (curvature, rate) = (f64::from(self.curvature_per_m), f64::from(self.curvature_rate_per_m2));
        f64::from(self.heading_rad) + s_m * (curvature + 0.5 * s_m * rate)
    }
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
    /// The lane on the floor, from detectors that know the camera's place on the car. `None` from the others.
    pub ground: Option<GroundLane>,
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

crate::message!(LaneEstimate, "carril/LaneEstimate", 2);

#[cfg(test)]
mod tests {
    use super::*;

    fn lane(offset_m: f32, heading_rad: f32, curvature_per_m: f32) -> GroundLane {
        GroundLane {
            offset_m,
            heading_rad,
            curvature_per_m,
            curvature_rate_per_m2: 0.0,
            width_m: 0.4,
            seen_m: 1.0,
            left_seen: true,
            right_seen: true,
            bridged_m: 0.0,
        }
    }

    #[test]
    fn a_circle_is_a_circle() {
        // Around (0, 1), through the origin.
        let [x, y] = lane(0.0, 0.0, 1.0).point_at(std::f64::consts::FRAC_PI_2);
        assert!((x - 1.0).abs() < 1e-3 && (y - 1.0).abs() < 1e-3, "a quarter of it ends at (1, 1), got ({x}, {y})");
        let [x, y] = lane(0.1, 0.3, 0.0).point_at(0.0);
        assert!((x.hypot(y) - 0.1).abs() < 1e-6 && y > 0.0, "the nearest point is the offset away, got ({x}, {y})");
    }

    #[test]
    fn finds_the_point_at_a_distance() {
        for (offset, heading, curvature) in [(0.0, 0.0, 0.0), (0.1, -0.2, 0.8), (-0.2, 0.4, -1.0)] {
            for from in [[0.0, 0.0], [0.1, 0.02]] {
                let [x, y] = lane(offset, heading, curvature).point_away_from(from, 0.6);
                let away = (x - from[0]).hypot(y - from[1]);
                assert!((away - 0.6).abs() < 1e-3 && x > 0.0, "0.6 m away and ahead, got ({x}, {y})");
            }
        }
        let [x, y] = lane(0.7, 0.0, 0.0).point_away_from([0.1, 0.0], 0.6);
        assert!((x - 0.1).abs() < 1e-6 && (y - 0.7).abs() < 1e-6, "the point beside, of a far lane, got ({x}, {y})");
        let [x, y] = lane(0.0, 0.0, 10.0).point_away_from([0.0, 0.0], 0.6);
        assert!(x.is_finite() && y.is_finite(), "a lane that never gets so far away, got ({x}, {y})");
    }
}
