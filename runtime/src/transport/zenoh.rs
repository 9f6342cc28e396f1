//! The transport between processes, and the control plane: the one file that names Zenoh.
//!
//! A sample's header travels in the attachment. Large payloads lie in shared memory: what an operator wrote into a buffer of
//! [`Transport::buffers`] is published without a copy, other payloads from [`SHARED_FROM_BYTES`] on are copied into it once,
//! and readers use it where it is. Processes find each other by the sockets that they are told; nothing scouts.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::time::{Duration, Instant};

use ::zenoh::bytes::ZBytes;
use ::zenoh::config::ZenohId;
use ::zenoh::internal::runtime::{Runtime, RuntimeBuilder, ZRuntime};
use ::zenoh::qos::CongestionControl;
use ::zenoh::query::{ConsolidationMode, Query, QueryTarget};
use ::zenoh::sample::{Locality, Sample, SampleKind};
use ::zenoh::shm::{PosixShmProviderBackend, ShmProvider, ShmProviderBuilder, ZShm, ZShmMut};
use ::zenoh::{Config, Session, Wait};
use carril_messages::{CodecError, Header, Key, MAX_IMAGE_BYTES, Payload, PayloadMut, Writable, codec, key};

use super::reliable::{
    ACK_EVERY, Ack, READER_SILENCE, RING_PART_OF_POOL, Readers, ReplayEnd, ReplayRequest, ReplayRing, Resequencer,
};
use super::{Guard, Publisher, Sink, Transport, TransportError, Wire, receive};
use crate::ports::{AnyMessage, Incoming};
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

fn config(options: &ZenohOptions) -> Result<Config, TransportError> {
    let mut config = Config::default();
    let settings = [
        ("mode", "\"peer\"".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("open/return_conditions/connect_scouted", "false".to_owned()),
        ("listen/endpoints", serde_json::json!(options.listen.iter().collect::<Vec<_>>()).to_string()),
        ("connect/endpoints", serde_json::json!(options.connect).to_string()),
        ("connect/exit_on_failure", "false".to_owned()),
        ("connect/timeout_ms", "-1".to_owned()),
        ("connect/retry", r#"{"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5}"#.to_owned()),
        ("transport/shared_memory/transport_optimization/enabled", "false".to_owned()),
        ("adminspace/enabled", "false".to_owned()),
    ];
    for (name, value) in settings {
        config.insert_json5(name, &value).map_err(failed(format!("zenoh setting `{name}`")))?;
    }
    Ok(config)
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
        let (runtime, session) = open(config(&options)?).map_err(failed(doing))?;
        let pool = Arc::new(SharedPool::new(options.pool_bytes));
        let recovery = Arc::new(Recovery::default());
        Ok(Self(Arc::new(Inner {
            session,
            runtime,
            pool,
            epoch: options.epoch,
            opened: Instant::now(),
            lose: options.lose,
            recovery,
        })))
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

    /// How many processes this one is linked to.
    pub fn links(&self) -> usize {
        self.0.session.info().peers_zid().wait().count()
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
        let own_key = key.to_owned();
        let queryable = self.0.session.declare_queryable(key).callback(move |query| {
            hear(Question { query, key: own_key.clone() });
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
        let replies = get.wait().map_err(failed(format!("asking `{key}`")))?;
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

    /// Keeps the last samples of a port and answers questions for them.
    fn keep_for_replay(&self, port: &Key) -> Result<Replay, TransportError> {
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

/// `carril/<robot>/@/replay/<node>/<port>`: asks a writer for samples that were lost.
fn replay_key(port: &Key) -> String {
    key::control_key(&port.robot, &format!("replay/{}/{}", port.node, port.port))
}

/// `carril/<robot>/@/ack/<node>/<port>`: the readers of a reliable port say how far they have come.
fn ack_key(port: &Key) -> String {
    key::control_key(&port.robot, &format!("ack/{}/{}", port.node, port.port))
}

/// Tells the readers of all processes of a machine apart.
fn reader_id() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    (u64::from(std::process::id()) << 32) | NEXT.fetch_add(1, Ordering::Relaxed)
}

/// A reader's name on the control plane: which one, and since when it exists.
fn read_reader_name(name: &str) -> Option<(u64, u64)> {
    let (id, since) = name.split_once('-')?;
    Some((id.parse().ok()?, since.parse().ok()?))
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

struct Replay {
    kept: Arc<Kept>,
    _guards: [Guard; 3],
}

/// What a reliable port keeps, and for whom.
struct Kept {
    state: Mutex<(ReplayRing, Readers)>,
    heard: Condvar,
}

impl Kept {
    /// Keeps a sample. Waits while the oldest one would have to go and a living reader lacks it.
    fn keep(&self, header: &Header, wire: &Wire) {
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

impl Publisher for ZenohPublisher {
    fn matched(&self) -> bool {
        // A reliable port keeps its samples even when nobody is there: its reader may just be on its way.
        self.replay.is_some() || self.matched.load(Ordering::Relaxed)
    }

    fn publish(&self, header: &Header, message: &dyn AnyMessage) -> Result<(), TransportError> {
        let mut wire = Wire::of(header, message)?;
        wire.payload = self.pool.share(wire.payload);
        if let Some(replay) = &self.replay {
            replay.kept.keep(header, &wire);
        }
        let put = self.publisher.put(to_wire(&wire.payload)).attachment(wire.header);
        // The text is made only when it is needed: this is the path of every sample.
        put.wait().map_err(|error| failed(format!("publishing on `{}`", self.publisher.key_expr()))(error))
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

/// A reader that misses nothing: stands between the link and the sink.
struct ReliableReader {
    id: u64,
    acks: ::zenoh::pubsub::Publisher<'static>,
    state: Mutex<ReaderState>,
    sink: Arc<dyn Sink>,
    replay_key: String,
    recovery: Arc<Recovery>,
}

struct ReaderState {
    order: Resequencer,
    heard: Instant,
    /// The last `next` that the writer was told.
    acked: u64,
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
struct Recovery {
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
    fn watch(self: &Arc<Self>, session: &Session, reader: &Arc<ReliableReader>) {
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

    fn stop(&self) {
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

/// Memory shared between processes. Made when it is first used: most processes never need it.
struct SharedPool {
    bytes: usize,
    provider: OnceLock<Option<ShmProvider<PosixShmProviderBackend>>>,
    fallbacks: AtomicU64,
}

struct SharedBuffer(ZShmMut);

impl SharedPool {
    fn new(bytes: usize) -> Self {
        let shm = nix::sys::statvfs::statvfs("/dev/shm");
        let free = shm.map(|shm| (shm.blocks_available() * shm.fragment_size()) as usize);
        // Pages beyond what /dev/shm holds would kill the process with SIGBUS when they are written.
        let bytes = free.map_or(bytes, |free| bytes.min(free / 4));
        Self { bytes, provider: OnceLock::new(), fallbacks: AtomicU64::new(0) }
    }

    /// `None` when there is no room. What readers gave back is taken first: it is warm in the cache, and its pages exist.
    fn allocate(&self, len: usize) -> Option<ZShmMut> {
        let provider = self.provider.get_or_init(|| provider(self.bytes)).as_ref()?;
        provider.garbage_collect();
        provider.alloc(len).wait().ok()
    }

    /// The payload in shared memory, if it is large: copied once, unless it is there already.
    fn share(&self, payload: Payload) -> Payload {
        if payload.len() < SHARED_FROM_BYTES || is_shared(&payload) {
            return payload;
        }
        let Some(mut buffer) = self.allocate(payload.len()) else {
            // Counted here only: whoever asked for a buffer in vain publishes from the heap, and comes by here, too.
            if self.fallbacks.fetch_add(1, Ordering::Relaxed) == 0 {
                tracing::warn!(
                    "shared memory is full ({} B): large payloads are copied until readers give some back",
                    self.bytes
                );
            }
            return payload;
        };
        buffer.copy_from_slice(&payload);
        Box::new(SharedBuffer(buffer)).freeze()
    }
}

fn provider(bytes: usize) -> Option<ShmProvider<PosixShmProviderBackend>> {
    match ShmProviderBuilder::default_backend(bytes).wait() {
        Ok(provider) => Some(provider),
        Err(error) => {
            tracing::warn!("no shared memory ({bytes} B): {error}; large payloads are copied through the socket");
            None
        }
    }
}

fn to_wire(payload: &Payload) -> ZBytes {
    match payload.backing::<ZShm>() {
        Some(shared) => ZBytes::from((*shared).clone()),
        None => ZBytes::from(payload.bytes().clone()),
    }
}

impl BufferPool for SharedPool {
    fn buffer(&self, len: usize) -> PayloadMut {
        if len >= SHARED_FROM_BYTES
            && let Some(buffer) = self.allocate(len)
        {
            return PayloadMut::new(Box::new(SharedBuffer(buffer)));
        }
        PayloadMut::heap(len)
    }
}

impl Writable for SharedBuffer {
    fn bytes(&self) -> &[u8] {
        &self.0
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut self.0
    }

    fn freeze(self: Box<Self>) -> Payload {
        Payload::from_shared(Arc::new(ZShm::from(self.0)))
    }
}
