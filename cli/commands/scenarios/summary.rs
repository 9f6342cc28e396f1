//! What a series of drives came to: success with its confidence interval, totals, spreads, and which drives failed.

use std::path::PathBuf;

use carril_runtime::scenario::Scenario;
use serde::Serialize;

use super::drive::Outcome;
use crate::common::report::Report;
use crate::common::time;

/// Failed drives that people are shown.
const SHOWN_FAILURES: usize = 20;
/// Of the standard normal distribution: 95 % lie within.
const Z_95: f64 = 1.959_964;

/// The numbers of a series.
#[derive(Serialize)]
pub struct Summary {
    scenario: PathBuf,
    graph: PathBuf,
    /// Seed of the series.
    seed: u64,
    runs: u64,
    /// Drives that were asked for; more than `runs` after Ctrl-C.
    asked: u64,
    succeeded: u64,
    /// Share that succeeded. `None`: nothing was driven.
    success: Option<f64>,
    /// Wilson interval of it, 95 %.
    success_from: f64,
    success_to: f64,
    required: f64,
    /// As many succeeded as the scenario requires.
    passed: bool,
    departures: u64,
    contacts: u64,
    red_runs: u64,
    distance_m: f64,
    cross_track_rms_m: Option<Spread>,
    cross_track_max_m: Option<f64>,
    /// Virtual time of all drives, s.
    seconds: f64,
    wall_s: f64,
    runs_per_minute: f64,
    failures: Vec<Failure>,
}

#[derive(Serialize)]
struct Spread {
    p50: f64,
    p99: f64,
    max: f64,
}

#[derive(Serialize)]
struct Failure {
    run: Option<u64>,
    seed: u64,
    hash: Option<String>,
    reasons: Vec<String>,
}

/// The interval that a share lies in with 95 % confidence, after `hits` of `count` (Wilson 1927).
pub fn wilson(hits: u64, count: u64) -> (f64, f64) {
    if count == 0 {
        return (0.0, 1.0);
    }
    let (n, share, z2) = (count as f64, hits as f64 / count as f64, Z_95 * Z_95);
    let middle = (share + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = Z_95 / (1.0 + z2 / n) * (share * (1.0 - share) / n + z2 / (4.0 * n * n)).sqrt();
    ((middle - half).max(0.0), (middle + half).min(1.0))
}

fn spread(mut numbers: Vec<f64>) -> Option<Spread> {
    numbers.sort_by(f64::total_cmp);
    let at = |share: f64| numbers.get((share * (numbers.len() as f64 - 1.0)).round() as usize).copied();
    Some(Spread { p50: at(0.5)?, p99: at(0.99)?, max: *numbers.last()? })
}

impl Summary {
    /// Of these drives, in their order.
    pub fn new(scenario: &Scenario, seed: u64, asked: u64, outcomes: &[Outcome], wall_s: f64) -> Self {
        let runs = outcomes.len() as u64;
        let succeeded = outcomes.iter().filter(|outcome| outcome.success).count() as u64;
        let success = (runs > 0).then(|| succeeded as f64 / runs as f64);
        let (success_from, success_to) = wilson(succeeded, runs);
        let count = |of: fn(&Outcome) -> Option<u32>| outcomes.iter().filter_map(of).map(u64::from).sum();
        let failure = |outcome: &Outcome| Failure {
            run: outcome.run,
            seed: outcome.seed,
            hash: outcome.hash.clone(),
            reasons: outcome.reasons.clone(),
        };
        Self {
            scenario: scenario.path.clone(),
            graph: scenario.graph.clone(),
            seed,
            runs,
            asked,
            succeeded,
            success,
            success_from,
            success_to,
            required: scenario.require.success_min,
            passed: success.is_some_and(|share| share >= scenario.require.success_min),
            departures: count(|outcome| outcome.departures),
            contacts: count(|outcome| outcome.contacts),
            red_runs: count(|outcome| outcome.red_runs),
            distance_m: outcomes.iter().filter_map(|outcome| outcome.distance_m).fold(0.0, |sum, way_m| sum + way_m),
            cross_track_rms_m: spread(outcomes.iter().filter_map(|o| o.cross_track_rms_m).map(f64::from).collect()),
            cross_track_max_m: outcomes.iter().filter_map(|o| o.cross_track_max_m).map(f64::from).reduce(f64::max),
            seconds: outcomes.iter().map(|outcome| outcome.seconds).sum(),
            wall_s,
            runs_per_minute: if wall_s > 0.0 { runs as f64 * 60.0 / wall_s } else { 0.0 },
            failures: outcomes.iter().filter(|outcome| !outcome.success).map(failure).collect(),
        }
    }

    /// Whether as many succeeded as the scenario requires.
    pub fn passed(&self) -> bool {
        self.passed
    }

    /// For people.
    pub fn text(&self) -> Report {
        let mut report = Report::default();
        report.fact("scenario", format_args!("{}, seed {}", self.scenario.display(), self.seed));
        let cut = if self.runs < self.asked { format!(" of {}, ended early", self.asked) } else { String::new() };
        let (virtual_time, wall) = (time::span(self.seconds), time::span(self.wall_s));
        let pace = format!("{virtual_time} driven in {wall}: {:.1} runs a minute", self.runs_per_minute);
        report.fact("runs", format_args!("{}{cut}; {pace}", self.runs));
        let percent = |share: f64| format!("{:.2} %", share * 100.0);
        let share = self.success.map_or_else(|| "-".to_owned(), percent);
        let interval = format!("{} to {}", percent(self.success_from), percent(self.success_to));
        report.fact("success", format_args!("{share} ({} of {}), 95 % interval {interval}", self.succeeded, self.runs));
        report.fact(
            "departures",
            format_args!("{}, contacts {}, red runs {}", self.departures, self.contacts, self.red_runs),
        );
        report.fact("distance", format_args!("{:.1} m", self.distance_m));
        if let (Some(rms), Some(max_m)) = (&self.cross_track_rms_m, self.cross_track_max_m) {
            let rms = format!("rms p50 {:.4}, p99 {:.4}, max {:.4} m", rms.p50, rms.p99, rms.max);
            report.fact("cross-track", format_args!("{rms}; largest {max_m:.4} m"));
        }
        let word = if self.passed { "passed" } else { "FAILED" };
        report.fact("verdict", format_args!("{word}: required is a success of {}", percent(self.required)));
        self.tell_failures(&mut report);
        report
    }

    fn tell_failures(&self, report: &mut Report) {
        if self.failures.is_empty() {
            return;
        }
        let row = |failure: &Failure| {
            let hash = failure.hash.clone().unwrap_or_else(|| "-".into());
            vec![failure.seed.to_string(), hash, failure.reasons.join("; ")]
        };
        let rows: Vec<_> = self.failures.iter().take(SHOWN_FAILURES).map(row).collect();
        report.table(&[">FAILING SEED", "HASH", "REASON"], &rows);
        if self.failures.len() > SHOWN_FAILURES {
            report.line(format_args!("and {} more; --out writes all", self.failures.len() - SHOWN_FAILURES));
        }
        let (scenario, seed) = (self.scenario.display(), self.failures[0].seed);
        report.line(format_args!("the first again: carril scenarios show {scenario} --seed {seed}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_is_wilsons() {
        let near = |got: f64, expected: f64| (got - expected).abs() < 5e-4;
        let (from, to) = wilson(8, 10);
        assert!(near(from, 0.4902) && near(to, 0.9433), "8 of 10: {from} to {to}");
        let (from, to) = wilson(1000, 1000);
        assert!(near(from, 0.9962) && to == 1.0, "all of 1000: {from} to {to}");
        assert_eq!(wilson(0, 0), (0.0, 1.0), "nothing is known");
    }

    #[test]
    fn a_spread_has_its_middle_and_its_ends() {
        let spread = spread((0..=100).rev().map(f64::from).collect()).expect("numbers");
        assert_eq!((spread.p50, spread.p99, spread.max), (50.0, 99.0, 100.0), "0 to 100");
        assert!(super::spread(Vec::new()).is_none(), "of nothing there is none");
    }
}
