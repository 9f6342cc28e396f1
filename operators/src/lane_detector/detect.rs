//! The algorithm: the line through the centroids of the marking pixels in two bands of rows. Touches no pixel outside the
//! bands, allocates nothing once its scratch memory has grown to the size of the bands, and keeps nothing from image to image.

use std::ops::Range;

use carril_messages::{Centroid, Image, Lane, LaneEstimate};

use super::config::{LaneDetectorConfig, Marking, Threshold};
use super::otsu::{self, Split};
use super::pixels;

/// Memory that [`detect`] uses again and again.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    /// Grey values (or colour mask) of the bands, row by row, far band first.
    values: Vec<u8>,
}

/// How a value of the scratch memory is told to be marking.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Test {
    /// A grey value above it.
    Above(u8),
    /// A grey value up to it.
    UpTo(u8),
    /// A mask that is set.
    Mask,
}

/// Finds the lane in an image.
pub fn detect(image: &Image, config: &LaneDetectorConfig, scratch: &mut Scratch) -> LaneEstimate {
    let bands = [config.row_far, config.row_near].map(|row| band_rows(image.height(), row, config.band_px));
    convert(image, &bands, &config.marking, scratch);
    let (test, contrast) = match (&config.marking, config.threshold) {
        (Marking::Hsv(_), _) => (Test::Mask, None),
        (marking, Threshold::Fixed(value)) => (grey_test(marking, value as u8), None),
        (marking, Threshold::Otsu) => {
            let Split { threshold, contrast } = otsu::split(&scratch.values);
            (grey_test(marking, threshold), Some(contrast))
        }
    };
    let threshold = test.threshold();
    let found = lane(image, config, &bands, &scratch.values, test);
    let contrast_trust = contrast.map_or(1.0, |contrast| contrast_trust(contrast, config.min_contrast));
    match found {
        Some((lane, quality)) if contrast_trust > 0.0 => {
            LaneEstimate { lane: Some(lane), quality: quality.min(contrast_trust) as f32, threshold }
        }
        _ => LaneEstimate { lane: None, quality: 0.0, threshold },
    }
}

/// The rows of a band whose middle lies at `row`, a share of the height.
pub(crate) fn band_rows(height: u32, row: f64, band_px: u32) -> Range<u32> {
    let middle = ((f64::from(height) * row) as u32).min(height.saturating_sub(1));
    let start = middle.saturating_sub(band_px.saturating_sub(1) / 2);
    start..start.saturating_add(band_px).min(height)
}

fn convert(image: &Image, bands: &[Range<u32>; 2], marking: &Marking, scratch: &mut Scratch) {
    let width = image.width() as usize;
    let rows = bands.iter().map(ExactSizeIterator::len).sum::<usize>();
    scratch.values.resize(rows * width, 0);
    let rows = bands.iter().flat_map(Clone::clone);
    for (y, out) in rows.zip(scratch.values.chunks_exact_mut(width)) {
        match marking {
            Marking::Hsv(range) => pixels::hsv_mask_row(image.encoding(), image.row(y), range, out),
            Marking::Bright | Marking::Dark => pixels::grey_row(image.encoding(), image.row(y), out),
        }
    }
}

pub(crate) fn grey_test(marking: &Marking, threshold: u8) -> Test {
    match marking {
        Marking::Dark => Test::UpTo(threshold),
        Marking::Bright | Marking::Hsv(_) => Test::Above(threshold),
    }
}

impl Test {
    fn threshold(self) -> Option<u8> {
        match self {
            Self::Above(value) | Self::UpTo(value) => Some(value),
            Self::Mask => None,
        }
    }

    fn count(self, row: &[u8]) -> pixels::Marked {
        match self {
            Self::Above(limit) => pixels::count_marked(row, |grey| grey > limit),
            Self::UpTo(limit) => pixels::count_marked(row, |grey| grey <= limit),
            Self::Mask => pixels::count_marked(row, |mask| mask != 0),
        }
    }
}

/// The line through both centroids, and how much it is to be trusted.
fn lane(
    image: &Image,
    config: &LaneDetectorConfig,
    bands: &[Range<u32>; 2],
    values: &[u8],
    test: Test,
) -> Option<(Lane, f64)> {
    let (far_values, near_values) = values.split_at(bands[0].len() * image.width() as usize);
    let (far, far_trust) = centroid(image, config, bands[0].clone(), far_values, test)?;
    let (near, near_trust) = centroid(image, config, bands[1].clone(), near_values, test)?;
    let rise = far.1 - near.1;
    if rise < 1.0 {
        return None;
    }
    let angle = ((far.0 - near.0) / rise).atan();
    let distance = (far.0 - angle.tan() * far.1) * angle.cos();
    let lane = Lane {
        angle_rad: angle as f32,
        distance_px: distance as f32,
        distance_m: config.metres_per_px.map(|scale| (distance * scale) as f32),
        ground: None,
        far: Centroid { left_px: far.0 as f32, ahead_px: far.1 as f32, pixels: far.2 },
        near: Centroid { left_px: near.0 as f32, ahead_px: near.1 as f32, pixels: near.2 },
    };
    Some((lane, far_trust.min(near_trust)))
}

/// Columns to the left of the middle, rows above the bottom row, count of pixels; and the trust in it.
fn centroid(
    image: &Image,
    config: &LaneDetectorConfig,
    band: Range<u32>,
    values: &[u8],
    test: Test,
) -> Option<((f64, f64, u32), f64)> {
    let width = image.width() as usize;
    let (mut count, mut column_sum, mut row_sum) = (0_u64, 0_u64, 0_u64);
    for (y, row) in band.zip(values.chunks_exact(width)) {
        let marked = test.count(row);
        count += marked.count;
        column_sum += marked.column_sum;
        row_sum += u64::from(y) * marked.count;
    }
    if count < u64::from(config.min_pixels) {
        return None;
    }
    let share = count as f64 / values.len() as f64;
    if share > config.max_share {
        return None;
    }
    let left = (width as f64 - 1.0) / 2.0 - column_sum as f64 / count as f64;
    let ahead = f64::from(image.height() - 1) - row_sum as f64 / count as f64;
    let trust = count_trust(count, config.min_pixels).min(share_trust(share, config.max_share));
    Some(((left, ahead, u32::try_from(count).unwrap_or(u32::MAX)), trust))
}

/// 1/3 at the fewest pixels allowed, 1 at three times as many.
fn count_trust(count: u64, min_pixels: u32) -> f64 {
    (count as f64 / (3.0 * f64::from(min_pixels))).min(1.0)
}

/// 1 up to half of the largest share allowed, then falling to 0 at that share: glare grows gradually.
fn share_trust(share: f64, max_share: f64) -> f64 {
    (2.0 * (1.0 - share / max_share)).clamp(0.0, 1.0)
}

/// 0 below the least contrast allowed, 1/2 at it, 1 at twice as much.
fn contrast_trust(contrast: f64, min_contrast: f64) -> f64 {
    if contrast < min_contrast {
        0.0
    } else if min_contrast > 0.0 {
        (contrast / (2.0 * min_contrast)).min(1.0)
    } else {
        1.0
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Encoding, Payload};
    use proptest::prelude::*;

    use super::super::config::HsvRange;
    use super::*;

    const WIDTH: u32 = 640;
    const HEIGHT: u32 = 480;

    /// An image of one colour with a line of another, 10 px wide, whose middle is at `column(y)`.
    fn scene(encoding: Encoding, floor: [u8; 3], line: [u8; 3], column: impl Fn(f64) -> f64) -> Image {
        let channels = encoding.bytes_per_pixel();
        let mut pixels = Vec::with_capacity((WIDTH * HEIGHT) as usize * channels);
        for y in 0..HEIGHT {
            let middle = column(f64::from(y));
            for x in 0..WIDTH {
                let on_line = (f64::from(x) - middle).abs() <= 5.0;
                pixels.extend_from_slice(&(if on_line { line } else { floor })[..channels]);
            }
        }
        Image::packed(WIDTH, HEIGHT, encoding, Payload::from(pixels)).expect("the size fits")
    }

    fn run(image: &Image, config: &LaneDetectorConfig) -> LaneEstimate {
        detect(image, config, &mut Scratch::default())
    }

    fn otsu() -> LaneDetectorConfig {
        LaneDetectorConfig { threshold: Threshold::Otsu, ..LaneDetectorConfig::default() }
    }

    #[test]
    fn a_line_straight_ahead_has_neither_angle_nor_distance() {
        let image = scene(Encoding::Bgr8, [60; 3], [230; 3], |_| 319.5);
        let estimate = run(&image, &LaneDetectorConfig::default());
        let lane = estimate.lane.expect("a clear line");
        assert!(lane.angle_rad.abs() < 1e-6 && lane.distance_px.abs() < 1e-4, "{lane:?}");
        assert_eq!(estimate.quality, 1.0, "nothing speaks against it");
        assert_eq!(estimate.threshold, Some(190), "the fixed threshold is reported");
    }

    #[test]
    fn what_lies_on_the_left_is_positive() {
        let beside = run(&scene(Encoding::Bgr8, [60; 3], [230; 3], |_| 219.0), &LaneDetectorConfig::default());
        let lane = beside.lane.expect("a clear line");
        assert!((lane.distance_px - 100.5).abs() < 1e-3, "219 is 100.5 columns left of 319.5: {lane:?}");
        assert!(lane.angle_rad.abs() < 1e-6, "parallel to the car: {lane:?}");
        // Leads to the left: the farther (the smaller y), the smaller the column.
        let leading =
            run(&scene(Encoding::Bgr8, [60; 3], [230; 3], |y| 319.5 + (y - 479.0)), &LaneDetectorConfig::default());
        let lane = leading.lane.expect("a clear line");
        assert!((lane.angle_rad - std::f32::consts::FRAC_PI_4).abs() < 0.01, "45 degrees to the left: {lane:?}");
        assert!(lane.distance_px.abs() < 1.0, "it begins below the car: {lane:?}");
    }

    #[test]
    fn all_encodings_see_the_same_line() {
        let column = |y: f64| 250.0 + y / 10.0;
        let expected = run(&scene(Encoding::Mono8, [60; 3], [230; 3], column), &LaneDetectorConfig::default());
        assert!(expected.lane.is_some(), "a clear line");
        for encoding in [Encoding::Bgr8, Encoding::Rgb8] {
            let estimate = run(&scene(encoding, [60; 3], [230; 3], column), &LaneDetectorConfig::default());
            assert_eq!(estimate, expected, "{encoding}");
        }
    }

    #[test]
    fn finds_dark_lines_and_coloured_tape() {
        let column = |_: f64| 300.0;
        let bright = run(&scene(Encoding::Bgr8, [60; 3], [230; 3], column), &LaneDetectorConfig::default());
        let dark_line = scene(Encoding::Bgr8, [220; 3], [20; 3], column);
        let dark = LaneDetectorConfig {
            marking: Marking::Dark,
            threshold: Threshold::Fixed(100.0),
            ..LaneDetectorConfig::default()
        };
        assert_eq!(run(&dark_line, &dark).lane, bright.lane, "dark on bright");
        let tape = scene(Encoding::Bgr8, [40, 120, 200], [200, 90, 30], column);
        let range = HsvRange { h: [90, 130], s: [80, 255], v: [40, 255] };
        let blue = LaneDetectorConfig { marking: Marking::Hsv(range), ..LaneDetectorConfig::default() };
        let estimate = run(&tape, &blue);
        assert_eq!(estimate.lane, bright.lane, "blue on orange");
        assert_eq!(estimate.threshold, None, "no grey value divides colours");
    }

    #[test]
    fn otsu_follows_the_light() {
        let dim = scene(Encoding::Bgr8, [20; 3], [110; 3], |_| 300.0);
        assert_eq!(run(&dim, &LaneDetectorConfig::default()).lane, None, "too dim for the fixed threshold");
        let estimate = run(&dim, &otsu());
        assert!(estimate.lane.is_some(), "found by Otsu: {estimate:?}");
        assert!(estimate.threshold.is_some_and(|value| (20..110).contains(&value)), "{estimate:?}");
    }

    #[test]
    fn an_empty_floor_is_no_lane() {
        // Uneven light and noise, but no line.
        let pixels = (0..WIDTH * HEIGHT).map(|i| (60 + i % WIDTH / 40 + i * 7919 % 13) as u8).collect::<Vec<u8>>();
        let floor = Image::packed(WIDTH, HEIGHT, Encoding::Mono8, Payload::from(pixels)).expect("the size fits");
        for config in [LaneDetectorConfig::default(), otsu()] {
            let estimate = run(&floor, &config);
            assert_eq!((estimate.lane, estimate.quality), (None, 0.0), "{:?}", config.threshold);
        }
    }

    #[test]
    fn glare_and_specks_are_no_lane() {
        let white = scene(Encoding::Mono8, [250; 3], [250; 3], |_| 0.0);
        assert_eq!(run(&white, &LaneDetectorConfig::default()).lane, None, "everything is bright");
        let line = scene(Encoding::Mono8, [60; 3], [230; 3], |_| 300.0);
        let strict = LaneDetectorConfig { min_pixels: 12, ..LaneDetectorConfig::default() };
        assert_eq!(run(&line, &strict).lane, None, "11 pixels are too few");
        let just = LaneDetectorConfig { min_pixels: 11, ..LaneDetectorConfig::default() };
        let quality = run(&line, &just).quality;
        assert!((quality - 1.0 / 3.0).abs() < 1e-6, "just enough is trusted little, got {quality}");
    }

    #[test]
    fn calibration_gives_metres() {
        let image = scene(Encoding::Mono8, [60; 3], [230; 3], |_| 219.0);
        let config = LaneDetectorConfig { metres_per_px: Some(0.002), ..LaneDetectorConfig::default() };
        let metres = run(&image, &config).lane.and_then(|lane| lane.distance_m);
        assert!(metres.is_some_and(|m| (m - 0.201).abs() < 1e-5), "100.5 px of 2 mm, got {metres:?}");
        assert_eq!(
            run(&image, &LaneDetectorConfig::default()).lane.and_then(|lane| lane.distance_m),
            None,
            "uncalibrated"
        );
    }

    #[test]
    fn scratch_carries_nothing_from_image_to_image() {
        let mut scratch = Scratch::default();
        let large = scene(Encoding::Bgr8, [60; 3], [230; 3], |_| 300.0);
        let small = Image::packed(4, 4, Encoding::Mono8, Payload::from(vec![200; 16])).expect("the size fits");
        let first = detect(&large, &otsu(), &mut scratch);
        detect(&small, &otsu(), &mut scratch);
        assert_eq!(detect(&large, &otsu(), &mut scratch), first, "the same image, the same answer");
    }

    #[test]
    fn bands_stay_in_the_image() {
        assert_eq!(band_rows(480, 0.75, 1), 360..361, "the classic far row");
        assert_eq!(band_rows(480, 0.85, 1), 408..409, "the classic near row");
        assert_eq!(band_rows(480, 1.0, 9), 475..480, "cut off at the bottom");
        assert_eq!(band_rows(480, 0.0, 9), 0..9, "and at the top");
        assert_eq!(band_rows(1, 0.85, 200), 0..1, "an image of one row");
    }

    prop_compose! {
        fn any_image()(
            width in 1_u32..90,
            height in 1_u32..60,
            padding in 0_u32..9,
            channels in 0_usize..3,
        )(
            pixels in proptest::collection::vec(any::<u8>(), ((width * [1, 3, 3][channels] + padding) * height) as usize),
            width in Just(width), height in Just(height), padding in Just(padding), channels in Just(channels),
        ) -> Image {
            let encoding = [Encoding::Mono8, Encoding::Bgr8, Encoding::Rgb8][channels];
            let stride = width * encoding.bytes_per_pixel() as u32 + padding;
            Image::with_stride(width, height, stride, encoding, Payload::from(pixels)).expect("the size fits")
        }
    }

    fn any_config() -> impl Strategy<Value = LaneDetectorConfig> {
        let marking = prop_oneof![
            Just(Marking::Bright),
            Just(Marking::Dark),
            Just(Marking::Hsv(HsvRange { h: [100, 20], s: [0, 200], v: [10, 255] })),
        ];
        let threshold = prop_oneof![(0_u8..=255).prop_map(|v| Threshold::Fixed(f64::from(v))), Just(Threshold::Otsu)];
        (marking, threshold, 0.0..0.5_f64, 0.5..=1.0_f64, 1_u32..=200, 1_u32..20).prop_map(
            |(marking, threshold, row_far, row_near, band_px, min_pixels)| LaneDetectorConfig {
                threshold,
                marking,
                row_far,
                row_near,
                band_px,
                min_pixels,
                max_share: 1.0,
                min_contrast: 0.0,
                metres_per_px: Some(0.001),
            },
        )
    }

    proptest! {
        #[test]
        fn any_image_gives_finite_numbers_within_the_image(image in any_image(), config in any_config()) {
            let estimate = run(&image, &config);
            prop_assert!((0.0..=1.0).contains(&estimate.quality), "quality {}", estimate.quality);
            if let Some(lane) = estimate.lane {
                let half = image.width() as f32 / 2.0;
                prop_assert!(lane.angle_rad.abs() < std::f32::consts::FRAC_PI_2, "{lane:?}");
                prop_assert!(lane.distance_px.is_finite() && lane.distance_m.is_some_and(f32::is_finite), "{lane:?}");
                for centroid in [lane.far, lane.near] {
                    prop_assert!(centroid.left_px.abs() <= half, "{lane:?}");
                    prop_assert!((0.0..image.height() as f32).contains(&centroid.ahead_px), "{lane:?}");
                    prop_assert!(centroid.pixels >= config.min_pixels, "{lane:?}");
                }
            }
        }
    }
}
