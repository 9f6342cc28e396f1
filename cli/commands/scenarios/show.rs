//! `carril scenarios show`: one drive again, from its seed, with what was drawn, what the decision node did and why, and how it ended.

use std::cell::RefCell;
use std::path::PathBuf;
use std::process::ExitCode;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Result, bail};
use carril_runtime::Registry;
use carril_runtime::scenario::Drawn;
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use super::drive::{Change, Outcome, Timeline, drive};
use crate::common::report::Report;
use crate::common::{interrupt, output};

/// Arguments of `carril scenarios show`.
#[derive(Args)]
#[command(after_help = "The hash is that of the same drive in a series. Exit code 1: the drive fails.

Examples:
  carril scenarios show lanes --seed 6457827717110365317
  carril scenarios show lanes --seed 7 --json | jq .timeline")]
pub struct ShowArgs {
    /// The scenario file, or its name in scenarios/
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Seed of the drive, as a series names it
    #[arg(long)]
    seed: u64,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// A drive and its course.
#[derive(Serialize)]
struct Shown {
    #[serde(flatten)]
    outcome: Outcome,
    timeline: Vec<Change>,
}

/// Runs it.
pub fn run(args: &ShowArgs, registry: &Registry) -> Result<ExitCode> {
    let scenario = super::read(&args.file, registry)?;
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    interrupt::on_interrupt(move || stopped.store(true, Ordering::Relaxed))?;
    let mut timeline: Timeline = Rc::new(RefCell::new(Vec::new()));
    let Some(outcome) = drive(&scenario, None, args.seed, registry, &stop, &mut timeline) else {
        bail!("the drive was stopped before its end");
    };
    let shown = Shown { outcome, timeline: timeline.take() };
    if args.json {
        output::json(&shown)?;
    } else {
        output::text(shown.text(&scenario.path))?;
    }
    Ok(if shown.outcome.success { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

impl Shown {
    fn text(&self, path: &std::path::Path) -> Report {
        let outcome = &self.outcome;
        let mut report = Report::default();
        report.fact("scenario", format_args!("{}, seed of the drive {}", path.display(), outcome.seed));
        report.fact("time", format_args!("{:.1} s", outcome.seconds));
        if let (Some(laps), Some(distance_m)) = (outcome.laps, outcome.distance_m) {
            report.fact("laps", format_args!("{laps}, {distance_m:.2} m"));
        }
        let count = |number: Option<u32>| number.map_or_else(|| "-".to_owned(), |number| number.to_string());
        let (contacts, red_runs) = (count(outcome.contacts), count(outcome.red_runs));
        let departures = count(outcome.departures);
        report.fact("departures", format_args!("{departures}, contacts {contacts}, red runs {red_runs}"));
        if let (Some(rms_m), Some(max_m)) = (outcome.cross_track_rms_m, outcome.cross_track_max_m) {
            report.fact("cross-track", format_args!("rms {rms_m:.4} m, largest {max_m:.4} m"));
        }
        report.fact("hash", outcome.hash.as_deref().unwrap_or("-"));
        report.fact("verdict", if outcome.success { "success" } else { "FAILED" });
        for reason in &outcome.reasons {
            report.fact("reason", reason);
        }
        report.table(&["DRAWN", "VALUE"], &drawn_rows(&outcome.drawn));
        let row = |change: &Change| vec![format!("{:.2}", change.at_s), change.state.clone(), change.reason.clone()];
        let rows: Vec<_> = self.timeline.iter().map(row).collect();
        if !rows.is_empty() {
            report.table(&[">AT [s]", "STATE", "REASON"], &rows);
        }
        report
    }
}

fn drawn_rows(drawn: &Drawn) -> Vec<Vec<String>> {
    let values = drawn.values.iter().map(|(key, value)| vec![key.clone(), plain(value)]);
    let latency = drawn.latency_ms.iter().map(|(node, ms)| vec![format!("latency of {node}"), format!("{ms} ms")]);
    values.chain(latency).collect()
}

fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}
