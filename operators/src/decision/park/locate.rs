//! Where the car is beside the gap, and where the gap's ends are: odometry carries it on, each point of a scan that lies on a flank
//! or a face of a neighbour corrects it (an extended Kalman filter over the pose, both faces and both flanks).
//!
//! The row's frame is held by the flanks: they lie along x. Faces stand across.

use serde::{Deserialize, Serialize};

use super::geometry::{Gap, Place};

const X: usize = 0;
const Y: usize = 1;
const YAW: usize = 2;
const REAR_FACE: usize = 3;
const FRONT_FACE: usize = 4;
const REAR_FLANK: usize = 5;
const FRONT_FLANK: usize = 6;
const N: usize = 7;

/// Noise of a point: of the lidar, and of neighbours that are no boxes, m.
const POINT_M: f64 = 0.015;
/// A point this far from a surface is of something else, m.
const GATE_M: f64 = 0.05;
/// Points this near to a corner may be of either of its surfaces, m.
const CORNER_M: f64 = 0.02;
/// So long a piece of a flank counts, m: what stands farther away stands as it likes.
const FLANK_M: f64 = 0.40;
/// So deep a piece of a face counts, m.
const FACE_M: f64 = 0.19;
/// How the error of odometry grows with the way, along, across (m²/m) and in heading (rad²/m): wheels that slip by some percent and
/// stand askew by a degree or two.
const GROWS: [f64; 3] = [6e-4, 1e-4, 4e-3];

/// What is known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Locator {
    state: [f64; N],
    covariance: [[f64; N]; N],
}

impl Locator {
    /// A car at a place in the row's frame, whose origin is the rear end of a gap of this length.
    pub fn new(at: Place, length_m: f64) -> Self {
        let state = [at.x_m, at.y_m, at.yaw_rad, 0.0, length_m, 0.0, 0.0];
        let spread = [0.03, 0.02, 0.04, 0.02, 0.05, 0.02, 0.02];
        let mut covariance = [[0.0; N]; N];
        (0..N).for_each(|i| covariance[i][i] = spread[i] * spread[i]);
        Self { state, covariance }
    }

    /// Where the car is, row frame.
    pub fn place(&self) -> Place {
        Place::new(self.state[X], self.state[Y], self.state[YAW])
    }

    /// The gap.
    pub fn gap(&self) -> Gap {
        Gap {
            from_m: self.state[REAR_FACE],
            to_m: self.state[FRONT_FACE],
            rear_flank_m: self.state[REAR_FLANK],
            front_flank_m: self.state[FRONT_FLANK],
        }
    }

    /// Whether all numbers are some.
    pub fn is_finite(&self) -> bool {
        self.state.iter().chain(self.covariance.iter().flatten()).all(|number| number.is_finite())
    }

    /// The car has moved to a place that is seen from where it was.
    pub fn moved(&mut self, moved: Place) {
        let before = self.place();
        let after = before.place(moved);
        (self.state[X], self.state[Y], self.state[YAW]) = (after.x_m, after.y_m, after.yaw_rad);
        // x and y depend on the heading before.
        let (dx, dy) = (before.y_m - after.y_m, after.x_m - before.x_m);
        for (row, by) in [(X, dx), (Y, dy)] {
            for column in 0..N {
                self.covariance[row][column] += by * self.covariance[YAW][column];
            }
        }
        for (column, by) in [(X, dx), (Y, dy)] {
            for row in 0..N {
                self.covariance[row][column] += by * self.covariance[row][YAW];
            }
        }
        let way_m = moved.x_m.hypot(moved.y_m);
        for (index, grows) in [X, Y, YAW].into_iter().zip(GROWS) {
            self.covariance[index][index] += grows * way_m;
        }
    }

    /// Points as seen from where the car is now correct it; gives how many did.
    pub fn look<'a>(&mut self, points: impl IntoIterator<Item = &'a [f64; 2]>) -> usize {
        points.into_iter().filter(|point| self.take(**point)).count()
    }

    fn take(&mut self, seen: [f64; 2]) -> bool {
        let place = self.place();
        let point = place.point(seen);
        let Some((surface, axis)) = self.surface(point) else { return false };
        let (sin, cos) = place.yaw_rad.sin_cos();
        let by_yaw = if axis == X { -sin * seen[0] - cos * seen[1] } else { cos * seen[0] - sin * seen[1] };
        // The point lies this far beyond the surface: what is measured is 0.
        let off_m = point[axis] - self.state[surface];
        let mut gain = [0.0; N];
        for (row, gain) in gain.iter_mut().enumerate() {
            let known = &self.covariance[row];
            *gain = known[axis] + by_yaw * known[YAW] - known[surface];
        }
        let spread = gain[axis] + by_yaw * gain[YAW] - gain[surface] + POINT_M * POINT_M;
        if off_m * off_m > 9.0 * spread {
            return false;
        }
        for row in 0..N {
            self.state[row] -= gain[row] / spread * off_m;
            for column in 0..N {
                self.covariance[row][column] -= gain[row] * gain[column] / spread;
            }
        }
        true
    }

    /// The surface of which a point is, and the axis across it.
    fn surface(&self, [x, y]: [f64; 2]) -> Option<(usize, usize)> {
        let gap = self.gap();
        let near = |value: f64, surface: f64| (value - surface).abs() < GATE_M;
        let in_face = |flank_m: f64| y < flank_m - CORNER_M && y > flank_m - FACE_M;
        if x < gap.from_m - CORNER_M && x > gap.from_m - FLANK_M && near(y, gap.rear_flank_m) {
            // Deep enough and near the face it may be of the face.
            let of_face = near(x, gap.from_m) && in_face(gap.rear_flank_m);
            return (!of_face).then_some((REAR_FLANK, Y));
        }
        if x > gap.to_m + CORNER_M && x < gap.to_m + FLANK_M && near(y, gap.front_flank_m) {
            let of_face = near(x, gap.to_m) && in_face(gap.front_flank_m);
            return (!of_face).then_some((FRONT_FLANK, Y));
        }
        if near(x, gap.from_m) && in_face(gap.rear_flank_m) {
            return Some((REAR_FACE, X));
        }
        (near(x, gap.to_m) && in_face(gap.front_flank_m)).then_some((FRONT_FACE, X))
    }
}

#[cfg(test)]
mod tests {
    use super::super::world::{Noise, World};
    use super::*;

    #[test]
    fn finds_the_car_and_the_gap_although_the_wheels_slip() {
        let mut noise = Noise::new(5);
        for (slip, askew_per_m) in [(0.0, 0.0), (0.08, 0.1), (0.05, -0.1)] {
            let world = World::row(&[(-0.4, 0.4), (0.5, 0.4)]);
            let mut truth = Place::new(-0.4, 0.25, 0.02);
            // It believes what the first look says, which is some centimetres wrong.
            let mut locator = Locator::new(Place::new(-0.42, 0.26, 0.0), 0.53);
            for (way_m, curvature, steps) in [(0.0125, 0.0, 100), (-0.0125, -1.3, 40), (-0.0125, 1.3, 30)] {
                for _ in 0..steps {
                    truth = truth.after(way_m * (1.0 - slip), curvature + askew_per_m);
                    locator.moved(Place::default().after(way_m, curvature));
                    locator.look(&world.scan(truth, &mut noise));
                }
            }
            let (place, gap) = (locator.place(), locator.gap());
            let text = format!("{place:?} in {gap:?}, really {truth:?}, with a slip of {slip}");
            assert!((gap.length_m() - 0.5).abs() < 0.008, "{text}");
            assert!(((place.x_m - gap.from_m) - truth.x_m).abs() < 0.01, "{text}");
            assert!(((place.y_m - gap.flank_m()) - truth.y_m).abs() < 0.01, "{text}");
            assert!((place.yaw_rad - truth.yaw_rad).abs() < 1_f64.to_radians(), "{text}");
        }
    }

    #[test]
    fn what_is_neither_flank_nor_face_changes_nothing() {
        let mut locator = Locator::new(Place::new(0.1, 0.3, 0.0), 0.5);
        let before = locator.clone();
        let elsewhere = [[1.5, 0.0], [0.15, -0.35], [0.0, 0.4], [f64::NAN, 0.0]];
        assert_eq!((locator.look(&elsewhere), locator), (0, before), "the lane, the middle of the gap, the other side");
    }
}
