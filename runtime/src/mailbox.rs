//! The bounded queue in front of an input port. Any thread puts in, the node's thread takes out.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};

use crate::ports::Incoming;

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
    /// Samples refused on the way in or out: see `last_refusal`.
    pub refused: u64,
}

/// A bounded queue: when full, the oldest sample goes.
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
    expected: Option<(u64, u64)>,
}

impl Mailbox {
    /// An empty one.
    pub fn new(policy: QueuePolicy) -> Self {
        Self { policy, inner: Mutex::default() }
    }

    /// Puts a sample in; the oldest goes when there is no room.
    pub fn push(&self, incoming: Incoming) {
        let mut inner = self.lock();
        inner.count_gap(incoming.header().epoch, incoming.header().seq);
        inner.counts.received += 1;
        while inner.queue.len() >= self.policy.capacity.max(1) {
            inner.queue.pop_front();
            inner.counts.dropped += 1;
        }
        inner.queue.push_back(incoming);
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

impl Inner {
    fn count_gap(&mut self, epoch: u64, seq: u64) {
        if let Some((same_epoch, next)) = self.expected
            && same_epoch == epoch
            && seq > next
        {
            self.counts.lost += seq - next;
        }
        self.expected = Some((epoch, seq.saturating_add(1)));
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
}
