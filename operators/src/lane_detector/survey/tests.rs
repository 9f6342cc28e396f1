use carril_messages::{Encoding, Payload};

use super::super::{Scratch, Threshold, detect};
use super::*;

const SIZE: (u32, u32) = (640, 480);

/// A frame whose grey value at a place is that of floor (`false`) or marking (`true`) there.
fn frame(grey: impl Fn(f64, f64, bool) -> f64) -> Image {
    let mut pixels = Vec::with_capacity((SIZE.0 * SIZE.1) as usize);
    let mut random = 1_u64;
    for y in 0..SIZE.1 {
        let slant = f64::from(480 - y) * 0.3;
        for x in 0..SIZE.0 {
            let at = f64::from(x);
            let on_marking = [100.0 + slant, 540.0 - slant].iter().any(|middle| (at - middle).abs() <= 6.0);
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let noise = (random >> 33) as f64 / f64::from(1_u32 << 31) * 6.0 - 3.0;
            let grey = grey(at / 640.0, f64::from(y) / 480.0, on_marking) + noise;
            pixels.push(grey.round().clamp(0.0, 255.0) as u8);
        }
    }
    Image::packed(SIZE.0, SIZE.1, Encoding::Mono8, Payload::from(pixels)).expect("the size fits")
}

fn of(frames: &[Image], config: &LaneDetectorConfig) -> Findings {
    let mut survey = Survey::new(config).expect("told by its grey value");
    for frame in frames {
        survey.add(frame);
    }
    survey.findings()
}

fn bright(frames: &[Image]) -> Findings {
    of(frames, &LaneDetectorConfig::default())
}

/// A threshold was proposed, and the detector finds both markings with it.
#[track_caller]
fn assert_drives(image: &Image, config: &LaneDetectorConfig, findings: &Findings) -> u8 {
    let Verdict::Divided { threshold, .. } = findings.verdict else { panic!("no threshold: {findings:?}") };
    let config = LaneDetectorConfig { threshold: Threshold::Fixed(f64::from(threshold)), ..config.clone() };
    let lane = detect(image, &config, &mut Scratch::default()).lane.expect("the lane");
    assert!(lane.near.left_px.abs() < 1.0 && lane.far.left_px.abs() < 1.0, "between both markings: {lane:?}");
    threshold
}

#[test]
fn in_even_light_the_threshold_lies_in_the_middle() {
    let image = frame(|_, _, marking| if marking { 230.0 } else { 60.0 });
    let findings = bright(std::slice::from_ref(&image));
    let threshold = assert_drives(&image, &LaneDetectorConfig::default(), &findings);
    assert!((140..=150).contains(&threshold), "between 63 and 227: {findings:?}");
    let marking = findings.marking.expect("two lines");
    let share = marking.pixels as f64 / (marking.pixels + findings.floor.expect("the rest").pixels) as f64;
    assert!((0.03..0.05).contains(&share), "26 of 640 px: {share}");
    assert_eq!((findings.frames, findings.frames_with_marking), (1, 1), "frames");
}

#[test]
fn dim_light_that_falls_off_has_a_threshold_as_long_as_there_is_a_gap() {
    let light = |x: f64| 0.3 + 0.3 * x;
    let image = frame(|x, _, marking| light(x) * if marking { 230.0 } else { 60.0 });
    let threshold = assert_drives(&image, &LaneDetectorConfig::default(), &bright(std::slice::from_ref(&image)));
    assert!((40..80).contains(&threshold), "the floor reaches 36 + noise, markings begin at 85: {threshold}");
}

#[test]
fn a_bright_floor_on_one_side_that_is_like_a_marking_on_the_other_is_told() {
    let light = |x: f64| 0.3 + 0.5 * x;
    let image = frame(|x, _, marking| light(x) * if marking { 230.0 } else { 140.0 });
    let findings = bright(&[image.clone(), image]);
    let Verdict::Overlap { gap, frames_divided } = findings.verdict else {
        panic!("no threshold can do: {findings:?}")
    };
    assert!(gap < 0, "they reach into each other by {gap}");
    assert_eq!(frames_divided, 0.0, "not even in one frame");
    let (floor, marking) = (findings.floor.expect("floor"), findings.marking.expect("marking"));
    assert!(floor.p99_5 > 105 && marking.p5 < 100, "both are known all the same: {floor:?} {marking:?}");
}

#[test]
fn light_that_changes_from_frame_to_frame_is_told_from_light_that_changes_in_the_frame() {
    let frames: Vec<Image> =
        [0.3, 1.0].map(|light| frame(move |_, _, marking| light * if marking { 230.0 } else { 80.0 })).into();
    let findings = bright(&frames);
    let Verdict::Overlap { frames_divided, .. } = findings.verdict else { panic!("69 is below 80: {findings:?}") };
    assert_eq!(frames_divided, 1.0, "each by itself has a threshold");
}

#[test]
fn a_floor_without_markings_has_no_threshold() {
    for contrast in [0.0, 4.0] {
        let image = frame(|x, _, marking| 60.0 + 40.0 * x + if marking { contrast } else { 0.0 });
        assert_eq!(bright(&[image]).verdict, Verdict::NoMarking, "{contrast} grey values are no marking");
    }
    assert_eq!(bright(&[]).verdict, Verdict::NoMarking, "no frame at all");
    let speck = Image::packed(3, 2, Encoding::Mono8, Payload::from(vec![9; 6])).expect("the size fits");
    assert_eq!(bright(&[speck]).verdict, Verdict::NoMarking, "a tiny image");
}

#[test]
fn dark_markings_are_below_the_threshold() {
    let config = LaneDetectorConfig { marking: Marking::Dark, ..LaneDetectorConfig::default() };
    let image = frame(|_, _, marking| if marking { 40.0 } else { 200.0 });
    let threshold = assert_drives(&image, &config, &of(std::slice::from_ref(&image), &config));
    assert!((115..=125).contains(&threshold), "{threshold}");
}

#[test]
fn specks_belong_to_the_floor_and_a_bright_area_is_told() {
    let specks = frame(|x, y, marking| match (marking, (x * 640.0) as u32 % 40, (y * 480.0) as u32 % 5) {
        (true, ..) => 230.0,
        (_, 0..3, 0) => 110.0,
        _ => 60.0,
    });
    let threshold = assert_drives(&specks, &LaneDetectorConfig::default(), &bright(std::slice::from_ref(&specks)));
    assert!(threshold > 115, "above the specks: {threshold}");
    let wall = frame(|x, _, marking| if marking || x > 0.6 { 230.0 } else { 60.0 });
    assert!(matches!(bright(&[wall]).verdict, Verdict::Overlap { .. }), "a white wall counts as floor");
}

#[test]
fn colours_have_no_threshold() {
    let range = super::super::HsvRange { h: [90, 130], s: [0, 255], v: [0, 255] };
    let config = LaneDetectorConfig { marking: Marking::Hsv(range), ..LaneDetectorConfig::default() };
    assert!(Survey::new(&config).is_err_and(|why| why.contains("colour")), "told by its colour");
}
