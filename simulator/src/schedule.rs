//! When outputs are due: at the first step at or after each multiple of their interval, counted in whole numbers.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Exact rates have whole millihertz.
const MHZ_PER_HZ: f64 = 1e3;

/// The ticks of one output.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Schedule {
    rate_mhz: u64,
    next: u64,
}

impl Schedule {
    /// Ticks at 0 and then `rate_hz` times a second; the rate is rounded to 0.001 Hz.
    pub fn new(rate_hz: f64) -> Self {
        Self { rate_mhz: (rate_hz * MHZ_PER_HZ).round().max(1.0) as u64, next: 0 }
    }

    /// As it goes on after `elapsed` at a rate that may be another.
    #[must_use]
    pub fn at_rate(self, rate_hz: f64, elapsed: Duration) -> Self {
        let mut other = Self::new(rate_hz);
        if other.rate_mhz == self.rate_mhz {
            return self;
        }
        other.next = other.ticks(elapsed) + 1;
        other
    }

    fn ticks(&self, elapsed: Duration) -> u64 {
        (elapsed.as_nanos() * u128::from(self.rate_mhz) / 1_000_000_000_000) as u64
    }

    /// The number of the tick that is due after `elapsed` since the start, if there is a new one. After a pause only the last of
    /// those that were missed comes.
    pub fn due(&mut self, elapsed: Duration) -> Option<u64> {
        let ticks = self.ticks(elapsed);
        if ticks < self.next {
            return None;
        }
        self.next = ticks + 1;
        Some(ticks)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thirty_hertz_on_a_grid_of_five_milliseconds() {
        let mut schedule = Schedule::new(30.0);
        let due: Vec<u32> =
            (0..=40).filter(|k| schedule.due(Duration::from_millis(5 * k)).is_some()).map(|k| 5 * k as u32).collect();
        assert_eq!(due, [0, 35, 70, 100, 135, 170, 200], "at or after each 33.3 ms, without drift");
    }

    #[test]
    fn a_pause_is_not_made_up_for() {
        let mut schedule = Schedule::new(10.0);
        assert_eq!(schedule.due(Duration::ZERO), Some(0), "the first");
        assert_eq!(schedule.due(Duration::from_millis(950)), Some(9), "only the last of nine");
        assert_eq!(schedule.due(Duration::from_millis(990)), None, "and not again");
    }
}
