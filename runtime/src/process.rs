//! The main function of a process of a running graph: the supervisor starts `<program> process --run-dir DIR --name NAME`.
//!
//! A program with operators of its own (`exec:` in the graph file) calls [`main_from_arguments`] with them.

mod seat_host;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use carril_messages::{Control, Header, Health, Message, Meta, Origins};
use nix::sys::signal::{SigSet, Signal};
use thiserror::Error;

use crate::clock::{Clock, LiveClock};
use crate::control_plane::{FaultReport, RUN_FILE, RunFile, control_key, fault_key, health_key, live_key};
use crate::describe;
use crate::executor::live::{Environment, Executor, NodeEvent, StartError};
use crate::realtime;
use crate::registry::Registry;
use crate::seats::{SeatName, TrialReport, seat_key, trial_key};
use crate::supervisor::plan::{Plan, PlanError};
use crate::transport::zenoh::{Question, ZenohOptions, ZenohTransport};
use crate::transport::{Guard, TransportError};
use seat_host::SeatHost;

/// Exit code of a process whose nodes could not be built; what they said is in `<name>.error` in the folder of the run.
pub const SETUP_FAILED: u8 = 78;
/// Exit code of a process whose only node panicked.
pub const PANICKED: u8 = 101;
/// A node has this long to hear a word before the sender is told that it did not.
pub const CONTROL_PATIENCE: Duration = Duration::from_secs(1);
/// A node whose step is still running after this is left out of this second's health.
const HEALTH_PATIENCE: Duration = Duration::from_millis(100);
/// Health is put this often.
const HEALTH_PERIOD: Duration = Duration::from_secs(1);

/// Why a process ended early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProcessError {
    /// The plan of the run is unusable.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The nodes could not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The link could not be opened.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The run is not what it should be.
    #[error("{0}")]
    Run(String),
}

/// [`main`] with the arguments that the supervisor gives: `process --run-dir DIR --name NAME`. Answers `--describe`,
/// `--check-config` and `--help` besides ([`describe`]).
pub fn main_from_arguments(registry: &Registry) -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |name: &str| arguments.iter().position(|a| a == name).and_then(|at| arguments.get(at + 1));
    let is_process = arguments.first().is_some_and(|word| word == "process");
    if let (true, Some(run_dir), Some(name)) = (is_process, value("--run-dir"), value("--name")) {
        return main(registry, Path::new(run_dir), name);
    }
    if let Some(code) = describe::answer(registry, &arguments) {
        return code;
    }
    eprintln!("error: this program is a node of a graph: name it in `exec:` and use `carril run`; `--help` says more");
    ExitCode::from(2)
}

/// Runs the nodes of process `name` until told to end. Call it first thing in `main`: signals are sorted out here, before there
/// are other threads.
pub fn main(registry: &Registry, run_dir: &Path, name: &str) -> ExitCode {
    let mut signals = SigSet::empty();
    signals.add(Signal::SIGTERM);
    signals.add(Signal::SIGINT);
    // Blocked here, and so in every thread: SIGTERM is waited for by one thread, SIGINT is the supervisor's affair.
    if let Err(error) = signals.thread_block() {
        eprintln!("error: process `{name}`: signals cannot be blocked: {error}");
        return ExitCode::FAILURE;
    }
    crate::log::start(name);
    match run(registry, run_dir, name) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error}");
            // The supervisor shows it; without the file it still has the line above.
            let _ = std::fs::write(run_dir.join(format!("{name}.error")), error.to_string());
            ExitCode::from(SETUP_FAILED)
        }
    }
}

/// Something that the main thread acts on.
enum Event {
    Terminate,
    Asked(Question),
    Node(NodeEvent),
}

fn run(registry: &Registry, run_dir: &Path, name: &str) -> Result<ExitCode, ProcessError> {
    let run = read_run_file(run_dir)?;
    die_with(run.pid)?;
    let plan = Plan::read(run_dir)?;
    let seed = plan.seed;
    let graph = plan.graph(name, registry)?;
    if graph.nodes.iter().any(|node| node.process == name && node.lock_memory)
        && let Some(warning) = realtime::lock_memory(name)
    {
        tracing::warn!("{warning}");
    }
    let clock: Arc<dyn Clock> = Arc::new(LiveClock::with_anchor(monotonic_now(), run.clock_zero));
    let transport = ZenohTransport::open(options(&run, name, clock.as_ref()))?;
    let environment = Environment {
        transport: Arc::new(transport.clone()),
        clock: Arc::clone(&clock),
        run_dir: Some(run_dir.to_owned()),
        seed,
    };
    let (sender, events) = channel();
    let (executor, node_events) = Executor::start(&graph, name, &environment)?;
    forward(node_events, sender.clone());
    let asked = sender.clone();
    let control = transport.answer(&control_key(&run.robot, name), move |question| {
        let _ = asked.send(Event::Asked(question));
    })?;
    wait_for_sigterm(sender);
    let executor = Arc::new(executor);
    let host = SeatHost::new(name, &run.robot, Arc::clone(&executor), &transport, &clock, registry);
    let process = Process { name, robot: run.robot.clone(), executor, transport: transport.clone(), clock };
    let seats = transport.answer(&seat_key(&run.robot, name), move |question| host.hear(question))?;
    let token = transport.announce(&live_key(&run.robot, name))?;
    let code = process.serve(&events);
    process.end(vec![control, seats, token]);
    Ok(code)
}

fn read_run_file(run_dir: &Path) -> Result<RunFile, ProcessError> {
    let path: PathBuf = run_dir.join(RUN_FILE);
    let text = std::fs::read(&path).map_err(|e| ProcessError::Run(format!("`{}`: {e}", path.display())))?;
    serde_json::from_slice(&text).map_err(|e| ProcessError::Run(format!("`{}` is no run file: {e}", path.display())))
}

/// No process outlives its supervisor, which started it, however that ends: a car without one stops by itself, because the lease runs out.
pub fn die_with(supervisor: u32) -> Result<(), ProcessError> {
    nix::sys::prctl::set_pdeathsig(Signal::SIGKILL).map_err(|error| {
        ProcessError::Run(format!("the kernel refuses a signal for the supervisor's death: {error}"))
    })?;
    // It may have died before that.
    let parent = nix::unistd::getppid().as_raw();
    if u32::try_from(parent) == Ok(supervisor) {
        return Ok(());
    }
    Err(ProcessError::Run(format!("process {parent} started this one, but the run belongs to process {supervisor}")))
}

/// What CLOCK_MONOTONIC reads.
pub(crate) fn monotonic_now() -> Duration {
    nix::time::clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC).map_or(Duration::ZERO, Duration::from)
}

fn options(run: &RunFile, name: &str, clock: &dyn Clock) -> ZenohOptions {
    let endpoint = |process: &str| run.processes.iter().find(|p| p.name == process).map(|p| p.endpoint.clone());
    let own = run.processes.iter().find(|process| process.name == name);
    let mut connect = own.map(|process| process.connect.clone()).unwrap_or_default();
    connect.push(run.endpoint.clone());
    let epoch = clock.now().as_nanos() as u64;
    ZenohOptions { listen: endpoint(name), connect, epoch, ..ZenohOptions::default() }
}

fn forward(nodes: Receiver<NodeEvent>, events: Sender<Event>) {
    std::thread::spawn(move || {
        for event in nodes {
            if events.send(Event::Node(event)).is_err() {
                return;
            }
        }
    });
}

fn wait_for_sigterm(events: Sender<Event>) {
    std::thread::spawn(move || {
        let mut signals = SigSet::empty();
        signals.add(Signal::SIGTERM);
        while !matches!(signals.wait(), Ok(Signal::SIGTERM)) {}
        // When nobody listens any more, the process is ending already.
        let _ = events.send(Event::Terminate);
    });
}

struct Process<'a> {
    name: &'a str,
    robot: String,
    executor: Arc<Executor>,
    transport: ZenohTransport,
    clock: Arc<dyn Clock>,
}

impl Process<'_> {
    /// Acts on events until one of them ends the process.
    fn serve(&self, events: &Receiver<Event>) -> ExitCode {
        let mut next_health = Instant::now();
        loop {
            match events.recv_timeout(next_health.saturating_duration_since(Instant::now())) {
                Ok(Event::Terminate) | Err(RecvTimeoutError::Disconnected) => return ExitCode::SUCCESS,
                Ok(Event::Asked(question)) => self.answer(question),
                Ok(Event::Node(NodeEvent::Fault(report))) => self.report(&report),
                Ok(Event::Node(NodeEvent::Panicked { node, message, alone: true })) => {
                    tracing::error!("node `{node}` panicked: {message}");
                    return ExitCode::from(PANICKED);
                }
                Ok(Event::Node(NodeEvent::Panicked { .. })) => {}
                Ok(Event::Node(NodeEvent::Trial(news))) => {
                    let seat = SeatName { node: news.node, number: news.seat };
                    self.tell_trial(&TrialReport { seat, result: news.result });
                }
                Err(RecvTimeoutError::Timeout) => {
                    next_health += HEALTH_PERIOD;
                    let pool_fallbacks = self.transport.pool_fallbacks();
                    for health in self.executor.health(HEALTH_PATIENCE) {
                        self.put_health(&Health { pool_fallbacks, ..health });
                    }
                }
            }
        }
    }

    fn answer(&self, question: Question) {
        let answer = match serde_json::from_slice::<Control>(&question.bytes()) {
            Ok(control) => self.executor.control(control, CONTROL_PATIENCE).and_then(|reply| {
                serde_json::to_vec(&reply).map_err(|error| format!("process `{}`: {error}", self.name))
            }),
            Err(error) => Err(format!(
                "process `{}`: {error}; allowed are \"start\", \"stop\", \"e_stop\" and \"reset\"",
                self.name
            )),
        };
        question.answer(answer);
    }

    /// Stops all nodes of this process at once, and tells the supervisor, which stops the others.
    fn report(&self, report: &FaultReport) {
        let told = serde_json::to_vec(report).map(|bytes| self.transport.put(&fault_key(&self.robot), None, bytes));
        match told {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::error!("the fault of node `{}` cannot be reported: {error}", report.node),
            Err(error) => tracing::error!("the fault of node `{}` cannot be reported: {error}", report.node),
        }
        if let Err(stuck) = self.executor.control(Control::EStop, CONTROL_PATIENCE) {
            tracing::error!("{stuck}");
        }
    }

    fn tell_trial(&self, report: &TrialReport) {
        let key = trial_key(&self.robot, &report.seat.node);
        let told = serde_json::to_vec(report).map(|bytes| self.transport.put(&key, None, bytes));
        if !matches!(told, Ok(Ok(()))) {
            tracing::error!("the trial of node `{}` cannot be reported", report.seat.node);
        }
    }

    fn put_health(&self, health: &Health) {
        let (stamp, origins, meta) = (self.clock.now(), Origins::none(), Meta::new());
        let header = Header { epoch: 0, seq: 0, stamp, origins, message_type: Health::TYPE, meta };
        let put = || {
            let payload = Message::encode(health)?.payload.to_vec();
            self.transport.put(&health_key(&self.robot, &health.node), Some(header.encode()?), payload)
        };
        if let Err(error) = put() {
            tracing::debug!("the health of node `{}` cannot be put: {error}", health.node);
        }
    }

    fn end(self, guards: Vec<Guard>) {
        drop(guards);
        self.executor.stop();
        self.transport.close();
    }
}
