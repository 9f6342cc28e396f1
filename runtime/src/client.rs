//! A tool's way into a running graph: finds the run, hears ports, asks, and passes words on. On the same machine it connects to every
//! process itself, so that it works even when the supervisor is gone, and nothing need be set at launch. From afar it connects to the
//! gateway of the car ([`far`]), which decides what it may do.

pub mod far;
pub mod machine;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Control, Encoded, Header, Key, MessageType, Origins, Payload, Stamp};
use serde::de::DeserializeOwned;
use thiserror::Error;

use crate::clock::{Clock, LiveClock};
use crate::control_plane::{
    Access, AccessLevel, ApplyReceipt, ApplyRequest, Change, ControlReply, LiveGraph, LogLevel, LogLine, ProcessEntry,
    RUN_DIR_VARIABLE, Receipt, RunFile, Status, Who, applied_key, apply_key, change_key, gateway_key, graph_key,
    log_key, receipts_key, run_key, runs_dir, said_key, status_key, who_key, word_key,
};
use crate::process::monotonic_now;
use crate::supervisor::run_dir::{STAND_IN_SOCKET, is_alive, read_run_file, tool_socket};
use crate::tap;
use crate::transport::zenoh::{ZenohOptions, ZenohTransport, endpoint};
use crate::transport::{Guard, Transport, TransportError};

/// The links of a tool come up within this time, if at all.
const LINK_PATIENCE: Duration = Duration::from_secs(2);

/// A living supervisor answers a question within this time; on a busy machine the first one may be asked before it can be heard.
const ANSWER_PATIENCE: Duration = Duration::from_secs(5);

/// Between two tries.
const ASK_AGAIN: Duration = Duration::from_millis(10);

/// A run that is younger is still starting: all its processes will be up in a moment.
const START_PATIENCE: Duration = Duration::from_secs(3);

/// A change takes no longer than this, besides the times asked for: processes start and devices open.
const CHANGE_PATIENCE: Duration = Duration::from_secs(60);

/// Why there is no way into a run.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ClientError {
    /// Nothing runs.
    #[error("no graph is running (looked in `{dir}`); start one in another terminal: carril run dataflow.yaml")]
    NoRun {
        /// Where we looked.
        dir: String,
    },
    /// Several run, and none was named.
    #[error("several graphs are running: {robots}; choose one with --robot")]
    SeveralRuns {
        /// Their robots.
        robots: String,
    },
    /// Others run.
    #[error("no graph is running for robot `{robot}`; running are {robots}")]
    OtherRuns {
        /// The robot that was named.
        robot: String,
        /// Those that run.
        robots: String,
    },
    /// It has died and left its folder.
    #[error(
        "the run of robot `{robot}` has died (its supervisor was process {pid}); start it again: carril run {graph}"
    )]
    Stale {
        /// The robot.
        robot: String,
        /// The process that is gone.
        pid: u32,
        /// The graph file.
        graph: String,
    },
    /// Nobody answers far away.
    #[error(
        "no car answers at `{endpoint}` (waited {waited_s:.1} s); is it on, in the same network, and does its graph have `remote:`? `carril doctor` looks into it"
    )]
    Unreachable {
        /// Where.
        endpoint: String,
        /// How long.
        waited_s: f64,
    },
    /// It needs a key.
    #[error(
        "{what} needs a key for robot `{robot}`: on the car `carril grant --control NAME`, then here `--key FILE` with the file that it wrote"
    )]
    NoKey {
        /// What was to be done.
        what: &'static str,
        /// The robot.
        robot: String,
    },
    /// The key is no good, or no more.
    #[error("{what} is refused by robot `{robot}`: {why}")]
    Refused {
        /// What was to be done.
        what: &'static str,
        /// The robot.
        robot: String,
        /// Why.
        why: String,
    },
    /// The link failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// An answer makes no sense.
    #[error("the answer on `{key}` makes no sense: {reason}")]
    Answer {
        /// The key.
        key: String,
        /// Why not.
        reason: String,
    },
}

/// A way into a running graph.
pub struct Client {
    run: RunFile,
    way: Way,
    transport: ZenohTransport,
    clock: Arc<dyn Clock>,
    status: Arc<(Mutex<Option<Status>>, Condvar)>,
    /// Where it listens.
    socket: Option<PathBuf>,
    _status_guard: Guard,
}

/// How it reaches the run.
enum Way {
    /// On the same machine.
    Near,
    /// By way of a gateway.
    Far(far::FarWay),
}

/// The folder of a run, if that can still be told and is there.
fn folder_of(run: &RunFile) -> Option<PathBuf> {
    let (_, socket) = run.endpoint.split_once('/')?;
    Path::new(socket).parent().filter(|dir| dir.is_dir()).map(Path::to_owned)
}

impl Drop for Client {
    fn drop(&mut self) {
        if let Some(socket) = &self.socket {
            // A killed tool leaves its socket; the supervisor knows by the process id in its name that it is dead.
            let _ = std::fs::remove_file(socket);
        }
    }
}

impl Client {
    /// Finds the run of `robot`, or the only one, and connects to it.
    pub fn connect(robot: Option<&str>) -> Result<Self, ClientError> {
        Self::open(find_run_here(robot)?)
    }

    /// The same for the gateway of a car, and for the link of another machine: they stand in for the nodes that run elsewhere, and so tools
    /// that read those connect to them, be they there already or not.
    pub fn connect_to_stand_in(robot: Option<&str>) -> Result<Self, ClientError> {
        let run = find_run_here(robot)?;
        let socket = folder_of(&run).map(|dir| dir.join(STAND_IN_SOCKET));
        let socket = socket.filter(|_| run.nodes.iter().any(|node| node.machine != run.machine));
        Self::open_at(run, socket)
    }

    /// Connects to a run.
    pub fn open(run: RunFile) -> Result<Self, ClientError> {
        Self::open_at(run, None)
    }

    /// `stand_in`: where it listens, when it stands in for nodes elsewhere.
    fn open_at(run: RunFile, stand_in: Option<PathBuf>) -> Result<Self, ClientError> {
        let clock: Arc<dyn Clock> = Arc::new(LiveClock::with_anchor(monotonic_now(), run.clock_zero));
        let alive = is_alive(run.pid);
        // To all, also those that are down: they may come back while the tool looks on.
        let mut connect: Vec<String> = run.processes.iter().map(|process| process.endpoint.clone()).collect();
        if alive {
            connect.push(run.endpoint.clone());
        }
        let starting = clock.now().since(run.started).to_duration() < START_PATIENCE;
        let up = |process: &&ProcessEntry| process.pid.is_some() || (alive && starting);
        let mut expected = run.processes.iter().filter(up).count() + usize::from(alive);
        let dir = folder_of(&run);
        let elsewhere = run.nodes.iter().any(|node| node.machine != run.machine);
        if let Some(other) =
            dir.as_ref().filter(|_| elsewhere && stand_in.is_none()).map(|dir| dir.join(STAND_IN_SOCKET))
        {
            connect.push(endpoint(&other));
            expected += usize::from(other.exists());
        }
        let epoch = clock.now().as_nanos() as u64;
        // Processes that start later come here: see `RunDir::tool_sockets`.
        let socket = stand_in.or_else(|| dir.map(|dir| tool_socket(&dir, std::process::id())));
        let listen = socket.as_ref().map(|socket| endpoint(socket));
        let transport = ZenohTransport::open(ZenohOptions { listen, connect, epoch, ..ZenohOptions::default() })?;
        transport.wait_for_links(expected, LINK_PATIENCE);
        Self::on(run, Way::Near, transport, clock, socket)
    }

    fn on(
        run: RunFile,
        way: Way,
        transport: ZenohTransport,
        clock: Arc<dyn Clock>,
        socket: Option<PathBuf>,
    ) -> Result<Self, ClientError> {
        let status: Arc<(Mutex<Option<Status>>, Condvar)> = Arc::default();
        let heard = Arc::clone(&status);
        let guard = transport.watch(&status_key(&run.robot), move |_, _, payload| {
            if let Ok(status) = serde_json::from_slice(&payload) {
                *heard.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(status);
                heard.1.notify_all();
            }
        })?;
        Ok(Self { run, way, transport, clock, status, socket, _status_guard: guard })
    }

    /// The run file as it was when the client connected; [`Client::run`] asks anew.
    pub fn file(&self) -> &RunFile {
        &self.run
    }

    /// The car's clock.
    pub fn clock(&self) -> &Arc<dyn Clock> {
        &self.clock
    }

    /// Whether the supervisor is alive; far away: whether the car was linked a moment ago.
    pub fn supervisor_is_alive(&self) -> bool {
        match &self.way {
            Way::Near => is_alive(self.run.pid),
            Way::Far(way) => way.is_alive(&self.transport),
        }
    }

    /// Whether it is linked to anything of the run. A process that was killed may count as alive until its parent looks at it.
    pub fn is_linked(&self) -> bool {
        self.transport.links() > 0
    }

    /// Whether it reaches the car over the network.
    pub fn is_far(&self) -> bool {
        matches!(self.way, Way::Far(_))
    }

    /// What this client may do: on the same machine all.
    pub fn access(&self) -> Access {
        match &self.way {
            Way::Near => Access {
                level: AccessLevel::Control,
                name: None,
                why: "on the car itself, everything is allowed".into(),
            },
            Way::Far(way) => way.access(self),
        }
    }

    /// The key that a request has to be asked on, which is another one far away.
    fn request_key(&self, what: &'static str, near: String, path: &str) -> Result<String, ClientError> {
        match &self.way {
            Way::Near => Ok(near),
            Way::Far(way) => way.request_key(self, what, path),
        }
    }

    /// The last lines of the run's log.
    pub fn log(&self) -> Result<Vec<LogLine>, ClientError> {
        self.ask_until_heard(&log_key(&self.run.robot))
    }

    /// Hears every new line of the run's log.
    pub fn watch_log(&self, hear: impl Fn(LogLine) + Send + Sync + 'static) -> Result<Guard, ClientError> {
        Ok(self.transport.watch(&log_key(&self.run.robot), move |_, _, payload| {
            if let Ok(line) = serde_json::from_slice(&payload) {
                hear(line);
            }
        })?)
    }

    /// Puts a line into the run's log.
    pub fn say(&self, level: LogLevel, process: &str, text: String) -> Result<(), ClientError> {
        let line = LogLine { stamp: self.clock.now(), level, process: process.to_owned(), text };
        let bytes = serde_json::to_vec(&line).unwrap_or_default();
        Ok(self.transport.put(&said_key(&self.run.robot), None, bytes)?)
    }

    /// Hears every word that is said to the nodes.
    pub fn watch_words(&self, hear: impl Fn(Control) + Send + Sync + 'static) -> Result<Guard, ClientError> {
        Ok(self.transport.watch(&word_key(&self.run.robot), move |_, _, payload| {
            if let Ok(word) = serde_json::from_slice(&payload) {
                hear(word);
            }
        })?)
    }

    /// Hears every receipt of a change.
    pub fn watch_receipts(&self, hear: impl Fn(Receipt) + Send + Sync + 'static) -> Result<Guard, ClientError> {
        Ok(self.transport.watch(&receipts_key(&self.run.robot), move |_, _, payload| {
            if let Ok(receipt) = serde_json::from_slice(&payload) {
                hear(receipt);
            }
        })?)
    }

    /// Asks the supervisor for the run file as it is now.
    pub fn run(&self) -> Result<RunFile, ClientError> {
        self.ask_until_heard(&run_key(&self.run.robot))
    }

    /// Asks the supervisor for the graph as it runs now.
    pub fn graph(&self) -> Result<LiveGraph, ClientError> {
        self.ask_until_heard(&graph_key(&self.run.robot))
    }

    /// Asks the supervisor to change the graph, and waits for the receipt.
    pub fn change(&self, change: &Change) -> Result<Receipt, ClientError> {
        let key = self.request_key("a change of the graph", change_key(&self.run.robot), "change")?;
        let answer = |reason: serde_json::Error| ClientError::Answer { key: key.clone(), reason: reason.to_string() };
        let question = serde_json::to_vec(change).map_err(answer)?;
        let terms = match change {
            Change::Set { .. } => None,
            Change::Swap(request) => Some(&request.terms),
            Change::Rollback { terms, .. } | Change::Restart { terms, .. } => Some(terms),
        };
        let asked_for = terms.map_or(0, |terms| terms.shadow_ms + terms.probation_ms);
        // A change must not be asked for twice. The supervisor tells of this key before that of the graph: once the graph is answered,
        // the change will be heard.
        self.graph()?;
        self.ask(&key, question, CHANGE_PATIENCE + Duration::from_millis(asked_for))
    }

    /// Asks the supervisor to make the running graph another one, or what would be done, and waits for the receipt.
    pub fn apply(&self, request: &ApplyRequest) -> Result<ApplyReceipt, ClientError> {
        let key = self.request_key("a change of the graph", apply_key(&self.run.robot), "apply")?;
        let answer = |reason: serde_json::Error| ClientError::Answer { key: key.clone(), reason: reason.to_string() };
        let question = serde_json::to_vec(request).map_err(answer)?;
        // Each node may be done, and undone.
        let steps = 2 * (1 + request.agreed.as_ref().map_or(0, Vec::len) as u32);
        let each = Duration::from_millis(request.terms.shadow_ms + request.terms.probation_ms);
        // As for `change`.
        self.graph()?;
        self.ask(&key, question, (CHANGE_PATIENCE + each) * steps)
    }

    /// For questions that change nothing: a question that comes before links and keys are known to both sides is answered by nobody.
    fn ask_until_heard<T: DeserializeOwned>(&self, key: &str) -> Result<T, ClientError> {
        let deadline = Instant::now() + ANSWER_PATIENCE;
        loop {
            match self.ask(key, Vec::new(), LINK_PATIENCE) {
                Err(ClientError::Transport(TransportError::NoAnswer { .. }))
                    if self.supervisor_is_alive() && Instant::now() < deadline =>
                {
                    std::thread::sleep(ASK_AGAIN);
                }
                answered => return answered,
            }
        }
    }

    fn ask<T: DeserializeOwned>(&self, key: &str, question: Vec<u8>, patience: Duration) -> Result<T, ClientError> {
        if let Way::Far(way) = &self.way {
            way.asked.is_asked();
        }
        let answers = self.transport.ask(key, question, patience)?;
        let answer = answers
            .into_iter()
            .next()
            .ok_or_else(|| TransportError::NoAnswer { key: key.to_owned(), timeout_ms: patience.as_millis() })?;
        let wrong = |reason: String| ClientError::Answer { key: key.to_owned(), reason };
        serde_json::from_slice(&answer.map_err(wrong)?).map_err(|error| wrong(error.to_string()))
    }

    /// The last status that was heard, if any yet.
    pub fn status(&self) -> Option<Status> {
        self.status.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits for the next status. `None`: none came in time.
    pub fn next_status(&self, timeout: Duration) -> Option<Status> {
        let mut last = self.status.0.lock().unwrap_or_else(PoisonError::into_inner);
        *last = None;
        let waited = self.status.1.wait_timeout_while(last, timeout, |status| status.is_none());
        waited.unwrap_or_else(PoisonError::into_inner).0.clone()
    }

    /// Hears a port: header, payload, and when it arrived on the car's clock. Samples without a readable header are left out.
    pub fn subscribe(
        &self,
        node: &str,
        port: &str,
        hear: impl Fn(Header, Payload, Stamp) + Send + Sync + 'static,
    ) -> Result<Guard, ClientError> {
        Ok(tap::subscribe(&self.transport, &self.clock, &self.run.robot, (node, port), hear)?)
    }

    /// Tells all nodes of all processes, also without a supervisor. An answer, or an error text, per process.
    pub fn control(&self, control: Control) -> Result<Vec<Result<ControlReply, String>>, ClientError> {
        match &self.way {
            Way::Near => Ok(tap::control(&self.transport, &self.run.robot, control)?),
            Way::Far(way) => way.control(self, control),
        }
    }

    /// Hears every status of the run.
    pub fn watch_status(&self, hear: impl Fn(Status) + Send + Sync + 'static) -> Result<Guard, ClientError> {
        Ok(self.transport.watch(&status_key(&self.run.robot), move |_, _, payload| {
            if let Ok(status) = serde_json::from_slice(&payload) {
                hear(status);
            }
        })?)
    }

    /// Hears the receipt of every change of the whole graph.
    pub fn watch_applied(&self, hear: impl Fn(ApplyReceipt) + Send + Sync + 'static) -> Result<Guard, ClientError> {
        Ok(self.transport.watch(&applied_key(&self.run.robot), move |_, _, payload| {
            if let Ok(receipt) = serde_json::from_slice(&payload) {
                hear(receipt);
            }
        })?)
    }

    /// Tells the supervisor who is connected from other machines; for the gateway, again and again.
    pub fn tell_who(&self, who: &Who) -> Result<(), ClientError> {
        let bytes = serde_json::to_vec(who).unwrap_or_default();
        Ok(self.transport.put(&gateway_key(&self.run.robot), None, bytes)?)
    }

    /// Who is connected to the gateway of the car, and which keys it has granted. `None`: no gateway runs.
    pub fn who(&self) -> Result<Option<Who>, ClientError> {
        let key = self.request_key("seeing who is connected", who_key(&self.run.robot), "who")?;
        self.ask_until_heard(&key)
    }

    /// Puts a sample of somebody else's on an external input, as it is.
    pub fn pass_on(&self, node: &str, port: &str, header: &Header, payload: Payload) -> Result<(), ClientError> {
        let bytes = header.encode().map_err(TransportError::from)?;
        Ok(self.transport.put_raw(&Key::new(&self.run.robot, node, port), &bytes, payload)?)
    }

    /// Opens an external input of a node, to feed it.
    pub fn publisher(&self, node: &str, port: &str, message_type: MessageType) -> ExternalPublisher {
        ExternalPublisher {
            key: Key::new(&self.run.robot, node, port),
            request: match &self.way {
                Way::Near => None,
                Way::Far(_) => Some(self.request_key("publishing", String::new(), &format!("pub/{node}/{port}"))),
            },
            asked: match &self.way {
                Way::Near => None,
                Way::Far(way) => Some(way.asked.clone()),
            },
            transport: self.transport.clone(),
            clock: Arc::clone(&self.clock),
            message_type,
            epoch: self.clock.now().as_nanos() as u64,
            next_seq: 0,
        }
    }
}

/// Feeds an external input.
pub struct ExternalPublisher {
    key: Key,
    /// Far away: the gateway is asked on this key to put it.
    request: Option<Result<String, ClientError>>,
    asked: Option<far::Followers>,
    transport: ZenohTransport,
    clock: Arc<dyn Clock>,
    message_type: MessageType,
    epoch: u64,
    next_seq: u64,
}

impl ExternalPublisher {
    /// Puts a message.
    pub fn put(&mut self, message: Encoded) -> Result<(), ClientError> {
        let header = Header {
            epoch: self.epoch,
            seq: self.next_seq,
            stamp: self.clock.now(),
            origins: Origins::none(),
            message_type: self.message_type.clone(),
            meta: message.meta,
        };
        self.next_seq += 1;
        let header = header.encode().map_err(TransportError::from)?;
        match &mut self.request {
            None => Ok(self.transport.put_raw(&self.key, &header, message.payload)?),
            Some(Ok(key)) => {
                self.asked.iter().for_each(far::Followers::is_asked);
                far::put(&self.transport, key, &header, &message.payload)
            }
            Some(refused) => {
                // Said once; whoever puts again after that is told that there was a refusal.
                let lost = || Err(ClientError::Answer { key: self.key.to_string(), reason: "refused before".into() });
                Err(std::mem::replace(refused, lost()).expect_err("no key was given"))
            }
        }
    }
}

/// Below here each service of `carril service install` has the folder in which its run keeps its folder.
pub const SERVICES_RUN_DIR: &str = "/run/carril";

/// The run of `robot` on this machine, be it started by hand or as a service; without a name, the only one.
pub fn find_run_here(robot: Option<&str>) -> Result<RunFile, ClientError> {
    let own = runs_dir(nix::unistd::getuid().as_raw());
    if std::env::var_os(RUN_DIR_VARIABLE).is_some() {
        return find_run(&own, robot);
    }
    let services = std::fs::read_dir(SERVICES_RUN_DIR).into_iter().flatten().flatten().map(|entry| entry.path());
    find_run_in(&[own].into_iter().chain(services).collect::<Vec<_>>(), robot)
}

/// The run of `robot` below `dir`; without a name, the only one.
pub fn find_run(dir: &Path, robot: Option<&str>) -> Result<RunFile, ClientError> {
    find_run_in(&[dir.to_owned()], robot)
}

fn find_run_in(dirs: &[PathBuf], robot: Option<&str>) -> Result<RunFile, ClientError> {
    let folders = dirs.iter().flat_map(|dir| std::fs::read_dir(dir).into_iter().flatten().flatten());
    let mut runs: Vec<RunFile> = folders.filter_map(|folder| read_run_file(&folder.path())).collect();
    runs.sort_by(|a, b| a.robot.cmp(&b.robot));
    // A run without its supervisor still counts while one of its processes lives.
    let lives = |run: &RunFile| {
        let mut pids = run.processes.iter().filter_map(|process| process.pid);
        is_alive(run.pid) || pids.any(is_alive)
    };
    let (mut living, dead): (Vec<RunFile>, Vec<RunFile>) = runs.into_iter().partition(lives);
    let robots = living.iter().map(|run| run.robot.as_str()).collect::<Vec<_>>().join(", ");
    let wanted = |run: &RunFile| robot.is_none_or(|robot| run.robot == robot);
    if let Some(at) = living.iter().position(wanted) {
        if robot.is_none() && living.len() > 1 {
            return Err(ClientError::SeveralRuns { robots });
        }
        return Ok(living.swap_remove(at));
    }
    if let Some(run) = dead.into_iter().find(wanted) {
        return Err(ClientError::Stale { robot: run.robot, pid: run.pid, graph: run.graph.display().to_string() });
    }
    match robot {
        Some(robot) if !living.is_empty() => Err(ClientError::OtherRuns { robot: robot.to_owned(), robots }),
        _ => Err(ClientError::NoRun { dir: dirs.first().map(|dir| dir.display().to_string()).unwrap_or_default() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn put_run(dir: &Path, robot: &str, pid: u32) {
        let run = RunFile {
            robot: robot.into(),
            pid,
            graph: "dataflow.yaml".into(),
            started: Stamp::ZERO,
            clock_zero: Stamp::ZERO,
            endpoint: String::new(),
            machine: None,
            processes: Vec::new(),
            nodes: Vec::new(),
        };
        std::fs::create_dir(dir.join(robot)).expect("the folder is writable");
        let text = serde_json::to_vec(&run).expect("a run file is JSON");
        std::fs::write(dir.join(robot).join(crate::control_plane::RUN_FILE), text).expect("the folder is writable");
    }

    fn error(dir: &Path, robot: Option<&str>) -> String {
        find_run(dir, robot).expect_err("no such run").to_string()
    }

    #[test]
    fn finds_the_only_run_or_the_named_one_and_says_what_else_there_is() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        assert!(error(dir.path(), None).contains("carril run"), "nothing runs: it says how to start");
        put_run(dir.path(), "dead", i32::MAX as u32);
        assert!(error(dir.path(), None).contains("`dead` has died"), "a stale run is named");
        put_run(dir.path(), "car1", std::process::id());
        assert_eq!(find_run(dir.path(), None).expect("one lives").robot, "car1", "the only living one");
        put_run(dir.path(), "car2", std::process::id());
        assert!(error(dir.path(), None).contains("car1, car2"), "several are listed");
        assert_eq!(find_run(dir.path(), Some("car2")).expect("it lives").robot, "car2", "by name");
        assert!(error(dir.path(), Some("car3")).contains("`car3`"), "another is refused by name");
    }
}
