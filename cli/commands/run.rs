//! `carril run FILE`: launches the graph, one process per `process` name, and shows how the car does until it is told to stop.

use std::fmt::Write;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use carril_messages::{Health, NodeState, Percentiles, TrackProgress};
use carril_runtime::Registry;
use carril_runtime::control_plane::{FaultReport, Outcome, Status};
use carril_runtime::graph::Graph;
use carril_runtime::supervisor::{Event, Options, Running, Supervisor};
use carril_runtime::transport::Guard;
use clap::Args;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::sync::broadcast::Receiver;

use crate::common::drive::{self, Drive};
use crate::common::graph_file::{self, GraphArgs, Shown};
use crate::common::output::StatusLine;
use crate::common::outside::{Outside, Told};
use crate::common::report::Report;
use crate::common::way::{MachineWay, Target};
use crate::common::wheel::{self, AgeMeter};
use crate::common::{applied, interrupt, nodes, output, receipt, time};

/// Between two looks at events and status.
const LOOK: Duration = Duration::from_millis(50);

/// Arguments of `carril run`.
#[derive(Args)]
#[command(
    after_help = "Ctrl-C stops the car first, then the graph; a second Ctrl-C ends everything at once. Watch from \
        another terminal with `carril top`, `carril echo`, `carril hz`; stop the car with `carril estop`.

Status line: time, what the decision node does, speed, lap, age from exposure to wheel (median/99th percentile of the \
        last second), steps per second of each node.

Examples:
  carril run dataflow.yaml
  carril run dataflow.yaml --for 30s --json | tail -n 1 | jq .summary.progress
  carril run dataflow.yaml --set world.track=tracks/s-bends.yaml --set decision.cruise_speed_m_s=0.4
  carril run dataflows/two-machines.yaml --machine laptop --connect car.local --key laptop.carril-key.json"
)]
pub struct RunArgs {
    #[command(flatten)]
    graph: GraphArgs,
    /// Stop after this time, for example 30s or 2m
    #[arg(long = "for", value_name = "DURATION", value_parser = time::parse)]
    duration: Option<Duration>,
    /// Seed of noise and of generated tracks
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Run the nodes that the graph places on this machine, and join the car with them
    #[arg(long, value_name = "NAME")]
    machine: Option<String>,
    /// With --machine: where the car is, `car.local` or `tcp/192.168.1.5:7447`; remembered for the next time
    #[arg(long, value_name = "HOST[:PORT]", requires = "machine")]
    connect: Option<String>,
    /// With --machine: the key that `carril grant --machine NAME` wrote on the car; remembered for the next time
    #[arg(long, value_name = "FILE", requires = "machine")]
    key: Option<PathBuf>,
    /// Nothing listens beyond this machine, whatever the graph says of `remote:`
    #[arg(long)]
    no_remote: bool,
    /// No status lines, only the summary
    #[arg(long)]
    quiet: bool,
    /// One JSON object a second, one per event, and the summary as the last line
    #[arg(long)]
    json: bool,
}

/// Runs it. Exit code 1 also when a process gave up or a fault stopped the car.
pub fn run(args: &RunArgs, registry: &Registry) -> Result<()> {
    let graph = graph_file::read_for(&args.graph, args.machine.as_deref(), registry)?;
    let target = Target { robot: None, connect: args.connect.clone(), key: args.key.clone() };
    if let Some(machine) = &args.machine {
        // Before anything starts: without a key it would run for nothing. The link finds it again.
        MachineWay::find(&graph.robot, machine, &target)?;
    }
    let options = Options { seed: args.seed, machine: args.machine.clone(), ..Options::default() };
    let running = Supervisor::start(&graph, registry, &options)?;
    stop_on_interrupt(&running)?;
    let mut console = Console::new(&graph, args);
    let result = console.watch(&running);
    running.stop();
    let ended = running.wait();
    // A reader that went away must not keep the car driving: first the graph ends, then its error counts.
    result?;
    console.drain()?;
    console.line.end()?;
    if console.ready_after_s.is_none() {
        ended?;
        return Ok(());
    }
    let summary = console.summary();
    if args.json {
        output::json_line(&json!({ "summary": summary }))?;
    } else {
        let gap = if args.quiet { "" } else { "\n" };
        output::text(format_args!("{gap}{}", summary.text()))?;
    }
    ended?;
    if summary.went_well() { Ok(()) } else { Err(Shown.into()) }
}

fn stop_on_interrupt(running: &Running) -> Result<()> {
    let stopper = running.stopper();
    let times = AtomicU32::new(0);
    interrupt::on_interrupt(move || match times.fetch_add(1, Ordering::Relaxed) {
        0 => stopper.stop(),
        _ => stopper.stop_now(),
    })
}

/// What the run looks like from this terminal.
struct Console<'a> {
    args: &'a RunArgs,
    graph: &'a Graph,
    line: StatusLine,
    heard: Arc<Mutex<Heard>>,
    events: Option<Receiver<Event>>,
    last: Status,
    /// As they were before they stopped in order: what the summary shows.
    nodes: Vec<Health>,
    begun: Instant,
    ready_after_s: Option<f64>,
    /// Processes that stay down, with their nodes.
    gave_up: Vec<(String, Vec<String>)>,
    /// While the graph is up: the gateway of a car whose graph has `remote:`, or the link of another machine.
    outside: Option<Outside>,
}

/// Filled on the transport's thread.
struct Heard {
    drive: Drive,
    ages: Option<AgeMeter>,
}

fn lock(heard: &Mutex<Heard>) -> MutexGuard<'_, Heard> {
    heard.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<'a> Console<'a> {
    fn new(graph: &'a Graph, args: &'a RunArgs) -> Self {
        let ages = wheel::path(graph).as_ref().map(AgeMeter::new);
        Self {
            args,
            graph,
            line: StatusLine::new(),
            heard: Arc::new(Mutex::new(Heard { drive: Drive::default(), ages })),
            events: None,
            last: Status::default(),
            nodes: Vec::new(),
            begun: Instant::now(),
            ready_after_s: None,
            gave_up: Vec::new(),
            outside: None,
        }
    }

    /// Until the run has ended, or must end.
    fn watch(&mut self, running: &Running) -> Result<()> {
        self.events = Some(running.events());
        let _guards = self.listen(running)?;
        let mut status = running.status();
        let mut told_to_stop = false;
        while !running.ended() {
            self.drain()?;
            if status.has_changed().unwrap_or(false) {
                self.last = status.borrow_and_update().clone();
                if self.last.nodes.iter().all(|node| node.state != NodeState::Stopped) {
                    self.nodes.clone_from(&self.last.nodes);
                }
                self.show_moment()?;
            }
            if !told_to_stop && self.args.duration.is_some_and(|duration| self.begun.elapsed() >= duration) {
                told_to_stop = true;
                running.stop();
            }
            std::thread::sleep(LOOK);
        }
        Ok(())
    }

    fn listen(&self, running: &Running) -> Result<Vec<Guard>> {
        let mut guards = Vec::new();
        for node in &self.graph.nodes {
            let Some(kind) = node.kind() else { continue };
            for port in kind.outputs.iter().filter(|port| drive::WATCHED.contains(&port.message_type.name.as_ref())) {
                let heard = Arc::clone(&self.heard);
                let hear = move |header, payload, _| lock(&heard).drive.update(&header, &payload);
                guards.push(running.subscribe(&node.name, port.name, hear)?);
            }
        }
        if let Some(path) = wheel::path(self.graph) {
            let heard = Arc::clone(&self.heard);
            let hear = move |header, _, arrived| {
                if let Some(ages) = &mut lock(&heard).ages {
                    ages.record(&header, arrived);
                }
            };
            guards.push(running.subscribe(&path.command.node, &path.command.port, hear)?);
        }
        Ok(guards)
    }

    fn show_moment(&mut self) -> Result<()> {
        let moment = {
            let mut heard = lock(&self.heard);
            let age_ms = heard.ages.as_mut().and_then(AgeMeter::take_window);
            heard.drive.moment(&self.last, age_ms)
        };
        match (self.args.quiet, self.args.json) {
            (true, _) => Ok(()),
            (false, true) => output::json_line(&moment),
            (false, false) => self.line.show(&moment.line()),
        }
    }

    fn drain(&mut self) -> Result<()> {
        while let Some(event) = self.events.as_mut().and_then(|events| events.try_recv().ok()) {
            self.tell(&event)?;
        }
        while let Some(told) = self.outside.as_ref().and_then(Outside::told) {
            self.tell_of_outside(&told)?;
        }
        Ok(())
    }

    fn start_outside(&mut self) -> Result<()> {
        self.outside = match (&self.args.machine, &self.graph.remote) {
            (Some(machine), remote) => {
                let rates = remote.as_ref().map(|remote| remote.rates).unwrap_or_default();
                Some(Outside::link(&self.graph.robot, machine, self.args.connect.as_deref(), rates)?)
            }
            (None, Some(remote)) if !self.args.no_remote => Some(Outside::gateway(&self.graph.robot, remote)?),
            _ => None,
        };
        Ok(())
    }

    fn tell_of_outside(&mut self, told: &Told) -> Result<()> {
        if self.args.json {
            return if self.args.quiet { Ok(()) } else { output::json_line(&json!({ "event": told.json })) };
        }
        if self.args.quiet && !told.always {
            return Ok(());
        }
        self.line.end()?;
        eprintln!("{}", told.text);
        Ok(())
    }

    /// Events go to standard error, so that a pipe gets status lines only; with `--json` they are lines of their own.
    fn tell(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::AllReady(after) => {
                self.ready_after_s = Some(after.as_secs_f64());
                self.start_outside()?;
            }
            // First nobody steers from outside any more.
            Event::Stopping => self.outside = None,
            Event::GaveUp { process, nodes, .. } => self.gave_up.push((process.clone(), nodes.clone())),
            // Somebody has started it again.
            Event::Changed(receipt) if receipt.outcome == Outcome::Done => {
                for (_, nodes) in &mut self.gave_up {
                    nodes.retain(|node| *node != receipt.node);
                }
                self.gave_up.retain(|(_, nodes)| !nodes.is_empty());
            }
            _ => {}
        }
        if self.args.json {
            let quiet = self.args.quiet || matches!(event, Event::Ready { .. });
            return if quiet { Ok(()) } else { output::json_line(&json!({ "event": event_json(event) })) };
        }
        let Some(text) = self.event_text(event) else { return Ok(()) };
        self.line.end()?;
        eprintln!("{text}");
        Ok(())
    }

    /// `None`: not worth a line.
    fn event_text(&self, event: &Event) -> Option<String> {
        let quiet = self.args.quiet;
        match event {
            Event::AllReady(after) if !quiet => Some(self.up_text(*after)),
            Event::Machine(machine) if machine.joined && !quiet => {
                Some(format!("machine `{}` has joined: {}", machine.machine, machine.nodes.join(", ")))
            }
            Event::Machine(machine) if !machine.joined => {
                Some(format!("machine `{}` has left, and with it: {}", machine.machine, machine.nodes.join(", ")))
            }
            Event::Changed(receipt) if !quiet => Some(receipt::text(receipt)),
            Event::Applied(receipt) if !quiet => Some(applied::headline(receipt)),
            Event::Stopping if !quiet => Some("stopping: first the car, then the graph".to_owned()),
            Event::Line { process, text } => Some(format!("[{process}] {text}")),
            Event::Died { process, how, again_in: Some(pause) } => {
                Some(format!("process `{process}` died: {how}; it starts again in {}", time::span(pause.as_secs_f64())))
            }
            Event::Died { process, how, again_in: None } => {
                Some(format!("process `{process}` died: {how}; it stays down"))
            }
            Event::GaveUp { process, nodes, why } => {
                let restart: Vec<String> = nodes.iter().map(|node| format!("carril restart {node}")).collect();
                Some(format!("process `{process}` stays down: {why}\nhint: {}", restart.join(", then ")))
            }
            Event::Fault(fault) => Some(format!(
                "the car is stopped by `{}`: {}\nhint: carril reset, then carril start",
                fault.node, fault.reason
            )),
            _ => None,
        }
    }

    fn up_text(&self, after: Duration) -> String {
        let machine = self.args.machine.as_deref();
        let count = self.graph.nodes.iter().filter(|node| node.is_on(machine)).count();
        let nodes = output::counted(count as u64, "node");
        let processes = output::counted(self.graph.processes_on(machine).len() as u64, "process");
        let (robot, after) = (&self.graph.robot, time::span(after.as_secs_f64()));
        if let Some(machine) = machine {
            return format!(
                "{robot}: {nodes} in {processes} up on machine `{machine}` after {after}; Ctrl-C ends them"
            );
        }
        let mut text =
            format!("{robot}: {nodes} in {processes} up after {after}; Ctrl-C stops the car, then the graph");
        for machine in self.graph.machines() {
            let elsewhere = self.graph.nodes.iter().filter(|node| node.is_on(Some(machine)));
            let names = elsewhere.map(|node| node.name.as_str()).collect::<Vec<_>>().join(", ");
            let _ = write!(
                text,
                "\nelsewhere: {machine} (not joined): {names}; there: carril run FILE --machine {machine}"
            );
        }
        text
    }

    fn summary(&self) -> Summary {
        let heard = lock(&self.heard);
        Summary {
            graph: self.graph.path.clone(),
            robot: self.graph.robot.clone(),
            uptime_s: self.last.uptime_s,
            ready_after_s: self.ready_after_s,
            progress: heard.drive.progress().copied(),
            age_ms: heard.ages.as_ref().and_then(AgeMeter::total),
            age_path: wheel::path(self.graph).map(|path| path.to_string()),
            fault: self.last.fault.clone(),
            gave_up: self.gave_up.iter().map(|(process, _)| process.clone()).collect(),
            nodes: self.nodes.clone(),
        }
    }
}

fn event_json(event: &Event) -> Value {
    match event {
        Event::Ready { process } => json!({ "kind": "ready", "process": process }),
        Event::AllReady(after) => json!({ "kind": "all-ready", "after_s": after.as_secs_f64() }),
        Event::Line { process, text } => json!({ "kind": "line", "process": process, "text": text }),
        Event::Died { process, how, again_in } => {
            let again_in_s = again_in.map(|pause| pause.as_secs_f64());
            json!({ "kind": "died", "process": process, "how": how, "again_in_s": again_in_s })
        }
        Event::GaveUp { process, nodes, why } => {
            json!({ "kind": "gave-up", "process": process, "nodes": nodes, "why": why })
        }
        Event::Fault(fault) => json!({ "kind": "fault", "node": fault.node, "reason": fault.reason }),
        Event::Machine(machine) => json!({ "kind": "machine", "machine": machine }),
        Event::Changed(receipt) => json!({ "kind": "changed", "receipt": receipt }),
        Event::Applied(receipt) => json!({ "kind": "applied", "receipt": receipt }),
        Event::Stopping => json!({ "kind": "stopping" }),
        other => json!({ "kind": "other", "text": format!("{other:?}") }),
    }
}

/// What the run came to.
#[derive(Serialize)]
struct Summary {
    graph: PathBuf,
    robot: String,
    uptime_s: f64,
    /// From the start to the last process being up.
    ready_after_s: Option<f64>,
    /// `null`: no referee.
    progress: Option<TrackProgress>,
    /// From exposure to wheel over the whole run, along `age_path`.
    age_ms: Option<Percentiles>,
    age_path: Option<String>,
    /// What stopped the car and was not reset.
    fault: Option<FaultReport>,
    /// Processes that died too often.
    gave_up: Vec<String>,
    nodes: Vec<Health>,
}

impl Summary {
    fn went_well(&self) -> bool {
        self.fault.is_none() && self.gave_up.is_empty()
    }

    fn text(&self) -> Report {
        let mut report = Report::default();
        let ready = self.ready_after_s.map(|after| format!(" (up after {})", time::span(after))).unwrap_or_default();
        report.line(format_args!("{} ran for {}{ready}", self.graph.display(), time::span(self.uptime_s)));
        if let Some(progress) = &self.progress {
            report.progress(progress);
        }
        report.age(self.age_path.as_deref(), self.age_ms);
        if let Some(fault) = &self.fault {
            report.fact("STOPPED", format_args!("{}: {}", fault.node, fault.reason));
        }
        report.table(&nodes::COLUMNS, &self.nodes.iter().map(nodes::row).collect::<Vec<_>>());
        for complaint in nodes::complaints(&self.nodes) {
            report.line(complaint);
        }
        for process in &self.gave_up {
            report.line(format_args!("process `{process}` died too often and stayed down"));
        }
        report
    }
}
