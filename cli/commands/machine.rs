//! `carril machine NAME`: the link of a machine that runs nodes of a car's graph to that car. `carril run FILE --machine NAME` starts it; it
//! is not for people.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Result;
use carril_dashboard::machine::link;
use carril_runtime::client::Client;
use carril_runtime::graph::remote::RemoteRates;
use carril_runtime::process::die_with;
use clap::Args;

use crate::common::way::{MachineWay, Target};
use crate::common::{interrupt, output};

/// Arguments of `carril machine`.
#[derive(Args)]
pub struct MachineArgs {
    /// The machine
    #[arg(value_name = "NAME")]
    name: String,
    /// The robot
    #[arg(long, value_name = "NAME")]
    robot: String,
    /// How images go out, as the graph says, in JSON
    #[arg(long, value_name = "JSON")]
    rates: String,
    /// Where the car is
    #[arg(long, value_name = "HOST[:PORT]")]
    connect: Option<String>,
}

/// Keeps the link until it is told to end, or the run on this machine has ended. What is new goes to standard output, a line of JSON each.
pub fn run(args: &MachineArgs) -> Result<()> {
    let rates: RemoteRates = serde_json::from_str(&args.rates)?;
    let target = Target { robot: None, connect: args.connect.clone(), key: None };
    let way = MachineWay::find(&args.robot, &args.name, &target)?;
    let near = Arc::new(Client::connect_to_stand_in(Some(&args.robot))?);
    // A tool that watches the run must not keep it alive: the car would believe that the machine is still there.
    die_with(near.file().pid)?;
    let stop = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&stop);
    interrupt::on_interrupt(move || told.store(true, Ordering::Relaxed))?;
    let options = link::Options { machine: args.name.clone(), rates };
    let connect = || way.connect().map_err(|error| format!("{error:#}"));
    link::keep(&near, &options, &connect, &stop, &|news| {
        if let Err(error) = output::json_line(news) {
            tracing::warn!("nobody hears of the link: {error}");
        }
    });
    Ok(())
}
