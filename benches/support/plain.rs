//! The yardstick: what a careful programmer writes with Zenoh alone. Frames lie in explicitly allocated shared memory that is
//! reused, small messages go over the socket; callbacks do the work.

use std::sync::mpsc;
use std::time::Duration;

use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::shm::{BlockOn, GarbageCollect, ShmProviderBuilder};
use zenoh::{Session, Wait};

use super::measure::{self, Recorder, Series, WARM_UP};

/// A session that listens at one socket and connects to others: the link that carril uses between its processes.
fn open(listen: Option<&str>, connect: &[String]) -> Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("listen/endpoints", serde_json::json!(listen.iter().collect::<Vec<_>>()).to_string()),
        ("connect/endpoints", serde_json::json!(connect).to_string()),
    ] {
        config.insert_json5(key, &value).expect("a valid setting of Zenoh");
    }
    zenoh::open(config).wait().expect("those that it connects to listen already")
}

fn publisher(session: &Session, key: &str) -> Publisher<'static> {
    let publisher = session.declare_publisher(key.to_owned()).congestion_control(CongestionControl::Drop);
    publisher.express(true).wait().expect("a publisher")
}

fn wait_for_reader(publisher: &Publisher<'_>) {
    while !publisher.matching_status().wait().expect("a status").matching() {
        std::thread::sleep(Duration::from_millis(1));
    }
    // The other readers of a fan-out declare themselves in these moments.
    std::thread::sleep(Duration::from_millis(200));
}

/// Publishes messages of `size` bytes on `key`, one per `period`, until it is ended: a reader may miss some. The first eight bytes
/// are the time of the put. Prints the CPU time of `count` messages.
pub fn source(connect: &[String], key: &str, size: usize, count: usize, period: Duration) -> ! {
    let session = open(None, connect);
    let publisher = publisher(&session, key);
    wait_for_reader(&publisher);
    let shared = (size >= measure::SHARED_FROM_BYTES)
        .then(|| ShmProviderBuilder::default_backend(size * 8).wait().expect("shared memory for eight frames"));
    let mut send = || {
        let payload: ZBytes = if let Some(provider) = &shared {
            let frame = provider.alloc(size).with_policy::<BlockOn<GarbageCollect>>();
            let mut frame = frame.wait().expect("memory for a frame");
            frame[..8].copy_from_slice(&measure::monotonic_ns().to_le_bytes());
            frame.into()
        } else {
            let mut message = vec![0x5a_u8; size];
            message[..8].copy_from_slice(&measure::monotonic_ns().to_le_bytes());
            message.into()
        };
        publisher.put(payload).wait().expect("a put");
    };
    measure::paced(WARM_UP, period, &mut send);
    let cpu_at_start = measure::cpu_us();
    measure::paced(count, period, &mut send);
    Series { latencies_ns: Vec::new(), cpu_us: measure::cpu_us() - cpu_at_start }.print();
    loop {
        measure::paced(count, period, &mut send);
    }
}

/// Takes `count` messages from `key`.
pub fn sink(listen: &str, connect: &[String], key: &str, count: usize) -> Series {
    let session = open(Some(listen), connect);
    let (done, finished) = mpsc::channel();
    let mut recorder = Recorder::new(count);
    let subscriber = session.declare_subscriber(key.to_owned()).callback_mut(move |sample| {
        let bytes = sample.payload().slices().next().unwrap_or_default();
        let sent_ns = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"));
        if let Some(series) = recorder.record(sent_ns) {
            drop(done.send(series));
        }
    });
    let _subscriber = subscriber.wait().expect("a subscriber");
    println!("ready");
    finished.recv_timeout(Duration::from_secs(120)).expect("all messages within two minutes")
}

/// Answers each message on `from` with a small one on `to` that carries its time on, until it is ended.
pub fn relay(listen: &str, connect: &[String], from: &str, to: &str) -> ! {
    let session = open(Some(listen), connect);
    let publisher = publisher(&session, to);
    let subscriber = session.declare_subscriber(from.to_owned()).callback(move |sample| {
        let bytes = sample.payload().slices().next().unwrap_or_default();
        publisher.put(bytes[..16.min(bytes.len())].to_vec()).wait().expect("a put");
    });
    let _subscriber = subscriber.wait().expect("a subscriber");
    println!("ready");
    loop {
        std::thread::park();
    }
}
