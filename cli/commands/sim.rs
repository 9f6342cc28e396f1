//! `carril sim FILE`: runs the graph in lockstep, in virtual time, as fast as it goes; a summary at the end.

use std::cell::RefCell;
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Result, bail};
use carril_messages::{DecisionState, DriveState, Percentiles, TrackProgress};
use carril_runtime::Registry;
use carril_runtime::executor::lockstep::{Lockstep, LockstepFault, LockstepOptions, LockstepSummary, NodeSummary};
use carril_runtime::graph::Graph;
use carril_runtime::node::Published;
use clap::Args;
use serde::Serialize;

use crate::common::graph_file::{self, GraphArgs};
use crate::common::lockstep::{drive_on, newest};
use crate::common::report::Report;
use crate::common::wheel::{self, AgeMeter, WheelPath};
use crate::common::{interrupt, nodes, output, progress, time};

/// How the progress bar looks.
const BAR: &str = "{bar:40} {percent:>3} %  {elapsed_precise} (left {eta})  {msg}";

/// Arguments of `carril sim`.
#[derive(Args)]
#[command(
    after_help = "The same operators and the same file as `carril run`, on one thread, without Zenoh. Same file, same \
        seed, same bytes: `hash` covers every output of every node. Ctrl-C ends the run early, with the summary.

Examples:
  carril sim dataflow.yaml
  carril sim dataflow.yaml --seconds 120 --seed 7 --json | jq .hash
  carril sim dataflow.yaml --laps 5 --set decision.k_angle=1.2"
)]
pub struct SimArgs {
    #[command(flatten)]
    graph: GraphArgs,
    /// Virtual seconds to run
    #[arg(long, default_value_t = 60.0, value_parser = parse_seconds)]
    seconds: f64,
    /// Seed of noise and of generated tracks
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// End after N whole laps; exit code 1 when they are not done within --seconds
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    laps: Option<u32>,
    /// The summary as JSON
    #[arg(long)]
    json: bool,
}

fn parse_seconds(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "write a number of seconds, for example 120".to_owned())?;
    if seconds > 0.0 && seconds <= 1e6 { Ok(seconds) } else { Err("allowed is more than 0, up to 1000000".to_owned()) }
}

/// Runs it.
pub fn run(args: &SimArgs, registry: &Registry) -> Result<()> {
    let graph = graph_file::read(&args.graph, registry)?;
    let options = LockstepOptions { seed: args.seed, ..LockstepOptions::default() };
    let mut lockstep = Lockstep::new(&graph, options)?;
    let path = wheel::path(&graph);
    let ages = path.as_ref().map(|path| measure_ages(&mut lockstep, path)).transpose()?;
    drive_with_a_bar(&mut lockstep, &graph, args)?;
    let progress = referee(&lockstep, &graph);
    let decision = newest::<DecisionState>(&lockstep, &graph);
    let mut summary = Summary::new(&graph, lockstep.finish(), progress.as_deref(), decision.as_deref());
    summary.age_ms = ages.and_then(|ages| ages.borrow().total());
    summary.age_path = path.map(|path| path.to_string());
    if args.json {
        output::json(&summary)?;
    } else {
        output::text(summary.text())?;
    }
    match (args.laps, summary.laps) {
        (Some(wanted), None) => bail!("{wanted} laps were asked for, but no node of the graph counts laps"),
        (Some(wanted), Some(driven)) if driven < wanted => {
            bail!("drove {driven} of {wanted} laps within {:.0} s\nhint: allow more with --seconds", summary.seconds)
        }
        _ => Ok(()),
    }
}

/// Computing takes no time in lockstep (unless modelled): a command is as old at the wheel as when it is sent.
fn measure_ages(lockstep: &mut Lockstep, path: &WheelPath) -> Result<Rc<RefCell<AgeMeter>>> {
    let ages = Rc::new(RefCell::new(AgeMeter::new(path)));
    let meter = Rc::clone(&ages);
    let hear = move |sample: &Published| meter.borrow_mut().record(&sample.header, sample.header.stamp);
    lockstep.subscribe(&path.command.node, &path.command.port, hear)?;
    Ok(ages)
}

fn drive_with_a_bar(lockstep: &mut Lockstep, graph: &Graph, args: &SimArgs) -> Result<()> {
    let stopped = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&stopped);
    interrupt::on_interrupt(move || stop.store(true, Ordering::Relaxed))?;
    let bar = progress::bar((args.seconds * 10.0) as u64, BAR)?;
    drive_on(lockstep, graph, args.seconds, args.laps, &stopped, |lockstep, laps| {
        bar.set_position((lockstep.now().as_secs_f64() * 10.0) as u64);
        bar.set_message(laps.map(|laps| format!("lap {laps}")).unwrap_or_default());
        Ok(())
    })?;
    bar.finish_and_clear();
    Ok(())
}

fn referee(lockstep: &Lockstep, graph: &Graph) -> Option<Arc<TrackProgress>> {
    newest(lockstep, graph)
}

/// What came out of the run.
#[derive(Serialize)]
struct Summary {
    graph: PathBuf,
    seed: u64,
    /// Virtual time, s.
    seconds: f64,
    /// Real time, s.
    wall_s: f64,
    real_time_factor: f64,
    /// `null` here and below: the graph has no referee.
    laps: Option<u32>,
    last_lap_s: Option<f64>,
    distance_m: Option<f64>,
    departures: Option<u32>,
    cross_track_rms_m: Option<f32>,
    cross_track_max_m: Option<f32>,
    collisions: Option<u32>,
    red_runs: Option<u32>,
    stopped_before_line_m: Option<f32>,
    #[serde(skip)]
    progress: Option<TrackProgress>,
    /// What the decision node does at the end.
    state: Option<DriveState>,
    /// From exposure to wheel, along `age_path`.
    age_ms: Option<Percentiles>,
    age_path: Option<String>,
    overruns: u64,
    budget_violations: u64,
    errors: u64,
    steps: u64,
    /// Of every output of every node.
    hash: String,
    faults: Vec<LockstepFault>,
    nodes: Vec<NodeRow>,
}

#[derive(Serialize)]
struct NodeRow {
    node: String,
    operator: String,
    steps: u64,
    sent: u64,
    /// Real time of all steps, ms.
    cost_ms: f64,
    /// Real time of one step in the mean, µs.
    cost_us_per_step: f64,
    age_ms: Option<Percentiles>,
    overruns: u64,
    missed_periods: u64,
    errors: u64,
    last_error: Option<String>,
}

impl NodeRow {
    fn new(node: NodeSummary) -> Self {
        Self {
            node: node.node,
            operator: node.operator,
            steps: node.steps,
            sent: node.sent,
            cost_ms: node.cost_ns as f64 * 1e-6,
            cost_us_per_step: if node.steps > 0 { node.cost_ns as f64 * 1e-3 / node.steps as f64 } else { 0.0 },
            age_ms: node.age_ms,
            overruns: node.overruns,
            missed_periods: node.missed_periods,
            errors: node.errors,
            last_error: node.health.last_error,
        }
    }

    fn cells(&self) -> Vec<String> {
        let age = self.age_ms.map_or_else(|| "-".to_owned(), |age| nodes::pair(age, 1e-3));
        vec![
            self.node.clone(),
            self.operator.clone(),
            self.steps.to_string(),
            time::span(self.cost_ms * 1e-3),
            time::span(self.cost_us_per_step * 1e-6),
            age,
            (self.overruns + self.missed_periods).to_string(),
            self.errors.to_string(),
        ]
    }
}

impl Summary {
    fn new(
        graph: &Graph,
        lockstep: LockstepSummary,
        progress: Option<&TrackProgress>,
        decision: Option<&DecisionState>,
    ) -> Self {
        let sum = |count: fn(&NodeSummary) -> u64| lockstep.nodes.iter().map(count).sum();
        Self {
            graph: graph.path.clone(),
            seed: lockstep.seed,
            seconds: lockstep.virtual_s,
            wall_s: lockstep.wall_s,
            real_time_factor: lockstep.real_time_factor,
            laps: progress.map(|progress| progress.laps),
            last_lap_s: progress.and_then(|progress| progress.last_lap_s),
            distance_m: progress.map(|progress| progress.distance_m),
            departures: progress.map(|progress| progress.departures),
            cross_track_rms_m: progress.map(|progress| progress.cross_track_rms_m),
            cross_track_max_m: progress.map(|progress| progress.cross_track_max_m),
            collisions: progress.map(|progress| progress.collisions),
            red_runs: progress.map(|progress| progress.red_runs),
            stopped_before_line_m: progress.and_then(|progress| progress.stopped_before_line_m),
            progress: progress.copied(),
            state: decision.map(|decision| decision.state),
            age_ms: None,
            age_path: None,
            overruns: sum(|node| node.overruns),
            budget_violations: sum(|node| node.budget_violations),
            errors: sum(|node| node.errors),
            steps: lockstep.steps,
            hash: lockstep.hash,
            faults: lockstep.faults,
            nodes: lockstep.nodes.into_iter().map(NodeRow::new).collect(),
        }
    }

    fn text(&self) -> Report {
        let mut report = Report::default();
        report.fact("graph", format_args!("{}, seed {}", self.graph.display(), self.seed));
        let (virtual_time, real_time) = (time::span(self.seconds), time::span(self.wall_s));
        report.fact("time", format_args!("{virtual_time} in {real_time}: {:.1} x real time", self.real_time_factor));
        if let Some(progress) = &self.progress {
            report.progress(progress);
        }
        report.age(self.age_path.as_deref(), self.age_ms);
        if let Some(state) = self.state {
            report.fact("state", state.name());
        }
        let (overruns, late, errors) = (self.overruns, self.budget_violations, self.errors);
        report.fact("trouble", format_args!("{overruns} overruns, {late} samples over budget, {errors} errors"));
        for fault in &self.faults {
            report.fact("STOPPED", format_args!("at {}: {}: {}", fault.at, fault.node, fault.reason));
        }
        report.fact("hash", &self.hash);
        let columns = ["NODE", "OPERATOR", ">STEPS", ">COST", ">PER STEP", ">AGE p50/p99", ">OVERRUNS", ">ERRORS"];
        report.table(&columns, &self.nodes.iter().map(NodeRow::cells).collect::<Vec<_>>());
        for node in &self.nodes {
            if let Some(error) = &node.last_error {
                report.line(format_args!("{}: the last error: {error}", node.node));
            }
        }
        report
    }
}
