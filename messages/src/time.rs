//! Points and spans of time as they travel on the wire. Who makes them (wall clock, virtual clock) is the runtime's affair.

use std::fmt;
use std::ops::{Add, Sub};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A point in time, ns since the Unix epoch on the car's clock (in lockstep: ns since the start of the run).
///
/// Within one run the clock never jumps: it is the monotonic clock, anchored to the wall clock once at start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Stamp(i64);

/// A signed difference of two [`Stamp`]s, ns. Negative when the "later" stamp comes from a clock that runs behind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Timespan(i64);

impl Stamp {
    /// The start of a lockstep run.
    pub const ZERO: Self = Self(0);

    /// From ns since the epoch.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// ns since the epoch.
    pub const fn as_nanos(self) -> i64 {
        self.0
    }

    /// s since the epoch.
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// How long ago `earlier` was. Saturates; negative when `earlier` lies in the future.
    pub const fn since(self, earlier: Self) -> Timespan {
        Timespan(self.0.saturating_sub(earlier.0))
    }

    /// The same moment on a clock that is `by` ahead. Saturates.
    #[must_use]
    pub const fn shifted(self, by: Timespan) -> Self {
        Self(self.0.saturating_add(by.0))
    }
}

impl Timespan {
    /// From ns.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// ns.
    pub const fn as_nanos(self) -> i64 {
        self.0
    }

    /// s.
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// ms.
    pub fn as_millis_f64(self) -> f64 {
        self.0 as f64 * 1e-6
    }

    /// As an unsigned duration; a negative span counts as zero.
    pub fn to_duration(self) -> Duration {
        Duration::from_nanos(self.0.max(0) as u64)
    }
}

impl From<Duration> for Timespan {
    fn from(duration: Duration) -> Self {
        Self(i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX))
    }
}

impl Add<Duration> for Stamp {
    type Output = Self;

    fn add(self, duration: Duration) -> Self {
        Self(self.0.saturating_add(Timespan::from(duration).0))
    }
}

impl Sub<Duration> for Stamp {
    type Output = Self;

    fn sub(self, duration: Duration) -> Self {
        Self(self.0.saturating_sub(Timespan::from(duration).0))
    }
}

impl fmt::Display for Stamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:09} s", self.0.div_euclid(1_000_000_000), self.0.rem_euclid(1_000_000_000))
    }
}

impl fmt::Display for Timespan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} ms", self.as_millis_f64())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_saturate_instead_of_wrapping() {
        let first = Stamp::from_nanos(i64::MIN);
        let last = Stamp::from_nanos(i64::MAX);
        assert_eq!(last.since(first).as_nanos(), i64::MAX, "a forged stamp must not wrap an age");
        assert_eq!((last + Duration::from_secs(1)).as_nanos(), i64::MAX, "sums saturate too");
    }

    #[test]
    fn prints_whole_and_fraction() {
        assert_eq!(Stamp::from_nanos(1_500_000_000).to_string(), "1.500000000 s", "display of a stamp");
    }
}
