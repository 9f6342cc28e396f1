//! A running graph in Foxglove, live: ports as channels with well-known schemas where there are any, nodes and edges as the topic
//! graph, configurations as parameters. See docs/foxglove.md.
//!
//! It costs the graph nothing while nobody looks: a port is subscribed only while a viewer subscribes a channel of it, and without viewers
//! nothing is asked. It never queues without bound: samples are the newest ones, at a limited rate, and a slow viewer loses messages.

mod feed;
mod hub;
mod json;
mod parameters;
mod plan;
mod setting;
mod show;
mod watch;

use std::net::SocketAddr;
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use carril_messages::Stamp;
use carril_runtime::client::Client;
use carril_runtime::control_plane::LogLevel;
use foxglove::WebSocketServer;
use foxglove::websocket::Capability;
use thiserror::Error;
use tokio::runtime::Runtime;

use hub::{Hub, Listener};
use setting::Handler;
use watch::Watch;

/// So many messages wait for a viewer at most; then the oldest is dropped. Two seconds of images, a tenth of a second of everything.
const BACKLOG: usize = 32;
/// Viewers are told that the server ends for this long at most.
const FAREWELL: Duration = Duration::from_secs(1);

/// How the server shows the graph.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Where it listens. Port 0: any free one, see [`Server::address`].
    pub listen: SocketAddr,
    /// Whether viewers may set parameters. All of them or none: the protocol has no names and no passwords.
    pub may_control: bool,
    /// Images a second at most, of each port, > 0.
    pub image_hz: f64,
    /// Wider images are scaled down, px.
    pub image_max_width: u32,
    /// Of the JPEG compression, 1 to 100.
    pub image_quality: u8,
    /// Scans a second at most, of each port, > 0.
    pub scan_hz: f64,
    /// Samples of other types a second at most, of each port, > 0.
    pub other_hz: f64,
}

impl Options {
    /// With the usual rates, for looking only.
    pub fn new(listen: SocketAddr) -> Self {
        Self {
            listen,
            may_control: false,
            image_hz: 15.0,
            image_max_width: 640,
            image_quality: 75,
            scan_hz: 10.0,
            other_hz: 30.0,
        }
    }
}

/// Why there is no server.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FoxgloveError {
    /// Its threads cannot be started.
    #[error("the threads of the Foxglove server cannot be started: {0}")]
    Threads(#[source] std::io::Error),
    /// It cannot listen there.
    #[error(
        "the Foxglove server cannot listen on `{address}`: {reason}; choose another address or port, 0 is any free one"
    )]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why not.
        reason: foxglove::FoxgloveError,
    },
}

/// A server that runs. It ends when it is dropped.
pub struct Server {
    hub: Arc<Hub>,
    address: SocketAddr,
    watch: Option<JoinHandle<()>>,
    runtime: Option<Runtime>,
}

/// Starts a server for the graph that `client` has found. Call it from anywhere, also from asynchronous code.
pub fn start(client: Arc<Client>, options: Options) -> Result<Server, FoxgloveError> {
    let listen = options.listen;
    let robot = client.file().robot.clone();
    let hub = Arc::new(Hub::new(client, options));
    let watch = Watch::new(Arc::clone(&hub));
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("foxglove")
        .enable_all()
        .build()
        .map_err(FoxgloveError::Threads)?;
    let host = if listen.is_ipv6() { format!("[{}]", listen.ip()) } else { listen.ip().to_string() };
    let server = WebSocketServer::new()
        .name(format!("carril {robot}"))
        .context(&hub.context)
        .bind(host, listen.port())
        .capabilities([Capability::Parameters, Capability::ConnectionGraph])
        .message_backlog_size(BACKLOG)
        .listener(Arc::new(Listener(Arc::clone(&hub))))
        .parameter_handler(Arc::new(Handler::start(Arc::clone(&hub))));
    // Not `block_on`, which would panic in asynchronous code.
    let (tell, told) = mpsc::channel();
    runtime.spawn(async move {
        let _ = tell.send(server.start().await);
    });
    let started = told.recv().map_err(|_| FoxgloveError::Threads(std::io::Error::other("the start was given up")));
    let started =
        started.and_then(|started| started.map_err(|reason| FoxgloveError::Listen { address: listen, reason }));
    let handle = match started {
        Ok(handle) => handle,
        Err(error) => {
            runtime.shutdown_background();
            return Err(error);
        }
    };
    let address = SocketAddr::new(listen.ip(), handle.port());
    // There was no server yet to take it when the graph was first read.
    let _ = handle.publish_connection_graph(watch.connections());
    *hub::lock(&hub.server) = Some(handle);
    // Who has connected meanwhile rang for nobody.
    hub.ring(|wants| wants.look = true);
    let mut server = Server { hub, address, watch: None, runtime: Some(runtime) };
    let watch = std::thread::Builder::new().name("foxglove-watch".into()).spawn(move || watch.run());
    server.watch = Some(watch.map_err(FoxgloveError::Threads)?);
    Ok(server)
}

impl Server {
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What to type into Foxglove's "Open connection", from the same machine.
    pub fn url(&self) -> String {
        let mut address = self.address;
        if address.ip().is_unspecified() {
            let local: std::net::IpAddr = if address.is_ipv4() {
                std::net::Ipv4Addr::LOCALHOST.into()
            } else {
                std::net::Ipv6Addr::LOCALHOST.into()
            };
            address.set_ip(local);
        }
        format!("ws://{address}")
    }

    /// How many viewers are connected.
    pub fn viewers(&self) -> usize {
        self.hub.viewers()
    }

    /// Shows a line beside those of the run's log. `time` is on the car's clock, `name` says whose line it is.
    pub fn log(&self, time: Stamp, level: LogLevel, name: &str, text: &str) {
        self.hub.log(time, level, name, text);
    }

    /// Ends it: viewers are told, subscriptions end.
    pub fn stop(self) {
        drop(self);
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.hub.ring(|wants| wants.stop = true);
        let handle = hub::lock(&self.hub.server).take();
        if let (Some(handle), Some(runtime)) = (handle, &self.runtime) {
            let (tell, told) = mpsc::channel();
            runtime.spawn(async move {
                handle.stop().wait().await;
                let _ = tell.send(());
            });
            let _ = told.recv_timeout(FAREWELL);
        }
        if let Some(watch) = self.watch.take() {
            let _ = watch.join();
        }
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}
