//! Speed of the detectors, of lanes and of traffic lights, beside the whole-image version in OpenCV: 640x480 bgr8, one frame after another from a ring that
//! does not fit the cache's nearest levels. Medians, taken in turn in one run.
//!
//! `cargo bench -p carril-operators --bench lane_detector`; with `-- --json` one JSON object per line.

mod reference;

use std::hint::black_box;
use std::time::Instant;

use carril_messages::{Encoding, Image, Payload, Stamp};
use carril_operators::lane_detector::{HsvRange, LaneDetectorConfig, Marking, Scratch, Threshold, detect};
use carril_operators::lane_lines::{Detector, LaneLinesConfig};
use carril_operators::traffic_light::{StopLineConfig, TrafficLightConfig, TrafficLights};
use reference::Reference;

const WIDTH: u32 = 640;
const HEIGHT: u32 = 480;
const FRAMES: usize = 8;
const ROUNDS: usize = 1500;

/// A floor with noise, a curved line, a traffic light and a red box, a little different in each frame.
fn frame(number: u64) -> Image {
    let mut noise = number + 1;
    let mut pixels = Vec::with_capacity((WIDTH * HEIGHT * 3) as usize);
    for y in 0..HEIGHT {
        let middle = 320.0 + (f64::from(y) - 400.0) * 0.3 + number as f64 * 7.0;
        for x in 0..WIDTH {
            noise = noise.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let grain = (noise >> 60) as u8;
            let on_line = (f64::from(x) - middle).abs() < 8.0;
            let floor = 60 + (x / 16) as u8;
            let from_lamp = (f64::from(x) - 150.0 - number as f64).hypot(f64::from(y) - 100.0);
            if from_lamp < 8.0 || ((20..60).contains(&x) && (120..160).contains(&y)) {
                pixels.extend_from_slice(if from_lamp < 4.0 { &[235, 240, 255] } else { &[30, 40, 220] });
                continue;
            }
            pixels.extend_from_slice(&if on_line { [220 + grain; 3] } else { [floor + grain, floor, floor + 10] });
        }
    }
    Image::packed(WIDTH, HEIGHT, Encoding::Bgr8, Payload::from(pixels)).expect("the size fits")
}

/// One thing to measure.
struct Case<'a> {
    name: &'static str,
    run: Box<dyn FnMut(&Image) + 'a>,
    micros: Vec<f64>,
}

fn case<'a>(name: &'static str, run: impl FnMut(&Image) + 'a) -> Case<'a> {
    Case { name, run: Box::new(run), micros: Vec::with_capacity(ROUNDS) }
}

fn ours<'a>(name: &'static str, config: LaneDetectorConfig) -> Case<'a> {
    let mut scratch = Scratch::default();
    case(name, move |image| {
        black_box(detect(black_box(image), &config, &mut scratch));
    })
}

/// With the search for the stop line.
fn lights<'a>(name: &'static str) -> Case<'a> {
    let config = TrafficLightConfig { stop_line: Some(StopLineConfig::default()), ..TrafficLightConfig::default() };
    let mut lights = TrafficLights::from_config(config);
    case(name, move |image| {
        black_box(lights.see(black_box(image)));
    })
}

/// Frames come as the ring gives them: the lane jumps now and then, so that it is searched anew more often than on a car.
fn lines<'a>(name: &'static str, config: LaneLinesConfig) -> Case<'a> {
    let mut detector = Detector::new(config);
    let mut frame = 0;
    case(name, move |image| {
        frame += 1;
        black_box(detector.see(black_box(image), Stamp::from_nanos(frame * 33_000_000)));
    })
}

fn cases<'a>() -> Vec<Case<'a>> {
    let default = LaneDetectorConfig::default;
    let blue = HsvRange { h: [90, 130], s: [80, 255], v: [40, 255] };
    let mut reference = Reference::default();
    vec![
        case("lane_detector/opencv_whole_image", move |image| {
            black_box(reference.detect(black_box(image), 190.0, 0.75, 0.85));
        }),
        ours("lane_detector/fixed", default()),
        ours("lane_detector/otsu", LaneDetectorConfig { threshold: Threshold::Otsu, ..default() }),
        ours("lane_detector/hsv", LaneDetectorConfig { marking: Marking::Hsv(blue), ..default() }),
        ours("lane_detector/fixed_band_9_rows", LaneDetectorConfig { band_px: 9, ..default() }),
        lines("lane_lines/bright", LaneLinesConfig::default()),
        lines("lane_lines/hsv", LaneLinesConfig { marking: Marking::Hsv(blue), ..LaneLinesConfig::default() }),
        lights("traffic_light/blob"),
    ]
}

fn quantile(micros: &mut [f64], share: f64) -> f64 {
    micros.sort_by(f64::total_cmp);
    micros[((micros.len() - 1) as f64 * share).round() as usize]
}

fn main() {
    let json = std::env::args().any(|argument| argument == "--json");
    // The yardstick runs on one core, like ours.
    opencv::core::set_num_threads(1).expect("a count of threads");
    let frames: Vec<Image> = (0..FRAMES as u64).map(frame).collect();
    let mut cases = cases();
    for round in 0..ROUNDS {
        for case in &mut cases {
            let started = Instant::now();
            (case.run)(&frames[round % FRAMES]);
            case.micros.push(started.elapsed().as_secs_f64() * 1e6);
        }
    }
    let baseline = quantile(&mut cases[0].micros, 0.5);
    if !json {
        println!("{:36} {:>10} {:>5} {:>10} {:>9} {:>10}", "name", "value", "unit", "baseline", "ratio", "p99");
    }
    for case in &mut cases {
        let (value, p99) = (quantile(&mut case.micros, 0.5), quantile(&mut case.micros, 0.99));
        let (name, ratio) = (case.name, value / baseline);
        if json {
            println!(
                r#"{{"name":"{name}","value":{value:.3},"unit":"us","baseline":{baseline:.3},"ratio":{ratio:.5},"p99":{p99:.3}}}"#
            );
        } else {
            println!("{name:36} {value:>10.3} {:>5} {baseline:>10.3} {ratio:>9.5} {p99:>10.3}", "us");
        }
    }
}
