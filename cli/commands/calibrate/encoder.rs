//! `carril calibrate encoder`: how much road is a tick? From several runs over a known distance, with a fit that a miscounted run
//! does not spoil.

use std::time::Duration;

use anyhow::{Result, anyhow, bail};
use carril_bridge::calibration::Param;
use carril_bridge::codec::{Drive, FULL_DUTY};
use carril_bridge::workbench::Workbench;
use carril_messages::car;
use carril_runtime::Registry;
use carril_runtime::graph::calibration::Subject;
use clap::Args;
use serde_json::{Map, Value, json};

use super::chip::{self, ChipArgs, Kept};
use super::dialogue;
use crate::common::output;

/// Runs that differ from the fit by more than this share of their distance are doubtful.
const DOUBTFUL: f64 = 0.02;
/// A run is left out when it is so many times farther off than runs usually are...
const OUTLIER_SIGMAS: f64 = 3.5;
/// ...but not for less than this share of its distance: people do not measure better.
const OUTLIER_SHARE: f64 = 0.005;
/// From so many runs on one can be told from the others.
const RUNS_TO_JUDGE: usize = 3;
/// From the median of the deviations to a standard deviation (Rousseeuw, Croux 1993, eq. 1.2).
const MAD_TO_SIGMA: f64 = 1.4826;

/// Arguments of `carril calibrate encoder`.
#[derive(Args)]
#[command(
    after_help = "By hand: push the car over a measured distance, or turn the driven wheel a number of turns, several
times. With --duty the motor turns the lifted wheels for --seconds, and you count their turns.

Examples:
  carril calibrate encoder --graph dataflows/hardware.yaml --distance-m 2
  carril calibrate encoder --port /dev/serial/by-id/... --turns 10 --runs 5
  carril calibrate encoder --port /dev/serial/by-id/... --duty 0.2 --seconds 5
  carril calibrate encoder --port /dev/serial/by-id/... --run 2:1273 --run 2:1275 --run 4:2547 --yes"
)]
pub struct EncoderArgs {
    #[command(flatten)]
    chip: ChipArgs,
    /// Distance of each run, m
    #[arg(long, value_name = "M", conflicts_with_all = ["turns", "duty", "run"])]
    distance_m: Option<f64>,
    /// Turns of the driven wheel in each run
    #[arg(long, value_name = "N", conflicts_with_all = ["duty", "run"])]
    turns: Option<f64>,
    /// The motor turns the lifted wheels with this share of full duty, -1 to 1
    #[arg(long, value_name = "SHARE", allow_hyphen_values = true, conflicts_with = "run")]
    duty: Option<f64>,
    /// For so long, s
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    seconds: f64,
    /// Diameter of the driven wheels, m
    #[arg(long, value_name = "M", default_value_t = car::WHEEL_DIAMETER_M)]
    wheel_diameter_m: f64,
    /// How many runs
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=50))]
    runs: u32,
    /// A run that was measured before: distance in m, and ticks; may be repeated
    #[arg(long, value_name = "M:TICKS", value_parser = run_of)]
    run: Vec<Measured>,
    /// Do not ask whether to store
    #[arg(long)]
    yes: bool,
}

/// A run.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Measured {
    distance_m: f64,
    ticks: u32,
}

fn run_of(text: &str) -> Result<Measured, String> {
    let measured = text.split_once(':').and_then(|(distance_m, ticks)| {
        let measured = Measured { distance_m: distance_m.trim().parse().ok()?, ticks: ticks.trim().parse().ok()? };
        (measured.distance_m > 0.0 && measured.distance_m < 1e4 && measured.ticks > 0).then_some(measured)
    });
    measured.ok_or_else(|| format!("got `{text}`, expected metres and ticks, both above 0, for example 2:1273"))
}

/// Road per tick from several runs.
#[derive(Clone, Debug, PartialEq)]
struct Fit {
    tick_m: f64,
    /// Of each run: what the fit says of its distance, less the distance, m.
    residuals_m: Vec<f64>,
    /// Of each run: whether it counts.
    counts: Vec<bool>,
}

/// Least squares through the origin over the runs that agree with each other. `None`: there is none.
fn fit(runs: &[Measured]) -> Option<Fit> {
    let ratios: Vec<f64> = runs.iter().map(|run| run.distance_m / f64::from(run.ticks)).collect();
    let first = median(&ratios)?;
    let off: Vec<f64> = ratios.iter().map(|ratio| (ratio / first - 1.0).abs()).collect();
    let limit = (OUTLIER_SIGMAS * MAD_TO_SIGMA * median(&off)?).max(OUTLIER_SHARE);
    let counts: Vec<bool> = off.iter().map(|off| runs.len() < RUNS_TO_JUDGE || *off <= limit).collect();
    let (mut product, mut square) = (0.0, 0.0);
    for (run, _) in runs.iter().zip(&counts).filter(|(_, counts)| **counts) {
        let ticks = f64::from(run.ticks);
        product += run.distance_m * ticks;
        square += ticks * ticks;
    }
    let tick_m = product / square;
    let residuals_m = runs.iter().map(|run| tick_m * f64::from(run.ticks) - run.distance_m).collect();
    tick_m.is_finite().then_some(Fit { tick_m, residuals_m, counts })
}

fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let upper = *sorted.get(sorted.len() / 2)?;
    Some(if sorted.len().is_multiple_of(2) { f64::midpoint(sorted[sorted.len() / 2 - 1], upper) } else { upper })
}

/// Runs it.
pub fn run(args: &EncoderArgs, registry: &Registry) -> Result<()> {
    let positive = [("--seconds", args.seconds), ("--wheel-diameter-m", args.wheel_diameter_m)];
    if let Some((name, got)) = positive.into_iter().find(|(_, value)| !(*value > 0.0 && *value < 1e3)) {
        bail!("{name}: got {got}, allowed is above 0 and below 1000");
    }
    if let Some(duty) = args.duty.filter(|duty| !(duty.abs() > 0.0 && duty.abs() <= 1.0)) {
        bail!("--duty: got {duty}, allowed is -1 to 1, and not 0");
    }
    let mut bench = args.chip.open(registry)?;
    let before = bench.read()?;
    let runs = if args.run.is_empty() { measure(args, &mut bench)? } else { args.run.clone() };
    let fit = fit(&runs).ok_or_else(|| anyhow!("there is no run"))?;
    report(&runs, &fit)?;
    let tick_nm = (fit.tick_m * 1e9).round();
    let mut wanted = before;
    wanted.set(Param::EncoderTickNm, tick_nm as i32).map_err(|_| {
        anyhow!(
            "a tick would be {tick_nm} nm of road, allowed is {}; nothing was stored",
            Param::EncoderTickNm.allowed()
        )
    })?;
    let doubtful = runs.iter().zip(&fit.residuals_m).zip(&fit.counts);
    let doubtful = doubtful.filter(|((run, off), counts)| **counts && off.abs() > DOUBTFUL * run.distance_m).count();
    if doubtful > 0 {
        let said = format!("{doubtful} of the runs are off by more than {} %; measure again", DOUBTFUL * 100.0);
        if args.yes {
            bail!("{said}; nothing was stored");
        }
        output::line(format_args!("warning: {said}"))?;
    }
    let measured: Vec<Value> =
        runs.iter().map(|run| json!({ "distance_m": run.distance_m, "ticks": run.ticks })).collect();
    let figures = Map::from_iter([("runs".to_owned(), Value::from(measured))]);
    let kept = Kept { chip: &args.chip, subject: Subject::Encoder, figures, yes: args.yes };
    chip::store(&mut bench, (&before, &wanted), kept, registry)
}

fn report(runs: &[Measured], fit: &Fit) -> Result<()> {
    let rows: Vec<Vec<String>> = runs
        .iter()
        .enumerate()
        .map(|(at, run)| {
            let per_tick_mm = run.distance_m / f64::from(run.ticks) * 1e3;
            let residual_mm = format!("{:+.1}", fit.residuals_m[at] * 1e3);
            let verdict = if fit.counts[at] { "" } else { "left out" };
            vec![
                (at + 1).to_string(),
                format!("{:.3}", run.distance_m),
                run.ticks.to_string(),
                format!("{per_tick_mm:.4}"),
                residual_mm,
                verdict.to_owned(),
            ]
        })
        .collect();
    output::text(output::table(&[">run", ">distance m", ">ticks", ">mm a tick", ">off by mm", ""], &rows))?;
    output::line(format_args!("a tick is {:.4} mm of road: {:.2} ticks a metre", fit.tick_m * 1e3, 1.0 / fit.tick_m))
}

fn measure(args: &EncoderArgs, bench: &mut Workbench) -> Result<Vec<Measured>> {
    let turn_m = args.wheel_diameter_m * std::f64::consts::PI;
    let mut runs = Vec::new();
    for number in 1..=args.runs {
        let measured = match (args.duty, args.turns) {
            (Some(duty), _) => driven(args, bench, duty, turn_m)?,
            (None, Some(turns)) => by_hand(bench, turns * turn_m, &format!("Turn the driven wheel {turns} times"))?,
            (None, None) => {
                let distance_m = args.distance_m.unwrap_or(1.0);
                by_hand(bench, distance_m, &format!("Push the car {distance_m} m straight ahead"))?
            }
        };
        output::line(format_args!("run {number} of {}: {} ticks", args.runs, measured.ticks))?;
        runs.push(measured);
    }
    Ok(runs)
}

fn by_hand(bench: &mut Workbench, distance_m: f64, what: &str) -> Result<Measured> {
    if !(distance_m > 0.0 && distance_m < 1e4) {
        bail!("the distance is {distance_m} m, allowed is above 0");
    }
    dialogue::ask("Put the car at its start, then press Enter.")?;
    let from = bench.newest_telemetry()?.ticks;
    dialogue::ask(&format!("{what}, then press Enter."))?;
    counted(bench.newest_telemetry()?.ticks.wrapping_sub(from), distance_m)
}

fn driven(args: &EncoderArgs, bench: &mut Workbench, duty: f64, turn_m: f64) -> Result<Measured> {
    let time = Duration::from_secs_f64(args.seconds);
    dialogue::ask(&format!(
        "Lift the driven wheels. They turn for {} s: count their turns. Enter starts.",
        args.seconds
    ))?;
    bench.clear_faults()?;
    let from = bench.newest_telemetry()?.ticks;
    bench.hold(0, Drive::Duty((duty * f64::from(FULL_DUTY)).round() as i16), time)?;
    bench.hold(0, Drive::Duty(0), Duration::from_millis(500))?;
    let ticks = bench.newest_telemetry()?.ticks.wrapping_sub(from);
    bench.release();
    let turns = dialogue::number("How many turns were it?", f64::NAN, (0.1, 1e4))?;
    if turns.is_nan() {
        bail!("without the number of turns there is nothing to compare with; nothing was stored");
    }
    counted(ticks, turns * turn_m)
}

fn counted(ticks: u32, distance_m: f64) -> Result<Measured> {
    if ticks == 0 {
        bail!("the encoder counted nothing; check its cable and the parameter encoder_pin");
    }
    Ok(Measured { distance_m, ticks })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs(all: &[(f64, u32)]) -> Vec<Measured> {
        all.iter().map(|(distance_m, ticks)| Measured { distance_m: *distance_m, ticks: *ticks }).collect()
    }

    #[test]
    fn a_miscounted_run_does_not_spoil_the_fit() {
        let good = fit(&runs(&[(2.0, 1_273), (2.0, 1_274), (4.0, 2_546), (2.0, 1_273)])).expect("there are runs");
        assert!((good.tick_m - 2.0 / 1_273.1).abs() < 2e-6, "got {} m a tick", good.tick_m);
        let spoilt = fit(&runs(&[(2.0, 1_273), (2.0, 1_274), (2.0, 1_400), (4.0, 2_546)])).expect("there are runs");
        assert_eq!(spoilt.counts, [true, true, false, true], "the third run is left out");
        assert!((spoilt.tick_m - good.tick_m).abs() < 1e-6, "got {} m a tick", spoilt.tick_m);
        assert!(spoilt.residuals_m[2] > 0.19, "and its residual is shown: {} m", spoilt.residuals_m[2]);
    }

    #[test]
    fn two_runs_are_no_judge_of_each_other() {
        let both = fit(&runs(&[(1.0, 600), (1.0, 660)])).expect("there are runs");
        assert_eq!(both.counts, [true, true], "nobody knows which is wrong");
        assert_eq!(fit(&[]), None, "no run, no fit");
    }

    #[test]
    fn runs_are_read_from_the_command_line() {
        assert_eq!(run_of("2:1273"), Ok(Measured { distance_m: 2.0, ticks: 1_273 }), "metres and ticks");
        for text in ["2", "2:", "0:5", "-1:5", "nan:5", "inf:5", "2:0", "2:-5", "2:1.5"] {
            assert!(run_of(text).is_err(), "`{text}`");
        }
    }
}
