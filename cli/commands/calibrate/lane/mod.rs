//! `carril calibrate lane`: looks at frames of the track for whichever node finds the lane: the threshold that divides marking and floor
//! for `lane-detector`, how the camera looks at the floor for `lane-lines`.

mod camera;
mod threshold;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, anyhow, bail};
use carril_messages::Image;
use carril_operators::camera::FrameFiles;
use carril_operators::lane_detector::LaneDetector;
use carril_operators::lane_detector::survey::MAX_FRAMES;
use carril_operators::lane_lines::LaneLines;
use carril_runtime::{Operator, Registry};
use clap::Args;

use super::keep::KeepArgs;
use super::listen::{listen, parse_seconds};
use super::target::{Target, TargetArgs};
use crate::common::output;

/// Arguments of `carril calibrate lane`.
#[derive(Args)]
#[command(
    after_help = "For a `lane-detector`: the threshold between marking and floor. Let the car stand where it will drive, or better drive:
the more of the track it sees, the better. For a `lane-lines`: the camera's height and pitch. Let the car stand or drive in a
straight lane whose width is `lane_width_m`. Exit code 1 when the frames do not tell.

Examples:
  carril calibrate lane                               the camera of the running graph
  carril calibrate lane --seconds 20 --save
  carril calibrate lane --images frames/ --graph dataflow.yaml"
)]
pub struct LaneArgs {
    #[command(flatten)]
    target: TargetArgs,
    /// Port with the frames; default: the one that the node reads
    #[arg(long, value_name = "NODE/PORT", conflicts_with = "images")]
    from: Option<String>,
    /// How long to look, s
    #[arg(long, value_name = "S", default_value = "2", value_parser = parse_seconds, conflicts_with = "images")]
    seconds: Duration,
    /// Look at an image, a folder of images, a pattern (frames/*.png) or a video instead
    #[arg(long, value_name = "PATH")]
    images: Option<PathBuf>,
    #[command(flatten)]
    keep: KeepArgs,
}

/// Runs it.
pub fn run(args: &LaneArgs, registry: &Registry) -> Result<()> {
    let target = Target::find(&args.target, &[LaneDetector::KIND, LaneLines::KIND], registry)?;
    if target.operator == LaneLines::KIND {
        camera::run(args, &target, registry)
    } else {
        threshold::run(args, &target, registry)
    }
}

/// Shows frames to somebody, at most [`MAX_FRAMES`] of files. Where they are from.
fn look(args: &LaneArgs, target: &Target, mut see: impl FnMut(&Image)) -> Result<String> {
    if let Some(path) = &args.images {
        return look_at_files(&path.display().to_string(), see);
    }
    let Some(run) = &target.run else {
        bail!(
            "`--graph` reads a file, in which nothing moves\nhint: give --images PATH too, or leave --graph out while the graph runs"
        );
    };
    let from = args.from.clone().map_or_else(|| target.source_of("image"), Ok)?;
    listen(run, &from, args.seconds, |image: &Image| see(image))?;
    Ok(from)
}

fn look_at_files(path: &str, mut see: impl FnMut(&Image)) -> Result<String> {
    let hint = "an image, a folder of images, a pattern (frames/*.png) or a video";
    let frames = FrameFiles::open(path).map_err(|why| anyhow!("--images: {why}\nhint: give {hint}"))?;
    let (mut damaged, mut seen) = (Vec::new(), 0);
    for frame in frames {
        match frame {
            Ok(image) => {
                see(&image);
                seen += 1;
            }
            Err(damage) => damaged.push(damage),
        }
        if seen == MAX_FRAMES {
            eprintln!("note: looked at the first {MAX_FRAMES} frames of `{path}`");
            break;
        }
    }
    if let Some(first) = damaged.first() {
        let count = output::counted(damaged.len() as u64, "frame");
        if seen == 0 {
            bail!("--images: {first}\nhint: give {hint}");
        }
        eprintln!("warning: {count} left out, the first: {first}");
    }
    Ok(path.to_owned())
}
