//! What all connections of a server share: the way into the run, who is there, and what each may do.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use carril_runtime::client::Client;
use carril_runtime::control_plane::{Access, AccessLevel, Connected, LogLevel};
use serde_json::{Value, json};
use tokio::sync::{Notify, Semaphore, watch};

use super::Options;
use super::doors::Peer;
use super::graph::GraphNow;
use super::hub::Hub;
use super::outbox::{Outbox, Traffic};
use super::press::Press;
use super::sessions::{Sessions, Tries};
use super::wheel::Wheel;
use crate::access;
use crate::gateway::questions::level_of;

/// The name of the server in logs; no process of a graph can have it.
pub const DASHBOARD: &str = "_dashboard";
/// Viewers at a time.
pub const MOST_VIEWERS: usize = 64;
/// Changes of the graph at a time, each of which waits for seconds.
const CHANGES: usize = 8;
/// Words to the car at a time.
const WORDS: usize = 16;
/// E-stops at a time: each viewer has one.
const STOPS: usize = MOST_VIEWERS;
/// Looks at pixels, logs and ports at a time.
const LOOKS: usize = 16;

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Somebody who looks on.
pub struct Viewer {
    /// Which one.
    pub id: u64,
    /// Where.
    pub peer: Peer,
    /// The session that the connection was opened with.
    pub session: Option<String>,
    /// What waits for it.
    pub outbox: Arc<Outbox>,
    /// What it was told that it may do.
    pub told: Mutex<Access>,
    /// Requests of it that are being answered.
    pub asking: Arc<Semaphore>,
    /// Whoever knows this may carry its view on a second connection. `None`: the system gave no random number.
    pub view: Option<String>,
}

/// What connections share.
pub struct House {
    /// The way into the run.
    pub client: Arc<Client>,
    /// As it was started.
    pub options: Options,
    /// Names of this machine.
    pub names: Vec<String>,
    /// Ports.
    pub hub: Hub,
    /// Images.
    pub press: Press,
    /// Driving by hand.
    pub wheel: Wheel,
    /// Who is logged in.
    pub sessions: Sessions,
    /// Who guesses.
    pub tries: Tries,
    /// The graph as it is, while somebody looks.
    pub graph: watch::Sender<Option<Arc<GraphNow>>>,
    /// Rings when the graph may have changed, or a viewer has come.
    pub look: Notify,
    /// Why the server ends, when it does.
    pub end: watch::Sender<Option<String>>,
    /// What has left the server.
    pub traffic: Arc<Traffic>,
    /// Whether there is a certificate to show.
    pub has_certificate: AtomicBool,
    /// What the client itself may do.
    pub own_access: Mutex<Access>,
    /// Limits for what blocks.
    pub limits: Limits,
    viewers: Mutex<BTreeMap<u64, Arc<Viewer>>>,
    /// WebSockets that are being served, also those of viewers who have gone and have not been told goodbye yet.
    served: AtomicUsize,
    next_viewer: AtomicU64,
    notes: Sender<(LogLevel, String)>,
}

/// So much at a time of what blocks.
pub struct Limits {
    /// Changes of the graph.
    pub changes: Semaphore,
    /// Words to the car.
    pub words: Semaphore,
    /// E-stops.
    pub stops: Semaphore,
    /// Looks at something.
    pub looks: Semaphore,
}

impl House {
    pub(super) fn new(client: Arc<Client>, options: Options) -> std::io::Result<Self> {
        let (notes, said) = channel::<(LogLevel, String)>();
        let speaker = Arc::clone(&client);
        std::thread::Builder::new().name("notes".into()).spawn(move || {
            for (level, text) in said {
                // Far away the gateway puts it into the log, under the name of the key.
                if speaker.is_far() {
                    continue;
                }
                if let Err(error) = speaker.say(level, DASHBOARD, text.clone()) {
                    tracing::warn!("{text} (not in the log of the run: {error})");
                }
            }
        })?;
        let driving = notes.clone();
        let say = move |name: &str, what: &str| drop(driving.send((LogLevel::Info, format!("{name}: {what}"))));
        Ok(Self {
            hub: Hub::new(Arc::clone(&client))?,
            press: Press::start()?,
            wheel: Wheel::start(Arc::clone(&client), Arc::new(say))?,
            own_access: Mutex::new(client.access()),
            has_certificate: AtomicBool::new(options.certificate.is_some()),
            client,
            options,
            names: crate::gateway::addresses::names(),
            sessions: Sessions::default(),
            tries: Tries::default(),
            graph: watch::channel(None).0,
            look: Notify::new(),
            end: watch::channel(None).0,
            traffic: Arc::default(),
            limits: Limits {
                changes: Semaphore::new(CHANGES),
                words: Semaphore::new(WORDS),
                stops: Semaphore::new(STOPS),
                looks: Semaphore::new(LOOKS),
            },
            viewers: Mutex::default(),
            served: AtomicUsize::new(0),
            next_viewer: AtomicU64::new(1),
            notes,
        })
    }

    /// Name of the robot.
    pub fn robot(&self) -> &str {
        &self.client.file().robot
    }

    /// A line for the log of the run.
    pub fn note(&self, level: LogLevel, text: String) {
        // The thread of notes lives as long as the house.
        let _ = self.notes.send((level, text));
    }

    /// What somebody may do, at this moment.
    pub fn access(&self, peer: &Peer, session: Option<&str>) -> Access {
        if self.is_local(peer) {
            return lock(&self.own_access).clone();
        }
        let key_id = session.and_then(|secret| self.sessions.key_id(secret, Instant::now()));
        if let (Some(access), Some(id)) = (&self.options.access, key_id) {
            return level_of(&access.read().unwrap_or_else(PoisonError::into_inner), &id);
        }
        Access { level: AccessLevel::Read, name: None, why: self.why_not(peer) }
    }

    fn is_local(&self, peer: &Peer) -> bool {
        self.options.local_control && peer.is_here()
    }

    fn why_not(&self, peer: &Peer) -> String {
        if self.options.access.is_none() {
            return "there is no log-in here; control it from the machine where this server runs".into();
        }
        if self.can_log_in(peer) {
            return "log in with the name and the token of a key; on the car: carril grant --control NAME".into();
        }
        if self.has_certificate.load(Ordering::Relaxed) {
            return "this connection is not encrypted, so that nobody can log in over it; use https://".into();
        }
        "this connection is not encrypted, so that nobody can log in over it, and the server has no certificate".into()
    }

    /// Whether a token may be sent over this connection, and would be of use.
    pub fn can_log_in(&self, peer: &Peer) -> bool {
        self.options.access.is_some() && !self.is_local(peer) && (peer.encrypted || peer.is_here())
    }

    /// Whether somebody with this access may see the car.
    pub fn may_read(&self, access: &Access) -> bool {
        self.options.read_for_all || access.level == AccessLevel::Control
    }

    /// Takes somebody in. `None`: there is no place left.
    pub fn enter(&self, peer: Peer, session: Option<String>) -> Option<Arc<Viewer>> {
        let access = self.access(&peer, session.as_deref());
        let mut viewers = lock(&self.viewers);
        if viewers.len() >= MOST_VIEWERS {
            return None;
        }
        let id = self.next_viewer.fetch_add(1, Ordering::Relaxed);
        let outbox = Arc::new(Outbox::new(Arc::clone(&self.traffic)));
        let asking = Arc::new(Semaphore::new(super::viewer::ASKING));
        let view = access::random_hex::<16>().ok();
        let viewer = Arc::new(Viewer { id, peer, session, outbox, told: Mutex::new(access), asking, view });
        viewers.insert(id, Arc::clone(&viewer));
        drop(viewers);
        self.look.notify_one();
        Some(viewer)
    }

    /// The viewer whose view somebody wants to carry, from where the viewer is itself.
    pub fn of_view(&self, view: &str, peer: &Peer) -> Option<Arc<Viewer>> {
        let viewers = lock(&self.viewers);
        let ip = |peer: &Peer| peer.address.ip().to_canonical();
        let fits = |viewer: &&Arc<Viewer>| viewer.view.as_deref() == Some(view) && ip(&viewer.peer) == ip(peer);
        viewers.values().find(fits).cloned()
    }

    /// Somebody has gone.
    pub fn leave(&self, viewer: &Viewer) {
        self.wheel.let_go(viewer.id);
        lock(&self.viewers).remove(&viewer.id);
        self.look.notify_one();
    }

    /// A WebSocket is served from now on, as long as the guard lives.
    pub fn serving(self: &Arc<Self>) -> Serving {
        self.served.fetch_add(1, Ordering::SeqCst);
        Serving(Arc::clone(self))
    }

    /// Whether every WebSocket has come to its end.
    pub fn is_quiet(&self) -> bool {
        self.served.load(Ordering::SeqCst) == 0
    }

    /// Whether there is a place left.
    pub fn has_place(&self) -> bool {
        lock(&self.viewers).len() < MOST_VIEWERS
    }

    /// Everybody who looks on.
    pub fn viewers(&self) -> Vec<Arc<Viewer>> {
        lock(&self.viewers).values().cloned().collect()
    }

    /// Everybody, for `carril who`.
    pub fn connected(&self) -> Vec<Connected> {
        let connected = |viewer: &Arc<Viewer>| Connected {
            address: viewer.peer.address.to_string(),
            by: "dashboard".into(),
            name: self.access(&viewer.peer, viewer.session.as_deref()).name,
        };
        self.viewers().iter().map(connected).collect()
    }

    /// What this server has to say of itself.
    pub fn link(&self) -> Value {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let Traffic { sent_bytes, dropped_images, dropped_data } = &*self.traffic;
        json!({
            "sent_bytes": read(sent_bytes),
            "dropped": { "image": read(dropped_images), "data": read(dropped_data) },
            "viewers": lock(&self.viewers).len(),
            "driver": self.wheel.driver(),
        })
    }
}

/// A WebSocket is being served.
pub struct Serving(Arc<House>);

impl Drop for Serving {
    fn drop(&mut self) {
        self.0.served.fetch_sub(1, Ordering::SeqCst);
    }
}

impl Viewer {
    /// Who it is, for logs and for others.
    pub fn name(&self, access: &Access) -> String {
        access.name.clone().unwrap_or_else(|| format!("somebody at {}", self.peer.address.ip()))
    }
}
