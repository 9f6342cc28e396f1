//! The detector on drawn floors whose truth is known: curves, dashes, shadows, gaps, and images that are none.

use carril_messages::{Encoding, FaultSet, GroundLane, Image, LaneEstimate, Payload, Stamp, WheelTelemetry};
use carril_runtime::{Operator, Setup, Trigger};
use nalgebra::Vector2;

use super::floor::Floor;
use super::*;
use crate::lane_curve::{Curve, State};
use crate::lane_detector::{HsvRange, LaneDetector, Marking};
use crate::testing::{at_ms, context, header};

const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;

/// A drawn floor: lines beside a curve, as the default camera sees them.
struct Scene {
    state: State,
    /// In lane widths to the left of the lane's middle, with the length of dashes and gaps, m.
    lines: Vec<(f64, f64)>,
    floor: [u8; 3],
    paint: [u8; 3],
    /// Factor on the light of each pixel, by its column and row.
    light: fn(u32, u32) -> f64,
    /// Nothing is painted from here to there along the lane, m.
    gap: std::ops::Range<f64>,
}

fn even(_: u32, _: u32) -> f64 {
    1.0
}

/// A lane of 0.4 m between two solid lines.
fn scene(offset_m: f64, heading_rad: f64, curvature_per_m: f64) -> Scene {
    Scene {
        state: State::from([offset_m, heading_rad, curvature_per_m, 0.0, 0.4]),
        lines: vec![(0.5, 0.0), (-0.5, 0.0)],
        floor: [60; 3],
        paint: [230; 3],
        light: even,
        gap: 0.0..0.0,
    }
}

impl Scene {
    fn draw(&self) -> Image {
        let floor = Floor::new(WIDTH, HEIGHT, CameraPose::default());
        let curve = Curve::new(&self.state);
        let mut pixels = Vec::with_capacity((WIDTH * HEIGHT * 3) as usize);
        for y in 0..HEIGHT {
            let row = floor.row(y);
            for x in 0..WIDTH {
                let point = row
                    .map(|row| Vector2::new(row.ahead_m, (floor.middle_column() - f64::from(x)) * row.metres_per_px));
                let painted = point.is_some_and(|point| self.painted(curve, point));
                let light = (self.light)(x, y);
                let colour = if painted { self.paint } else { self.floor };
                pixels.extend(colour.map(|value| (f64::from(value) * light).min(255.0) as u8));
            }
        }
        Image::packed(WIDTH, HEIGHT, Encoding::Bgr8, Payload::from(pixels)).expect("the size fits")
    }

    fn painted(&self, curve: Curve, point: Vector2<f64>) -> bool {
        let seen = curve.locate(point);
        !self.gap.contains(&seen.along_m)
            && self.lines.iter().any(|(line, dash_m)| {
                let drawn = *dash_m == 0.0 || seen.along_m.rem_euclid(2.0 * dash_m) < *dash_m;
                drawn && (seen.left_m - line * 0.4).abs() <= 0.01
            })
    }
}

fn see(scene: &Scene, config: LaneLinesConfig) -> LaneEstimate {
    Detector::new(config).see(&scene.draw(), Stamp::ZERO)
}

#[track_caller]
fn ground(estimate: &LaneEstimate) -> GroundLane {
    estimate.lane.and_then(|lane| lane.ground).unwrap_or_else(|| panic!("no lane: {estimate:?}"))
}

#[track_caller]
fn assert_near(found: &GroundLane, scene: &Scene, what: &str) {
    let expected = &scene.state;
    assert!((f64::from(found.offset_m) - expected[0]).abs() < 0.012, "{what}: offset {found:?}");
    assert!((f64::from(found.heading_rad) - expected[1]).abs() < 0.04, "{what}: heading {found:?}");
    assert!((f64::from(found.curvature_per_m) - expected[2]).abs() < 0.15, "{what}: curvature {found:?}");
    assert!((f64::from(found.width_m) - 0.4).abs() < 0.02, "{what}: width {found:?}");
}

#[test]
fn measures_offset_heading_and_curvature() {
    for (offset, heading, curvature) in
        [(0.0, 0.0, 0.0), (0.06, 0.0, 0.0), (-0.05, 0.15, 0.0), (0.0, 0.0, 0.9), (0.03, -0.1, -0.8)]
    {
        let scene = scene(offset, heading, curvature);
        let estimate = see(&scene, LaneLinesConfig::default());
        assert_near(&ground(&estimate), &scene, "both lines");
        assert!(estimate.quality > 0.8, "a clear lane is trusted: {estimate:?}");
    }
}

#[test]
fn one_line_is_enough() {
    for line in [0.5, -0.5] {
        let scene = Scene { lines: vec![(line, 0.0)], ..scene(0.02, 0.05, 0.3) };
        let found = ground(&see(&scene, LaneLinesConfig::default()));
        assert!((f64::from(found.offset_m) - 0.02).abs() < 0.03, "line {line}: {found:?}");
        assert_eq!((found.left_seen, found.right_seen), (line > 0.0, line < 0.0), "which one is known: {found:?}");
    }
}

#[test]
fn keeps_to_the_right_of_a_dashed_line() {
    let scene = Scene { lines: vec![(0.5, 0.15), (-0.5, 0.0), (1.5, 0.0)], ..scene(-0.03, 0.0, 0.4) };
    let config = LaneLinesConfig { lane: Which::Right, ..LaneLinesConfig::default() };
    assert_near(&ground(&see(&scene, config)), &scene, "the right lane");
}

#[test]
fn follows_a_single_line() {
    let scene = Scene { lines: vec![(0.0, 0.0)], ..scene(0.05, -0.1, 0.2) };
    let config = LaneLinesConfig { lane: Which::Follow, ..LaneLinesConfig::default() };
    let found = ground(&see(&scene, config));
    assert!((found.offset_m - 0.05).abs() < 0.012 && (found.heading_rad + 0.1).abs() < 0.04, "{found:?}");
}

#[test]
fn shadows_glare_and_dim_light_change_nothing() {
    let shadow = |x: u32, y: u32| if (x + y) % 200 < 90 { 0.3 } else { 1.0 };
    let glare =
        |x: u32, y: u32| 1.0 + 6.0 * f64::from(u8::from((x as i32 - 180).pow(2) + (y as i32 - 170).pow(2) < 900));
    let dim = |x: u32, _: u32| 0.12 + f64::from(x) / 1200.0;
    for (what, light) in [("shadow", shadow as fn(u32, u32) -> f64), ("glare", glare), ("dim", dim)] {
        let scene = Scene { light, ..scene(0.03, 0.05, 0.4) };
        assert_near(&ground(&see(&scene, LaneLinesConfig::default())), &scene, what);
    }
}

#[test]
fn dark_lines_and_coloured_tape_are_lines_too() {
    let dark = Scene { floor: [220; 3], paint: [40; 3], ..scene(0.02, 0.0, 0.5) };
    let config = LaneLinesConfig { marking: Marking::Dark, ..LaneLinesConfig::default() };
    assert_near(&ground(&see(&dark, config.clone())), &dark, "dark");
    // Of the same grey as the floor.
    let blue = Scene { floor: [60, 120, 170], paint: [220, 110, 60], ..scene(0.02, 0.0, 0.5) };
    let range = HsvRange { h: [90, 130], s: [80, 255], v: [40, 255] };
    let config = LaneLinesConfig { marking: Marking::Hsv(range), ..config };
    assert_near(&ground(&see(&blue, config)), &blue, "blue");
}

fn wheels(speed_m_s: f32, steering_rad: f32) -> WheelTelemetry {
    WheelTelemetry {
        ticks: 0,
        tick_period_us: None,
        speed_m_s,
        steering_rad,
        battery_v: None,
        faults: FaultSet::NONE,
        driving: true,
        last_command_seq: None,
        round_trip_us: None,
        frames_lost: 0,
        frames_damaged: 0,
    }
}

/// Gives the operator an image, and what the wheels do.
fn step(lines: &mut LaneLines, image: &Image, speed_m_s: Option<f32>, ms: i64) -> LaneEstimate {
    let (mut inputs, mut outputs) = (LaneLinesInputs::default(), LaneLinesOutputs::default());
    if let Some(speed_m_s) = speed_m_s {
        inputs.wheels.put(wheels(speed_m_s, 0.0), header::<WheelTelemetry>(at_ms(ms)));
    }
    inputs.image.put(image.clone(), header::<Image>(at_ms(ms)));
    lines.step(&mut inputs, &mut outputs, &context(at_ms(ms), Trigger::Input)).expect("a step");
    LaneEstimate::clone(&outputs.lane.sent().pop().expect("one estimate per frame"))
}

fn operator(config: LaneLinesConfig) -> LaneLines {
    LaneLines::new(config, &Setup::for_tests("lane")).expect("the configuration is good")
}

fn empty() -> Image {
    Scene { lines: Vec::new(), ..scene(0.0, 0.0, 0.0) }.draw()
}

#[test]
fn bridges_a_gap_by_odometry_and_no_farther() {
    let mut lines = operator(LaneLinesConfig { bridge_m: 0.3, ..LaneLinesConfig::default() });
    // A lane that leads away to the left: driving straight on, the car gets to its right.
    let image = scene(0.0, 0.2, 0.0).draw();
    step(&mut lines, &image, Some(0.5), 0);
    let mut trust = 1.0;
    for frame in 1..=5 {
        let estimate = step(&mut lines, &empty(), Some(0.5), 100 * frame);
        let found = ground(&estimate);
        let way_m = 0.05 * frame as f32;
        assert!((found.offset_m - way_m * 0.2_f32.sin()).abs() < 0.01, "after {way_m} m: {found:?}");
        assert!((found.bridged_m - way_m).abs() < 1e-3 && !found.left_seen, "after {way_m} m: {found:?}");
        assert!(estimate.quality < trust, "the trust falls: {estimate:?}");
        trust = estimate.quality;
    }
    step(&mut lines, &empty(), Some(0.5), 600);
    assert_eq!(step(&mut lines, &empty(), Some(0.5), 700).lane, None, "0.35 m are too far");
    assert!(step(&mut lines, &image, Some(0.5), 800).lane.is_some(), "and it is found again");
}

#[test]
fn without_odometry_the_lane_is_held_for_a_while() {
    let mut lines = operator(LaneLinesConfig { bridge_s: 0.2, ..LaneLinesConfig::default() });
    step(&mut lines, &scene(0.0, 0.0, 0.0).draw(), None, 0);
    assert!(step(&mut lines, &empty(), None, 100).lane.is_some(), "0.1 s");
    assert_eq!(step(&mut lines, &empty(), None, 300).lane, None, "0.3 s");
}

#[test]
fn images_without_a_lane_are_no_lane() {
    let flat = |value: u8, size: (u32, u32)| {
        let pixels = vec![value; (size.0 * size.1) as usize];
        Image::packed(size.0, size.1, Encoding::Mono8, Payload::from(pixels)).expect("the size fits")
    };
    for image in [flat(0, (640, 480)), flat(255, (640, 480)), flat(90, (1, 1)), flat(200, (3, 2)), flat(7, (64, 1))] {
        let mut detector = Detector::new(LaneLinesConfig::default());
        for frame in 0..3 {
            let estimate = detector.see(&image, at_ms(33 * frame));
            assert_eq!((estimate.lane, estimate.quality), (None, 0.0), "{}x{}", image.width(), image.height());
        }
    }
}

#[test]
fn noise_is_no_lane_for_long_and_never_a_number_that_is_none() {
    let mut detector = Detector::new(LaneLinesConfig::default());
    let mut noise = 1_u64;
    for frame in 0..40 {
        let pixels: Vec<u8> = (0..WIDTH * HEIGHT)
            .map(|_| {
                noise = noise.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (noise >> 56) as u8
            })
            .collect();
        let image = Image::packed(WIDTH, HEIGHT, Encoding::Mono8, Payload::from(pixels)).expect("the size fits");
        let estimate = detector.see(&image, at_ms(33 * frame));
        assert!((0.0..=1.0).contains(&estimate.quality), "{estimate:?}");
        assert!(estimate.lane.is_none_or(|lane| lane.ground.is_some_and(|ground| ground.is_finite())), "{estimate:?}");
    }
}

#[test]
fn the_image_fields_agree_with_the_floor() {
    let estimate = see(&scene(0.0, 0.0, 0.0), LaneLinesConfig::default());
    let lane = estimate.lane.expect("a lane");
    assert!(lane.angle_rad.abs() < 0.03 && lane.distance_px.abs() < 4.0, "straight on: {lane:?}");
    let left = see(&scene(0.05, 0.0, 0.0), LaneLinesConfig::default()).lane.expect("a lane");
    assert!(left.near.left_px > 10.0 && left.distance_px > 10.0, "what lies on the left is positive: {left:?}");
    assert!(left.far.left_px < left.near.left_px, "perspective draws it to the middle: {left:?}");
}

#[test]
fn takes_the_place_of_the_classic_detector_and_gives_it_back() {
    let mut lines = operator(LaneLinesConfig::default());
    step(&mut lines, &scene(0.0, 0.1, 0.0).draw(), None, 0);
    let memory = lines.snapshot();
    let mut successor = operator(LaneLinesConfig::default());
    successor.restore(memory.clone()).expect("its own state");
    assert_eq!(step(&mut successor, &empty(), None, 50), step(&mut lines, &empty(), None, 50), "goes on alike");
    let classic = LaneLines::migrate(LaneDetector::STATE_VERSION, &[]).expect("that of `lane-detector`");
    assert_eq!(classic, LaneMemory::default(), "which knows no lane");
    assert!(LaneDetector::migrate(LaneLines::STATE_VERSION, &[]).is_ok(), "and the other way round");
    assert!(LaneLines::migrate(7, &[]).is_err(), "no other version");
}
