//! From pieces or points in a track file to a closed centre line.

use nalgebra::{Point2, Vector2};

use crate::centre_line::wrap_angle;

/// Distance between the points that pieces and curves are made of, m.
const DENSE_M: f64 = 0.004;
/// A chain of pieces may miss its start by this much, m; people round angles and lengths.
pub const MAX_GAP_M: f64 = 0.02;
/// And by this much in direction, rad.
pub const MAX_TURN_RAD: f64 = 0.02;

/// A straight (`curvature` 0) or an arc, + to the left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    /// m.
    pub length_m: f64,
    /// 1/m.
    pub curvature: f64,
}

/// Where a chain of pieces ends, when it does not close.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// From the end to the start, m, in the direction of the start.
    pub ahead_m: f64,
    /// From the end to the start, m, to the left of that.
    pub left_m: f64,
    /// Turn that is missing at the end, rad, + left.
    pub turn_rad: f64,
}

/// The points of a chain of pieces that begins at the origin along x. Small errors of closing are spread over the whole chain.
pub fn chain(pieces: &[Piece]) -> Result<Vec<Point2<f64>>, Gap> {
    let (mut points, mut at, mut yaw) = (Vec::new(), Point2::origin(), 0.0_f64);
    for piece in pieces {
        let count = (piece.length_m / DENSE_M).ceil().max(1.0);
        let (step_m, turn) = (piece.length_m / count, piece.length_m * piece.curvature / count);
        // The chord of an arc is shorter than the arc, and points half the turn ahead.
        let chord_m = if turn.abs() > 1e-12 { step_m * (turn / 2.0).sin() / (turn / 2.0) } else { step_m };
        for _ in 0..count as usize {
            points.push(at);
            at += Vector2::new((yaw + turn / 2.0).cos(), (yaw + turn / 2.0).sin()) * chord_m;
            yaw += turn;
        }
    }
    let gap = Gap { ahead_m: -at.x, left_m: -at.y, turn_rad: wrap_angle(-yaw) };
    if at.coords.norm() > MAX_GAP_M || gap.turn_rad.abs() > MAX_TURN_RAD {
        return Err(gap);
    }
    let count = points.len() as f64;
    Ok(points.iter().enumerate().map(|(i, point)| point - at.coords * (i as f64 / count)).collect())
}

/// A smooth closed curve through points: centripetal Catmull-Rom (Barry and Goldman 1988), which never loops between points.
/// Neighbours must differ.
pub fn smooth(points: &[Point2<f64>]) -> Vec<Point2<f64>> {
    let n = points.len();
    let mut dense = Vec::new();
    for i in 0..n {
        let [p0, p1, p2, p3] = [points[(i + n - 1) % n], points[i], points[(i + 1) % n], points[(i + 2) % n]];
        let knot = |from: f64, a: Point2<f64>, b: Point2<f64>| from + (b - a).norm().sqrt();
        let t1 = knot(0.0, p0, p1);
        let t2 = knot(t1, p1, p2);
        let t3 = knot(t2, p2, p3);
        let mix = |a: Point2<f64>, b: Point2<f64>, ta: f64, tb: f64, t: f64| a + (b - a) * ((t - ta) / (tb - ta));
        let count = ((p2 - p1).norm() / DENSE_M).ceil().max(1.0) as usize;
        for k in 0..count {
            let t = t1 + (t2 - t1) * k as f64 / count as f64;
            let (a1, a2, a3) = (mix(p0, p1, 0.0, t1, t), mix(p1, p2, t1, t2, t), mix(p2, p3, t2, t3, t));
            dense.push(mix(mix(a1, a2, 0.0, t2, t), mix(a2, a3, t1, t3, t), t1, t2, t));
        }
    }
    dense
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::centre_line::CentreLine;

    #[test]
    fn an_oval_closes() {
        let arc = Piece { length_m: PI, curvature: 1.0 };
        let straight = Piece { length_m: 2.0, curvature: 0.0 };
        let points = chain(&[straight, arc, straight, arc]).expect("an oval closes");
        let line = CentreLine::through(&points);
        assert!((line.length_m() - (4.0 + 2.0 * PI)).abs() < 1e-3, "length {}", line.length_m());
        assert!((line.min_radius_m() - 1.0).abs() < 0.02, "radius {}", line.min_radius_m());
    }

    #[test]
    fn an_open_chain_says_what_is_missing() {
        let gap = chain(&[Piece { length_m: 2.0, curvature: 0.0 }, Piece { length_m: PI, curvature: 1.0 }])
            .expect_err("a half oval is open");
        assert!((gap.ahead_m + 2.0).abs() < 1e-6 && (gap.left_m + 2.0).abs() < 1e-6, "{gap:?}");
        assert!((gap.turn_rad.abs() - PI).abs() < 1e-6, "{gap:?}");
    }

    #[test]
    fn a_curve_goes_through_its_points() {
        let corner = |x, y| Point2::new(x, y);
        let points = [corner(0.0, 0.0), corner(3.0, 0.0), corner(3.5, 2.0), corner(0.0, 2.0)];
        let line = CentreLine::through(&smooth(&points));
        for point in points {
            let left_m = line.locate(point, None).left_m;
            assert!(left_m.abs() < 2e-3, "{point} is {left_m} m off");
        }
    }
}
