//! The supervisor's thread: reacts to what happens to processes, nodes and people, one message at a time.

use std::collections::HashMap;
use std::path::PathBuf;
use std::process::ExitStatus;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Control, Health, Message as _, NodeState, VehicleState, WheelTelemetry};
use nix::sys::signal::Signal;
use tokio::sync::{broadcast, watch};

use super::children::{self, Start};
use super::live::SharedLive;
use super::run_dir::RunDir;
use super::status::{Picture, ProcessView};
use super::{Event, Options, RunError, outside};
use crate::backoff::{Restarts, Verdict};
use crate::clock::Clock;
use crate::control_plane::{
    ApplyReceipt, FaultReport, Outcome, ProcessEntry, Receipt, RunFile, Status, status_key, word_key,
};
use crate::graph::{Graph, Restart};
use crate::process::SETUP_FAILED;
use crate::tap;
use crate::transport::Guard;
use crate::transport::zenoh::{ZenohTransport, clean_shared_memory, endpoint};

/// The status is renewed this often.
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// A car that is told to stop has this long to stand still.
const STANDSTILL_PATIENCE: Duration = Duration::from_millis(1500);
/// Slower is standing still, m/s: below one encoder tick in 0.1 s.
const STANDSTILL_M_S: f32 = 0.02;
/// A process that is told to end has this long.
const END_PATIENCE: Duration = Duration::from_secs(2);

/// What the supervisor reacts to.
pub(super) enum Message {
    /// Start a process without nodes: candidates come there. Who asks is told what becomes of it.
    StartHost {
        host: Host,
        news: Sender<HostNews>,
    },
    /// A host is a process like any other from now on.
    Adopt {
        process: String,
    },
    /// End a process for good: in order, or at once.
    EndProcess {
        process: String,
        at_once: bool,
    },
    /// Where is a process? `None`: it is up.
    Look {
        process: String,
        answer: Sender<Option<NodeState>>,
    },
    /// The plan has changed: nodes are other ones, elsewhere, new or gone.
    Replanned,
    /// Two processes were linked.
    Linked,
    /// A whole graph was applied: the run is that of another file.
    Applied {
        path: PathBuf,
        text: String,
        receipt: Box<ApplyReceipt>,
    },
    /// A change of the graph has come to its end.
    Changed(Box<Receipt>),
    Exited {
        process: String,
        generation: u32,
        status: Option<ExitStatus>,
    },
    Announced {
        process: String,
        here: bool,
    },
    Health(Box<Health>),
    /// The machines that have joined.
    Machines(Vec<String>),
    Fault(FaultReport),
    Control(Control),
    Speed(f32),
    Stop,
    StopNow,
}

/// A process to start, at first without nodes.
pub(super) struct Host {
    pub process: String,
    /// A binary of the user's own; `None`: ours.
    pub program: Option<PathBuf>,
    /// Processes that it connects to.
    pub connect: Vec<String>,
}

/// What becomes of a host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum HostNews {
    Ready { pid: u32 },
    Ended { how: String },
}

/// Where the supervisor tells what it knows.
pub(super) struct Outlets {
    pub status: watch::Sender<Status>,
    pub events: broadcast::Sender<Event>,
}

struct Process {
    name: String,
    pid: Option<u32>,
    generation: u32,
    phase: Phase,
    /// The rule of its first node: nodes that share a process share its fate.
    rule: Restart,
    restarts: Restarts,
    was_ready: bool,
    /// A binary of the user's own.
    program: Option<PathBuf>,
    /// It is on trial: somebody is told what becomes of it, and it is not started again.
    host: Option<Sender<HostNews>>,
    /// It was told to end for good; at this time it is killed.
    leaving: Option<Instant>,
}

impl Process {
    /// One that is to be started.
    fn new(name: &str, rule: Restart, program: Option<PathBuf>) -> Self {
        Self {
            name: name.to_owned(),
            pid: None,
            generation: 0,
            phase: Phase::Starting,
            rule,
            restarts: Restarts::new(rule),
            was_ready: false,
            program,
            host: None,
            leaving: None,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Starting,
    Ready(Instant),
    Pausing(Instant),
    Down(NodeState),
}

/// How far the run has come in ending.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    No,
    /// The car is stopping; at this time the processes are told to end, whether it stands or not.
    Braking(Instant),
    /// The processes are told to end; at this time they are killed.
    Ending(Instant),
    Killed,
}

pub(super) struct Monitor {
    robot: String,
    processes: Vec<Process>,
    index: HashMap<String, usize>,
    /// Tells the sockets of processes apart.
    next_number: usize,
    picture: Picture,
    /// When the gateway last said who has joined.
    heard_of_machines: Instant,
    program: PathBuf,
    arguments: Vec<String>,
    live: SharedLive,
    dir: RunDir,
    run: Arc<Mutex<RunFile>>,
    transport: ZenohTransport,
    clock: Arc<dyn Clock>,
    sender: Sender<Message>,
    guards: Vec<Guard>,
    started: Instant,
    all_ready: bool,
    /// The e-stop was said, by a person or for a node, and not taken back: whoever starts later hears it too.
    stopped: bool,
    end: End,
    result: Result<(), RunError>,
}

/// What ties the monitor to the others.
pub(super) struct Links {
    pub transport: ZenohTransport,
    pub live: SharedLive,
    pub clock: Arc<dyn Clock>,
    pub sender: Sender<Message>,
    pub guards: Vec<Guard>,
}

impl Monitor {
    pub(super) fn new(
        graph: &Graph,
        options: &Options,
        dir: RunDir,
        run: Arc<Mutex<RunFile>>,
        Links { transport, live, clock, sender, guards }: Links,
    ) -> Self {
        let exec = exec_programs(graph);
        let own = || (std::env::current_exe().unwrap_or_else(|_| "/proc/self/exe".into()), vec!["process".to_owned()]);
        let (program, arguments) = options.program.clone().unwrap_or_else(own);
        let process = |name: &&str| {
            let first = graph.nodes.iter().find(|node| node.process == *name);
            let rule = first.map(|node| node.restart).unwrap_or_default();
            Process::new(name, rule, exec.get(*name).cloned())
        };
        let processes: Vec<Process> = graph.processes_on(options.machine.as_deref()).iter().map(process).collect();
        let index = processes.iter().enumerate().map(|(at, process)| (process.name.clone(), at)).collect();
        let mut picture = Picture::on(options.machine.as_deref());
        picture.follow(&run.lock().unwrap_or_else(PoisonError::into_inner).nodes, clock.now());
        Self {
            robot: graph.robot.clone(),
            // One more is the supervisor's own.
            next_number: processes.len() + 1,
            processes,
            index,
            picture,
            heard_of_machines: Instant::now(),
            program,
            arguments,
            live,
            dir,
            run,
            transport,
            clock,
            sender,
            guards,
            started: Instant::now(),
            all_ready: false,
            stopped: false,
            end: End::No,
            result: Ok(()),
        }
    }

    /// Runs until all processes have ended.
    pub(super) fn run(mut self, messages: &Receiver<Message>, outlets: &Outlets) -> Result<(), RunError> {
        tracing::debug!("robot `{}` starts at {}", self.robot, self.clock.now());
        for at in 0..self.processes.len() {
            self.start(at, outlets);
        }
        let mut next_status = Instant::now();
        while !self.over() {
            let now = Instant::now();
            if now >= next_status {
                next_status += STATUS_PERIOD;
                if now.duration_since(self.heard_of_machines) >= outside::SILENCE {
                    self.machines(&[], outlets);
                }
                self.tell_status(now, outlets);
            }
            self.pass_time(now, outlets);
            let pause = self.next_deadline(next_status).saturating_duration_since(Instant::now());
            match messages.recv_timeout(pause) {
                Ok(message) => self.react(message, outlets),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        self.tell_status(Instant::now(), outlets);
        self.guards.clear();
        self.transport.close();
        clean_shared_memory();
        self.result
    }

    fn over(&self) -> bool {
        let none_lives = self.processes.iter().all(|process| process.pid.is_none());
        match self.end {
            End::No => false,
            End::Braking(_) | End::Ending(_) | End::Killed => none_lives,
        }
    }

    fn next_deadline(&self, next_status: Instant) -> Instant {
        let pauses = self.processes.iter().filter_map(|process| match process.phase {
            Phase::Pausing(until) => Some(until),
            _ => process.leaving,
        });
        let end = match self.end {
            End::Braking(until) | End::Ending(until) => Some(until),
            End::No | End::Killed => None,
        };
        pauses.chain(end).fold(next_status, Instant::min)
    }

    /// Does what is due at `now`.
    fn pass_time(&mut self, now: Instant, outlets: &Outlets) {
        match self.end {
            End::No => {
                for at in 0..self.processes.len() {
                    if matches!(self.processes[at].phase, Phase::Pausing(until) if until <= now) {
                        self.start(at, outlets);
                    }
                }
                self.kill_stragglers(now);
            }
            End::Braking(until) if until <= now => self.tell_to_end(now),
            End::Ending(until) if until <= now => self.kill(),
            End::Braking(_) | End::Ending(_) | End::Killed => {}
        }
    }

    fn react(&mut self, message: Message, outlets: &Outlets) {
        let now = Instant::now();
        match message {
            Message::Exited { process, generation, status } => self.exited(&process, generation, status, outlets),
            Message::StartHost { host, news } => self.start_host(host, news, outlets),
            Message::Adopt { process } => self.adopt(&process),
            Message::EndProcess { process, at_once } => self.end_process(&process, at_once),
            Message::Look { process, answer } => {
                // Whoever asked may have stopped waiting.
                let _ = answer.send(self.view(&process).state);
            }
            Message::Replanned => self.replanned(),
            Message::Linked => self.write_run_file(),
            Message::Applied { path, text, receipt } => self.applied(path, &text, receipt, outlets),
            Message::Changed(receipt) => {
                // Nobody may be listening.
                let _ = outlets.events.send(Event::Changed(receipt));
            }
            Message::Announced { process, here: true } => self.announced(&process, outlets),
            Message::Control(word) => self.was_said(word),
            // Who is gone is learnt from its end.
            Message::Announced { here: false, .. } => {}
            Message::Health(health) => self.picture.hear(*health, now),
            Message::Machines(joined) => {
                self.heard_of_machines = now;
                self.machines(&joined, outlets);
            }
            Message::Fault(report) => self.fault(report, outlets),
            Message::Speed(speed) => {
                if matches!(self.end, End::Braking(_)) && speed.abs() < STANDSTILL_M_S {
                    self.tell_to_end(now);
                }
            }
            Message::Stop => self.stop(outlets),
            Message::StopNow => self.kill(),
        }
    }

    /// Processes that were told to end and did not.
    fn kill_stragglers(&mut self, now: Instant) {
        for process in &mut self.processes {
            if process.leaving.is_some_and(|until| until <= now) {
                process.leaving = Some(now + END_PATIENCE);
                if let Some(pid) = process.pid {
                    tracing::warn!("process `{}` does not end; it is killed", process.name);
                    children::signal(pid, Signal::SIGKILL);
                }
            }
        }
    }

    fn start_host(&mut self, host: Host, news: Sender<HostNews>, outlets: &Outlets) {
        if self.end != End::No {
            let _ = news.send(HostNews::Ended { how: "the run is ending".into() });
            return;
        }
        let (at, number) = (self.processes.len(), self.next_number);
        self.next_number += 1;
        let entry = self.dir.socket(&host.process, number).map(|socket| {
            let mut run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
            let endpoints = |name: &String| run.processes.iter().find(|p| p.name == *name).map(|p| p.endpoint.clone());
            let mut connect: Vec<String> = host.connect.iter().filter_map(endpoints).collect();
            // Tools that look on know nothing of this process: it goes to them.
            connect.extend(self.dir.tool_sockets().iter().map(|socket| endpoint(socket)));
            let entry = ProcessEntry { name: host.process.clone(), endpoint: endpoint(&socket), connect, pid: None };
            run.processes.push(entry);
        });
        if let Err(error) = entry {
            let _ = news.send(HostNews::Ended { how: error.to_string() });
            return;
        }
        self.index.insert(host.process.clone(), at);
        let process = Process::new(&host.process, Restart::default(), host.program);
        self.processes.push(Process { host: Some(news), ..process });
        // Before it starts: it reads there to whom it connects.
        self.write_run_file();
        self.start(at, outlets);
    }

    fn adopt(&mut self, name: &str) {
        let Some(&at) = self.index.get(name) else { return };
        self.processes[at].host = None;
        self.follow_restart_rules();
    }

    fn end_process(&mut self, name: &str, at_once: bool) {
        let Some(&at) = self.index.get(name) else { return };
        let process = &mut self.processes[at];
        process.leaving = Some(Instant::now() + END_PATIENCE);
        match process.pid {
            Some(pid) => children::signal(pid, if at_once { Signal::SIGKILL } else { Signal::SIGTERM }),
            None => self.forget(at),
        }
    }

    /// A process is no more, and will not come back.
    fn forget(&mut self, at: usize) {
        let gone = self.processes.remove(at);
        self.index = self.processes.iter().enumerate().map(|(at, process)| (process.name.clone(), at)).collect();
        let mut run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
        run.processes.retain(|entry| entry.name != gone.name);
        drop(run);
        self.write_run_file();
    }

    fn replanned(&mut self) {
        let (entries, plan) = {
            let live = self.live.lock();
            (live.node_entries(), live.plan.clone())
        };
        self.picture.follow(&entries, self.clock.now());
        self.run.lock().unwrap_or_else(PoisonError::into_inner).nodes = entries;
        self.follow_restart_rules();
        if let Err(error) = self.dir.write_plan(&plan) {
            tracing::error!("{error}");
        }
        self.write_run_file();
    }

    fn follow_restart_rules(&mut self) {
        let live = self.live.lock();
        for process in self.processes.iter_mut().filter(|process| process.host.is_none()) {
            let first = live.plan.nodes.iter().find(|node| node.process == process.name);
            if let Some(rule) = first.map(|node| node.restart).filter(|rule| *rule != process.rule) {
                (process.rule, process.restarts) = (rule, Restarts::new(rule));
            }
        }
    }

    fn applied(&mut self, path: PathBuf, text: &str, receipt: Box<ApplyReceipt>, outlets: &Outlets) {
        if receipt.outcome == Outcome::Done {
            self.run.lock().unwrap_or_else(PoisonError::into_inner).graph = path;
            if let Err(error) = self.dir.write_graph(text) {
                tracing::warn!("{error}");
            }
            self.replanned();
        }
        // Nobody may be listening.
        let _ = outlets.events.send(Event::Applied(receipt));
    }

    fn start(&mut self, at: usize, outlets: &Outlets) {
        let process = &mut self.processes[at];
        process.generation += 1;
        // Whatever instances it had, it begins anew.
        self.live.lock().begin_process(&process.name);
        let exec = process.program.as_ref();
        let start = Start {
            process: &process.name,
            program: exec.unwrap_or(&self.program),
            arguments: if exec.is_some() { &["process".to_owned()] } else { &self.arguments },
            run_dir: self.dir.path(),
            generation: process.generation,
        };
        match children::start(&start, &self.sender, &outlets.events) {
            Ok(pid) => {
                process.pid = Some(pid);
                process.phase = Phase::Starting;
            }
            Err(error) if process.host.is_some() => {
                if let Some(news) = process.host.take() {
                    let _ = news.send(HostNews::Ended { how: error.to_string() });
                }
                self.forget(at);
            }
            Err(error) => {
                process.phase = Phase::Down(NodeState::GaveUp);
                self.fail(error, outlets);
            }
        }
        self.write_run_file();
    }

    /// Ends the run because of an error.
    fn fail(&mut self, error: RunError, outlets: &Outlets) {
        if self.result.is_ok() {
            self.result = Err(error);
        }
        self.stop(outlets);
    }

    fn exited(&mut self, name: &str, generation: u32, status: Option<ExitStatus>, outlets: &Outlets) {
        let Some(&at) = self.index.get(name) else { return };
        if self.processes[at].generation != generation {
            return;
        }
        self.processes[at].pid = None;
        self.write_run_file();
        if self.end != End::No {
            self.processes[at].phase = Phase::Down(NodeState::Stopped);
            return;
        }
        if let Some(news) = self.processes[at].host.take() {
            let how = self.dir.take_error(name).unwrap_or_else(|| children::describe(status));
            let _ = news.send(HostNews::Ended { how });
            return self.forget(at);
        }
        // A node that has gone elsewhere leaves an empty process behind.
        if self.processes[at].leaving.is_some() || !self.live.lock().plan.has_nodes_in(name) {
            return self.forget(at);
        }
        let setup_failed = status.and_then(|status| status.code()) == Some(i32::from(SETUP_FAILED));
        let how = match setup_failed.then(|| self.dir.take_error(name)).flatten() {
            Some(reason) if !self.processes[at].was_ready => {
                self.processes[at].phase = Phase::Down(NodeState::Stopped);
                return self.fail(RunError::Setup { process: name.to_owned(), reason }, outlets);
            }
            Some(reason) => reason,
            None => children::describe(status),
        };
        let failed = status.is_none_or(|status| !status.success());
        self.restart_or_not(at, how, failed, outlets);
    }

    fn restart_or_not(&mut self, at: usize, how: String, failed: bool, outlets: &Outlets) {
        let now = Instant::now();
        let process = &mut self.processes[at];
        let name = process.name.clone();
        let event = match process.restarts.ended(failed, now) {
            Verdict::After(pause) => {
                process.phase = Phase::Pausing(now + pause);
                Event::Died { process: name, how, again_in: Some(pause) }
            }
            Verdict::StayDown => {
                process.phase = Phase::Down(NodeState::Stopped);
                Event::Died { process: name, how, again_in: None }
            }
            Verdict::GiveUp => {
                process.phase = Phase::Down(NodeState::GaveUp);
                let why = format!("{how}; it was started again {}", process.restarts.limit());
                let live = self.live.lock();
                let nodes = live.plan.nodes.iter().filter(|node| node.process == name);
                let nodes = nodes.map(|node| node.name.clone()).collect();
                Event::GaveUp { process: name, nodes, why }
            }
        };
        let last = match &event {
            Event::Died { process, how, .. } => format!("process `{process}`: {how}"),
            Event::GaveUp { process, why, .. } => format!("process `{process}`: {why}"),
            _ => String::new(),
        };
        // Nobody may be listening.
        let _ = outlets.events.send(event);
        self.tell_status(now, outlets);
        if self.processes.iter().all(|process| matches!(process.phase, Phase::Down(_))) {
            let result = if failed { Err(RunError::NothingLeft { last }) } else { Ok(()) };
            if self.result.is_ok() {
                self.result = result;
            }
            self.end = End::Killed;
        }
    }

    fn announced(&mut self, name: &str, outlets: &Outlets) {
        let Some(&at) = self.index.get(name) else { return };
        let process = &mut self.processes[at];
        if process.phase != Phase::Starting {
            return;
        }
        process.phase = Phase::Ready(Instant::now());
        process.was_ready = true;
        if let (Some(news), Some(pid)) = (&process.host, process.pid) {
            let _ = news.send(HostNews::Ready { pid });
            return;
        }
        let _ = outlets.events.send(Event::Ready { process: name.to_owned() });
        if self.stopped {
            self.say(Control::EStop);
        }
        if !self.all_ready && self.processes.iter().all(|process| matches!(process.phase, Phase::Ready(_))) {
            self.all_ready = true;
            let _ = outlets.events.send(Event::AllReady(self.started.elapsed()));
        }
    }

    /// The machines that have joined are these.
    fn machines(&mut self, joined: &[String], outlets: &Outlets) {
        let changed = self.picture.joined(joined, (Instant::now(), self.clock.now()));
        if changed.is_empty() {
            return;
        }
        for machine in changed {
            // Nobody may be listening.
            let _ = outlets.events.send(Event::Machine(machine));
        }
        self.tell_status(Instant::now(), outlets);
    }

    /// A node stops the car: all others hear it, too.
    fn fault(&mut self, report: FaultReport, outlets: &Outlets) {
        self.stopped = true;
        self.say(Control::EStop);
        if self.picture.fault.is_none() {
            self.picture.fault = Some(report.clone());
        }
        let _ = outlets.events.send(Event::Fault(report));
        self.tell_status(Instant::now(), outlets);
    }

    /// Words are the nodes' affair, except `reset`; those on other machines hear it from here.
    fn was_said(&mut self, word: Control) {
        match word {
            Control::EStop => self.stopped = true,
            Control::Reset => {
                self.stopped = false;
                self.picture.fault = None;
            }
            Control::Start | Control::Stop => {}
        }
        let put = serde_json::to_vec(&word).map(|bytes| self.transport.put(&word_key(&self.robot), None, bytes));
        if let Ok(Err(error)) = put {
            tracing::warn!("`{word}` is not told to other machines: {error}");
        }
    }

    /// Says a word to all nodes, without waiting.
    fn say(&self, word: Control) {
        let (transport, robot) = (self.transport.clone(), self.robot.clone());
        std::thread::spawn(move || match tap::control(&transport, &robot, word) {
            Ok(answers) => answers.into_iter().filter_map(Result::err).for_each(|error| tracing::error!("{error}")),
            Err(error) => tracing::error!("`{word}` did not go out: {error}"),
        });
    }

    /// Stops the car, if it has a speed to wait for, then the processes.
    fn stop(&mut self, outlets: &Outlets) {
        if self.end != End::No {
            return;
        }
        let _ = outlets.events.send(Event::Stopping);
        let now = Instant::now();
        self.say(Control::Stop);
        self.end = End::Braking(now + STANDSTILL_PATIENCE);
        let ready = |process: &Process| matches!(process.phase, Phase::Ready(_));
        if !self.watch_speed() || !self.processes.iter().any(ready) {
            self.tell_to_end(now);
        }
    }

    /// `false`: no port tells the speed.
    fn watch_speed(&mut self) -> bool {
        let ports = speed_ports(&self.run.lock().unwrap_or_else(PoisonError::into_inner));
        for (node, port) in &ports {
            let sender = self.sender.clone();
            let key = carril_messages::Key::new(&self.robot, node, port).to_string();
            let guard = self.transport.watch(&key, move |_, header, payload| {
                let Ok(header) = carril_messages::Header::decode(header) else { return };
                let vehicle = || VehicleState::decode(&header.meta, &payload).map(|state| state.speed_m_s);
                let wheel = || WheelTelemetry::decode(&header.meta, &payload).map(|state| state.speed_m_s);
                let speed = if header.message_type == VehicleState::TYPE { vehicle() } else { wheel() };
                if let Ok(speed) = speed {
                    let _ = sender.send(Message::Speed(speed));
                }
            });
            match guard {
                Ok(guard) => self.guards.push(guard),
                Err(error) => tracing::debug!("{error}"),
            }
        }
        !ports.is_empty()
    }

    fn tell_to_end(&mut self, now: Instant) {
        self.end = End::Ending(now + END_PATIENCE);
        for process in self.processes.iter().rev() {
            if let Some(pid) = process.pid {
                children::signal(pid, Signal::SIGTERM);
            }
        }
    }

    fn kill(&mut self) {
        self.end = End::Killed;
        for process in &self.processes {
            if let Some(pid) = process.pid {
                tracing::warn!("process `{}` is killed", process.name);
                children::signal(pid, Signal::SIGKILL);
            }
        }
    }

    fn view(&self, name: &str) -> ProcessView {
        let Some(process) = self.index.get(name).map(|&at| &self.processes[at]) else {
            return ProcessView { state: None, restarts: 0, ready_since: None };
        };
        let (state, ready_since) = match process.phase {
            Phase::Starting if process.generation > 1 => (Some(NodeState::Restarting), None),
            Phase::Starting => (Some(NodeState::Starting), None),
            Phase::Ready(since) => (None, Some(since)),
            Phase::Pausing(_) => (Some(NodeState::Restarting), None),
            Phase::Down(state) => (Some(state), None),
        };
        ProcessView { state, restarts: process.restarts.total(), ready_since }
    }

    fn tell_status(&mut self, now: Instant, outlets: &Outlets) {
        let mut picture = std::mem::take(&mut self.picture);
        let status = picture.status(self.started.elapsed(), (now, self.clock.now()), &|name| self.view(name));
        self.picture = picture;
        match serde_json::to_vec(&status) {
            Ok(bytes) => {
                if let Err(error) = self.transport.put(&status_key(&self.robot), None, bytes) {
                    tracing::debug!("{error}");
                }
            }
            Err(error) => tracing::debug!("the status cannot be put: {error}"),
        }
        outlets.status.send_replace(status);
    }

    fn write_run_file(&self) {
        let mut run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
        for process in &self.processes {
            if let Some(entry) = run.processes.iter_mut().find(|entry| entry.name == process.name) {
                entry.pid = process.pid;
            }
        }
        if let Err(error) = self.dir.write_run_file(&run) {
            tracing::warn!("{error}");
        }
    }
}

fn speed_ports(run: &RunFile) -> Vec<(String, String)> {
    let tells_speed = |name: &str| name == VehicleState::TYPE.name || name == WheelTelemetry::TYPE.name;
    let here = run.nodes.iter().filter(|node| node.machine == run.machine);
    let ports = here.flat_map(|node| node.outputs.iter().map(move |output| (node, output)));
    ports
        .filter(|(_, output)| tells_speed(&output.message_type))
        .map(|(node, output)| (node.name.clone(), output.port.clone()))
        .collect()
}

fn exec_programs(graph: &Graph) -> HashMap<String, PathBuf> {
    let exec = |node: &crate::graph::GraphNode| Some((node.process.clone(), node.exec()?.to_owned()));
    graph.nodes.iter().filter_map(exec).collect()
}
