//! Measures one hop from node to node, half a round trip: between two processes against a plain Zenoh program on the same link,
//! and between two nodes of one process. `cargo run --release -p carril-runtime --example hop [-- --json FILE]`
//!
//! Both programs take turns in one run. Both write each payload once into its buffer (in explicitly allocated shared memory from
//! 16 KiB on), send it from the callback in which the previous echo arrived, and get it back uncopied from the other process.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, mpsc};
use std::time::{Duration, Instant};

use carril_messages::{CodecError, Encoded, Message, MessageType, Meta, Payload};
use carril_runtime::clock::LiveClock;
use carril_runtime::executor::live::{Environment, Executor};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::transport::Transport;
use carril_runtime::transport::memory::MemoryTransport;
use carril_runtime::transport::zenoh::{SHARED_FROM_BYTES, ZenohOptions, ZenohTransport, endpoint};
use carril_runtime::{
    Context, Findings, NoState, Operator, OperatorConfig, Registry, Setup, SetupError, StateError, StepError, Trigger,
    Waker,
};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::sample::Locality;

const SIZES: [usize; 4] = [16, 1 << 10, 64 << 10, 921_600];
const ROUNDS: usize = 20;
const BATCH: usize = 250;

/// Raw bytes, like an image without its layout.
#[derive(Clone, Debug)]
struct Blob(Payload);

impl Message for Blob {
    const TYPE: MessageType = MessageType::new("bench/Blob", 1);

    fn encode(&self) -> Result<Encoded, CodecError> {
        Ok(Encoded { meta: Meta::new(), payload: self.0.clone() })
    }

    fn decode(_meta: &[u8], payload: &Payload) -> Result<Self, CodecError> {
        Ok(Self(payload.clone()))
    }
}

/// One batch of round trips, whoever makes them.
struct Batch {
    source: Vec<u8>,
    to_go: usize,
    sent: Option<Instant>,
    times: Vec<Duration>,
    done: mpsc::Sender<Vec<Duration>>,
}

impl Batch {
    fn start(len: usize, count: usize) -> (Self, mpsc::Receiver<Vec<Duration>>) {
        let (done, receiver) = mpsc::channel();
        (Self { source: vec![7; len], to_go: count, sent: None, times: Vec::with_capacity(count), done }, receiver)
    }

    /// An echo has come. `true`: send the next.
    fn echo(&mut self) -> bool {
        if let Some(sent) = self.sent.take() {
            self.times.push(sent.elapsed());
        }
        if self.to_go == 0 {
            let _ = self.done.send(std::mem::take(&mut self.times));
            return false;
        }
        self.to_go -= 1;
        self.sent = Some(Instant::now());
        true
    }
}

static BATCH_NOW: Mutex<Option<Batch>> = Mutex::new(None);
static WAKERS: Mutex<Vec<Waker>> = Mutex::new(Vec::new());

#[derive(serde::Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[derive(Default)]
struct NoConfig {}

impl OperatorConfig for NoConfig {
    fn check(&self, _findings: &mut Findings<'_>) {}
}

carril_runtime::inputs! {
    /// What comes back.
    struct PingInputs {
        /// The echo.
        echo: Blob,
    }
}
carril_runtime::outputs! {
    /// What goes out.
    struct PingOutputs {
        /// The ball.
        ball: Blob,
    }
}
carril_runtime::inputs! {
    /// What comes.
    struct PongInputs {
        /// The ball.
        ball: Blob,
    }
}
carril_runtime::outputs! {
    /// What goes back.
    struct PongOutputs {
        /// The echo.
        echo: Blob,
    }
}

struct Ping;
struct Pong;

impl Operator for Ping {
    const KIND: &'static str = "ping";
    const SUMMARY: &'static str = "Plays balls and takes the time until they come back";
    type Config = NoConfig;
    type Inputs = PingInputs;
    type Outputs = PingOutputs;
    type State = NoState;

    fn new(_config: NoConfig, setup: &Setup) -> Result<Self, SetupError> {
        WAKERS.lock().unwrap_or_else(PoisonError::into_inner).push(setup.waker.clone());
        Ok(Self)
    }

    fn step(
        &mut self,
        inputs: &mut PingInputs,
        outputs: &mut PingOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        if context.trigger() == Trigger::Input {
            drop(inputs.echo.take());
        }
        let mut batch = BATCH_NOW.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(batch) = batch.as_mut()
            && batch.echo()
        {
            let mut ball = context.buffer(batch.source.len());
            ball.copy_from_slice(&batch.source);
            outputs.ball.send(Blob(ball.freeze()));
        }
        Ok(())
    }

    fn snapshot(&self) -> NoState {
        NoState
    }

    fn restore(&mut self, _state: NoState) -> Result<(), StateError> {
        Ok(())
    }
}

impl Operator for Pong {
    const KIND: &'static str = "pong";
    const SUMMARY: &'static str = "Sends every ball back";
    type Config = NoConfig;
    type Inputs = PongInputs;
    type Outputs = PongOutputs;
    type State = NoState;

    fn new(_config: NoConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, inputs: &mut PongInputs, outputs: &mut PongOutputs, _: &Context<'_>) -> Result<(), StepError> {
        if let Some(ball) = inputs.ball.take() {
            outputs.echo.send(Blob::clone(ball.value()));
        }
        Ok(())
    }

    fn snapshot(&self) -> NoState {
        NoState
    }

    fn restore(&mut self, _state: NoState) -> Result<(), StateError> {
        Ok(())
    }
}

const GRAPH: &str = "
robot: bench
nodes:
  ping: { operator: ping, inputs: { echo: { from: pong/echo, delay_ms: 1 } } }
  pong: { operator: pong, inputs: { ball: ping/ball } }
";

fn graph(processes: &str) -> Result<Graph, Box<dyn Error>> {
    let registry = Registry::new().with::<Ping>().with::<Pong>();
    let text = GRAPH.replace("operator: p", &format!("{processes}operator: p"));
    Graph::parse(text, Path::new("bench.yaml"), &registry, &ReadOptions::default()).map_err(|e| format!("{e:?}").into())
}

fn environment(transport: Arc<dyn Transport>) -> Environment {
    Environment { transport, clock: Arc::new(LiveClock::anchored_now()), run_dir: None, seed: 1 }
}

fn sockets(dir: &Path) -> [String; 2] {
    ["carril.sock", "plain.sock"].map(|name| endpoint(&dir.join(name)))
}

/// The other process: echoes for both programs until its standard input closes.
fn echo(dir: &Path) -> Result<(), Box<dyn Error>> {
    let [carril, plain] = sockets(dir);
    let transport = ZenohTransport::open(ZenohOptions { connect: vec![carril], ..ZenohOptions::default() })?;
    let (_executor, _events) = Executor::start(&graph("")?, "pong", &environment(Arc::new(transport)))?;
    let session = zenoh::open(plain_config("connect", &plain)?).wait().map_err(|e| e.to_string())?;
    let publisher = plain_publisher(&session, "plain/echo")?;
    let subscriber = session.declare_subscriber("plain/ball").allowed_origin(Locality::Remote);
    let subscriber = subscriber.callback(move |sample| {
        let _ = publisher.put(sample.payload().clone()).wait();
    });
    let _subscriber = subscriber.wait().map_err(|e| e.to_string())?;
    std::io::stdin().read_line(&mut String::new())?;
    Ok(())
}

fn plain_config(side: &str, endpoint: &str) -> Result<zenoh::Config, Box<dyn Error>> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("scouting/multicast/enabled", "false"),
        ("scouting/gossip/enabled", "false"),
        ("listen/endpoints", "[]"),
        ("connect/retry", r#"{"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5}"#),
        ("open/return_conditions/connect_scouted", "false"),
        ("transport/shared_memory/transport_optimization/enabled", "false"),
        (&format!("{side}/endpoints"), &format!("[\"{endpoint}\"]")),
    ] {
        config.insert_json5(key, value).map_err(|e| e.to_string())?;
    }
    Ok(config)
}

fn plain_publisher(
    session: &zenoh::Session,
    key: &'static str,
) -> Result<zenoh::pubsub::Publisher<'static>, Box<dyn Error>> {
    let publisher = session.declare_publisher(key).express(true).allowed_destination(Locality::Remote);
    Ok(publisher.wait().map_err(|e| e.to_string())?)
}

/// What takes a batch of round trips.
trait Player {
    fn play(&self, len: usize, count: usize) -> Result<Vec<Duration>, Box<dyn Error>>;
}

struct Carril {
    index: usize,
    _executor: Executor,
    _events: mpsc::Receiver<carril_runtime::executor::live::NodeEvent>,
}

impl Player for Carril {
    fn play(&self, len: usize, count: usize) -> Result<Vec<Duration>, Box<dyn Error>> {
        let (batch, done) = Batch::start(len, count);
        *BATCH_NOW.lock().unwrap_or_else(PoisonError::into_inner) = Some(batch);
        WAKERS.lock().unwrap_or_else(PoisonError::into_inner)[self.index].wake();
        Ok(done.recv_timeout(Duration::from_secs(5))?)
    }
}

struct Plain {
    publisher: Arc<zenoh::pubsub::Publisher<'static>>,
    provider: Arc<zenoh::shm::ShmProvider<zenoh::shm::PosixShmProviderBackend>>,
    batch: Arc<Mutex<Option<Batch>>>,
    _subscriber: Box<dyn std::any::Any>,
    _session: zenoh::Session,
}

fn plain_send(
    publisher: &zenoh::pubsub::Publisher<'_>,
    provider: &zenoh::shm::ShmProvider<zenoh::shm::PosixShmProviderBackend>,
    source: &[u8],
) {
    let payload = if source.len() < SHARED_FROM_BYTES {
        ZBytes::from(source)
    } else {
        provider.garbage_collect();
        let mut buffer = provider.alloc(source.len()).wait().expect("the pool holds many frames");
        buffer.copy_from_slice(source);
        ZBytes::from(buffer)
    };
    let _ = publisher.put(payload).wait();
}

impl Plain {
    fn open(endpoint: &str) -> Result<Self, Box<dyn Error>> {
        let session = zenoh::open(plain_config("listen", endpoint)?).wait().map_err(|e| e.to_string())?;
        let provider = zenoh::shm::ShmProviderBuilder::default_backend(64_usize << 20);
        let provider = Arc::new(provider.wait().map_err(|e| e.to_string())?);
        let publisher = Arc::new(plain_publisher(&session, "plain/ball")?);
        let batch: Arc<Mutex<Option<Batch>>> = Arc::default();
        let (own_publisher, own_provider, own_batch) = (publisher.clone(), provider.clone(), batch.clone());
        let subscriber = session.declare_subscriber("plain/echo").allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample| {
            drop(sample);
            let mut batch = own_batch.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(batch) = batch.as_mut()
                && batch.echo()
            {
                plain_send(&own_publisher, &own_provider, &batch.source);
            }
        });
        let subscriber = subscriber.wait().map_err(|e| e.to_string())?;
        Ok(Self { publisher, provider, batch, _subscriber: Box::new(subscriber), _session: session })
    }
}

impl Player for Plain {
    fn play(&self, len: usize, count: usize) -> Result<Vec<Duration>, Box<dyn Error>> {
        let (mut batch, done) = Batch::start(len, count);
        batch.echo();
        let source = batch.source.clone();
        *self.batch.lock().unwrap_or_else(PoisonError::into_inner) = Some(batch);
        plain_send(&self.publisher, &self.provider, &source);
        Ok(done.recv_timeout(Duration::from_secs(5))?)
    }
}

/// Starts an executor and tells which of the wakers is its own.
fn carril(graph: &Graph, process: &str, transport: Arc<dyn Transport>) -> Result<Carril, Box<dyn Error>> {
    let index = WAKERS.lock().unwrap_or_else(PoisonError::into_inner).len();
    let (executor, events) = Executor::start(graph, process, &environment(transport))?;
    Ok(Carril { index, _executor: executor, _events: events })
}

/// CPU time of this process and the other, all threads.
fn cpu(child: &Child) -> Duration {
    let of = |pid: String| {
        let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
        let stats = tasks.filter_map(|task| std::fs::read_to_string(task.path().join("schedstat")).ok());
        stats.filter_map(|text| text.split(' ').next()?.parse::<u64>().ok()).sum::<u64>()
    };
    Duration::from_nanos(of("self".into()) + of(child.id().to_string()))
}

#[derive(Default)]
struct Results {
    hops_us: Vec<f64>,
    cpu: Duration,
}

impl Results {
    fn quantile(&mut self, q: f64) -> f64 {
        self.hops_us.sort_by(f64::total_cmp);
        self.hops_us.get(((self.hops_us.len() as f64 - 1.0) * q).round() as usize).copied().unwrap_or(f64::NAN)
    }

    fn cpu_us(&self) -> f64 {
        self.cpu.as_secs_f64() * 1e6 / (2.0 * self.hops_us.len() as f64)
    }
}

fn play(player: &dyn Player, len: usize, child: &Child, results: &mut Results) -> Result<(), Box<dyn Error>> {
    // The first ones find cold caches and sleeping cores, whoever plays.
    player.play(len, BATCH / 10)?;
    let before = cpu(child);
    let times = player.play(len, BATCH)?;
    results.cpu += cpu(child).saturating_sub(before);
    results.hops_us.extend(times.iter().map(|time| time.as_secs_f64() * 1e6 / 2.0));
    Ok(())
}

static JSON: OnceLock<PathBuf> = OnceLock::new();

fn report(rows: &[(String, &str, f64, f64)]) -> Result<(), Box<dyn Error>> {
    let row = |(name, unit, value, baseline): &(String, &str, f64, f64)| serde_json::json!({ "name": name, "unit": unit, "value": value, "baseline": baseline, "ratio": value / baseline });
    if let Some(file) = JSON.get() {
        std::fs::write(file, serde_json::to_string_pretty(&rows.iter().map(row).collect::<Vec<_>>())?)?;
    }
    Ok(())
}

fn bench() -> Result<(), Box<dyn Error>> {
    let dir = tempfile::tempdir()?;
    let [carril_socket, plain_socket] = sockets(dir.path());
    let mut child =
        Command::new(std::env::current_exe()?).arg("--echo").arg(dir.path()).stdin(Stdio::piped()).spawn()?;
    let transport = ZenohTransport::open(ZenohOptions { listen: Some(carril_socket), ..ZenohOptions::default() })?;
    let between = carril(&graph("")?, "ping", Arc::new(transport))?;
    let plain = Plain::open(&plain_socket)?;
    let within = carril(&graph("process: both, ")?, "both", Arc::new(MemoryTransport::default()))?;
    for player in [&between as &dyn Player, &plain] {
        // The links come up in the background; balls played before are lost.
        while player.play(16, 1).is_err() {}
    }
    let mut rows = Vec::new();
    println!("{:>10}  {:>22}  {:>22}  {:>6} {:>6} {:>6}", "", "carril", "plain Zenoh", "", "ratio", "");
    println!(
        "{:>10}  {:>7} {:>7} {:>6}  {:>7} {:>7} {:>6}  {:>6} {:>6} {:>6}",
        "payload B", "p50 us", "p99 us", "cpu", "p50 us", "p99 us", "cpu", "p50", "p99", "cpu"
    );
    for len in SIZES {
        let (mut ours, mut theirs) = (Results::default(), Results::default());
        for round in 0..ROUNDS {
            // Whoever comes second finds a warmer machine.
            if round % 2 == 0 {
                play(&between, len, &child, &mut ours)?;
                play(&plain, len, &child, &mut theirs)?;
            } else {
                play(&plain, len, &child, &mut theirs)?;
                play(&between, len, &child, &mut ours)?;
            }
        }
        let (o, t) = ([0.5, 0.99].map(|q| ours.quantile(q)), [0.5, 0.99].map(|q| theirs.quantile(q)));
        println!(
            "{len:>10}  {:>7.1} {:>7.1} {:>6.1}  {:>7.1} {:>7.1} {:>6.1}  {:>6.2} {:>6.2} {:>6.2}",
            o[0],
            o[1],
            ours.cpu_us(),
            t[0],
            t[1],
            theirs.cpu_us(),
            o[0] / t[0],
            o[1] / t[1],
            ours.cpu_us() / theirs.cpu_us()
        );
        rows.push((format!("hop_between_processes_{len}_p50"), "us", o[0], t[0]));
        rows.push((format!("hop_between_processes_{len}_p99"), "us", o[1], t[1]));
        rows.push((format!("hop_between_processes_{len}_cpu"), "us", ours.cpu_us(), theirs.cpu_us()));
    }
    let mut local = Results::default();
    for _ in 0..ROUNDS {
        play(&within, 64, &child, &mut local)?;
    }
    let (p50, p99) = (local.quantile(0.5), local.quantile(0.99));
    println!("between two nodes of one process: p50 {p50:.2} us, p99 {p99:.2} us (goal 5 us)");
    rows.push(("hop_within_process_p50".into(), "us", p50, 5.0));
    drop(child.stdin.take());
    child.wait()?;
    report(&rows)
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    match (arguments.next().as_deref(), arguments.next()) {
        (Some("--echo"), Some(dir)) => echo(Path::new(&dir)),
        (Some("--json"), Some(file)) => {
            JSON.get_or_init(|| file.into());
            bench()
        }
        (None, _) => bench(),
        _ => Err("usage: hop [--json FILE]".into()),
    }
}
