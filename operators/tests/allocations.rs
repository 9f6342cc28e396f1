//! The lane detector takes no memory once it is warm: a counting allocator sees every request of this thread.
#![allow(
    unsafe_code,
    reason = "an allocator can only be written with unsafe; this one counts and passes on to the system's"
)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use carril_messages::{Encoding, Image, Payload, Stamp};
use carril_operators::lane_detector::{HsvRange, LaneDetectorConfig, Marking, Scratch, Threshold, detect};
use carril_operators::lane_lines::{Detector, LaneLinesConfig};

thread_local! {
    static REQUESTS: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn count() {
    // While a thread ends its counter is gone; nobody asks for it then.
    let _ = REQUESTS.try_with(|requests| requests.set(requests.get() + 1));
}

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promise holds for the system's allocator too.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the pointer came from the system's allocator.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count();
        // SAFETY: the pointer came from the system's allocator.
        unsafe { System.realloc(pointer, layout, new_size) }
    }
}

fn requests(run: impl FnOnce()) -> u64 {
    let before = REQUESTS.get();
    run();
    REQUESTS.get() - before
}

fn image(encoding: Encoding) -> Image {
    let row = 640 * encoding.bytes_per_pixel();
    let mut pixels = vec![60; row * 480];
    for line in pixels.chunks_exact_mut(row) {
        line[row / 3..row / 3 + 30].fill(230);
    }
    Image::packed(640, 480, encoding, Payload::from(pixels)).expect("the size fits")
}

#[test]
fn the_allocator_counts() {
    assert!(requests(|| drop(std::hint::black_box(vec![1_u8; 100]))) > 0, "a vector takes memory");
}

#[test]
fn a_warm_detector_takes_no_memory() {
    let blue = Marking::Hsv(HsvRange { h: [90, 130], s: [80, 255], v: [40, 255] });
    for encoding in [Encoding::Mono8, Encoding::Bgr8, Encoding::Rgb8] {
        let image = image(encoding);
        for marking in [Marking::Bright, Marking::Dark, blue] {
            for threshold in [Threshold::Fixed(190.0), Threshold::Otsu] {
                let config = LaneDetectorConfig { marking, threshold, band_px: 5, ..LaneDetectorConfig::default() };
                let mut scratch = Scratch::default();
                detect(&image, &config, &mut scratch);
                let requests = requests(|| {
                    for _ in 0..1000 {
                        std::hint::black_box(detect(&image, &config, &mut scratch));
                    }
                });
                assert_eq!(requests, 0, "1000 detections, {encoding}, {marking:?}, {threshold:?}");
            }
        }
    }
}

#[test]
fn warm_lane_lines_take_no_memory() {
    let blue = Marking::Hsv(HsvRange { h: [90, 130], s: [80, 255], v: [40, 255] });
    for encoding in [Encoding::Mono8, Encoding::Bgr8, Encoding::Rgb8] {
        let image = image(encoding);
        for marking in [Marking::Bright, Marking::Dark, blue] {
            let mut detector = Detector::new(LaneLinesConfig { marking, ..LaneLinesConfig::default() });
            let mut see =
                |frame: i64| std::hint::black_box(detector.see(&image, Stamp::from_nanos(frame * 33_000_000)));
            see(0);
            let requests = requests(|| {
                for frame in 1..200 {
                    see(frame);
                }
            });
            assert_eq!(requests, 0, "200 frames, {encoding}, {marking:?}");
        }
    }
}
