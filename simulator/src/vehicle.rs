//! The car: a kinematic bicycle with its reference point on the rear axle, a servo and a motor with lag, an encoder, a battery.
//!
//! Not modelled: tyre forces (but for an understeer gradient), suspension, roll and pitch, gear play.

use carril_messages::car::{
    BATTERY_FULL_V, ENCODER_TICKS_PER_M, FULL_DUTY_SPEED_M_S, SERVO_LEFT_US, SERVO_RIGHT_US, STEERING_LIMIT_RAD,
    WHEELBASE_M,
};
use carril_messages::{Command, McuPins, Pose};
use serde::{Deserialize, Serialize};

use crate::centre_line::wrap_angle;
use crate::config::VehicleConfig;

/// Rolling resistance, m/s²: brings the car to rest in the end when nothing drives it.
const ROLLING_M_S2: f64 = 0.08;

/// What drives the car.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Drive {
    /// Road-wheel angle that the servo is told, rad, + left. `None`: the servo is free and stays where it is.
    pub steering_rad: Option<f64>,
    /// What the motor is told.
    pub motor: Motor,
}

/// What the motor is told.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Motor {
    /// Nothing: it turns freely.
    Coast,
    /// To brake.
    Brake,
    /// Share of full voltage, -1 to 1.
    Duty(f64),
    /// A speed, m/s, by an ideal controller.
    Speed(f64),
}

impl Drive {
    /// Free servo, free motor.
    pub const IDLE: Self = Self { steering_rad: None, motor: Motor::Coast };

    /// From the microcontroller's pins. `None` when the duty is not a number.
    pub fn from_pins(pins: &McuPins) -> Option<Self> {
        let duty = f64::from(pins.motor_duty);
        let motor = match (pins.brake, duty == 0.0) {
            (true, _) => Motor::Brake,
            (false, true) => Motor::Coast,
            (false, false) => Motor::Duty(duty.clamp(-1.0, 1.0)),
        };
        duty.is_finite().then_some(Self { steering_rad: pins.servo_us.map(servo_angle_rad), motor })
    }

    /// From a command. `None` when a number of it is not finite.
    pub fn from_command(command: &Command) -> Option<Self> {
        let speed_m_s = f64::from(command.speed_m_s).clamp(-FULL_DUTY_SPEED_M_S, FULL_DUTY_SPEED_M_S);
        let drive = Self { steering_rad: Some(f64::from(command.steering_rad)), motor: Motor::Speed(speed_m_s) };
        command.is_finite().then_some(drive)
    }
}

/// Road-wheel angle of a servo pulse, rad, + left: linear between the stops, and never beyond them.
pub fn servo_angle_rad(pulse_us: u16) -> f64 {
    let share = (f64::from(pulse_us) - f64::from(SERVO_RIGHT_US)) / f64::from(SERVO_LEFT_US - SERVO_RIGHT_US);
    STEERING_LIMIT_RAD * (2.0 * share - 1.0).clamp(-1.0, 1.0)
}

/// The encoder: edges after equal distances, in both directions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Encoder {
    road_m: f64,
    edges: u64,
    last_edge_s: Option<f64>,
    period_s: Option<f64>,
}

/// The state of the car.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Vehicle {
    /// Rear axle, map frame.
    pub pose: Pose,
    /// Along the body's x axis, m/s.
    pub speed_m_s: f64,
    /// Of the road wheels, rad, + left.
    pub steering_rad: f64,
    /// + left.
    pub yaw_rate_rad_s: f64,
    /// V.
    pub battery_v: f64,
    time_s: f64,
    encoder: Encoder,
}

impl Vehicle {
    /// At rest.
    pub fn at(pose: Pose, config: &VehicleConfig) -> Self {
        let steering_rad = config.steering_offset_deg.to_radians();
        let battery_v = config.battery_v;
        Self {
            pose,
            speed_m_s: 0.0,
            steering_rad,
            yaw_rate_rad_s: 0.0,
            battery_v,
            time_s: 0.0,
            encoder: Encoder::default(),
        }
    }

    /// Goes on by `dt_s`, a millisecond or so.
    pub fn advance(&mut self, drive: &Drive, config: &VehicleConfig, dt_s: f64) {
        self.turn_servo(drive.steering_rad, config, dt_s);
        let wheel_speed_before = self.speed_m_s;
        self.turn_motor(drive.motor, config, dt_s);
        self.roll(f64::midpoint(wheel_speed_before, self.speed_m_s), config, dt_s);
        self.time_s += dt_s;
    }

    /// Edges of the encoder since the start.
    pub fn encoder_ticks(&self) -> u64 {
        self.encoder.edges
    }

    /// Time between the last two edges, µs.
    pub fn encoder_period_us(&self) -> Option<u32> {
        self.encoder.period_s.map(|period_s| (period_s * 1e6).clamp(0.0, f64::from(u32::MAX)) as u32)
    }

    fn turn_servo(&mut self, target_rad: Option<f64>, config: &VehicleConfig, dt_s: f64) {
        let Some(target_rad) = target_rad else { return };
        let told = target_rad * config.steering_gain + config.steering_offset_deg.to_radians();
        let error = told.clamp(-STEERING_LIMIT_RAD, STEERING_LIMIT_RAD) - self.steering_rad;
        let most = config.servo_rate_deg_s.to_radians() * dt_s;
        self.steering_rad += (error * approach(dt_s, config.servo_lag_ms)).clamp(-most, most);
    }

    fn turn_motor(&mut self, motor: Motor, config: &VehicleConfig, dt_s: f64) {
        let (target, lag_ms) = match motor {
            Motor::Coast => (0.0, config.coast_lag_ms),
            Motor::Brake => (0.0, config.brake_lag_ms),
            Motor::Duty(duty) => (duty * FULL_DUTY_SPEED_M_S * self.battery_v / BATTERY_FULL_V, config.motor_lag_ms),
            Motor::Speed(speed) if speed.abs() < self.speed_m_s.abs() => (speed, config.brake_lag_ms),
            Motor::Speed(speed) => (speed, config.motor_lag_ms),
        };
        self.speed_m_s += (target - self.speed_m_s) * approach(dt_s, lag_ms);
        if target == 0.0 {
            self.speed_m_s -= self.speed_m_s.clamp(-ROLLING_M_S2 * dt_s, ROLLING_M_S2 * dt_s);
        }
        let load = if let Motor::Duty(duty) = motor { duty.abs() } else { self.speed_m_s.abs() / FULL_DUTY_SPEED_M_S };
        self.battery_v = config.battery_v - config.battery_sag_v * load;
    }

    fn roll(&mut self, wheel_speed_m_s: f64, config: &VehicleConfig, dt_s: f64) {
        self.encoder.roll(wheel_speed_m_s, self.time_s, dt_s);
        let speed = wheel_speed_m_s * (1.0 - config.wheel_slip);
        // Kinematic bicycle at the rear axle; the understeer gradient lengthens the wheelbase with the square of the speed.
        self.yaw_rate_rad_s = speed * self.steering_rad.tan() / (WHEELBASE_M + config.understeer_s2_m * speed * speed);
        let mean_yaw = self.pose.yaw_rad + self.yaw_rate_rad_s * dt_s / 2.0;
        self.pose.x_m += speed * mean_yaw.cos() * dt_s;
        self.pose.y_m += speed * mean_yaw.sin() * dt_s;
        self.pose.yaw_rad = wrap_angle(self.pose.yaw_rad + self.yaw_rate_rad_s * dt_s);
    }
}

impl Encoder {
    fn roll(&mut self, speed_m_s: f64, time_s: f64, dt_s: f64) {
        let before_m = self.road_m;
        self.road_m += speed_m_s.abs() * dt_s;
        let edges = (self.road_m * ENCODER_TICKS_PER_M) as u64;
        for edge in self.edges + 1..=edges {
            let at_s = time_s + (edge as f64 / ENCODER_TICKS_PER_M - before_m).max(0.0) / speed_m_s.abs();
            self.period_s = self.last_edge_s.map(|last_s| at_s - last_s);
            self.last_edge_s = Some(at_s);
        }
        self.edges = edges;
    }
}

/// The share of an error that a first-order lag makes up for in `dt_s`.
fn approach(dt_s: f64, lag_ms: f64) -> f64 {
    if lag_ms > 0.0 { 1.0 - (-dt_s * 1e3 / lag_ms).exp() } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_S: f64 = 1e-3;

    fn car() -> (Vehicle, VehicleConfig) {
        let config = VehicleConfig::default();
        (Vehicle::at(Pose::default(), &config), config)
    }

    fn drive(vehicle: &mut Vehicle, config: &VehicleConfig, drive: Drive, seconds: f64) {
        (0..(seconds / STEP_S).round() as u32).for_each(|_| vehicle.advance(&drive, config, STEP_S));
    }

    fn speed(speed_m_s: f64, steering_rad: f64) -> Drive {
        Drive { steering_rad: Some(steering_rad), motor: Motor::Speed(speed_m_s) }
    }

    #[test]
    fn turns_on_the_circle_of_the_bicycle() {
        let (mut car, config) = car();
        drive(&mut car, &config, speed(0.5, 0.2), 3.0);
        // The middle of the circle is one radius to the left; all later poses have the same distance from it.
        let radius_m = WHEELBASE_M / 0.2_f64.tan();
        let middle =
            (car.pose.x_m - radius_m * car.pose.yaw_rad.sin(), car.pose.y_m + radius_m * car.pose.yaw_rad.cos());
        for _ in 0..10 {
            drive(&mut car, &config, speed(0.5, 0.2), 0.7);
            let distance = (car.pose.x_m - middle.0).hypot(car.pose.y_m - middle.1);
            assert!((distance - radius_m).abs() < 1e-3, "radius {distance} m, expected {radius_m} m");
        }
    }

    #[test]
    fn counts_the_edges_of_the_way_and_measures_their_period() {
        let (mut car, config) = car();
        drive(&mut car, &config, speed(0.5, 0.0), 10.0);
        let expected = (car.pose.x_m * ENCODER_TICKS_PER_M) as u64;
        assert!(car.encoder_ticks().abs_diff(expected) <= 1, "{} edges, expected {expected}", car.encoder_ticks());
        let period = car.encoder_period_us().expect("many edges");
        let expected = 1e6 / (0.5 * ENCODER_TICKS_PER_M);
        assert!((f64::from(period) - expected).abs() < 3.0, "{period} us, expected {expected} us");
        let before = car.encoder_ticks();
        drive(&mut car, &config, speed(-0.5, 0.0), 3.0);
        assert!(car.encoder_ticks() > before + 500, "backwards counts up too");
    }

    #[test]
    fn has_no_period_before_the_second_edge() {
        let (mut car, config) = car();
        assert_eq!((car.encoder_ticks(), car.encoder_period_us()), (0, None), "at rest");
        while car.encoder_ticks() < 1 {
            drive(&mut car, &config, speed(0.3, 0.0), STEP_S);
        }
        assert_eq!(car.encoder_period_us(), None, "one edge has no period");
    }

    #[test]
    fn brakes_short_and_coasts_long() {
        let stop_distance = |motor| {
            let (mut car, config) = car();
            drive(&mut car, &config, speed(1.0, 0.0), 3.0);
            let from_m = car.pose.x_m;
            drive(&mut car, &config, Drive { steering_rad: None, motor }, 20.0);
            assert_eq!(car.speed_m_s, 0.0, "{motor:?} ends at rest");
            car.pose.x_m - from_m
        };
        let (braked_m, coasted_m) = (stop_distance(Motor::Brake), stop_distance(Motor::Coast));
        assert!((0.04..0.10).contains(&braked_m), "braking from 1 m/s takes {braked_m} m");
        assert!((0.4..1.0).contains(&coasted_m), "coasting from 1 m/s takes {coasted_m} m");
    }

    #[test]
    fn servo_lags_and_keeps_its_rate() {
        let (mut car, config) = car();
        drive(&mut car, &config, speed(0.0, STEERING_LIMIT_RAD), 0.010);
        let most = config.servo_rate_deg_s.to_radians() * 0.010;
        assert!(car.steering_rad > 0.0 && car.steering_rad <= most + 1e-9, "{} rad after 10 ms", car.steering_rad);
        drive(&mut car, &config, speed(0.0, 9.0), 1.0);
        assert!((car.steering_rad - STEERING_LIMIT_RAD).abs() < 1e-6, "never beyond the stop");
        drive(&mut car, &config, Drive::IDLE, 1.0);
        assert!((car.steering_rad - STEERING_LIMIT_RAD).abs() < 1e-6, "a free servo stays");
    }

    #[test]
    fn pulses_map_linearly_onto_the_stops() {
        for (pulse_us, share) in [(635, -1.0), (1050, 0.0), (1465, 1.0), (100, -1.0), (2000, 1.0)] {
            let angle = servo_angle_rad(pulse_us);
            assert!((angle - share * STEERING_LIMIT_RAD).abs() < 1e-9, "{pulse_us} us is {angle} rad");
        }
    }

    #[test]
    fn full_duty_is_full_speed_of_a_full_battery() {
        let (mut car, config) = car();
        let pins = McuPins { servo_us: None, motor_duty: 1.0, brake: false };
        drive(&mut car, &config, Drive::from_pins(&pins).expect("finite"), 5.0);
        let expected = FULL_DUTY_SPEED_M_S * car.battery_v / BATTERY_FULL_V;
        assert!((car.speed_m_s - expected).abs() < 1e-3, "{} m/s, expected {expected}", car.speed_m_s);
        assert!((car.battery_v - (config.battery_v - config.battery_sag_v)).abs() < 1e-9, "the battery sags");
        assert_eq!(Drive::from_pins(&McuPins { motor_duty: f32::NAN, ..pins }), None, "NaN drives nothing");
    }
}
