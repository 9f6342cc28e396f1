//! Driving one move: the steering that keeps the car on its arc, ahead and back, and how far it is to the end.

use super::geometry::{Car, Place};
use super::plan::Move;

/// Where the car is on a move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnMove {
    /// Way to its end, m; below 0 beyond it.
    pub left_to_go_m: f64,
    /// To the left of the arc, m, as the car looks.
    pub off_m: f64,
    /// Turned to the left of the arc, rad.
    pub turned_rad: f64,
}

/// Where a car stands on a move.
pub fn locate(way: &Move, at: Place) -> OnMove {
    let [ahead_m, left_m] = way.from.seen([at.x_m, at.y_m]);
    let curvature = way.curvature_per_m;
    let (along_m, off_m) = if curvature.abs() < 1e-6 {
        (ahead_m, left_m)
    } else {
        let radius_m = 1.0 / curvature;
        // Seen from the middle of the circle, the move begins at -radius.
        let from_middle = radius_m - left_m;
        let angle = (ahead_m * radius_m.signum()).atan2(from_middle * radius_m.signum());
        (angle * radius_m, radius_m - radius_m.signum() * ahead_m.hypot(from_middle))
    };
    let turned_rad = at.yaw_rad - way.from.yaw_rad - curvature * along_m;
    OnMove { left_to_go_m: (way.way_m - along_m) * way.way_m.signum(), off_m, turned_rad }
}

/// Curvature that brings the car back onto its arc within some `settle_m` of way, 1/m, + to the left, within what the car can do.
///
/// Along the way `s`, driven in direction `d`: `off' = d sin(turned)`, `turned' = d (curvature - arc)`, so that
/// `curvature = arc - off / l^2 - 2 d turned / l` makes `off'' = -off / l^2 - 2 off' / l`: critically damped, ahead and back alike.
pub fn curvature_per_m(way: &Move, on: &OnMove, settle_m: f64, car: &Car) -> f64 {
    let direction = way.way_m.signum();
    let back = on.off_m / (settle_m * settle_m) + 2.0 * direction * on.turned_rad.sin() / settle_m;
    (way.curvature_per_m - back).clamp(-car.curvature_per_m, car.curvature_per_m)
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::car;
    use super::*;

    #[test]
    fn knows_where_it_is_on_arcs_of_every_sort() {
        for curvature_per_m in [-1.3, 0.0, 1.3] {
            for way_m in [-0.8, 0.6] {
                let way = Move { from: Place::new(0.4, -0.2, 0.3), curvature_per_m, way_m };
                let on_it = way.from.after(0.25 * way_m, curvature_per_m);
                let beside = on_it.place(Place::new(0.0, 0.02, 0.05));
                let on = locate(&way, beside);
                let text = format!("{on:?} on {way:?}");
                // Beside the arc, the same angle is another way along it.
                assert!((on.left_to_go_m - 0.75 * way_m.abs()).abs() < 1e-9, "{text}");
                assert!((on.off_m - 0.02).abs() < 1e-9 && (on.turned_rad - 0.05).abs() < 1e-9, "{text}");
                assert!(
                    locate(&way, way.to().after(0.1 * way_m, curvature_per_m)).left_to_go_m < 0.0,
                    "beyond its end"
                );
            }
        }
    }

    #[test]
    fn comes_back_onto_the_arc_ahead_and_back() {
        let car = car();
        for curvature_per_m in [-1.0, 0.0, 1.0] {
            for way_m in [-0.9, 0.9] {
                let way = Move { from: Place::default(), curvature_per_m, way_m };
                let mut at = Place::new(0.0, 0.015, 0.03);
                while locate(&way, at).left_to_go_m > 0.0 {
                    let on = locate(&way, at);
                    at = at.after(0.002 * way_m.signum(), curvature_per_m_with_offset(&way, &on, &car));
                }
                let on = locate(&way, at);
                assert!(on.off_m.abs() < 0.004 && on.turned_rad.abs() < 0.02, "{on:?} at the end of {way:?}");
            }
        }
    }

    /// Wheels that stand a degree to the left of what they are told.
    fn curvature_per_m_with_offset(way: &Move, on: &OnMove, car: &Car) -> f64 {
        let told = (curvature_per_m(way, on, 0.12, car) * car.wheelbase_m).atan();
        (told + 1_f64.to_radians()).tan() / car.wheelbase_m
    }
}
