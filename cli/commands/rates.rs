//! `carril hz`, `carril bw` and `carril delay`: one number stream each, second by second, of one or more ports.

use anyhow::Result;
use clap::Args;

use crate::common::live::Run;
use crate::common::output;
use crate::common::ports;
use crate::common::statistics::Summary;
use crate::common::watch::{self, Viewer, WatchArgs};

/// Arguments of all three.
#[derive(Args)]
pub struct RatesArgs {
    /// The ports, as `carril list` shows them
    #[arg(value_name = "NODE/PORT", required = true)]
    ports: Vec<String>,
    #[command(flatten)]
    watch: WatchArgs,
}

/// Examples of `carril hz`.
pub const HZ_HELP: &str = "One line a second and port; ends with the statistics of all it saw, also on Ctrl-C.

Examples:
  carril hz world/camera lane/lane
  carril hz lane/lane -n 300 --json | tail -n 1";
/// Examples of `carril bw`.
pub const BW_HELP: &str = "One line a second and port; ends with the statistics of all it saw, also on Ctrl-C.

Examples:
  carril bw world/camera
  carril bw world/camera world/scan --for 10s";
/// Examples of `carril delay`.
pub const DELAY_HELP: &str =
    "One line a second and port: time from publication to here, and from each exposure to here. Ends with the \
    statistics of all it saw, also on Ctrl-C.

Examples:
  carril delay actuator/command
  carril delay lane/lane decision/command --for 10s";

/// Which number is shown.
#[derive(Clone, Copy)]
pub enum Quantity {
    /// Samples per second.
    Rate,
    /// Bytes per second.
    Bandwidth,
    /// Time since publication and since exposure.
    Delay,
}

/// Runs it.
pub fn run(args: &RatesArgs, quantity: Quantity) -> Result<()> {
    let run = Run::connect(&args.watch.target)?;
    let ports = args.ports.iter().map(|name| ports::to_read(run.file(), name)).collect::<Result<Vec<_>>>()?;
    let width = args.ports.iter().map(String::len).max().unwrap_or(0);
    watch::watch(&run, &ports, &args.watch, &mut Rates { quantity, json: args.watch.json, width })
}

struct Rates {
    quantity: Quantity,
    json: bool,
    width: usize,
}

impl Rates {
    fn line(&self, window: &Summary) -> String {
        let numbers = match self.quantity {
            Quantity::Rate => window.rate_text(),
            Quantity::Bandwidth => window.bandwidth_text(),
            Quantity::Delay => window.delay_text(),
        };
        format!("{:<width$}  {numbers}", window.port, width = self.width)
    }
}

impl Viewer for Rates {
    const SAMPLES: bool = false;

    fn second(&mut self, windows: &[Summary]) -> Result<()> {
        for window in windows {
            if self.json { output::json_line(window)? } else { output::line(self.line(window))? }
        }
        Ok(())
    }
}
