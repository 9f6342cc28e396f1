//! Poses, arcs and the outline of the car, in a plane: x forward, y to the left, yaw counter-clockwise. The point of reference is the
//! middle of the rear axle.

use serde::{Deserialize, Serialize};

/// Below this curvature an arc is a straight line, 1/m.
const STRAIGHT_PER_M: f64 = 1e-6;

/// Where the car is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// m.
    pub x_m: f64,
    /// m.
    pub y_m: f64,
    /// rad, not wrapped.
    pub yaw_rad: f64,
}

impl Place {
    /// At `x_m`, `y_m`, turned by `yaw_rad`.
    pub const fn new(x_m: f64, y_m: f64, yaw_rad: f64) -> Self {
        Self { x_m, y_m, yaw_rad }
    }

    /// After `way_m` (backwards below 0) along a curve, 1/m, + to the left.
    pub fn after(self, way_m: f64, curvature_per_m: f64) -> Self {
        let turn = way_m * curvature_per_m;
        let (sin, cos) = self.yaw_rad.sin_cos();
        let (ahead, left) = if curvature_per_m.abs() < STRAIGHT_PER_M {
            (way_m, 0.0)
        } else {
            (turn.sin() / curvature_per_m, (1.0 - turn.cos()) / curvature_per_m)
        };
        Self {
            x_m: self.x_m + ahead * cos - left * sin,
            y_m: self.y_m + ahead * sin + left * cos,
            yaw_rad: self.yaw_rad + turn,
        }
    }

    /// A point that is seen from here, as this frame has it.
    pub fn point(self, [ahead_m, left_m]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.yaw_rad.sin_cos();
        [self.x_m + ahead_m * cos - left_m * sin, self.y_m + ahead_m * sin + left_m * cos]
    }

    /// A point of this frame, as it is seen from here.
    pub fn seen(self, [x_m, y_m]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let (x, y) = (x_m - self.x_m, y_m - self.y_m);
        [x * cos + y * sin, y * cos - x * sin]
    }

    /// A place that is seen from here, as this frame has it.
    pub fn place(self, seen: Self) -> Self {
        let [x_m, y_m] = self.point([seen.x_m, seen.y_m]);
        Self { x_m, y_m, yaw_rad: self.yaw_rad + seen.yaw_rad }
    }

    /// A place of this frame, as it is seen from here.
    pub fn place_seen(self, place: Self) -> Self {
        let [x_m, y_m] = self.seen([place.x_m, place.y_m]);
        Self { x_m, y_m, yaw_rad: place.yaw_rad - self.yaw_rad }
    }

    /// Whether all numbers are some.
    pub fn is_finite(&self) -> bool {
        self.x_m.is_finite() && self.y_m.is_finite() && self.yaw_rad.is_finite()
    }
}

/// The outline of the car and how tightly it turns.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::struct_field_names, reason = "the unit belongs to each name")]
pub struct Car {
    /// From axle to axle, m.
    pub wheelbase_m: f64,
    /// Front end, ahead of the rear axle, m.
    pub front_m: f64,
    /// Rear end, behind the rear axle, m.
    pub rear_m: f64,
    /// m.
    pub width_m: f64,
    /// Tightest curvature that plans use, 1/m: a bit less than that of the servo's stops, so that there is something left to correct with.
    pub plan_curvature_per_m: f64,
    /// Tightest curvature, 1/m.
    pub curvature_per_m: f64,
}

impl Car {
    /// Corners of the body at a place: front right, front left, rear left, rear right.
    pub fn corners(&self, at: Place) -> [[f64; 2]; 4] {
        let half = self.width_m / 2.0;
        [[self.front_m, -half], [self.front_m, half], [-self.rear_m, half], [-self.rear_m, -half]]
            .map(|corner| at.point(corner))
    }

    /// Whether a point as seen from the car is within its outline, enlarged by `reach_m`.
    pub fn covers(&self, [ahead_m, left_m]: [f64; 2], reach_m: f64) -> bool {
        ahead_m > -self.rear_m - reach_m
            && ahead_m < self.front_m + reach_m
            && left_m.abs() < self.width_m / 2.0 + reach_m
    }

    /// Where the middle of its length lies ahead of the rear axle, m.
    pub fn middle_m(&self) -> f64 {
        f64::midpoint(self.front_m, -self.rear_m)
    }
}

/// A gap in a row, in the row's frame: x along the lane, y to the left, the row on the right of the car. What stands behind and before
/// the gap is everything below its flank: `y < flank`, `x < from` or `x > to`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[expect(clippy::struct_field_names, reason = "the unit belongs to each name")]
pub struct Gap {
    /// Its rear end, m: the front of what stands behind it.
    pub from_m: f64,
    /// Its front end, m: the rear of what stands before it.
    pub to_m: f64,
    /// Flank of what stands behind it, m.
    pub rear_flank_m: f64,
    /// Flank of what stands before it, m.
    pub front_flank_m: f64,
}

impl Gap {
    /// m.
    pub fn length_m(&self) -> f64 {
        self.to_m - self.from_m
    }

    /// m.
    pub fn middle_m(&self) -> f64 {
        f64::midpoint(self.from_m, self.to_m)
    }

    /// Mean of both flanks, m.
    pub fn flank_m(&self) -> f64 {
        f64::midpoint(self.rear_flank_m, self.front_flank_m)
    }

    /// Whether the car at a place keeps `margin_m` from both neighbours.
    pub fn clears(&self, car: &Car, at: Place, margin_m: f64) -> bool {
        let rear = [self.from_m + margin_m, self.rear_flank_m + margin_m];
        let front = [self.to_m - margin_m, self.front_flank_m + margin_m];
        let corners = car.corners(at);
        let hits = |[x, y]: [f64; 2]| (x < rear[0] && y < rear[1]) || (x > front[0] && y < front[1]);
        !corners.into_iter().any(hits) && !car.covers(at.seen(rear), 0.0) && !car.covers(at.seen(front), 0.0)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// The 1:10 car.
    pub(crate) fn car() -> Car {
        let curvature = |degrees: f64| degrees.to_radians().tan() / 0.26;
        Car {
            wheelbase_m: 0.26,
            front_m: 0.30,
            rear_m: 0.05,
            width_m: 0.19,
            plan_curvature_per_m: curvature(19.0),
            curvature_per_m: curvature(20.0),
        }
    }

    #[test]
    fn an_arc_ends_on_its_circle_and_leads_back() {
        let quarter = Place::default().after(std::f64::consts::FRAC_PI_2, 1.0);
        assert!(
            (quarter.x_m - 1.0).abs() < 1e-12 && (quarter.y_m - 1.0).abs() < 1e-12,
            "a quarter to the left: {quarter:?}"
        );
        let back = quarter.after(-std::f64::consts::FRAC_PI_2, 1.0);
        assert!(back.x_m.abs() + back.y_m.abs() + back.yaw_rad.abs() < 1e-12, "and back: {back:?}");
        let there = Place::new(1.0, 2.0, 0.7);
        let place = Place::new(-0.4, 0.3, -0.2);
        let again = there.place_seen(there.place(place));
        assert!((again.x_m - place.x_m).abs() + (again.y_m - place.y_m).abs() < 1e-12, "seen as it was: {again:?}");
    }

    #[test]
    fn the_neighbours_begin_at_their_faces_and_flanks() {
        let gap = Gap { from_m: 0.0, to_m: 0.5, rear_flank_m: 0.0, front_flank_m: 0.02 };
        let car = car();
        assert!(gap.clears(&car, Place::new(0.06, -0.095, 0.0), 0.005), "1 cm before the one behind");
        assert!(!gap.clears(&car, Place::new(0.06, -0.095, 0.0), 0.015), "but not 1.5 cm");
        assert!(!gap.clears(&car, Place::new(0.19, -0.095, 0.0), 0.015), "1 cm behind the one before");
        assert!(gap.clears(&car, Place::new(0.0, 0.12, 0.0), 0.0), "beside the one behind");
        assert!(!gap.clears(&car, Place::new(0.4, 0.11, 0.0), 0.0), "the one before stands out farther");
        assert!(
            !gap.clears(&car, Place::new(0.4, 0.08, 0.3), 0.0),
            "a corner of the one before reaches into the right flank"
        );
    }
}
