//! The dashboard's server: the page, and everything that `dashboard/protocol.md` has between it and a run. It runs on the car, beside the
//! gateway, or on a laptop with a client of its own. Browsers look on from anywhere; control is for those who have it.

mod doors;
mod graph;
mod house;
mod hub;
mod messages;
mod news;
mod origin;
mod outbox;
mod pacer;
mod page;
mod press;
mod requests;
mod routes;
mod sessions;
mod view;
mod viewer;
mod wheel;

use std::net::SocketAddr;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

use axum::extract::ConnectInfo;
use axum::{Extension, Router};
use carril_runtime::client::Client;
use carril_runtime::control_plane::Connected;
use carril_runtime::transport::zenoh::Identity;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::runtime::{Builder, Runtime};

use crate::access::Access;
use doors::{CertificateError, Doors, Shown};
use house::House;

/// Viewers are told goodbye within this time.
const GOODBYE: Duration = Duration::from_secs(2);
/// The headers of a request come within this time, so that a place is not kept by somebody who never ends.
const HEADERS: Duration = Duration::from_secs(10);
/// Threads that serve; images and the wheel have their own.
const THREADS: usize = 2;

/// Why there is no server.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServerError {
    /// It cannot listen.
    #[error("the dashboard cannot listen on `{listen}`: {reason}")]
    Listen {
        /// Where.
        listen: SocketAddr,
        /// Why not.
        reason: std::io::Error,
    },
    /// It has no threads.
    #[error("the dashboard cannot start: {0}")]
    Start(std::io::Error),
    /// Its certificate is none.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
}

/// How a dashboard is served.
#[derive(Clone)]
pub struct Options {
    /// Where to listen.
    pub listen: SocketAddr,
    /// The keys of the car. `None`: nobody can log in here.
    pub access: Option<Arc<RwLock<Access>>>,
    /// Those on this machine may do all that the client itself may.
    pub local_control: bool,
    /// Anybody may look on; otherwise only holders of a key.
    pub read_for_all: bool,
    /// Anybody may say `estop`; otherwise only holders of a key.
    pub estop_for_all: bool,
    /// For TLS, on the same port.
    pub certificate: Option<Identity>,
}

impl Options {
    /// On this machine, for this machine.
    pub fn local(listen: SocketAddr) -> Self {
        Self { listen, access: None, local_control: true, read_for_all: true, estop_for_all: true, certificate: None }
    }
}

/// A running server. It ends when it is dropped.
pub struct Server {
    house: Arc<House>,
    shown: Shown,
    address: SocketAddr,
    runtime: Option<Runtime>,
}

/// Starts a server for a run.
pub fn start(client: Arc<Client>, options: Options) -> Result<Server, ServerError> {
    let acceptor = options.certificate.as_ref().map(doors::acceptor).transpose()?;
    let shown: Shown = Arc::new(RwLock::new(acceptor));
    let mut builder = Builder::new_multi_thread();
    let runtime = builder.worker_threads(THREADS).thread_name("dashboard").enable_all().build();
    let runtime = runtime.map_err(ServerError::Start)?;
    let listen = options.listen;
    let house = Arc::new(House::new(client, options).map_err(ServerError::Start)?);
    let doors = {
        let _inside = runtime.enter();
        Doors::open(listen, Arc::clone(&shown)).map_err(|reason| ServerError::Listen { listen, reason })?
    };
    let address = doors.address();
    runtime.spawn(serve(doors, routes::router(Arc::clone(&house))));
    runtime.spawn(news::keep_graph(Arc::clone(&house)));
    runtime.spawn(news::keep_access(Arc::clone(&house)));
    Ok(Server { house, shown, address, runtime: Some(runtime) })
}

/// Serves whoever comes, each on a task of its own.
async fn serve(mut doors: Doors, routes: Router) {
    let mut http = hyper::server::conn::http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(HEADERS);
    while let Some((connection, peer)) = doors.next().await {
        let routes = TowerToHyperService::new(routes.clone().layer(Extension(ConnectInfo(peer))));
        let served = http.serve_connection(TokioIo::new(connection), routes).with_upgrades();
        tokio::spawn(async move {
            if let Err(error) = served.await {
                tracing::debug!("{}: {error}", peer.address);
            }
        });
    }
}

impl Server {
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Who looks on.
    pub fn connected(&self) -> Vec<Connected> {
        self.house.connected()
    }

    /// Who looks on, for as long as the server is there: for `carril who`.
    pub fn connected_later(&self) -> impl Fn() -> Vec<Connected> + Send + 'static {
        let house = Arc::downgrade(&self.house);
        move || house.upgrade().map(|house| house.connected()).unwrap_or_default()
    }

    /// How many ports of the graph it listens to: none while nobody looks.
    pub fn listening_to(&self) -> usize {
        self.house.hub.listening_to()
    }

    /// Shows another certificate from now on: the machine has other addresses.
    pub fn show(&self, certificate: &Identity) -> Result<(), ServerError> {
        let acceptor = doors::acceptor(certificate)?;
        *self.shown.write().unwrap_or_else(PoisonError::into_inner) = Some(acceptor);
        self.house.has_certificate.store(true, Ordering::Relaxed);
        Ok(())
    }

    /// Ends it, and says why to those who look on.
    pub fn close(self, reason: &str) {
        self.house.end.send_replace(Some(reason.to_owned()));
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.house.end.send_if_modified(|reason| {
            let silent = reason.is_none();
            reason.get_or_insert_with(|| "the server has ended".into());
            silent
        });
        let begun = Instant::now();
        while !self.house.is_quiet() && begun.elapsed() < GOODBYE {
            std::thread::sleep(Duration::from_millis(5));
        }
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(GOODBYE);
        }
    }
}
