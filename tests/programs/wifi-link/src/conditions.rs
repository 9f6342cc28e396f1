//! How good or bad the link is: numbers only, checked.

use std::time::Duration;

use crate::LinkError;

/// What the link does to packets. May change while it runs.
#[derive(Clone, Debug, PartialEq)]
pub struct Conditions {
    /// What goes through, bit/s of IP packets with their headers; `None`: no limit.
    pub rate_bit_s: Option<u64>,
    /// Who shares that rate.
    pub medium: Medium,
    /// Time from the end of a packet's transmission to its arrival.
    pub delay: Duration,
    /// The delay of a packet is uniform in `delay - jitter ..= delay + jitter`. Order is kept, as on Wi-Fi: a packet that
    /// would overtake the one before it arrives together with it. So where packets follow each other closely, the mean is above
    /// `delay`. At most `delay`.
    pub jitter: Duration,
    /// Share of the packets that are sent and never arrive, 0 ..= 1: what is left after the radio's own retries.
    pub loss: f64,
    /// What may wait for transmission in each direction; what comes on top is dropped.
    pub queue: Queue,
    /// The same seed gives the n-th packet of a direction the same fate in each run.
    pub seed: u64,
}

/// Who shares the rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Medium {
    /// Both directions, packet by packet in turn where both have something to send: stations on one Wi-Fi channel.
    Shared,
    /// Nobody: each direction has the whole rate, as on a cable.
    PerDirection,
}

/// How much may wait for transmission in one direction. A packet that finds nothing waiting is always taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queue {
    /// So many bytes.
    Bytes(u64),
    /// As many bytes as the rate sends in this time. No limit where the rate has none: then nothing waits.
    Time(Duration),
}

impl Queue {
    /// The limit in bytes at a rate.
    pub fn bytes(self, rate_bit_s: Option<u64>) -> u64 {
        match (self, rate_bit_s) {
            (Self::Bytes(bytes), _) => bytes,
            (Self::Time(_), None) => u64::MAX,
            (Self::Time(time), Some(rate)) => {
                u64::try_from(time.as_nanos() * u128::from(rate) / 8_000_000_000).unwrap_or(u64::MAX)
            }
        }
    }
}

impl Conditions {
    /// A room with the access point in it: 20 Mbit/s shared, 5 ± 3 ms, 2 % loss, a queue of 200 ms.
    pub fn good() -> Self {
        Self {
            rate_bit_s: Some(20_000_000),
            medium: Medium::Shared,
            delay: Duration::from_millis(5),
            jitter: Duration::from_millis(3),
            loss: 0.02,
            queue: Queue::Time(Duration::from_millis(200)),
            seed: 1,
        }
    }

    /// The far end of the corridor: as [`Conditions::good`] with 2 Mbit/s.
    pub fn slow() -> Self {
        Self { rate_bit_s: Some(2_000_000), ..Self::good() }
    }

    /// No limit, no delay, no loss: what the relay itself costs.
    pub fn perfect() -> Self {
        Self { rate_bit_s: None, delay: Duration::ZERO, jitter: Duration::ZERO, loss: 0.0, ..Self::good() }
    }

    /// Refuses what no link can do.
    pub fn check(&self) -> Result<(), LinkError> {
        let refuse = |problem: String| Err(LinkError::BadConditions(problem));
        if self.rate_bit_s == Some(0) {
            return refuse("a rate of 0 lets nothing through; cut the link instead".into());
        }
        if self.jitter > self.delay {
            return refuse(format!(
                "the jitter ({:?}) is more than the delay ({:?}); a packet would arrive before it was sent. Allowed: 0 to the delay",
                self.jitter, self.delay
            ));
        }
        if !(self.loss >= 0.0 && self.loss <= 1.0) {
            return refuse(format!("the loss is a share from 0 to 1, got {}", self.loss));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_pass_their_check() {
        for preset in [Conditions::good(), Conditions::slow(), Conditions::perfect()] {
            preset.check().expect("a preset is possible");
        }
    }

    #[test]
    fn refuses_what_no_link_can_do() {
        let bad = [
            Conditions { rate_bit_s: Some(0), ..Conditions::good() },
            Conditions { jitter: Duration::from_millis(6), ..Conditions::good() },
            Conditions { loss: f64::NAN, ..Conditions::good() },
            Conditions { loss: -0.1, ..Conditions::good() },
            Conditions { loss: 1.1, ..Conditions::good() },
        ];
        for conditions in bad {
            assert!(conditions.check().is_err(), "{conditions:?} was taken");
        }
    }

    #[test]
    fn a_queue_of_time_is_what_the_rate_sends_in_it() {
        let queue = Queue::Time(Duration::from_millis(200));
        assert_eq!(queue.bytes(Some(2_000_000)), 50_000, "2 Mbit/s for 200 ms");
        assert_eq!(queue.bytes(None), u64::MAX, "no rate, no limit");
        assert_eq!(Queue::Bytes(7).bytes(Some(2_000_000)), 7, "bytes are bytes");
    }
}
