//! The gateway: the one process of a car that listens beyond it. On the one side it is a tool of the run like any other, on the other it
//! serves those far away: samples at a limited pace, images compressed, and control for holders of a key alone.

pub mod addresses;
pub mod machines;
pub mod questions;
pub mod refusals;
pub mod relay;
mod reports;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::{Duration, Instant, SystemTime};

use carril_runtime::client::{Client, ClientError};
use carril_runtime::control_plane::{
    Connected, LogLevel, RunFile, Who, applied_key, log_key, receipts_key, status_key, word_key,
};
use carril_runtime::graph::remote::Remote;
use carril_runtime::transport::zenoh::{FarPublisher, GatewayOptions, Identity, Scouting, ZenohTransport};
use carril_runtime::transport::{Guard, TransportError};

use crate::access::{Access, AccessError, Grant};
use machines::{Listening, Machines};
use questions::Answers;
use refusals::Refusal;
use relay::{Counters, Relay};
use reports::{Reports, more};

/// By which way a machine is connected that runs nodes of the graph.
pub const MACHINE: &str = "machine";
/// The name of the gateway in logs; no process of a graph can have it.
pub const GATEWAY: &str = "_gateway";
/// Keys and addresses are looked up this often.
const LOOK: Duration = Duration::from_millis(250);
/// Who is connected is said this often.
const SAY_AGAIN: Duration = Duration::from_secs(1);
/// The ports of the run are looked up this often.
const LOOK_AT_RUN: Duration = Duration::from_secs(2);

/// Why there is no gateway.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GatewayError {
    /// Of the session to the outside.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// Of the keys.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// Of the way into the run.
    #[error(transparent)]
    Client(#[from] ClientError),
}

/// How a gateway serves.
#[derive(Clone, Debug)]
pub struct Options {
    /// What the graph says.
    pub remote: Remote,
    /// Where the keys lie.
    pub config_dir: PathBuf,
}

/// A running gateway.
pub struct Gateway {
    shared: Arc<Shared>,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

/// What its thread, its answers and its servers share.
pub struct Shared {
    /// The way into the run.
    pub client: Arc<Client>,
    /// The keys.
    pub access: Arc<RwLock<Access>>,
    options: Options,
    counters: Arc<Counters>,
    refused: AtomicU64,
    machines: Arc<Machines>,
    outer: Mutex<Option<Outer>>,
    /// Others that listen, and who is connected to them.
    others: Mutex<Others>,
}

/// Servers beside Zenoh: where they listen, and who is connected to them.
type Others = Vec<(String, Box<dyn Fn() -> Vec<Connected> + Send>)>;

/// The session to the outside. It is made anew when keys or addresses change: Zenoh reads its access rules once.
struct Outer {
    transport: ZenohTransport,
    fingerprint: String,
    _relay: Relay,
    _machines: Listening,
    _guards: Vec<Guard>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Gateway {
    /// Starts a gateway for a run. `refusals`: what its access rules refuse, from [`refusals::layer`].
    pub fn start(
        client: &Arc<Client>,
        mut options: Options,
        refusals: Receiver<Refusal>,
    ) -> Result<Self, GatewayError> {
        let run = client.run()?;
        let access = Arc::new(RwLock::new(Access::open(&options.config_dir, &run.robot)?));
        let wanted = Wanted::now(&read(&access));
        let machines = Arc::new(Machines::new(client, &access));
        let shared = |options: &Options| {
            Arc::new(Shared {
                client: Arc::clone(client),
                access: Arc::clone(&access),
                options: options.clone(),
                counters: Arc::default(),
                refused: AtomicU64::new(0),
                machines: Arc::clone(&machines),
                outer: Mutex::new(None),
                others: Mutex::default(),
            })
        };
        let first = shared(&options);
        let outer = first.open(&wanted, &run)?;
        // A free port that was found stays the same when the session is made anew.
        if options.remote.listen.port() == 0
            && let Some(found) = listening_at(&outer.transport, "tcp")
        {
            options.remote.listen = found;
        }
        let shared = if options.remote.listen == first.options.remote.listen { first } else { shared(&options) };
        *lock(&shared.outer) = Some(outer);
        let stop = Arc::new(AtomicBool::new(false));
        let thread = {
            let (shared, stop) = (Arc::clone(&shared), Arc::clone(&stop));
            std::thread::spawn(move || shared.keep(wanted, run, &refusals, &stop))
        };
        Ok(Self { shared, stop, thread: Some(thread) })
    }

    /// Where it can be reached, as Zenoh endpoints: readers, holders of a key.
    pub fn endpoints(&self) -> Vec<String> {
        lock(&self.shared.outer).as_ref().map(|outer| outer.transport.endpoints()).unwrap_or_default()
    }

    /// SHA-256 of the certificate that it shows now.
    pub fn fingerprint(&self) -> String {
        lock(&self.shared.outer).as_ref().map(|outer| outer.fingerprint.clone()).unwrap_or_default()
    }

    /// What its servers share with it.
    pub fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // If it panicked, it has said so.
            let _ = thread.join();
        }
        if let Some(outer) = lock(&self.shared.outer).take() {
            outer.close();
        }
    }
}

fn read(access: &RwLock<Access>) -> std::sync::RwLockReadGuard<'_, Access> {
    access.read().unwrap_or_else(PoisonError::into_inner)
}

/// What the session to the outside depends on.
#[derive(Clone, PartialEq, Eq)]
struct Wanted {
    granted: Vec<String>,
    machines: Vec<String>,
    names: Vec<String>,
    addresses: Vec<std::net::IpAddr>,
}

impl Wanted {
    fn now(access: &Access) -> Self {
        let (machines, people): (Vec<&Grant>, Vec<&Grant>) =
            access.grants().iter().filter(|grant| grant.is_valid()).partition(|grant| grant.machine.is_some());
        let ids = |grants: Vec<&Grant>| grants.into_iter().map(|grant| grant.id.clone()).collect();
        Self {
            granted: ids(people),
            machines: ids(machines),
            names: addresses::names(),
            addresses: addresses::addresses(),
        }
    }
}

/// When a file was last changed, and its size: both change when it is replaced.
fn state_of(path: &Path) -> Option<(SystemTime, u64)> {
    let known = std::fs::metadata(path).ok()?;
    Some((known.modified().ok()?, known.len()))
}

fn listening_at(transport: &ZenohTransport, scheme: &str) -> Option<SocketAddr> {
    transport.endpoints().iter().find_map(|endpoint| endpoint.strip_prefix(scheme)?.strip_prefix('/')?.parse().ok())
}

impl Outer {
    fn close(self) {
        let Self { transport, _relay: relay, _machines: machines, _guards: guards, .. } = self;
        drop((relay, machines, guards));
        transport.close();
    }
}

impl Shared {
    /// Names a server beside Zenoh in `carril who`.
    pub fn add_server(&self, listening: String, connected: impl Fn() -> Vec<Connected> + Send + 'static) {
        lock(&self.others).push((listening, Box::new(connected)));
    }

    /// A certificate of the car for this moment, and its fingerprint.
    pub fn identity(&self) -> Result<(Identity, String), AccessError> {
        read(&self.access).server_identity(&addresses::names(), &addresses::addresses())
    }

    /// What has left the car.
    pub fn counters(&self) -> &Arc<Counters> {
        &self.counters
    }

    fn open(self: &Arc<Self>, wanted: &Wanted, run: &RunFile) -> Result<Outer, GatewayError> {
        let remote = &self.options.remote;
        let (identity, fingerprint) = read(&self.access).server_identity(&wanted.names, &wanted.addresses)?;
        let mut listen_tls = remote.listen;
        listen_tls.set_port(if remote.listen.port() == 0 { 0 } else { remote.listen.port() + 1 });
        let transport = ZenohTransport::open_gateway(&GatewayOptions {
            robot: run.robot.clone(),
            listen: remote.read_for_all.then_some(remote.listen),
            listen_tls,
            identity,
            granted: wanted.granted.clone(),
            machines: wanted.machines.clone(),
            estop_for_all: remote.estop_for_all,
            scouting: remote.scouting.clone().map_or(Scouting::Off, Scouting::On),
        })?;
        let relay = Relay::start(&self.client, &transport, run, remote.rates, &self.counters)?;
        let asked = Arc::clone(self);
        let who = move || serde_json::to_vec(&asked.who()).map_err(|error| error.to_string());
        let machines = self.machines.listen(&transport, run)?;
        let answers = Answers::new(
            Arc::clone(&self.client),
            Arc::clone(&self.access),
            Arc::new(who),
            Arc::clone(&self.machines),
            remote.estop_for_all,
        );
        let mut guards = answers.listen(&transport)?;
        guards.extend(self.pass_on_news(&transport, &run.robot)?);
        Ok(Outer { transport, fingerprint, _relay: relay, _machines: machines, _guards: guards })
    }

    /// Status, words, receipts and log: small, and of interest to all.
    fn pass_on_news(&self, outer: &ZenohTransport, robot: &str) -> Result<Vec<Guard>, GatewayError> {
        let outlet = |key: String| -> Result<_, TransportError> {
            let publisher = outer.publish_far(&key, true)?;
            Ok(move |bytes: Result<Vec<u8>, serde_json::Error>| tell(&publisher, bytes))
        };
        let (status, receipts) = (outlet(status_key(robot))?, outlet(receipts_key(robot))?);
        let (applied, log, word) = (outlet(applied_key(robot))?, outlet(log_key(robot))?, outlet(word_key(robot))?);
        Ok(vec![
            self.client.watch_words(move |value| word(serde_json::to_vec(&value)))?,
            self.client.watch_status(move |value| status(serde_json::to_vec(&value)))?,
            self.client.watch_receipts(move |value| receipts(serde_json::to_vec(&value)))?,
            self.client.watch_applied(move |value| applied(serde_json::to_vec(&value)))?,
            self.client.watch_log(move |value| log(serde_json::to_vec(&value)))?,
        ])
    }

    /// Who is connected, and who might be.
    pub fn who(&self) -> Who {
        let (mut connected, mut listening) = (Vec::new(), Vec::new());
        if let Some(outer) = &*lock(&self.outer) {
            listening = outer.transport.endpoints();
            connected.extend(outer.transport.viewers().into_iter().map(|viewer| {
                let access = read(&self.access);
                let grant = viewer.name.as_ref().and_then(|id| access.by_id(id));
                let is_machine = grant.is_some_and(|grant| grant.machine.is_some());
                Connected {
                    address: viewer.address,
                    by: if is_machine { MACHINE } else { "zenoh" }.into(),
                    name: grant.map(|grant| grant.name.clone()).or(viewer.name),
                }
            }));
        }
        for (address, others) in lock(&self.others).iter() {
            listening.push(address.clone());
            connected.extend(others());
        }
        let access = read(&self.access);
        let names = |valid: bool| {
            access.grants().iter().filter(|grant| grant.is_valid() == valid).map(|grant| grant.name.clone()).collect()
        };
        let counts = self.counters.read();
        Who {
            listening,
            connected,
            granted: names(true),
            revoked: names(false),
            machines: self.machines.joined(),
            refused: self.refused.load(Ordering::Relaxed) + self.machines.refused(),
            sent: (counts.sent, counts.sent_bytes),
            dropped: (counts.dropped_images, counts.dropped_data),
        }
    }

    /// Follows keys, addresses, the run and refusals until it is told to stop.
    fn keep(self: &Arc<Self>, mut wanted: Wanted, mut run: RunFile, refusals: &Receiver<Refusal>, stop: &AtomicBool) {
        let grants_file = read(&self.access).grants_file();
        let mut seen = state_of(&grants_file);
        let mut reports = Reports::default();
        let mut looked_at_run = Instant::now();
        let mut said: Option<(Instant, Who)> = None;
        while !stop.load(Ordering::Relaxed) {
            std::thread::sleep(LOOK);
            self.report(refusals, &mut reports);
            self.machines.report();
            self.tell_who(&mut said);
            let now = state_of(&grants_file);
            if now != seen {
                seen = now;
                self.read_grants();
            }
            let mut ports_changed = false;
            if looked_at_run.elapsed() >= LOOK_AT_RUN {
                looked_at_run = Instant::now();
                if let Ok(now) = self.client.run() {
                    ports_changed = now.nodes != run.nodes;
                    run = now;
                }
            }
            let wanted_now = Wanted::now(&read(&self.access));
            if wanted_now != wanted || ports_changed {
                wanted = wanted_now;
                self.reopen(&wanted, &run);
            }
        }
    }

    /// Who is connected, once a second and when it changes.
    fn tell_who(&self, said: &mut Option<(Instant, Who)>) {
        let who = self.who();
        if said.as_ref().is_some_and(|(when, before)| *before == who && when.elapsed() < SAY_AGAIN) {
            return;
        }
        if let Err(error) = self.client.tell_who(&who) {
            tracing::debug!("telling who is connected: {error}");
        }
        *said = Some((Instant::now(), who));
    }

    fn read_grants(&self) {
        match Access::open(&self.options.config_dir, &self.client.file().robot) {
            Ok(access) => *self.access.write().unwrap_or_else(PoisonError::into_inner) = access,
            // What was granted before stays in force.
            Err(error) => self.say(LogLevel::Error, format!("the keys cannot be read anew: {error}")),
        }
    }

    fn reopen(self: &Arc<Self>, wanted: &Wanted, run: &RunFile) {
        let before = lock(&self.outer).take();
        if let Some(before) = before {
            before.close();
        }
        // The port is free a moment after the session is closed.
        let deadline = Instant::now() + Duration::from_secs(5);
        loop {
            match self.open(wanted, run) {
                Ok(outer) => {
                    *lock(&self.outer) = Some(outer);
                    return;
                }
                Err(_) if Instant::now() < deadline => std::thread::sleep(Duration::from_millis(20)),
                Err(error) => {
                    self.say(LogLevel::Error, format!("the gateway cannot listen again: {error}"));
                    std::process::exit(1);
                }
            }
        }
    }

    fn report(&self, refusals: &Receiver<Refusal>, reports: &mut Reports) {
        while let Ok(refusal) = refusals.try_recv() {
            self.refused.fetch_add(1, Ordering::Relaxed);
            let Some(before) = reports.due(&refusal.identity, &refusal.key, Instant::now()) else { continue };
            let viewers = lock(&self.outer).as_ref().map(|outer| outer.transport.viewers()).unwrap_or_default();
            let viewer = viewers.into_iter().find(|viewer| viewer.identity == refusal.identity);
            let from = viewer.map_or_else(|| "somebody".into(), |viewer| viewer.address);
            let Refusal { what, key, .. } = refusal;
            let again = more(before);
            let text = match what {
                "put" | "delete" => {
                    format!(
                        "refused: {from} put on `{key}`; only its own node may, people use `carril pub` with a key{again}"
                    )
                }
                _ => format!("refused: {from} asked `{key}` without the key for it{again}"),
            };
            self.say(LogLevel::Warning, text);
        }
    }

    fn say(&self, level: LogLevel, text: String) {
        tracing::warn!("{text}");
        if let Err(error) = self.client.say(level, GATEWAY, text) {
            tracing::warn!("not in the log of the run: {error}");
        }
    }
}

fn tell(publisher: &FarPublisher, bytes: Result<Vec<u8>, serde_json::Error>) {
    if publisher.wanted()
        && let Ok(bytes) = bytes
        && let Err(error) = publisher.put(None, bytes)
    {
        tracing::debug!("{error}");
    }
}
