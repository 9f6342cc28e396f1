//! What is different from car to car and lives in the chip: pins, limits, directions, gains. `bridge/vectors/parameters.txt` has the
//! same table, and the tests of both sides of the line read it. Pure.

use serde::{Deserialize, Serialize};

use crate::codec::CalibrationStatus;

/// A parameter of the chip, by its index on the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Param {
    /// Arduino number of the pin that the servo is at.
    ServoPin = 0,
    /// Pulse at the right stop.
    ServoRightUs,
    /// Pulse with the wheels straight.
    ServoCenterUs,
    /// Pulse at the left stop.
    ServoLeftUs,
    /// Road-wheel angle at both stops.
    SteeringLimitTenthMrad,
    /// Pin of the motor's PWM.
    MotorPwmPin,
    /// Pin of the motor's direction.
    MotorDirectionPin,
    /// Pin that is high while the chip runs, the driver's reset. [`NO_PIN`]: none.
    MotorResetPin,
    /// Level of the direction pin that drives forward.
    MotorForwardLevel,
    /// Speed at full duty on level ground.
    FullDutySpeedMmS,
    /// Pin of the encoder.
    EncoderPin,
    /// Pin of its second channel. [`NO_PIN`]: one channel only.
    EncoderBPin,
    /// Road per tick.
    EncoderTickNm,
    /// Duty per m/s of error.
    SpeedP,
    /// Duty per m of error.
    SpeedI,
    /// Largest duty that the integral contributes.
    SpeedILimit,
    /// The duty falls to 0 within this time when a lease has run out. 0: at once.
    LeaseRampMs,
    /// Largest change of the set speed. 0: none.
    AccelerationMmS2,
    /// Duty that only overcomes friction: added to any other.
    MotorDeadDuty,
    /// Analogue pin of the battery. [`NO_PIN`]: not measured.
    BatteryPin,
    /// Battery voltage at which the converter reads its largest number.
    BatteryFullScaleMv,
    /// Below this voltage the car does not drive.
    BatteryLowMv,
    /// Pin of the e-stop button. [`NO_PIN`]: none.
    EstopPin,
    /// Its level when it is pressed.
    EstopPressedLevel,
}

/// What a parameter is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spec {
    /// Its name, with the unit.
    pub name: &'static str,
    /// Its unit; `-`: none.
    pub unit: &'static str,
    /// Smallest value.
    pub min: i32,
    /// Largest value.
    pub max: i32,
    /// Value that the firmware is built with.
    pub default: i32,
}

/// Stands for "no pin".
pub const NO_PIN: i32 = 255;
/// Pins with a timer of 7.8 kHz.
const PWM_PINS: [i32; 4] = [3, 5, 6, 11];
/// Pins of the serial line.
const SERIAL_PINS: [i32; 2] = [0, 1];

const fn spec(name: &'static str, unit: &'static str, min: i32, max: i32, default: i32) -> Spec {
    Spec { name, unit, min, max, default }
}

/// All parameters, by index.
pub const SPECS: [Spec; 24] = [
    spec("servo_pin", "-", 2, 19, 9),
    spec("servo_right_us", "us", 500, 2_500, 635),
    spec("servo_center_us", "us", 500, 2_500, 1_050),
    spec("servo_left_us", "us", 500, 2_500, 1_465),
    spec("steering_limit_tenth_mrad", "0.1mrad", 100, 7_854, 3_491),
    spec("motor_pwm_pin", "-", 3, 11, 11),
    spec("motor_direction_pin", "-", 2, 19, 4),
    spec("motor_reset_pin", "-", 2, 255, 7),
    spec("motor_forward_level", "-", 0, 1, 1),
    spec("full_duty_speed_mm_s", "mm/s", 100, 20_000, 2_000),
    spec("encoder_pin", "-", 2, 3, 2),
    spec("encoder_b_pin", "-", 2, 255, 255),
    spec("encoder_tick_nm", "nm", 1_000, 100_000_000, 1_570_796),
    spec("speed_p", "1/1020/(m/s)", 0, 20_000, 255),
    spec("speed_i", "1/1020/m", 0, 20_000, 1_020),
    spec("speed_i_limit", "1/1020", 0, 1_020, 408),
    spec("lease_ramp_ms", "ms", 0, 1_000, 0),
    spec("acceleration_mm_s2", "mm/s2", 0, 20_000, 0),
    spec("motor_dead_duty", "1/1020", 0, 500, 0),
    spec("battery_pin", "-", 14, 255, 14),
    spec("battery_full_scale_mv", "mV", 1_000, 60_000, 15_000),
    spec("battery_low_mv", "mV", 0, 60_000, 6_400),
    spec("estop_pin", "-", 2, 255, 8),
    spec("estop_pressed_level", "-", 0, 1, 0),
];

impl Param {
    /// All of them, by index.
    pub const ALL: [Self; SPECS.len()] = [
        Self::ServoPin,
        Self::ServoRightUs,
        Self::ServoCenterUs,
        Self::ServoLeftUs,
        Self::SteeringLimitTenthMrad,
        Self::MotorPwmPin,
        Self::MotorDirectionPin,
        Self::MotorResetPin,
        Self::MotorForwardLevel,
        Self::FullDutySpeedMmS,
        Self::EncoderPin,
        Self::EncoderBPin,
        Self::EncoderTickNm,
        Self::SpeedP,
        Self::SpeedI,
        Self::SpeedILimit,
        Self::LeaseRampMs,
        Self::AccelerationMmS2,
        Self::MotorDeadDuty,
        Self::BatteryPin,
        Self::BatteryFullScaleMv,
        Self::BatteryLowMv,
        Self::EstopPin,
        Self::EstopPressedLevel,
    ];

    /// What it is.
    pub const fn spec(self) -> &'static Spec {
        &SPECS[self as usize]
    }

    /// The parameter of that name.
    pub fn of(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|param| param.spec().name == name)
    }

    /// Whether the chip takes this value. The same rules as in the firmware: each value for itself.
    pub fn allows(self, value: i32) -> bool {
        let Spec { min, max, .. } = *self.spec();
        let in_range = (min..=max).contains(&value);
        in_range
            && match self {
                Self::MotorPwmPin => PWM_PINS.contains(&value),
                Self::MotorResetPin | Self::EncoderBPin | Self::EstopPin => value <= 19 || value == NO_PIN,
                Self::BatteryPin => value <= 21 || value == NO_PIN,
                _ => true,
            }
    }

    /// What the chip takes, for people.
    pub fn allowed(self) -> String {
        let Spec { min, max, unit, .. } = *self.spec();
        match self {
            Self::MotorPwmPin => "3, 5, 6 or 11".to_owned(),
            Self::MotorResetPin | Self::EncoderBPin | Self::EstopPin => "2 to 19, or 255 for none".to_owned(),
            Self::BatteryPin => "14 to 21, or 255 for none".to_owned(),
            _ if unit == "-" => format!("{min} to {max}"),
            _ => format!("{min} to {max} {unit}"),
        }
    }

    const fn is_pin(self) -> bool {
        matches!(
            self,
            Self::ServoPin
                | Self::MotorPwmPin
                | Self::MotorDirectionPin
                | Self::MotorResetPin
                | Self::EncoderPin
                | Self::EncoderBPin
                | Self::BatteryPin
                | Self::EstopPin
        )
    }
}

/// The values of all parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Calibration([i32; SPECS.len()]);

impl Default for Calibration {
    /// What the firmware is built with.
    fn default() -> Self {
        Self(SPECS.map(|spec| spec.default))
    }
}

impl Calibration {
    /// A value.
    pub const fn get(&self, param: Param) -> i32 {
        self.0[param as usize]
    }

    /// Sets a value, if the chip would take it.
    pub fn set(&mut self, param: Param, value: i32) -> Result<(), CalibrationStatus> {
        if !param.allows(value) {
            return Err(CalibrationStatus::OutOfRange);
        }
        self.0[param as usize] = value;
        Ok(())
    }

    /// CRC-16 over all values, as it goes over the line.
    pub fn crc(&self) -> u16 {
        let bytes: Vec<u8> = self.0.iter().flat_map(|value| value.to_le_bytes()).collect();
        crate::codec::checksum(&bytes)
    }

    /// What does not go together, for people. Empty: all is well.
    pub fn problems(&self) -> Vec<String> {
        let mut problems: Vec<String> = Param::ALL
            .into_iter()
            .filter(|param| !param.allows(self.get(*param)))
            .map(|param| format!("{}: got {}, allowed is {}", param.spec().name, self.get(param), param.allowed()))
            .collect();
        let pins: Vec<Param> = Param::ALL.into_iter().filter(|param| param.is_pin()).collect();
        for (at, param) in pins.iter().enumerate() {
            let pin = self.get(*param);
            if SERIAL_PINS.contains(&pin) {
                problems.push(format!("{}: pin {pin} belongs to the serial line", param.spec().name));
            }
            let other = pins[..at].iter().find(|other| pin != NO_PIN && self.get(**other) == pin);
            if let Some(other) = other {
                problems.push(format!("{} and {}: both have pin {pin}", other.spec().name, param.spec().name));
            }
        }
        let pulses = [Param::ServoRightUs, Param::ServoCenterUs, Param::ServoLeftUs].map(|param| self.get(param));
        if !pulses.is_sorted_by(|a, b| a < b) && !pulses.is_sorted_by(|a, b| a > b) {
            let [right, center, left] = pulses;
            problems.push(format!(
                "servo: right {right}, centre {center}, left {left} us; the centre must lie between the two stops"
            ));
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = include_str!("../vectors/parameters.txt");

    #[test]
    fn the_table_is_that_of_the_firmware() {
        let lines: Vec<&str> = TABLE.lines().filter(|line| !line.starts_with('#') && !line.is_empty()).collect();
        let own: Vec<String> = Param::ALL
            .into_iter()
            .map(|param| {
                let Spec { name, unit, min, max, default } = *param.spec();
                format!("{} {name} {unit} {min} {max} {default}", param as u8)
            })
            .collect();
        assert_eq!(lines, own, "bridge/vectors/parameters.txt, line by line");
    }

    #[test]
    fn the_defaults_go_together_and_every_value_for_itself_is_checked() {
        let calibration = Calibration::default();
        assert_eq!(calibration.problems(), Vec::<String>::new(), "the defaults");
        for param in Param::ALL {
            let Spec { min, max, default, .. } = *param.spec();
            assert!(param.allows(default), "{param:?}: its default");
            let ends = [min - 1, max + 1, i32::MIN, i32::MAX];
            assert!(!ends.into_iter().any(|value| param.allows(value)), "{param:?}: beyond its range");
        }
        let refused = [(Param::MotorPwmPin, 4), (Param::EstopPin, 20), (Param::BatteryPin, 22), (Param::EncoderPin, 4)];
        for (param, value) in refused {
            assert!(!param.allows(value), "{param:?} = {value}: no such pin");
        }
    }

    #[test]
    fn what_does_not_go_together_is_named() {
        let mut calibration = Calibration::default();
        calibration.set(Param::EstopPin, 9).expect("a pin");
        calibration.set(Param::ServoCenterUs, 600).expect("a pulse");
        let problems = calibration.problems();
        assert_eq!(problems.len(), 2, "{problems:?}");
        assert!(problems[0].contains("servo_pin and estop_pin: both have pin 9"), "{problems:?}");
        assert!(problems[1].contains("right 635, centre 600, left 1465"), "{problems:?}");
        let mut reversed = Calibration::default();
        reversed.set(Param::ServoRightUs, 1_465).expect("a pulse");
        reversed.set(Param::ServoLeftUs, 635).expect("a pulse");
        assert!(reversed.problems().is_empty(), "a servo that is mounted the other way round");
    }

    #[test]
    fn the_crc_tells_calibrations_apart() {
        let (default, mut other) = (Calibration::default(), Calibration::default());
        assert_eq!(other.set(Param::ServoLeftUs, 3_000), Err(CalibrationStatus::OutOfRange), "refused");
        assert_eq!(other, default, "and nothing has changed");
        other.set(Param::ServoLeftUs, 1_466).expect("a pulse");
        assert_ne!(other.crc(), default.crc(), "one microsecond is seen");
    }
}
