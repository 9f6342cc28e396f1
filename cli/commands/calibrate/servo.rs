//! `carril calibrate servo`: the servo is moved to its centre and both stops, and the three pulses are stored in the chip.

use std::time::Duration;

use anyhow::{Result, anyhow};
use carril_bridge::calibration::{Calibration, Param};
use carril_bridge::codec::Drive;
use carril_bridge::workbench::Workbench;
use carril_runtime::Registry;
use carril_runtime::graph::calibration::Subject;
use clap::Args;
use serde_json::Map;

use super::chip::{self, ChipArgs, Kept};
use super::dialogue;
use crate::common::output;

/// Shortest and longest pulse that any servo is told, µs.
const PULSES: (i32, i32) = (500, 2_500);
/// Steps of `+` and `++`, µs.
const STEP_US: i32 = 10;
const LEAP_US: i32 = 50;
/// A servo reaches its place within this time; then it holds it by itself.
const MOVE: Duration = Duration::from_millis(300);

/// Arguments of `carril calibrate servo`.
#[derive(Args)]
#[command(
    after_help = "Without pulses it asks: the servo moves, you say where the stops are. With all of them it asks only
whether to store them, and with --yes not even that.

Examples:
  carril calibrate servo --graph dataflows/hardware.yaml
  carril calibrate servo --port /dev/serial/by-id/... --right-us 640 --center-us 1048 --left-us 1460 --limit-deg 20 --yes"
)]
pub struct ServoArgs {
    #[command(flatten)]
    chip: ChipArgs,
    /// Pulse at the right stop, us
    #[arg(long, value_name = "US", requires_all = ["center_us", "left_us"])]
    right_us: Option<i32>,
    /// Pulse with the wheels straight, us
    #[arg(long, value_name = "US", requires_all = ["right_us", "left_us"])]
    center_us: Option<i32>,
    /// Pulse at the left stop, us
    #[arg(long, value_name = "US", requires_all = ["right_us", "center_us"])]
    left_us: Option<i32>,
    /// Road-wheel angle at the stops, degrees
    #[arg(long, value_name = "DEG")]
    limit_deg: Option<f64>,
    /// Do not ask whether to store
    #[arg(long)]
    yes: bool,
}

/// Runs it.
pub fn run(args: &ServoArgs, registry: &Registry) -> Result<()> {
    let mut bench = args.chip.open(registry)?;
    let before = bench.read()?;
    let mut wanted = before;
    let pulses = if let (Some(right), Some(center), Some(left)) = (args.right_us, args.center_us, args.left_us) {
        [right, center, left]
    } else {
        let found = find(&mut bench, &before);
        // Whatever happened, the wide range of the search must not stay in force.
        let restored = bench.write(&before);
        let found = found?;
        restored?;
        found
    };
    let params = [Param::ServoRightUs, Param::ServoCenterUs, Param::ServoLeftUs];
    for (param, pulse) in params.into_iter().zip(pulses) {
        put(&mut wanted, param, pulse)?;
    }
    let known_deg = degrees(before.get(Param::SteeringLimitTenthMrad));
    let limit_deg = match (args.limit_deg, args.right_us) {
        (Some(limit_deg), _) => limit_deg,
        (None, Some(_)) => known_deg,
        (None, None) => dialogue::number(
            &format!("Angle of the wheels at the stops, degrees [{known_deg:.1}]:"),
            known_deg,
            (1.0, 45.0),
        )?,
    };
    put(&mut wanted, Param::SteeringLimitTenthMrad, (limit_deg.to_radians() * 10_000.0).round() as i32)?;
    let kept = Kept { chip: &args.chip, subject: Subject::Servo, figures: Map::new(), yes: args.yes };
    chip::store(&mut bench, (&before, &wanted), kept, registry)
}

fn put(calibration: &mut Calibration, param: Param, value: i32) -> Result<()> {
    let refused = |_| anyhow!("{}: got {value}, allowed is {}", param.spec().name, param.allowed());
    calibration.set(param, value).map_err(refused)
}

fn degrees(tenth_mrad: i32) -> f64 {
    (f64::from(tenth_mrad) / 10_000.0).to_degrees()
}

/// Moves the servo as the person says: pulses of right stop, centre, left stop.
fn find(bench: &mut Workbench, before: &Calibration) -> Result<[i32; 3]> {
    output::line(
        "The motor stays off; only the steering moves. Lift the front wheels, and stop before the servo hums at a stop.",
    )?;
    output::line(format_args!(
        "+ and - move by {STEP_US} us, ++ and -- by {LEAP_US} us, a number goes there, Enter takes what is shown."
    ))?;
    bench.clear_faults()?;
    let mut wide = *before;
    put(&mut wide, Param::ServoRightUs, PULSES.0)?;
    put(&mut wide, Param::ServoCenterUs, i32::midpoint(PULSES.0, PULSES.1))?;
    put(&mut wide, Param::ServoLeftUs, PULSES.1)?;
    bench.write(&wide)?;
    let limit = wide.get(Param::SteeringLimitTenthMrad);
    let center = step_to(bench, limit, "centre", before.get(Param::ServoCenterUs))?;
    let right = step_to(bench, limit, "right stop", before.get(Param::ServoRightUs))?;
    let left = step_to(bench, limit, "left stop", before.get(Param::ServoLeftUs))?;
    step(bench, limit, center)?;
    Ok([right, center, left])
}

fn step_to(bench: &mut Workbench, limit: i32, place: &str, from_us: i32) -> Result<i32> {
    let mut pulse_us = from_us;
    loop {
        step(bench, limit, pulse_us)?;
        let answer = dialogue::ask(&format!("{place}: {pulse_us} us >"))?;
        let Some(next_us) = moved(pulse_us, &answer) else {
            output::line(format_args!("got `{answer}`, allowed are +, -, ++, --, {} to {}", PULSES.0, PULSES.1))?;
            continue;
        };
        if answer.is_empty() {
            return Ok(pulse_us);
        }
        pulse_us = next_us;
    }
}

/// Where the servo goes after an answer. `None`: it makes no sense.
fn moved(pulse_us: i32, answer: &str) -> Option<i32> {
    let next_us = match answer {
        "" => pulse_us,
        "+" => pulse_us + STEP_US,
        "-" => pulse_us - STEP_US,
        "++" => pulse_us + LEAP_US,
        "--" => pulse_us - LEAP_US,
        number => number.parse().ok()?,
    };
    (PULSES.0..=PULSES.1).contains(&next_us).then_some(next_us)
}

/// Moves the servo there. The session ends in order, so that the servo holds its place while the person looks.
fn step(bench: &mut Workbench, limit: i32, pulse_us: i32) -> Result<()> {
    let half_us = f64::from(PULSES.1 - PULSES.0) / 2.0;
    let share = (f64::from(pulse_us - PULSES.0) - half_us) / half_us;
    bench.greet(MOVE)?;
    bench.hold((share * f64::from(limit)).round() as i16, Drive::Duty(0), MOVE)?;
    bench.release();
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_move_the_servo_within_its_limits() {
        let cases = [
            ("", Some(1_000)),
            ("+", Some(1_010)),
            ("-", Some(990)),
            ("++", Some(1_050)),
            ("--", Some(950)),
            ("640", Some(640)),
            ("499", None),
            ("2501", None),
            ("left", None),
            ("1e3", None),
        ];
        for (answer, expected) in cases {
            assert_eq!(moved(1_000, answer), expected, "`{answer}` at 1000 us");
        }
        assert_eq!(moved(2_490, "++"), None, "not beyond the longest pulse");
    }
}
