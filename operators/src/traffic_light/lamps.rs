//! Lamps in an image: spots of a lamp's colour that are round, of a lamp's size, with a core so bright that it is white. Looks only at the
//! part of the image that is asked for. Pure.

use std::ops::Range;

use carril_messages::{Encoding, Image, Lamp, LightColour};

use super::config::TrafficLightConfig;
use crate::lane_detector::HsvRange;
use crate::lane_detector::pixels::hsv;

/// Sizes of the configuration are those in an image of so many columns.
const COLUMNS: f64 = 640.0;
/// Height over width of a lamp's spot, from the one to the other: lamps are seen at an angle, and blur.
const ASPECT: (f64, f64) = (0.6, 1.7);
/// So much of a disc is of the lamp's colour or its core; of one of a few pixels, less.
const FILLED: (f64, f64) = (0.82, 0.70);
/// A disc covers 0.785 of the square around it; a spot that covers more than this is none. Small ones are too coarse to tell.
const SQUARE: (f64, f64) = (0.90, 5.0);
/// Just outside of a lamp, from the one to the other of its radii, no more than this is of its colour.
const AROUND: (f64, f64, f64) = (1.35, 1.7, 0.2);
/// There is its housing, of one brightness, be it dark or bright: this share of it lies so near to its median, grey values.
const HOUSING: (f64, usize) = (0.75, 35);
/// Its core lies within this share of its radius.
const CORE: f64 = 0.75;
/// A pixel of the core is so little coloured, and at least this share as bright as the spot.
const WHITE: (i32, f64) = (110, 0.8);

/// Memory that is used again and again.
#[derive(Clone, Debug, Default)]
pub(crate) struct Scratch {
    chroma: Vec<u8>,
    runs: Vec<Run>,
    spots: Vec<Spot>,
    rows: [Range<usize>; 2],
}

/// Pixels of one colour side by side.
#[derive(Clone, Copy, Debug)]
struct Run {
    colour: LightColour,
    from: u32,
    to: u32,
    spot: usize,
}

/// Runs that touch.
#[derive(Clone, Copy, Debug)]
struct Spot {
    colour: LightColour,
    /// Another spot that this one has become part of.
    part_of: Option<usize>,
    area: u32,
    value: u64,
    columns: [u32; 2],
    rows: [u32; 2],
}

/// The lamps of an image, each colour's largest.
pub(crate) fn lamps(image: &Image, config: &TrafficLightConfig, scratch: &mut Scratch) -> Vec<Lamp> {
    if image.encoding() == Encoding::Mono8 {
        return Vec::new();
    }
    let share = |share: f64, of: u32| ((share * f64::from(of)).round() as u32).min(of);
    let columns = share(config.region.left, image.width())..share(config.region.right, image.width());
    let rows = share(config.region.top, image.height())..share(config.region.bottom, image.height());
    scratch.begin();
    for y in rows {
        scratch.read_row(image, y, columns.clone(), config);
    }
    let found = scratch.spots.iter().filter(|spot| spot.part_of.is_none());
    let found: Vec<Lamp> = found.filter_map(|spot| lamp(spot, image, config)).collect();
    let largest = |colour| {
        let of_colour = found.iter().filter(|lamp: &&Lamp| lamp.colour == colour);
        of_colour.max_by(|a, b| a.radius_px.total_cmp(&b.radius_px)).copied()
    };
    [LightColour::Red, LightColour::Green].into_iter().filter_map(largest).collect()
}

/// How many pixels on the left are red by the plain rule: red above 200, green and blue below.
pub(crate) fn plainly_red(image: &Image, columns_px: u32) -> u32 {
    let (r, b) = match image.encoding() {
        Encoding::Mono8 => return 0,
        Encoding::Rgb8 => (0, 2),
        _ => (2, 0),
    };
    let columns = (f64::from(columns_px) * f64::from(image.width()) / COLUMNS).round() as usize;
    let red = |pixel: &[u8]| u32::from(pixel[r] > 200 && pixel[1] < 200 && pixel[b] < 200);
    (0..image.height()).map(|y| image.row(y).chunks_exact(3).take(columns).map(red).sum::<u32>()).sum()
}

impl Scratch {
    fn begin(&mut self) {
        self.runs.clear();
        self.spots.clear();
        self.rows = [0..0, 0..0];
    }

    /// Takes in the runs of a row and joins them to those of the row above.
    fn read_row(&mut self, image: &Image, y: u32, columns: Range<u32>, config: &TrafficLightConfig) {
        let row = &image.row(y)[columns.start as usize * 3..columns.end as usize * 3];
        self.chroma.resize(columns.len(), 0);
        for (pixel, chroma) in row.chunks_exact(3).zip(&mut self.chroma) {
            let (most, least) = (pixel[0].max(pixel[1]).max(pixel[2]), pixel[0].min(pixel[1]).min(pixel[2]));
            *chroma = most - least;
        }
        let least = least_chroma(&config.red).min(least_chroma(&config.green));
        self.rows = [self.rows[1].clone(), self.runs.len()..self.runs.len()];
        let mut x = 0;
        while x < self.chroma.len() {
            // Most of a scene is grey: this skips it many pixels at a time.
            let Some(next) = self.chroma[x..].iter().position(|chroma| *chroma >= least) else { break };
            x += next;
            let (colour, value) = colour_of(row, x, image.encoding(), config);
            let from = x;
            let mut values = value as u64;
            x += 1;
            let Some(colour) = colour else { continue };
            while x < self.chroma.len() && self.chroma[x] >= least {
                let (next, value) = colour_of(row, x, image.encoding(), config);
                if next != Some(colour) {
                    break;
                }
                values += value as u64;
                x += 1;
            }
            self.add(colour, [columns.start + from as u32, columns.start + x as u32], y, values);
        }
        self.rows[1].end = self.runs.len();
    }

    fn add(&mut self, colour: LightColour, [from, to]: [u32; 2], y: u32, value: u64) {
        let mut spot = Spot { colour, part_of: None, area: to - from, value, columns: [from, to], rows: [y, y + 1] };
        let index = self.spots.len();
        for above in self.rows[0].clone() {
            let run = self.runs[above];
            // Corner to corner is side by side.
            if run.colour == colour && run.from <= to && from <= run.to {
                let other = self.root(run.spot);
                if other != index {
                    spot.join(&self.spots[other]);
                    self.spots[other].part_of = Some(index);
                }
            }
        }
        self.spots.push(spot);
        self.runs.push(Run { colour, from, to, spot: index });
    }

    fn root(&mut self, mut spot: usize) -> usize {
        while let Some(next) = self.spots[spot].part_of {
            if let Some(over) = self.spots.get(next).and_then(|next| next.part_of) {
                self.spots[spot].part_of = Some(over);
            }
            spot = next;
            if spot >= self.spots.len() {
                break;
            }
        }
        spot
    }
}

impl Spot {
    fn join(&mut self, other: &Self) {
        self.area += other.area;
        self.value += other.value;
        self.columns = [self.columns[0].min(other.columns[0]), self.columns[1].max(other.columns[1])];
        self.rows = [self.rows[0].min(other.rows[0]), self.rows[1].max(other.rows[1])];
    }
}

/// Less coloured pixels lie in no range: saturation is 255 times the chroma over the value.
fn least_chroma(range: &HsvRange) -> u8 {
    ((range.s[0] * range.v[0]) / 255).clamp(1, 255) as u8
}

fn colour_of(row: &[u8], x: usize, encoding: Encoding, config: &TrafficLightConfig) -> (Option<LightColour>, i32) {
    let colour = hsv_at(row, x, encoding);
    let named = if config.red.contains(colour) {
        Some(LightColour::Red)
    } else if config.green.contains(colour) {
        Some(LightColour::Green)
    } else {
        None
    };
    (named, colour[2])
}

fn hsv_at(row: &[u8], x: usize, encoding: Encoding) -> [i32; 3] {
    let pixel = &row[x * 3..x * 3 + 3];
    match encoding {
        Encoding::Rgb8 => hsv(pixel[2], pixel[1], pixel[0]),
        _ => hsv(pixel[0], pixel[1], pixel[2]),
    }
}

/// The lamp that a spot is, if it is one.
fn lamp(spot: &Spot, image: &Image, config: &TrafficLightConfig) -> Option<Lamp> {
    let [width, height] = [spot.columns, spot.rows].map(|[from, to]| f64::from(to - from));
    let radius = (width + height) / 4.0;
    let scale = f64::from(image.width()) / COLUMNS;
    let sizes = config.min_radius_px * scale..=config.max_radius_px * scale;
    if !sizes.contains(&radius) || height < ASPECT.0 * width || height > ASPECT.1 * width {
        return None;
    }
    let middle = [spot.columns, spot.rows].map(|[from, to]| f64::from(from + to - 1) / 2.0);
    let seen = Seen::around(spot, middle, radius, image, config);
    let square = f64::from(spot.area) / (width * height);
    let is_square = radius >= SQUARE.1 && square > SQUARE.0;
    let filled = if radius >= SQUARE.1 { FILLED.0 } else { FILLED.1 };
    let found = !is_square
        && share_of(seen.coloured + seen.core, seen.disc) >= filled
        && share_of(seen.around_coloured, seen.around) <= AROUND.2
        && seen.housing_share() >= HOUSING.0
        && share_of(seen.core, seen.disc) >= config.min_core;
    found.then(|| Lamp {
        colour: spot.colour,
        column_px: middle[0] as f32,
        row_px: middle[1] as f32,
        radius_px: radius as f32,
    })
}

/// What lies in a disc and just around it, px.
struct Seen {
    disc: u32,
    coloured: u32,
    core: u32,
    around: u32,
    around_coloured: u32,
    around_values: [u32; 256],
}

fn share_of(part: u32, of: u32) -> f64 {
    f64::from(part) / f64::from(of.max(1))
}

impl Seen {
    fn around(spot: &Spot, [x, y]: [f64; 2], radius: f64, image: &Image, config: &TrafficLightConfig) -> Self {
        let mut seen = Self { disc: 0, coloured: 0, core: 0, around: 0, around_coloured: 0, around_values: [0; 256] };
        let bright = (spot.value as f64 / f64::from(spot.area.max(1)) * WHITE.1) as i32;
        let reach = radius * AROUND.1;
        let span =
            |at: f64, limit: u32| (at - reach).floor().max(0.0) as u32..((at + reach).ceil() as u32 + 1).min(limit);
        for row in span(y, image.height()) {
            let pixels = image.row(row);
            for column in span(x, image.width()) {
                let away = (f64::from(column) - x).hypot(f64::from(row) - y) / radius;
                let colour = hsv_at(pixels, column as usize, image.encoding());
                let range = if spot.colour == LightColour::Red { &config.red } else { &config.green };
                seen.count(away, range.contains(colour), colour[1] <= WHITE.0 && colour[2] >= bright, colour[2]);
            }
        }
        seen
    }

    fn count(&mut self, away: f64, coloured: bool, white: bool, value: i32) {
        if away <= 1.0 {
            self.disc += 1;
            if coloured {
                self.coloured += 1;
            } else if white && away <= CORE {
                self.core += 1;
            }
        } else if away >= AROUND.0 && away <= AROUND.1 {
            self.around += 1;
            self.around_coloured += u32::from(coloured);
            self.around_values[value as usize & 255] += 1;
        }
    }

    /// How much of what is around it is about as bright as the median of it.
    fn housing_share(&self) -> f64 {
        let mut below = 0;
        let median = self.around_values.iter().position(|count| {
            below += count;
            below * 2 >= self.around
        });
        let median = median.unwrap_or_default();
        let near = median.saturating_sub(HOUSING.1)..(median + HOUSING.1 + 1).min(256);
        share_of(self.around_values[near].iter().sum(), self.around)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A grey scene in which `paint` gives the colour (red, green, blue) of a pixel, where it gives any.
    fn scene(width: u32, height: u32, paint: impl Fn(f64, f64) -> Option<[u8; 3]>) -> Image {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let bytes: Vec<u8> = pixels
            .flat_map(|(x, y)| {
                let [r, g, b] = paint(f64::from(x), f64::from(y)).unwrap_or([60; 3]);
                [b, g, r]
            })
            .collect();
        Image::packed(width, height, Encoding::Bgr8, bytes.into()).expect("a picture")
    }

    const RED: [u8; 3] = [250, 40, 30];
    const GREEN: [u8; 3] = [30, 230, 90];
    const WHITE: [u8; 3] = [255, 240, 235];

    /// A lamp that is lit: a halo with a white core.
    fn lit(x: f64, y: f64, at: [f64; 2], radius: f64, colour: [u8; 3]) -> Option<[u8; 3]> {
        let away = (x - at[0]).hypot(y - at[1]);
        if away <= radius * 0.5 { Some(WHITE) } else { (away <= radius).then_some(colour) }
    }

    fn found(image: &Image, config: &TrafficLightConfig) -> Vec<(LightColour, i32, i32)> {
        let lamps = lamps(image, config, &mut Scratch::default());
        lamps.iter().map(|lamp| (lamp.colour, lamp.column_px.round() as i32, lamp.row_px.round() as i32)).collect()
    }

    #[test]
    fn finds_lamps_of_both_colours_near_and_far() {
        for radius in [3.0, 6.0, 12.0, 30.0] {
            for (colour, rgb) in [(LightColour::Red, RED), (LightColour::Green, GREEN)] {
                let image = scene(640, 480, |x, y| lit(x, y, [200.0, 120.0], radius, rgb));
                let found = found(&image, &TrafficLightConfig::default());
                assert_eq!(found, [(colour, 200, 120)], "{} of radius {radius}", colour.name());
            }
        }
    }

    #[test]
    fn other_red_things_are_no_lamps() {
        let config = TrafficLightConfig::default();
        let nothing: [(&str, Image); 6] = [
            (
                "a red box",
                scene(640, 480, |x, y| {
                    ((150.0..190.0).contains(&x) && (90.0..130.0).contains(&y)).then_some([200, 40, 40])
                }),
            ),
            (
                "a far red box",
                scene(640, 480, |x, y| {
                    ((150.0..158.0).contains(&x) && (90.0..98.0).contains(&y)).then_some([200, 40, 40])
                }),
            ),
            ("red tape", scene(640, 480, |x, y| ((x - y).abs() < 6.0).then_some([220, 30, 40]))),
            ("a painted disc", scene(640, 480, |x, y| ((x - 150.0).hypot(y - 99.0) <= 9.0).then_some([190, 30, 40]))),
            ("a white marking", scene(640, 480, |x, _| (100.0..120.0).contains(&x).then_some([235; 3]))),
            ("a lamp on the right", scene(640, 480, |x, y| lit(x, y, [500.0, 120.0], 8.0, RED))),
        ];
        for (name, image) in nothing {
            assert_eq!(found(&image, &config), [], "{name}");
        }
        let painted = TrafficLightConfig { min_core: 0.0, ..config };
        let image = scene(640, 480, |x, y| ((x - 150.0).hypot(y - 99.0) <= 9.0).then_some([190, 30, 40]));
        assert_eq!(found(&image, &painted), [(LightColour::Red, 150, 99)], "painted lamps count when told so");
    }

    #[test]
    fn a_spot_that_forks_is_one_spot() {
        // A ring: its rows fall into two runs, which meet again.
        let ring = scene(640, 480, |x, y| lit(x, y, [100.0, 100.0], 20.0, RED));
        let mut scratch = Scratch::default();
        lamps(&ring, &TrafficLightConfig::default(), &mut scratch);
        assert_eq!(scratch.spots.iter().filter(|spot| spot.part_of.is_none()).count(), 1, "one ring");
    }

    #[test]
    fn the_plain_rule_counts_red_pixels_on_the_left() {
        let image = scene(640, 480, |x, y| lit(x, y, [150.0, 120.0], 10.0, RED));
        assert!(plainly_red(&image, 190) > 150, "the halo: {}", plainly_red(&image, 190));
        assert_eq!(plainly_red(&image, 100), 0, "it lies farther right");
    }

    proptest! {
        #[test]
        fn any_image_gives_lamps_within_it(
            (width, height) in (1_u32..40, 1_u32..40),
            seed: u64,
        ) {
            let mut state = seed;
            let mut byte = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                // Few values make large spots.
                [20_u8, 250][(state >> 40) as usize % 2]
            };
            let bytes: Vec<u8> = (0..width * height * 3).map(|_| byte()).collect();
            let image = Image::packed(width, height, Encoding::Bgr8, bytes.into()).expect("a picture");
            let config = TrafficLightConfig { min_core: 0.0, ..TrafficLightConfig::default() };
            for lamp in lamps(&image, &config, &mut Scratch::default()) {
                prop_assert!(lamp.column_px >= 0.0 && lamp.column_px < width as f32, "{lamp:?}");
                prop_assert!(lamp.row_px >= 0.0 && lamp.row_px < height as f32 && lamp.radius_px > 0.0, "{lamp:?}");
            }
        }
    }
}
