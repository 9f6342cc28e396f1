//! The reader's side of reliable edges: puts samples in order, and asks the writer for those that the link has lost.

use std::sync::{Arc, Condvar, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use ::zenoh::query::{ConsolidationMode, QueryTarget};
use ::zenoh::{Session, Wait};
use carril_messages::codec;

use super::{REPLAY_TIMEOUT, SHARED_FROM_BYTES, TAIL_CHECK, lock, payload_of};
use crate::ports::Incoming;
use crate::transport::reliable::{ACK_EVERY, ReplayEnd, ReplayRequest, Resequencer};
use crate::transport::{Sink, receive};

/// A reader that misses nothing: stands between the link and the sink.
pub(super) struct ReliableReader {
    pub(super) id: u64,
    pub(super) acks: ::zenoh::pubsub::Publisher<'static>,
    pub(super) state: Mutex<ReaderState>,
    pub(super) sink: Arc<dyn Sink>,
    pub(super) replay_key: String,
    pub(super) recovery: Arc<Recovery>,
}

pub(super) struct ReaderState {
    pub(super) order: Resequencer,
    pub(super) heard: Instant,
    /// The last `next` that the writer was told.
    pub(super) acked: u64,
}

impl Sink for ReliableReader {
    fn deliver(&self, incoming: Incoming) {
        let mut state = lock(&self.state);
        state.heard = Instant::now();
        let large = is_large(&incoming);
        state.order.offer(incoming, &mut |incoming| self.sink.deliver(incoming));
        if state.order.missing().is_some() {
            self.recovery.kick();
        }
        self.acknowledge(&mut state, large);
    }

    fn refuse(&self, reason: String) {
        self.sink.refuse(reason);
    }
}

/// Whether the writer may have room for only few samples like this, and waits for each acknowledgement.
fn is_large(incoming: &Incoming) -> bool {
    matches!(incoming, Incoming::Wire(_, payload) if payload.len() >= SHARED_FROM_BYTES)
}

impl ReliableReader {
    /// Tells the writer how far this reader has come: `always`, or when it has come on far enough.
    fn acknowledge(&self, state: &mut ReaderState, always: bool) {
        let ack = state.order.ack(self.id);
        let come_on = ack.next.abs_diff(state.acked) >= ACK_EVERY;
        if always || come_on {
            state.acked = ack.next;
            let put = || self.acks.put(codec::encode(&ack)?).wait();
            if let Err(error) = put() {
                tracing::debug!("acknowledging on `{}`: {error}", self.acks.key_expr());
            }
        }
    }

    /// What to ask the writer now, if anything.
    fn question(&self) -> Option<ReplayRequest> {
        let mut state = lock(&self.state);
        // Also says that this reader is alive.
        self.acknowledge(&mut state, true);
        if let Some(missing) = state.order.missing() {
            return Some(missing);
        }
        if state.heard.elapsed() < TAIL_CHECK {
            return None;
        }
        state.heard = Instant::now();
        Some(state.order.anything_newer())
    }

    /// Asks, and takes the answers in. `true`: something is still missing that the writer may have.
    fn recover(&self, session: &Session) -> Result<bool, ::zenoh::Error> {
        let Some(request) = self.question() else { return Ok(false) };
        let get = session.get(&self.replay_key).payload(codec::encode(&request)?).timeout(REPLAY_TIMEOUT);
        let replies = get.target(QueryTarget::All).consolidation(ConsolidationMode::None).wait()?;
        let mut answered = false;
        while let Ok(reply) = replies.recv() {
            let Ok(sample) = reply.into_result() else { continue };
            answered = true;
            let Some(header) = sample.attachment() else {
                let end: ReplayEnd = codec::decode(&sample.payload().to_bytes())?;
                lock(&self.state).order.end_of_replay(end, &mut |incoming| self.sink.deliver(incoming));
                continue;
            };
            match receive(&header.to_bytes(), payload_of(sample.payload())) {
                Ok(incoming) => {
                    let (mut state, large) = (lock(&self.state), is_large(&incoming));
                    state.order.offer(incoming, &mut |incoming| self.sink.deliver(incoming));
                    self.acknowledge(&mut state, large);
                }
                Err(refusal) => self.sink.refuse(refusal.to_string()),
            }
        }
        let mut state = lock(&self.state);
        self.acknowledge(&mut state, true);
        Ok(answered && state.order.missing().is_some())
    }
}

/// The thread that asks for lost samples, one for all reliable readers of a process.
#[derive(Default)]
pub(super) struct Recovery {
    state: Mutex<RecoveryState>,
    kicked: Condvar,
}

#[derive(Default)]
struct RecoveryState {
    readers: Vec<Weak<ReliableReader>>,
    running: bool,
    kick: bool,
    stop: bool,
}

impl Recovery {
    pub(super) fn watch(self: &Arc<Self>, session: &Session, reader: &Arc<ReliableReader>) {
        let mut state = lock(&self.state);
        state.readers.push(Arc::downgrade(reader));
        if !state.running {
            state.running = true;
            let (recovery, session) = (Arc::clone(self), session.clone());
            std::thread::spawn(move || recovery.run(&session));
        }
    }

    fn kick(&self) {
        lock(&self.state).kick = true;
        self.kicked.notify_one();
    }

    pub(super) fn stop(&self) {
        lock(&self.state).stop = true;
        self.kicked.notify_one();
    }

    fn run(&self, session: &Session) {
        let mut again = false;
        loop {
            let pause = if again { Duration::from_millis(1) } else { TAIL_CHECK };
            let mut state = lock(&self.state);
            if !state.kick && !state.stop {
                state = self.kicked.wait_timeout(state, pause).unwrap_or_else(PoisonError::into_inner).0;
            }
            state.kick = false;
            state.readers.retain(|reader| reader.strong_count() > 0);
            let readers: Vec<_> = state.readers.iter().filter_map(Weak::upgrade).collect();
            if state.stop || readers.is_empty() {
                state.running = false;
                return;
            }
            drop(state);
            again = false;
            for reader in readers {
                match reader.recover(session) {
                    Ok(incomplete) => again |= incomplete,
                    Err(error) => tracing::debug!("asking on `{}`: {error}", reader.replay_key),
                }
            }
        }
    }
}
