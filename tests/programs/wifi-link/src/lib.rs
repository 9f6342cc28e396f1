//! An emulated Wi-Fi link between two network namespaces, for tests and benchmarks: a car and a laptop on one machine.
//!
//! ```no_run
//! use wifi_link::{Conditions, LinkError, WifiLink};
//!
//! let link = match WifiLink::new(Conditions::good()) {
//!     Ok(link) => link,
//!     Err(LinkError::NotPossible(reason)) => return println!("skipped: {reason}"),
//!     Err(error) => panic!("{error}"),
//! };
//! link.car().command("carril").args(["run", "dataflow.yaml"]).spawn().unwrap();
//! link.cut();
//! ```
//!
//! Each namespace has loopback, and a TUN device `wifi0` with an address, which also carries multicast. A thread passes packets
//! between the two devices as the [`schedule`] says. Nothing else connects the two namespaces, nor do they reach anything else.
//! They share the file system, except that commands of a [`Host`] have a `/dev/shm` of their own.

mod conditions;
mod kernel;
mod namespace;
mod relay;
pub mod schedule;

use std::ffi::OsStr;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

pub use conditions::{Conditions, Medium, Queue};
use namespace::Namespace;
use relay::Relay;
use schedule::Schedule;
pub use schedule::{Counters, Direction};

/// Why there is no link.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// This machine or this user cannot have one; tests skip.
    #[error("an emulated Wi-Fi link is not possible here: {0}")]
    NotPossible(String),
    /// The conditions contradict themselves.
    #[error("no link is like this: {0}")]
    BadConditions(String),
    /// It should have been possible.
    #[error("{step} failed: {got}")]
    Setup {
        /// What was done.
        step: String,
        /// What the kernel or `ip` said.
        got: String,
    },
}

/// One end of the link.
pub struct Host {
    namespace: Namespace,
    address: Ipv4Addr,
}

impl Host {
    fn new(index: u32, host: &str, address: Ipv4Addr) -> Result<Self, LinkError> {
        Ok(Self { namespace: Namespace::new(&namespace::name_of(index, host))?, address })
    }

    /// The address on the link.
    pub fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// The name of the namespace, for `ip netns exec`.
    pub fn namespace(&self) -> &str {
        &self.namespace.name
    }

    /// A command that runs on this host: in its network, and with a `/dev/shm` that only commands of this host share. It ends
    /// when it ends, not with the link.
    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        self.namespace.command(program.as_ref())
    }

    /// Runs a function on this host, in a thread of its own. Sockets that it opens stay on this host.
    pub fn inside<T: Send>(&self, run: impl FnOnce() -> T + Send) -> Result<T, LinkError> {
        self.namespace.inside(run).map_err(|error| LinkError::Setup {
            step: format!("entering the namespace `{}`", self.namespace.name),
            got: error.to_string(),
        })
    }
}

/// A running link. Dropping it removes the namespaces; what a killed process leaves is removed by the next link.
pub struct WifiLink {
    // The relay goes first: it holds the devices of the namespaces.
    relay: Relay,
    car: Host,
    laptop: Host,
}

impl WifiLink {
    /// Makes the namespaces and begins to relay.
    pub fn new(conditions: Conditions) -> Result<Self, LinkError> {
        static LINKS: AtomicU32 = AtomicU32::new(0);
        conditions.check()?;
        probe()?;
        namespace::remove_leftovers();
        let index = LINKS.fetch_add(1, Ordering::Relaxed);
        // The namespaces of two links never meet, so equal subnets would do no harm; different ones are easier to tell apart.
        let subnet = (std::process::id().wrapping_add(index) % 254) as u8 + 1;
        let car = Host::new(index, "car", Ipv4Addr::new(10, 87, subnet, 1))?;
        let laptop = Host::new(index, "laptop", Ipv4Addr::new(10, 87, subnet, 2))?;
        let devices = [car.namespace.add_tun(car.address)?, laptop.namespace.add_tun(laptop.address)?];
        let relay = Relay::start(Schedule::new(conditions), devices)
            .map_err(|error| LinkError::Setup { step: "starting the relay".into(), got: error.to_string() })?;
        Ok(Self { relay, car, laptop })
    }

    /// The end with address .1.
    pub fn car(&self) -> &Host {
        &self.car
    }

    /// The end with address .2.
    pub fn laptop(&self) -> &Host {
        &self.laptop
    }

    /// From now on other conditions hold, also for what waits.
    pub fn set(&self, conditions: Conditions) -> Result<(), LinkError> {
        conditions.check()?;
        self.relay.with(|schedule, now| schedule.set(now, conditions));
        Ok(())
    }

    /// What holds now.
    pub fn conditions(&self) -> Conditions {
        self.relay.with(|schedule, _| schedule.conditions().clone())
    }

    /// Begins an outage: when this returns, nothing passes any more, also nothing that was under way.
    pub fn cut(&self) {
        self.relay.with(Schedule::cut);
    }

    /// Ends every outage that has begun.
    pub fn restore(&self) {
        self.relay.with(Schedule::restore);
    }

    /// Plans an outage, from `after` from now and for `length`.
    pub fn plan_outage(&self, after: Duration, length: Duration) {
        self.relay.with(|schedule, now| {
            let begin = now.saturating_add(after);
            schedule.outage(begin, begin.saturating_add(length));
        });
    }

    /// Whether an outage holds now.
    pub fn is_cut(&self) -> bool {
        self.relay.with(|schedule, now| schedule.is_cut(now))
    }

    /// What became of the packets of a direction so far.
    pub fn counters(&self, direction: Direction) -> Counters {
        self.relay.with(|schedule, now| schedule.counters(now, direction))
    }

    /// Why it relays no longer; `None` while it does. Only what happens from outside brings this about: somebody removes the device.
    pub fn failure(&self) -> Option<String> {
        self.relay.failure()
    }
}

/// Says early, and in words, what is missing.
fn probe() -> Result<(), LinkError> {
    let not_possible = |reason: String| Err(LinkError::NotPossible(reason));
    if !nix::unistd::geteuid().is_root() {
        return not_possible("network namespaces need root; run it with sudo".into());
    }
    if !Path::new(kernel::TUN_PATH).exists() {
        return not_possible(format!(
            "there is no {}; load the module (`modprobe tun`), or give the container the device (`--device {}`)",
            kernel::TUN_PATH,
            kernel::TUN_PATH
        ));
    }
    if let Err(error) = Command::new("ip").arg("-V").output() {
        return not_possible(format!("`ip` cannot be run ({error}); install the package iproute2"));
    }
    Ok(())
}
