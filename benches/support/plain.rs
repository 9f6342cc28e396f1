//! The yardstick: what a careful programmer writes with Zenoh alone. One process publishes, one subscribes; frames lie in
//! explicitly allocated shared memory that is reused, small messages go over the socket; the callback takes the time.

use std::sync::mpsc;
use std::time::Duration;

use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::shm::{BlockOn, GarbageCollect, ShmProviderBuilder};

use crate::support::measure::{self, HopStats};

/// The link of both: what carril uses between its processes.
fn config(mode: &str, endpoint: &str) -> zenoh::Config {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        (mode, format!("[\"{endpoint}\"]")),
    ] {
        config.insert_json5(key, &value).expect("a valid setting of Zenoh");
    }
    config
}

/// Publishes `count` messages of `size` bytes, one per `period`. The first eight bytes are the time of the put.
pub fn source(endpoint: &str, size: usize, count: usize, period: Duration) {
    let session = zenoh::open(config("connect/endpoints", endpoint)).wait().expect("the sink listens already");
    let publisher = session
        .declare_publisher("bench/hop")
        .congestion_control(CongestionControl::Drop)
        .express(true)
        .wait()
        .expect("a publisher");
    while !publisher.matching_status().wait().expect("a status").matching() {
        std::thread::sleep(Duration::from_millis(1));
    }
    let shared = (size >= measure::SHARED_FROM_BYTES)
        .then(|| ShmProviderBuilder::default_backend(size * 8).wait().expect("shared memory for eight frames"));
    let heap = vec![0x5a_u8; size];
    measure::paced(count, period, || {
        let stamp = measure::monotonic_ns();
        let payload: ZBytes = if let Some(provider) = &shared {
            let mut frame =
                provider.alloc(size).with_policy::<BlockOn<GarbageCollect>>().wait().expect("a frame's memory");
            frame[..8].copy_from_slice(&stamp.to_le_bytes());
            frame.into()
        } else {
            let mut message = heap.clone();
            message[..8].copy_from_slice(&stamp.to_le_bytes());
            message.into()
        };
        publisher.put(payload).wait().expect("a put");
    });
    std::thread::sleep(Duration::from_millis(100));
}

/// Takes `count` messages and says how long they took.
pub fn sink(endpoint: &str, count: usize) -> HopStats {
    let session = zenoh::open(config("listen/endpoints", endpoint)).wait().expect("a session");
    let (done, finished) = mpsc::channel();
    let mut stats = HopStats::new(count);
    let _subscriber = session
        .declare_subscriber("bench/hop")
        .callback_mut(move |sample| {
            let bytes = sample.payload().slices().next().unwrap_or_default();
            let sent = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"));
            if stats.record(measure::monotonic_ns().saturating_sub(sent)) {
                drop(done.send(stats.take()));
            }
        })
        .wait()
        .expect("a subscriber");
    println!("ready");
    finished.recv_timeout(Duration::from_secs(60)).expect("all messages within a minute")
}
