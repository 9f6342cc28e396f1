//! A node of the default graph replaced while it drives: how long the request takes, and how long its outputs pause.

use carril_runtime::control_plane::{Outcome, Receipt, SwapTerms};

use crate::support::car::{Candidate, Car, my_lane};
use crate::support::measure::quantile;
use crate::support::report::Row;

const CONFIGS: u64 = 100;
const BINARIES: u64 = 30;
/// What a swap of the configuration may take besides its shadow, ms.
const CONFIG_GOAL_MS: f64 = 50.0;
/// What a swap of a binary may take besides its shadow, ms.
const BINARY_GOAL_MS: f64 = 500.0;
/// How long outputs may pause: from one frame of the default camera to the next, and 5 ms, ms.
const GAP_GOAL_MS: f64 = 1000.0 / 30.0 + 5.0;

/// Measures swaps of `lane`.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let car = Car::launch();
    let other = |round| swap(&car, Candidate::Threshold(170 + round % 40));
    let configs: Vec<Receipt> = (0..CONFIGS).map(other).collect();
    report(emit, "swap of a configuration", &configs, CONFIG_GOAL_MS);
    let Some(binary) = my_lane("swap") else { return };
    let there_and_back = |_| {
        let receipt = swap(&car, Candidate::Exec(&binary));
        swap(&car, Candidate::BuiltIn);
        receipt
    };
    let binaries: Vec<Receipt> = (0..BINARIES).map(there_and_back).collect();
    report(emit, "swap of a binary", &binaries, BINARY_GOAL_MS);
}

fn swap(car: &Car, candidate: Candidate<'_>) -> Receipt {
    let terms = SwapTerms { shadow_ms: 200, probation_outputs: 5, fresh: true, stall_ms: 2000, ..SwapTerms::default() };
    car.swap_lane(candidate, terms)
}

fn report(emit: &mut dyn FnMut(Row), what: &str, receipts: &[Receipt], goal_ms: f64) {
    let (done, others): (Vec<_>, Vec<_>) = receipts.iter().partition(|receipt| receipt.outcome == Outcome::Done);
    for receipt in &others {
        eprintln!("{what}: {:?} in {:?}: {:?}", receipt.outcome, receipt.phase, receipt.reason);
    }
    let all = |pick: fn(&Receipt) -> Option<f64>| -> Vec<f64> { done.iter().copied().filter_map(pick).collect() };
    let (took, gaps, usual) = (all(|r| r.took_ms), all(|r| r.gap_ms), all(|r| r.usual_gap_ms));
    for (label, at) in [("median", 0.5), ("p99", 0.99)] {
        let name = format!("{what}, request to take-over without shadow, {label}, against the goal");
        emit(Row::against(name, quantile(&took, at), "ms", goal_ms));
        let name = format!("{what}, longest pause, {label}, against a camera period + 5 ms");
        emit(Row::against(name, quantile(&gaps, at), "ms", GAP_GOAL_MS));
    }
    let name = format!("{what}, longest pause against the usual pause, medians");
    emit(Row::against(name, quantile(&gaps, 0.5), "ms", quantile(&usual, 0.5)));
    let lost: u64 = done.iter().map(|receipt| receipt.lost + receipt.duplicated).sum();
    emit(Row::alone(format!("{what}, samples lost or duplicated in {} swaps", done.len()), lost as f64, ""));
    emit(Row::alone(format!("{what}, swaps that did not go through"), others.len() as f64, ""));
}
