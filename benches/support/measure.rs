//! Time, pacing and percentiles for the benchmarks.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// Payloads from this size on go through shared memory.
pub const SHARED_FROM_BYTES: usize = 16 * 1024;

/// What all processes of this machine read alike, ns.
pub fn monotonic_ns() -> u64 {
    let now = nix::time::clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC).expect("every Linux has this clock");
    now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64
}

/// CPU time of this process so far, µs.
pub fn cpu_us() -> f64 {
    let clock = nix::time::ClockId::CLOCK_PROCESS_CPUTIME_ID;
    let now = nix::time::clock_gettime(clock).expect("every Linux has this clock");
    now.tv_sec() as f64 * 1e6 + now.tv_nsec() as f64 * 1e-3
}

/// CPU time of another process so far, s, in hundredths.
pub fn processor_s(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("the process is there");
    let fields: Vec<&str> = stat.rsplit_once(')').map_or("", |(_, rest)| rest).split_whitespace().collect();
    let ticks = |at: usize| fields[at].parse::<f64>().expect("a number");
    (ticks(11) + ticks(12)) / 100.0
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

/// A quantile of some values. NaN without data.
pub fn quantile(values: &[f64], quantile: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let index = (quantile * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(index).copied().unwrap_or(f64::NAN)
}

/// Latencies of a series, and what it cost.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Series {
    /// One per message, ns.
    pub latencies_ns: Vec<u64>,
    /// CPU time of the processes while they were measured, µs.
    pub cpu_us: f64,
}

impl Series {
    /// Adds another series.
    pub fn add(&mut self, other: &Self) {
        self.latencies_ns.extend(&other.latencies_ns);
        self.cpu_us += other.cpu_us;
    }

    /// Prints it for the process that asked.
    pub fn print(&self) {
        println!("{}", serde_json::to_string(self).expect("a series is JSON"));
    }

    /// A quantile, µs. NaN without data.
    pub fn quantile_us(&self, quantile: f64) -> f64 {
        let latencies_us: Vec<f64> = self.latencies_ns.iter().map(|ns| *ns as f64 * 1e-3).collect();
        self::quantile(&latencies_us, quantile)
    }

    /// CPU time per message, µs.
    pub fn cpu_per_message_us(&self) -> f64 {
        self.cpu_us / self.latencies_ns.len().max(1) as f64
    }
}

/// Records a series of a known length; the first messages warm up and do not count.
pub struct Recorder {
    warm_up: usize,
    wanted: usize,
    cpu_at_start: f64,
    series: Series,
}

/// Messages that do not count at the start of each series.
pub const WARM_UP: usize = 50;

impl Recorder {
    /// For `wanted` messages after the warm-up.
    pub fn new(wanted: usize) -> Self {
        let series = Series { latencies_ns: Vec::with_capacity(wanted), cpu_us: 0.0 };
        Self { warm_up: WARM_UP, wanted, cpu_at_start: 0.0, series }
    }

    /// Adds a message that was stamped at `sent_ns`; gives the series with the last one.
    pub fn record(&mut self, sent_ns: u64) -> Option<Series> {
        let latency_ns = monotonic_ns().saturating_sub(sent_ns);
        if self.warm_up > 0 {
            self.warm_up -= 1;
            self.cpu_at_start = cpu_us();
            return None;
        }
        self.series.latencies_ns.push(latency_ns);
        if self.series.latencies_ns.len() < self.wanted {
            return None;
        }
        self.series.cpu_us = cpu_us() - self.cpu_at_start;
        Some(std::mem::take(&mut self.series))
    }
}
