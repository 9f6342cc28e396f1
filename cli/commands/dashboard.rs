//! `carril dashboard`: the running graph in a browser of this machine, wherever the graph runs.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use carril_dashboard::server::{self, Options};
use carril_dashboard::foxglove;
use carril_runtime::control_plane::AccessLevel;
use carril_runtime::graph::remote::{DASHBOARD_PORT, FOXGLOVE_PORT};
use clap::Args;

use crate::common::interrupt;
use crate::common::output;
use crate::common::way::{self, Target};

/// Examples of `carril dashboard`.
pub const HELP: &str = "Only this machine can open it. A car whose graph has `remote:` serves it to others by itself.

Examples:
  carril dashboard --open
  carril dashboard --connect car.local --open
  carril dashboard --foxglove                      Foxglove connects to ws://127.0.0.1:8765";

const LOOK: Duration = Duration::from_millis(100);

/// Arguments of `carril dashboard`.
#[derive(Args)]
pub struct DashboardArgs {
    /// Port of this machine; 0 takes a free one [default: 8080, or a free one if that is taken]
    #[arg(long, value_name = "PORT")]
    port: Option<u16>,
    /// Open it in the browser
    #[arg(long)]
    open: bool,
    /// Serve Foxglove on this port too [default port: 8765]
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "8765")]
    foxglove: Option<u16>,
    /// Foxglove may set parameters. Its protocol has no keys and does not say which page connects: any page that is open in a browser
    /// of this machine could do the same
    #[arg(long, requires = "foxglove")]
    foxglove_control: bool,
    #[command(flatten)]
    target: Target,
}

/// Runs it.
pub fn run(args: &DashboardArgs) -> Result<()> {
    let client = Arc::new(way::connect(&args.target)?);
    let local = |port| SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), port);
    let start = |port| server::start(Arc::clone(&client), Options::local(local(port)));
    let server = match args.port {
        Some(port) => start(port)?,
        None => start(DASHBOARD_PORT).or_else(|_| start(0))?,
    };
    let url = format!("http://{}", server.address());
    let access = client.access();
    let may = if access.level == AccessLevel::Control { "control" } else { "read" };
    output::line(format_args!("robot `{}` at {url} ({may}: {}); Ctrl-C ends it", client.file().robot, access.why))?;
    let _foxglove = match args.foxglove {
        Some(port) => {
            let may_control = args.foxglove_control && access.level == AccessLevel::Control;
            let options = foxglove::Options { may_control, ..foxglove::Options::new(local(port)) };
            let server = foxglove::start(Arc::clone(&client), options)
                .with_context(|| format!("Foxglove on port {port} (its own is {FOXGLOVE_PORT})"))?;
            output::line(format_args!("foxglove at {}", server.url()))?;
            Some(server)
        }
        None => None,
    };
    if args.open {
        open(&url);
    }
    let stop = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&stop);
    interrupt::on_interrupt(move || told.store(true, Ordering::Relaxed))?;
    while !stop.load(Ordering::Relaxed) && client.supervisor_is_alive() {
        std::thread::sleep(LOOK);
    }
    let ended = !stop.load(Ordering::Relaxed);
    server.close(if ended { "the graph has ended" } else { "`carril dashboard` was ended" });
    anyhow::ensure!(!ended, "the graph of robot `{}` has ended", client.file().robot);
    Ok(())
}

/// In whatever this machine opens pages with. The address is on the screen in any case.
fn open(url: &str) {
    let opener = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let started = Command::new(opener).arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    if let Err(error) = started {
        eprintln!("warning: no browser could be opened ({opener}: {error}); open {url} yourself");
    }
}
