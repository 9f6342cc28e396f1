//! `carril watch`: swaps a binary in whenever it was built anew.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime};

use anyhow::{Context, Result};
use carril_runtime::control_plane::{Change, SwapRequest, SwapTerms};
use clap::Args;

use crate::commands::swap;
use crate::common::live::Run;
use crate::common::way::Target;
use crate::common::{assignments, interrupt, output};

/// How often the file is looked at.
const LOOK: Duration = Duration::from_millis(200);

/// Arguments of `carril watch`.
#[derive(Args)]
#[command(
    after_help = "Swaps each new build in as `carril swap` does; one that fails changes nothing. Ends with Ctrl-C; the last version that
went through stays.

Examples:
  carril watch lane --exec ./target/release/my-lane
  cargo watch -x 'build --release'        # in another terminal"
)]
pub struct WatchArgs {
    /// The node
    #[arg(value_name = "NODE")]
    node: String,
    /// A binary of your own with the same ports
    #[arg(long, value_name = "PATH")]
    exec: PathBuf,
    /// Values in its configuration; may be given several times
    #[arg(long = "set", value_name = "PATH=VALUE[,...]")]
    values: Vec<String>,
    /// Begin each version without the state of the one before
    #[arg(long)]
    fresh: bool,
    /// The receipts as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// What tells one build from the next.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Build {
    modified: SystemTime,
    bytes: u64,
}

/// `None`: it is not there now, as while it is being linked.
fn build_of(path: &Path) -> Option<Build> {
    let metadata = std::fs::metadata(path).ok()?;
    Some(Build { modified: metadata.modified().ok()?, bytes: metadata.len() })
}

/// Runs it.
pub fn run(args: &WatchArgs) -> Result<()> {
    let run = Run::connect(&args.target)?;
    let path = std::path::absolute(&args.exec).with_context(|| format!("`{}`", args.exec.display()))?;
    let values = assignments::parse(&args.values)?;
    let interrupted = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&interrupted);
    interrupt::on_interrupt(move || flag.store(true, Ordering::Relaxed))?;
    let mut last = build_of(&path);
    if !args.json {
        let there = if last.is_some() { "" } else { ", which is not there yet" };
        output::line(format!("watching `{}`{there}; Ctrl-C ends it", path.display()))?;
    }
    let mut seen = last;
    while !interrupted.load(Ordering::Relaxed) && run.is_alive() {
        std::thread::sleep(LOOK);
        let now = build_of(&path);
        // A linker writes for a while: only what looks the same twice is complete.
        if now.is_some() && now == seen && now != last {
            last = now;
            let terms = SwapTerms { fresh: args.fresh, ..SwapTerms::default() };
            let (node, exec, values) = (args.node.clone(), Some(path.clone()), values.clone());
            let receipt = run.change(&Change::Swap(SwapRequest { node, exec, values, terms, operator: None }))?;
            swap::write(&receipt, args.json)?;
        }
        seen = now;
    }
    Ok(())
}
