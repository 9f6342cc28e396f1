//! `carril calibrate lidar`: how the lidar is mounted. A box is put beside the car, and where a return came nearer is where it stands.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, anyhow, bail};
use carril_messages::LaserScan;
use carril_operators::lidar_sectors::LidarSectorsConfig;
use carril_operators::lidar_sectors::orientation::{Block, Figures, Refusal, mounting_deg, what_came_nearer};
use carril_runtime::Registry;
use carril_runtime::graph::calibration::Subject;
use clap::{Args, ValueEnum};
use serde_json::{Map, Value, json};

use super::keep::{Found, KeepArgs, keep};
use super::listen::{listen, parse_seconds};
use super::target::{Target, TargetArgs};
use super::{dialogue, scans};
use crate::common::output;

/// A box is put down by hand, and lidars are mounted at right angles: nearer than this to one, it is taken, degrees.
const RIGHT_ANGLE_DEG: f64 = 10.0;

/// Arguments of `carril calibrate lidar`.
#[derive(Args)]
#[command(
    after_help = "It asks for an empty view, then for a box in front of the car, and finds the direction in which something came nearer. A box of
20 cm or more at half a metre does; nothing else should move. Exit code 1 when nothing, too much or several things moved.

Examples:
  carril calibrate lidar                                    asks, step by step
  carril calibrate lidar --where left
  carril calibrate lidar --wait-s 5 --save                  5 s to put the box there, no questions
  carril calibrate lidar --before empty.json --after box.json --graph dataflow.yaml"
)]
pub struct LidarArgs {
    #[command(flatten)]
    target: TargetArgs,
    /// Port with the scans; default: the one that the node reads
    #[arg(long, value_name = "NODE/PORT", conflicts_with_all = ["before", "after"])]
    from: Option<String>,
    /// Where the box stands, seen from the car
    #[arg(long = "where", value_name = "SIDE", default_value = "ahead")]
    side: Side,
    /// How long to look before, s
    #[arg(long, value_name = "S", default_value = "1", value_parser = parse_seconds, conflicts_with = "before")]
    before_s: Duration,
    /// Time to put the box there, s; without it, it waits for Enter
    #[arg(long, value_name = "S", value_parser = parse_seconds, conflicts_with = "before")]
    wait_s: Option<Duration>,
    /// How long to look after, s
    #[arg(long, value_name = "S", default_value = "1", value_parser = parse_seconds, conflicts_with = "before")]
    after_s: Duration,
    /// Scans without the box, as `carril echo world/scan --json` prints them
    #[arg(long, value_name = "FILE", requires = "after")]
    before: Option<PathBuf>,
    /// Scans with the box
    #[arg(long, value_name = "FILE", requires = "before")]
    after: Option<PathBuf>,
    /// Take the angle as measured, also near to a right angle
    #[arg(long)]
    exact: bool,
    #[command(flatten)]
    keep: KeepArgs,
}

/// Where a box stands.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Side {
    Ahead,
    Left,
    Right,
    Behind,
}

impl Side {
    /// Bearing in the body frame, degrees, + left.
    fn bearing_deg(self) -> f64 {
        match self {
            Self::Ahead => 0.0,
            Self::Left => 90.0,
            Self::Right => -90.0,
            Self::Behind => 180.0,
        }
    }

    fn words(self) -> &'static str {
        match self {
            Self::Ahead => "ahead of the car",
            Self::Left => "to the left of the car",
            Self::Right => "to the right of the car",
            Self::Behind => "behind the car",
        }
    }
}

/// Runs it.
pub fn run(args: &LidarArgs, registry: &Registry) -> Result<()> {
    let target = Target::find(&args.target, &["lidar-sectors"], registry)?;
    let config: LidarSectorsConfig = target.config()?;
    let [before, after] = look(args, &target)?;
    let (block, figures) =
        what_came_nearer(&before, &after, config.min_range_m).map_err(|why| anyhow!(refused(&why)))?;
    let measured = mounting_deg(block.bearing_deg, args.side.bearing_deg());
    let proposal = proposed(measured, args.exact);
    if !args.keep.json {
        output::text(told(&target.node, args.side, (&block, &figures), (measured, proposal), config.mounting_deg))?;
    }
    let found = Found {
        subject: Subject::Lidar,
        values: Map::from_iter([("mounting_deg".to_owned(), number(proposal))]),
        figures: recorded(args.side, &block, &figures, measured),
    };
    let saved = keep(&found, &target, &args.keep, registry)?;
    if args.keep.json {
        output::json(&json!({
            "node": target.node, "where": format!("{:?}", args.side).to_lowercase(), "nearer": block, "figures": figures,
            "in_force": config.mounting_deg, "measured_deg": measured, "mounting_deg": number(proposal), "saved": saved,
        }))?;
    }
    Ok(())
}

/// The scans before and after.
fn look(args: &LidarArgs, target: &Target) -> Result<[Vec<LaserScan>; 2]> {
    if let (Some(before), Some(after)) = (&args.before, &args.after) {
        return Ok([scans::read(before)?, scans::read(after)?]);
    }
    let Some(run) = &target.run else {
        bail!(
            "`--graph` reads a file, in which nothing moves\nhint: give --before FILE --after FILE too, or leave --graph out while the graph runs"
        );
    };
    let from = args.from.clone().map_or_else(|| target.source_of("scan"), Ok)?;
    let hear = |span| {
        let mut scans = Vec::new();
        listen(run, &from, span, |scan: &LaserScan| scans.push(scan.clone()))?;
        Ok::<_, anyhow::Error>(scans)
    };
    if args.wait_s.is_none() {
        dialogue::ask(&format!("Keep the space {} free, let the car stand, and press Enter.", args.side.words()))?;
    }
    let before = hear(args.before_s)?;
    let put = format!("Put a box half a metre {}, step back", args.side.words());
    match args.wait_s {
        Some(wait) => {
            // To standard error: what is asked for is the figures.
            eprintln!("{put}; {} s from now on.", wait.as_secs_f64());
            std::thread::sleep(wait);
        }
        None => drop(dialogue::ask(&format!("{put}, and press Enter."))?),
    }
    Ok([before, hear(args.after_s)?])
}

/// A right angle, where it is meant.
fn proposed(measured_deg: f64, exact: bool) -> f64 {
    let right = (measured_deg / 90.0).round() * 90.0;
    if !exact && (measured_deg - right).abs() <= RIGHT_ANGLE_DEG {
        return if right == -180.0 { 180.0 } else { right };
    }
    (measured_deg * 10.0).round() / 10.0
}

fn told(node: &str, side: Side, found: (&Block, &Figures), (measured, proposal): (f64, f64), in_force: f64) -> String {
    let (block, figures) = found;
    let before = block.before_m.map_or_else(|| "out of reach".to_owned(), |range| format!("{range:.2} m"));
    let scans =
        format!("{} before, {} after", output::counted(figures.scans_before as u64, "scan"), figures.scans_after);
    let mut text = format!(
        "{node}: {scans}; {}\na block {:.1}° wide came nearer at {:.1}° in the lidar's own frame: from {before} to {:.2} m\n\n",
        counts(figures),
        block.width_deg,
        block.bearing_deg,
        block.after_m,
    );
    let _ = write!(text, "proposal: {node}.mounting_deg {}, so that this is {}", number(proposal), side.words());
    if (measured - proposal).abs() > 0.05 {
        let _ = write!(text, " (measured {measured:.1}°; --exact takes that)");
    }
    let _ = writeln!(text, "; in force is {}", number(in_force));
    text
}

fn counts(figures: &Figures) -> String {
    let Figures { rays, compared, nearer, farther, .. } = figures;
    format!("of {rays} rays {compared} were compared, {nearer} came nearer, {farther} went farther")
}

/// What went wrong, with figures, and what helps.
fn refused(refusal: &Refusal) -> String {
    match refusal {
        Refusal::Scan(reason) => reason.clone(),
        Refusal::Nothing(figures) => format!(
            "nothing came nearer that could be a box: {}\n\
             hint: put a box of 20 cm or more at half a metre, as high as the lidar, and let the car stand",
            counts(figures)
        ),
        Refusal::TooMuch(figures) => format!(
            "too much has changed for a box: {}\nhint: let the car stand, step back, and put only the box there",
            counts(figures)
        ),
        Refusal::Several(figures, blocks) => {
            let [first, second] = &**blocks;
            format!(
                "several things came nearer: {} rays at {:.0}°, {} at {:.0}° (lidar frame); {}\n\
                 hint: step back, so that only the box has come",
                first.rays,
                first.bearing_deg,
                second.rays,
                second.bearing_deg,
                counts(figures)
            )
        }
    }
}

fn recorded(side: Side, block: &Block, figures: &Figures, measured: f64) -> Map<String, Value> {
    let rounded = |value: f64| (value * 100.0).round() / 100.0;
    let entries = [
        ("where", json!(format!("{side:?}").to_lowercase())),
        ("bearing_deg", rounded(block.bearing_deg).into()),
        ("width_deg", rounded(block.width_deg).into()),
        ("measured_deg", rounded(measured).into()),
        ("before_m", block.before_m.map_or(Value::Null, |range| rounded(range).into())),
        ("after_m", rounded(block.after_m).into()),
        ("nearer", figures.nearer.into()),
        ("rays", figures.rays.into()),
    ];
    entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

/// Whole numbers without `.0`.
fn number(value: f64) -> Value {
    if value.fract() == 0.0 { json!(value as i64) } else { json!(value) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn right_angles_are_taken_where_a_hand_could_have_meant_them() {
        let cases = [(176.3, 180.0), (-173.0, 180.0), (3.0, 0.0), (-88.0, -90.0), (45.04, 45.0), (101.0, 101.0)];
        for (measured, expected) in cases {
            assert_eq!(proposed(measured, false), expected, "{measured}");
        }
        assert_eq!(proposed(176.34, true), 176.3, "as measured");
    }

    #[test]
    fn refusals_have_figures_and_a_hint() {
        let figures = Figures { rays: 360, compared: 350, nearer: 2, farther: 1, ..Figures::default() };
        let text = refused(&Refusal::Nothing(figures));
        assert!(
            text.contains("of 360 rays 350 were compared, 2 came nearer, 1 went farther\nhint: put a box"),
            "{text}"
        );
        assert!(refused(&Refusal::TooMuch(figures)).contains("let the car stand"), "what helps");
    }
}
