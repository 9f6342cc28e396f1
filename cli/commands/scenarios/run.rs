//! `carril scenarios run`: the drives of a series, on several threads, in an order that does not matter for what comes out.

use std::collections::BTreeMap;
use std::fs::File;
use std::hash::{BuildHasher, RandomState};
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Instant;

use anyhow::{Context, Result};
use carril_runtime::Registry;
use carril_runtime::scenario::{Scenario, run_seed};
use clap::Args;

use super::drive::{Outcome, drive};
use super::summary::Summary;
use crate::common::{interrupt, output, progress};

/// Drives when nothing is said; one when they would all be the same.
const RUNS: u64 = 100;
/// How the progress bar looks.
const BAR: &str = "{bar:40} {pos}/{len}  {elapsed_precise} (left {eta})  {msg}";

/// Arguments of `carril scenarios run`.
#[derive(Args)]
#[command(
    after_help = "Ctrl-C ends the series early, with what is done so far. Exit code 1: fewer succeeded than required.

Examples:
  carril scenarios run scenarios/oval.yaml
  carril scenarios run lanes --runs 1000 --jobs 2 --out results.jsonl"
)]
pub struct RunArgs {
    /// The scenario file, or its name in scenarios/
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// How many drives [default: 100]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    runs: Option<u64>,
    /// Drives at the same time [default: one a processor]
    #[arg(long, value_name = "J", value_parser = clap::value_parser!(u64).range(1..=256))]
    jobs: Option<u64>,
    /// Seed of the series [default: another one each time]
    #[arg(long)]
    seed: Option<u64>,
    /// The summary as JSON
    #[arg(long)]
    json: bool,
    /// Write each drive as a line of JSON, in the order of the series
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// A series of drives.
struct Series<'a> {
    scenario: &'a Scenario,
    registry: &'a Registry,
    seed: u64,
    runs: u64,
    jobs: u64,
    stop: Arc<AtomicBool>,
}

/// Runs it.
pub fn run(args: &RunArgs, registry: &Registry) -> Result<ExitCode> {
    let scenario = super::read(&args.file, registry)?;
    let seed = args.seed.unwrap_or_else(|| RandomState::new().hash_one(0) >> 32);
    let runs = args.runs.unwrap_or(if scenario.varies() { RUNS } else { 1 });
    let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get() as u64);
    let jobs = args.jobs.unwrap_or(cores).min(runs);
    let mut out = args.out.as_ref().map(create).transpose()?;
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    interrupt::on_interrupt(move || stopped.store(true, Ordering::Relaxed))?;
    let began = Instant::now();
    let series = Series { scenario: &scenario, registry, seed, runs, jobs, stop };
    let outcomes = series.drive(&mut |outcome| match &mut out {
        Some(out) => write_line(out, outcome),
        None => Ok(()),
    })?;
    if let Some(mut out) = out {
        out.flush().context("cannot write the results")?;
    }
    let summary = Summary::new(&scenario, seed, runs, &outcomes, began.elapsed().as_secs_f64());
    if args.json {
        output::json(&summary)?;
    } else {
        output::text(summary.text())?;
    }
    Ok(if summary.passed() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn create(path: &PathBuf) -> Result<BufWriter<File>> {
    let file = File::create(path).with_context(|| format!("cannot write `{}`", path.display()))?;
    Ok(BufWriter::new(file))
}

fn write_line(out: &mut BufWriter<File>, outcome: &Outcome) -> Result<()> {
    serde_json::to_writer(&mut *out, outcome).context("cannot write the results")?;
    out.write_all(b"\n").context("cannot write the results")
}

impl Series<'_> {
    /// Drives all of them and calls `done` with each, in the order of the series. After Ctrl-C: with those that were done.
    fn drive(&self, done: &mut dyn FnMut(&Outcome) -> Result<()>) -> Result<Vec<Outcome>> {
        let next = AtomicU64::new(0);
        let (sender, receiver) = mpsc::channel();
        std::thread::scope(|scope| {
            for _ in 0..self.jobs {
                let (sender, next) = (sender.clone(), &next);
                scope.spawn(move || self.work(next, &sender));
            }
            drop(sender);
            let collected = self.collect(&receiver, done);
            // Nobody listens any more: what is left need not be driven.
            self.stop.store(true, Ordering::Relaxed);
            collected
        })
    }

    /// What one thread does.
    fn work(&self, next: &AtomicU64, sender: &mpsc::Sender<(u64, Outcome)>) {
        while !self.stop.load(Ordering::Relaxed) {
            let run = next.fetch_add(1, Ordering::Relaxed);
            if run >= self.runs {
                return;
            }
            let seed = run_seed(self.seed, run);
            let Some(outcome) = drive(self.scenario, Some(run), seed, self.registry, &self.stop, &mut ()) else {
                return;
            };
            if sender.send((run, outcome)).is_err() {
                return;
            }
        }
    }

    fn collect(
        &self,
        receiver: &mpsc::Receiver<(u64, Outcome)>,
        done: &mut dyn FnMut(&Outcome) -> Result<()>,
    ) -> Result<Vec<Outcome>> {
        let bar = progress::bar(self.runs, BAR)?;
        let mut waiting: BTreeMap<u64, Outcome> = BTreeMap::new();
        let (mut outcomes, mut failed) = (Vec::new(), 0_u64);
        for (run, outcome) in receiver {
            failed += u64::from(!outcome.success);
            bar.inc(1);
            bar.set_message(format!("{failed} failed"));
            waiting.insert(run, outcome);
            while let Some(outcome) = waiting.remove(&(outcomes.len() as u64)) {
                done(&outcome)?;
                outcomes.push(outcome);
            }
        }
        bar.finish_and_clear();
        // After Ctrl-C, a drive before these may be missing.
        for outcome in waiting.into_values() {
            done(&outcome)?;
            outcomes.push(outcome);
        }
        Ok(outcomes)
    }
}

#[cfg(test)]
mod tests {
    use carril_runtime::{
        Context, Findings, NoInputs, NoOutputs, NoState, Operator, OperatorConfig, Setup, SetupError, StateError,
        StepError,
    };
    use serde::{Deserialize, Serialize};

    use super::*;

    #[derive(Debug, Default, Serialize, Deserialize, schemars::JsonSchema)]
    #[serde(default, deny_unknown_fields)]
    struct FuseConfig {
        blows: u32,
    }

    impl OperatorConfig for FuseConfig {
        fn check(&self, _: &mut Findings<'_>) {}
    }

    /// Panics at its first step when it is told to.
    struct Fuse(FuseConfig);

    impl Operator for Fuse {
        const KIND: &'static str = "fuse";
        const SUMMARY: &'static str = "Panics";
        type Config = FuseConfig;
        type Inputs = NoInputs;
        type Outputs = NoOutputs;
        type State = NoState;

        fn new(config: FuseConfig, _: &Setup) -> Result<Self, SetupError> {
            Ok(Self(config))
        }

        fn step(&mut self, _: &mut NoInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
            assert!(self.0.blows == 0, "blown");
            Ok(())
        }

        fn snapshot(&self) -> NoState {
            NoState
        }

        fn restore(&mut self, _: NoState) -> Result<(), StateError> {
            Ok(())
        }

        fn period(_: &FuseConfig) -> Option<std::time::Duration> {
            Some(std::time::Duration::from_millis(10))
        }
    }

    #[test]
    fn a_drive_that_panics_has_failed_and_the_series_goes_on() {
        let folder = tempfile::tempdir().expect("a folder");
        let graph = "robot: car1\nnodes:\n  one: { operator: fuse }\n";
        std::fs::write(folder.path().join("g.yaml"), graph).expect("written");
        let text = "graph: g.yaml\nseconds: 0.1\nvary: { one.blows: { integer: [0, 1] } }\n";
        let registry = Registry::new().with::<Fuse>();
        let scenario = Scenario::parse(text.to_owned(), &folder.path().join("s.yaml"), &registry)
            .unwrap_or_else(|problems| panic!("{}", problems.render(false)));
        let stop = Arc::new(AtomicBool::new(false));
        let series = Series { scenario: &scenario, registry: &registry, seed: 3, runs: 12, jobs: 2, stop };
        let outcomes = series.drive(&mut |_| Ok(())).expect("it goes to its end");
        assert_eq!(outcomes.len(), 12, "every drive has an outcome");
        let blows = |outcome: &&Outcome| outcome.drawn.values["one.blows"] == 1;
        let (blown, whole): (Vec<_>, Vec<_>) = outcomes.iter().partition(blows);
        assert!(!blown.is_empty() && !whole.is_empty(), "both kinds were drawn: {} blown", blown.len());
        for outcome in blown {
            assert!(!outcome.success && outcome.reasons[0].contains("blown"), "{:?}", outcome.reasons);
        }
        // Nobody judges this graph: that is another failure, at the end of the drive.
        assert!(whole.iter().all(|outcome| !outcome.reasons[0].contains("blown")), "the others drove on");
    }
}
