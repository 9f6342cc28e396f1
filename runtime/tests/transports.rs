//! One suite for both transports: memory and Zenoh must behave alike. What only Zenoh can do (losses, recovery) follows below.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use carril_messages::{Command, Encoding, Header, Image, Message, Payload};
use carril_runtime::transport::memory::MemoryTransport;
use carril_runtime::transport::zenoh::is_shared;

#[path = "support/links.rs"]
mod links;

use links::{Collector, Pair, command, connected, header, port, until, zenoh_with};

fn memory() -> Pair {
    let transport = MemoryTransport::default();
    let dir = tempfile::tempdir().expect("a temporary folder");
    Pair { writer: Box::new(transport.clone()), reader: Box::new(transport), dir }
}

fn zenoh() -> Pair {
    zenoh_with(16 << 20, None)
}

fn delivers_headers_and_messages_in_order(pair: &Pair) {
    let (publisher, sink, _guard) = connected(pair, &port("lane", "command"), false);
    for n in 0..20 {
        publisher.publish(&header(n, Command::TYPE), &command(n)).expect("publishing");
    }
    until("all samples", || sink.len() == 20);
    assert_eq!(sink.seqs(), (0..20).collect::<Vec<_>>(), "in order");
    assert_eq!(sink.decode::<Command>(19), command(19), "the message itself");
    let samples = sink.samples.lock().expect("no test panics while it collects");
    assert_eq!(**samples[3].header(), header(3, Command::TYPE), "the header with its stamps and origins");
}

fn knows_whether_anybody_reads(pair: &Pair) {
    let key = port("lane", "debug");
    let publisher = pair.writer.publish_on(&key, false).expect("publishing");
    assert!(!publisher.matched(), "nobody reads yet");
    let guard = pair.reader.subscribe(&key, false, Arc::new(Collector::default())).expect("subscribing");
    until("the reader to be seen", || publisher.matched());
    drop(guard);
    until("the reader to be gone", || !publisher.matched());
}

fn carries_images_of_every_size(pair: &Pair) {
    let (publisher, sink, _guard) = connected(pair, &port("world", "camera"), false);
    for (index, (width, height)) in [(1, 1), (100, 100), (640, 480), (1280, 960)].into_iter().enumerate() {
        let len = (width * height * 3) as usize;
        let mut pixels = pair.writer.buffers().buffer(len);
        for (at, pixel) in pixels.iter_mut().enumerate() {
            *pixel = (at % 251) as u8;
        }
        let written = Image::packed(width, height, Encoding::Bgr8, pixels.freeze()).expect("the size fits");
        publisher.publish(&header(index as u64, Image::TYPE), &written).expect("publishing");
        until("the image", || sink.len() == index + 1);
        assert_eq!(sink.decode::<Image>(index), written, "{width}x{height}: same pixels");
    }
    let heap = Image::packed(640, 480, Encoding::Mono8, Payload::from(vec![7; 640 * 480])).expect("the size fits");
    publisher.publish(&header(9, Image::TYPE), &heap).expect("publishing");
    until("the image from the heap", || sink.len() == 5);
    assert_eq!(sink.decode::<Image>(4), heap, "from the heap: same pixels");
}

fn serves_several_readers(pair: &Pair) {
    let key = port("world", "scan");
    let (publisher, first, _guard) = connected(pair, &key, false);
    let second = Arc::new(Collector::default());
    let _second_guard = pair.reader.subscribe(&key, false, second.clone()).expect("subscribing");
    publisher.publish(&header(0, Command::TYPE), &command(0)).expect("publishing");
    until("both readers to hear", || first.len() == 1 && second.len() == 1);
}

fn refuses_garbage_and_goes_on(pair: &Pair) {
    let key = port("decision", "goal");
    let (publisher, sink, _guard) = connected(pair, &key, false);
    let valid = header(0, Command::TYPE).encode().expect("a header encodes");
    let mut old = valid.clone();
    old[0] = 0;
    let garbage: [&[u8]; 6] = [&[], &[1], &[255; 64], &[1; 4000], &valid[..valid.len() - 1], &old];
    for bytes in garbage {
        pair.writer.put_raw(&key, bytes, Payload::from(vec![3; 10])).expect("putting");
    }
    until("all refusals", || sink.refusals().len() == garbage.len());
    assert_eq!(sink.len(), 0, "nothing got in");
    let refusals = sink.refusals();
    assert!(refusals.iter().any(|r| r.contains("header version 0, expected 1")), "versions are named: {refusals:?}");
    publisher.publish(&header(1, Command::TYPE), &command(1)).expect("publishing");
    until("the good sample", || sink.len() == 1);
}

fn refuses_absurd_sizes(pair: &Pair) {
    let key = port("lane", "image");
    let (_publisher, sink, _guard) = connected(pair, &key, false);
    let valid = header(0, Image::TYPE).encode().expect("a header encodes");
    pair.writer.put_raw(&key, &valid, Payload::from(vec![0; (64 << 20) + 1])).expect("putting");
    until("the refusal", || sink.refusals().len() == 1);
    assert!(sink.refusals()[0].contains("67108865 bytes"), "it says the size: {:?}", sink.refusals());
}

fn reliable_edges_deliver_in_order(pair: &Pair) {
    let (publisher, sink, _guard) = connected(pair, &port("decision", "events"), true);
    for n in 0..50 {
        publisher.publish(&header(n, Command::TYPE), &command(n)).expect("publishing");
    }
    until("all samples", || sink.len() == 50);
    assert_eq!(sink.seqs(), (0..50).collect::<Vec<_>>(), "in order, each once");
}

macro_rules! suite {
    ($($test:ident),+ $(,)?) => {
        mod with_memory {
            $(#[test] fn $test() { super::$test(&super::memory()); })+
        }
        mod with_zenoh {
            $(#[test] fn $test() { super::$test(&super::zenoh()); })+
        }
    };
}

suite!(
    delivers_headers_and_messages_in_order,
    knows_whether_anybody_reads,
    carries_images_of_every_size,
    serves_several_readers,
    refuses_garbage_and_goes_on,
    refuses_absurd_sizes,
    reliable_edges_deliver_in_order,
);

/// A link that loses samples by a fixed pattern; counts how many.
fn lossy(losses: &Arc<AtomicU64>, pattern: fn(u64) -> bool) -> Pair {
    let losses = Arc::clone(losses);
    let lose = move |header: &Header| {
        let lost = pattern(header.seq);
        losses.fetch_add(u64::from(lost), Ordering::Relaxed);
        lost
    };
    zenoh_with(16 << 20, Some(Arc::new(lose)))
}

#[test]
fn reliable_edges_fill_every_gap() {
    let losses = Arc::new(AtomicU64::new(0));
    // Single samples, pairs, a run of ten, and the very last, behind which no other sample shows the gap.
    let pair = lossy(&losses, |seq| seq % 7 == 3 || seq % 50 == 49 || (100..110).contains(&seq) || seq == 299);
    let (publisher, sink, _guard) = connected(&pair, &port("decision", "events"), true);
    for n in 0..300 {
        publisher.publish(&header(n, Command::TYPE), &command(n)).expect("publishing");
    }
    until("all samples in spite of losses", || sink.len() >= 300);
    assert!(losses.load(Ordering::Relaxed) >= 50, "the link did lose samples");
    assert_eq!(sink.seqs(), (0..300).collect::<Vec<_>>(), "in order, nothing lost, nothing twice");
}

#[test]
fn other_edges_show_the_same_losses() {
    let losses = Arc::new(AtomicU64::new(0));
    let pair = lossy(&losses, |seq| seq % 3 == 0);
    let (publisher, sink, _guard) = connected(&pair, &port("decision", "state"), false);
    for n in 0..30 {
        publisher.publish(&header(n, Command::TYPE), &command(n)).expect("publishing");
    }
    // A busy machine may lose more on such an edge, even the last one.
    until("the last sample", || {
        publisher.publish(&header(31, Command::TYPE), &command(31)).expect("publishing");
        sink.seqs().last() == Some(&31)
    });
    let lost = sink.seqs().into_iter().filter(|seq| seq % 3 == 0).count();
    assert_eq!(lost, 0, "what is lost stays lost: the hook of the other test works");
}

#[test]
fn frames_travel_without_a_copy() {
    let pair = zenoh();
    let (publisher, sink, _guard) = connected(&pair, &port("world", "camera"), false);
    let mut pixels = pair.writer.buffers().buffer(640 * 480);
    pixels.fill(9);
    let pixels = pixels.freeze();
    let image = Image::packed(640, 480, Encoding::Mono8, pixels.clone()).expect("the size fits");
    publisher.publish(&header(0, Image::TYPE), &image).expect("publishing");
    until("the image", || sink.len() == 1);
    let received = sink.decode::<Image>(0);
    assert!(is_shared(received.pixels()), "the reader uses shared memory where it is");
}
