//! How fast the view may leave for one viewer, so that it fills no queue on its way: what people ask and what they are answered passes
//! through the same radio, and would wait behind it. Pure.
//!
//! A piece of a picture goes every so often, at a rate that follows the link: what a ping takes there and back beyond the quickest of late
//! is time in a queue. As long as there is hardly any, the rate rises; when there is, it falls. Pings are answered by the browser itself, not
//! by the page, and one that is late proves nothing: a lost packet was sent again, or somebody was busy. While one has been out for long
//! nothing follows it, whatever the rate: it would only wait behind it.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// The rate at first, and its limits, bit/s.
const FIRST_BIT_S: f64 = 1e6;
const LEAST_BIT_S: f64 = 2e5;
const MOST_BIT_S: f64 = 1e8;
/// While something leaves, a ping goes this often ...
const LOOK: Duration = Duration::from_millis(50);
/// ... so many answers are remembered for the quickest among them, ten seconds, ...
const REMEMBERED: usize = 200;
/// ... and the quickest of so many is what the way takes now.
const NOW: usize = 3;
/// A queue of up to this is none ...
const NO_QUEUE: Duration = Duration::from_millis(6);
/// ... and this one is too long.
const QUEUE: Duration = Duration::from_millis(12);
/// A ping that takes so much longer than the quickest holds everything back ...
const HELD_BACK: Duration = Duration::from_millis(100);
/// ... and is looked after this often.
const LOOK_AFTER: Duration = Duration::from_millis(5);
/// What the rate changes by at an answer. Slowly up, but for the first rise: whatever is too much for the link waits in its queue until
/// that is known.
const FIRST_FASTER: f64 = 1.1;
const FASTER: f64 = 1.02;
const SLOWER: f64 = 0.9;
/// A picture should take no longer on its way out.
const ONE_PICTURE: Duration = Duration::from_millis(100);

/// The pace of one view.
#[derive(Debug)]
pub struct Pacer {
    rate_bit_s: f64,
    /// Newest last.
    round_trips: VecDeque<Duration>,
    /// When the pings left that were not answered yet, oldest first.
    out: VecDeque<Instant>,
    /// Until there was a queue for the first time.
    rising: bool,
    looked: Option<Instant>,
    next: Option<Instant>,
}

impl Default for Pacer {
    fn default() -> Self {
        let (round_trips, out) = (VecDeque::new(), VecDeque::new());
        Self { rate_bit_s: FIRST_BIT_S, round_trips, out, rising: true, looked: None, next: None }
    }
}

impl Pacer {
    /// When the next piece may leave, or shall be asked for again. `None`: at once.
    pub fn due(&self, now: Instant) -> Option<Instant> {
        let quickest = self.round_trips.iter().min().copied().unwrap_or_default();
        let held_back =
            self.out.front().is_some_and(|left| now.saturating_duration_since(*left) > quickest + HELD_BACK);
        if held_back { Some(self.next.unwrap_or(now).max(now + LOOK_AFTER)) } else { self.next }
    }

    /// So many bytes leave now.
    pub fn leave(&mut self, bytes: usize, now: Instant) {
        let takes = Duration::from_secs_f64(bytes as f64 * 8.0 / self.rate_bit_s);
        // What was not used is not made up for, or it would leave in a burst.
        self.next = Some(self.next.map_or(now, |next| next.max(now)) + takes);
    }

    /// Whether a ping is due, behind what has just left. Then it counts as sent.
    pub fn look(&mut self, now: Instant) -> bool {
        let due = self.looked.is_none_or(|looked| now.saturating_duration_since(looked) >= LOOK);
        if due {
            self.looked = Some(now);
            self.out.push_back(now);
        }
        due
    }

    /// The oldest ping that is out was answered after this time.
    pub fn answered(&mut self, round_trip: Duration) {
        self.out.pop_front();
        if self.round_trips.len() >= REMEMBERED {
            self.round_trips.pop_front();
        }
        self.round_trips.push_back(round_trip);
        let quickest = self.round_trips.iter().min().copied().unwrap_or(round_trip);
        let now = self.round_trips.iter().rev().take(NOW).min().copied().unwrap_or(round_trip);
        let queue = now.saturating_sub(quickest);
        if queue > QUEUE {
            self.rising = false;
            self.set(self.rate_bit_s * SLOWER);
        } else if queue < NO_QUEUE {
            self.set(self.rate_bit_s * if self.rising { FIRST_FASTER } else { FASTER });
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

    /// A link of this rate with a long queue, and a camera that always has a picture: the rate of the pacer after a minute, bit/s, the
    /// longest queue, and the longest in the second half.
    fn settle(link_bit_s: f64) -> (f64, Duration, Duration) {
        let mut pacer = Pacer::default();
        let begun = Instant::now();
        let (mut now, mut free) = (begun, begun);
        let (mut longest, mut settled) = (Duration::ZERO, Duration::ZERO);
        let mut pings: VecDeque<(Instant, Duration)> = VecDeque::new();
        let mut count = 0;
        while now < begun + Duration::from_secs(60) {
            while let Some((_, takes)) = pings.front().copied().filter(|(at, _)| *at <= now) {
                pings.pop_front();
                pacer.answered(takes);
            }
            if let Some(due) = pacer.due(now).filter(|due| *due > now) {
                now = due;
                continue;
            }
            free = free.max(now) + Duration::from_secs_f64(1300.0 * 8.0 / link_bit_s);
            pacer.leave(1300, now);
            if pacer.look(now) {
                count += 1;
                // Now and then a packet is lost and sent again.
                let again = Duration::from_millis(if count % 6 == 0 { 30 } else { 0 });
                let takes = free - now + Duration::from_millis(12) + again;
                pings.push_back((now + takes, takes));
            }
            longest = longest.max(free - now);
            if now > begun + Duration::from_secs(30) {
                settled = settled.max(free - now);
            }
        }
        (pacer.rate_bit_s, longest, settled)
    }

    #[test]
    fn follows_the_link_and_leaves_no_queue_behind() {
        for link in [5e5, 2e6, 2e7] {
            let (rate, longest, queue) = settle(link);
            assert!(rate > 0.5 * link && rate < 1.3 * link, "{rate} on a link of {link}");
            // Some packets, whatever they take on this link.
            let most = Duration::from_millis(30) + Duration::from_secs_f64(4.0 * 1300.0 * 8.0 / link);
            assert!(queue < most, "{queue:?} on a link of {link}");
            assert!(longest < Duration::from_millis(400), "{longest:?} at first on a link of {link}");
        }
    }

    #[test]
    fn a_queue_makes_it_slower_down_to_a_least_and_its_end_faster_again() {
        let mut pacer = Pacer::default();
        let answer = |pacer: &mut Pacer, round_trips_ms: &[u64]| {
            for ms in round_trips_ms {
                pacer.answered(Duration::from_millis(*ms));
            }
        };
        answer(&mut pacer, &[10, 250, 12, 90, 11]);
        assert!(pacer.rate_bit_s > FIRST_BIT_S, "late ones among others prove nothing: {pacer:?}");
        let before = pacer.rate_bit_s;
        answer(&mut pacer, &[19, 19, 19]);
        assert!(pacer.rate_bit_s >= before, "a little more than usual changes nothing: {pacer:?}");
        answer(&mut pacer, &[50; 100]);
        assert_eq!(pacer.rate_bit_s.to_bits(), LEAST_BIT_S.to_bits(), "there is a least");
        assert_eq!(pacer.picture_bytes(), 2500, "of which a picture has a tenth of a second");
        // The way has become longer for good: another room.
        answer(&mut pacer, &[50; 2 * REMEMBERED]);
        assert!(pacer.rate_bit_s > LEAST_BIT_S, "what is usual is no queue: {}", pacer.rate_bit_s);
    }

    #[test]
    fn what_was_not_used_is_not_made_up_for_and_pings_are_few() {
        let (mut pacer, begun) = (Pacer::default(), Instant::now());
        assert_eq!(pacer.due(begun), None, "at once");
        pacer.leave(7500, begun);
        assert_eq!(pacer.due(begun), Some(begun + Duration::from_millis(60)), "60000 bit at 1 Mbit/s");
        let later = begun + Duration::from_secs(1);
        pacer.leave(7500, later);
        assert_eq!(pacer.due(later), Some(later + Duration::from_millis(60)), "counted from then");
        assert!(pacer.look(begun), "the first ping");
        assert!(!pacer.look(begun + LOOK / 2) && pacer.look(begun + LOOK), "one in a while");
    }

    #[test]
    fn nothing_follows_a_ping_that_is_out_for_long() {
        let (mut pacer, begun) = (Pacer::default(), Instant::now());
        assert!(pacer.look(begun) && pacer.look(begun + LOOK), "two are out");
        let late = begun + HELD_BACK + Duration::from_millis(1);
        assert_eq!(pacer.due(late), Some(late + LOOK_AFTER), "the first for too long");
        pacer.answered(late - begun);
        assert_eq!(pacer.due(late), None, "it was answered");
        let later = begun + LOOK + HELD_BACK + (late - begun) + Duration::from_millis(1);
        assert!(pacer.due(later).is_some(), "the second takes longer than the first by too much");
    }
}
