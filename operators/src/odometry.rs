//! How the car has moved, from what its microcontroller says of the wheels.

use carril_messages::{Stamp, WheelTelemetry};
use carril_runtime::Input;
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

/// Older news of the wheels is none, s.
const TIMEOUT_S: f64 = 0.2;

/// What the wheels do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Wheels {
    /// m/s, + forward.
    pub speed_m_s: f64,
    /// Of the road wheels, rad, + left.
    pub steering_rad: f64,
}

impl Wheels {
    /// The newest news, if it is young and sound.
    pub fn newest(input: &mut Input<WheelTelemetry>, now: Stamp) -> Option<Self> {
        let sample = input.latest()?;
        let wheels = Self { speed_m_s: f64::from(sample.speed_m_s), steering_rad: f64::from(sample.steering_rad) };
        let fresh = sample.age(now).as_secs_f64() <= TIMEOUT_S;
        let sound = wheels.speed_m_s.is_finite() && wheels.steering_rad.abs() < std::f64::consts::FRAC_PI_2;
        (fresh && sound).then_some(wheels)
    }

    /// Where they take a car with this wheelbase (m) in `seconds`.
    pub fn motion(self, seconds: f64, wheelbase_m: f64) -> Motion {
        let way_m = self.speed_m_s * seconds;
        Motion { way_m, turn_rad: way_m * self.steering_rad.tan() / wheelbase_m }
    }
}

/// A short way of the car, along an arc: of the middle of its rear axle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Motion {
    /// m, + forward.
    pub way_m: f64,
    /// rad, + left.
    pub turn_rad: f64,
}

impl Motion {
    /// Where it leads, ahead and left of where it began, m.
    pub fn end(self) -> Vector2<f64> {
        let (sin, cos) = (self.turn_rad / 2.0).sin_cos();
        Vector2::new(cos, sin) * self.way_m
    }

    /// A point of the floor as it is seen after the motion.
    pub fn seen_after(self, point: Vector2<f64>) -> Vector2<f64> {
        let (sin, cos) = self.turn_rad.sin_cos();
        let from_end = point - self.end();
        Vector2::new(cos * from_end.x + sin * from_end.y, cos * from_end.y - sin * from_end.x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_of_a_circle_in_short_steps() {
        let wheels = Wheels { speed_m_s: 0.5, steering_rad: 0.26_f64.atan() };
        // Radius 1 m: pi / 2 m of way, towards the point that lies 1 m ahead and 1 m to the left.
        let seconds = std::f64::consts::FRAC_PI_2 / 0.5;
        let mut goal = Vector2::new(1.0, 1.0);
        for _ in 0..100 {
            goal = wheels.motion(seconds / 100.0, 0.26).seen_after(goal);
        }
        assert!(goal.norm() < 1e-4, "the car stands on it: {goal:?}");
        let whole = wheels.motion(seconds, 0.26);
        assert!((whole.turn_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-9, "turned by a quarter");
    }
}
