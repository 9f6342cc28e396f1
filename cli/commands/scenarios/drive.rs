//! One drive of a scenario: from its seed to what it came to. Never prints, never panics: what goes wrong is a drive that failed.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Result, bail};
use carril_messages::{DecisionState, DriveState, TrackProgress};
use carril_runtime::Registry;
use carril_runtime::executor::lockstep::{Lockstep, LockstepFault, LockstepOptions};
use carril_runtime::graph::Graph;
use carril_runtime::node::Published;
use carril_runtime::scenario::{Drawn, Scenario, Success};
use serde::Serialize;

use crate::common::lockstep::{drive_on, newest, source};

/// What a drive came to.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Its number in the series, from 0. `None`: it was driven alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub run: Option<u64>,
    /// The drive can be repeated from it.
    pub seed: u64,
    pub success: bool,
    /// Why it failed.
    pub reasons: Vec<String>,
    /// Virtual time, s.
    pub seconds: f64,
    /// What the referee says at the end. `None`: the graph has none, or nothing was driven.
    pub laps: Option<u32>,
    pub distance_m: Option<f64>,
    pub departures: Option<u32>,
    pub contacts: Option<u32>,
    pub red_runs: Option<u32>,
    pub cross_track_rms_m: Option<f32>,
    pub cross_track_max_m: Option<f32>,
    /// What the decision node does at the end, and why.
    pub state: Option<String>,
    pub state_reason: Option<String>,
    /// Of every output of every node.
    pub hash: Option<String>,
    /// What was drawn.
    pub drawn: Drawn,
}

/// The decision node goes over to another state.
#[derive(Clone, Debug, Serialize)]
pub struct Change {
    /// Virtual time, s.
    pub at_s: f64,
    pub state: String,
    pub reason: String,
}

/// Where the changes of a drive are written to.
pub type Timeline = Rc<RefCell<Vec<Change>>>;

/// Looks on while a drive goes on, and changes nothing about it: it only takes what nodes send anyway.
pub trait Onlooker {
    /// Before the first step.
    fn begin(&mut self, _lockstep: &mut Lockstep, _graph: &Graph) -> Result<()> {
        Ok(())
    }

    /// After each tenth of a second.
    fn look(&mut self, _lockstep: &Lockstep, _graph: &Graph) -> Result<()> {
        Ok(())
    }
}

/// Nobody looks on.
impl Onlooker for () {}

/// Writes the changes down.
impl Onlooker for Timeline {
    fn begin(&mut self, lockstep: &mut Lockstep, graph: &Graph) -> Result<()> {
        write_changes(lockstep, graph, self)
    }
}

/// The end of a drive, before it is judged.
struct End {
    seconds: f64,
    progress: Option<TrackProgress>,
    decision: Option<DecisionState>,
    faults: Vec<String>,
    hash: String,
}

/// Drives once. `None`: it was stopped before its end.
pub fn drive(
    scenario: &Scenario,
    run: Option<u64>,
    seed: u64,
    registry: &Registry,
    stop: &AtomicBool,
    onlooker: &mut dyn Onlooker,
) -> Option<Outcome> {
    let drawn = scenario.draw(seed);
    let ended = catch_unwind(AssertUnwindSafe(|| drive_to_the_end(scenario, &drawn, seed, registry, stop, onlooker)));
    let ended = match ended {
        Ok(Ok(None)) => return None,
        Ok(Ok(Some(end))) => Ok(end),
        Ok(Err(error)) => Err(format!("{error:#}")),
        Err(_) => Err("the drive panicked".to_owned()),
    };
    Some(judge(scenario, run, seed, drawn, ended))
}

fn drive_to_the_end(
    scenario: &Scenario,
    drawn: &Drawn,
    seed: u64,
    registry: &Registry,
    stop: &AtomicBool,
    onlooker: &mut dyn Onlooker,
) -> Result<Option<End>> {
    let graph = match scenario.graph_of(drawn, registry) {
        Ok(graph) => graph,
        Err(problems) => {
            let first = problems.first_error().map(|problem| format!("{}: {}", problem.file, problem.message));
            bail!("the graph refuses what was drawn: {}", first.unwrap_or_default());
        }
    };
    let options = LockstepOptions { seed: scenario.noise_seed(seed), ..LockstepOptions::default() };
    let mut lockstep = Lockstep::new(&graph, options)?;
    onlooker.begin(&mut lockstep, &graph)?;
    let mut look = |lockstep: &Lockstep, _| onlooker.look(lockstep, &graph);
    drive_on(&mut lockstep, &graph, scenario.seconds, scenario.laps, stop, &mut look)?;
    if stop.load(Ordering::Relaxed) {
        return Ok(None);
    }
    let end = so_far(&lockstep, &graph);
    Ok(Some(End { hash: lockstep.finish().hash, ..end }))
}

/// How a drive stands now. Without a hash: that is there at the end only.
fn so_far(lockstep: &Lockstep, graph: &Graph) -> End {
    let fault = |fault: &LockstepFault| format!("{} at {}: {}", fault.node, fault.at, fault.reason);
    End {
        seconds: lockstep.now().as_secs_f64(),
        progress: newest::<TrackProgress>(lockstep, graph).map(|progress| *progress),
        decision: newest::<DecisionState>(lockstep, graph).map(|decision| (*decision).clone()),
        faults: lockstep.faults().iter().map(fault).collect(),
        hash: String::new(),
    }
}

/// Why a drive would be no success if it ended now.
pub fn reasons_now(success: &Success, lockstep: &Lockstep, graph: &Graph) -> Vec<String> {
    reasons(success, &so_far(lockstep, graph))
}

fn write_changes(lockstep: &mut Lockstep, graph: &Graph, timeline: &Timeline) -> Result<()> {
    let Some((node, port)) = source::<DecisionState>(graph) else { return Ok(()) };
    let timeline = Rc::clone(timeline);
    let mut before = None;
    let hear = move |sample: &Published| {
        let Ok(decision) = Arc::clone(&sample.message).into_any().downcast::<DecisionState>() else { return };
        if before.replace(decision.state) != Some(decision.state) {
            let (state, reason) = (decision.state.name().to_owned(), decision.reason.clone());
            timeline.borrow_mut().push(Change { at_s: sample.header.stamp.as_secs_f64(), state, reason });
        }
    };
    Ok(lockstep.subscribe(node, port, hear)?)
}

fn judge(scenario: &Scenario, run: Option<u64>, seed: u64, drawn: Drawn, ended: Result<End, String>) -> Outcome {
    let (end, error) = match ended {
        Ok(end) => (Some(end), None),
        Err(error) => (None, Some(error)),
    };
    let reasons = match &end {
        Some(end) => reasons(&scenario.success, end),
        None => error.into_iter().collect(),
    };
    let progress = end.as_ref().and_then(|end| end.progress);
    let decision = end.as_ref().and_then(|end| end.decision.clone());
    Outcome {
        run,
        seed,
        success: reasons.is_empty(),
        reasons,
        seconds: end.as_ref().map_or(0.0, |end| end.seconds),
        laps: progress.map(|progress| progress.laps),
        distance_m: progress.map(|progress| progress.distance_m),
        departures: progress.map(|progress| progress.departures),
        contacts: progress.map(|progress| progress.collisions),
        red_runs: progress.map(|progress| progress.red_runs),
        cross_track_rms_m: progress.map(|progress| progress.cross_track_rms_m),
        cross_track_max_m: progress.map(|progress| progress.cross_track_max_m),
        state: decision.as_ref().map(|decision| decision.state.name().to_owned()),
        state_reason: decision.map(|decision| decision.reason),
        hash: end.map(|end| end.hash),
        drawn,
    }
}

/// Why a drive is no success. Empty: it is one.
fn reasons(success: &Success, end: &End) -> Vec<String> {
    let Some(progress) = end.progress else { return vec!["no node of the graph judges the drive".to_owned()] };
    let mut reasons = end.faults.clone();
    let mut most = |what: &str, got: u32, allowed: u32| {
        if got > allowed {
            reasons.push(format!("{got} {what}, allowed are {allowed}"));
        }
    };
    most("departures", progress.departures, success.departures);
    most("contacts", progress.collisions, success.contacts);
    most("red runs", progress.red_runs, success.red_runs);
    if let Some(wanted) = success.laps_min.filter(|wanted| progress.laps < *wanted) {
        reasons.push(format!("{} laps, wanted are {wanted}", progress.laps));
    }
    if let Some(wanted) = success.distance_min_m.filter(|wanted| !(*wanted..).contains(&progress.distance_m)) {
        reasons.push(format!("drove {:.2} m, wanted are {wanted} m", progress.distance_m));
    }
    let errors = [
        ("rms", progress.cross_track_rms_m, success.cross_track_rms_max_m),
        ("maximum", progress.cross_track_max_m, success.cross_track_max_m),
    ];
    for (what, got, allowed) in errors {
        if let Some(allowed) = allowed.filter(|allowed| !(0.0..=*allowed).contains(&f64::from(got))) {
            reasons.push(format!("cross-track {what} {got:.4} m, allowed are {allowed} m"));
        }
    }
    let state = end.decision.as_ref().map(|decision| decision.state);
    let wrong = |allowed: &&Vec<DriveState>| !state.is_some_and(|state| allowed.contains(&state));
    if let Some(allowed) = success.end_state.as_ref().filter(wrong) {
        let (state, allowed) = (state.map_or("none", DriveState::name), allowed.iter().map(|state| state.name()));
        let why = end.decision.as_ref().map(|decision| format!(" ({})", decision.reason)).unwrap_or_default();
        reasons.push(format!("ends in state {state}{why}, allowed are {}", allowed.collect::<Vec<_>>().join(", ")));
    }
    reasons
}

#[cfg(test)]
mod tests {
    use super::*;

    fn end(progress: TrackProgress) -> End {
        End { seconds: 1.0, progress: Some(progress), decision: None, faults: Vec::new(), hash: String::new() }
    }

    #[test]
    fn a_drive_without_trouble_is_a_success() {
        assert!(reasons(&Success::default(), &end(TrackProgress::default())).is_empty(), "nothing is asked for");
    }

    #[test]
    fn every_condition_has_its_reason() {
        let progress = TrackProgress {
            departures: 2,
            collisions: 1,
            red_runs: 1,
            cross_track_rms_m: f32::NAN,
            cross_track_max_m: 0.5,
            ..TrackProgress::default()
        };
        let success = Success {
            departures: 1,
            laps_min: Some(1),
            distance_min_m: Some(3.0),
            cross_track_rms_max_m: Some(0.1),
            cross_track_max_m: Some(0.1),
            end_state: Some(vec![DriveState::LaneFollow]),
            ..Success::default()
        };
        let reasons = reasons(&success, &End { faults: vec!["bridge stopped".into()], ..end(progress) });
        let expected = [
            "bridge",
            "2 departures, allowed are 1",
            "1 contacts",
            "1 red runs",
            "0 laps",
            "drove 0.00 m",
            "rms NaN",
            "maximum 0.5",
            "ends in state none",
        ];
        assert_eq!(reasons.len(), expected.len(), "{reasons:?}");
        for (reason, expected) in reasons.iter().zip(expected) {
            assert!(reason.contains(expected), "`{expected}` in `{reason}`");
        }
    }
}
