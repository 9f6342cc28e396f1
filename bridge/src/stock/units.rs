//! Between SI units and the numbers of stock firmware. Rounds to the nearest and keeps within what the firmware takes.

use std::f64::consts::PI;

use super::config::{StockConfig, WheelFigure};

/// Full power of the motor: the firmware divides by 4 and takes that as duty of 255.
pub const FULL_POWER: f64 = 1020.0;
/// The servo's command when the wheels are straight, and as far as it goes to either side.
const SERVO_STRAIGHT: f64 = 90.0;
/// No such car is faster, m/s. More is a damaged number.
const FASTEST_M_S: f64 = 50.0;

/// Power for a speed, -1020 to 1020. The caller has made sure that the speed is finite.
pub fn power_of_m_s(speed_m_s: f32, config: &StockConfig) -> i16 {
    let share = (f64::from(speed_m_s) / config.full_speed_m_s).clamp(-1.0, 1.0);
    let power = (share * FULL_POWER).round() as i16;
    if config.motor_reversed { -power } else { power }
}

/// A road-wheel angle that the car can steer, rad, + left.
pub fn limited_rad(steering_rad: f32, config: &StockConfig) -> f32 {
    let limit_rad = config.steering_limit_deg.to_radians() as f32;
    steering_rad.clamp(-limit_rad, limit_rad)
}

/// Degrees to the right, for cars that take those.
pub fn degrees_of_rad(steering_rad: f32, config: &StockConfig) -> f32 {
    let right = -f64::from(steering_rad).to_degrees();
    let limited = right.clamp(-config.steering_limit_deg, config.steering_limit_deg);
    (if config.steering_reversed { -limited } else { limited }) as f32
}

/// 0 (right stop) to 180 (left stop), for cars that take those.
pub fn servo_of_rad(steering_rad: f32, config: &StockConfig) -> u8 {
    let left = f64::from(steering_rad).to_degrees() / config.steering_limit_deg;
    let side = if config.steering_reversed { -left } else { left };
    (SERVO_STRAIGHT + side.clamp(-1.0, 1.0) * SERVO_STRAIGHT).round() as u8
}

/// Speed of the car from its wheel figure, m/s. `None` for what no car drives: a damaged number.
pub fn m_s_of_wheel_figure(figure: f64, config: &StockConfig) -> Option<f32> {
    let rim_m = PI * config.wheel_diameter_m;
    let speed_m_s = match config.wheel_figure {
        WheelFigure::Speed => figure,
        WheelFigure::AngularSpeed => figure / config.encoder_turns_per_wheel_turn * config.wheel_diameter_m / 2.0,
        WheelFigure::Period if figure == 0.0 => 0.0,
        WheelFigure::Period => rim_m / (figure * config.period_count_s),
    };
    let forward = if config.motor_reversed { -speed_m_s } else { speed_m_s };
    (forward.abs() <= FASTEST_M_S).then_some(forward as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT_RAD: f32 = 0.349_065_85;

    #[test]
    fn power_is_a_share_of_the_full_speed_and_never_more_than_all() {
        let config = StockConfig::default();
        let powers = [-9.0, -1.0, 0.0, 0.5, 2.0, 1e9].map(|speed| power_of_m_s(speed, &config));
        assert_eq!(powers, [-1020, -510, 0, 255, 1020, 1020], "2 m/s is all");
        let reversed = StockConfig { motor_reversed: true, ..config };
        assert_eq!(power_of_m_s(0.5, &reversed), -255, "the other way");
    }

    #[test]
    fn left_is_negative_degrees_and_the_upper_half_of_the_servo() {
        let config = StockConfig::default();
        let angles = [-9.0, -LIMIT_RAD, 0.0, LIMIT_RAD / 2.0, 9.0];
        assert_eq!(angles.map(|angle| servo_of_rad(angle, &config)), [0, 0, 90, 135, 180], "0 to 180");
        let degrees = angles.map(|angle| degrees_of_rad(angle, &config).round());
        assert_eq!(degrees, [20.0, 20.0, 0.0, -10.0, -20.0], "to the right");
        let reversed = StockConfig { steering_reversed: true, ..config };
        assert_eq!(angles.map(|angle| servo_of_rad(angle, &reversed)), [180, 180, 90, 45, 0], "the other way");
        assert_eq!(degrees_of_rad(LIMIT_RAD, &reversed).round(), 20.0, "the other way");
    }

    #[test]
    fn every_wheel_figure_gives_the_speed_of_the_car() {
        let config = StockConfig::default();
        let of = |figure, wheel_figure| m_s_of_wheel_figure(figure, &StockConfig { wheel_figure, ..config.clone() });
        assert_eq!(of(-10.0, WheelFigure::AngularSpeed), Some(-0.3), "10 rad/s at a radius of 3 cm");
        assert_eq!(of(0.7, WheelFigure::Speed), Some(0.7), "as it is");
        let expected = (PI * 0.06 / 0.3) as f32;
        assert_eq!(of(50.0, WheelFigure::Period), Some(expected), "a turn in 50 * 6 ms");
        assert_eq!(of(0.0, WheelFigure::Period), Some(0.0), "it stands");
        for damaged in [1e30, f64::NAN, f64::INFINITY] {
            assert_eq!(of(damaged, WheelFigure::Speed), None, "{damaged} m/s");
        }
        let geared = StockConfig { encoder_turns_per_wheel_turn: 5.0, motor_reversed: true, ..config };
        assert_eq!(m_s_of_wheel_figure(50.0, &geared), Some(-0.3), "through a gear, and the other way");
    }
}
