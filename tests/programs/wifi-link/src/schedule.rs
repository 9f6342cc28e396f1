//! What leaves when: the link in virtual time. Pure: no clock, no thread, no socket.
//!
//! Each direction has a queue. The medium takes packets from the queues one after the other, each for as long as its bytes take
//! at the rate; then a packet is lost or flies for its delay. Times are durations since any common start, never decreasing.

use std::collections::VecDeque;
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::{Conditions, Medium};

/// Most bytes that fly at once in a direction: only a link without rate, but with delay, comes near.
const MAX_FLYING_BYTES: u64 = 64 << 20;

/// More than this behind its due time, a packet counts as late.
const LATE: Duration = Duration::from_millis(1);

/// Where a packet goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// What the car sends.
    CarToLaptop,
    /// What the laptop sends.
    LaptopToCar,
}

impl Direction {
    /// Both, in the order of their indices.
    pub const BOTH: [Self; 2] = [Self::CarToLaptop, Self::LaptopToCar];

    fn other(self) -> Self {
        match self {
            Self::CarToLaptop => Self::LaptopToCar,
            Self::LaptopToCar => Self::CarToLaptop,
        }
    }
}

/// What became of the packets of one direction. `sent_packets` is the sum of the delivered, the lost, the dropped, and of those
/// under way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Packets that came to the link.
    pub sent_packets: u64,
    /// Their bytes, with IP headers.
    pub sent_bytes: u64,
    /// Packets that the other side was given.
    pub delivered_packets: u64,
    /// Their bytes, with IP headers.
    pub delivered_bytes: u64,
    /// Packets that were lost at random.
    pub lost_packets: u64,
    /// Packets that found the queue full.
    pub queue_drops: u64,
    /// Packets that an outage swallowed: sent in it, or under way when it began.
    pub outage_drops: u64,
    /// Packets that the receiving network device refused: somebody has set it down.
    pub refused_packets: u64,
    /// Packets that wait for transmission or fly.
    pub under_way_packets: u64,
    /// Bytes that wait for transmission.
    pub queued_bytes: u64,
    /// How long a packet sent now would wait for its transmission if nothing else came.
    pub queue_delay: Duration,
    /// Packets that were handed over more than 1 ms behind their due time: an error of this machine, which is busy, not of the link.
    pub late_packets: u64,
    /// How far behind its due time a packet was handed over at worst.
    pub worst_lateness: Duration,
}

impl Counters {
    /// Packets that will never arrive, whatever the cause.
    pub fn gone_packets(&self) -> u64 {
        self.lost_packets + self.queue_drops + self.outage_drops + self.refused_packets
    }
}

struct Packet<P> {
    payload: P,
    bytes: u64,
    /// In [0, 1): lost if below the loss.
    loss_draw: f64,
    /// In [0, 1): where in the range of the jitter.
    delay_draw: f64,
}

struct Flight<P> {
    due: Duration,
    bytes: u64,
    payload: P,
}

struct OnAir<P> {
    packet: Packet<P>,
    end: Duration,
}

struct Lane<P> {
    waiting: VecDeque<Packet<P>>,
    waiting_bytes: u64,
    on_air: Option<OnAir<P>>,
    /// In the order of their due times.
    flying: VecDeque<Flight<P>>,
    flying_bytes: u64,
    /// No packet arrives before this one did.
    last_due: Duration,
    rng: Pcg64Mcg,
    counters: Counters,
}

impl<P> Lane<P> {
    fn new(seed: u64, direction: Direction) -> Self {
        Self {
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            on_air: None,
            flying: VecDeque::new(),
            flying_bytes: 0,
            last_due: Duration::ZERO,
            rng: generator(seed, direction),
            counters: Counters::default(),
        }
    }

    fn under_way(&self) -> u64 {
        (self.waiting.len() + usize::from(self.on_air.is_some()) + self.flying.len()) as u64
    }

    /// Drops all but what arrives by `last`.
    fn drop_after(&mut self, last: Option<Duration>) {
        let before = self.under_way();
        self.waiting.clear();
        self.waiting_bytes = 0;
        self.on_air = None;
        while self.flying.back().is_some_and(|flight| Some(flight.due) > last) {
            let flight = self.flying.pop_back().expect("it was just seen");
            self.flying_bytes -= flight.bytes;
        }
        self.counters.outage_drops += before - self.under_way();
    }
}

/// Each direction draws from numbers of its own, so that the traffic of one changes nothing for the other.
fn generator(seed: u64, direction: Direction) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(seed ^ ((direction as u64) << 63))
}

#[derive(Clone, Copy)]
struct Outage {
    begin: Duration,
    end: Duration,
    begun: bool,
}

/// The link in virtual time. `P` is what a packet carries; the schedule never looks into it.
pub struct Schedule<P> {
    conditions: Conditions,
    lanes: [Lane<P>; 2],
    /// Who may send next where both want to.
    turn: Direction,
    outages: Vec<Outage>,
    now: Duration,
}

impl<P> Schedule<P> {
    /// An idle link. The conditions are taken as checked.
    pub fn new(conditions: Conditions) -> Self {
        let lanes = Direction::BOTH.map(|direction| Lane::new(conditions.seed, direction));
        Self { conditions, lanes, turn: Direction::CarToLaptop, outages: Vec::new(), now: Duration::ZERO }
    }

    /// What holds now.
    pub fn conditions(&self) -> &Conditions {
        &self.conditions
    }

    /// From `now` on other conditions hold. What is on the air or flies keeps its times; what waits goes at the new rate. Another
    /// seed begins its numbers anew.
    pub fn set(&mut self, now: Duration, conditions: Conditions) {
        self.advance(now);
        if conditions.seed != self.conditions.seed {
            for direction in Direction::BOTH {
                self.lanes[direction as usize].rng = generator(conditions.seed, direction);
            }
        }
        self.conditions = conditions;
        self.advance(now);
    }

    /// Nothing passes from `now` on, also nothing that is under way or already due.
    pub fn cut(&mut self, now: Duration) {
        self.advance(now);
        self.outages.push(Outage { begin: self.now, end: Duration::MAX, begun: true });
        for lane in &mut self.lanes {
            lane.drop_after(None);
        }
    }

    /// Nothing arrives from `begin` to `end`, and what is under way at `begin` never does. A begin in the past means now.
    pub fn outage(&mut self, begin: Duration, end: Duration) {
        let begin = begin.max(self.now);
        if begin < end {
            self.outages.push(Outage { begin, end, begun: false });
        }
    }

    /// Ends every outage that has begun. Later ones still come.
    pub fn restore(&mut self, now: Duration) {
        self.advance(now);
        let now = self.now;
        self.outages.retain(|outage| outage.begin > now);
    }

    /// Whether an outage holds at `now`.
    pub fn is_cut(&self, now: Duration) -> bool {
        self.outages.iter().any(|outage| outage.begin <= now && now < outage.end)
    }

    /// A packet comes to the link.
    pub fn offer(&mut self, now: Duration, direction: Direction, bytes: usize, payload: P) {
        self.advance(now);
        let is_cut = self.is_cut(self.now);
        let limit = self.conditions.queue.bytes(self.conditions.rate_bit_s);
        let lane = &mut self.lanes[direction as usize];
        let bytes = bytes as u64;
        lane.counters.sent_packets += 1;
        lane.counters.sent_bytes += bytes;
        // Drawn also for those that are dropped, so that the n-th packet always meets the same numbers.
        let (loss_draw, delay_draw) = (lane.rng.random(), lane.rng.random());
        if is_cut {
            lane.counters.outage_drops += 1;
        } else if !lane.waiting.is_empty() && lane.waiting_bytes.saturating_add(bytes) > limit {
            lane.counters.queue_drops += 1;
        } else {
            lane.waiting_bytes += bytes;
            lane.waiting.push_back(Packet { payload, bytes, loss_draw, delay_draw });
            self.advance(now);
        }
    }

    /// The next packet that has arrived by `now`, in the order of arrival.
    pub fn due(&mut self, now: Duration) -> Option<(Direction, P)> {
        self.advance(now);
        let due_of = |direction: &Direction| self.lanes[*direction as usize].flying.front().map(|flight| flight.due);
        let first = Direction::BOTH
            .into_iter()
            .filter(|direction| due_of(direction).is_some_and(|due| due <= self.now))
            .min_by_key(due_of)?;
        let lane = &mut self.lanes[first as usize];
        let flight = lane.flying.pop_front().expect("it was just seen");
        lane.flying_bytes -= flight.bytes;
        lane.counters.delivered_packets += 1;
        lane.counters.delivered_bytes += flight.bytes;
        let lateness = self.now.saturating_sub(flight.due);
        lane.counters.late_packets += u64::from(lateness > LATE);
        lane.counters.worst_lateness = lane.counters.worst_lateness.max(lateness);
        Some((first, flight.payload))
    }

    /// The packet that [`Schedule::due`] gave last for this direction was not taken after all.
    pub fn refused(&mut self, direction: Direction, bytes: usize) {
        let counters = &mut self.lanes[direction as usize].counters;
        counters.delivered_packets -= 1;
        counters.delivered_bytes -= bytes as u64;
        counters.refused_packets += 1;
    }

    /// When something happens next if nothing else is sent; `None`: never. May be in the past, then something is due.
    pub fn next_event(&self) -> Option<Duration> {
        let of_lanes = self.lanes.iter().flat_map(|lane| {
            [lane.on_air.as_ref().map(|on_air| on_air.end), lane.flying.front().map(|flight| flight.due)]
        });
        of_lanes.flatten().chain(self.next_outage()).min()
    }

    /// What became of the packets of a direction by `now`.
    pub fn counters(&mut self, now: Duration, direction: Direction) -> Counters {
        self.advance(now);
        let lane = &self.lanes[direction as usize];
        Counters {
            under_way_packets: lane.under_way(),
            queued_bytes: lane.waiting_bytes,
            queue_delay: self.queue_delay(direction),
            ..lane.counters
        }
    }

    fn queue_delay(&self, direction: Direction) -> Duration {
        let (own, other) = (&self.lanes[direction as usize], &self.lanes[direction.other() as usize]);
        let mut begin = own.on_air.as_ref().map_or(self.now, |on_air| on_air.end);
        let mut bytes = own.waiting_bytes;
        if self.conditions.medium == Medium::Shared {
            begin = begin.max(other.on_air.as_ref().map_or(self.now, |on_air| on_air.end));
            // They take turns: one of theirs for each of ours, and one more where it is their turn now.
            let theirs = own.waiting.len() + usize::from(self.turn != direction);
            bytes += other.waiting.iter().take(theirs).map(|packet| packet.bytes).sum::<u64>();
        }
        begin.saturating_sub(self.now) + air_time(bytes, self.conditions.rate_bit_s)
    }

    fn next_outage(&self) -> Option<Duration> {
        self.outages.iter().filter(|outage| !outage.begun).map(|outage| outage.begin).min()
    }

    /// Carries out what happens up to `now`, each thing at its own time, however late this is called.
    fn advance(&mut self, now: Duration) {
        let now = self.now.max(now);
        loop {
            self.begin_transmissions();
            let next_end = Direction::BOTH
                .into_iter()
                .filter_map(|direction| Some((self.lanes[direction as usize].on_air.as_ref()?.end, direction)))
                .min_by_key(|(end, _)| *end)
                .filter(|(end, _)| *end <= now);
            let next_outage = self.next_outage().filter(|begin| *begin <= now);
            match (next_outage, next_end) {
                (Some(begin), end) if end.is_none_or(|(end, _)| begin <= end) => self.begin_outage(begin),
                (_, Some((end, direction))) => self.end_transmission(end, direction),
                (_, None) => break,
            }
        }
        self.now = now;
        self.outages.retain(|outage| outage.end > now || !outage.begun);
    }

    fn begin_outage(&mut self, begin: Duration) {
        self.now = begin.max(self.now);
        for outage in &mut self.outages {
            outage.begun |= outage.begin <= begin;
        }
        for lane in &mut self.lanes {
            lane.drop_after(Some(begin));
        }
    }

    fn begin_transmissions(&mut self) {
        for direction in [self.turn, self.turn.other()] {
            let own_is_free = self.lanes[direction as usize].on_air.is_none();
            let other_is_free = self.lanes[direction.other() as usize].on_air.is_none();
            if !own_is_free || (self.conditions.medium == Medium::Shared && !other_is_free) {
                continue;
            }
            let lane = &mut self.lanes[direction as usize];
            if let Some(packet) = lane.waiting.pop_front() {
                lane.waiting_bytes -= packet.bytes;
                let end = self.now + air_time(packet.bytes, self.conditions.rate_bit_s);
                lane.on_air = Some(OnAir { packet, end });
                self.turn = direction.other();
            }
        }
    }

    fn end_transmission(&mut self, end: Duration, direction: Direction) {
        self.now = end.max(self.now);
        let lane = &mut self.lanes[direction as usize];
        let OnAir { packet, .. } = lane.on_air.take().expect("its end was just seen");
        if packet.loss_draw < self.conditions.loss {
            lane.counters.lost_packets += 1;
        } else if lane.flying_bytes + packet.bytes > MAX_FLYING_BYTES {
            lane.counters.queue_drops += 1;
        } else {
            let earliest = self.conditions.delay.saturating_sub(self.conditions.jitter);
            let delay = earliest + (2 * self.conditions.jitter).mul_f64(packet.delay_draw);
            lane.last_due = lane.last_due.max(end + delay);
            lane.flying_bytes += packet.bytes;
            lane.flying.push_back(Flight { due: lane.last_due, bytes: packet.bytes, payload: packet.payload });
        }
    }
}

/// How long the medium is taken; rounded up, so that the rate is never exceeded.
fn air_time(bytes: u64, rate_bit_s: Option<u64>) -> Duration {
    let Some(rate) = rate_bit_s else { return Duration::ZERO };
    let ns = (u128::from(bytes) * 8_000_000_000).div_ceil(u128::from(rate));
    Duration::from_nanos(u64::try_from(ns).unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::Direction::{CarToLaptop, LaptopToCar};
    use super::*;
    use crate::Queue;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    /// 1 byte takes 1 ms; nothing else happens to it.
    fn plain() -> Conditions {
        Conditions { rate_bit_s: Some(8_000), queue: Queue::Bytes(u64::MAX), ..Conditions::perfect() }
    }

    /// All that arrives by `until`, with the times of its events as the relay would wake for them.
    fn arrivals<P>(schedule: &mut Schedule<P>, until: Duration) -> Vec<(Duration, Direction, P)> {
        let mut arrived = Vec::new();
        while let Some(now) = schedule.next_event().filter(|next| *next <= until) {
            while let Some((direction, payload)) = schedule.due(now) {
                arrived.push((now, direction, payload));
            }
        }
        arrived
    }

    #[test]
    fn a_packet_takes_its_air_time_and_then_its_delay() {
        let mut schedule = Schedule::new(Conditions { delay: ms(5), ..plain() });
        schedule.offer(ms(100), CarToLaptop, 10, 'a');
        schedule.offer(ms(100), CarToLaptop, 20, 'b');
        let expected = [(ms(115), CarToLaptop, 'a'), (ms(135), CarToLaptop, 'b')];
        assert_eq!(arrivals(&mut schedule, ms(1000)), expected, "10 ms and then 20 ms on the air, 5 ms each in flight");
        assert_eq!(schedule.next_event(), None, "nothing is left");
    }

    #[test]
    fn a_late_call_changes_no_due_time() {
        let mut schedule = Schedule::new(Conditions { delay: ms(5), ..plain() });
        schedule.offer(ms(0), CarToLaptop, 10, 'a');
        schedule.offer(ms(0), CarToLaptop, 10, 'b');
        assert_eq!(schedule.due(ms(15)), Some((CarToLaptop, 'a')), "due at 15 ms");
        schedule.offer(ms(400), CarToLaptop, 10, 'c');
        assert_eq!(schedule.due(ms(400)), Some((CarToLaptop, 'b')), "due at 25 ms");
        assert_eq!(
            schedule.counters(ms(400), CarToLaptop).worst_lateness,
            ms(375),
            "the delay of the caller is counted"
        );
        assert_eq!(
            arrivals(&mut schedule, ms(1000)),
            [(ms(415), CarToLaptop, 'c')],
            "the idle medium is taken at once"
        );
    }

    #[test]
    fn both_directions_share_the_medium_in_turn() {
        let mut schedule = Schedule::new(plain());
        for name in ['a', 'b', 'c'] {
            schedule.offer(ms(0), CarToLaptop, 10, name);
        }
        schedule.offer(ms(0), LaptopToCar, 10, 'x');
        let names: Vec<_> = arrivals(&mut schedule, ms(1000)).into_iter().map(|(at, _, name)| (at, name)).collect();
        assert_eq!(
            names,
            [(ms(10), 'a'), (ms(20), 'x'), (ms(30), 'b'), (ms(40), 'c')],
            "x waits for one packet, not for all"
        );
    }

    #[test]
    fn directions_that_do_not_share_send_at_once() {
        let mut schedule = Schedule::new(Conditions { medium: Medium::PerDirection, ..plain() });
        schedule.offer(ms(0), CarToLaptop, 10, 'a');
        schedule.offer(ms(0), LaptopToCar, 10, 'x');
        let expected = [(ms(10), CarToLaptop, 'a'), (ms(10), LaptopToCar, 'x')];
        assert_eq!(arrivals(&mut schedule, ms(1000)), expected, "neither waits");
    }

    #[test]
    fn a_full_queue_drops_what_comes_last_and_never_delays_by_more_than_its_limit() {
        let queue = Queue::Time(ms(100));
        let mut schedule = Schedule::new(Conditions { queue, ..plain() });
        for number in 0..50 {
            schedule.offer(ms(0), CarToLaptop, 10, number);
        }
        let counters = schedule.counters(ms(0), CarToLaptop);
        assert_eq!(counters.queue_drops, 39, "one is on the air, ten wait");
        assert_eq!(counters.queued_bytes, 100, "100 ms at 1 byte/ms");
        assert_eq!(counters.queue_delay, ms(110), "the queue and what is on the air");
        assert_eq!(schedule.counters(ms(55), CarToLaptop).queue_delay, ms(55), "it drains with time");
        let numbers: Vec<_> = arrivals(&mut schedule, ms(1000)).into_iter().map(|(_, _, number)| number).collect();
        assert_eq!(numbers, (0..11).collect::<Vec<_>>(), "the first eleven arrive");
        assert_eq!(schedule.counters(ms(1000), CarToLaptop).queue_delay, ms(0), "an idle link has no queue");
    }

    #[test]
    fn the_queue_delay_foretells_the_wait_behind_both_queues() {
        let mut schedule = Schedule::new(plain());
        for _ in 0..3 {
            schedule.offer(ms(0), CarToLaptop, 10, ' ');
            schedule.offer(ms(0), LaptopToCar, 7, ' ');
        }
        let foretold = schedule.counters(ms(4), LaptopToCar).queue_delay;
        schedule.offer(ms(4), LaptopToCar, 1, 'x');
        let (at, ..) = *arrivals(&mut schedule, ms(1000)).iter().find(|(_, _, name)| *name == 'x').expect("it arrives");
        assert_eq!(foretold + ms(4 + 1), at, "it was foretold at 4 ms, and takes 1 ms itself");
    }

    #[test]
    fn a_packet_larger_than_the_queue_still_passes_an_idle_link() {
        let mut schedule = Schedule::new(Conditions { queue: Queue::Bytes(0), ..plain() });
        schedule.offer(ms(0), CarToLaptop, 1000, 'a');
        assert_eq!(arrivals(&mut schedule, ms(2000)).len(), 1, "nothing waited before it");
    }

    #[test]
    fn jitter_stays_in_its_range_and_keeps_the_order() {
        let mut schedule = Schedule::new(Conditions { delay: ms(5), jitter: ms(3), ..Conditions::perfect() });
        let sent_at = |number: u64| Duration::from_micros(number * 100);
        let mut arrived = Vec::new();
        for number in 0..10_000 {
            arrived.extend(arrivals(&mut schedule, sent_at(number)));
            schedule.offer(sent_at(number), CarToLaptop, 100, number);
        }
        arrived.extend(arrivals(&mut schedule, ms(10_000)));
        assert_eq!(arrived.len(), 10_000, "nothing is lost");
        let (mut least, mut most) = (Duration::MAX, Duration::ZERO);
        for (position, (at, _, number)) in arrived.iter().enumerate() {
            assert_eq!(position as u64, *number, "the order is kept");
            let delay = at.checked_sub(sent_at(*number)).expect("nothing arrives before it was sent");
            (least, most) = (least.min(delay), most.max(delay));
        }
        assert!(least >= ms(2) && most <= ms(8), "delays from {least:?} to {most:?}, allowed 2 to 8 ms");
        // Order makes low delays rare at this rate: a packet waits for the slowest of those before it.
        assert!(most > ms(7), "delays reach {most:?} only, the range is not used");
    }

    #[test]
    fn jitter_is_uniform_where_packets_are_far_apart() {
        const COUNT: u32 = 10_000;
        let mut schedule = Schedule::new(Conditions { delay: ms(5), jitter: ms(3), ..Conditions::perfect() });
        let mut total = Duration::ZERO;
        for number in 0..COUNT {
            let sent_at = ms(20) * number;
            schedule.offer(sent_at, CarToLaptop, 100, ());
            total += arrivals(&mut schedule, sent_at + ms(10))[0].0.saturating_sub(sent_at);
        }
        // 6 sigma of the mean: the standard deviation of a uniform number is its range / sqrt(12).
        let bound_ms = 6.0 * (6.0 / 12_f64.sqrt()) / f64::from(COUNT).sqrt();
        let mean_ms = total.as_secs_f64() * 1e3 / f64::from(COUNT);
        assert!((mean_ms - 5.0).abs() < bound_ms, "the mean delay is {mean_ms} ms, expected 5 ± {bound_ms}");
    }

    #[test]
    fn loses_the_share_it_is_told_to() {
        const COUNT: u64 = 100_000;
        for loss in [0.0, 0.02, 0.5, 1.0] {
            let mut schedule = Schedule::new(Conditions { loss, ..Conditions::perfect() });
            for number in 0..COUNT {
                schedule.offer(Duration::from_micros(number), CarToLaptop, 100, ());
                schedule.due(Duration::from_micros(number));
            }
            let lost = schedule.counters(ms(1000), CarToLaptop).lost_packets as f64;
            let (expected, sigma) = (loss * COUNT as f64, (COUNT as f64 * loss * (1.0 - loss)).sqrt());
            assert!((lost - expected).abs() <= 6.0 * sigma, "lost {lost}, expected {expected} ± {}", 6.0 * sigma);
        }
    }

    #[test]
    fn the_same_seed_loses_the_same_packets_whatever_the_other_direction_does() {
        let survivors = |seed, with_other: bool| {
            let mut schedule = Schedule::new(Conditions { loss: 0.3, seed, ..Conditions::perfect() });
            for number in 0..1000 {
                schedule.offer(ms(number), CarToLaptop, 100, number);
                if with_other {
                    schedule.offer(ms(number), LaptopToCar, 100, number);
                }
            }
            let arrived = arrivals(&mut schedule, ms(2000));
            let of = |wanted| {
                arrived.iter().filter(move |(_, direction, _)| *direction == wanted).map(|(.., number)| *number)
            };
            (of(CarToLaptop).collect::<Vec<_>>(), of(LaptopToCar).collect::<Vec<_>>())
        };
        let (alone, both) = (survivors(7, false), survivors(7, true));
        assert_eq!(alone.0, both.0, "the traffic of the laptop changed the car's losses");
        assert_ne!(both.0, both.1, "the directions have numbers of their own");
        assert_ne!(alone.0, survivors(8, false).0, "the seed matters");
    }

    #[test]
    fn never_exceeds_the_rate() {
        const RATE: u64 = 1_000_003;
        let mut schedule =
            Schedule::new(Conditions { rate_bit_s: Some(RATE), queue: Queue::Bytes(20_000), ..Conditions::good() });
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let mut arrived_bits = 0;
        for step in 0..20_000_u64 {
            let now = Duration::from_micros(step * 500);
            while let Some((_, bytes)) = schedule.due(now) {
                arrived_bits += 8 * bytes as u128;
            }
            // All of it was sent since 0 s, so no burst is to be allowed for.
            assert!(
                arrived_bits * 1_000_000_000 <= now.as_nanos() * u128::from(RATE),
                "{arrived_bits} bits by {now:?}"
            );
            for direction in Direction::BOTH {
                let bytes = rng.random_range(20..1500);
                schedule.offer(now, direction, bytes, bytes);
            }
        }
        assert!(arrived_bits > 0, "nothing arrived, so nothing was tested");
    }

    #[test]
    fn a_cut_link_passes_nothing_not_even_what_is_due() {
        let mut schedule = Schedule::new(Conditions { delay: ms(5), ..plain() });
        for name in ['a', 'b', 'c'] {
            schedule.offer(ms(0), CarToLaptop, 10, name);
        }
        // a is due at 15 ms, b flies since 20 ms, c is on the air.
        schedule.cut(ms(22));
        schedule.offer(ms(23), CarToLaptop, 10, 'd');
        assert!(schedule.is_cut(ms(1000)), "it stays cut");
        assert_eq!(arrivals(&mut schedule, ms(1000)), [], "the link is cut");
        assert_eq!(schedule.counters(ms(1000), CarToLaptop).outage_drops, 4, "all four are counted");
        schedule.restore(ms(1000));
        schedule.offer(ms(1000), CarToLaptop, 10, 'e');
        assert_eq!(arrivals(&mut schedule, ms(2000)), [(ms(1015), CarToLaptop, 'e')], "it passes again, at once");
    }

    #[test]
    fn a_planned_outage_begins_and_ends_by_itself_however_late_the_calls_are() {
        let mut schedule = Schedule::new(plain());
        schedule.outage(ms(15), ms(50));
        for name in ['a', 'b'] {
            schedule.offer(ms(0), CarToLaptop, 10, name);
        }
        schedule.offer(ms(49), CarToLaptop, 10, 'c');
        assert!(schedule.is_cut(ms(49)) && !schedule.is_cut(ms(50)), "the end does not belong to it");
        schedule.offer(ms(50), CarToLaptop, 10, 'd');
        let names: Vec<_> = arrivals(&mut schedule, ms(1000)).into_iter().map(|(.., name)| name).collect();
        assert_eq!(names, ['a', 'd'], "a was through at 10 ms, b was on the air at 15 ms, c came in the outage");
    }

    #[test]
    fn restoring_ends_a_planned_outage_but_not_a_later_one() {
        let mut schedule = Schedule::<()>::new(plain());
        schedule.outage(ms(10), ms(20));
        schedule.outage(ms(30), ms(40));
        schedule.restore(ms(15));
        assert!(!schedule.is_cut(ms(16)), "the first was ended");
        assert!(schedule.is_cut(ms(35)), "the second comes");
    }

    #[test]
    fn other_conditions_hold_for_what_waits() {
        let mut schedule = Schedule::new(plain());
        for name in ['a', 'b'] {
            schedule.offer(ms(0), CarToLaptop, 10, name);
        }
        schedule.set(ms(5), Conditions { rate_bit_s: Some(80_000), delay: ms(100), ..plain() });
        let expected = [(ms(110), CarToLaptop, 'a'), (ms(111), CarToLaptop, 'b')];
        assert_eq!(arrivals(&mut schedule, ms(1000)), expected, "a ends its 10 ms, b takes 1 ms; both fly 100 ms");
    }

    #[test]
    fn a_shorter_delay_lets_nothing_overtake() {
        let mut schedule = Schedule::new(Conditions { delay: ms(100), ..plain() });
        schedule.offer(ms(0), CarToLaptop, 1, 'a');
        schedule.set(ms(10), plain());
        schedule.offer(ms(10), CarToLaptop, 1, 'b');
        let expected = [(ms(101), CarToLaptop, 'a'), (ms(101), CarToLaptop, 'b')];
        assert_eq!(arrivals(&mut schedule, ms(1000)), expected, "b arrives with a");
        assert_eq!(
            schedule.counters(ms(1000), CarToLaptop).worst_lateness,
            ms(0),
            "and is not late: it was due with a"
        );
    }

    #[test]
    fn every_packet_is_accounted_for() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let mut schedule = Schedule::new(Conditions { loss: 0.1, queue: Queue::Bytes(5000), ..Conditions::slow() });
        let (mut now, mut arrived) = (Duration::ZERO, [0, 0]);
        for _ in 0..50_000 {
            now += Duration::from_micros(rng.random_range(0..4000));
            match rng.random_range(0..1000) {
                0 => schedule.cut(now),
                1..5 => schedule.restore(now),
                5 => schedule.outage(now + ms(rng.random_range(0..50)), now + ms(rng.random_range(0..100))),
                6 => schedule.set(now, Conditions { rate_bit_s: None, ..Conditions::good() }),
                7..10 => schedule.set(now, Conditions { queue: Queue::Bytes(5000), ..Conditions::slow() }),
                _ => {
                    let direction = Direction::BOTH[rng.random_range(0..2)];
                    schedule.offer(now, direction, rng.random_range(20..1500), ());
                }
            }
            while let Some((direction, ())) = schedule.due(now) {
                arrived[direction as usize] += 1;
            }
            for direction in Direction::BOTH {
                let counters = schedule.counters(now, direction);
                let sum = counters.delivered_packets + counters.gone_packets() + counters.under_way_packets;
                assert_eq!(counters.sent_packets, sum, "at {now:?}: {counters:?}");
                assert_eq!(counters.delivered_packets, arrived[direction as usize], "at {now:?}: {counters:?}");
            }
        }
        let counters = schedule.counters(now, CarToLaptop);
        assert!(
            counters.lost_packets > 0 && counters.outage_drops > 0 && counters.queue_drops > 0,
            "untested: {counters:?}"
        );
    }
}
