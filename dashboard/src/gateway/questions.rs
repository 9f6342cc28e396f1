//! What may be asked of the gateway from outside, and by whom. Zenoh's access rules have let the question through; whoever asks for control
//! is looked up here once more, and what they do is put into the log of the run under their name.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Duration, Instant};

use carril_messages::{Control, Header, Payload, key};
use carril_runtime::client::{Client, far};
use carril_runtime::control_plane::{
    Access as Granted, AccessLevel, ApplyRequest, Change, LogLevel, OPEN_QUESTIONS, access_key, granted_key,
    open_estop_key,
};
use carril_runtime::transport::zenoh::{Question, ZenohTransport};
use carril_runtime::transport::{Guard, TransportError};
use serde::Serialize;

use super::GATEWAY;
use super::machines::Machines;
use crate::access::{Access, Grant};

/// So many questions are answered at the same time; one more is told to try again.
const AT_A_TIME: usize = 32;
/// That somebody puts on a port is said this often.
const NOTE_AGAIN: Duration = Duration::from_secs(10);

/// Answers questions from outside.
#[derive(Clone)]
pub struct Answers {
    /// The way into the run.
    pub client: Arc<Client>,
    /// Who may control.
    pub access: Arc<RwLock<Access>>,
    /// Who is connected, as JSON.
    pub who: Arc<dyn Fn() -> Result<Vec<u8>, String> + Send + Sync>,
    /// Machines that run nodes of the graph.
    pub machines: Arc<Machines>,
    /// The e-stop is for all who may read.
    pub estop_for_all: bool,
    busy: Arc<AtomicUsize>,
    /// Who put where, when that was last said.
    noted: Arc<Mutex<Vec<(String, String, Instant)>>>,
}

impl Answers {
    /// Answers by this client.
    pub fn new(
        client: Arc<Client>,
        access: Arc<RwLock<Access>>,
        who: Arc<dyn Fn() -> Result<Vec<u8>, String> + Send + Sync>,
        machines: Arc<Machines>,
        estop_for_all: bool,
    ) -> Self {
        Self { client, access, who, machines, estop_for_all, busy: Arc::default(), noted: Arc::default() }
    }

    /// Begins to answer on a session.
    pub fn listen(&self, outer: &ZenohTransport) -> Result<Vec<Guard>, TransportError> {
        let robot = self.client.file().robot.clone();
        let mut guards = Vec::new();
        for path in OPEN_QUESTIONS {
            let answers = self.clone();
            let path_too = path.to_owned();
            guards.push(outer.answer(&key::control_key(&robot, path), move |question| {
                if path_too == "clock" {
                    // At once: the time that it takes is a mistake of the clock.
                    let now = answers.client.clock().now().as_nanos();
                    return question.answer(to_json(&now));
                }
                let (own, path) = (answers.clone(), path_too.clone());
                answers.aside(question, move |question| own.open(&path, question));
            })?);
        }
        let answers = self.clone();
        guards.push(outer.answer(&open_estop_key(&robot), move |question| {
            let own = answers.clone();
            answers.aside(question, move |_| own.control("somebody without a key", Control::EStop));
        })?);
        let answers = self.clone();
        guards.push(outer.answer(&granted_key(&robot, "*", "**"), move |question| {
            let own = answers.clone();
            answers.aside(question, move |question| own.granted(question));
        })?);
        Ok(guards)
    }

    /// Answers on another thread: changes take seconds, and the threads of the transport must not wait.
    fn aside(&self, question: Question, answer: impl FnOnce(&Question) -> Result<Vec<u8>, String> + Send + 'static) {
        let busy = Arc::clone(&self.busy);
        if busy.fetch_add(1, Ordering::Relaxed) >= AT_A_TIME {
            busy.fetch_sub(1, Ordering::Relaxed);
            return question.answer(Err("the gateway is busy with other questions; try again".into()));
        }
        std::thread::spawn(move || {
            let answered = answer(&question);
            question.answer(answered);
            busy.fetch_sub(1, Ordering::Relaxed);
        });
    }

    fn open(&self, path: &str, question: &Question) -> Result<Vec<u8>, String> {
        match path {
            "run" => self.client.run().map_err(text).and_then(|run| to_json(&run)),
            "graph" => self.client.graph().map_err(text).and_then(|graph| to_json(&graph)),
            "log" => self.client.log().map_err(text).and_then(|log| to_json(&log)),
            _ => {
                let robot = &self.client.file().robot;
                let id = question.key().strip_prefix(&access_key(robot, "")).unwrap_or_default();
                to_json(&level_of(&self.access.read().unwrap_or_else(PoisonError::into_inner), id))
            }
        }
    }

    /// `as/<id>/<path>`
    fn granted(&self, question: &Question) -> Result<Vec<u8>, String> {
        let robot = &self.client.file().robot;
        let below = key::control_key(robot, "as/");
        let rest = question.key().strip_prefix(&below).and_then(|rest| rest.split_once('/'));
        let (id, path) = rest.ok_or("asked for nothing")?;
        if let Some(machine) = path.strip_prefix("machine/").and_then(|rest| rest.strip_suffix("/join")) {
            return self.machines.join(id, machine, &question.bytes()).and_then(|joined| to_json(&joined));
        }
        let access = level_of(&self.access.read().unwrap_or_else(PoisonError::into_inner), id);
        if access.level != AccessLevel::Control {
            return Err(access.why);
        }
        let name = access.name.unwrap_or_default();
        let bytes = question.bytes();
        match path {
            "change" => {
                let change: Change = from_json(&bytes)?;
                self.note(&name, &describe(&change));
                self.client.change(&change).map_err(text).and_then(|receipt| to_json(&receipt))
            }
            "apply" => {
                let request: ApplyRequest = from_json(&bytes)?;
                if request.agreed.is_some() {
                    self.note(&name, "apply another graph");
                }
                self.client.apply(&request).map_err(text).and_then(|receipt| to_json(&receipt))
            }
            "control" => self.control(&name, from_json(&bytes)?),
            "who" => (self.who)(),
            _ => match path.strip_prefix("pub/").and_then(|port| port.split_once('/')) {
                Some((node, port)) => self.put(&name, node, port, &bytes),
                None => Err(format!("there is no `{path}` to ask for")),
            },
        }
    }

    /// Says a word to the car under a name.
    pub fn control(&self, name: &str, word: Control) -> Result<Vec<u8>, String> {
        self.note(name, &word.to_string());
        self.client.control(word).map_err(text).and_then(|replies| to_json(&replies))
    }

    fn put(&self, name: &str, node: &str, port: &str, packed: &[u8]) -> Result<Vec<u8>, String> {
        let (header, payload) = far::unpack_sample(packed).ok_or("the sample is cut off")?;
        let header = Header::decode(header).map_err(text)?;
        let run = self.client.run().map_err(text)?;
        let found = run.nodes.iter().find(|known| known.name == node);
        let input = found.and_then(|node| node.inputs.iter().find(|input| input.port == port && input.external));
        let Some(input) = input else { return Err(format!("`{node}/{port}` is no input that is open to people")) };
        if header.message_type.name != input.message_type {
            return Err(format!("`{node}/{port}` takes `{}`, got `{}`", input.message_type, header.message_type));
        }
        self.note_pub(name, &format!("pub {node}/{port}"));
        self.client.pass_on(node, port, &header, Payload::from(payload.to_vec())).map_err(text)?;
        Ok(Vec::new())
    }

    /// The same, now and then: whoever drives by hand puts fifty times a second.
    fn note_pub(&self, name: &str, what: &str) {
        let now = Instant::now();
        let mut noted = self.noted.lock().unwrap_or_else(PoisonError::into_inner);
        noted.retain(|(_, _, when)| now.duration_since(*when) < NOTE_AGAIN);
        if !noted.iter().any(|(who, did, _)| who == name && did == what) {
            noted.push((name.to_owned(), what.to_owned(), now));
            drop(noted);
            self.note(name, what);
        }
    }

    /// Who did what, for the log of the run.
    pub fn note(&self, name: &str, what: &str) {
        tracing::info!("{name}: {what}");
        if let Err(error) = self.client.say(LogLevel::Info, GATEWAY, format!("{name}: {what}")) {
            tracing::warn!("not in the log of the run: {error}");
        }
    }
}

/// What the holder of a key may do.
pub fn level_of(access: &Access, id: &str) -> Granted {
    match access.by_id(id) {
        Some(Grant { machine: Some(machine), revoked_s: None, name, .. }) => Granted {
            level: AccessLevel::Read,
            name: Some(name.clone()),
            why: format!(
                "the key is for the nodes on machine `{machine}`; to control the car: carril grant --control NAME"
            ),
        },
        Some(grant) if grant.is_valid() => {
            Granted { level: AccessLevel::Control, name: Some(grant.name.clone()), why: "a granted key".into() }
        }
        Some(grant) => Granted {
            level: AccessLevel::Read,
            name: Some(grant.name.clone()),
            why: format!("the key of `{}` was revoked; on the car: carril grant --control NAME", grant.name),
        },
        None => Granted {
            level: AccessLevel::Read,
            name: None,
            why: format!("the car has granted no key `{id}`; on the car: carril grant --control NAME"),
        },
    }
}

fn describe(change: &Change) -> String {
    match change {
        Change::Set { node, values } => {
            let values = values.iter().map(|(path, value)| format!("{path}={value}")).collect::<Vec<_>>().join(" ");
            format!("set {node} {values}")
        }
        Change::Swap(request) if request.terms.compare_only => format!("shadow {}", request.node),
        Change::Swap(request) => format!("swap {}", request.node),
        Change::Rollback { node, .. } => format!("rollback {node}"),
        Change::Restart { node, .. } => format!("restart {node}"),
    }
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

fn to_json(value: &impl Serialize) -> Result<Vec<u8>, String> {
    serde_json::to_vec(value).map_err(text)
}

fn from_json<T: for<'de> serde::Deserialize<'de>>(bytes: &[u8]) -> Result<T, String> {
    serde_json::from_slice(bytes).map_err(|error| format!("the request is not readable: {error}"))
}
