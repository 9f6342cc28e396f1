//! How fast the view may leave for one viewer, so that it fills no queue on its way: what people ask and what they are answered passes
//! through the same radio, and would wait behind it. Pure.
//!
//! A piece of a picture goes every so often, at a rate that follows the link: what the round trip takes beyond the quickest of late is time
//! in a queue. As long as there is hardly any, the rate rises; when there is, it falls. The kernel measures the round trip, not the page:
//! what a busy browser or a busy car takes must not look like a slow link.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// The rate at first, and its limits, bit/s.
const FIRST_BIT_S: f64 = 6e6;
const LEAST_BIT_S: f64 = 2e5;
const MOST_BIT_S: f64 = 1e8;
/// The round trip is looked at this often ...
const LOOK: Duration = Duration::from_millis(50);
/// ... and so many looks are remembered for the quickest among them: ten seconds.
const REMEMBERED: usize = 200;
/// A queue of up to this is none ...
const NO_QUEUE: Duration = Duration::from_millis(8);
/// ... and this one is too long.
const QUEUE: Duration = Duration::from_millis(15);
/// What the rate changes by at a look. Slowly up: whatever is too much for the link waits in its queue until that is known.
const FASTER: f64 = 1.03;
const SLOWER: f64 = 0.85;
/// A picture should take no longer on its way out.
const ONE_PICTURE: Duration = Duration::from_millis(100);

/// The pace of one view.
#[derive(Debug)]
pub struct Pacer {
    rate_bit_s: f64,
    /// Newest last.
    round_trips: VecDeque<Duration>,
    looked: Option<Instant>,
    next: Option<Instant>,
}

impl Default for Pacer {
    fn default() -> Self {
        Self { rate_bit_s: FIRST_BIT_S, round_trips: VecDeque::new(), looked: None, next: None }
    }
}

impl Pacer {
    /// When the next piece may leave.
    pub fn due(&self) -> Option<Instant> {
        self.next
    }

    /// So many bytes leave now. `round_trip`: asked for only now and then.
    pub fn leave(&mut self, bytes: usize, now: Instant, round_trip: impl FnOnce() -> Option<Duration>) {
        if self.looked.is_none_or(|looked| now.saturating_duration_since(looked) >= LOOK) {
            self.looked = Some(now);
            if let Some(round_trip) = round_trip() {
                self.look(round_trip);
            }
        }
        let takes = Duration::from_secs_f64(bytes as f64 * 8.0 / self.rate_bit_s);
        // What was not used is not made up for, or it would leave in a burst.
        self.next = Some(self.next.map_or(now, |next| next.max(now)) + takes);
    }

    fn look(&mut self, round_trip: Duration) {
        if self.round_trips.len() >= REMEMBERED {
            self.round_trips.pop_front();
        }
        self.round_trips.push_back(round_trip);
        let quickest = self.round_trips.iter().min().copied().unwrap_or(round_trip);
        let queue = round_trip - quickest;
        if queue > QUEUE {
            self.set(self.rate_bit_s * SLOWER);
        } else if queue < NO_QUEUE {
            self.set(self.rate_bit_s * FASTER);
        }
    }

    fn set(&mut self, rate_bit_s: f64) {
        self.rate_bit_s = rate_bit_s.clamp(LEAST_BIT_S, MOST_BIT_S);
    }

    /// What a picture may have, B.
    pub fn picture_bytes(&self) -> usize {
        (self.rate_bit_s * ONE_PICTURE.as_secs_f64() / 8.0) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A link of this rate with a long queue, and a camera that always has a picture: the rate of the pacer after a minute, bit/s, and the
    /// longest queue in its second half.
    fn settle(link_bit_s: f64) -> (f64, Duration) {
        let mut pacer = Pacer::default();
        let begun = Instant::now();
        let (mut now, mut free, mut smooth_s) = (begun, begun, 0.012);
        let mut longest = Duration::ZERO;
        while now < begun + Duration::from_secs(60) {
            now = now.max(pacer.due().unwrap_or(now));
            free = free.max(now) + Duration::from_secs_f64(1300.0 * 8.0 / link_bit_s);
            let queue = free - now;
            // As the kernel does: an eighth of each.
            smooth_s += (queue.as_secs_f64() + 0.012 - smooth_s) / 8.0;
            pacer.leave(1300, now, || Some(Duration::from_secs_f64(smooth_s)));
            if now > begun + Duration::from_secs(30) {
                longest = longest.max(queue);
            }
        }
        (pacer.rate_bit_s, longest)
    }

    #[test]
    fn follows_the_link_and_leaves_no_queue_behind() {
        for link in [5e5, 2e6, 2e7] {
            let (rate, queue) = settle(link);
            assert!(rate > 0.5 * link && rate < 1.3 * link, "{rate} on a link of {link}");
            // Some packets, whatever they take on this link.
            let most = Duration::from_millis(30) + Duration::from_secs_f64(4.0 * 1300.0 * 8.0 / link);
            assert!(queue < most, "{queue:?} on a link of {link}");
        }
    }

    #[test]
    fn a_queue_makes_it_slower_down_to_a_least_and_its_end_faster_again() {
        let mut pacer = Pacer::default();
        let mut now = Instant::now();
        let mut look = |pacer: &mut Pacer, round_trip_ms| {
            now += LOOK;
            pacer.leave(1, now, || Some(Duration::from_millis(round_trip_ms)));
        };
        look(&mut pacer, 10);
        assert!(pacer.rate_bit_s > FIRST_BIT_S, "{pacer:?}");
        let before = pacer.rate_bit_s;
        look(&mut pacer, 20);
        assert_eq!(before.to_bits(), pacer.rate_bit_s.to_bits(), "between the two it stays");
        for _ in 0..100 {
            look(&mut pacer, 50);
        }
        assert_eq!(pacer.rate_bit_s.to_bits(), LEAST_BIT_S.to_bits(), "there is a least");
        assert_eq!(pacer.picture_bytes(), 2500, "of which a picture has a tenth of a second");
        // The way has become longer for good: another room.
        for _ in 0..2 * REMEMBERED {
            look(&mut pacer, 50);
        }
        assert!(pacer.rate_bit_s > LEAST_BIT_S, "what is usual is no queue: {}", pacer.rate_bit_s);
    }

    #[test]
    fn what_was_not_used_is_not_made_up_for_and_the_kernel_is_asked_now_and_then() {
        let (mut pacer, begun) = (Pacer::default(), Instant::now());
        assert_eq!(pacer.due(), None, "at once");
        pacer.leave(7500, begun, || None);
        assert_eq!(pacer.due(), Some(begun + Duration::from_millis(10)), "60000 bit at 6 Mbit/s");
        pacer.leave(7500, begun + Duration::from_millis(10), || panic!("it was asked just now"));
        let later = begun + Duration::from_secs(1);
        pacer.leave(7500, later, || None);
        assert_eq!(pacer.due(), Some(later + Duration::from_millis(10)), "counted from then");
    }
}
