//! What reliable edges and shared memory promise (docs/live.md): nothing lost under load, late and restarted ends, frames that
//! stay as they are for as long as a reader holds them.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use carril_messages::{Command, Encoding, Header, Image, Key, Message, Payload};
use carril_runtime::Incoming;
use carril_runtime::transport::zenoh::{POOL_BYTES, ZenohOptions, ZenohTransport, endpoint, is_shared};
use carril_runtime::transport::{Guard, Publisher, Sink, Transport};

#[path = "support/links.rs"]
mod links;
#[path = "../../tests/support/thorough.rs"]
mod thorough;

use links::{Collector, command, header, port, until};

const FRAME_BYTES: usize = 640 * 480 * 3;

/// One end of a link whose socket lies in `dir`. `since`: when it began to live.
fn end(dir: &Path, listens: bool, since: u64, pool_bytes: usize) -> ZenohTransport {
    let socket = endpoint(&dir.join("link.sock"));
    let (listen, connect) = if listens { (Some(socket), Vec::new()) } else { (None, vec![socket]) };
    let options = ZenohOptions { listen, connect, pool_bytes, epoch: since * LONG, ..ZenohOptions::default() };
    ZenohTransport::open(options).expect("the session opens")
}

fn read(transport: &ZenohTransport, key: &Key) -> (Arc<Collector>, Guard) {
    let sink = Arc::new(Collector::default());
    let guard = transport.subscribe(key, true, sink.clone()).expect("subscribing");
    (sink, guard)
}

/// Between the lives in these tests, ns: longer than any of them takes.
const LONG: u64 = 1_000_000_000_000;

/// Publishes commands in a life of the writer that began at `epoch`.
fn publish(publisher: &dyn Publisher, epoch: u64, seqs: std::ops::Range<u64>) {
    for seq in seqs {
        let header = Header { epoch: epoch * LONG, ..header(seq, Command::TYPE) };
        publisher.publish(&header, &command(seq)).expect("publishing");
    }
}

fn lives(sink: &Collector) -> Vec<(u64, u64)> {
    let samples = sink.samples.lock().expect("no test panics while it collects");
    samples.iter().map(|sample| (sample.header().epoch / LONG, sample.header().seq)).collect()
}

fn of_life(epoch: u64, seqs: std::ops::Range<u64>) -> Vec<(u64, u64)> {
    seqs.map(|seq| (epoch, seq)).collect()
}

#[test]
fn a_reader_that_was_there_first_gets_all_even_when_its_link_comes_late() {
    let (dir, key) = (tempfile::tempdir().expect("a folder"), port("world", "events"));
    let reader = end(dir.path(), false, 50, POOL_BYTES);
    let (sink, _guard) = read(&reader, &key);
    // Nobody listens at the socket yet: the writer starts only now, and publishes before it has a link.
    let writer = end(dir.path(), true, 100, POOL_BYTES);
    let publisher = writer.publish_on(&key, true).expect("publishing");
    publish(publisher.as_ref(), 100, 0..30);
    until("all samples from the first on", || sink.len() >= 30);
    assert_eq!(lives(&sink), of_life(100, 0..30), "in order, nothing lost, nothing twice");
}

#[test]
fn a_reader_that_starts_late_gets_what_comes_then() {
    let (dir, key) = (tempfile::tempdir().expect("a folder"), port("world", "events"));
    let writer = end(dir.path(), true, 100, POOL_BYTES);
    let publisher = writer.publish_on(&key, true).expect("publishing");
    publish(publisher.as_ref(), 100, 0..30);
    let reader = end(dir.path(), false, 200, POOL_BYTES);
    let (sink, _guard) = read(&reader, &key);
    let probe = writer.publish_on(&key, false).expect("publishing");
    until("the writer to see its reader", || probe.matched());
    publish(publisher.as_ref(), 100, 30..60);
    until("the new samples", || sink.len() >= 30);
    assert_eq!(lives(&sink), of_life(100, 30..60), "all from then on, none of the old ones");
}

#[test]
fn a_restarted_writer_loses_none_of_its_samples() {
    let (dir, key) = (tempfile::tempdir().expect("a folder"), port("world", "events"));
    let reader = end(dir.path(), false, 50, POOL_BYTES);
    let (sink, _guard) = read(&reader, &key);
    for epoch in [100, 200, 300] {
        let writer = end(dir.path(), true, epoch, POOL_BYTES);
        let publisher = writer.publish_on(&key, true).expect("publishing");
        publish(publisher.as_ref(), epoch, 0..30);
        until("all samples of this life", || lives(&sink).iter().filter(|(life, _)| *life == epoch).count() >= 30);
        drop(publisher);
        writer.close();
    }
    let expected = [of_life(100, 0..30), of_life(200, 0..30), of_life(300, 0..30)].concat();
    assert_eq!(lives(&sink), expected, "each life in order, nothing lost, nothing twice");
}

#[test]
fn a_restarted_reader_gets_nothing_twice_and_holds_nobody_up() {
    let (dir, key) = (tempfile::tempdir().expect("a folder"), port("world", "events"));
    let writer = end(dir.path(), true, 100, POOL_BYTES);
    let publisher = writer.publish_on(&key, true).expect("publishing");
    let first = end(dir.path(), false, 50, POOL_BYTES);
    let (before, guard) = read(&first, &key);
    publish(publisher.as_ref(), 100, 0..30);
    until("the first reader to have all", || before.len() >= 30);
    drop(guard);
    first.close();
    let probe = writer.publish_on(&key, false).expect("publishing");
    until("the writer to see that it is gone", || !probe.matched());
    // More than the writer keeps: with a reader that lacks them it would wait here.
    publish(publisher.as_ref(), 100, 30..1000);
    let second = end(dir.path(), false, 200, POOL_BYTES);
    let (after, _guard) = read(&second, &key);
    until("the writer to see its reader", || probe.matched());
    publish(publisher.as_ref(), 100, 1000..1030);
    until("the second reader to have the new ones", || after.len() >= 30);
    assert_eq!(lives(&before), of_life(100, 0..30), "the first");
    assert_eq!(lives(&after), of_life(100, 1000..1030), "the second: none of what was before it");
}

/// Checks each frame when it comes, and gives its memory back at once.
#[derive(Default)]
struct Checker {
    seqs: Mutex<Vec<u64>>,
    through_socket: AtomicU64,
}

impl Checker {
    /// However slow the machine is: only frames that stop coming fail.
    fn wait_for(&self, frames: usize) {
        let count = || self.seqs.lock().expect("no test panics while it checks").len();
        let (mut seen, mut at) = (count(), Instant::now());
        while seen < frames {
            assert!(at.elapsed() < Duration::from_secs(60), "no frame for 60 s, {seen} of {frames} have come");
            std::thread::sleep(Duration::from_millis(2));
            if count() > seen {
                (seen, at) = (count(), Instant::now());
            }
        }
    }
}

impl Sink for Checker {
    fn deliver(&self, incoming: Incoming) {
        let Incoming::Wire(header, payload) = incoming else { panic!("frames come over the link") };
        assert_eq!(payload.len(), FRAME_BYTES, "the whole frame");
        let wrong = payload.iter().step_by(4099).filter(|pixel| **pixel != header.seq as u8).count();
        assert_eq!(wrong, 0, "the pixels of frame {}", header.seq);
        self.through_socket.fetch_add(u64::from(!is_shared(&payload)), Ordering::Relaxed);
        self.seqs.lock().expect("no test panics while it checks").push(header.seq);
    }

    fn refuse(&self, reason: String) {
        panic!("every frame is valid: {reason}");
    }
}

fn frame(transport: &ZenohTransport, seq: u64) -> Image {
    let mut pixels = transport.buffers().buffer(FRAME_BYTES);
    pixels.fill(seq as u8);
    Image::packed(640, 480, Encoding::Bgr8, pixels.freeze()).expect("the size fits")
}

/// Threads that do nothing but run, until this is dropped.
struct Load(Arc<AtomicBool>);

impl Load {
    fn start(threads: usize) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        for _ in 0..threads {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    std::hint::black_box(0_u64);
                }
            });
        }
        Self(stop)
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Publishes frames as fast as they go, with busy threads beside, to a reader that gives each back at once.
fn all_frames_come(frames: u64, busy_threads: usize, pool_bytes: usize) {
    let (dir, key) = (tempfile::tempdir().expect("a folder"), port("world", "camera"));
    let reader = end(dir.path(), false, 50, POOL_BYTES);
    let sink = Arc::new(Checker::default());
    let _guard = reader.subscribe(&key, true, sink.clone()).expect("subscribing");
    let writer = end(dir.path(), true, 100, pool_bytes);
    let publisher = writer.publish_on(&key, true).expect("publishing");
    let probe = writer.publish_on(&key, false).expect("publishing");
    until("the writer to see its reader", || probe.matched());
    let load = Load::start(busy_threads);
    for seq in 0..frames {
        let header = Header { epoch: 100 * LONG, ..header(seq, Image::TYPE) };
        publisher.publish(&header, &frame(&writer, seq)).expect("publishing");
    }
    sink.wait_for(frames as usize);
    drop(load);
    let (full, by_socket) = (writer.pool_fallbacks(), sink.through_socket.load(Ordering::Relaxed));
    println!("shared memory was full {full} times; {by_socket} of {frames} frames came through the socket");
    assert_eq!(
        *sink.seqs.lock().expect("no panic"),
        (0..frames).collect::<Vec<_>>(),
        "in order, nothing lost or twice"
    );
}

#[test]
fn no_frame_is_lost_on_a_busy_machine() {
    let (frames, busy_threads) = thorough::count((400, 8), (1000, 64));
    all_frames_come(frames, busy_threads, POOL_BYTES);
}

#[test]
fn no_frame_is_lost_when_shared_memory_is_scarce() {
    // Room for four frames, of which the writer keeps one for those who ask again.
    all_frames_come(1000, 1, 4 << 20);
}

#[test]
fn frames_that_a_reader_holds_never_change_and_the_pool_never_grows() {
    const LEN: usize = 64 << 10;
    const POOL: usize = 1 << 20;
    let (dir, key) = (tempfile::tempdir().expect("a folder"), port("world", "camera"));
    let writer = end(dir.path(), true, 100, POOL);
    let reader = end(dir.path(), false, 50, POOL);
    let sink = Arc::new(Collector::default());
    // Reliable, so that a busy machine drops none while the test waits for it.
    let _guard = reader.subscribe(&key, true, sink.clone()).expect("subscribing");
    let publisher = writer.publish_on(&key, true).expect("publishing");
    let send = |seq: u64| {
        let mut pixels = writer.buffers().buffer(LEN);
        pixels.fill(seq as u8);
        let image = Image::packed(256, 256, Encoding::Mono8, pixels.freeze()).expect("the size fits");
        publisher.publish(&Header { epoch: 100 * LONG, ..header(seq, Image::TYPE) }, &image).expect("publishing");
    };
    let held = || -> Vec<Payload> {
        let samples = sink.samples.lock().expect("no test panics while it collects");
        let payload = |sample: &Incoming| match sample {
            Incoming::Wire(_, payload) => payload.clone(),
            Incoming::Local(..) => panic!("frames come over the link"),
        };
        samples.iter().map(payload).collect()
    };
    // Four times what fits; each arrives before the next goes out, and all are held.
    for seq in 0..64 {
        send(seq);
        until("the frame", || sink.len() as u64 == seq + 1);
    }
    let frames = held();
    let shared = frames.iter().filter(|frame| is_shared(frame)).count();
    assert!(shared <= POOL / LEN, "shared memory holds no more than fits: {shared} frames");
    let full = writer.pool_fallbacks();
    assert!((48..=56).contains(&full), "of 64 frames, 8 to 16 fit, and each of the others is counted once: {full}");
    for (seq, frame) in frames.iter().enumerate() {
        assert!(frame.iter().all(|pixel| *pixel == seq as u8), "frame {seq} is as it was sent");
    }
    drop(frames);
    sink.samples.lock().expect("no test panics while it collects").clear();
    // Many times what fits, each given back before the next: the same memory serves them all.
    for seq in 64..264 {
        send(seq);
        until("the frame", || sink.len() == 1);
        let frame = held().remove(0);
        assert!(frame.iter().all(|pixel| *pixel == seq as u8), "frame {seq} is as it was sent");
        drop(frame);
        sink.samples.lock().expect("no test panics while it collects").clear();
    }
    assert_eq!(writer.pool_fallbacks(), full, "what readers gave back is enough");
}
