//! `carril doctor`: why a car cannot be reached, or only looked at. Each check says what it found and what to do.

use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Result;
use carril_dashboard::access::{KeyFile, config_dir};
use carril_dashboard::gateway::addresses;
use carril_messages::Stamp;
use carril_runtime::client::{Client, find_run_here};
use carril_runtime::control_plane::AccessLevel;
use carril_runtime::transport::zenoh::FarOptions;
use clap::Args;
use serde::Serialize;

use crate::common::output;
use crate::common::profiles::Profiles;
use crate::common::way::{self, SCOUTING_VARIABLE, Target};

/// A port answers within this time, if at all.
const PORT_PATIENCE: Duration = Duration::from_secs(2);
/// A larger difference between the clocks is worth a word: recordings of both machines will not fit together.
const CLOCK_DIFFERENCE: Duration = Duration::from_secs(1);
/// A slower round trip makes driving by hand hard.
const SLOW_ROUND_TRIP: Duration = Duration::from_millis(60);

/// Arguments of `carril doctor`.
#[derive(Args)]
#[command(after_help = "Exit code 1 when something does not work.

Examples:
  carril doctor                          what runs here, which cars answer, which are known
  carril doctor --connect car.local      the way to one car, step by step")]
pub struct DoctorArgs {
    /// JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// One thing that was looked at.
#[derive(Serialize)]
struct Finding {
    what: String,
    outcome: Outcome,
    found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    hint: Option<String>,
}

#[derive(Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Outcome {
    Works,
    Note,
    Fails,
}

#[derive(Default)]
struct Findings(Vec<Finding>);

impl Findings {
    fn add(&mut self, outcome: Outcome, what: &str, found: impl Into<String>, hint: Option<&str>) {
        self.0.push(Finding { what: what.into(), outcome, found: found.into(), hint: hint.map(str::to_owned) });
    }

    fn works(&mut self, what: &str, found: impl Into<String>) {
        self.add(Outcome::Works, what, found, None);
    }

    fn note(&mut self, what: &str, found: impl Into<String>, hint: &str) {
        self.add(Outcome::Note, what, found, Some(hint));
    }

    fn fails(&mut self, what: &str, found: impl Into<String>, hint: &str) {
        self.add(Outcome::Fails, what, found, Some(hint));
    }
}

/// Runs it.
pub fn run(args: &DoctorArgs) -> Result<ExitCode> {
    let mut findings = Findings::default();
    this_machine(&mut findings);
    let cars = scouting(&mut findings);
    let endpoint = args.target.endpoint()?;
    let profiles = Profiles::read();
    let known = match &args.target.robot {
        Some(robot) => profiles.of(robot),
        None => profiles.iter().map(|(_, profile)| profile).next(),
    };
    for (robot, profile) in profiles.iter() {
        let key = if profile.key.is_some() { "with a key" } else { "without a key: only to look on" };
        findings.works("known car", format!("`{robot}` at {} {key}", profile.endpoint));
    }
    let endpoint = endpoint.or_else(|| known.map(|profile| profile.endpoint.clone())).or(cars);
    match endpoint {
        Some(endpoint) => car(&args.target, &endpoint, &mut findings)?,
        None => findings.note(
            "way to a car",
            "no car to look at: none was named, none is known, none answered",
            "carril doctor --connect HOST",
        ),
    }
    if args.json {
        output::json(&findings.0)?;
    } else {
        for finding in &findings.0 {
            let mark = match finding.outcome {
                Outcome::Works => "ok   ",
                Outcome::Note => "note ",
                Outcome::Fails => "FAILS",
            };
            output::line(format_args!("{mark} {:<14} {}", finding.what, finding.found))?;
            if let Some(hint) = &finding.hint {
                output::line(format_args!("{:<21}hint: {hint}", ""))?;
            }
        }
    }
    let failed = findings.0.iter().any(|finding| finding.outcome == Outcome::Fails);
    Ok(if failed { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

fn this_machine(findings: &mut Findings) {
    findings.works("version", format!("carril {}", env!("CARGO_PKG_VERSION")));
    let addresses = addresses::addresses();
    let list = |loopback: bool| {
        let some = addresses.iter().filter(|ip| ip.is_loopback() == loopback);
        some.map(ToString::to_string).collect::<Vec<_>>().join(", ")
    };
    let names = addresses::names().join(", ");
    if list(false).is_empty() {
        findings.fails("addresses", format!("{names}: only {}", list(true)), "connect this machine to a network");
    } else {
        findings.works("addresses", format!("{names}: {}", list(false)));
    }
    match find_run_here(None) {
        Ok(run) => findings.works("runs here", format!("robot `{}`, {}", run.robot, run.graph.display())),
        Err(error) => findings.add(Outcome::Note, "runs here", error.to_string(), None),
    }
    findings.works("settings", config_dir().display().to_string());
}

/// Looks for cars. An endpoint of the first that answers.
fn scouting(findings: &mut Findings) -> Option<String> {
    let interface = std::env::var(SCOUTING_VARIABLE).unwrap_or_else(|_| "auto".into());
    if interface == "off" {
        findings.note("scouting", format!("is off ({SCOUTING_VARIABLE}=off)"), "unset it, or name cars with --connect");
        return None;
    }
    match way::look_around() {
        Ok(found) if found.is_empty() => {
            findings.note(
                "scouting",
                format!("nobody answers on `{interface}` (multicast 224.0.0.224, UDP port 7446)"),
                "many access points block multicast between their clients: --connect HOST works all the same",
            );
            None
        }
        Ok(found) => {
            for car in &found {
                findings.works("scouting", format!("{} answers: {}", car.identity, car.endpoints.join(", ")));
            }
            found.iter().find_map(|car| way::reader_endpoints(car).first().map(|endpoint| (*endpoint).to_owned()))
        }
        Err(error) => {
            findings.fails(
                "scouting",
                error.to_string(),
                "set CARRIL_SCOUTING to the network interface of the car's network",
            );
            None
        }
    }
}

/// The way to one car, step by step.
fn car(target: &Target, endpoint: &str, findings: &mut Findings) -> Result<()> {
    let address = endpoint.trim_start_matches("tcp/");
    let Some(addresses) = resolve(address, findings) else { return Ok(()) };
    let key = match &target.key {
        Some(path) => Some(KeyFile::read(path)?),
        None => way::key_for(target, endpoint),
    };
    let with_key = way::with_key(endpoint);
    let reads = port("port (readers)", &addresses, findings);
    let key_port = addresses.iter().map(|at| SocketAddr::new(at.ip(), at.port().saturating_add(1))).collect::<Vec<_>>();
    let controls = port("port (keys)", &key_port, findings);
    if reads {
        session("session", &FarOptions { endpoint: endpoint.to_owned(), identity: None }, None, target, findings);
    }
    match key {
        Some(key) if controls => {
            let options = FarOptions { endpoint: with_key, identity: Some(key.identity()) };
            session("with the key", &options, Some(&key), target, findings);
        }
        Some(_) => {}
        None => findings.note(
            "key",
            "none for this car: it can be looked at, and stopped",
            "on the car: carril grant --control NAME",
        ),
    }
    Ok(())
}

fn resolve(address: &str, findings: &mut Findings) -> Option<Vec<SocketAddr>> {
    match address.to_socket_addrs().map(Iterator::collect::<Vec<_>>) {
        Ok(addresses) if !addresses.is_empty() => {
            let shown = addresses.iter().map(|at| at.ip().to_string()).collect::<Vec<_>>().join(", ");
            findings.works("name", format!("{address} is {shown}"));
            Some(addresses)
        }
        Ok(_) => {
            findings.fails(
                "name",
                format!("{address} has no address"),
                "use the address that `carril run` prints on the car",
            );
            None
        }
        Err(error) => {
            findings.fails(
                "name",
                format!("{address}: {error}"),
                "names that end in .local need mDNS (avahi) on both machines; use the address that `carril run` prints on the car",
            );
            None
        }
    }
}

fn port(what: &str, addresses: &[SocketAddr], findings: &mut Findings) -> bool {
    let mut last = String::new();
    for address in addresses {
        let asked = Instant::now();
        match TcpStream::connect_timeout(address, PORT_PATIENCE) {
            Ok(_) => {
                findings.works(what, format!("{address} answers after {:.1} ms", asked.elapsed().as_secs_f64() * 1e3));
                return true;
            }
            Err(error) => last = format!("{address}: {error}"),
        }
    }
    findings.fails(
        what,
        last,
        "refused: no gateway runs there (does the graph have `remote:`?); no answer: another network, a firewall, or the car is off",
    );
    false
}

fn session(what: &str, options: &FarOptions, key: Option<&KeyFile>, target: &Target, findings: &mut Findings) {
    let robot = target.robot.as_deref();
    let id = key.map(|key| key.id.as_str());
    let client = match Client::open_far(options, id, robot, PORT_PATIENCE) {
        Ok(client) => client,
        Err(error) => {
            let hint = if key.is_some() {
                "the key is of another car, or the car's keys were made anew: carril grant --control NAME, on the car"
            } else {
                "something else listens there, or another version of carril"
            };
            return findings.fails(what, error.to_string(), hint);
        }
    };
    let run = client.file();
    findings.works(what, format!("robot `{}`, {} nodes, {}", run.robot, run.nodes.len(), run.graph.display()));
    if key.is_none() {
        round_trip(&client, findings);
        clocks(&client, findings);
    }
    let access = client.access();
    match access.level {
        AccessLevel::Control => findings.works("access", format!("control: {}", access.why)),
        AccessLevel::Read if key.is_some() => {
            findings.fails("access", access.why, "on the car: carril grant --control NAME");
        }
        AccessLevel::Read => findings.works("access", "read"),
    }
}

fn round_trip(client: &Client, findings: &mut Findings) {
    let mut times: Vec<Duration> = Vec::new();
    for _ in 0..10 {
        let asked = Instant::now();
        if client.graph().is_ok() {
            times.push(asked.elapsed());
        }
    }
    times.sort();
    let Some(median) = times.get(times.len() / 2) else {
        return findings.fails("round trip", "the car does not answer", "see `carril run` on the car");
    };
    let worst = times.last().map_or(0.0, |time| time.as_secs_f64() * 1e3);
    let found = format!("{:.1} ms, at worst {worst:.1} ms of {} tries", median.as_secs_f64() * 1e3, times.len());
    if *median > SLOW_ROUND_TRIP {
        findings.note("round trip", found, "too slow to drive by hand; come nearer, or use the 5 GHz band");
    } else {
        findings.works("round trip", found);
    }
}

fn clocks(client: &Client, findings: &mut Findings) {
    let here = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    let offset = client.clock().now().since(Stamp::ZERO + here);
    let seconds = offset.as_secs_f64();
    let found =
        format!("the car's is {:.3} s {} ours", seconds.abs(), if seconds < 0.0 { "behind" } else { "ahead of" });
    if seconds.abs() > CLOCK_DIFFERENCE.as_secs_f64() {
        findings.note(
            "clocks",
            found,
            "carril does not mind; recordings of other programs will: set the car's clock (chrony, date)",
        );
    } else {
        findings.works("clocks", found);
    }
}
