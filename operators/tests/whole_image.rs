//! The lane detector and the whole-image version in OpenCV see the same lane.

#[path = "../benches/reference/mod.rs"]
mod reference;

use carril_messages::{Encoding, Image, Payload};
use carril_operators::lane_detector::{LaneDetectorConfig, Scratch, Threshold, detect};
use proptest::prelude::*;
use reference::Reference;

fn scene(width: u32, height: u32, foot: f64, lean: f64, thickness: f64, noise: &[u8]) -> Image {
    let mut pixels = Vec::with_capacity((width * height * 3) as usize);
    for y in 0..height {
        let middle = foot + lean * f64::from(height - y);
        for x in 0..width {
            let on_line = (f64::from(x) - middle).abs() <= thickness;
            let base = if on_line { 200 } else { 50 };
            let grain = |channel: usize| base + noise[(x as usize * 31 + y as usize * 17 + channel) % noise.len()] % 50;
            pixels.extend_from_slice(&[grain(0), grain(1), grain(2)]);
        }
    }
    Image::packed(width, height, Encoding::Bgr8, Payload::from(pixels)).expect("the size fits")
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn agrees_with_opencv(
        width in 64_u32..400,
        height in 48_u32..300,
        foot in 0.1..0.9_f64,
        lean in -0.5..0.5_f64,
        thickness in 2.0..6.0_f64,
        threshold in 120_u8..180,
        noise in proptest::collection::vec(any::<u8>(), 97..98),
    ) {
        let image = scene(width, height, foot * f64::from(width), lean, thickness, &noise);
        let config = LaneDetectorConfig { threshold: Threshold::Fixed(f64::from(threshold)), ..LaneDetectorConfig::default() };
        let ours = detect(&image, &config, &mut Scratch::default()).lane;
        let theirs = Reference::default().detect(&image, f64::from(threshold), config.row_far, config.row_near);
        match (ours, theirs) {
            (Some(lane), Some((angle, distance))) => {
                prop_assert!((f64::from(lane.angle_rad) - angle).abs() < 1e-4, "{lane:?}, theirs {angle} rad");
                prop_assert!((f64::from(lane.distance_px) - distance).abs() < 0.5, "{lane:?}, theirs {distance} px");
            }
            // The yardstick has no least count of pixels.
            (None, _) => {}
            (Some(lane), None) => prop_assert!(false, "{lane:?}, theirs none"),
        }
    }
}

#[test]
fn both_see_the_lane_of_a_plain_scene() {
    let image = scene(640, 480, 250.0, 0.2, 5.0, &[0]);
    let lane = detect(&image, &LaneDetectorConfig::default(), &mut Scratch::default()).lane.expect("a clear line");
    let (angle, distance) = Reference::default().detect(&image, 190.0, 0.75, 0.85).expect("a clear line");
    assert!((f64::from(lane.angle_rad) - angle).abs() < 1e-5, "{lane:?}, theirs {angle} rad");
    assert!((f64::from(lane.distance_px) - distance).abs() < 0.01, "{lane:?}, theirs {distance} px");
}
