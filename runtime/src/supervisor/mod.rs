//! Starts the processes of a graph, watches them, starts again what dies, and ends them in order. It is not on the data path:
//! the processes talk to each other without it.

mod apply;
mod candidate;
mod changes;
mod children;
mod fit;
pub mod links;
mod live;
mod logbook;
mod monitor;
mod observer;
mod outside;
pub mod plan;
mod restart;
pub mod run_dir;
mod status;
mod swap;

use std::io;
use std::path::PathBuf;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use carril_messages::{Control, Header, Payload, Stamp};
use thiserror::Error;
use tokio::sync::{broadcast, watch};

use crate::clock::{Clock, LiveClock};
use crate::control_plane::{
    ApplyReceipt, FaultReport, MachineStatus, NodeEntry, ProcessEntry, Receipt, RunFile, Status, control_key,
    fault_key, health_key, live_key, run_key, runs_dir,
};
use crate::graph::Graph;
use crate::process::monotonic_now;
use crate::registry::Registry;
use crate::tap;
use crate::transport::zenoh::{ZenohOptions, ZenohTransport, clean_shared_memory, endpoint};
use crate::transport::{Guard, TransportError};
use changes::Changes;
use live::SharedLive;
use monitor::{Links, Message, Monitor};
use plan::Plan;
use run_dir::RunDir;

/// Name under which the supervisor answers control words; no process can have it.
pub const SUPERVISOR: &str = "_supervisor";
/// Lines and events that a slow listener may fall behind; then the oldest go.
const EVENTS: usize = 4096;

/// How to run a graph.
#[derive(Clone, Debug)]
pub struct Options {
    /// Seed of the run.
    pub seed: u64,
    /// The program that serves the processes, with its first arguments. Default: this program, `process`.
    pub program: Option<(PathBuf, Vec<String>)>,
    /// Folder below which the run keeps its folder. Default: [`runs_dir`].
    pub runs_dir: Option<PathBuf>,
    /// The machine that this is: only its nodes are started. `None`: the car.
    pub machine: Option<String>,
}

impl Default for Options {
    fn default() -> Self {
        Self { seed: 1, program: None, runs_dir: None, machine: None }
    }
}

/// Why a graph does not run, or ended early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// The robot runs already.
    #[error(
        "robot `{robot}` runs already, in process {pid}; end that run first (Ctrl-C in its terminal, or `kill {pid}`), or \
         give this graph another `robot`"
    )]
    AlreadyRunning {
        /// The robot.
        robot: String,
        /// Process id of its supervisor.
        pid: u32,
    },
    /// The folder of the run cannot be used.
    #[error("`{}`: {reason}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// Its path leaves no room for sockets.
    #[error(
        "`{}` is too long for sockets, whose paths have at most {limit} bytes; set CARRIL_RUN_DIR to a shorter folder",
        path.display()
    )]
    PathTooLong {
        /// The folder.
        path: PathBuf,
        /// The limit.
        limit: usize,
    },
    /// A program cannot be started.
    #[error("process `{process}`: `{}` cannot be started: {reason}", program.display())]
    Spawn {
        /// The process.
        process: String,
        /// The program.
        program: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// The nodes of a process could not be built.
    #[error("{reason}")]
    Setup {
        /// The process.
        process: String,
        /// What it said.
        reason: String,
    },
    /// A process died before it was ready, too often.
    #[error("no process is left: {last}")]
    NothingLeft {
        /// What happened to the last.
        last: String,
    },
    /// A binary of the user's own shares its process.
    #[error("node `{node}` is a binary of its own (`exec:`); it cannot share process `{process}` with other nodes")]
    SharedExec {
        /// The node.
        node: String,
        /// The process.
        process: String,
    },
    /// The link cannot be opened.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// What happens during a run.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Event {
    /// A process is up, its nodes are built.
    Ready {
        /// The process.
        process: String,
    },
    /// All processes are up, so long after the start.
    AllReady(Duration),
    /// A process wrote a line.
    Line {
        /// The process.
        process: String,
        /// The line.
        text: String,
    },
    /// A process ended without being told to.
    Died {
        /// The process.
        process: String,
        /// How: `killed by SIGKILL`.
        how: String,
        /// It is started again after this pause; `None`: its policy leaves it down.
        again_in: Option<Duration>,
    },
    /// A process died too often and stays down.
    GaveUp {
        /// The process.
        process: String,
        /// Its nodes.
        nodes: Vec<String>,
        /// How it died, and the limit.
        why: String,
    },
    /// A node stopped the car.
    Fault(FaultReport),
    /// A machine that runs nodes of the graph has come, or gone.
    Machine(MachineStatus),
    /// The running graph was changed, or not: see the receipt.
    Changed(Box<Receipt>),
    /// A whole graph was applied, or not: see the receipt. Its steps came as [`Event::Changed`].
    Applied(Box<ApplyReceipt>),
    /// The run is ending: first the car is stopped.
    Stopping,
}

/// Starts graphs.
pub struct Supervisor;

impl Supervisor {
    /// Starts the processes of a graph. Returns as soon as they are started, not when they are ready.
    /// `registry`: the operators that nodes may be replaced by.
    pub fn start(graph: &Graph, registry: &Registry, options: &Options) -> Result<Running, RunError> {
        refuse_shared_exec(graph)?;
        clean_shared_memory();
        let runs = options.runs_dir.clone().unwrap_or_else(|| runs_dir(nix::unistd::getuid().as_raw()));
        let dir = RunDir::make(&runs, &graph.robot)?;
        let plan = Plan::new(graph, options.seed).on(options.machine.clone());
        dir.write_plan(&plan)?;
        dir.write_graph(&graph.text)?;
        let live = SharedLive::new(plan, registry);
        let run = run_file(graph, options.machine.as_deref(), live.lock().node_entries(), &dir)?;
        dir.write_run_file(&run)?;
        let clock: Arc<dyn Clock> = Arc::new(LiveClock::with_anchor(monotonic_now(), run.clock_zero));
        let transport =
            ZenohTransport::open(ZenohOptions { listen: Some(run.endpoint.clone()), ..Default::default() })?;
        let (sender, receiver) = std::sync::mpsc::channel();
        let run = Arc::new(Mutex::new(run));
        let changes = Changes::new(&run, live.clone(), &transport, &clock, &sender, dir.path());
        let mut guards = listen(&transport, &run, &sender)?;
        guards.extend(changes.listen()?);
        let (status, status_receiver) = watch::channel(Status::default());
        let (events, first_events) = broadcast::channel(EVENTS);
        guards.extend(logbook::keep(&transport, &graph.robot, Arc::clone(&clock), events.subscribe())?);
        guards.extend(outside::listen(&transport, &graph.robot, &sender)?);
        let own_clock = Arc::clone(&clock);
        let links = Links { transport: transport.clone(), live, clock: own_clock, sender: sender.clone(), guards };
        let monitor = Monitor::new(graph, options, dir, Arc::clone(&run), links);
        let outlets = monitor::Outlets { status, events: events.clone() };
        let thread = std::thread::Builder::new().name("supervisor".into());
        // The children die with the thread that starts them (PR_SET_PDEATHSIG), so that one starts them all.
        let thread = thread.spawn(move || monitor.run(&receiver, &outlets));
        let thread = thread.map_err(|reason| RunError::Spawn {
            process: SUPERVISOR.into(),
            program: PathBuf::from("supervisor thread"),
            reason,
        })?;
        let first_events = Mutex::new(Some(first_events));
        Ok(Running { run, status: status_receiver, events, first_events, sender, thread, transport, clock })
    }
}

/// A running graph.
pub struct Running {
    run: Arc<Mutex<RunFile>>,
    status: watch::Receiver<Status>,
    events: broadcast::Sender<Event>,
    first_events: Mutex<Option<broadcast::Receiver<Event>>>,
    sender: Sender<Message>,
    thread: JoinHandle<Result<(), RunError>>,
    transport: ZenohTransport,
    clock: Arc<dyn Clock>,
}

impl Running {
    /// The run file as it is now.
    pub fn run_file(&self) -> RunFile {
        self.run.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The status, renewed once a second.
    pub fn status(&self) -> watch::Receiver<Status> {
        self.status.clone()
    }

    /// What happens. The first receiver has everything since the start, later ones what comes from now on.
    pub fn events(&self) -> broadcast::Receiver<Event> {
        let first = self.first_events.lock().unwrap_or_else(PoisonError::into_inner).take();
        first.unwrap_or_else(|| self.events.subscribe())
    }

    /// Hears a port: header, payload and when it arrived. Damaged samples are left out.
    pub fn subscribe(
        &self,
        node: &str,
        port: &str,
        hear: impl Fn(Header, Payload, Stamp) + Send + Sync + 'static,
    ) -> Result<Guard, TransportError> {
        tap::subscribe(&self.transport, &self.clock, &self.run_file().robot, (node, port), hear)
    }

    /// Tells all nodes; an answer, or an error text, per process.
    pub fn control(
        &self,
        control: Control,
    ) -> Result<Vec<Result<crate::control_plane::ControlReply, String>>, TransportError> {
        tap::control(&self.transport, &self.run_file().robot, control)
    }

    /// Stops the car, then the processes. Returns at once; [`Running::wait`] waits.
    pub fn stop(&self) {
        // When the supervisor has ended already, there is nothing to stop.
        let _ = self.sender.send(Message::Stop);
    }

    /// Ends the processes at once.
    pub fn stop_now(&self) {
        let _ = self.sender.send(Message::StopNow);
    }

    /// A handle that stops the run from another thread.
    pub fn stopper(&self) -> Stopper {
        Stopper(self.sender.clone())
    }

    /// Waits until the run has ended.
    pub fn wait(self) -> Result<(), RunError> {
        match self.thread.join() {
            Ok(result) => result,
            Err(_) => Err(RunError::NothingLeft { last: "the supervisor itself panicked".into() }),
        }
    }

    /// Whether the run has ended.
    pub fn ended(&self) -> bool {
        self.thread.is_finished()
    }
}

/// Stops a run.
#[derive(Clone)]
pub struct Stopper(Sender<Message>);

impl Stopper {
    /// As [`Running::stop`].
    pub fn stop(&self) {
        let _ = self.0.send(Message::Stop);
    }

    /// As [`Running::stop_now`].
    pub fn stop_now(&self) {
        let _ = self.0.send(Message::StopNow);
    }
}

fn refuse_shared_exec(graph: &Graph) -> Result<(), RunError> {
    for node in graph.nodes.iter().filter(|node| node.exec().is_some()) {
        if graph.nodes.iter().any(|other| other.process == node.process && other.name != node.name) {
            return Err(RunError::SharedExec { node: node.name.clone(), process: node.process.clone() });
        }
    }
    Ok(())
}

/// Hears processes, nodes and people.
fn listen(
    transport: &ZenohTransport,
    run: &Arc<Mutex<RunFile>>,
    sender: &Sender<Message>,
) -> Result<Vec<Guard>, TransportError> {
    let robot = run.lock().unwrap_or_else(PoisonError::into_inner).robot.clone();
    let to_monitor = || {
        let sender = sender.clone();
        // The monitor ends last; what comes after that is of no interest.
        move |message| drop(sender.send(message))
    };
    let (announced, health, fault, word) = (to_monitor(), to_monitor(), to_monitor(), to_monitor());
    let run = Arc::clone(run);
    Ok(vec![
        transport.watch_announced(&live_key(&robot, "*"), move |key, here| {
            announced(Message::Announced { process: last_chunk(key), here });
        })?,
        transport.watch(&health_key(&robot, "*"), move |_, header, payload| {
            if let Some(read) = tap::read_health(header, &payload) {
                health(Message::Health(Box::new(read)));
            }
        })?,
        transport.watch(&fault_key(&robot), move |_, _, payload| {
            if let Ok(report) = serde_json::from_slice(&payload) {
                fault(Message::Fault(report));
            }
        })?,
        transport.answer(&control_key(&robot, SUPERVISOR), move |question| {
            if let Ok(control) = serde_json::from_slice(&question.bytes()) {
                word(Message::Control(control));
            }
        })?,
        transport.answer(&run_key(&robot), move |question| {
            let run = run.lock().unwrap_or_else(PoisonError::into_inner).clone();
            question.answer(serde_json::to_vec(&run).map_err(|error| error.to_string()));
        })?,
    ])
}

fn last_chunk(key: &str) -> String {
    key.rsplit('/').next().unwrap_or_default().to_owned()
}

fn run_file(graph: &Graph, machine: Option<&str>, nodes: Vec<NodeEntry>, dir: &RunDir) -> Result<RunFile, RunError> {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    let started = Stamp::ZERO + since_epoch;
    let names = graph.processes_on(machine);
    let entry = |(number, name): (usize, &&str)| {
        let socket = dir.socket(name, number)?;
        Ok(ProcessEntry { name: (*name).to_owned(), endpoint: endpoint(&socket), connect: Vec::new(), pid: None })
    };
    let mut processes: Vec<ProcessEntry> = names.iter().enumerate().map(entry).collect::<Result<_, RunError>>()?;
    let endpoints: Vec<(String, String)> = processes.iter().map(|p| (p.name.clone(), p.endpoint.clone())).collect();
    for process in &mut processes {
        let to = links::to_connect(graph, &process.name);
        process.connect = endpoints.iter().filter(|(name, _)| to.contains(name)).map(|(_, at)| at.clone()).collect();
    }
    Ok(RunFile {
        robot: graph.robot.clone(),
        pid: std::process::id(),
        graph: std::path::absolute(&graph.path).unwrap_or_else(|_| graph.path.clone()),
        started,
        clock_zero: started - monotonic_now(),
        endpoint: endpoint(&dir.socket(SUPERVISOR, names.len())?),
        machine: machine.map(str::to_owned),
        processes,
        nodes,
    })
}
