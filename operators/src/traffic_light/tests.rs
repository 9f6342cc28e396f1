//! The operator on images of a light that is switched, flickers, or is none, and on photographs.

use std::path::PathBuf;

use carril_messages::{Encoding, Image, LightColour};
use carril_runtime::Operator;

use super::{LightMemory, Mode, Region, TrafficLightConfig, TrafficLights};
use crate::camera::FrameFiles;

const RED: Option<LightColour> = Some(LightColour::Red);
const GREEN: Option<LightColour> = Some(LightColour::Green);

/// A lamp that is lit, on the left; `None`: a bare scene.
fn image(colour: Option<LightColour>) -> Image {
    let (width, height) = (320_u32, 240_u32);
    let mut bytes = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let away = (f64::from(x) - 80.0).hypot(f64::from(y) - 60.0);
            bytes.extend_from_slice(match colour {
                Some(_) if away <= 3.0 => &[240, 245, 255],
                Some(LightColour::Red) if away <= 6.0 => &[30, 40, 250],
                Some(_) if away <= 6.0 => &[80, 235, 30],
                _ => &[60, 60, 60],
            });
        }
    }
    Image::packed(width, height, Encoding::Bgr8, bytes.into()).expect("a picture")
}

#[test]
fn a_light_is_on_after_some_images_and_gone_after_more() {
    let mut lights = TrafficLights::from_config(TrafficLightConfig::default());
    let mut see = |colour, times| (0..times).map(|_| lights.see(&image(colour)).colour).collect::<Vec<_>>();
    assert_eq!(see(RED, 4), [None, None, RED, RED], "`on_frames` 3");
    assert_eq!(see(None, 7), [RED; 7], "it may be hidden");
    assert_eq!(see(None, 2), [None; 2], "`off_frames` 8");
    assert_eq!(see(RED, 3)[2], RED, "again");
    assert_eq!(see(GREEN, 3), [RED, RED, GREEN], "it changes");
}

#[test]
fn a_lamp_that_flickers_is_on_and_one_odd_image_is_nothing() {
    let mut lights = TrafficLights::from_config(TrafficLightConfig::default());
    let mut shown = Vec::new();
    for index in 0..40 {
        shown.push(lights.see(&image(if index % 2 == 0 { RED } else { None })).colour);
    }
    assert_eq!(shown[20..], [RED; 20], "seen in every other image");
    let mut lights = TrafficLights::from_config(TrafficLightConfig::default());
    for index in 0..80 {
        let colour = lights.see(&image(if index % 8 == 0 { RED } else { None })).colour;
        assert_eq!(colour, None, "seen in one of eight, image {index}");
    }
}

#[test]
fn black_tiny_and_grey_images_show_no_light() {
    let mut lights = TrafficLights::from_config(TrafficLightConfig {
        stop_line: Some(super::StopLineConfig::default()),
        ..TrafficLightConfig::default()
    });
    for (width, height) in [(1, 1), (640, 480), (7, 3)] {
        for encoding in [Encoding::Mono8, Encoding::Bgr8, Encoding::Rgb8] {
            let bytes = vec![0; width as usize * height as usize * encoding.bytes_per_pixel()];
            let black = Image::packed(width, height, encoding, bytes.into()).expect("a picture");
            let light = lights.see(&black);
            assert_eq!((light.colour, light.lamp, light.stop_line_m), (None, None, None), "{width}x{height}");
        }
    }
}

#[test]
fn the_plain_rule_knows_red_and_no_red() {
    let config = TrafficLightConfig { mode: Mode::Plain, ..TrafficLightConfig::default() };
    let mut lights = TrafficLights::from_config(config);
    for _ in 0..3 {
        lights.see(&image(RED));
    }
    assert_eq!(lights.see(&image(RED)).colour, RED, "many red pixels on the left");
    for _ in 0..2 {
        lights.see(&image(None));
    }
    assert_eq!(lights.see(&image(None)).colour, GREEN, "no red is go");
}

#[test]
fn a_successor_goes_on_and_a_broken_state_is_refused() {
    let mut old = TrafficLights::from_config(TrafficLightConfig::default());
    for _ in 0..3 {
        old.see(&image(RED));
    }
    let mut new = TrafficLights::from_config(TrafficLightConfig::default());
    new.restore(old.snapshot()).expect("a valid state");
    assert_eq!(new.see(&image(None)).colour, RED, "it remembers the light");
    let broken = LightMemory { trust: [f32::NAN, 0.0], shown: None };
    assert!(new.restore(broken).is_err(), "no number");
}

/// A toy light whose lamps are painted, on a cluttered desk before a wide-angle camera.
#[test]
fn real_photographs_are_read_rightly() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/lights");
    if !folder.is_dir() {
        eprintln!("skipped: there are no photographs in `{}`", folder.display());
        return;
    }
    let whole = Region { left: 0.0, right: 1.0, top: 0.0, bottom: 0.6 };
    let config =
        TrafficLightConfig { region: whole, min_core: 0.0, min_radius_px: 5.0, ..TrafficLightConfig::default() };
    for (name, expected) in [("red_light.jpg", RED), ("green_light.jpg", GREEN), ("no_obj.jpg", None)] {
        let mut lights = TrafficLights::from_config(config.clone());
        let path = folder.join(name).display().to_string();
        let image = FrameFiles::open(&path).expect("it is there").next().expect("one").expect("a picture");
        let found = (0..4).map(|_| lights.see(&image)).last().expect("four looks");
        assert_eq!(found.colour, expected, "{name}: {found:?}");
    }
}
