//! `carril grant`, `revoke` and `who`: who may control a car from another machine, and who is connected.

use std::path::PathBuf;

use anyhow::{Context, Result};
use carril_dashboard::access::{Access, config_dir};
use carril_dashboard::gateway::MACHINE;
use carril_runtime::client::find_run_here;
use carril_runtime::control_plane::Who;
use clap::Args;

use crate::common::live::Run;
use crate::common::output;
use crate::common::report::Report;
use crate::common::way::Target;

/// Examples of `carril grant`.
pub const GRANT_HELP: &str = "The key is a file: whoever has it controls the car. Copy it to the other machine over a safe way (scp, a USB stick).
The key of a machine is for the nodes that the graph places there, and for nothing else but to look on.
There, name it once: carril list --connect car.local --key FILE. A running gateway takes the key in at once.

Examples:
  carril grant --control laptop-1                  writes laptop-1.carril-key.json
  carril grant --control anna --robot car2 -o anna.json
  carril grant --machine laptop                    for `carril run FILE --machine laptop` there";

/// Arguments of `carril grant`.
#[derive(Args)]
pub struct GrantArgs {
    /// To control the car. Name of the key: the person or machine that will have it
    #[arg(long, value_name = "NAME", required_unless_present = "machine")]
    control: Option<String>,
    /// To run the nodes that the graph places on this machine (`machine:`)
    #[arg(long, value_name = "NAME", conflicts_with = "control")]
    machine: Option<String>,
    /// Which robot; default: the one whose graph runs here
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// File to write; default: NAME.carril-key.json
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Arguments of `carril revoke`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril revoke laptop-1")]
pub struct RevokeArgs {
    /// Name of the key
    #[arg(value_name = "NAME")]
    name: String,
    /// Which robot; default: the one whose graph runs here
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
}

/// Arguments of `carril who`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril who
  carril who --json | jq .connected")]
pub struct WhoArgs {
    /// JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// Runs `carril grant`.
pub fn grant(args: &GrantArgs) -> Result<()> {
    let name = args.control.as_ref().or(args.machine.as_ref()).expect("the command line asks for one of them");
    let path = args.output.clone().unwrap_or_else(|| PathBuf::from(format!("{name}.carril-key.json")));
    // Before the key is made: one that cannot be handed over would have to be revoked.
    anyhow::ensure!(!path.exists(), "`{}` exists already; name another file with -o", path.display());
    let mut access = Access::open(&config_dir(), &robot(args.robot.as_deref())?)?;
    let key = match &args.machine {
        Some(machine) => access.grant_machine(machine)?,
        None => access.grant(name)?,
    };
    if let Err(error) = key.write(&path) {
        access.revoke(name).context("the key cannot be written, nor revoked")?;
        return Err(error.into());
    }
    if let Some(machine) = &key.machine {
        let file = path.file_name().unwrap_or_default().to_string_lossy();
        return output::line(format_args!(
            "machine `{machine}` may run its nodes of robot `{}` with the key in `{}`\n\
             on that machine: carril run FILE --machine {machine} --connect HOST --key {file}\n\
             to end it: carril revoke {machine}",
            key.robot,
            path.display(),
        ));
    }
    output::line(format_args!(
        "`{}` may control robot `{}` with the key in `{}`\n\
         on the other machine: carril list --connect HOST --key {}\n\
         at the dashboard (https): name {}, token {}\n\
         to end it: carril revoke {}",
        key.name,
        key.robot,
        path.display(),
        path.file_name().unwrap_or_default().to_string_lossy(),
        key.name,
        key.token,
        key.name
    ))
}

/// Runs `carril revoke`.
pub fn revoke(args: &RevokeArgs) -> Result<()> {
    let mut access = Access::open(&config_dir(), &robot(args.robot.as_deref())?)?;
    access.revoke(&args.name)?;
    output::line(format_args!("the key of `{}` for robot `{}` is void", args.name, access.robot()))
}

/// The robot that is named, or whose graph runs here. Keys are made on the car itself: none is looked for elsewhere.
fn robot(named: Option<&str>) -> Result<String> {
    if let Some(robot) = named {
        carril_messages::key::check_name(robot)?;
        return Ok(robot.to_owned());
    }
    let run = find_run_here(None).context("which robot? name it with --robot, as in the graph file")?;
    Ok(run.robot)
}

/// Runs `carril who`.
pub fn who(args: &WhoArgs) -> Result<()> {
    let run = Run::connect(&args.target)?;
    let who = run.client().who()?.context(
        "no gateway runs: nobody can connect from another machine\nhint: a section `remote:` in the graph, or `carril gateway`",
    )?;
    if args.json { output::json(&who) } else { output::text(shown(&who)) }
}

fn shown(who: &Who) -> Report {
    let mut report = Report::default();
    report.line(format_args!("listening at {}", who.listening.join(", ")));
    if who.connected.is_empty() {
        report.line("nobody is connected");
    } else {
        let rows: Vec<Vec<String>> = who
            .connected
            .iter()
            .map(|one| {
                let may = match &one.name {
                    None => "read",
                    Some(_) if one.by == MACHINE => "run its nodes",
                    Some(_) => "control",
                };
                vec![one.name.clone().unwrap_or_else(|| "-".into()), may.into(), one.by.clone(), one.address.clone()]
            })
            .collect();
        report.table(&["NAME", "MAY", "BY", "FROM"], &rows);
    }
    let names = |names: &[String]| if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    report.fact("keys", names(&who.granted));
    if !who.machines.is_empty() {
        report.fact("machines", names(&who.machines));
    }
    report.fact("revoked", names(&who.revoked));
    report.fact("sent", format_args!("{} samples, {:.1} MB", who.sent.0, who.sent.1 as f64 * 1e-6));
    report.fact(
        "dropped",
        format_args!("{} images, {} others (newer ones took their place)", who.dropped.0, who.dropped.1),
    );
    report.fact("refused", who.refused);
    report
}
