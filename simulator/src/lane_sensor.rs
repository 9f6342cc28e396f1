//! An ideal lane sensor: what a flawless detector would say of a flawless image, computed from the truth. For graphs without a
//! camera: the same control law drives them.

use carril_messages::{Centroid, Lane as LaneLine, LaneEstimate, Pose};
use nalgebra::{Isometry2, Point2, Vector2};

use crate::camera::model::CameraModel;
use crate::track::Lane;

/// Rows that it looks at, as shares of the image height: those of the lane detector's defaults.
const ROW_FAR: f64 = 0.75;
const ROW_NEAR: f64 = 0.85;
/// It looks no farther along the lane than this, m.
const REACH_M: f64 = 3.0;

/// The point of the lane's middle that a row shows.
#[derive(Clone, Copy, Debug)]
struct Seen {
    left_px: f64,
    ahead_px: f64,
    on_ground: Point2<f64>,
}

/// The lane as seen from a pose; `index` is the sample of its middle nearest to the car.
pub fn estimate(model: &CameraModel, pose: Pose, lane: &Lane, index: usize) -> LaneEstimate {
    let row = |share: f64| (share * model.height as f64).floor();
    let both = seen(model, pose, lane, index, row(ROW_FAR)).zip(seen(model, pose, lane, index, row(ROW_NEAR)));
    match both {
        Some((far, near)) => LaneEstimate { lane: Some(line(model, far, near)), quality: 1.0, threshold: None },
        None => LaneEstimate { lane: None, quality: 0.0, threshold: None },
    }
}

/// Where the middle of the lane crosses the floor line that `row` shows.
fn seen(model: &CameraModel, pose: Pose, lane: &Lane, index: usize, row: f64) -> Option<Seen> {
    let ground = model.ground_row(row)?;
    let body_from_map = Isometry2::new(Vector2::new(pose.x_m, pose.y_m), pose.yaw_rad).inverse();
    let (points, step_m) = (lane.centre.points(), lane.centre.step_m());
    let heading = Vector2::new(pose.yaw_rad.cos(), pose.yaw_rad.sin());
    // A car that drives against the lane's direction sees it the other way round.
    let stride = if lane.centre.directions()[index].dot(&heading) >= 0.0 { 1 } else { points.len() - 1 };
    let mut before = body_from_map * points[index];
    let mut at = index;
    for _ in 0..(REACH_M / step_m) as usize {
        at = (at + stride) % points.len();
        let after = body_from_map * points[at];
        if before.x <= ground.ahead_m && after.x > ground.ahead_m {
            let on_ground = before + (after - before) * ((ground.ahead_m - before.x) / (after.x - before.x));
            let left_px = on_ground.y / ground.metres_per_px;
            let in_view = left_px.abs() <= model.middle_column();
            return in_view.then_some(Seen { left_px, ahead_px: model.height as f64 - 1.0 - row, on_ground });
        }
        before = after;
    }
    None
}

/// The line through both points: the formulas of [`LaneLine`].
fn line(model: &CameraModel, far: Seen, near: Seen) -> LaneLine {
    let angle = ((far.left_px - near.left_px) / (far.ahead_px - near.ahead_px)).atan();
    let distance_px = (far.left_px - angle.tan() * far.ahead_px) * angle.cos();
    // The origin on the floor is what the middle of the bottom row shows.
    let origin = model.ground_point(model.middle_column(), model.height as f64 - 1.0);
    let along = (far.on_ground - near.on_ground).try_normalize(1e-9);
    let distance_m = origin.zip(along).map(|(origin, along)| along.perp(&(near.on_ground - origin)) as f32);
    let centroid = |seen: Seen| Centroid { left_px: seen.left_px as f32, ahead_px: seen.ahead_px as f32, pixels: 1 };
    LaneLine {
        angle_rad: angle as f32,
        distance_px: distance_px as f32,
        distance_m,
        ground: None,
        far: centroid(far),
        near: centroid(near),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::CameraConfig;
    use crate::track::Track;

    fn see(along_m: f64, left_m: f64, turned_rad: f64) -> LaneEstimate {
        let lane = Track::load("oval", Path::new(".")).expect("built in").lane.expect("a lane");
        let pose = lane.pose_at(along_m, left_m);
        let pose = Pose { yaw_rad: pose.yaw_rad + turned_rad, ..pose };
        estimate(&CameraConfig::default().model(), pose, &lane, lane.centre.index_at(along_m))
    }

    #[test]
    fn in_the_middle_of_a_straight_everything_is_zero() {
        let lane = see(0.5, 0.0, 0.0).lane.expect("a lane");
        assert!(lane.angle_rad.abs() < 1e-6 && lane.distance_px.abs() < 1e-4, "{lane:?}");
        assert_eq!((lane.far.ahead_px, lane.near.ahead_px), (119.0, 71.0), "rows 360 and 408 of 480");
    }

    #[test]
    fn a_lane_on_the_left_is_positive_in_pixels_and_metres() {
        let lane = see(0.5, -0.05, 0.0).lane.expect("a lane");
        assert!(lane.near.left_px > 30.0 && lane.distance_px > 30.0, "{lane:?}");
        assert!(lane.far.left_px < lane.near.left_px, "perspective draws it to the middle");
        let distance_m = lane.distance_m.expect("calibrated");
        assert!((distance_m - 0.05).abs() < 1e-4, "{distance_m} m");
    }

    #[test]
    fn a_left_curve_leads_to_the_left() {
        let lane = see(3.0, 0.0, 0.0).lane.expect("a lane");
        assert!(lane.angle_rad > 0.1 && lane.far.left_px > lane.near.left_px, "{lane:?}");
    }

    #[test]
    fn out_of_view_is_no_lane() {
        assert_eq!(see(0.5, 0.9, 0.0).lane, None, "90 cm beside it");
        assert_eq!(see(0.5, 0.0, 1.4).lane, None, "looking across");
    }
}
