//! The wheel in the hands of the microcontroller: speed from one channel of an encoder, and a PI controller with feed-forward
//! that holds a speed with it. Pure: numbers and times in, numbers out; the firmware does the same in integers.

use carril_messages::McuSensors;
use serde::{Deserialize, Serialize};

use crate::calibration::{Calibration, Param};
use crate::codec::FULL_DUTY;

/// Without a tick for so long, the wheel counts as standing, µs.
const STANDING_AFTER_US: u64 = 200_000;
/// Ticks are seen in steps of so much when the encoder is read by polling; a pause up to this is no slowing down, µs.
const POLLING_SLACK_US: u64 = 20_000;
/// Slower set points mean: stand, m/s.
const STANDSTILL_M_S: f32 = 0.005;
/// A wheel faster than this is not driven the other way: it brakes first, m/s.
const REVERSE_BELOW_M_S: f32 = 0.1;
/// No step of the controller counts as longer, s.
const LONGEST_STEP_S: f32 = 0.05;

/// The wheel as its encoder shows it. Without a sign: one channel does not know it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Encoder {
    first_count: Option<u64>,
    ticks: u64,
    last_tick_us: Option<u64>,
    period_us: Option<u32>,
}

impl Encoder {
    /// Takes a reading.
    pub fn read(&mut self, sensors: &McuSensors, now_us: u64) {
        let first = *self.first_count.get_or_insert(sensors.encoder_ticks);
        let ticks = sensors.encoder_ticks.saturating_sub(first);
        if ticks != self.ticks {
            self.ticks = ticks;
            self.last_tick_us = Some(now_us);
            self.period_us = sensors.encoder_period_us;
        }
    }

    /// Ticks since the first reading; wraps.
    pub fn ticks(&self) -> u32 {
        self.ticks as u32
    }

    /// Time between the last two ticks, µs. `None` when the wheel stands.
    pub fn period_us(&self, now_us: u64) -> Option<u32> {
        self.period_us.filter(|_| self.since_tick_us(now_us).is_some_and(|since| since < STANDING_AFTER_US))
    }

    /// Time since the last tick was seen, µs.
    pub fn since_tick_us(&self, now_us: u64) -> Option<u64> {
        self.last_tick_us.map(|tick| now_us.saturating_sub(tick))
    }

    /// Speed of the road under the wheel, m/s, never negative, with `tick_m` of road per tick. Falls by itself when ticks stay away.
    pub fn speed_m_s(&self, tick_m: f64, now_us: u64) -> f32 {
        let Some(period_us) = self.period_us(now_us) else { return 0.0 };
        let pause_us = self.since_tick_us(now_us).unwrap_or(0).saturating_sub(POLLING_SLACK_US);
        let period_s = u64::from(period_us).max(pause_us).max(1) as f64 * 1e-6;
        (tick_m / period_s) as f32
    }
}

/// What the motor driver is told.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MotorOrder {
    /// -1 to 1.
    pub duty: f32,
    /// Both terminals shorted.
    pub brake: bool,
}

impl MotorOrder {
    /// Brakes.
    pub const BRAKE: Self = Self { duty: 0.0, brake: true };
}

/// How a speed is held. Duties are shares of full duty.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gains {
    full_duty_m_s: f32,
    /// Duty per m/s of error.
    proportional: f32,
    /// Duty per m of error.
    integral: f32,
    /// Largest duty that the integral may contribute: it makes up for slopes and a tired battery.
    integral_limit: f32,
    /// Duty that only overcomes friction.
    dead_duty: f32,
}

impl Gains {
    /// Those of a calibration.
    pub fn of(calibration: &Calibration) -> Self {
        let duty = |param| calibration.get(param) as f32 / f32::from(FULL_DUTY);
        Self {
            full_duty_m_s: calibration.get(Param::FullDutySpeedMmS) as f32 / 1_000.0,
            proportional: duty(Param::SpeedP),
            integral: duty(Param::SpeedI),
            integral_limit: duty(Param::SpeedILimit),
            dead_duty: duty(Param::MotorDeadDuty),
        }
    }

    /// A duty with what overcomes friction, within -1 and 1.
    pub fn over_friction(&self, duty: f32) -> f32 {
        if duty == 0.0 { 0.0 } else { (duty + self.dead_duty.copysign(duty)).clamp(-1.0, 1.0) }
    }
}

/// Holds a speed.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SpeedControl {
    /// Duty, as it has been learnt.
    integral: f32,
    /// 1 or -1: where the motor pushes, or last pushed.
    direction: f32,
    last_step_us: Option<u64>,
}

impl Default for SpeedControl {
    fn default() -> Self {
        Self { integral: 0.0, direction: 1.0, last_step_us: None }
    }
}

impl SpeedControl {
    /// 1 or -1: the sign of the wheel's speed.
    pub fn direction(&self) -> f32 {
        self.direction
    }

    /// Whether what it has learnt is a number within its limits.
    pub fn is_sane(&self) -> bool {
        self.integral.abs() <= 1.0 && self.direction.abs() == 1.0
    }

    /// Forgets what it has learnt; the wheel stands or brakes.
    pub fn reset(&mut self) {
        self.integral = 0.0;
        self.last_step_us = None;
    }

    /// The motor is driven without control, this way.
    pub fn pushes(&mut self, duty: f32) {
        self.reset();
        self.direction = if duty == 0.0 { self.direction } else { duty.signum() };
    }

    /// What the motor driver shall do now. `target_m_s` is signed, `wheel_m_s` is not.
    pub fn step(&mut self, gains: &Gains, target_m_s: f32, wheel_m_s: f32, now_us: u64) -> MotorOrder {
        let wanted = target_m_s.signum();
        let must_turn = wanted != self.direction;
        if target_m_s.abs() < STANDSTILL_M_S || (must_turn && wheel_m_s > REVERSE_BELOW_M_S) {
            self.reset();
            return MotorOrder::BRAKE;
        }
        self.direction = wanted;
        let elapsed_us = now_us.saturating_sub(self.last_step_us.replace(now_us).unwrap_or(now_us));
        let elapsed_s = (elapsed_us as f32 * 1e-6).min(LONGEST_STEP_S);
        let error_m_s = target_m_s.abs() - wheel_m_s;
        let feed_forward = target_m_s.abs() / gains.full_duty_m_s;
        let unlimited = feed_forward + gains.proportional * error_m_s + self.integral;
        // At a limit the integral only moves back: it does not wind up.
        if (unlimited < 1.0 || error_m_s < 0.0) && (unlimited > 0.0 || error_m_s > 0.0) {
            let integral = self.integral + gains.integral * error_m_s * elapsed_s;
            self.integral = integral.clamp(-gains.integral_limit, gains.integral_limit);
        }
        MotorOrder { duty: gains.over_friction(self.direction * unlimited.clamp(0.0, 1.0)), brake: false }
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::car;

    use super::*;

    const TICK_M: f64 = 1.0 / car::ENCODER_TICKS_PER_M;

    /// A motor with a first-order lag; `strength` 1 is the nominal car.
    struct Motor {
        speed_m_s: f64,
        distance_m: f64,
        strength: f64,
    }

    impl Motor {
        fn run(&mut self, order: MotorOrder, step_s: f64) {
            let driven_m_s = f64::from(order.duty) * car::FULL_DUTY_SPEED_M_S * self.strength;
            let (goal, lag_s) = if order.brake { (0.0, 0.05) } else { (driven_m_s, 0.2) };
            self.speed_m_s += (goal - self.speed_m_s) * step_s / lag_s;
            self.distance_m += self.speed_m_s.abs() * step_s;
        }

        fn sensors(&self) -> McuSensors {
            let frequency = self.speed_m_s.abs() * car::ENCODER_TICKS_PER_M;
            McuSensors {
                encoder_ticks: (self.distance_m * car::ENCODER_TICKS_PER_M) as u64,
                encoder_period_us: (frequency > 0.1).then(|| (1e6 / frequency) as u32),
                battery_v: 8.0,
                estop_pressed: false,
            }
        }
    }

    fn drive(target_m_s: f32, strength: f64, seconds: f64) -> Motor {
        let mut motor = Motor { speed_m_s: 0.0, distance_m: 0.0, strength };
        let gains = Gains::of(&Calibration::default());
        let (mut encoder, mut control) = (Encoder::default(), SpeedControl::default());
        for step in 0..(seconds / 0.005) as u64 {
            let now_us = step * 5_000;
            encoder.read(&motor.sensors(), now_us);
            let order = control.step(&gains, target_m_s, encoder.speed_m_s(TICK_M, now_us), now_us);
            motor.run(order, 0.005);
        }
        motor
    }

    #[test]
    fn holds_the_speed_of_strong_and_weak_cars_both_ways() {
        for (target_m_s, strength) in [(0.5, 1.0), (0.5, 0.75), (0.5, 1.3), (-0.4, 1.0), (1.5, 1.0), (0.1, 1.0)] {
            let motor = drive(target_m_s, strength, 4.0);
            let error = (motor.speed_m_s - f64::from(target_m_s)).abs();
            assert!(
                error < 0.02,
                "strength {strength}: got {} m/s, wanted {target_m_s} m/s within 0.02",
                motor.speed_m_s
            );
        }
    }

    #[test]
    fn brakes_before_it_turns_back() {
        let (mut control, gains) = (SpeedControl::default(), Gains::of(&Calibration::default()));
        assert!(control.step(&gains, 0.5, 0.5, 0).duty > 0.0, "forward");
        assert_eq!(control.step(&gains, -0.5, 0.5, 5_000), MotorOrder::BRAKE, "still rolling forward at 0.5 m/s");
        assert!(control.step(&gains, -0.5, 0.05, 10_000).duty < 0.0, "slow enough to turn back");
    }

    #[test]
    fn friction_is_overcome_both_ways_and_a_standing_motor_stays() {
        let mut calibration = Calibration::default();
        calibration.set(Param::MotorDeadDuty, 102).expect("a duty");
        let gains = Gains::of(&calibration);
        let duties = [0.0, 0.3, -0.3, 0.95].map(|duty| gains.over_friction(duty));
        assert_eq!(duties, [0.0, 0.4, -0.4, 1.0], "a tenth more than wanted, at most all");
    }

    #[test]
    fn stands_when_the_ticks_stay_away() {
        let mut encoder = Encoder::default();
        let reading = |ticks| McuSensors {
            encoder_ticks: ticks,
            encoder_period_us: Some(3_000),
            battery_v: 8.0,
            estop_pressed: false,
        };
        encoder.read(&reading(1_000), 0);
        assert_eq!((encoder.ticks(), encoder.period_us(0)), (0, None), "counts from its first reading");
        encoder.read(&reading(1_002), 5_000);
        let expected_m_s = (1.0 / (0.003 * car::ENCODER_TICKS_PER_M)) as f32;
        assert!(
            (encoder.speed_m_s(TICK_M, 5_000) - expected_m_s).abs() < 1e-6,
            "{} m/s",
            encoder.speed_m_s(TICK_M, 5_000)
        );
        encoder.read(&reading(1_002), 105_000);
        assert!(encoder.speed_m_s(TICK_M, 105_000) < 0.02, "a pause of 100 ms is a slow wheel");
        assert_eq!(encoder.speed_m_s(TICK_M, 205_000), 0.0, "and 200 ms a standing one");
    }
}
