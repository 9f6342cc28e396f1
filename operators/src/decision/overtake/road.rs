//! What a scan shows of the road: along the car's own lane, and beside it.

use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

use super::config::OvertakeConfig;
use crate::decision::own_lane::OwnLane;
use crate::lane_curve::Curve;
use crate::scan_points::BodyConfig;

/// Farther along the lane nothing is looked for, m.
const REACH_M: f64 = 4.0;
/// Returns of one thing lie within this along the lane, m: its near face.
const FACE_M: f64 = 0.15;

/// What stands on the road. Distances along the car's own lane, from the front of the car, m.
#[allow(clippy::struct_field_names)]
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Road {
    /// To the nearest thing ahead in its own lane.
    pub ahead_m: Option<f64>,
    /// To the nearest thing in the left lane that is not behind the car. Below 0: beside it.
    pub left_m: Option<f64>,
    /// To the nearest thing in its own lane that is not behind the car, wherever the car itself is.
    pub own_m: Option<f64>,
}

impl Road {
    /// Of points in the body frame.
    pub(super) fn of(points: &[Vector2<f64>], own: &OwnLane, body: &BodyConfig, config: &OvertakeConfig) -> Self {
        let curve = Curve::new(&own.state());
        let half_m = body.width_m / 2.0 + config.clearance_m;
        let (mut in_own, mut in_left) = (Vec::new(), Vec::new());
        for point in points.iter().filter(|point| point.norm() <= REACH_M) {
            let seen = curve.locate(*point);
            let from_front_m = seen.along_m - body.front_m;
            if seen.left_m.abs() <= half_m {
                in_own.push(from_front_m);
            } else if (seen.left_m - own.width_m()).abs() <= half_m {
                in_left.push(from_front_m);
            }
        }
        let (rear_m, behind_m) = (body.rear_m - body.front_m, config.free_behind_m + body.front_m);
        Self {
            ahead_m: nearest_m(&mut in_own, 0.0, config.min_returns),
            left_m: nearest_m(&mut in_left, -behind_m, config.min_returns),
            own_m: nearest_m(&mut in_own, rear_m - 0.05, config.min_returns.min(2)),
        }
    }
}

/// The nearest of things that are not farther back than `least_m`, each with so many returns.
fn nearest_m(along_m: &mut [f64], least_m: f64, returns: u32) -> Option<f64> {
    along_m.sort_by(f64::total_cmp);
    let ahead = &along_m[along_m.partition_point(|along_m| *along_m < least_m)..];
    let thing = ahead.windows(returns.max(1) as usize).find(|face| face[face.len() - 1] - face[0] <= FACE_M);
    thing.map(|face| face[0])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lane_curve::{State, published};
    use crate::odometry::Motion;

    fn own(offset_m: f64, curvature: f64) -> OwnLane {
        OwnLane::seen(&published(&State::from([offset_m, 0.0, curvature, 0.0, 0.4])), Motion::default())
    }

    fn face(ahead_m: f64, left_m: f64) -> Vec<Vector2<f64>> {
        (-4..=4).map(|k| Vector2::new(ahead_m, left_m + f64::from(k) * 0.02)).collect()
    }

    fn road(points: &[Vector2<f64>], own: &OwnLane) -> Road {
        Road::of(points, own, &BodyConfig::default(), &OvertakeConfig::default())
    }

    #[test]
    fn tells_the_lanes_apart() {
        let own = own(0.0, 0.0);
        let seen = road(&[face(1.5, 0.0), face(1.0, 0.4)].concat(), &own);
        assert!((seen.ahead_m.expect("in its lane") - 1.2).abs() < 1e-9, "{seen:?}");
        assert!((seen.left_m.expect("in the left lane") - 0.7).abs() < 1e-9, "{seen:?}");
        assert_eq!(road(&face(1.0, -0.4), &own), Road::default(), "beside the road on the right");
        assert_eq!(road(&face(1.0, 0.9), &own), Road::default(), "beside the road on the left");
        assert_eq!(road(&face(1.0, 0.0)[..2], &own).ahead_m, None, "two returns are noise");
    }

    #[test]
    fn follows_the_curve() {
        // A left curve of 1.5 m: after 1.5 rad of it the lane leads to the left.
        let own = own(0.0, 1.0 / 1.5);
        let at = Vector2::new(1.5, 1.5);
        let points: Vec<_> = (-3..=3).map(|k| at + Vector2::new(0.0, f64::from(k) * 0.02)).collect();
        let ahead_m = road(&points, &own).ahead_m.expect("on the lane");
        let expected_m = 1.5 * std::f64::consts::FRAC_PI_2 - 0.3;
        assert!((ahead_m - expected_m).abs() < 0.1, "{ahead_m} m instead of {expected_m} m");
    }

    #[test]
    fn from_the_left_lane_its_own_is_on_the_right() {
        let own = own(-0.4, 0.0);
        let beside = road(&face(0.1, -0.4), &own);
        assert!(beside.own_m.is_some() && beside.ahead_m.is_none() && beside.left_m.is_none(), "beside it: {beside:?}");
        assert_eq!(road(&face(-0.2, -0.4), &own), Road::default(), "behind it");
        let ahead = road(&face(1.0, 0.0), &own);
        assert!(ahead.left_m.is_some() && ahead.ahead_m.is_none(), "in the lane where it drives: {ahead:?}");
    }
}
