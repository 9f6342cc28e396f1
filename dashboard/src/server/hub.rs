//! Listens to the ports of the graph for all viewers together: each port once, and only while somebody looks.

use std::collections::HashMap;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, Weak};
use std::time::Instant;

use carril_runtime::client::Client;
use carril_runtime::transport::Guard;
use tokio::sync::watch;

use super::graph::Sources;
use super::messages;
use super::outbox::{Arrival, Outbox};

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Every port that somebody looks at.
pub struct Hub {
    client: Arc<Client>,
    ports: Mutex<HashMap<String, Weak<Port>>>,
    /// Names of the ports that exposures come from.
    sources: Arc<RwLock<Arc<Sources>>>,
    /// Where subscriptions are ended: not on a thread that must not wait.
    ended: Sender<Guard>,
}

/// A port that somebody looks at. With the last of its holders the subscription ends.
pub struct Port {
    newest: watch::Sender<Option<Arc<Arrival>>>,
    outboxes: Mutex<Vec<Weak<Outbox>>>,
    guard: Mutex<Option<Guard>>,
    ended: Sender<Guard>,
}

impl Drop for Port {
    fn drop(&mut self) {
        if let Some(guard) = lock(&self.guard).take() {
            // Nobody is there: the hub has gone, and the guard goes here.
            let _ = self.ended.send(guard);
        }
    }
}

impl Hub {
    /// One that listens to nothing yet.
    pub fn new(client: Arc<Client>) -> std::io::Result<Self> {
        let (ended, guards) = channel();
        std::thread::Builder::new().name("ports".into()).spawn(move || guards.into_iter().for_each(drop))?;
        Ok(Self { client, ports: Mutex::default(), sources: Arc::default(), ended })
    }

    /// Listens to a port; blocks until the subscription is there.
    pub fn listen(&self, key: &str) -> Result<Arc<Port>, String> {
        let (node, name) = messages::split(key).ok_or_else(|| format!("`{key}` is no port; ports are `node/port`"))?;
        let port = {
            let mut ports = lock(&self.ports);
            ports.retain(|_, port| port.strong_count() > 0);
            let known = ports.get(key).and_then(Weak::upgrade);
            known.unwrap_or_else(|| {
                let port = Arc::new(Port {
                    newest: watch::channel(None).0,
                    outboxes: Mutex::default(),
                    guard: Mutex::default(),
                    ended: self.ended.clone(),
                });
                ports.insert(key.to_owned(), Arc::downgrade(&port));
                port
            })
        };
        let mut guard = lock(&port.guard);
        if guard.is_none() {
            let (heard, key, sources) = (Arc::downgrade(&port), key.to_owned(), Arc::clone(&self.sources));
            let hear = move |header, payload, _| {
                if let Some(port) = heard.upgrade() {
                    let sources = sources.read().unwrap_or_else(PoisonError::into_inner).clone();
                    port.hear(Arc::new(Arrival::new(key.clone(), header, payload, sources)));
                }
            };
            *guard = Some(self.client.subscribe(node, name, hear).map_err(|error| error.to_string())?);
        }
        drop(guard);
        Ok(port)
    }

    /// The graph has these ports.
    pub fn name_sources(&self, sources: &Arc<Sources>) {
        *self.sources.write().unwrap_or_else(PoisonError::into_inner) = Arc::clone(sources);
    }

    /// How many ports are listened to.
    pub fn listening_to(&self) -> usize {
        lock(&self.ports).values().filter(|port| port.strong_count() > 0).count()
    }
}

impl Port {
    fn hear(&self, arrival: Arc<Arrival>) {
        let now = Instant::now();
        lock(&self.outboxes).retain(|outbox| {
            let outbox = outbox.upgrade();
            outbox.inspect(|outbox| outbox.offer(&arrival, now)).is_some()
        });
        self.newest.send_replace(Some(arrival));
    }

    /// Passes on every sample to a viewer, beginning with the newest if there is one.
    pub fn pass_to(&self, outbox: &Arc<Outbox>) {
        let mut outboxes = lock(&self.outboxes);
        if !outboxes.iter().any(|known| std::ptr::eq(known.as_ptr(), Arc::as_ptr(outbox))) {
            outboxes.push(Arc::downgrade(outbox));
            if let Some(newest) = &*self.newest.borrow() {
                outbox.offer(newest, Instant::now());
            }
        }
    }

    /// Passes on no more.
    pub fn part_from(&self, outbox: &Arc<Outbox>) {
        lock(&self.outboxes).retain(|known| !std::ptr::eq(known.as_ptr(), Arc::as_ptr(outbox)));
    }

    /// The newest sample, or the first that comes.
    pub async fn newest(&self) -> Option<Arc<Arrival>> {
        let mut newest = self.newest.subscribe();
        newest.wait_for(Option::is_some).await.ok()?.clone()
    }
}
