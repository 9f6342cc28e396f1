//! `carril gateway`: serves the running graph of this machine to others. `carril run` starts it when the graph has `remote:`.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Result, bail};
use carril_dashboard::access::config_dir;
use carril_dashboard::gateway::{Gateway, Options, addresses, refusals};
use carril_dashboard::{foxglove, server};
use carril_runtime::client::Client;
use carril_runtime::graph::remote::{Remote, address};
use carril_runtime::process::die_with;
use clap::Args;
use serde::{Deserialize, Serialize};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use crate::common::interrupt;
use crate::common::output;

/// Examples of `carril gateway`.
pub const HELP: &str = "Readers need no key; control needs one of `carril grant`. Ends with the graph, or with Ctrl-C.

Examples:
  carril gateway                                   a graph without `remote:` can be seen from other machines
  carril gateway --listen 127.0.0.1:7447           only from this one: for trying it out";

/// The run is looked up this often.
const LOOK: Duration = Duration::from_millis(100);

/// Arguments of `carril gateway`.
#[derive(Args)]
pub struct GatewayArgs {
    /// Which robot, where several graphs run
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// Where readers connect; holders of a key use the next port [default: 0.0.0.0:7447]
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<String>,
    /// Where the dashboard is served, or `off` [default: 0.0.0.0:8080]
    #[arg(long, value_name = "ADDRESS")]
    dashboard: Option<String>,
    /// Where Foxglove connects, or `off` [default: off]
    #[arg(long, value_name = "ADDRESS")]
    foxglove: Option<String>,
    /// Network interface on which to answer those who look for cars, `auto` or `off` [default: auto]
    #[arg(long, value_name = "INTERFACE")]
    scouting: Option<String>,
    /// All of it as the graph says, in JSON
    #[arg(long, value_name = "JSON", hide = true)]
    remote: Option<String>,
    /// Where it can be reached, as one JSON object
    #[arg(long)]
    json: bool,
}

impl GatewayArgs {
    fn remote(&self) -> Result<Remote> {
        let mut remote = match &self.remote {
            Some(text) => serde_json::from_str(text)?,
            None => Remote::default(),
        };
        let read = |name: &str, text: &Option<String>| match text.as_deref().map(address) {
            None => Ok(None),
            Some(Ok(address)) => Ok(Some(address)),
            Some(Err(message)) => bail!("--{name}: {message}"),
        };
        match read("listen", &self.listen)? {
            Some(Some(listen)) => remote.listen = listen,
            Some(None) => bail!("--listen: got `off`; without a gateway there is nothing to start"),
            None => {}
        }
        if let Some(dashboard) = read("dashboard", &self.dashboard)? {
            remote.dashboard = dashboard;
        }
        if let Some(foxglove) = read("foxglove", &self.foxglove)? {
            remote.foxglove = foxglove;
        }
        if let Some(interface) = &self.scouting {
            remote.scouting = (interface != "off").then(|| interface.clone());
        }
        Ok(remote)
    }
}

/// Where a car can be reached: what the gateway tells `carril run`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Reachable {
    /// The car's names.
    pub names: Vec<String>,
    /// Where readers connect.
    pub readers: Vec<String>,
    /// Where holders of a key connect.
    pub control: Vec<String>,
    /// Addresses of the dashboard in a browser.
    pub dashboard: Vec<String>,
    /// Where Foxglove connects.
    pub foxglove: Vec<String>,
    /// SHA-256 of the certificate that the car shows.
    pub fingerprint: String,
    /// What does not work, though it was asked for.
    pub problems: Vec<String>,
}

impl Reachable {
    /// For people.
    pub fn text(&self) -> String {
        let mut lines = Vec::new();
        let mut fact = |name: &str, values: &[String]| {
            if !values.is_empty() {
                lines.push(format!("{name:<12} {}", values.join("  ")));
            }
        };
        let connect = |endpoints: &[String]| {
            endpoints.iter().map(|at| format!("carril list --connect {at}")).take(1).collect::<Vec<_>>()
        };
        fact("dashboard", &self.dashboard);
        fact("tools", &connect(&self.readers));
        fact("readers", &self.readers);
        fact("with a key", &self.control);
        fact("foxglove", &self.foxglove);
        lines.push(format!("{:<12} SHA-256 {}", "certificate", self.fingerprint));
        lines.extend(self.problems.iter().map(|problem| format!("warning: {problem}")));
        lines.join("\n")
    }
}

/// Runs it.
pub fn run(args: &GatewayArgs) -> Result<()> {
    let (refusal_layer, refusals) = refusals::layer();
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_target(false)
        .without_time()
        .with_ansi(false);
    let log = log.with_filter(crate::log_filter("info,zenoh=off"));
    tracing_subscriber::registry().with(log).with(refusal_layer).init();

    let remote = args.remote()?;
    // Whatever it does, the car's own processes come first.
    give_way();
    let client = Arc::new(Client::connect_to_stand_in(args.robot.as_deref())?);
    if args.remote.is_some() {
        // The run has started it. A tool that watches the run must not keep it alive.
        die_with(client.file().pid)?;
    }
    let options = Options { remote: remote.clone(), config_dir: config_dir() };
    let gateway = Gateway::start(&client, options, refusals)?;
    let mut reachable = reachable(&gateway);
    let servers = Servers::start(&client, &gateway, &remote, &mut reachable);
    if args.json {
        output::json_line(&reachable)?;
    } else {
        output::line(reachable.text())?;
    }
    let stop = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&stop);
    interrupt::on_interrupt(move || told.store(true, Ordering::Relaxed))?;
    while !stop.load(Ordering::Relaxed) && client.supervisor_is_alive() {
        std::thread::sleep(LOOK);
    }
    servers.close();
    drop(gateway);
    Ok(())
}

/// What is served beside Zenoh. One that cannot listen is told of and does without: the others do not fall with it.
struct Servers {
    dashboard: Option<server::Server>,
    foxglove: Option<foxglove::Server>,
}

impl Servers {
    fn start(client: &Arc<Client>, gateway: &Gateway, remote: &Remote, reachable: &mut Reachable) -> Self {
        let shared = gateway.shared();
        let dashboard = remote.dashboard.and_then(|listen| {
            let options = server::Options {
                listen,
                access: Some(Arc::clone(&shared.access)),
                local_control: true,
                read_for_all: remote.read_for_all,
                estop_for_all: remote.estop_for_all,
                certificate: shared.identity().ok().map(|(identity, _)| identity),
            };
            let started = server::start(Arc::clone(client), options);
            started.inspect_err(|error| reachable.problems.push(error.to_string())).ok()
        });
        if let Some(server) = &dashboard {
            let address = server.address();
            let host = |at: SocketAddr| format!("http://{at}");
            reachable.dashboard = addresses::reachable(address).into_iter().map(host).collect();
            shared.add_server(format!("http(s)://{address}"), server.connected_later());
        }
        // Foxglove's protocol has no keys: whoever connects may look, and nobody may set anything.
        let foxglove = remote.foxglove.and_then(|listen| {
            let options = foxglove::Options { may_control: false, ..foxglove::Options::new(listen) };
            let started = foxglove::start(Arc::clone(client), options);
            started.inspect_err(|error| reachable.problems.push(error.to_string())).ok()
        });
        if let Some(server) = &foxglove {
            reachable.foxglove =
                addresses::reachable(server.address()).into_iter().map(|at| format!("ws://{at}")).collect();
            shared.add_server(server.url(), Vec::new);
        }
        Self { dashboard, foxglove }
    }

    fn close(self) {
        if let Some(dashboard) = self.dashboard {
            dashboard.close("the graph has ended");
        }
        drop(self.foxglove);
    }
}

fn give_way() {
    let pid = nix::unistd::getpid();
    tracing::debug!("gateway in process {pid}");
    if let Err(error) = thread_priority::set_current_thread_priority(thread_priority::ThreadPriority::Min) {
        tracing::debug!("the gateway keeps its priority: {error:?}");
    }
}

fn reachable(gateway: &Gateway) -> Reachable {
    let of = |scheme: &str| -> Vec<String> {
        let bound = gateway.endpoints();
        let addresses = bound
            .iter()
            .filter_map(|endpoint| endpoint.strip_prefix(scheme)?.strip_prefix('/')?.parse::<SocketAddr>().ok());
        let mut all: Vec<SocketAddr> = addresses.flat_map(addresses::reachable).collect();
        all.sort_by_key(|address| (address.ip().is_loopback(), *address));
        all.dedup();
        all.iter().map(|address| format!("{scheme}/{address}")).collect()
    };
    Reachable {
        names: addresses::names(),
        readers: of("tcp"),
        control: of("tls"),
        fingerprint: gateway.fingerprint(),
        ..Reachable::default()
    }
}
