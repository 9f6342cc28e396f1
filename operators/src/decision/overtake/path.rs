//! The way beside the car's own lane: out of it, along it, back into it. And what driving that way would come near to.

use carril_messages::GroundLane;
use nalgebra::{Rotation2, Vector2};
use serde::{Deserialize, Serialize};

use crate::decision::DecisionConfig;
use crate::decision::pursuit::{self, Going, Path};
use crate::scan_points::BodyConfig;

/// A way is looked at in steps of this, m.
const STEP_M: f64 = 0.04;
/// The wheels follow what they are told by this share in each step, at the speeds of a 1:10 car.
const SERVO_SHARE: f64 = 0.6;

/// How far beside the lane's middle the car drives, to the left, and how that changes with the way: evenly bent, without a jump of the
/// heading.
#[allow(clippy::struct_field_names)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Ramp {
    /// At its beginning, m.
    pub from_m: f64,
    /// At its end and after it, m.
    pub to_m: f64,
    /// m.
    pub length_m: f64,
    /// Way of the car since its beginning, m.
    pub driven_m: f64,
}

impl Ramp {
    /// m to the left, `ahead_m` from where the car is.
    pub fn at(&self, ahead_m: f64) -> f64 {
        let share = if self.length_m > 0.0 { (self.driven_m + ahead_m) / self.length_m } else { 1.0 };
        let share = share.clamp(0.0, 1.0);
        self.from_m + (self.to_m - self.from_m) * (1.0 - (std::f64::consts::PI * share).cos()) / 2.0
    }

    /// Whether the car has driven it.
    pub fn is_done(&self) -> bool {
        self.driven_m >= self.length_m
    }

    pub fn is_finite(&self) -> bool {
        [self.from_m, self.to_m, self.length_m, self.driven_m].iter().all(|number| number.is_finite())
    }
}

/// A ramp beside a lane.
#[derive(Clone, Copy, Debug)]
pub struct Beside<'a> {
    /// Body frame.
    pub lane: &'a GroundLane,
    /// Beside it.
    pub ramp: Ramp,
}

impl Beside<'_> {
    fn point_at(&self, along_m: f64) -> Vector2<f64> {
        let left = Rotation2::new(self.lane.direction_at(along_m)) * Vector2::y();
        Vector2::from(self.lane.point_at(along_m)) + left * self.ramp.at(along_m)
    }
}

impl Path for Beside<'_> {
    fn point_away_from(&self, from: [f64; 2], distance_m: f64) -> [f64; 2] {
        let from = Vector2::from(from);
        // The way along the lane to the point beside `from`: some steps lead there.
        let mut beside_m = from.x.max(0.0);
        for _ in 0..3 {
            let off = from - Vector2::from(self.lane.point_at(beside_m));
            let (sin, cos) = self.lane.direction_at(beside_m).sin_cos();
            beside_m += off.x * cos + off.y * sin;
        }
        let away_m = |along_m: f64| (self.point_at(along_m) - from).norm();
        // Never nearer than the distance: then it is the point beside, or the one at the end.
        let (mut low, mut high) = (beside_m, beside_m + 1.5 * distance_m);
        if away_m(low) >= distance_m {
            return self.point_at(low).into();
        }
        if away_m(high) < distance_m {
            return self.point_at(high).into();
        }
        for _ in 0..8 {
            let middle = f64::midpoint(low, high);
            if away_m(middle) < distance_m {
                low = middle;
            } else {
                high = middle;
            }
        }
        self.point_at(high).into()
    }
}

/// How near a car that follows `path` for `way_m` would come to the nearest of `points`, m, and after which way. Below 0: it would
/// drive over it. Points and path in the body frame of now.
pub fn clearance_along(
    path: &Beside<'_>,
    (way_m, going): (f64, Going),
    points: &[Vector2<f64>],
    body: &BodyConfig,
    config: &DecisionConfig,
) -> (f64, f64) {
    let reach_m = way_m + body.front_m + 0.5;
    let near: Vec<_> = points.iter().filter(|point| point.norm() <= reach_m).collect();
    let (mut at, mut turned_rad, mut steering_rad) = (Vector2::zeros(), 0.0_f64, going.steering_rad);
    let mut nearest = (f64::INFINITY, way_m);
    let mut driven_m = 0.0;
    while driven_m <= way_m && !near.is_empty() {
        let to_body = Rotation2::new(-turned_rad);
        let gap_m = near.iter().map(|point| outside_m(to_body * (**point - at), body)).fold(f64::INFINITY, f64::min);
        if gap_m < nearest.0 {
            nearest = (gap_m, driven_m);
        }
        let told_rad = pursuit::steering_from(path, at, turned_rad, going.speed_m_s, config);
        steering_rad += (told_rad - steering_rad) * SERVO_SHARE;
        let turn_rad = STEP_M * steering_rad.tan() / config.wheelbase_m;
        at += Rotation2::new(turned_rad + turn_rad / 2.0) * Vector2::new(STEP_M, 0.0);
        turned_rad += turn_rad;
        driven_m += STEP_M;
    }
    nearest
}

/// Distance of a point of the body frame from the outline, m. Below 0 inside.
fn outside_m(point: Vector2<f64>, body: &BodyConfig) -> f64 {
    let ahead_m = (point.x - body.front_m).max(body.rear_m - point.x);
    let aside_m = point.y.abs() - body.width_m / 2.0;
    if ahead_m > 0.0 && aside_m > 0.0 { ahead_m.hypot(aside_m) } else { ahead_m.max(aside_m) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lane_curve::{State, published};

    fn lane(curvature: f64) -> GroundLane {
        published(&State::from([0.0, 0.0, curvature, 0.0, 0.4]))
    }

    const GOING: Going = Going { speed_m_s: 0.5, steering_rad: 0.0, age_s: 0.0 };

    fn out() -> Ramp {
        Ramp { from_m: 0.0, to_m: 0.4, length_m: 1.2, driven_m: 0.0 }
    }

    #[test]
    fn a_ramp_begins_and_ends_evenly() {
        let ramp = out();
        assert_eq!(
            (ramp.at(-0.5), ramp.at(0.0), ramp.at(1.2), ramp.at(9.0)),
            (0.0, 0.0, 0.4, 0.4),
            "from here to there"
        );
        assert!((ramp.at(0.6) - 0.2).abs() < 1e-12, "half way");
        assert!(ramp.at(0.05) < 0.002, "begins along the lane");
        assert_eq!(Ramp { length_m: 0.0, ..ramp }.at(0.0), 0.4, "without length it is at its end");
    }

    #[test]
    fn a_car_on_its_way_out_passes_what_is_far_enough_ahead() {
        let (lane, body, config) = (lane(0.0), BodyConfig::default(), DecisionConfig::default());
        let path = Beside { lane: &lane, ramp: out() };
        let clearance_m = |ahead_m: f64| {
            let rear = [-0.1, -0.05, 0.0, 0.05, 0.1].map(|left_m| Vector2::new(ahead_m, left_m));
            clearance_along(&path, (2.0, GOING), &rear, &body, &config)
        };
        assert!(clearance_m(0.3 + 1.1).0 > 0.06, "1.1 m ahead of its front: {:?}", clearance_m(1.4));
        let (near_m, after_m) = clearance_m(0.3 + 0.3);
        assert!(near_m < 0.0 && (0.2..0.6).contains(&after_m), "0.3 m ahead it is hit: {near_m} m after {after_m} m");
        assert_eq!(clearance_along(&path, (2.0, GOING), &[], &body, &config).0, f64::INFINITY, "nothing is there");
    }

    #[test]
    fn distances_are_those_from_the_outline() {
        let body = BodyConfig { front_m: 0.3, rear_m: -0.1, width_m: 0.2, ..BodyConfig::default() };
        for (x, y, expected) in
            [(0.5, 0.0, 0.2), (0.0, -0.3, 0.2), (0.6, 0.5, 0.5), (0.0, 0.05, -0.05), (-0.2, 0.0, 0.1)]
        {
            let got = outside_m(Vector2::new(x, y), &body);
            assert!((got - expected).abs() < 1e-12, "({x}, {y}): {got} instead of {expected}");
        }
    }
}
