//! Links that leave the machine: the gateway's side and that of a tool far away.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ::zenoh::Wait;
use ::zenoh::config::WhatAmI;
use ::zenoh::qos::{CongestionControl, Priority};
use ::zenoh::sample::Locality;
use carril_messages::{Header, Key, Payload};

use super::config::{self, FarOptions, GatewayOptions};
use super::{ZenohOptions, ZenohTransport, failed, open};
use crate::transport::{Guard, Transport, TransportError, knock};

/// Something that answered when cars were looked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// Its identity on its links.
    pub identity: String,
    /// Where it listens, as Zenoh endpoints.
    pub endpoints: Vec<String>,
}

/// One link of a gateway to somebody.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Viewer {
    /// The other's identity; it says so itself, so it proves nothing.
    pub identity: String,
    /// The other's address, as a Zenoh endpoint.
    pub address: String,
    /// The name in its certificate, proven. `None`: a reader without a key.
    pub name: Option<String>,
}

/// What a gateway publishes to the outside.
pub struct FarPublisher {
    publisher: ::zenoh::pubsub::Publisher<'static>,
    wanted: Arc<AtomicBool>,
    _listener: Guard,
}

/// Publishes in the place of a node that is elsewhere.
pub struct StandIn {
    transport: ZenohTransport,
    port: Key,
    wanted: Arc<AtomicBool>,
    /// Tells who reads; samples go past it, through shared memory where they are large.
    _publisher: ::zenoh::pubsub::Publisher<'static>,
    _listener: Guard,
}

/// Looks for cars by multicast for so long.
pub fn scout(interface: &str, patience: Duration) -> Result<Vec<Found>, TransportError> {
    let doing = || "looking for cars by multicast";
    let scout = ::zenoh::scout(WhatAmI::Router, config::scout(interface)?).wait().map_err(failed(doing()))?;
    let deadline = Instant::now() + patience;
    let mut found: Vec<Found> = Vec::new();
    while let Ok(Some(hello)) = scout.recv_deadline(deadline) {
        let identity = hello.zid().to_string();
        if !found.iter().any(|known| known.identity == identity) {
            found.push(Found { identity, endpoints: hello.locators().iter().map(ToString::to_string).collect() });
        }
    }
    scout.stop();
    Ok(found)
}

impl ZenohTransport {
    /// Opens a session that listens to the outside.
    pub fn open_gateway(options: &GatewayOptions) -> Result<Self, TransportError> {
        let doing = match options.listen {
            Some(address) => format!("listening on `{address}` and `{}`", options.listen_tls),
            None => format!("listening on `{}`", options.listen_tls),
        };
        let (runtime, session) = open(config::gateway(options)?).map_err(failed(doing))?;
        Ok(Self::on(session, runtime, ZenohOptions::default()))
    }

    /// Opens a session with the gateway of a car far away. Returns at once; the link comes up in the background, and comes back.
    pub fn open_far(options: &FarOptions) -> Result<Self, TransportError> {
        let doing = format!("connecting to `{}`", options.endpoint);
        let (runtime, session) =
            open(config::far(options, knock::round_trip(&options.endpoint))?).map_err(failed(doing))?;
        Ok(Self::on(session, runtime, ZenohOptions::default()))
    }

    /// Where this process can be reached, as Zenoh endpoints.
    pub fn endpoints(&self) -> Vec<String> {
        let locators = self.0.runtime.get_locators();
        locators.iter().map(|locator| format!("{}/{}", locator.protocol(), locator.address())).collect()
    }

    /// Who is linked to this process.
    pub fn viewers(&self) -> Vec<Viewer> {
        let links = self.0.session.info().links().wait();
        let viewer = |link: ::zenoh::session::Link| Viewer {
            identity: link.zid().to_string(),
            address: format!("{}/{}", link.dst().protocol(), link.dst().address()),
            name: link.auth_identifier().map(str::to_owned),
        };
        links.map(viewer).collect()
    }

    /// Publishes in the place of a node that is elsewhere, to readers in this process too.
    pub fn stand_in(&self, port: &Key) -> Result<StandIn, TransportError> {
        let publisher = self.0.session.declare_publisher(port.to_string());
        let publisher = publisher.wait().map_err(failed(format!("publishing on `{port}`")))?;
        let (wanted, listener) = watch_readers(&publisher)?;
        Ok(StandIn { transport: self.clone(), port: port.clone(), wanted, _publisher: publisher, _listener: listener })
    }

    /// Publishes on a key for those far away: when a link is slow, what does not fit is dropped. `urgent`: before all else on the link.
    pub fn publish_far(&self, key: &str, urgent: bool) -> Result<FarPublisher, TransportError> {
        let priority = if urgent { Priority::InteractiveHigh } else { Priority::DataLow };
        let publisher = self.0.session.declare_publisher(key.to_owned());
        let publisher = publisher.congestion_control(CongestionControl::Drop).priority(priority).express(true);
        let publisher = publisher.allowed_destination(Locality::Remote);
        let publisher = publisher.wait().map_err(failed(format!("publishing on `{key}`")))?;
        let (wanted, listener) = watch_readers(&publisher)?;
        Ok(FarPublisher { publisher, wanted, _listener: listener })
    }
}

/// Whether anybody reads what is published; kept up to date while the guard lives.
fn watch_readers(publisher: &::zenoh::pubsub::Publisher<'_>) -> Result<(Arc<AtomicBool>, Guard), TransportError> {
    let wanted = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&wanted);
    let listener = publisher.matching_listener();
    let listener = listener.callback(move |status| flag.store(status.matching(), Ordering::Relaxed));
    let listener = listener.wait().map_err(failed(format!("watching the readers of `{}`", publisher.key_expr())))?;
    Ok((wanted, Box::new(listener)))
}

impl StandIn {
    /// Whether anybody reads it.
    pub fn wanted(&self) -> bool {
        self.wanted.load(Ordering::Relaxed)
    }

    /// Puts a sample of the node.
    pub fn put(&self, header: &Header, payload: Payload) -> Result<(), TransportError> {
        self.transport.put_raw(&self.port, &header.encode()?, payload)
    }
}

impl FarPublisher {
    /// Whether anybody reads it.
    pub fn wanted(&self) -> bool {
        self.wanted.load(Ordering::Relaxed)
    }

    /// Puts bytes, with the header of a sample where there is one.
    pub fn put(&self, header: Option<&[u8]>, bytes: Vec<u8>) -> Result<(), TransportError> {
        let put = self.publisher.put(bytes);
        let put = match header {
            Some(header) => put.attachment(header).wait(),
            None => put.wait(),
        };
        put.map_err(|error| failed(format!("publishing on `{}`", self.publisher.key_expr()))(error))
    }
}
