//! The stop line: a bright band across the car's way, found on the floor. Looks along some lines that run straight ahead, side by side: a
//! stop line crosses them all, a line along the lane at most one or two. Pure.

use carril_messages::{Encoding, Image};

use super::config::StopLineConfig;
use crate::lane_lines::Floor;

/// Lines ahead, side by side.
const PATHS: usize = 9;
/// Between two looks along a path, as a share of the stop line's width.
const STEP: f64 = 0.2;
/// A stop line crosses this share of the paths.
const CROSSED: f64 = 0.75;
/// It may lie askew by so much across the car's way, m per m: 15 degrees.
const ASKEW: f64 = 0.27;

/// The near edge of the nearest stop line, m ahead of the rear axle.
pub(crate) fn stop_line(image: &Image, config: &StopLineConfig) -> Option<f32> {
    let floor = Floor::new(image.width(), image.height(), config.camera);
    let bands: Vec<(f64, Vec<f64>)> = (0..PATHS)
        .map(|path| {
            let left_m = config.across_m * (path as f64 / (PATHS - 1) as f64 - 0.5);
            (left_m, bands_along(&grey_along(image, &floor, left_m, config), config))
        })
        .collect();
    let mut starts: Vec<(f64, f64)> =
        bands.iter().flat_map(|(left_m, bands)| bands.iter().map(|ahead_m| (*left_m, *ahead_m))).collect();
    starts.sort_by(|a, b| a.1.total_cmp(&b.1));
    let needed = (CROSSED * PATHS as f64).ceil() as usize;
    starts.iter().find_map(|start| crossing(*start, &bands, config).filter(|crossed| crossed.len() >= needed)).map(
        |crossed| {
            let sum: f64 = crossed.iter().sum();
            (sum / crossed.len() as f64) as f32
        },
    )
}

/// Where the paths are crossed by a line through one band: one band of each path, as near to it as can be.
fn crossing((left_m, ahead_m): (f64, f64), bands: &[(f64, Vec<f64>)], config: &StopLineConfig) -> Option<Vec<f64>> {
    let crossed: Vec<f64> = bands
        .iter()
        .filter_map(|(other_left_m, bands)| {
            let reach_m = ASKEW * (other_left_m - left_m).abs() + config.line_width_m / 2.0;
            let near = bands.iter().filter(|band| (*band - ahead_m).abs() <= reach_m);
            near.min_by(|a, b| (*a - ahead_m).abs().total_cmp(&(*b - ahead_m).abs())).copied()
        })
        .collect();
    (!crossed.is_empty()).then_some(crossed)
}

/// Distances ahead with their grey values, the nearest first: as far as the image shows them.
fn grey_along(image: &Image, floor: &Floor, left_m: f64, config: &StopLineConfig) -> Vec<(f64, f64)> {
    let step_m = config.line_width_m * STEP;
    let count = (config.far_m / step_m).ceil().min(2000.0) as usize;
    let grey = |step: usize| {
        let ahead_m = step as f64 * step_m;
        let (column, row) = floor.pixel([ahead_m, left_m])?;
        let inside = column >= 0.0
            && row >= 0.0
            && column <= f64::from(image.width() - 1)
            && row <= f64::from(image.height() - 1);
        inside.then(|| (ahead_m, grey_at(image, column as u32, row as u32)))
    };
    (0..count).filter_map(grey).collect()
}

fn grey_at(image: &Image, column: u32, row: u32) -> f64 {
    let row = image.row(row);
    if image.encoding() == Encoding::Mono8 {
        return f64::from(row[column as usize]);
    }
    let at = column as usize * 3;
    row[at..at + 3].iter().map(|value| f64::from(*value)).sum::<f64>() / 3.0
}

/// The near edges of bands as wide as the line that are brighter than the floor before and behind them.
fn bands_along(greys: &[(f64, f64)], config: &StopLineConfig) -> Vec<f64> {
    let wide = (1.0 / STEP).round() as usize;
    let mut bands = Vec::new();
    let mut at = wide;
    while at + 2 * wide <= greys.len() {
        let mean = |from: usize| greys[from..from + wide].iter().map(|(_, grey)| grey).sum::<f64>() / wide as f64;
        // Half a width of room on both sides: edges are blurred.
        let before = mean(at - wide);
        let behind = mean(at + wide);
        let rise = mean(at) - before.max(behind);
        if rise >= config.min_contrast && is_peak(greys, at, wide) {
            bands.push(near_edge(greys, at, wide, f64::midpoint(mean(at), before)));
            at += wide;
        }
        at += 1;
    }
    bands
}

/// Whether the band is at its brightest here, not one step on.
fn is_peak(greys: &[(f64, f64)], at: usize, wide: usize) -> bool {
    let Some((_, next)) = greys.get(at + wide) else { return true };
    greys[at].1 >= *next
}

/// Where the grey value first reaches a level.
fn near_edge(greys: &[(f64, f64)], at: usize, wide: usize, level: f64) -> f64 {
    let from = at - wide;
    let rises = greys[from..at + wide].windows(2).position(|pair| pair[0].1 < level && pair[1].1 >= level);
    match rises {
        Some(index) => greys[from + index + 1].0,
        None => greys[at].0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A floor as the default camera sees it; `bright` says which of its points (ahead, left) are.
    fn floor(bright: impl Fn(f64, f64) -> bool) -> Image {
        let (width, height) = (640_u32, 480_u32);
        let floor = Floor::new(width, height, StopLineConfig::default().camera);
        let mut bytes = vec![60; (width * height) as usize];
        for y in 0..height {
            let Some(row) = floor.row(y) else { continue };
            for x in 0..width {
                let left_m = (floor.middle_column() - f64::from(x)) * row.metres_per_px;
                if bright(row.ahead_m, left_m) {
                    bytes[(y * width + x) as usize] = 230;
                }
            }
        }
        Image::packed(width, height, Encoding::Mono8, bytes.into()).expect("a picture")
    }

    #[test]
    fn finds_the_near_edge_of_a_line_across_the_way() {
        for at_m in [0.35, 0.5, 0.7, 0.9] {
            for askew in [0.0, 0.15] {
                let image = floor(|ahead, left| {
                    let along = ahead + askew * left - at_m;
                    ((0.0..0.04).contains(&along) && left.abs() < 0.2) || (left.abs() - 0.2).abs() < 0.01
                });
                let found = stop_line(&image, &StopLineConfig::default());
                assert!(found.is_some_and(|found| (f64::from(found) - at_m).abs() < 0.02), "{at_m} m: {found:?}");
            }
        }
    }

    #[test]
    fn lines_along_the_way_and_wide_bright_floor_are_none() {
        let scenes: [(&str, Image); 5] = [
            ("a lane", floor(|_, left| (left.abs() - 0.2).abs() < 0.01)),
            ("a line along the middle", floor(|_, left| left.abs() < 0.03)),
            ("a dash", floor(|ahead, left| (0.5..0.54).contains(&ahead) && left.abs() < 0.05)),
            ("a bright floor behind an edge", floor(|ahead, _| ahead > 0.6)),
            ("a bare floor", floor(|_, _| false)),
        ];
        for (name, image) in scenes {
            assert_eq!(stop_line(&image, &StopLineConfig::default()), None, "{name}");
        }
        for (width, height) in [(1, 1), (3, 200), (200, 3)] {
            let image = Image::packed(width, height, Encoding::Mono8, vec![9; (width * height) as usize].into());
            let image = image.expect("a picture");
            assert_eq!(stop_line(&image, &StopLineConfig::default()), None, "{width}x{height}");
        }
    }

    #[test]
    fn of_two_lines_the_nearer_counts() {
        let image =
            floor(|ahead, left| left.abs() < 0.2 && ((0.5..0.54).contains(&ahead) || (0.8..0.84).contains(&ahead)));
        let found = stop_line(&image, &StopLineConfig::default()).expect("two lines");
        assert!((found - 0.5).abs() < 0.02, "{found}");
    }
}
