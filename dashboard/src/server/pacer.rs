//! How fast the view may leave for one viewer, so that it fills no queue on its way: what people ask and what they are answered passes
//! through the same radio, and would wait behind it. Pure.
//!
//! What the link carries is learnt from the images that arrived: what left from their first byte to their last, over the time until the
//! viewer had them, less what the way takes anyhow. One that was late proves nothing: a packet was sent again, or somebody was busy; so the quickest of late counts. Pieces of an
//! image leave a little faster than that, so that a link that has become better is noticed, and images follow each other with pauses.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// The rate as long as no image has arrived, and its limits, bit/s.
const FIRST_BIT_S: f64 = 2e6;
const LEAST_BIT_S: f64 = 1e5;
const MOST_BIT_S: f64 = 1e8;
/// So many images are remembered for the quickest among them, ...
const IMAGES: usize = 8;
/// ... and so many round trips.
const ROUND_TRIPS: usize = 100;
/// Pieces leave so much faster than what the link was seen to carry ...
const PROBE: f64 = 1.3;
/// ... of which everything together takes this share.
const SHARE: f64 = 0.6;
/// A picture should take no longer on the link: some ten a second fit beside data.
const ONE_PICTURE: Duration = Duration::from_millis(30);

/// The pace of one view.
#[derive(Debug, Default)]
pub struct Pacer {
    /// Of images that have arrived, bit/s. Newest last.
    rates_bit_s: VecDeque<f64>,
    /// Of pings. Newest last.
    round_trips: VecDeque<Duration>,
    /// When the last piece is out.
    out: Option<Instant>,
    /// When the share of what has left is used up.
    used: Option<Instant>,
    /// All that has left, B.
    left_bytes: u64,
}

impl Pacer {
    /// What the link carries, as far as it is known, bit/s.
    fn rate_bit_s(&self) -> f64 {
        self.rates_bit_s.iter().copied().reduce(f64::max).unwrap_or(FIRST_BIT_S)
    }

    /// So many bytes leave now.
    pub fn leave(&mut self, bytes: usize, now: Instant) {
        let takes = |bit_s: f64| Duration::from_secs_f64(bytes as f64 * 8.0 / bit_s);
        let rate = self.rate_bit_s();
        self.left_bytes += bytes as u64;
        // What was not used is not made up for, or it would leave in a burst.
        let after = |last: Option<Instant>| last.map_or(now, |last| last.max(now));
        self.out = Some(after(self.out) + takes(rate * PROBE));
        self.used = Some(after(self.used) + takes(rate * SHARE));
    }

    /// All that has left so far, B.
    pub fn left_bytes(&self) -> u64 {
        self.left_bytes
    }

    /// When the next piece may leave. `None`: at once.
    pub fn next_piece(&self) -> Option<Instant> {
        self.out
    }

    /// When the next image may begin. `None`: at once.
    pub fn next_image(&self) -> Option<Instant> {
        self.used
    }

    /// A ping that left before an image was answered after this time.
    pub fn answered(&mut self, round_trip: Duration) {
        push_bounded(&mut self.round_trips, round_trip, ROUND_TRIPS);
    }

    /// An image had arrived this long after it began to leave. `bytes`: with the data that left in between.
    pub fn arrived(&mut self, bytes: u64, took: Duration) {
        let way = self.round_trips.iter().min().copied().unwrap_or_default();
        let took_s = took.saturating_sub(way).as_secs_f64();
        // It cannot have arrived faster than it left.
        let most = (self.rate_bit_s() * PROBE).min(MOST_BIT_S);
        let rate = (bytes as f64 * 8.0 / took_s).min(most).max(LEAST_BIT_S);
        push_bounded(&mut self.rates_bit_s, rate, IMAGES);
    }

    /// What a picture may have, B.
    pub fn picture_bytes(&self) -> usize {
        (self.rate_bit_s() * ONE_PICTURE.as_secs_f64() / 8.0) as usize
    }
}

fn push_bounded<T>(queue: &mut VecDeque<T>, item: T, most: usize) {
    if queue.len() >= most {
        queue.pop_front();
    }
    queue.push_back(item);
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAY: Duration = Duration::from_millis(12);

    /// A link of this rate with a long queue.
    struct Link {
        bit_s: f64,
        free: Instant,
        longest: Duration,
    }

    impl Link {
        fn carry(&mut self, bytes: usize, now: Instant) -> Instant {
            self.free = self.free.max(now) + Duration::from_secs_f64(bytes as f64 * 8.0 / self.bit_s);
            self.longest = self.longest.max(self.free - now);
            self.free + WAY
        }
    }

    /// Sends this many images, some of which arrive late.
    fn send(pacer: &mut Pacer, link: &mut Link, mut now: Instant, images: u32) -> Instant {
        for count in 0..images {
            now = now.max(pacer.next_image().unwrap_or(now));
            pacer.answered(WAY + Duration::from_millis(u64::from(count % 7)));
            let (begun, mut arrives, before) = (now, now, pacer.left_bytes());
            let bytes = 8000.min(pacer.picture_bytes());
            for _ in 0..bytes.div_ceil(1000) {
                now = now.max(pacer.next_piece().unwrap_or(now));
                if count % 2 == 0 {
                    // Data between the pieces.
                    pacer.leave(300, now);
                    link.carry(300, now);
                }
                pacer.leave(1000, now);
                arrives = link.carry(1000, now);
            }
            if count % 3 == 1 {
                // A packet was lost and sent again.
                arrives += Duration::from_millis(30);
            }
            pacer.arrived(pacer.left_bytes() - before, arrives - begun);
            now = now.max(arrives);
        }
        now
    }

    #[test]
    fn follows_the_link_and_leaves_no_queue_behind() {
        for bit_s in [5e5, 2e6, 2e7] {
            let (mut pacer, begun) = (Pacer::default(), Instant::now());
            let mut link = Link { bit_s, free: begun, longest: Duration::ZERO };
            let now = send(&mut pacer, &mut link, begun, 100);
            let rate = pacer.rate_bit_s();
            assert!(rate > 0.6 * bit_s && rate < 1.3 * bit_s, "{rate} on a link of {bit_s}");
            let (rest, packets) = (Duration::from_millis(20), Duration::from_secs_f64(3.0 * 8000.0 / bit_s));
            link.longest = Duration::ZERO;
            let now = send(&mut pacer, &mut link, now, 100);
            assert!(link.longest < rest + packets, "{:?} on a link of {bit_s}", link.longest);

            link.bit_s /= 4.0;
            let now = send(&mut pacer, &mut link, now, 20);
            assert!(pacer.rate_bit_s() < 1.3 * link.bit_s, "a worse link is noticed: {}", pacer.rate_bit_s());
            link.bit_s *= 4.0;
            send(&mut pacer, &mut link, now, 30);
            assert!(pacer.rate_bit_s() > 0.6 * link.bit_s, "and a better one: {}", pacer.rate_bit_s());
        }
    }

    #[test]
    fn late_images_among_others_prove_nothing_and_there_are_limits() {
        let mut pacer = Pacer::default();
        pacer.answered(Duration::from_millis(10));
        // 10 kB in 40 ms.
        pacer.arrived(10_000, Duration::from_millis(50));
        let rate = pacer.rate_bit_s();
        assert!((rate - 2e6).abs() < 1.0, "{rate}");
        for _ in 0..IMAGES - 1 {
            pacer.arrived(10_000, Duration::from_secs(3));
        }
        assert_eq!(pacer.rate_bit_s().to_bits(), rate.to_bits(), "seven late ones");
        assert_eq!(pacer.picture_bytes(), 7500, "a picture has 30 ms");
        pacer.arrived(10_000, Duration::from_secs(3600));
        pacer.arrived(0, Duration::ZERO);
        assert!(pacer.rate_bit_s() >= LEAST_BIT_S, "there is a least");
        for _ in 0..200 {
            pacer.arrived(10_000, Duration::ZERO);
        }
        assert_eq!(pacer.rate_bit_s().to_bits(), MOST_BIT_S.to_bits(), "and a most");
    }

    #[test]
    fn pieces_follow_closely_and_images_with_pauses() {
        let (mut pacer, begun) = (Pacer::default(), Instant::now());
        assert_eq!((pacer.next_piece(), pacer.next_image()), (None, None), "at once");
        // 62400 bit at 2.6 and at 1.2 Mbit/s.
        pacer.leave(7800, begun);
        let at = |ms: u64, from: Instant| Some(from + Duration::from_millis(ms));
        assert_eq!((pacer.next_piece(), pacer.next_image()), (at(24, begun), at(52, begun)));
        let later = begun + Duration::from_secs(1);
        pacer.leave(7800, later);
        assert_eq!(pacer.next_piece(), at(24, later), "what was not used is not made up for");
    }
}
