//! Time, pacing and percentiles for the benchmarks.

use std::time::{Duration, Instant};

/// Payloads from this size on go through shared memory.
pub const SHARED_FROM_BYTES: usize = 16 * 1024;

/// What all processes of this machine read alike, ns.
pub fn monotonic_ns() -> u64 {
    let now = nix::time::clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC).expect("every Linux has this clock");
    now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64
}

/// CPU time of this process so far, µs.
pub fn cpu_us() -> f64 {
    let now = nix::time::clock_gettime(nix::time::ClockId::CLOCK_PROCESS_CPUTIME_ID).expect("every Linux has this clock");
    now.tv_sec() as f64 * 1e6 + now.tv_nsec() as f64 * 1e-3
}

/// Calls `work` `count` times, once per `period`.
pub fn paced(count: usize, period: Duration, mut work: impl FnMut()) {
    let start = Instant::now();
    for turn in 0..count {
        let due = start + period * turn as u32;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        work();
    }
}

/// Latencies of a series, ns.
#[derive(Default)]
pub struct HopStats {
    wanted: usize,
    /// One per message.
    pub latencies_ns: Vec<u64>,
    /// CPU time of the receiving process per message, µs.
    pub cpu_us: f64,
}

impl HopStats {
    /// For `wanted` messages.
    pub fn new(wanted: usize) -> Self {
        Self { wanted, latencies_ns: Vec::with_capacity(wanted), cpu_us: 0.0 }
    }

    /// Adds one; `true` when it was the last.
    pub fn record(&mut self, latency_ns: u64) -> bool {
        self.latencies_ns.push(latency_ns);
        self.latencies_ns.len() == self.wanted
    }

    /// Takes out the series.
    pub fn take(&mut self) -> Self {
        std::mem::take(self)
    }

    /// A quantile, µs.
    pub fn quantile_us(&self, quantile: f64) -> f64 {
        let mut sorted = self.latencies_ns.clone();
        sorted.sort_unstable();
        let index = (quantile * sorted.len().saturating_sub(1) as f64).round() as usize;
        sorted.get(index).map_or(f64::NAN, |ns| *ns as f64 * 1e-3)
    }
}
