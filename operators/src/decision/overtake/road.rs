//! What a scan shows of the road: along the car's own lane, and beside it.

use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

use super::config::OvertakeConfig;
use crate::decision::own_lane::OwnLane;
use crate::lane_curve::{CURVATURE, Curve};
use crate::scan_points::BodyConfig;

/// Farther along the lane nothing is looked for, m.
const REACH_M: f64 = 4.0;
/// Farther round the lane's curve nothing is looked for, rad: at half a circle what is ahead and what is behind meet, and a long thing
/// there reaches across from one to the other.
const ROUND_RAD: f64 = 2.0;
/// Returns that follow each other in the scan and lie within this of each other belong to one thing, m.
const ONE_THING_M: f64 = 0.15;

/// What stands on the road. Distances along the car's own lane, from the front of the car, m.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Road {
    /// To the nearest thing ahead in its own lane.
    pub ahead_m: Option<f64>,
    /// Its middle as far as it is seen, body frame, m.
    pub ahead_at: Option<[f64; 2]>,
    /// To the nearest thing in the left lane that is not behind the car. Below 0: beside it.
    pub left_m: Option<f64>,
    /// To the nearest thing in its own lane that is not behind the car, wherever the car itself is.
    pub own_m: Option<f64>,
    /// From the rear end of the car to what is behind it, m.
    pub behind_m: Option<f64>,
}

/// Returns of one thing.
struct Thing {
    middle: Vector2<f64>,
    returns: u32,
    /// Along the own lane, from the front of the car, m.
    from_m: f64,
    to_m: f64,
    /// To the left of the own lane's middle: its right side, its middle, its left side, m.
    left_m: [f64; 3],
}

impl Thing {
    fn of(points: &[Vector2<f64>], curve: &Curve, body: &BodyConfig) -> Self {
        let middle = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
        let (mut along, mut aside) = ((f64::INFINITY, f64::NEG_INFINITY), (f64::INFINITY, f64::NEG_INFINITY));
        for point in points {
            let seen = curve.locate(*point);
            along = (along.0.min(seen.along_m), along.1.max(seen.along_m));
            aside = (aside.0.min(seen.left_m), aside.1.max(seen.left_m));
        }
        Self {
            middle,
            returns: points.len() as u32,
            from_m: along.0 - body.front_m,
            to_m: along.1 - body.front_m,
            left_m: [aside.0, f64::midpoint(aside.0, aside.1), aside.1],
        }
    }

    /// Whether it is in the way of a car that keeps `half_m` free to both sides of `middle_m`, and not rather in the lane beside.
    fn is_in(&self, middle_m: f64, half_m: f64, width_m: f64) -> bool {
        let [right_m, own_m, left_m] = self.left_m;
        let reaches_in = right_m <= middle_m + half_m && left_m >= middle_m - half_m;
        let is_wide = left_m - right_m > width_m;
        let lies_in = (own_m - middle_m).abs() <= width_m / 2.0;
        // What lies outside of the road and reaches in counts for the lane that it reaches.
        let from_outside = own_m < -width_m / 2.0 || own_m > 1.5 * width_m;
        lies_in || reaches_in && (is_wide || from_outside)
    }
}

impl Road {
    /// Of points in the body frame, in the order of the scan.
    pub(super) fn of(points: &[Vector2<f64>], own: &OwnLane, body: &BodyConfig, config: &OvertakeConfig) -> Self {
        let curve = Curve::new(&own.state());
        let (half_m, width_m) = (body.width_m / 2.0 + config.clearance_m, own.width_m());
        let round_m = ROUND_RAD / own.state()[CURVATURE].abs();
        let near = points.iter().filter(|point| point.norm() <= REACH_M);
        let near: Vec<_> = near.filter(|point| curve.locate(**point).along_m.abs() <= round_m).copied().collect();
        let things = near.chunk_by(|one, next| (next - one).norm() <= ONE_THING_M);
        let things: Vec<_> = things.map(|points| Thing::of(points, &curve, body)).collect();
        let (rear_m, behind_m) = (body.rear_m - body.front_m, config.free_behind_m + body.front_m);
        let nearest = |lane_m: f64, least_m: f64, returns: u32| {
            let there = things.iter().filter(|thing| thing.returns >= returns && thing.to_m >= least_m);
            let there = there.filter(|thing| thing.is_in(lane_m, half_m, width_m));
            there.min_by(|a, b| a.from_m.total_cmp(&b.from_m))
        };
        let behind = near.iter().filter(|point| point.x < body.rear_m && point.y.abs() <= half_m);
        let ahead = nearest(0.0, 0.0, config.min_returns);
        Self {
            ahead_m: ahead.map(|thing| thing.from_m),
            ahead_at: ahead.map(|thing| thing.middle.into()),
            left_m: nearest(width_m, -behind_m, config.min_returns).map(|thing| thing.from_m),
            own_m: nearest(0.0, rear_m - 0.05, config.min_returns.min(2)).map(|thing| thing.from_m),
            behind_m: behind.map(|point| body.rear_m - point.x).min_by(f64::total_cmp),
        }
    }
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
        let odd = road(&face(1.5, 0.12), &own);
        assert!(odd.ahead_m.is_some() && odd.left_m.is_none(), "what stands in its lane is not in the other: {odd:?}");
        let wall: Vec<_> = (-8..=16).map(|k| Vector2::new(1.3, f64::from(k) * 0.05)).collect();
        let wall = road(&wall, &own);
        assert!(wall.ahead_m.is_some() && wall.left_m.is_some(), "a wall across the road is in both: {wall:?}");
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
    fn what_is_on_the_other_side_of_the_curve_is_neither_ahead_nor_behind() {
        // Half round a left curve of 1.6 m: a thing that begins before and ends behind the point opposite.
        let own = own(0.0, 1.0 / 1.6);
        assert_eq!(road(&face(0.0, 3.2), &own), Road::default(), "across the lane");
        let along: Vec<_> = (-6..=6).map(|k| Vector2::new(f64::from(k) * 0.05, 3.2)).collect();
        assert_eq!(road(&along, &own), Road::default(), "along the lane");
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
