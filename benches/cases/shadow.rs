//! What a candidate in shadow costs the node that drives: from exposure to lane estimate with a shadow beside it and without,
//! by turns, so that what else happens on the machine meets both alike.

use std::time::Duration;

use carril_runtime::control_plane::{Outcome, SwapTerms};

use crate::support::ages::Ages;
use crate::support::car::{Candidate, Car, my_lane};
use crate::support::measure::quantile;
use crate::support::report::Row;

const ROUNDS: usize = 7;
/// 30 frames a second: 120 estimates.
const WINDOW: Duration = Duration::from_secs(4);
/// Until the candidate is built, linked and warm.
const SETTLE: Duration = Duration::from_millis(1500);

/// Measures the shadow of `lane` in the same process, and in one of its own.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let car = Car::launch();
    let lane = Ages::listen(&car.client, "lane", "lane");
    measure(emit, "in its own process", &car, &lane, Candidate::Threshold(185));
    if let Some(binary) = my_lane("shadow") {
        measure(emit, "in another process", &car, &lane, Candidate::Exec(&binary));
    }
}

fn measure(emit: &mut dyn FnMut(Row), place: &str, car: &Car, lane: &Ages, candidate: Candidate<'_>) {
    let (mut with, mut without) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        std::thread::sleep(SETTLE);
        without.push(lane.window(WINDOW));
        with.push(beside_a_shadow(car, lane, candidate));
    }
    for (label, at) in [("median", 0.5), ("p99", 0.99)] {
        let typical = |windows: &[Vec<f64>]| {
            let of_each: Vec<f64> = windows.iter().map(|window| quantile(window, at)).collect();
            quantile(&of_each, 0.5)
        };
        let name = format!("exposure to lane, a shadow {place}, {label}, against none");
        emit(Row::against(name, typical(&with), "us", typical(&without)));
    }
}

/// A window of which all lies in the shadow.
fn beside_a_shadow(car: &Car, lane: &Ages, candidate: Candidate<'_>) -> Vec<f64> {
    let shadow_ms = (SETTLE * 2 + WINDOW).as_millis() as u64;
    let terms = SwapTerms { shadow_ms, compare_only: true, fresh: true, stall_ms: 2000, ..SwapTerms::default() };
    std::thread::scope(|scope| {
        let asking = scope.spawn(move || car.swap_lane(candidate, terms));
        std::thread::sleep(SETTLE);
        let window = lane.window(WINDOW);
        assert!(!asking.is_finished(), "the shadow is over too early: {:?}", asking.join());
        let receipt = asking.join().expect("asking does not panic");
        assert_eq!(receipt.outcome, Outcome::Compared, "{receipt:?}");
        window
    })
}
