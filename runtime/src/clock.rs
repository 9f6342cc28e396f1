//! Where time comes from. Operators never ask: they are given the time of their step.

use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use carril_messages::Stamp;

/// A source of time.
pub trait Clock: Send + Sync {
    /// The time on the car's clock.
    fn now(&self) -> Stamp;
}

/// The monotonic clock, anchored to the wall clock once, so that a clock correction during a run moves nothing.
#[derive(Clone, Copy, Debug)]
pub struct LiveClock {
    start: Instant,
    start_stamp: Stamp,
}

impl LiveClock {
    /// Anchors the clock now.
    pub fn anchored_now() -> Self {
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
        Self { start: Instant::now(), start_stamp: Stamp::ZERO + since_epoch }
    }

    /// The anchor in a form that another process of this machine can take over: the stamp at which the machine's monotonic
    /// clock (`CLOCK_MONOTONIC`) reads zero, given what it reads now.
    pub fn with_anchor(monotonic_now: Duration, stamp_of_zero: Stamp) -> Self {
        Self { start: Instant::now(), start_stamp: stamp_of_zero + monotonic_now }
    }
}

impl Clock for LiveClock {
    fn now(&self) -> Stamp {
        self.start_stamp + self.start.elapsed()
    }
}

/// The clock of a car far away, as far as it can be told from here: set whenever the car has said its time, and going on in between.
#[derive(Debug)]
pub struct FarClock {
    start: Instant,
    /// The car's stamp at `start`, ns.
    stamp_at_start: AtomicI64,
}

impl FarClock {
    /// A clock that shows `now` now.
    pub fn set_to(now: Stamp) -> Self {
        Self { start: Instant::now(), stamp_at_start: AtomicI64::new(now.as_nanos()) }
    }

    /// The car's clock showed `stamp` at `when`.
    pub fn set(&self, stamp: Stamp, when: Instant) {
        let since_start = when.duration_since(self.start).as_nanos() as i64;
        self.stamp_at_start.store(stamp.as_nanos() - since_start, Ordering::Relaxed);
    }
}

impl Clock for FarClock {
    fn now(&self) -> Stamp {
        Stamp::from_nanos(self.stamp_at_start.load(Ordering::Relaxed)) + self.start.elapsed()
    }
}

/// Time that goes on only when somebody turns it.
#[derive(Debug, Default)]
pub struct VirtualClock(AtomicI64);

impl VirtualClock {
    /// Sets the time. It may not go back.
    pub fn advance_to(&self, stamp: Stamp) {
        self.0.fetch_max(stamp.as_nanos(), Ordering::Relaxed);
    }
}

impl Clock for VirtualClock {
    fn now(&self) -> Stamp {
        Stamp::from_nanos(self.0.load(Ordering::Relaxed))
    }
}
