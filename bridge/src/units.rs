//! Between SI units and the integers of the serial line. Rounds to the nearest, saturates at the integers' ends.

use carril_messages::WheelTelemetry;

use crate::calibration::{Calibration, Param};
use crate::codec::Telemetry;

/// rad to 0.1 mrad. The caller has made sure that the number is finite.
pub fn tenth_mrad_of_rad(angle_rad: f32) -> i16 {
    (angle_rad * 10_000.0).round() as i16
}

/// 0.1 mrad to rad.
pub fn rad_of_tenth_mrad(angle_tenth_mrad: i16) -> f32 {
    f32::from(angle_tenth_mrad) / 10_000.0
}

/// m/s to mm/s. The caller has made sure that the number is finite.
pub fn mm_s_of_m_s(speed_m_s: f32) -> i16 {
    (speed_m_s * 1_000.0).round() as i16
}

/// mm/s to m/s.
pub fn m_s_of_mm_s(speed_mm_s: i16) -> f32 {
    f32::from(speed_mm_s) / 1_000.0
}

/// Road-wheel angle to servo pulse, µs: a straight line from the centre to either stop, beyond which it does not go.
pub fn servo_us_of_rad(angle_rad: f32, calibration: &Calibration) -> u16 {
    let limit_rad = f64::from(calibration.get(Param::SteeringLimitTenthMrad)) / 10_000.0;
    let share = (f64::from(angle_rad) / limit_rad).clamp(-1.0, 1.0);
    let center_us = f64::from(calibration.get(Param::ServoCenterUs));
    let stop = if share < 0.0 { Param::ServoRightUs } else { Param::ServoLeftUs };
    (center_us + (f64::from(calibration.get(stop)) - center_us) * share.abs()).round() as u16
}

/// Telemetry in SI units, with what this side knows of the line: the round trip, reports lost, frames damaged here.
pub fn wheel_telemetry(
    telemetry: &Telemetry,
    round_trip_us: Option<u32>,
    (frames_lost, damaged_here): (u64, u64),
) -> WheelTelemetry {
    WheelTelemetry {
        ticks: telemetry.ticks,
        tick_period_us: telemetry.tick_period_us,
        speed_m_s: m_s_of_mm_s(telemetry.speed_mm_s),
        steering_rad: rad_of_tenth_mrad(telemetry.steering_tenth_mrad),
        battery_v: telemetry.battery_mv.map(|millivolts| f32::from(millivolts) / 1_000.0),
        faults: telemetry.faults,
        driving: telemetry.driving,
        last_command_seq: telemetry.last_command.map(|last| last.seq),
        round_trip_us,
        frames_lost: frames_lost as u32,
        frames_damaged: (damaged_here as u32).wrapping_add(telemetry.damaged_frames.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_servo_reaches_its_stops_and_not_beyond() {
        let limit = carril_messages::car::STEERING_LIMIT_RAD as f32;
        let mut calibration = Calibration::default();
        let pulses = [-9.0, -limit, 0.0, limit, 9.0].map(|rad| servo_us_of_rad(rad, &calibration));
        assert_eq!(pulses, [635, 635, 1050, 1465, 1465], "right is the short pulse, µs");
        calibration.set(Param::ServoCenterUs, 1_000).expect("a pulse");
        let pulses = [-limit / 2.0, 0.0, limit / 2.0].map(|rad| servo_us_of_rad(rad, &calibration));
        assert_eq!(pulses, [818, 1_000, 1_232], "each side has a slope of its own, µs");
    }

    #[test]
    fn numbers_saturate_instead_of_wrapping() {
        assert_eq!(mm_s_of_m_s(1e9), i16::MAX, "an absurd speed keeps its sign");
        assert_eq!(tenth_mrad_of_rad(-1e9), i16::MIN, "and an absurd angle");
        assert_eq!(tenth_mrad_of_rad(rad_of_tenth_mrad(-3_491)), -3_491, "there and back");
    }
}
