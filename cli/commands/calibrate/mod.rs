//! `carril calibrate ...`: finds what is different from car to car and keeps it where it belongs.

mod chip;
mod dialogue;
mod encoder;
mod keep;
mod lane;
mod lidar;
mod listen;
mod scans;
mod servo;
mod target;

use anyhow::Result;
use carril_runtime::Registry;
use clap::{Args, Subcommand};

/// Arguments of `carril calibrate`.
#[derive(Args)]
pub struct CalibrateArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Show the calibration of a microcontroller
    Show(chip::ShowArgs),
    /// Change parameters of a microcontroller, and store them in it
    Set(chip::SetArgs),
    /// Write the calibration of a microcontroller into a file
    Backup(chip::BackupArgs),
    /// Store the calibration of a file in a microcontroller
    Restore(chip::RestoreArgs),
    /// Find the servo's stops and its centre
    Servo(servo::ServoArgs),
    /// Find how much road a tick of the encoder is
    Encoder(encoder::EncoderArgs),
    /// Find the threshold between marking and floor, or how the camera looks at the floor
    Lane(lane::LaneArgs),
    /// Find how the lidar is mounted, from what comes nearer
    Lidar(lidar::LidarArgs),
}

/// Runs it.
pub fn run(args: &CalibrateArgs, registry: &Registry) -> Result<()> {
    match &args.what {
        What::Show(args) => chip::show(args, registry),
        What::Set(args) => chip::set(args, registry),
        What::Backup(args) => chip::backup(args, registry),
        What::Restore(args) => chip::restore(args, registry),
        What::Servo(args) => servo::run(args, registry),
        What::Encoder(args) => encoder::run(args, registry),
        What::Lane(args) => lane::run(args, registry),
        What::Lidar(args) => lidar::run(args, registry),
    }
}
