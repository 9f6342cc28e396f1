//! Steering along a path whose place on the floor is known, a lane's middle: towards a point ahead on it (pure pursuit), from where the car will
//! be when the wheels have turned.
//!
//! R. C. Coulter, "Implementation of the Pure Pursuit Path Tracking Algorithm", CMU-RI-TR-92-01, 1992: the circle through the rear
//! axle, along the car, to a point at distance L and y to the left has the curvature 2 y / L^2.

use carril_messages::GroundLane;
use nalgebra::Vector2;

use super::config::DecisionConfig;

/// What the car does meanwhile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Going {
    /// m/s.
    pub speed_m_s: f64,
    /// Road-wheel angle, rad, + left.
    pub steering_rad: f64,
    /// Since the exposure of the image in which the lane was seen, s.
    pub age_s: f64,
}

/// What is driven along. Body frame: ahead and left of the rear axle, m.
pub trait Path {
    /// The point ahead on it that is `distance_m` away from `from`; where it is farther away than that, the point of it beside `from`.
    fn point_away_from(&self, from: [f64; 2], distance_m: f64) -> [f64; 2];
}

impl Path for GroundLane {
    fn point_away_from(&self, from: [f64; 2], distance_m: f64) -> [f64; 2] {
        Self::point_away_from(self, from, distance_m)
    }
}

/// Road-wheel angle, rad, + left, within the limit.
pub fn steering_rad(path: &impl Path, going: Going, config: &DecisionConfig) -> f64 {
    let way_m = going.speed_m_s * (going.age_s.max(0.0) + config.steering_delay_ms * 1e-3);
    let turned = way_m * going.steering_rad.tan() / config.wheelbase_m;
    let at = Vector2::new((turned / 2.0).cos(), (turned / 2.0).sin()) * way_m;
    steering_from(path, at, turned, going.speed_m_s, config)
}

/// Road-wheel angle of a car that has come to `at`, turned to the left by `turned_rad`.
pub fn steering_from(
    path: &impl Path,
    at: Vector2<f64>,
    turned_rad: f64,
    speed_m_s: f64,
    config: &DecisionConfig,
) -> f64 {
    let lookahead_m = config.lookahead_m + config.lookahead_s * speed_m_s.abs();
    let [x, y] = path.point_away_from(at.into(), lookahead_m);
    let (ahead, left) = (x - at.x, y - at.y);
    let left_m = left * turned_rad.cos() - ahead * turned_rad.sin();
    // A path that lies farther away than the lookahead is approached at the steepest.
    let distance_m = ahead.hypot(left).max(lookahead_m);
    let limit = config.max_steering_deg.to_radians();
    (2.0 * left_m / (distance_m * distance_m) * config.wheelbase_m).atan().clamp(-limit, limit)
}

#[cfg(test)]
mod tests {
    use super::*;

    const STANDING: Going = Going { speed_m_s: 0.0, steering_rad: 0.0, age_s: 0.0 };

    fn lane(offset_m: f32, heading_rad: f32, curvature_per_m: f32) -> GroundLane {
        GroundLane {
            offset_m,
            heading_rad,
            curvature_per_m,
            curvature_rate_per_m2: 0.0,
            width_m: 0.4,
            seen_m: 1.0,
            left_seen: true,
            right_seen: true,
            bridged_m: 0.0,
        }
    }

    #[test]
    fn on_a_circle_the_wheels_stand_as_the_circle_needs() {
        let config = DecisionConfig::default();
        let steering = steering_rad(&lane(0.0, 0.0, 0.8), STANDING, &config);
        let expected = (0.8 * config.wheelbase_m).atan();
        assert!((steering - expected).abs() < 2e-3, "{steering} rad instead of {expected}");
        // Driving round it changes nothing: the car stays on the circle while it is late.
        let going = Going { speed_m_s: 1.0, steering_rad: expected, age_s: 0.05 };
        let steering = steering_rad(&lane(0.0, 0.0, 0.8), going, &config);
        assert!((steering - expected).abs() < 4e-3, "{steering} rad instead of {expected}");
    }

    #[test]
    fn steers_to_where_the_lane_lies() {
        let config = DecisionConfig::default();
        assert_eq!(steering_rad(&lane(0.0, 0.0, 0.0), STANDING, &config), 0.0, "straight on");
        assert!(steering_rad(&lane(0.1, 0.0, 0.0), STANDING, &config) > 0.05, "a lane on the left");
        assert!(steering_rad(&lane(0.0, -0.2, 0.0), STANDING, &config) < -0.05, "a lane that leads to the right");
        let limit = config.max_steering_deg.to_radians();
        assert!((steering_rad(&lane(3.0, 0.0, 0.0), STANDING, &config)).abs() <= limit, "within the servo's stops");
    }
}
