//! The bounded queue in front of an input port. Any thread puts in, the node's thread takes out.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use carril_messages::Stamp;
use serde::{Deserialize, Serialize};

use crate::ports::Incoming;
use crate::positions::Positions;

/// A mailbox that keeps everything keeps no more than this: its node hangs.
const KEPT_SAMPLES: usize = 10_000;
/// A sample that is farther ahead of its predecessor is damaged. It must not make all that follow look old.
const LARGEST_JUMP: u64 = 1 << 32;
/// Samples that did not come yet are remembered up to this many.
const MISSING_SAMPLES: usize = 64;

/// What a full queue does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct QueuePolicy {
    /// Samples that it holds. 1 is latest-wins.
    pub capacity: usize,
}

impl QueuePolicy {
    /// Holds only the newest sample.
    pub const LATEST: Self = Self { capacity: 1 };
}

/// Counters of a mailbox, since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MailboxCounts {
    /// Samples that arrived.
    pub received: u64,
    /// Samples that newer ones pushed out.
    pub dropped: u64,
    /// Samples that never arrived: gaps in the sequence numbers of one epoch.
    pub lost: u64,
    /// Samples that had arrived before, and were left out.
    pub duplicates: u64,
    /// Samples refused on the way in or out: see `last_refusal`.
    pub refused: u64,
}

/// A bounded queue: when full, the oldest sample goes. Each sample is taken in once: while a writer is replaced by another, two
/// may send the same one, on two links.
#[derive(Debug)]
pub struct Mailbox {
    policy: QueuePolicy,
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    queue: VecDeque<Incoming>,
    counts: MailboxCounts,
    last_refusal: Option<String>,
    received: Positions,
    missing: Vec<(u64, u64)>,
    keep_all: bool,
}

impl Mailbox {
    /// An empty one.
    pub fn new(policy: QueuePolicy) -> Self {
        Self { policy, inner: Mutex::default() }
    }

    /// Puts a sample in; the oldest goes when there is no room.
    pub fn push(&self, incoming: Incoming) {
        let mut inner = self.lock();
        let (epoch, seq) = (incoming.header().epoch, incoming.header().seq);
        if inner.received.next(epoch).is_some_and(|next| seq > next.saturating_add(LARGEST_JUMP)) {
            inner.counts.refused += 1;
            inner.last_refusal = Some(format!("sequence number {seq} is absurd: no writer sends so many samples"));
            return;
        }
        match inner.sort(epoch, seq) {
            Order::Duplicate => {
                inner.counts.duplicates += 1;
                return;
            }
            Order::Next => inner.queue.push_back(incoming),
            // On another link than its successors: it goes where it belongs, unless a newer one has gone by.
            Order::Late => {
                let newer = |other: &Incoming| other.header().epoch == epoch && other.header().seq > seq;
                let place = inner.queue.iter().position(newer).unwrap_or(inner.queue.len());
                inner.queue.insert(place, incoming);
            }
        }
        inner.counts.received += 1;
        let capacity = if inner.keep_all { KEPT_SAMPLES } else { self.policy.capacity.max(1) };
        while inner.queue.len() > capacity {
            inner.queue.pop_front();
            inner.counts.dropped += 1;
        }
    }

    /// Whether to keep everything, whatever the queue's length: while nobody may take samples out because the node is being
    /// replaced.
    pub fn keep_all(&self, keep: bool) {
        self.lock().keep_all = keep;
    }

    /// How far it has come, and what waits.
    pub fn waiting(&self) -> (Positions, Vec<Incoming>) {
        let inner = self.lock();
        (inner.received.clone(), inner.queue.iter().cloned().collect())
    }

    /// When the sample that waits longest was published; `None`: nothing waits.
    pub fn oldest(&self) -> Option<Stamp> {
        self.lock().queue.front().map(|incoming| incoming.header().stamp)
    }

    /// How far it has come.
    pub fn received(&self) -> Positions {
        self.lock().received.clone()
    }

    /// Takes out the oldest sample, if it is one of those seen at `positions`.
    pub fn pop_seen(&self, positions: &Positions) -> Option<Incoming> {
        let mut inner = self.lock();
        let seen = |incoming: &Incoming| positions.has(incoming.header().epoch, incoming.header().seq);
        if inner.queue.front().is_some_and(seen) { inner.queue.pop_front() } else { None }
    }

    /// Takes everything out.
    pub fn take_all(&self) -> Vec<Incoming> {
        self.lock().queue.drain(..).collect()
    }

    /// Takes the oldest sample out.
    pub fn pop(&self) -> Option<Incoming> {
        self.lock().queue.pop_front()
    }

    /// Drops all that waits, and counts it as dropped.
    pub fn clear(&self) {
        let mut inner = self.lock();
        inner.counts.dropped += inner.queue.len() as u64;
        inner.queue.clear();
    }

    /// Whether nothing waits.
    pub fn is_empty(&self) -> bool {
        self.lock().queue.is_empty()
    }

    /// Counts a sample that was refused.
    pub fn refuse(&self, reason: String) {
        let mut inner = self.lock();
        inner.counts.refused += 1;
        inner.last_refusal = Some(reason);
    }

    /// The counters.
    pub fn counts(&self) -> MailboxCounts {
        self.lock().counts
    }

    /// Why the last refused sample was refused.
    pub fn last_refusal(&self) -> Option<String> {
        self.lock().last_refusal.clone()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where a sample belongs.
enum Order {
    Next,
    Late,
    Duplicate,
}

impl Inner {
    fn sort(&mut self, epoch: u64, seq: u64) -> Order {
        let next = self.received.next(epoch);
        if next.is_some_and(|next| seq < next) {
            let Some(at) = self.missing.iter().position(|missing| *missing == (epoch, seq)) else {
                return Order::Duplicate;
            };
            self.missing.remove(at);
            self.counts.lost = self.counts.lost.saturating_sub(1);
            return Order::Late;
        }
        let gap = next.unwrap_or(seq)..seq;
        self.counts.lost += gap.end - gap.start;
        self.missing.extend(gap.rev().take(MISSING_SAMPLES).map(|missing| (epoch, missing)));
        let too_many = self.missing.len().saturating_sub(MISSING_SAMPLES);
        self.missing.drain(..too_many);
        self.received.advance(epoch, seq);
        Order::Next
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use carril_messages::{Command, Header, Message, Meta, Origins, Payload, Stamp};

    use super::*;

    fn sample(epoch: u64, seq: u64) -> Incoming {
        let (origins, meta) = (Origins::none(), Meta::new());
        let header = Header { epoch, seq, stamp: Stamp::ZERO, origins, message_type: Command::TYPE, meta };
        Incoming::Wire(Arc::new(header), Payload::default())
    }

    #[test]
    fn latest_wins() {
        let mailbox = Mailbox::new(QueuePolicy::LATEST);
        (0..5).for_each(|seq| mailbox.push(sample(1, seq)));
        assert_eq!(mailbox.pop().map(|s| s.header().seq), Some(4), "the newest");
        assert!(mailbox.is_empty(), "and only that");
        let counts = mailbox.counts();
        assert_eq!((counts.received, counts.dropped, counts.lost), (5, 4, 0), "all are accounted for");
    }

    #[test]
    fn tells_lost_from_restarted() {
        let mailbox = Mailbox::new(QueuePolicy { capacity: 10 });
        for (epoch, seq) in [(1, 0), (1, 3), (2, 0), (2, 1)] {
            mailbox.push(sample(epoch, seq));
        }
        assert_eq!(mailbox.counts().lost, 2, "1 and 2 of the first epoch; a new epoch begins again");
    }

    #[test]
    fn takes_each_sample_once_and_puts_late_ones_where_they_belong() {
        let mailbox = Mailbox::new(QueuePolicy { capacity: 10 });
        for seq in [0, 1, 1, 4, 2, 2, 3, 0] {
            mailbox.push(sample(1, seq));
        }
        let order: Vec<u64> = mailbox.take_all().iter().map(|sample| sample.header().seq).collect();
        assert_eq!(order, [0, 1, 2, 3, 4], "in order, each once");
        let counts = mailbox.counts();
        assert_eq!((counts.received, counts.duplicates, counts.lost), (5, 3, 0), "what came late was not lost");
    }

    #[test]
    fn an_absurd_number_does_not_make_the_others_old() {
        let mailbox = Mailbox::new(QueuePolicy { capacity: 10 });
        for seq in [0, u64::MAX, 1] {
            mailbox.push(sample(1, seq));
        }
        let counts = mailbox.counts();
        assert_eq!((counts.received, counts.refused, counts.lost), (2, 1, 0), "it alone is refused");
    }

    #[test]
    fn keeps_everything_when_told() {
        let mailbox = Mailbox::new(QueuePolicy::LATEST);
        mailbox.keep_all(true);
        (0..5).for_each(|seq| mailbox.push(sample(1, seq)));
        let mut seen = Positions::default();
        seen.advance(1, 1);
        let mut taken = Vec::new();
        while let Some(sample) = mailbox.pop_seen(&seen) {
            taken.push(sample.header().seq);
        }
        assert_eq!(taken, [0, 1], "no farther than told");
        assert_eq!(mailbox.waiting().1.len(), 3, "the others wait");
    }
}
