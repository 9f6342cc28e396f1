//! Machines that run nodes of the car's graph: who has joined, and what they put. Zenoh's access rules have let it through; here the key,
//! the place of the node in the graph, the port and the type are looked at once more before a sample goes into the run.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use carril_messages::{Header, Health, Payload, Stamp, key};
use carril_runtime::client::{Client, ClientError};
use carril_runtime::control_plane::{FaultReport, LogLevel, NodeEntry, RunFile, machine_key};
use carril_runtime::machines::{Join, Joined, SILENCE};
use carril_runtime::transport::zenoh::{StandIn, ZenohTransport};
use carril_runtime::transport::{Guard, TransportError};

use super::GATEWAY;
use super::reports::{Reports, more};
use crate::access::Access;
use crate::machine::{Carrier, Latest, Sample, fits, unpacked};

/// Whether somebody reads an output is looked up this often.
const LOOK: Duration = Duration::from_millis(50);
/// A sample that says it is from farther in the future has a wrong clock behind it: it would seem fresh for too long.
const CLOCK_AHEAD: Duration = Duration::from_secs(1);
/// Health and faults that wait to be passed on; more come again, or say the same.
const WAITING: usize = 64;
/// Refusals that wait to be reported; more are only counted.
const REFUSALS: usize = 256;

/// What the gateway knows of machines. Outlives the sessions to the outside.
pub struct Machines {
    client: Arc<Client>,
    access: Arc<RwLock<Access>>,
    joined: Mutex<HashMap<String, Seen>>,
    refused: AtomicU64,
    refusals: Mutex<Vec<(String, String)>>,
    reports: Mutex<Reports>,
}

/// A machine that has joined.
struct Seen {
    /// The name in its certificate.
    id: String,
    /// When its run began.
    started: Stamp,
    heard: Instant,
    /// What was looked at when it was let in: only something else is looked at again.
    said: Vec<u8>,
    nodes: Vec<NodeEntry>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Machines {
    /// None has joined yet.
    pub fn new(client: &Arc<Client>, access: &Arc<RwLock<Access>>) -> Self {
        Self {
            client: Arc::clone(client),
            access: Arc::clone(access),
            joined: Mutex::default(),
            refused: AtomicU64::new(0),
            refusals: Mutex::default(),
            reports: Mutex::default(),
        }
    }

    /// The machine for which a key was made, if it still counts.
    fn machine_of(&self, id: &str) -> Result<String, String> {
        let access = self.access.read().unwrap_or_else(PoisonError::into_inner);
        match access.by_id(id) {
            Some(grant) if grant.is_valid() => grant.machine.clone().ok_or_else(|| {
                format!("the key of `{}` is for people; on the car: carril grant --machine NAME", grant.name)
            }),
            Some(grant) => Err(format!("the key of `{}` was revoked", grant.name)),
            None => Err(format!("the car has granted no key `{id}`")),
        }
    }

    /// A machine joins, or says that it is still there.
    pub fn join(&self, id: &str, machine: &str, bytes: &[u8]) -> Result<Joined, String> {
        let own = self.machine_of(id)?;
        if own != machine {
            return Err(format!("the key is that of machine `{own}`, not of `{machine}`"));
        }
        let run = self.client.run().map_err(|error| error.to_string())?;
        let mut joined = lock(&self.joined);
        let known =
            joined.get_mut(machine).filter(|seen| seen.id == id && seen.said == bytes && seen.nodes == run.nodes);
        if let Some(seen) = known {
            seen.heard = Instant::now();
            return Ok(Joined { started: run.started });
        }
        let join: Join = serde_json::from_slice(bytes).map_err(|error| {
            format!("the car does not understand the machine; is its carril of the same version? {error}")
        })?;
        if let Some(other) = joined.get(machine).filter(|seen| seen.heard.elapsed() < SILENCE) {
            if other.id != id {
                return Err(format!("machine `{machine}` has joined already, with the key `{}`", other.id));
            }
            if other.started != join.started {
                return Err(format!("machine `{machine}` has joined already, from another run; end that one first"));
            }
        }
        drop(joined);
        let graph = self.client.graph().map_err(|error| error.to_string())?;
        let differences = join.differences(machine, &run, &graph);
        if !differences.is_empty() {
            lock(&self.joined).remove(machine);
            return Err(format!("its graph is not that of the car: {}", differences.join("; ")));
        }
        let (id, started, said) = (id.to_owned(), join.started, bytes.to_vec());
        let seen = Seen { id, started, heard: Instant::now(), said, nodes: run.nodes };
        lock(&self.joined).insert(machine.to_owned(), seen);
        Ok(Joined { started: run.started })
    }

    /// The machines that are there.
    pub fn joined(&self) -> Vec<String> {
        let mut joined = lock(&self.joined);
        joined.retain(|machine, seen| {
            seen.heard.elapsed() < SILENCE && self.machine_of(&seen.id).is_ok_and(|own| own == *machine)
        });
        let mut names: Vec<String> = joined.keys().cloned().collect();
        names.sort();
        names
    }

    /// What was refused since the start of the gateway.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Whose put on `as/<id>/machine/<machine>/...` it is, if they may: the machine. `None`: it has not joined yet, which is no offence.
    fn sender(&self, key: &str) -> Result<Option<String>, String> {
        let robot = &self.client.file().robot;
        let below = key::control_key(robot, "as/");
        let mut chunks = key.strip_prefix(&below).unwrap_or_default().split('/');
        let (id, machine) = (chunks.next().unwrap_or_default(), chunks.nth(1).unwrap_or_default());
        let own = self.machine_of(id)?;
        if own != machine {
            return Err(format!("it is the key of machine `{own}`"));
        }
        let joined = lock(&self.joined);
        Ok(joined.get(machine).filter(|seen| seen.id == id).map(|_| own))
    }

    fn refuse(&self, key: &str, why: String) {
        self.refused.fetch_add(1, Ordering::Relaxed);
        let mut refusals = lock(&self.refusals);
        if refusals.len() < REFUSALS {
            refusals.push((key.to_owned(), why));
        }
    }

    /// Says what was refused; called now and then, on a thread that may wait.
    pub fn report(&self) {
        for (key, why) in std::mem::take(&mut *lock(&self.refusals)) {
            if let Some(before) = lock(&self.reports).due(&key, &why, Instant::now()) {
                let text = format!("refused: put on `{key}`: {why}{}", more(before));
                tracing::warn!("{text}");
                if let Err(error) = self.client.say(LogLevel::Warning, GATEWAY, text) {
                    tracing::warn!("not in the log of the run: {error}");
                }
            }
        }
    }

    /// Passes on what machines put, until the guard is dropped.
    pub fn listen(self: &Arc<Self>, outer: &ZenohTransport, run: &RunFile) -> Result<Listening, ClientError> {
        let mut inlets = Vec::new();
        for node in run.nodes.iter().filter(|node| node.machine.is_some()) {
            for output in &node.outputs {
                inlets.push(Inlet {
                    machines: Arc::clone(self),
                    machine: node.machine.clone().unwrap_or_default(),
                    path: format!("port/{}/{}", node.name, output.port),
                    message_type: output.message_type.clone(),
                    stand_in: Arc::new(self.client.stand_in(&node.name, &output.port)?),
                    tap: None,
                });
            }
        }
        let news = if inlets.is_empty() { Vec::new() } else { self.hear_news(outer, run)? };
        let stop = Arc::new(AtomicBool::new(false));
        let (told, outer) = (Arc::clone(&stop), outer.clone());
        let thread = std::thread::spawn(move || {
            while !inlets.is_empty() && !told.load(Ordering::Relaxed) {
                for inlet in &mut inlets {
                    inlet.follow_readers(&outer);
                }
                std::thread::sleep(LOOK);
            }
        });
        Ok(Listening { stop, thread: Some(thread), _news: news })
    }

    /// Hears how their nodes do, and that one of them stops the car.
    fn hear_news(self: &Arc<Self>, outer: &ZenohTransport, run: &RunFile) -> Result<Vec<Guard>, TransportError> {
        // The threads of the transport must not wait for room in the session inside.
        let (sender, news) = sync_channel::<(String, Vec<u8>)>(WAITING);
        let machines = Arc::clone(self);
        std::thread::spawn(move || news.iter().for_each(|(key, bytes)| machines.pass_on_news(&key, &bytes)));
        let hear = |path: &str, sender: SyncSender<(String, Vec<u8>)>| {
            outer.watch(&machine_key(&run.robot, "*", "*", path), move |key, _, payload| {
                // When nobody keeps up, the next one will do.
                let _ = sender.try_send((key.to_owned(), payload.to_vec()));
            })
        };
        Ok(vec![hear("status", sender.clone())?, hear("fault", sender)?])
    }

    fn pass_on_news(&self, key: &str, bytes: &[u8]) {
        let machine = match self.sender(key) {
            Ok(Some(machine)) => machine,
            Ok(None) => return,
            Err(why) => return self.refuse(key, why),
        };
        let own = |node: &str| {
            let joined = lock(&self.joined);
            let seen = joined.get(&machine);
            seen.is_some_and(|seen| {
                seen.nodes.iter().any(|known| known.name == node && known.machine.as_ref() == Some(&machine))
            })
        };
        let passed = if key.ends_with("/fault") {
            let fault: Result<FaultReport, _> = serde_json::from_slice(bytes);
            match fault {
                Ok(fault) if own(&fault.node) => self.client.tell_fault(&fault).map_err(|error| error.to_string()),
                Ok(fault) => Err(format!("node `{}` is not one of machine `{machine}`", fault.node)),
                Err(error) => Err(error.to_string()),
            }
        } else {
            let nodes: Result<Vec<Health>, _> = serde_json::from_slice(bytes);
            nodes.map_err(|error| error.to_string()).and_then(|nodes| {
                nodes.iter().try_for_each(|health| {
                    if !own(&health.node) {
                        return Err(format!("node `{}` is not one of machine `{machine}`", health.node));
                    }
                    self.client.tell_health(health).map_err(|error| error.to_string())
                })
            })
        };
        if let Err(why) = passed {
            self.refuse(key, why);
        }
    }
}

/// Passes on until it is dropped.
pub struct Listening {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    _news: Vec<Guard>,
}

impl Drop for Listening {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // If it panicked, it has said so.
            let _ = thread.join();
        }
    }
}

/// An output of a node elsewhere.
struct Inlet {
    machines: Arc<Machines>,
    machine: String,
    path: String,
    message_type: String,
    stand_in: Arc<StandIn>,
    tap: Option<(Guard, Carrier)>,
}

impl Inlet {
    /// Hears the machine while somebody on the car reads the output: then, and only then, the machine sends it.
    fn follow_readers(&mut self, outer: &ZenohTransport) {
        match (self.stand_in.wanted(), self.tap.is_some()) {
            (true, false) => match self.open(outer) {
                Ok(tap) => self.tap = Some(tap),
                Err(error) => tracing::warn!("hearing `{}` of machine `{}`: {error}", self.path, self.machine),
            },
            (false, true) => self.tap = None,
            _ => {}
        }
    }

    fn open(&self, outer: &ZenohTransport) -> Result<(Guard, Carrier), TransportError> {
        let (stand_in, path) = (Arc::clone(&self.stand_in), self.path.clone());
        let carrier = Carrier::start(move |sample| {
            let put = unpacked(sample)
                .and_then(|(header, payload)| stand_in.put(&header, payload).map_err(|error| error.to_string()));
            if let Err(error) = put {
                tracing::debug!("passing on `{path}`: {error}");
            }
        });
        let (machines, message_type, slot) = (Arc::clone(&self.machines), self.message_type.clone(), carrier.slot());
        let key = machine_key(&self.machines.client.file().robot, "*", &self.machine, &self.path);
        let hear = move |key: &str, header: &[u8], payload: Payload| {
            machines.hear(key, header, payload, &message_type, &slot);
        };
        Ok((outer.watch(&key, hear)?, carrier))
    }
}

impl Machines {
    fn hear(&self, key: &str, header: &[u8], payload: Payload, message_type: &str, slot: &Latest<Sample>) {
        match self.sender(key) {
            Ok(Some(_)) => {}
            Ok(None) => return,
            Err(why) => return self.refuse(key, why),
        }
        let header = match Header::decode(header) {
            Ok(header) => header,
            Err(error) => return self.refuse(key, error.to_string()),
        };
        if !fits(&header, message_type) {
            return self.refuse(key, format!("the port gives `{message_type}`, got `{}`", header.message_type));
        }
        let now = self.client.clock().now();
        let newest = header.origins.iter().map(|origin| origin.stamp).fold(header.stamp, std::cmp::Ord::max);
        if newest > now + CLOCK_AHEAD {
            let ahead = newest.since(now).as_secs_f64();
            return self.refuse(key, format!("it says that it is from {ahead:.1} s in the future"));
        }
        slot.put((header, payload));
    }
}
