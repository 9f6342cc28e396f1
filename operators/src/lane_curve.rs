//! The middle of the lane as a curve on the floor: its distance from a point, how that changes with the curve, and the same curve as
//! seen from where the car has gone meanwhile.
//!
//! A line beside the lane's middle is parallel to it at every point, so that one number, the signed distance of a marking from the
//! curve, says to which line it belongs and how well the curve fits it. For a circle that distance is exact; an evenly changing
//! curvature adds `rate * s^3 / 6` (a clothoid's series, its first term).

use carril_messages::GroundLane;
use nalgebra::{SMatrix, SVector, Vector2};

use crate::odometry::Motion;

/// Offset, heading, curvature, its rate, width of the lane: the fields of [`GroundLane`], in its order.
pub(crate) type State = SVector<f64, 5>;
/// How uncertain they are.
pub(crate) type Covariance = SMatrix<f64, 5, 5>;

pub(crate) const OFFSET: usize = 0;
pub(crate) const HEADING: usize = 1;
pub(crate) const CURVATURE: usize = 2;
pub(crate) const RATE: usize = 3;
pub(crate) const WIDTH: usize = 4;

/// Below this curvature a circle is a straight line, 1/m.
const STRAIGHT: f64 = 1e-6;

/// A point of the floor as seen from the curve.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// To the left of the curve, m.
    pub left_m: f64,
    /// How `left_m` changes with the state.
    pub gradient: State,
    /// Way along the curve to the point's foot, m.
    pub along_m: f64,
}

/// The curve with what many points share.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Curve {
    state: State,
    sin: f64,
    cos: f64,
}

impl Curve {
    pub fn new(state: &State) -> Self {
        let (sin, cos) = state[HEADING].sin_cos();
        Self { state: *state, sin, cos }
    }

    /// Where a point lies beside the curve.
    pub fn locate(&self, point: Vector2<f64>) -> Seen {
        let [offset, curvature, rate] = [OFFSET, CURVATURE, RATE].map(|index| self.state[index]);
        let u = point.x * self.cos + point.y * self.sin;
        let v = point.y * self.cos - point.x * self.sin - offset;
        // The circle's centre lies at (0, 1 / curvature) in (u, v).
        let (across, towards) = (curvature * u, 1.0 - curvature * v);
        let radius = across.hypot(towards);
        let left_m = (2.0 * v - curvature * (u * u + v * v)) / (1.0 + radius);
        let (sin, cos) = (across / radius.max(1e-9), towards / radius.max(1e-9));
        let (along_m, forward, sideways) = if curvature.abs() < STRAIGHT {
            (u, u, u * u / 2.0)
        } else {
            (sin.atan2(cos) / curvature, sin / curvature, (1.0 - cos) / (curvature * curvature))
        };
        let cube = along_m * along_m * along_m / 6.0;
        let gradient = State::from([-cos, -(forward + offset * sin), -sideways, -cube, 0.0]);
        Seen { left_m: left_m - rate * cube, gradient, along_m }
    }

    /// The signed distance alone. Quick where the curve is a circle: the search asks thousands of times.
    pub fn left_of(&self, point: Vector2<f64>) -> f64 {
        if self.state[RATE] != 0.0 {
            return self.locate(point).left_m;
        }
        let curvature = self.state[CURVATURE];
        let u = point.x * self.cos + point.y * self.sin;
        let v = point.y * self.cos - point.x * self.sin - self.state[OFFSET];
        let (across, towards) = (curvature * u, 1.0 - curvature * v);
        (2.0 * v - curvature * (u * u + v * v)) / (1.0 + (across * across + towards * towards).sqrt())
    }
}

/// The curve and its uncertainty as seen after the motion.
pub(crate) fn moved(state: &State, covariance: &Covariance, motion: Motion) -> (State, Covariance) {
    let here = Curve::new(state).locate(motion.end());
    let along = here.along_m;
    let turn = along * (state[CURVATURE] + along * state[RATE] / 2.0);
    let moved = State::from([
        -here.left_m,
        state[HEADING] + turn - motion.turn_rad,
        state[CURVATURE] + along * state[RATE],
        state[RATE],
        state[WIDTH],
    ]);
    let mut change = Covariance::identity();
    change.set_row(OFFSET, &(-here.gradient.transpose()));
    change[(HEADING, CURVATURE)] = along;
    change[(HEADING, RATE)] = along * along / 2.0;
    change[(CURVATURE, RATE)] = along;
    (moved, change * covariance * change.transpose())
}

/// The parallel of the curve that lies `left_m` to its left.
pub(crate) fn beside(state: &State, left_m: f64) -> State {
    let bent = 1.0 - state[CURVATURE] * left_m;
    let bent = if bent.abs() < 0.1 { 0.1_f64.copysign(bent) } else { bent };
    let mut beside = *state;
    beside[OFFSET] += left_m;
    beside[CURVATURE] /= bent;
    // Along the parallel the way is longer or shorter by `bent`, and the curvature is divided by it twice.
    beside[RATE] /= bent * bent * bent;
    beside
}

/// As it was published.
pub(crate) fn state_of(lane: &GroundLane) -> State {
    let numbers = [lane.offset_m, lane.heading_rad, lane.curvature_per_m, lane.curvature_rate_per_m2, lane.width_m];
    State::from(numbers.map(f64::from))
}

/// As it is published.
pub(crate) fn published(state: &State) -> GroundLane {
    GroundLane {
        offset_m: state[OFFSET] as f32,
        heading_rad: state[HEADING] as f32,
        curvature_per_m: state[CURVATURE] as f32,
        curvature_rate_per_m2: state[RATE] as f32,
        width_m: state[WIDTH] as f32,
        seen_m: 0.0,
        left_seen: false,
        right_seen: false,
        bridged_m: 0.0,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn any_state() -> impl Strategy<Value = State> {
        let rate = prop_oneof![Just(0.0), -0.3..0.3];
        let curvature = prop_oneof![Just(0.0), -1.2..1.2];
        (-0.3..0.3, -0.5..0.5, curvature, rate).prop_map(|(a, h, k, r)| State::from([a, h, k, r, 0.4]))
    }

    #[test]
    fn distances_from_a_circle_are_exact() {
        // Around (0, 1) with radius 1.
        let curve = Curve::new(&State::from([0.0, 0.0, 1.0, 0.0, 0.4]));
        for (x, y) in [(0.5, 0.2), (0.9, 1.0), (0.3, -0.3), (1.2, 0.4)] {
            let expected = 1.0 - f64::hypot(x, y - 1.0);
            assert!((curve.left_of(Vector2::new(x, y)) - expected).abs() < 1e-12, "({x}, {y})");
        }
    }

    proptest! {
        #[test]
        fn points_of_the_published_curve_lie_on_it(state in any_state(), s in 0.0..1.0_f64) {
            let [x, y] = published(&state).point_at(s);
            let seen = Curve::new(&state).locate(Vector2::new(x, y));
            prop_assert!(seen.left_m.abs() < 0.02, "{} m beside it", seen.left_m);
            prop_assert!((seen.along_m - s).abs() < 0.04, "at {} instead of {s}", seen.along_m);
        }

        #[test]
        fn gradients_are_differences(state in any_state(), x in 0.1..1.2_f64, y in -0.4..0.4_f64) {
            let point = Vector2::new(x, y);
            let seen = Curve::new(&state).locate(point);
            // Farther from the lane's middle no line is looked for.
            prop_assume!(seen.left_m.abs() < 0.6);
            let gradient = seen.gradient;
            // With a rate the gradients leave out what is small.
            let tolerance = 0.01 + 1.6 * state[RATE].abs();
            for index in 0..4 {
                let mut step = State::zeros();
                step[index] = 1e-5;
                let difference = (Curve::new(&(state + step)).left_of(point) - Curve::new(&(state - step)).left_of(point)) / 2e-5;
                prop_assert!((difference - gradient[index]).abs() < tolerance, "{index}: {difference} and {}", gradient[index]);
            }
        }

        #[test]
        fn a_curve_stays_where_it_is_while_the_car_moves(
            state in any_state(), way in 0.0..0.2_f64, turn in -0.2..0.2_f64, s in 0.3..0.8_f64,
        ) {
            let motion = Motion { way_m: way, turn_rad: turn };
            let (after, _) = moved(&state, &Covariance::identity(), motion);
            let [x, y] = published(&state).point_at(s);
            let point = nalgebra::Rotation2::new(-turn) * (Vector2::new(x, y) - motion.end());
            let left_m = Curve::new(&after).left_of(point);
            prop_assert!(left_m.abs() < 0.02, "a point of the lane's middle is {left_m} m beside it");
        }
    }
}
