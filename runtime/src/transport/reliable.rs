//! How an edge marked `reliable` loses nothing: the writer keeps its last samples, the reader notices gaps in the sequence
//! numbers and asks for what is missing. Readers also say how far they have come, and a writer drops nothing that one of them
//! lacks. Pure: no link, no thread; told the time.
//!
//! Zenoh delivers in order and, told to block, drops nothing on the way out. But a buffer in shared memory is declared invalid
//! when the machine is so busy that a watchdog thread does not run for 100 ms, and the sample is gone
//! (docs/decisions/0004-reliable-edges.md).

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::time::{Duration, Instant};

use carril_messages::Payload;
use serde::{Deserialize, Serialize};

use super::Wire;
use crate::ports::Incoming;

/// A writer keeps at most so many samples.
pub const RING_SAMPLES: usize = 512;
/// A writer keeps at most this part of its shared memory. Readers hold as much again while they catch up, and the frame that is
/// being written needs room, too: a full pool would send frames through the socket, just when the machine is busy.
pub const RING_PART_OF_POOL: usize = 4;
/// A reader holds back at most so many samples behind a gap; then it goes on without the missing ones.
pub const HELD_SAMPLES: usize = RING_SAMPLES;

/// A reader says how far it has come at least once in this many samples, and after each large one.
pub const ACK_EVERY: u64 = 8;
/// A writer does not wait for a reader that has said nothing for this long: it hangs. As long as Zenoh waits before it closes
/// a link that takes nothing (`wait_before_close`). One that dies is forgotten at once.
pub const READER_SILENCE: Duration = Duration::from_secs(5);
/// A reader asks for so many samples at a time: a longer answer would keep it silent for long on a busy machine.
pub const REPLAY_BATCH: u64 = 8;

/// How far a reader has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ack {
    /// Tells readers apart.
    pub reader: u64,
    /// Since when the reader exists, ns on the car's clock.
    pub since: u64,
    /// Life of the writer. 0: it has heard nothing yet.
    pub epoch: u64,
    /// It has everything before this.
    pub next: u64,
}

/// The readers of a port, as far as they have said something.
#[derive(Default)]
pub struct Readers(HashMap<u64, (Ack, Instant)>);

impl Readers {
    /// A reader has said how far it has come. One that is not there, or no longer, is not believed: its word may arrive after
    /// the news that it has gone, and nobody would wait for more of it in vain.
    pub fn hear(&mut self, ack: Ack, now: Instant) {
        if let Some(known) = self.0.get_mut(&ack.reader) {
            *known = (ack, now);
        }
    }

    /// A reader has come that has said nothing yet: it may lack everything that was sent since it exists.
    pub fn expect(&mut self, reader: u64, since: u64, now: Instant) {
        let ack = Ack { reader, since, epoch: 0, next: 0 };
        self.0.entry(reader).or_insert((ack, now));
    }

    /// A reader is gone.
    pub fn forget(&mut self, reader: u64) {
        self.0.remove(&reader);
    }

    /// Whether a living reader still lacks sample `seq`.
    pub fn lack(&mut self, epoch: u64, seq: u64, now: Instant) -> bool {
        self.0.retain(|_, (_, heard)| now.duration_since(*heard) < READER_SILENCE);
        self.0.values().any(|(ack, _)| {
            if ack.epoch == epoch {
                return ack.next <= seq;
            }
            // It has nothing of this life of the writer yet, and wants all of it if it was there first.
            ack.epoch < epoch && ack.since <= epoch
        })
    }
}

/// What a reader asks for: the samples of `epoch` from `from` on, at most `count`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReplayRequest {
    /// Life of the writer.
    pub epoch: u64,
    /// First sequence number.
    pub from: u64,
    /// So many.
    pub count: u64,
}

/// Ends the answer to a [`ReplayRequest`]: what the writer has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReplayEnd {
    /// Life of the writer. 0: it has sent nothing yet.
    pub epoch: u64,
    /// The oldest sequence number that it still has.
    pub oldest: u64,
    /// One more than the newest.
    pub next: u64,
}

/// The last samples of a port.
pub struct ReplayRing {
    max_bytes: usize,
    samples: VecDeque<Kept>,
    bytes: usize,
    epoch: u64,
    next: u64,
}

struct Kept {
    seq: u64,
    header: Vec<u8>,
    payload: Payload,
}

impl ReplayRing {
    /// Keeps at most `max_bytes` of payload.
    pub fn new(max_bytes: usize) -> Self {
        Self { max_bytes, samples: VecDeque::new(), bytes: 0, epoch: 0, next: 0 }
    }

    /// Keeps a sample; the oldest go when there is no room.
    pub(crate) fn keep(&mut self, epoch: u64, seq: u64, wire: &Wire) {
        if epoch != self.epoch {
            *self = Self { epoch, ..Self::new(self.max_bytes) };
        }
        self.bytes += wire.payload.len();
        self.samples.push_back(Kept { seq, header: wire.header.clone(), payload: wire.payload.clone() });
        self.next = seq + 1;
        while self.samples.len() > RING_SAMPLES || (self.bytes > self.max_bytes && self.samples.len() > 1) {
            let gone = self.samples.pop_front().expect("the loop's condition says that there are samples");
            self.bytes -= gone.payload.len();
        }
    }

    /// The oldest sample, if it would have to go for one of `len` bytes: its epoch and sequence number.
    pub fn would_drop(&self, len: usize) -> Option<(u64, u64)> {
        let full = self.samples.len() >= RING_SAMPLES || self.bytes + len > self.max_bytes;
        self.samples.front().filter(|_| full).map(|oldest| (self.epoch, oldest.seq))
    }

    /// The samples asked for that are still here (headers and payloads), and what there is.
    pub fn answer(&self, request: ReplayRequest) -> (Vec<(Vec<u8>, Payload)>, ReplayEnd) {
        let wanted = request.from..request.from.saturating_add(request.count);
        let samples = if request.epoch == self.epoch {
            self.samples.iter().filter(|kept| wanted.contains(&kept.seq)).map(Kept::parts).collect()
        } else {
            Vec::new()
        };
        let oldest = self.samples.front().map_or(self.next, |kept| kept.seq);
        (samples, ReplayEnd { epoch: self.epoch, oldest, next: self.next })
    }
}

impl Kept {
    fn parts(&self) -> (Vec<u8>, Payload) {
        (self.header.clone(), self.payload.clone())
    }
}

/// Puts what a reader gets into order: each sample once, and none before its predecessor.
#[derive(Debug)]
pub struct Resequencer {
    reader_epoch: u64,
    epoch: u64,
    next: u64,
    known_next: u64,
    held: BTreeMap<u64, Incoming>,
    lost: u64,
}

impl Resequencer {
    /// For a reader that exists since `reader_epoch`. Of writers that were there before it wants what comes from now on, of
    /// writers that start later it wants everything.
    pub fn new(reader_epoch: u64) -> Self {
        Self { reader_epoch, epoch: 0, next: 0, known_next: 0, held: BTreeMap::new(), lost: 0 }
    }

    /// Takes a sample in, from the link or from a replay. What can be delivered now goes to `deliver`.
    pub fn offer(&mut self, incoming: Incoming, deliver: &mut dyn FnMut(Incoming)) {
        let (epoch, seq) = (incoming.header().epoch, incoming.header().seq);
        if epoch < self.epoch {
            return;
        }
        if epoch > self.epoch {
            self.begin(epoch, seq, deliver);
        }
        if seq >= self.next {
            self.held.insert(seq, incoming);
            self.known_next = self.known_next.max(seq.saturating_add(1));
        }
        self.release(deliver);
        while self.held.len() > HELD_SAMPLES {
            self.skip_gap(deliver);
        }
    }

    /// A writer begins: a new one, or the old one again.
    fn begin(&mut self, epoch: u64, seq: u64, deliver: &mut dyn FnMut(Incoming)) {
        while !self.held.is_empty() {
            self.skip_gap(deliver);
        }
        self.epoch = epoch;
        self.next = if epoch >= self.reader_epoch { 0 } else { seq };
        self.known_next = self.next;
    }

    fn release(&mut self, deliver: &mut dyn FnMut(Incoming)) {
        while let Some(incoming) = self.held.remove(&self.next) {
            deliver(incoming);
            self.next += 1;
        }
    }

    fn skip_gap(&mut self, deliver: &mut dyn FnMut(Incoming)) {
        if let Some((&first, _)) = self.held.first_key_value() {
            self.lost += first - self.next;
            self.next = first;
        }
        self.release(deliver);
    }

    /// What is missing, as a question to the writer. `None`: nothing is known to be.
    pub fn missing(&self) -> Option<ReplayRequest> {
        let end = self.held.first_key_value().map_or(self.known_next, |(&first, _)| first);
        let count = end.saturating_sub(self.next).min(REPLAY_BATCH);
        (count > 0).then_some(ReplayRequest { epoch: self.epoch, from: self.next, count })
    }

    /// Asks whether there is more than what has come.
    pub fn anything_newer(&self) -> ReplayRequest {
        ReplayRequest { epoch: self.epoch, from: self.next, count: REPLAY_BATCH }
    }

    /// The end of an answer: what the writer no longer has is lost.
    pub fn end_of_replay(&mut self, end: ReplayEnd, deliver: &mut dyn FnMut(Incoming)) {
        if end.epoch > self.epoch {
            self.begin(end.epoch, end.next, deliver);
        }
        if end.epoch != self.epoch {
            return;
        }
        self.known_next = self.known_next.max(end.next);
        if end.oldest > self.next {
            let reachable = self.held.first_key_value().map_or(end.oldest, |(&first, _)| first.min(end.oldest));
            self.lost += reachable - self.next;
            self.next = reachable;
            self.release(deliver);
        }
    }

    /// How far the reader has come, as `reader` says it to the writer.
    pub fn ack(&self, reader: u64) -> Ack {
        Ack { reader, since: self.reader_epoch, epoch: self.epoch, next: self.next }
    }

    /// Samples that are lost for good.
    pub fn lost(&self) -> u64 {
        self.lost
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use carril_messages::{Command, Header, Message, Meta, Origins, Stamp};

    use super::*;

    fn header(epoch: u64, seq: u64) -> Header {
        let (origins, meta) = (Origins::none(), Meta::new());
        Header { epoch, seq, stamp: Stamp::ZERO, origins, message_type: Command::TYPE, meta }
    }

    fn sample(epoch: u64, seq: u64) -> Incoming {
        Incoming::Wire(Arc::new(header(epoch, seq)), Payload::default())
    }

    /// Offers samples of epoch 10 and gives the sequence numbers that come out.
    fn offer(reader: &mut Resequencer, seqs: &[u64]) -> Vec<u64> {
        let mut out = Vec::new();
        for &seq in seqs {
            reader.offer(sample(10, seq), &mut |incoming| out.push(incoming.header().seq));
        }
        out
    }

    #[test]
    fn delivers_in_order_and_once() {
        let mut reader = Resequencer::new(1);
        assert_eq!(offer(&mut reader, &[0, 1, 1, 3, 0]), [0, 1], "3 waits for 2, repeats are dropped");
        assert_eq!(reader.missing(), Some(ReplayRequest { epoch: 10, from: 2, count: 1 }), "the gap is known");
        assert_eq!(offer(&mut reader, &[2]), [2, 3], "then both come");
        assert_eq!((reader.missing(), reader.lost()), (None, 0), "nothing is missing or lost");
    }

    #[test]
    fn wants_everything_of_a_later_writer_and_joins_an_earlier_one() {
        let mut later = Resequencer::new(20);
        assert_eq!(offer(&mut later, &[5, 6]), [5, 6], "the writer was there first");
        let mut earlier = Resequencer::new(1);
        assert_eq!(offer(&mut earlier, &[2]), [0_u64; 0], "the reader was there first: 0 and 1 are wanted");
        assert_eq!(offer(&mut earlier, &[0, 1]), [0, 1, 2], "they come");
    }

    #[test]
    fn a_restarted_writer_ends_the_old_gap() {
        let mut reader = Resequencer::new(1);
        offer(&mut reader, &[0, 2]);
        let mut out = Vec::new();
        reader.offer(sample(11, 0), &mut |incoming| out.push((incoming.header().epoch, incoming.header().seq)));
        assert_eq!(out, [(10, 2), (11, 0)], "what was held comes first");
        assert_eq!(reader.lost(), 1, "1 of the old epoch is lost");
        assert_eq!(offer(&mut reader, &[1]), [0_u64; 0], "a late sample of the dead writer is dropped");
    }

    #[test]
    fn what_the_writer_no_longer_has_is_lost() {
        let mut reader = Resequencer::new(1);
        offer(&mut reader, &[0, 9]);
        let mut out = Vec::new();
        let end = ReplayEnd { epoch: 10, oldest: 4, next: 10 };
        reader.end_of_replay(end, &mut |incoming| out.push(incoming.header().seq));
        assert_eq!(out, [0_u64; 0], "4 to 8 may still come");
        assert_eq!(reader.missing(), Some(ReplayRequest { epoch: 10, from: 4, count: 5 }), "they are asked for");
        assert_eq!(reader.lost(), 3, "1 to 3 are lost");
    }

    #[test]
    fn learns_of_a_lost_tail() {
        let mut reader = Resequencer::new(1);
        offer(&mut reader, &[0]);
        assert_eq!(reader.missing(), None, "no gap is seen");
        reader.end_of_replay(ReplayEnd { epoch: 10, oldest: 0, next: 3 }, &mut |_| ());
        assert_eq!(reader.missing(), Some(ReplayRequest { epoch: 10, from: 1, count: 2 }), "the writer told");
    }

    #[test]
    fn the_ring_keeps_the_newest_within_its_limits() {
        let mut ring = ReplayRing::new(1000);
        let wire = |len: usize| Wire { header: vec![1], payload: Payload::from(vec![0; len]) };
        (0..600).for_each(|seq| ring.keep(10, seq, &wire(1)));
        let (samples, end) = ring.answer(ReplayRequest { epoch: 10, from: 80, count: 10 });
        assert_eq!(samples.len(), 2, "88 and 89 are still here");
        assert_eq!(end, ReplayEnd { epoch: 10, oldest: 88, next: 600 }, "and it says so");
        (600..603).for_each(|seq| ring.keep(10, seq, &wire(500)));
        let (_, end) = ring.answer(ReplayRequest { epoch: 10, from: 0, count: 0 });
        assert_eq!(end.oldest, 601, "bytes count, too");
        ring.keep(11, 0, &wire(1));
        let (samples, end) = ring.answer(ReplayRequest { epoch: 10, from: 0, count: 99 });
        assert_eq!((samples.len(), end.epoch), (0, 11), "a new epoch begins again");
    }

    #[test]
    fn a_writer_waits_for_the_slowest_living_reader() {
        let (mut readers, now) = (Readers::default(), Instant::now());
        assert!(!readers.lack(10, 5, now), "nobody reads");
        let ack = |reader, next| Ack { reader, since: 1, epoch: 10, next };
        for reader in 1..=3 {
            readers.expect(reader, 20, now);
        }
        readers.hear(ack(1, 9), now);
        readers.hear(ack(2, 5), now);
        assert!(readers.lack(10, 5, now), "the second lacks it");
        readers.hear(ack(2, 6), now);
        assert!(!readers.lack(10, 5, now), "now both have it");
        readers.hear(Ack { reader: 3, since: 1, epoch: 0, next: 0 }, now);
        assert!(readers.lack(10, 5, now), "the third was there before the writer and has nothing yet");
        readers.hear(Ack { reader: 3, since: 20, epoch: 0, next: 0 }, now);
        assert!(!readers.lack(10, 5, now), "one that came later wants only what comes from now on");
        readers.expect(5, 20, now);
        readers.hear(ack(2, 9), now);
        assert!(!readers.lack(10, 5, now), "one that comes later than the writer does not hold it up");
        readers.expect(4, 1, now);
        assert!(readers.lack(10, 0, now), "of a fourth nothing is known yet");
        readers.hear(ack(4, 9), now);
        readers.expect(4, 1, now);
        assert!(!readers.lack(10, 5, now), "it has said that it has it");
        readers.hear(ack(2, 0), now);
        readers.forget(3);
        assert!(!readers.lack(10, 5, now + READER_SILENCE), "the silent are not waited for");
    }

    #[test]
    fn gives_up_a_gap_when_too_much_waits() {
        let mut reader = Resequencer::new(1);
        let seqs: Vec<u64> = (1..=HELD_SAMPLES as u64 + 1).collect();
        assert_eq!(offer(&mut reader, &seqs).len(), HELD_SAMPLES + 1, "all that was held");
        assert_eq!(reader.lost(), 1, "sample 0 is lost");
    }
}
