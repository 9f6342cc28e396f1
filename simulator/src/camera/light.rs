//! Light and noise: from what the scene is to what the sensor says.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the scene is lit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Lighting {
    /// The same everywhere: markings of 230 and a floor of 60 stay so, and a fixed threshold of 190 divides them.
    #[default]
    Even,
    /// Dim, falling off to the left, to the bottom and to the corners: every marking is darker than 190, and the floor on the
    /// bright side comes near to the markings on the dark side. Within one row a threshold can still be found.
    DimGradient,
    /// The reflection of a lamp that blinds a part of the image, and two hard shadows across it; at their edges the floor is as
    /// bright here as a marking is there.
    GlareAndShadows,
}

/// Gains of `dim-gradient`: at the left and right edge, and factors at the top and bottom edge and in the corners.
const DIM: (f64, f64) = (0.42, 0.76);
const DIM_TOP_BOTTOM: (f64, f64) = (1.0, 0.70);
const DIM_CORNER: f64 = 0.88;

/// `glare-and-shadows`: the middle of the reflection and its radius, shares of the image; there everything is white.
const GLARE: (f64, f64, f64) = (0.60, 0.72, 0.09);
/// The gain within the shadows: lines may be as dark there as the floor is elsewhere.
const SHADOW: f64 = 0.30;
/// A shadow's slope, where it crosses the left edge, and its height, shares of the image.
const SHADOWS: [(f64, f64, f64); 2] = [(0.35, 0.50, 0.10), (-0.25, 0.95, 0.08)];

/// Fixed point of gains: 256 is 1.
const ONE: f64 = 256.0;

/// The gain of each pixel, in 1/256; `None` where it is 1 everywhere.
pub fn gains(lighting: Lighting, exposure: f64, width: usize, height: usize) -> Option<Vec<u16>> {
    if lighting == Lighting::Even && exposure == 1.0 {
        return None;
    }
    let gain = |index: usize| {
        let (x, y) = (index % width, index / width);
        let (x, y) = (x as f64 / (width - 1).max(1) as f64, y as f64 / (height - 1).max(1) as f64);
        let light = match lighting {
            Lighting::Even => 1.0,
            Lighting::DimGradient => {
                let gradient =
                    (DIM.0 + (DIM.1 - DIM.0) * x) * (DIM_TOP_BOTTOM.0 + (DIM_TOP_BOTTOM.1 - DIM_TOP_BOTTOM.0) * y);
                let off_axis_sq = 2.0 * ((x - 0.5).powi(2) + (y - 0.5).powi(2));
                gradient * (1.0 - (1.0 - DIM_CORNER) * off_axis_sq)
            }
            Lighting::GlareAndShadows => {
                let shaded = SHADOWS.iter().any(|(slope, at, size)| (y - at - slope * x).abs() < size / 2.0);
                // As wide as high on an image of 4:3; it fades over its own radius.
                let away = ((x - GLARE.0).hypot(0.75 * (y - GLARE.1)) / GLARE.2 - 1.0).clamp(0.0, 1.0);
                let shade = if shaded { SHADOW } else { 1.0 };
                shade + 8.0 * (1.0 - away) * (1.0 - away)
            }
        };
        (light * exposure * ONE).clamp(0.0, 65_535.0) as u16
    };
    Some((0..width * height).map(gain).collect())
}

/// Applies gain and noise to a row.
pub fn shade(scene: &[u8], gains: Option<&[u16]>, noise: Option<&[i8]>, out: &mut [u8]) {
    match gains {
        Some(gains) => {
            for ((out, scene), gain) in out.iter_mut().zip(scene).zip(gains) {
                *out = ((u32::from(*scene) * u32::from(*gain)) >> 8).min(255) as u8;
            }
        }
        None => out.copy_from_slice(scene),
    }
    if let Some(noise) = noise {
        for (out, noise) in out.iter_mut().zip(noise) {
            *out = (i16::from(*out) + i16::from(*noise)).clamp(0, 255) as u8;
        }
    }
}

/// Writes a grey row as blue, green, red.
pub fn spread_grey(grey: &[u8], bgr: &mut [u8]) {
    let mut out = bgr.chunks_exact_mut(12);
    let mut quads = grey.chunks_exact(4);
    for (quad, out) in quads.by_ref().zip(out.by_ref()) {
        // Four pixels are three words: aaab bbcc cddd, the first byte lowest.
        let [a, b, c, d] = [quad[0], quad[1], quad[2], quad[3]].map(u32::from);
        out[0..4].copy_from_slice(&((a * 0x0001_0101) | (b << 24)).to_le_bytes());
        out[4..8].copy_from_slice(&((b * 0x0000_0101) | (c * 0x0101_0000)).to_le_bytes());
        out[8..12].copy_from_slice(&(c | (d * 0x0101_0100)).to_le_bytes());
    }
    for (grey, out) in quads.remainder().iter().zip(out.into_remainder().chunks_exact_mut(3)) {
        out.fill(*grey);
    }
}

/// Writes three rows of colour as one of blue, green, red.
pub fn interleave(blue: &[u8], green: &[u8], red: &[u8], bgr: &mut [u8]) {
    for (out, ((blue, green), red)) in bgr.chunks_exact_mut(3).zip(blue.iter().zip(green).zip(red)) {
        out.copy_from_slice(&[*blue, *green, *red]);
    }
}

/// Averages over squares of `2 * radius + 1` pixels; pixels beyond the edge count as those at the edge.
pub fn blur(plane: &mut [u8], width: usize, height: usize, radius: usize) {
    let mut line = vec![0; width.max(height)];
    for row in plane.chunks_exact_mut(width) {
        line[..width].copy_from_slice(row);
        smooth(&line[..width], radius, |x, value| row[x] = value);
    }
    for x in 0..width {
        (0..height).for_each(|y| line[y] = plane[y * width + x]);
        smooth(&line[..height], radius, |y, value| plane[y * width + x] = value);
    }
}

fn smooth(line: &[u8], radius: usize, mut put: impl FnMut(usize, u8)) {
    let at = |index: isize| u32::from(line[index.clamp(0, line.len() as isize - 1) as usize]);
    let (radius, count) = (radius as isize, 2 * radius as u32 + 1);
    let mut sum: u32 = (-radius..=radius).map(at).sum();
    for index in 0..line.len() as isize {
        put(index as usize, ((sum + count / 2) / count) as u8);
        sum = sum + at(index + radius + 1) - at(index - radius);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grey_becomes_three_equal_bytes() {
        let grey: Vec<u8> = (0..11).map(|x| x * 20).collect();
        let mut bgr = vec![0; 33];
        spread_grey(&grey, &mut bgr);
        let expected: Vec<u8> = grey.iter().flat_map(|value| [*value; 3]).collect();
        assert_eq!(bgr, expected, "also where the row is no multiple of four");
    }

    #[test]
    fn dim_gradient_keeps_every_marking_below_190_and_hides_it_in_the_floor_elsewhere() {
        let gains = gains(Lighting::DimGradient, 1.0, 640, 480).expect("uneven");
        let seen = |grey: u32, x: usize, y: usize| (grey * u32::from(gains[y * 640 + x])) >> 8;
        assert!((0..480).all(|y| (0..640).all(|x| seen(230, x, y) < 190)), "no marking reaches 190");
        assert!(seen(230, 20, 470) < 2 * seen(60, 620, 170), "a dark marking is not far from a bright floor");
        for y in [360, 408] {
            let (floor, marking) = (seen(60, 639, y), (100..540).map(|x| seen(230, x, y)).min());
            assert!(
                marking > Some(floor + 25),
                "row {y}: one threshold serves the row, floor {floor}, marking {marking:?}"
            );
        }
    }

    #[test]
    fn noise_does_not_wrap() {
        let mut out = [0; 3];
        shade(&[250, 5, 100], None, Some(&[10, -10, 1]), &mut out);
        assert_eq!(out, [255, 0, 101], "clamped at both ends");
        shade(&[200, 100, 0], Some(&[512, 128, 256]), None, &mut out);
        assert_eq!(out, [255, 50, 0], "gains of 2, 0.5 and 1");
    }

    #[test]
    fn blur_keeps_the_mean_and_spreads_a_point() {
        let mut plane = vec![0; 81];
        plane[40] = 90;
        blur(&mut plane, 9, 9, 1);
        assert_eq!(plane[40], 10, "a ninth stays");
        assert_eq!(plane[30], 10, "a ninth goes to the corner");
        assert_eq!(plane.iter().map(|v| u32::from(*v)).sum::<u32>(), 90, "the sum stays");
    }
}
