//! The writer's side of reliable edges: keeps samples until their readers have them, and answers questions for lost ones.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Instant;

use ::zenoh::Wait;
use ::zenoh::bytes::ZBytes;
use ::zenoh::query::Query;
use carril_messages::{Header, Key, codec, key};

use super::{TAIL_CHECK, ZenohTransport, failed, lock};
use crate::transport::reliable::{Ack, READER_SILENCE, RING_PART_OF_POOL, Readers, ReplayRequest, ReplayRing};
use crate::transport::{Guard, TransportError, Wire};

/// `carril/<robot>/@/replay/<node>/<port>`: asks a writer for samples that were lost.
pub(super) fn replay_key(port: &Key) -> String {
    key::control_key(&port.robot, &format!("replay/{}/{}", port.node, port.port))
}

/// `carril/<robot>/@/ack/<node>/<port>`: the readers of a reliable port say how far they have come.
pub(super) fn ack_key(port: &Key) -> String {
    key::control_key(&port.robot, &format!("ack/{}/{}", port.node, port.port))
}

/// Tells the readers of all processes of a machine apart.
pub(super) fn reader_id() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    (u64::from(std::process::id()) << 32) | NEXT.fetch_add(1, Ordering::Relaxed)
}

/// A reader's name on the control plane: which one, and since when it exists.
fn read_reader_name(name: &str) -> Option<(u64, u64)> {
    let (id, since) = name.split_once('-')?;
    Some((id.parse().ok()?, since.parse().ok()?))
}

pub(super) struct Replay {
    pub(super) kept: Arc<Kept>,
    _guards: [Guard; 3],
}

/// What a reliable port keeps, and for whom.
pub(super) struct Kept {
    state: Mutex<(ReplayRing, Readers)>,
    heard: Condvar,
}

impl Kept {
    /// Keeps a sample. Waits while the oldest one would have to go and a living reader lacks it.
    pub(super) fn keep(&self, header: &Header, wire: &Wire) {
        let deadline = Instant::now() + READER_SILENCE;
        let mut state = lock(&self.state);
        while let Some((epoch, oldest)) = state.0.would_drop(wire.payload.len()) {
            let now = Instant::now();
            if epoch != header.epoch || now >= deadline || !state.1.lack(epoch, oldest, now) {
                break;
            }
            let waited = self.heard.wait_timeout(state, TAIL_CHECK.min(deadline - now));
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        state.0.keep(header.epoch, header.seq, wire);
    }
}

impl ZenohTransport {
    /// Keeps the last samples of a port and answers questions for them.
    pub(super) fn keep_for_replay(&self, port: &Key) -> Result<Replay, TransportError> {
        let ring = ReplayRing::new(self.0.pool.bytes / RING_PART_OF_POOL);
        let kept = Arc::new(Kept { state: Mutex::new((ring, Readers::default())), heard: Condvar::new() });
        let (answered, own_key) = (Arc::clone(&kept), replay_key(port));
        // An answer waits for room to send. Zenoh's threads may not: what makes room is told to them.
        let (ask, questions) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            for query in questions {
                if let Err(error) = answer_replay(&query, &own_key, &answered) {
                    tracing::debug!("answering on `{own_key}`: {error}");
                }
            }
        });
        let queryable = self.0.session.declare_queryable(replay_key(port)).callback(move |query| {
            // The thread lives as long as this sender.
            let _ = ask.send(query);
        });
        let queryable = queryable.wait().map_err(failed(format!("keeping samples of `{port}`")))?;
        let acked = Arc::clone(&kept);
        let acks = self.0.session.declare_subscriber(ack_key(port)).callback(move |sample| {
            if let Ok(ack) = codec::decode::<Ack>(&sample.payload().to_bytes()) {
                lock(&acked.state).1.hear(ack, Instant::now());
                acked.heard.notify_all();
            }
        });
        let acks = acks.wait().map_err(failed(format!("hearing the readers of `{port}`")))?;
        let known = Arc::clone(&kept);
        let readers = self.watch_announced(&format!("{}/*", ack_key(port)), move |key, here| {
            let reader = key.rsplit('/').next().and_then(read_reader_name);
            let Some((reader, since)) = reader else { return };
            let readers = &mut lock(&known.state).1;
            if here {
                readers.expect(reader, since, Instant::now());
            } else {
                readers.forget(reader);
                known.heard.notify_all();
            }
        })?;
        Ok(Replay { kept, _guards: [Box::new(queryable), Box::new(acks), readers] })
    }
}

fn answer_replay(query: &Query, key: &str, kept: &Kept) -> Result<(), ::zenoh::Error> {
    let question = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
    let request: ReplayRequest = codec::decode(&question)?;
    let (samples, end) = lock(&kept.state).0.answer(request);
    for (header, payload) in samples {
        // Through the socket: shared memory is what may have lost it.
        query.reply(key, ZBytes::from(payload.bytes().clone())).attachment(header).wait()?;
    }
    query.reply(key, codec::encode(&end)?).wait()
}
