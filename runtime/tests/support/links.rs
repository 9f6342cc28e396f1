//! Two ends of a link, for tests of transports.

#![allow(dead_code, missing_docs, reason = "shared by several test programs, each of which uses a part")]

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use carril_messages::{Command, Header, Key, Message, MessageType, Meta, Origins, SourceId, Stamp};
use carril_runtime::transport::zenoh::{Loss, ZenohOptions, ZenohTransport, endpoint};
use carril_runtime::transport::{Publisher, Sink, Transport};
use carril_runtime::{AnyInput, Incoming, Input};

/// What a reader got.
#[derive(Default)]
pub struct Collector {
    pub samples: Mutex<Vec<Incoming>>,
    refusals: Mutex<Vec<String>>,
}

impl Sink for Collector {
    fn deliver(&self, incoming: Incoming) {
        self.samples.lock().expect("no test panics while it collects").push(incoming);
    }

    fn refuse(&self, reason: String) {
        self.refusals.lock().expect("no test panics while it collects").push(reason);
    }
}

impl Collector {
    pub fn len(&self) -> usize {
        self.samples.lock().expect("no test panics while it collects").len()
    }

    pub fn seqs(&self) -> Vec<u64> {
        self.samples.lock().expect("no test panics while it collects").iter().map(|s| s.header().seq).collect()
    }

    pub fn refusals(&self) -> Vec<String> {
        self.refusals.lock().expect("no test panics while it collects").clone()
    }

    pub fn decode<T: Message>(&self, index: usize) -> T {
        let incoming = self.samples.lock().expect("no test panics while it collects")[index].clone();
        let mut input = Input::<T>::default();
        input.accept(incoming).expect("the sample is of this type");
        T::clone(input.take().expect("it was just put in").value())
    }
}

/// Waits for what must happen sooner or later; only a hang fails.
pub fn until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < Duration::from_secs(30), "still waiting for: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

pub struct Pair {
    pub writer: Box<dyn Transport>,
    pub reader: Box<dyn Transport>,
    pub dir: tempfile::TempDir,
}

pub fn zenoh_with(pool_bytes: usize, lose: Option<Loss>) -> Pair {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let socket = endpoint(&dir.path().join("writer.sock"));
    let writer = ZenohOptions { listen: Some(socket.clone()), pool_bytes, ..ZenohOptions::default() };
    let reader = ZenohOptions { connect: vec![socket], lose, ..ZenohOptions::default() };
    let writer = ZenohTransport::open(writer).expect("the writer opens");
    let reader = ZenohTransport::open(reader).expect("the reader opens");
    Pair { writer: Box::new(writer), reader: Box::new(reader), dir }
}

pub fn port(node: &str, port: &str) -> Key {
    Key::new("car", node, port)
}

pub fn header(seq: u64, message_type: MessageType) -> Header {
    let origins = Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(1_000));
    Header { epoch: 7, seq, stamp: Stamp::from_nanos(2_000), origins, message_type, meta: Meta::new() }
}

pub fn command(n: u64) -> Command {
    Command { speed_m_s: n as f32, ..Command::default() }
}

/// Opens both ends and waits until they know of each other.
pub fn connected(
    pair: &Pair,
    key: &Key,
    reliable: bool,
) -> (Box<dyn Publisher>, Arc<Collector>, Box<dyn std::any::Any>) {
    let sink = Arc::new(Collector::default());
    let guard = pair.reader.subscribe(key, reliable, sink.clone()).expect("subscribing");
    let probe = pair.writer.publish_on(key, false).expect("publishing");
    until("the writer to see its reader", || probe.matched());
    let publisher = if reliable { pair.writer.publish_on(key, true).expect("publishing") } else { probe };
    (publisher, sink, guard)
}
