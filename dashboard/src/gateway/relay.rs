//! Passes samples on to the outside: of each port the newest only, at most so many a second, and only while somebody reads it. Images are
//! compressed, on a thread of their own, so that nothing else waits for them.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Header, Image, Message, Payload, dynamic};
use carril_runtime::client::Client;
use carril_runtime::control_plane::{RunFile, json_key};
use carril_runtime::graph::remote::RemoteRates;
use carril_runtime::transport::zenoh::{FarPublisher, ZenohTransport};
use carril_runtime::transport::{Guard, TransportError};
use serde::Serialize;
use serde_json::json;

use crate::machine;

/// Whether somebody reads a port is looked up this often.
const LOOK: Duration = Duration::from_millis(50);

/// What has left the car and what has not, since the gateway started.
#[derive(Debug, Default)]
pub struct Counters {
    sent: AtomicU64,
    sent_bytes: AtomicU64,
    dropped_images: AtomicU64,
    dropped_data: AtomicU64,
}

/// The counters at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Samples that were sent.
    pub sent: u64,
    /// Their payloads, B.
    pub sent_bytes: u64,
    /// Images that a newer one replaced before they were sent.
    pub dropped_images: u64,
    /// Other samples that a newer one replaced.
    pub dropped_data: u64,
}

impl Counters {
    /// As they are now.
    pub fn read(&self) -> Counts {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Counts {
            sent: read(&self.sent),
            sent_bytes: read(&self.sent_bytes),
            dropped_images: read(&self.dropped_images),
            dropped_data: read(&self.dropped_data),
        }
    }
}

/// Lets a sample through every so often: the newest at the time.
#[derive(Debug)]
pub struct Pace {
    period: Duration,
    next: Option<Instant>,
}

impl Pace {
    /// At most `hz` times a second.
    pub fn new(hz: f64) -> Self {
        Self { period: Duration::from_secs_f64(1.0 / hz.max(0.001)), next: None }
    }

    /// When the next may pass. `None`: at once.
    pub fn due(&self) -> Option<Instant> {
        self.next
    }

    /// Whether one may pass now; then it counts as passed.
    pub fn pass(&mut self, now: Instant) -> bool {
        match self.next {
            Some(next) if now < next => false,
            // A source a little faster than the pace keeps its rhythm; one that paused begins anew.
            Some(next) if now < next + self.period => {
                self.next = Some(next + self.period);
                true
            }
            _ => {
                self.next = Some(now + self.period * 7 / 8);
                true
            }
        }
    }
}

struct Outlet {
    node: String,
    port: String,
    is_image: bool,
    raw: FarPublisher,
    json: FarPublisher,
    newest: Arc<Mutex<Option<(Header, Payload)>>>,
    tap: Option<Guard>,
    pace: Pace,
}

/// Relays ports until it is dropped.
pub struct Relay {
    stop: Arc<AtomicBool>,
    news: [Arc<News>; 2],
    threads: Vec<std::thread::JoinHandle<()>>,
}

#[derive(Default)]
struct News {
    seen: Mutex<bool>,
    came: Condvar,
}

impl News {
    fn tell(&self) {
        *lock(&self.seen) = true;
        self.came.notify_all();
    }

    fn wait(&self, patience: Duration) {
        let seen = lock(&self.seen);
        let waited = self.came.wait_timeout_while(seen, patience, |seen| !*seen);
        *waited.unwrap_or_else(PoisonError::into_inner).0 = false;
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Relay {
    /// Begins to relay every port of a run.
    pub fn start(
        client: &Arc<Client>,
        outer: &ZenohTransport,
        run: &RunFile,
        rates: RemoteRates,
        counters: &Arc<Counters>,
    ) -> Result<Self, TransportError> {
        let (mut images, mut data) = (Vec::new(), Vec::new());
        for (node, port, message_type) in ports(run) {
            let is_image = message_type == Image::TYPE.name;
            let key = carril_messages::Key::new(&run.robot, node, port).to_string();
            let outlet = Outlet {
                node: node.to_owned(),
                port: port.to_owned(),
                is_image,
                raw: outer.publish_far(&key, false)?,
                json: outer.publish_far(&json_key(&run.robot, node, port), false)?,
                newest: Arc::default(),
                tap: None,
                pace: Pace::new(if is_image { rates.image_hz } else { rates.data_hz }),
            };
            if is_image { images.push(outlet) } else { data.push(outlet) }
        }
        let stop = Arc::new(AtomicBool::new(false));
        let news: [Arc<News>; 2] = Default::default();
        let mut threads = Vec::new();
        for (outlets, news) in [images, data].into_iter().zip(&news) {
            let worker = Worker {
                client: Arc::clone(client),
                outlets,
                rates,
                counters: Arc::clone(counters),
                stop: Arc::clone(&stop),
                news: Arc::clone(news),
            };
            threads.push(std::thread::spawn(move || worker.run()));
        }
        Ok(Self { stop, news, threads })
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for news in &self.news {
            news.tell();
        }
        for thread in self.threads.drain(..) {
            // A relay that panicked has said so.
            let _ = thread.join();
        }
    }
}

/// Every port of a run that samples travel from: node, port, type.
fn ports(run: &RunFile) -> impl Iterator<Item = (&str, &str, &str)> {
    run.nodes.iter().flat_map(|node| {
        let outputs =
            node.outputs.iter().map(|output| (node.name.as_str(), output.port.as_str(), output.message_type.as_str()));
        let external = node.inputs.iter().filter(|input| input.external);
        outputs.chain(external.map(|input| (node.name.as_str(), input.port.as_str(), input.message_type.as_str())))
    })
}

struct Worker {
    client: Arc<Client>,
    outlets: Vec<Outlet>,
    rates: RemoteRates,
    counters: Arc<Counters>,
    stop: Arc<AtomicBool>,
    news: Arc<News>,
}

impl Worker {
    fn run(mut self) {
        let mut looked: Option<Instant> = None;
        while !self.stop.load(Ordering::Relaxed) {
            let now = Instant::now();
            if looked.is_none_or(|looked| now >= looked + LOOK) {
                self.follow_readers();
                looked = Some(now);
            }
            let mut next = now + LOOK;
            for at in 0..self.outlets.len() {
                if lock(&self.outlets[at].newest).is_none() {
                    continue;
                }
                if self.outlets[at].pace.pass(Instant::now()) {
                    self.send(at);
                } else if let Some(due) = self.outlets[at].pace.due() {
                    next = next.min(due);
                }
            }
            self.news.wait(next.saturating_duration_since(Instant::now()));
        }
    }

    /// Listens to the ports that somebody reads, and to no others.
    fn follow_readers(&mut self) {
        for outlet in &mut self.outlets {
            let wanted = outlet.raw.wanted() || outlet.json.wanted();
            if wanted == outlet.tap.is_some() {
                continue;
            }
            if !wanted {
                outlet.tap = None;
                *lock(&outlet.newest) = None;
                continue;
            }
            let (newest, news, counters) =
                (Arc::clone(&outlet.newest), Arc::clone(&self.news), Arc::clone(&self.counters));
            let is_image = outlet.is_image;
            let hear = move |header: Header, payload: Payload, _| {
                if lock(&newest).replace((header, payload)).is_some() {
                    let dropped = if is_image { &counters.dropped_images } else { &counters.dropped_data };
                    dropped.fetch_add(1, Ordering::Relaxed);
                }
                news.tell();
            };
            match self.client.subscribe(&outlet.node, &outlet.port, hear) {
                Ok(tap) => outlet.tap = Some(tap),
                Err(error) => tracing::warn!("listening to `{}/{}`: {error}", outlet.node, outlet.port),
            }
        }
    }

    fn send(&self, at: usize) {
        let outlet = &self.outlets[at];
        let Some((header, payload)) = lock(&outlet.newest).take() else { return };
        let (width, quality) = (self.rates.image_width, self.rates.image_quality);
        let sent = machine::packed((header, payload), width, quality)
            .and_then(|(header, payload)| send(outlet, &header, &payload));
        match sent {
            Ok(bytes) => {
                self.counters.sent.fetch_add(1, Ordering::Relaxed);
                self.counters.sent_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
            }
            Err(reason) => tracing::debug!("passing on `{}/{}`: {reason}", outlet.node, outlet.port),
        }
    }
}

fn send(outlet: &Outlet, header: &Header, payload: &Payload) -> Result<usize, String> {
    let mut bytes = 0;
    if outlet.json.wanted() {
        let text = as_json(header, payload).to_string().into_bytes();
        bytes += text.len();
        outlet.json.put(None, text).map_err(|error| error.to_string())?;
    }
    if outlet.raw.wanted() {
        let header = header.encode().map_err(|error| error.to_string())?;
        bytes += payload.len();
        outlet.raw.put(Some(&header), payload.to_vec()).map_err(|error| error.to_string())?;
    }
    Ok(bytes)
}

/// A sample for clients without our types.
fn as_json(header: &Header, payload: &Payload) -> serde_json::Value {
    let (value, error) = match dynamic::to_json(header, payload) {
        Ok(value) => (value, None),
        Err(error) => (serde_json::Value::Null, Some(error.to_string())),
    };
    json!({
        "type": header.message_type.to_string(),
        "seq": header.seq,
        "stamp_ns": header.stamp.as_nanos(),
        "captured_ns": header.origins.oldest().map(carril_messages::Stamp::as_nanos),
        "value": value,
        "error": error,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pace_lets_through_at_most_its_rate_and_never_saves_up() {
        let start = Instant::now();
        let mut pace = Pace::new(10.0);
        let passed = |pace: &mut Pace, from_ms: u64, to_ms: u64, every_ms: u64| {
            (from_ms..to_ms)
                .step_by(every_ms as usize)
                .filter(|ms| pace.pass(start + Duration::from_millis(*ms)))
                .count()
        };
        assert_eq!(passed(&mut pace, 0, 10_000, 33), 101, "30 Hz become 10, and the first passes at once");
        assert!(passed(&mut pace, 60_000, 60_100, 1) <= 2, "a pause is not made up for");
        let mut slow = Pace::new(30.0);
        assert_eq!(passed(&mut slow, 0, 10_000, 34), 295, "a source slower than the pace loses nothing");
    }

    #[test]
    fn json_says_what_it_is_and_why_it_is_not() {
        let lane = carril_messages::LaneEstimate { lane: None, quality: 0.0, threshold: Some(190) };
        let encoded = lane.encode().expect("it encodes");
        let mut header = Header {
            epoch: 1,
            seq: 7,
            stamp: carril_messages::Stamp::from_nanos(5),
            origins: carril_messages::Origins::none(),
            message_type: carril_messages::LaneEstimate::TYPE,
            meta: encoded.meta,
        };
        let shown = as_json(&header, &encoded.payload);
        assert_eq!((&shown["seq"], &shown["value"]["threshold"]), (&json!(7), &json!(190)), "{shown}");
        header.message_type = carril_messages::Command::TYPE;
        let shown = as_json(&header, &Payload::from(vec![1]));
        assert!(shown["error"].is_string() && shown["value"].is_null(), "damaged: {shown}");
    }
}
