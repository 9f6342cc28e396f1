//! `carril`: checks, runs, simulates and watches dataflow graphs of small autonomous cars.
//!
//! This file reads the command line, hands over to one file per command, and turns the result into an exit code: 0 ok,
//! 1 problems, 2 usage.

mod commands;
mod common;

use std::process::ExitCode;

use anyhow::Result;
use carril_messages::Control;
use clap::{Parser, Subcommand};

use commands::rates::Quantity;
use commands::{
    access, apply, calibrate, check, control, dashboard, doctor, echo, gateway, graph, list, machine, new, operators,
    params, process, publish, rates, run, scenarios, service, set, sim, swap, top, watch,
};
use common::graph_file::{Shown, Usage};
use common::output::ClosedPipe;
use common::registry;

/// Runs small autonomous cars as a graph of operators
///
/// `carril run dataflow.yaml` launches a simulated car that follows its lane; the other commands watch and steer it from
/// another terminal.
#[derive(Parser)]
#[command(name = "carril", version, max_term_width = 110)]
#[command(
    after_help = "Exit code: 0 ok, 1 problems, 2 wrong command line. CARRIL_LOG=info (debug, trace) shows more on standard error.

Examples:
  carril check dataflow.yaml && carril run dataflow.yaml --for 30s
  carril sim dataflow.yaml --laps 5
  carril echo lane/lane -n 3
  carril estop"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Report every problem of graph files
    Check(check::CheckArgs),
    /// Write a graph as Mermaid, Graphviz or JSON
    Graph(graph::GraphCommandArgs),
    /// Write the JSON Schema of graph files, for editors
    Schema(graph::SchemaArgs),
    /// List the kinds of operators, their ports and configuration
    Operators(operators::OperatorsArgs),
    /// Write a crate with an operator of your own
    New(new::NewArgs),
    /// Launch a graph and show how the car does
    Run(run::RunArgs),
    /// Run a graph in lockstep: virtual time, deterministic, faster than real time
    Sim(sim::SimArgs),
    /// Drive a graph many times, each time differently, and judge
    Scenarios(scenarios::ScenariosArgs),
    /// List the ports of the running graph
    List(list::ListArgs),
    /// Show everything about one node
    Info(list::InfoArgs),
    /// Show the samples of a port as text or JSON, or save an image
    Echo(echo::EchoArgs),
    /// Measure the rate of ports: period, jitter, losses
    #[command(after_help = rates::HZ_HELP)]
    Hz(rates::RatesArgs),
    /// Measure the bandwidth of ports
    #[command(after_help = rates::BW_HELP)]
    Bw(rates::RatesArgs),
    /// Measure the delay of ports: since publication, since exposure
    #[command(after_help = rates::DELAY_HELP)]
    Delay(rates::RatesArgs),
    /// Show every node live: rate, cost, latency, age, losses, processor, memory
    Top(top::TopArgs),
    /// Publish messages on a port that is open to people
    Pub(publish::PubArgs),
    /// List the parameters of the running nodes: value, default, range, unit, text
    Params(params::ParamsArgs),
    /// Show the value of a parameter of a running node
    Get(params::GetArgs),
    /// Change parameters of a running node, and with --save the graph file too
    Set(set::SetArgs),
    /// Replace a node by another version while the car drives
    Swap(swap::SwapArgs),
    /// Compare another version of a node with the one that runs; nothing is taken over
    Shadow(swap::ShadowArgs),
    /// Go back to the version of a node before the last change
    Rollback(swap::RollbackArgs),
    /// Start a node again: one that gave up, or one that runs
    Restart(swap::RestartArgs),
    /// Make the running graph that of a file, node by node, while the car drives
    Apply(apply::ApplyArgs),
    /// Swap a binary in whenever it was built anew
    Watch(watch::WatchArgs),
    /// Find what is different from car to car: servo, encoder, limits, pins, lane, lidar
    Calibrate(calibrate::CalibrateArgs),
    /// Show the running graph in a browser, here or from another machine
    #[command(after_help = dashboard::HELP)]
    Dashboard(dashboard::DashboardArgs),
    /// Let somebody control this car from another machine: writes a key
    #[command(after_help = access::GRANT_HELP)]
    Grant(access::GrantArgs),
    /// Make a key void
    Revoke(access::RevokeArgs),
    /// Show who is connected to the car from other machines, and who may control it
    Who(access::WhoArgs),
    /// Find out why a car cannot be reached: names, ports, scouting, versions, clocks, access
    Doctor(doctor::DoctorArgs),
    /// Serve the running graph to other machines; `carril run` starts it when the graph has `remote:`
    #[command(after_help = gateway::HELP)]
    Gateway(gateway::GatewayArgs),
    /// Start a graph whenever this machine starts (systemd)
    #[command(after_help = service::HELP)]
    Service(service::ServiceArgs),
    /// Let the car drive
    #[command(after_help = control::START_HELP)]
    Start(control::ControlArgs),
    /// Let the car slow down, stop and wait for `start`
    #[command(after_help = control::STOP_HELP)]
    Stop(control::ControlArgs),
    /// Stop the car at once and keep it stopped until `reset`
    #[command(after_help = control::ESTOP_HELP)]
    Estop(control::ControlArgs),
    /// Clear stops and faults; nothing moves before `start`
    #[command(after_help = control::RESET_HELP)]
    Reset(control::ControlArgs),
    /// The link of a machine to a car; `carril run --machine` starts it
    #[command(hide = true)]
    Machine(machine::MachineArgs),
    /// One process of a run; the supervisor starts it
    #[command(hide = true)]
    Process(process::ProcessArgs),
}

fn main() -> ExitCode {
    let command = Cli::parse().command;
    // Before any other thread: it sorts out signals, and logs in its own way.
    if let Command::Process(args) = &command {
        return process::run(args, &registry::built_in());
    }
    // It logs what its access rules refuse, too.
    if !matches!(command, Command::Gateway(_)) {
        start_logging();
    }
    match execute(command) {
        Ok(code) => code,
        Err(error) if error.is::<ClosedPipe>() => ExitCode::SUCCESS,
        Err(error) if error.is::<Shown>() => ExitCode::FAILURE,
        Err(error) if error.is::<Usage>() => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Logs go to standard error; `CARRIL_LOG=info` or `CARRIL_LOG=carril_runtime=debug` shows more than warnings.
fn start_logging() {
    let filter = log_filter("warn,zenoh=off");
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_target(false).init();
}

/// `CARRIL_LOG`, else `default`.
fn log_filter(default: &str) -> tracing_subscriber::EnvFilter {
    let filter = tracing_subscriber::EnvFilter::try_from_env("CARRIL_LOG");
    filter.unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(default))
}

fn execute(command: Command) -> Result<ExitCode> {
    let registry = registry::built_in();
    match command {
        Command::Check(args) => return check::run(&args, &registry),
        Command::Graph(args) => graph::run(&args, &registry)?,
        Command::Schema(_) => graph::schema(&registry)?,
        Command::Operators(args) => operators::run(&args, &registry)?,
        Command::New(args) => new::run(&args)?,
        Command::Run(args) => run::run(&args, &registry)?,
        Command::Sim(args) => sim::run(&args, &registry)?,
        Command::Scenarios(args) => return scenarios::run(&args, &registry),
        Command::List(args) => list::list(&args)?,
        Command::Info(args) => list::info(&args)?,
        Command::Echo(args) => echo::run(args)?,
        Command::Hz(args) => rates::run(&args, Quantity::Rate)?,
        Command::Bw(args) => rates::run(&args, Quantity::Bandwidth)?,
        Command::Delay(args) => rates::run(&args, Quantity::Delay)?,
        Command::Top(args) => top::run(&args)?,
        Command::Pub(args) => publish::run(&args)?,
        Command::Params(args) => params::params(&args, &registry)?,
        Command::Get(args) => params::get(&args, &registry)?,
        Command::Set(args) => return set::run(&args, &registry),
        Command::Swap(args) => swap::swap(&args)?,
        Command::Shadow(args) => swap::shadow(&args)?,
        Command::Apply(args) => apply::run(&args, &registry)?,
        Command::Watch(args) => watch::run(&args)?,
        Command::Rollback(args) => swap::rollback(&args)?,
        Command::Restart(args) => swap::restart(&args)?,
        Command::Calibrate(args) => calibrate::run(&args, &registry)?,
        Command::Dashboard(args) => dashboard::run(&args)?,
        Command::Grant(args) => access::grant(&args)?,
        Command::Revoke(args) => access::revoke(&args)?,
        Command::Who(args) => access::who(&args)?,
        Command::Doctor(args) => return doctor::run(&args),
        Command::Gateway(args) => gateway::run(&args)?,
        Command::Service(args) => return service::run(&args, &registry),
        Command::Machine(args) => machine::run(&args)?,
        Command::Start(args) => control::run(&args, Control::Start)?,
        Command::Stop(args) => control::run(&args, Control::Stop)?,
        Command::Estop(args) => control::run(&args, Control::EStop)?,
        Command::Reset(args) => control::run(&args, Control::Reset)?,
        Command::Process(args) => return Ok(process::run(&args, &registry)),
    }
    Ok(ExitCode::SUCCESS)
}
