//! Random closed tracks by seed: smooth, never tighter than a metre, never close to themselves.

use std::f64::consts::TAU;

use nalgebra::Point2;
use rand::RngExt;

use super::rules::{DASH_M, FLOOR, LANE_WIDTH_M, MARKING_WIDTH_M, PAINT};
use super::{Floor, Lane, Markings, Style, Track};
use crate::centre_line::CentreLine;
use crate::noise;

/// No curve of the centre line is tighter, m.
pub const MIN_RADIUS_M: f64 = 1.0;
/// Length of a lap, m.
pub const LENGTH_M: std::ops::RangeInclusive<f64> = 10.0..=30.0;
/// Two stretches never come closer, middle to middle, m: the markings of one stay out of the camera's view from the other.
pub const MIN_APPROACH_M: f64 = 3.0 * LANE_WIDTH_M;
/// Stretches count as two when they are this far apart on the road, m: half a turn of the tightest curve is longer.
pub const APART_M: f64 = 2.0;
/// Waves around the middle of the track, of 2, 3, ... periods.
const WAVES: usize = 5;

/// What is drawn along the curve.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One lane between two solid lines.
    Lane,
    /// A road with two lanes and a dashed line between them; the car drives in the right one.
    Road,
}

impl Kind {
    /// How near two stretches may come, middle to middle of the lane, m.
    fn min_approach_m(self) -> f64 {
        match self {
            Self::Lane => MIN_APPROACH_M,
            // The other lane of one of them lies between them.
            Self::Road => MIN_APPROACH_M + LANE_WIDTH_M,
        }
    }

    fn styles(self) -> [Style; 4] {
        match self {
            Self::Lane => [Style::Solid, Style::None, Style::Solid, Style::None],
            Self::Road => [Style::Dashed, Style::None, Style::Solid, Style::Solid],
        }
    }
}

/// The track of a seed.
pub fn track(name: &str, kind: Kind, seed: u64) -> Track {
    let centre = (0..)
        .find_map(|attempt| candidate(kind, seed, attempt))
        .expect("candidates are drawn without end, and one in some fits");
    let lane = Lane { centre, width_m: LANE_WIDTH_M };
    let start = lane.pose_at(0.0, 0.0);
    let markings = Markings {
        floor: FLOOR,
        paint: PAINT,
        width_m: MARKING_WIDTH_M,
        styles: kind.styles(),
        dash_m: DASH_M,
        gap_m: DASH_M,
    };
    let floor = Floor::Drawn(markings);
    Track {
        name: name.to_owned(),
        lane: Some(lane),
        floor,
        boxes: Vec::new(),
        walls: Vec::new(),
        lights: Vec::new(),
        start,
    }
}

/// A closed curve around the origin whose distance from it is a sum of waves, scaled so that its tightest curve is a bit over a
/// metre; `None` when it is too short, too long, or too close to itself.
fn candidate(kind: Kind, seed: u64, attempt: u64) -> Option<CentreLine> {
    let mut rng = noise::generator(&[seed, attempt, 0x0074_7261_636B]);
    let mut uniform = |min: f64, max: f64| min + (max - min) * rng.random::<f64>();
    let waves: [(f64, f64); WAVES] =
        std::array::from_fn(|k| (uniform(0.0, 0.55) / (k as f64 + 2.0).powf(1.2), uniform(0.0, TAU)));
    let tightest_m = uniform(MIN_RADIUS_M * 1.02, MIN_RADIUS_M * 1.35);
    let clockwise = uniform(0.0, 1.0) < 0.5;
    let shape = |angle: f64| {
        let wave = |(k, (height, phase)): (usize, &(f64, f64))| height * ((k as f64 + 2.0) * angle + phase).cos();
        1.0 + waves.iter().enumerate().map(wave).sum::<f64>()
    };
    let points = |scale_m: f64| -> Vec<Point2<f64>> {
        let at = |i: u32| f64::from(i) / 6000.0 * if clockwise { -TAU } else { TAU };
        let point = |angle: f64| Point2::new(angle.cos(), angle.sin()) * (scale_m * shape(angle));
        (0..6000).map(|i| point(at(i))).collect()
    };
    if points(1.0).iter().any(|point| point.coords.norm() < 0.15) {
        return None;
    }
    let scale_m = 2.0 * tightest_m / CentreLine::through(&points(2.0)).min_radius_m();
    if !(scale_m * TAU <= *LENGTH_M.end() && scale_m > 0.5) {
        return None;
    }
    let line = CentreLine::through(&points(scale_m));
    let fits = LENGTH_M.contains(&line.length_m())
        && line.min_radius_m() >= MIN_RADIUS_M
        && line.self_approach_m(APART_M) >= kind.min_approach_m();
    fits.then_some(line)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hundred_seeds_keep_the_rules() {
        let mut longest = 0.0_f64;
        let mut clockwise = 0;
        for seed in 0..100 {
            let track = track("random", Kind::Lane, seed);
            let line = track.lane.expect("a random track has a lane").centre;
            assert!(LENGTH_M.contains(&line.length_m()), "seed {seed}: length {} m", line.length_m());
            assert!(line.min_radius_m() >= MIN_RADIUS_M, "seed {seed}: radius {} m", line.min_radius_m());
            let near_m = line.self_approach_m(APART_M);
            assert!(near_m >= 2.0 * LANE_WIDTH_M, "seed {seed}: comes {near_m} m close to itself");
            longest = longest.max(line.length_m());
            let area: f64 = line.points().windows(2).map(|pair| pair[0].coords.perp(&pair[1].coords)).sum();
            clockwise += u32::from(area < 0.0);
        }
        assert!(longest > 15.0, "some tracks are long, the longest has {longest} m");
        assert!((20..80).contains(&clockwise), "both directions come up, {clockwise} of 100 are clockwise");
    }

    #[test]
    fn a_road_has_room_for_its_other_lane() {
        for seed in 0..20 {
            let road = track("random-road", Kind::Road, seed).lane.expect("a road has a lane").centre;
            let near_m = road.self_approach_m(APART_M);
            assert!(near_m >= 3.9 * LANE_WIDTH_M, "seed {seed}: comes {near_m} m close to itself");
            assert!(road.min_radius_m() >= MIN_RADIUS_M, "seed {seed}: radius {} m", road.min_radius_m());
        }
    }

    #[test]
    fn a_seed_is_a_track() {
        assert_eq!(track("a", Kind::Lane, 17), track("a", Kind::Lane, 17), "same seed");
        assert_ne!(track("a", Kind::Lane, 17).lane, track("a", Kind::Lane, 18).lane, "another seed");
    }
}
