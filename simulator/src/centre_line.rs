//! The middle of a lane: a closed curve, sampled evenly. It has a direction; left and right are seen along it.

use std::f64::consts::{PI, TAU};

use nalgebra::{Point2, Vector2};

/// Distance between samples, m, at most.
const STEP_M: f64 = 0.01;
/// Beyond this distance a local search may be on the wrong stretch, m.
const LOCAL_REACH_M: f64 = 0.6;

/// A closed curve.
#[derive(Clone, Debug, PartialEq)]
pub struct CentreLine {
    points: Vec<Point2<f64>>,
    directions: Vec<Vector2<f64>>,
    step_m: f64,
}

/// A point as seen from the curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnCurve {
    /// Distance along the curve from its start, m, 0 to its length.
    pub along_m: f64,
    /// Distance to the left of the curve, m.
    pub left_m: f64,
    /// The nearest sample; makes the next search short.
    pub index: usize,
}

/// An angle in -pi to pi.
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = (angle_rad + PI).rem_euclid(TAU) - PI;
    if wrapped == -PI { PI } else { wrapped }
}

/// A vector turned left by a quarter.
pub fn left_of(direction: Vector2<f64>) -> Vector2<f64> {
    Vector2::new(-direction.y, direction.x)
}

impl CentreLine {
    /// The closed curve through `points`, which lie densely (a few mm) and do not repeat the first at the end. At least three.
    pub fn through(points: &[Point2<f64>]) -> Self {
        let ends = || (0..points.len()).map(|i| (points[i], points[(i + 1) % points.len()]));
        let length: f64 = ends().map(|(a, b)| (b - a).norm()).sum();
        let count = (length / STEP_M).ceil().max(3.0);
        let step_m = length / count;
        let mut samples = Vec::with_capacity(count as usize);
        let mut before_m = 0.0;
        for (a, b) in ends() {
            let piece_m = (b - a).norm();
            while samples.len() < count as usize && samples.len() as f64 * step_m < before_m + piece_m {
                let share = (samples.len() as f64 * step_m - before_m) / piece_m.max(1e-12);
                samples.push(a + (b - a) * share);
            }
            before_m += piece_m;
        }
        let n = samples.len();
        let direction = |i: usize| (samples[(i + 1) % n] - samples[(i + n - 1) % n]).try_normalize(1e-9);
        let directions = (0..n).map(|i| direction(i).unwrap_or_else(Vector2::x)).collect();
        Self { points: samples, directions, step_m }
    }

    /// Length of one lap, m.
    pub fn length_m(&self) -> f64 {
        self.step_m * self.points.len() as f64
    }

    /// The samples.
    pub fn points(&self) -> &[Point2<f64>] {
        &self.points
    }

    /// Unit vectors along the curve, at each sample.
    pub fn directions(&self) -> &[Vector2<f64>] {
        &self.directions
    }

    /// Distance between samples, m.
    pub fn step_m(&self) -> f64 {
        self.step_m
    }

    /// Index of the sample at or before `along_m`, which may lie outside of one lap.
    pub fn index_at(&self, along_m: f64) -> usize {
        (along_m.rem_euclid(self.length_m()) / self.step_m) as usize % self.points.len()
    }

    /// Point `left_m` to the left of sample `index`.
    pub fn beside(&self, index: usize, left_m: f64) -> Point2<f64> {
        self.points[index] + left_of(self.directions[index]) * left_m
    }

    /// Point `left_m` to the left of the curve at `along_m`, and the direction there, between the samples as well.
    pub fn between_samples(&self, along_m: f64, left_m: f64) -> (Point2<f64>, Vector2<f64>) {
        let (index, next) = (self.index_at(along_m), self.index_at(along_m) + 1);
        let next = next % self.points.len();
        let share = along_m.rem_euclid(self.length_m()) / self.step_m - index as f64;
        let direction = self.directions[index].lerp(&self.directions[next], share);
        let direction = direction.try_normalize(1e-9).unwrap_or(self.directions[index]);
        (self.points[index] + (self.points[next] - self.points[index]) * share + left_of(direction) * left_m, direction)
    }

    /// Where `point` lies; `hint` is the nearest sample of a point nearby, for a short search.
    pub fn locate(&self, point: Point2<f64>, hint: Option<usize>) -> OnCurve {
        let nearby = hint.map(|hint| self.descend(point, hint)).filter(|i| self.distance_m(point, *i) < LOCAL_REACH_M);
        let index = nearby.unwrap_or_else(|| self.nearest_of_all(point));
        let offset = point - self.points[index];
        let along_m = (index as f64 * self.step_m + offset.dot(&self.directions[index])).rem_euclid(self.length_m());
        OnCurve { along_m, left_m: left_of(self.directions[index]).dot(&offset), index }
    }

    fn distance_m(&self, point: Point2<f64>, index: usize) -> f64 {
        (point - self.points[index]).norm()
    }

    fn descend(&self, point: Point2<f64>, hint: usize) -> usize {
        let n = self.points.len();
        let mut index = hint % n;
        let mut best = self.distance_m(point, index);
        for stride in [1, n - 1] {
            loop {
                let next = (index + stride) % n;
                let distance = self.distance_m(point, next);
                if distance.total_cmp(&best).is_ge() {
                    break;
                }
                (index, best) = (next, distance);
            }
        }
        index
    }

    fn nearest_of_all(&self, point: Point2<f64>) -> usize {
        let nearest = (0..self.points.len())
            .step_by(8)
            .min_by(|a, b| self.distance_m(point, *a).total_cmp(&self.distance_m(point, *b)))
            .unwrap_or(0);
        self.descend(point, nearest)
    }

    /// The tightest radius, m, over stretches of about 10 cm.
    pub fn min_radius_m(&self) -> f64 {
        let n = self.points.len();
        let window = ((0.1 / self.step_m) as usize).clamp(1, n / 3);
        let turn = |i: usize| {
            let (a, b) = (self.directions[i], self.directions[(i + window) % n]);
            a.perp(&b).atan2(a.dot(&b)).abs()
        };
        let sharpest = (0..n).map(turn).fold(0.0, f64::max);
        window as f64 * self.step_m / sharpest.max(1e-9)
    }

    /// The smallest distance between two stretches that are at least `apart_m` of road away from each other, m.
    pub fn self_approach_m(&self, apart_m: f64) -> f64 {
        let stride = ((0.05 / self.step_m) as usize).max(1);
        let length_m = self.length_m();
        let mut nearest = f64::INFINITY;
        for i in (0..self.points.len()).step_by(stride) {
            for j in (0..i).step_by(stride) {
                let road_m = (i - j) as f64 * self.step_m;
                if road_m.min(length_m - road_m) >= apart_m {
                    nearest = nearest.min((self.points[i] - self.points[j]).norm());
                }
            }
        }
        nearest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circle(radius_m: f64) -> CentreLine {
        let at = |i| f64::from(i) / 2000.0 * TAU;
        let points: Vec<_> = (0..2000).map(|i| Point2::new(radius_m * at(i).cos(), radius_m * at(i).sin())).collect();
        CentreLine::through(&points)
    }

    #[test]
    fn measures_a_circle() {
        let line = circle(2.0);
        assert!((line.length_m() - 4.0 * PI).abs() < 1e-3, "length {}", line.length_m());
        assert!((line.min_radius_m() - 2.0).abs() < 0.01, "radius {}", line.min_radius_m());
        assert!((line.self_approach_m(2.0 * PI - 0.2) - 4.0).abs() < 0.02, "the far side is 4 m away");
    }

    #[test]
    fn left_is_inside_of_a_counter_clockwise_circle() {
        let line = circle(2.0);
        for hint in [None, Some(0), Some(line.points().len() / 4)] {
            let found = line.locate(Point2::new(0.0, 1.9), hint);
            assert!((found.left_m - 0.1).abs() < 1e-4, "left {} with hint {hint:?}", found.left_m);
            assert!((found.along_m - PI).abs() < 1e-3, "along {} with hint {hint:?}", found.along_m);
        }
    }

    #[test]
    fn angles_wrap() {
        assert!((wrap_angle(3.0 * PI / 2.0) + PI / 2.0).abs() < 1e-12, "270 degrees is -90");
        assert_eq!(wrap_angle(-PI), PI, "one name for half a turn");
    }
}
