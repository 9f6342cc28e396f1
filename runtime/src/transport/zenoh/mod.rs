//! The transport between processes, and the control plane. This folder is the one place that names Zenoh.
//!
//! A sample's header travels in the attachment. Large payloads lie in shared memory: what an operator wrote into a buffer of
//! [`Transport::buffers`] is published without a copy, other payloads from [`SHARED_FROM_BYTES`] on are copied into it once,
//! and readers use it where it is. Processes find each other by the sockets that they are told; nothing scouts.

mod config;
mod far;
mod pool;
mod reader;
mod replay;

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ::zenoh::bytes::ZBytes;
use ::zenoh::config::ZenohId;
use ::zenoh::internal::runtime::{Runtime, RuntimeBuilder, ZRuntime};
use ::zenoh::qos::{CongestionControl, Priority};
use ::zenoh::query::{ConsolidationMode, Query, QueryTarget};
use ::zenoh::sample::{Locality, Sample, SampleKind};
use ::zenoh::shm::ZShm;
use ::zenoh::{Config, Session, Wait};
use carril_messages::{CodecError, Header, Key, MAX_IMAGE_BYTES, Payload};

pub use config::{FarOptions, GatewayOptions, Identity, Scouting};
pub use far::{FarPublisher, Found, StandIn, Viewer, scout};
use pool::{SharedPool, to_wire};
use reader::{ReaderState, Recovery, ReliableReader};
use replay::{Replay, ack_key, reader_id, replay_key};

use super::reliable::Resequencer;
use super::{Guard, Publisher, Sink, Transport, TransportError, Wire, receive};
use crate::ports::AnyMessage;
use crate::setup::BufferPool;

/// Payloads of this size and more travel in shared memory, B. Below, a copy through the socket costs less.
pub const SHARED_FROM_BYTES: usize = 16 << 10;
/// Shared memory of a process that publishes large payloads, B. Taken page by page as it is used.
pub const POOL_BYTES: usize = 64 << 20;
/// A reader of a reliable edge that heard nothing for this long asks whether something was lost.
const TAIL_CHECK: Duration = Duration::from_millis(250);
/// A writer has this long to answer a question for lost samples; then it is asked again. Longer than a link lives that takes nothing:
/// when a question times out, Zenoh says so over the link, on the very thread that is told when there is room to send.
const REPLAY_TIMEOUT: Duration = Duration::from_secs(10);

/// The threads of Zenoh in a process of nodes, as an environment variable and its value, for whoever starts the process: it is
/// read once, before the first session. What a socket has to say is told to the thread that also reads from it, instead of to
/// one that only wakes the reading one: a wake-up less for each sample. Sending keeps its own thread: a callback may have to
/// wait for it (docs/decisions/0007-threads-of-zenoh.md).
pub const THREADS: (&str, &str) =
    ("ZENOH_RUNTIME", "(rx: (handover: net), acc: (handover: net), net: (worker_threads: 2))");

/// Says of a sample whether the link loses it.
pub type Loss = Arc<dyn Fn(&Header) -> bool + Send + Sync>;

/// How a process takes part.
#[derive(Clone)]
pub struct ZenohOptions {
    /// Where it listens: see [`endpoint`].
    pub listen: Option<String>,
    /// To whom it connects, now and whenever they come back.
    pub connect: Vec<String>,
    /// Shared memory for its large payloads, B.
    pub pool_bytes: usize,
    /// Identifies this life of the process: the ns stamp of its start on the car's clock. 0: its readers count as having been there
    /// before any writer.
    pub epoch: u64,
    /// For tests: samples for which it says `true` are lost before the reader sees them.
    pub lose: Option<Loss>,
}

impl Default for ZenohOptions {
    fn default() -> Self {
        Self { listen: None, connect: Vec::new(), pool_bytes: POOL_BYTES, epoch: 0, lose: None }
    }
}

/// The endpoint of a socket.
pub fn endpoint(socket: &Path) -> String {
    format!("unixsock-stream/{}", socket.display())
}

/// Removes shared memory that dead processes left behind.
pub fn clean_shared_memory() {
    ::zenoh::shm::cleanup_orphaned_shm_segments();
}

/// Whether a payload lies in memory that is shared between processes.
pub fn is_shared(payload: &Payload) -> bool {
    payload.backing::<ZShm>().is_some()
}

/// Carries samples between processes. Clones share the session.
#[derive(Clone)]
pub struct ZenohTransport(Arc<Inner>);

struct Inner {
    session: Session,
    /// Opens links to processes that come to share an edge later.
    runtime: Runtime,
    pool: Arc<SharedPool>,
    epoch: u64,
    opened: Instant,
    lose: Option<Loss>,
    recovery: Arc<Recovery>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn failed(doing: impl Into<String>) -> impl FnOnce(::zenoh::Error) -> TransportError {
    let doing = doing.into();
    move |error| TransportError::Link { doing, reason: error.to_string() }
}

/// As `zenoh::open` does it, but keeps the runtime: the session alone cannot connect to anybody later
/// (docs/decisions/0009-links-of-a-running-process.md).
fn open(config: Config) -> Result<(Runtime, Session), ::zenoh::Error> {
    ZRuntime::Application.block_in_place(async move {
        let mut runtime = RuntimeBuilder::new(config).build().await?;
        let session = ::zenoh::session::init(runtime.clone().into()).await?;
        runtime.start().await?;
        Ok((runtime, session))
    })
}

impl ZenohTransport {
    /// Opens the session. Returns at once; links come up in the background.
    pub fn open(options: ZenohOptions) -> Result<Self, TransportError> {
        let doing = match &options.listen {
            Some(endpoint) => format!("listening on `{endpoint}`"),
            None => "opening a session".to_owned(),
        };
        let (runtime, session) = open(config::near(&options)?).map_err(failed(doing))?;
        Ok(Self::on(session, runtime, options))
    }

    fn on(session: Session, runtime: Runtime, options: ZenohOptions) -> Self {
        let pool = Arc::new(SharedPool::new(options.pool_bytes));
        let recovery = Arc::new(Recovery::default());
        Self(Arc::new(Inner {
            session,
            runtime,
            pool,
            epoch: options.epoch,
            opened: Instant::now(),
            lose: options.lose,
            recovery,
        }))
    }

    /// Large payloads that found no room in shared memory.
    pub fn pool_fallbacks(&self) -> u64 {
        self.0.pool.fallbacks.load(Ordering::Relaxed)
    }

    /// Ends the session; readers and askers elsewhere learn of it at once.
    pub fn close(&self) {
        self.0.recovery.stop();
        // The links are the runtime's, and a session closes only a runtime of its own.
        let closed = self.0.session.close().wait().and_then(|()| self.0.runtime.close().wait());
        if let Err(error) = closed {
            tracing::debug!("closing the zenoh session: {error}");
        }
    }

    /// Who this process is on its links.
    pub fn identity(&self) -> String {
        self.0.session.zid().to_string()
    }

    /// Opens a link to a process that listens at `endpoint`, and waits for it. At once when there is one already. A link that breaks
    /// later is not opened again: whoever is started anew connects to all that the run file names.
    pub fn connect(&self, identity: &str, endpoint: &str) -> Result<(), TransportError> {
        let doing = || format!("connecting to `{endpoint}`");
        let broken = |reason: String| TransportError::Link { doing: doing(), reason };
        let zid = identity.parse::<ZenohId>().map_err(|error| broken(error.to_string()))?;
        let locator = endpoint.parse().map_err(|error: ::zenoh::Error| broken(error.to_string()))?;
        let runtime = self.0.runtime.clone();
        let connected =
            ZRuntime::Application.block_in_place(async move { runtime.connect_peer(&zid.into(), &[locator]).await });
        if connected { Ok(()) } else { Err(broken("nobody answers there".into())) }
    }

    /// How many processes this one is linked to; a gateway counts as one.
    pub fn links(&self) -> usize {
        let info = self.0.session.info();
        info.peers_zid().wait().count() + info.routers_zid().wait().count()
    }

    /// Waits until so many links are up; after `patience` it goes on with fewer.
    pub fn wait_for_links(&self, links: usize, patience: Duration) {
        let deadline = Instant::now() + patience;
        while self.links() < links && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Puts bytes on a key of the control plane.
    pub fn put(&self, key: &str, header: Option<Vec<u8>>, bytes: Vec<u8>) -> Result<(), TransportError> {
        let put = self.0.session.put(key, bytes).congestion_control(CongestionControl::Block);
        match header {
            Some(header) => put.attachment(header).wait(),
            None => put.wait(),
        }
        .map_err(failed(format!("publishing on `{key}`")))
    }

    /// Hears every put on matching keys: key, header bytes (empty: none), payload.
    pub fn watch(
        &self,
        key: &str,
        hear: impl Fn(&str, &[u8], Payload) + Send + Sync + 'static,
    ) -> Result<Guard, TransportError> {
        let subscriber = self.0.session.declare_subscriber(key).callback(move |sample| {
            let header = sample.attachment().map(ZBytes::to_bytes).unwrap_or_default();
            if sample.kind() == SampleKind::Put && sample.payload().len() <= MAX_IMAGE_BYTES {
                hear(sample.key_expr().as_str(), &header, payload_of(sample.payload()));
            }
        });
        let subscriber = subscriber.wait().map_err(failed(format!("subscribing to `{key}`")))?;
        Ok(Box::new(subscriber))
    }

    /// Answers questions on a key. The question may be moved to another thread to be answered there.
    pub fn answer(&self, key: &str, hear: impl Fn(Question) + Send + Sync + 'static) -> Result<Guard, TransportError> {
        let own_key = (!key.contains('*')).then(|| key.to_owned());
        let queryable = self.0.session.declare_queryable(key).callback(move |query| {
            // Whoever answers on many keys is asked on one, and whoever asks many has an answer from each.
            let key = own_key.clone().unwrap_or_else(|| query.key_expr().to_string());
            hear(Question { query, key });
        });
        let queryable = queryable.wait().map_err(failed(format!("answering on `{key}`")))?;
        Ok(Box::new(queryable))
    }

    /// Asks all that answer on matching keys, and waits for their answers.
    pub fn ask(
        &self,
        key: &str,
        question: Vec<u8>,
        timeout: Duration,
    ) -> Result<Vec<Result<Vec<u8>, String>>, TransportError> {
        let get = self.0.session.get(key).payload(question).timeout(timeout);
        let get = get.target(QueryTarget::All).consolidation(ConsolidationMode::None);
        // A question, and its answer, must not wait behind samples.
        let replies = get.priority(Priority::InteractiveHigh).express(true).wait();
        let replies = replies.map_err(failed(format!("asking `{key}`")))?;
        let mut answers = Vec::new();
        while let Ok(reply) = replies.recv() {
            answers.push(match reply.into_result() {
                Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
                // Zenoh's word for a silent answerer.
                Err(error) if error.payload().to_bytes().as_ref() == b"Timeout" => {
                    Err(format!("no answer within {} ms", timeout.as_millis()))
                }
                Err(error) => Err(String::from_utf8_lossy(&error.payload().to_bytes()).into_owned()),
            });
        }
        Ok(answers)
    }

    /// Says that this process is there, for as long as the guard lives.
    pub fn announce(&self, key: &str) -> Result<Guard, TransportError> {
        let token = self.0.session.liveliness().declare_token(key).wait();
        Ok(Box::new(token.map_err(failed(format!("announcing `{key}`")))?))
    }

    /// Hears who comes (`true`) and goes (`false`); those already there are told at once.
    pub fn watch_announced(
        &self,
        key: &str,
        hear: impl Fn(&str, bool) + Send + Sync + 'static,
    ) -> Result<Guard, TransportError> {
        let liveliness = self.0.session.liveliness();
        let subscriber = liveliness.declare_subscriber(key).history(true).callback(move |sample| {
            hear(sample.key_expr().as_str(), sample.kind() == SampleKind::Put);
        });
        Ok(Box::new(subscriber.wait().map_err(failed(format!("watching `{key}`")))?))
    }
}

/// A question to this process. Dropping it unanswered is an answer, too: none.
pub struct Question {
    query: Query,
    key: String,
}

impl Question {
    /// The key that the answer will bear.
    pub fn key(&self) -> &str {
        &self.key
    }

    /// What was asked.
    pub fn bytes(&self) -> Vec<u8> {
        self.query.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default()
    }

    /// Answers, or says why not.
    pub fn answer(self, answer: Result<Vec<u8>, String>) {
        let sent = match answer {
            Ok(bytes) => self.query.reply(self.key.as_str(), bytes).wait(),
            Err(reason) => self.query.reply_err(reason).wait(),
        };
        if let Err(error) = sent {
            tracing::debug!("answering on `{}`: {error}", self.key);
        }
    }
}

impl Transport for ZenohTransport {
    fn publish_on(&self, port: &Key, reliable: bool) -> Result<Box<dyn Publisher>, TransportError> {
        let inner = &self.0;
        let congestion = if reliable { CongestionControl::Block } else { CongestionControl::Drop };
        let publisher = inner.session.declare_publisher(port.to_string());
        let publisher = publisher.congestion_control(congestion).express(true).allowed_destination(Locality::Remote);
        let publisher = publisher.wait().map_err(failed(format!("publishing on `{port}`")))?;
        let matched = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&matched);
        let listener = publisher.matching_listener();
        let listener = listener.callback(move |status| flag.store(status.matching(), Ordering::Relaxed));
        let listener = listener.wait().map_err(failed(format!("watching the readers of `{port}`")))?;
        let replay = if reliable { Some(self.keep_for_replay(port)?) } else { None };
        let pool = Arc::clone(&inner.pool);
        Ok(Box::new(ZenohPublisher { publisher, matched, pool, replay, _listener: Box::new(listener) }))
    }

    fn subscribe(&self, port: &Key, reliable: bool, sink: Arc<dyn Sink>) -> Result<Guard, TransportError> {
        if !reliable {
            return self.subscribe_with(port, sink);
        }
        let recovery = &self.0.recovery;
        let own_ack_key = ack_key(port);
        let acks = self.0.session.declare_publisher(own_ack_key.clone()).express(true);
        let acks = acks.allowed_destination(Locality::Remote).wait();
        let acks = acks.map_err(failed(format!("acknowledging on `{own_ack_key}`")))?;
        // Not since the process exists: a reader that comes later, beside an older one, wants what comes from now on.
        let elapsed = self.0.opened.elapsed().as_nanos() as u64;
        let since = if self.0.epoch == 0 { 0 } else { self.0.epoch.saturating_add(elapsed) };
        let order = Resequencer::new(since);
        let state = Mutex::new(ReaderState { order, heard: Instant::now(), acked: 0 });
        let (id, replay_key, recovery_too) = (reader_id(), replay_key(port), Arc::clone(recovery));
        let token = self.announce(&format!("{own_ack_key}/{id}-{since}"))?;
        let reader = Arc::new(ReliableReader { id, state, sink, acks, replay_key, recovery: recovery_too });
        let guard = self.subscribe_with(port, reader.clone())?;
        recovery.watch(&self.0.session, &reader);
        Ok(Box::new((guard, token)))
    }

    fn put_raw(&self, port: &Key, header: &[u8], payload: Payload) -> Result<(), TransportError> {
        let put = self.0.session.put(port.to_string(), to_wire(&self.0.pool.share(payload))).attachment(header);
        put.congestion_control(CongestionControl::Block).wait().map_err(failed(format!("publishing on `{port}`")))
    }

    fn buffers(&self) -> Arc<dyn BufferPool> {
        Arc::clone(&self.0.pool) as Arc<dyn BufferPool>
    }
}

impl ZenohTransport {
    fn subscribe_with(&self, port: &Key, sink: Arc<dyn Sink>) -> Result<Guard, TransportError> {
        let lose = self.0.lose.clone();
        let subscriber = self.0.session.declare_subscriber(port.to_string()).allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample| take(&sample, sink.as_ref(), lose.as_deref()));
        Ok(Box::new(subscriber.wait().map_err(failed(format!("subscribing to `{port}`")))?))
    }
}

fn payload_of(bytes: &ZBytes) -> Payload {
    match bytes.as_shm() {
        Some(shared) => Payload::from_shared(Arc::new(shared.to_owned())),
        None => Payload::from(bytes.to_bytes().into_owned()),
    }
}

/// Takes a sample from the link and passes it on, or says why not.
fn take(sample: &Sample, sink: &dyn Sink, lose: Option<&(dyn Fn(&Header) -> bool + Send + Sync)>) {
    let header = sample.attachment().map(ZBytes::to_bytes).unwrap_or_default();
    let len = sample.payload().len();
    let incoming = if len > MAX_IMAGE_BYTES {
        Err(CodecError::TooLarge { got: len, limit: MAX_IMAGE_BYTES })
    } else {
        receive(&header, payload_of(sample.payload()))
    };
    match incoming {
        Ok(incoming) if lose.is_some_and(|lose| lose(incoming.header())) => {}
        Ok(incoming) => sink.deliver(incoming),
        Err(refusal) => sink.refuse(refusal.to_string()),
    }
}

struct ZenohPublisher {
    publisher: ::zenoh::pubsub::Publisher<'static>,
    matched: Arc<AtomicBool>,
    pool: Arc<SharedPool>,
    replay: Option<Replay>,
    _listener: Guard,
}

impl Publisher for ZenohPublisher {
    fn matched(&self) -> bool {
        // A reliable port keeps its samples even when nobody is there: its reader may just be on its way.
        self.replay.is_some() || self.matched.load(Ordering::Relaxed)
    }

    fn publish(&self, header: &Header, message: &dyn AnyMessage) -> Result<usize, TransportError> {
        let mut wire = Wire::of(header, message)?;
        wire.payload = self.pool.share(wire.payload);
        if let Some(replay) = &self.replay {
            replay.kept.keep(header, &wire);
        }
        let put = self.publisher.put(to_wire(&wire.payload)).attachment(wire.header);
        // The text is made only when it is needed: this is the path of every sample.
        put.wait().map_err(|error| failed(format!("publishing on `{}`", self.publisher.key_expr()))(error))?;
        Ok(wire.payload.len())
    }
}
