//! What the lidar has seen of the row beside the car, kept by odometry, and the gaps in it.
//!
//! The row's flank is the line of what stands nearest to the lane. A gap is a stretch along it in which nothing stands as deep as the
//! car needs, between two neighbours whose flanks have been seen.

use serde::{Deserialize, Serialize};

use super::geometry::Place;

/// A scan is kept when the car has gone on by this, m.
const EVERY_M: f64 = 0.03;
/// So far behind the car scans are forgotten, m.
const KEPT_M: f64 = 1.2;
/// Width of the bins in which the flank is looked for, m.
const FLANK_BIN_M: f64 = 0.04;
/// Points this near to the flank's line are of it, m.
const FLANK_M: f64 = 0.035;
/// Width of the bins in which gaps are looked for, m.
const BIN_M: f64 = 0.01;
/// So much of a neighbour's flank must be seen beside a gap, m, ...
const NEIGHBOUR_M: f64 = 0.10;
/// ... that is this share of it.
const NEIGHBOUR_SHARE: f64 = 0.6;
/// A bin with fewer points than this, and than this share of the median, is empty.
const LEAST_POINTS: u32 = 3;
const LEAST_SHARE: f64 = 0.15;

/// What is looked for.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::struct_field_names, reason = "the unit belongs to each name")]
pub struct Search {
    /// The flank is no farther to the side of the car's middle, m.
    pub within_m: f64,
    /// Half of the car's width, m.
    pub half_width_m: f64,
    /// As deep as this a gap must be empty, m.
    pub depth_m: f64,
    /// What is shorter is a space between two cars, not a gap, m.
    pub least_m: f64,
    /// The lidar, ahead of the rear axle, m: it must have passed a gap.
    pub lidar_m: f64,
}

/// The points of one scan beside the car.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Kept {
    /// Where the car was, odometry frame.
    pub at: Place,
    /// Body frame, m.
    pub points: Vec<[f32; 2]>,
}

/// What has been seen of the row.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    scans: Vec<Kept>,
    /// The front end of the last gap that was judged, odometry frame.
    judged_to: Option<[f64; 2]>,
}

/// A gap as it was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// The row's frame in that of odometry: its origin is the gap's rear end, on the flank's line.
    pub row: Place,
    /// m.
    pub length_m: f64,
}

impl Row {
    /// Takes in a scan, points in the body frame, the row on the right.
    pub fn add(&mut self, at: Place, points: &[[f64; 2]], search: &Search) {
        let gone = self.scans.last().is_none_or(|last| (at.x_m - last.at.x_m).hypot(at.y_m - last.at.y_m) >= EVERY_M);
        if !gone {
            return;
        }
        self.scans.retain(|kept| (at.x_m - kept.at.x_m).hypot(at.y_m - kept.at.y_m) < KEPT_M);
        let beside =
            |point: &&[f64; 2]| point[1] < -search.half_width_m && point[1] > -search.within_m - search.depth_m;
        let near = |point: &&[f64; 2]| point[0].abs() < 1.0;
        let points = points.iter().filter(beside).filter(near).map(|[x, y]| [*x as f32, *y as f32]).collect();
        self.scans.push(Kept { at, points });
    }

    /// The scans that are kept, oldest first.
    pub fn scans(&self) -> &[Kept] {
        &self.scans
    }

    /// A gap has been judged and is no more looked at.
    pub fn passed(&mut self, candidate: &Candidate) {
        self.judged_to = Some(candidate.row.point([candidate.length_m, 0.0]));
    }

    /// The first gap behind the lidar that has not been judged yet.
    pub fn find(&self, search: &Search) -> Option<Candidate> {
        let here = self.scans.last()?.at;
        let yaw_rad = self.scans.iter().map(|kept| kept.at.yaw_rad).sum::<f64>() / self.scans.len() as f64;
        let base = Place { yaw_rad, ..here };
        let mut points: Vec<[f64; 2]> = Vec::with_capacity(4096);
        for kept in &self.scans {
            let from = base.place_seen(kept.at);
            points.extend(kept.points.iter().map(|[x, y]| from.point([f64::from(*x), f64::from(*y)])));
        }
        let (left_m, slope) = flank(&points, search)?;
        let line = base.place(Place::new(0.0, left_m, slope.atan()));
        let from_line = Place::new(0.0, left_m, slope.atan());
        for point in &mut points {
            *point = from_line.seen(*point);
        }
        let lidar_m = line.seen(here.point([search.lidar_m, 0.0]))[0];
        let judged_m = self.judged_to.map_or(f64::NEG_INFINITY, |point| line.seen(point)[0]);
        let (from_m, to_m) = gaps(&points, search)
            .into_iter()
            .find(|(from_m, to_m)| *from_m > judged_m - 0.05 && lidar_m > to_m + NEIGHBOUR_M)?;
        Some(Candidate { row: line.place(Place::new(from_m, 0.0, 0.0)), length_m: to_m - from_m })
    }
}

/// The line through what is nearest to the lane: to the left of the base, and its slope.
fn flank(points: &[[f64; 2]], search: &Search) -> Option<(f64, f64)> {
    let mut tops: Vec<(i32, f64, f64)> = Vec::new();
    let mut keyed: Vec<(i32, f64)> = points
        .iter()
        .filter(|[_, y]| *y > -search.within_m)
        .map(|[x, y]| ((x / FLANK_BIN_M).floor() as i32, *y))
        .collect();
    keyed.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)));
    for bin in keyed.chunk_by(|a, b| a.0 == b.0).filter(|bin| bin.len() >= 4) {
        // Not the very nearest: that is noise. The quarter of them that is nearest to the lane.
        let nearest = &bin[..bin.len().div_ceil(4)];
        let mean = nearest.iter().map(|(_, y)| y).sum::<f64>() / nearest.len() as f64;
        tops.push((bin[0].0, (f64::from(bin[0].0) + 0.5) * FLANK_BIN_M, mean));
    }
    let mut sorted: Vec<f64> = tops.iter().map(|top| top.2).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let mut line = (*sorted.get(sorted.len() * 7 / 10)?, 0.0);
    for within_m in [0.08, 0.05, FLANK_M, FLANK_M] {
        let of_it: Vec<_> = tops.iter().filter(|(_, x, y)| (y - line.0 - line.1 * x).abs() < within_m).collect();
        let count = of_it.len() as f64;
        if of_it.len() < 4 {
            return None;
        }
        let (mean_x, mean_y) = of_it.iter().fold((0.0, 0.0), |sum, (_, x, y)| (sum.0 + x / count, sum.1 + y / count));
        let spread: f64 = of_it.iter().map(|(_, x, _)| (x - mean_x).powi(2)).sum();
        let slope = of_it.iter().map(|(_, x, y)| (x - mean_x) * (y - mean_y)).sum::<f64>() / spread.max(1e-9);
        line = (mean_y - slope * mean_x, slope);
    }
    (line.1.abs() < 0.3).then_some(line)
}

/// The empty stretches between two neighbours, by their ends along the line, m, the rearmost first.
fn gaps(points: &[[f64; 2]], search: &Search) -> Vec<(f64, f64)> {
    let Some(first_m) = points.iter().map(|point| point[0]).min_by(f64::total_cmp) else { return Vec::new() };
    let bin = |x: f64| ((x - first_m) / BIN_M) as usize;
    let Some(last) = points.iter().map(|point| bin(point[0])).max() else { return Vec::new() };
    let (mut within, mut of_flank) = (vec![0_u32; last + 1], vec![0_u32; last + 1]);
    for [x, y] in points {
        if *y > -search.depth_m && *y < FLANK_M {
            within[bin(*x)] += 1;
            of_flank[bin(*x)] += u32::from(y.abs() < FLANK_M);
        }
    }
    let mut some: Vec<u32> = within.iter().copied().filter(|count| *count > 0).collect();
    some.sort_unstable();
    let Some(median) = some.get(some.len() / 2) else { return Vec::new() };
    let least = LEAST_POINTS.max((f64::from(*median) * LEAST_SHARE) as u32);
    let neighbour = (NEIGHBOUR_M / BIN_M) as usize;
    let seen = |bins: &[u32]| {
        let full = bins.iter().filter(|count| **count >= LEAST_POINTS).count();
        bins.len() == neighbour && full as f64 >= NEIGHBOUR_SHARE * neighbour as f64
    };
    let (mut found, mut begin) = (Vec::new(), None);
    for index in 0..=last {
        if within[index] < least {
            begin = begin.or(Some(index));
            continue;
        }
        if let Some(begin) = begin.take()
            && (index - begin) as f64 * BIN_M >= search.least_m
            && seen(&of_flank[begin.saturating_sub(neighbour)..begin])
            && seen(&of_flank[index..(index + neighbour).min(last + 1)])
        {
            let at = |bin: usize| first_m + bin as f64 * BIN_M;
            found.push((at(begin), at(index)));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::super::world::{Noise, World};
    use super::*;

    const SEARCH: Search = Search { within_m: 0.6, half_width_m: 0.095, depth_m: 0.21, least_m: 0.2, lidar_m: 0.18 };

    /// Drives past a row, 25 cm beside its flank and askew, and gives what is found.
    fn past(world: &World, yaw_deg: f64, noise: &mut Noise) -> Vec<Candidate> {
        let (mut row, mut found) = (Row::default(), Vec::new());
        let start = Place::new(-1.0, 0.25, yaw_deg.to_radians());
        for step in 0..100 {
            let at = start.after(0.03 * f64::from(step), 0.0);
            let odometry = start.place_seen(at);
            row.add(odometry, &world.scan(at, noise), &SEARCH);
            if let Some(candidate) = row.find(&SEARCH) {
                row.passed(&candidate);
                found.push(Candidate { row: start.place(candidate.row), ..candidate });
            }
        }
        found
    }

    #[test]
    fn finds_each_gap_once_and_where_it_is() {
        let mut noise = Noise::new(3);
        for length_m in [0.25, 0.45, 0.6] {
            for yaw_deg in [-2.0, 0.0, 2.0] {
                let world = World::row(&[
                    (-1.2, 0.4),
                    (-0.75, 0.4),
                    (-0.4 + 0.05, 0.35),
                    (length_m, 0.4),
                    (length_m + 0.45, 0.4),
                ]);
                let found = past(&world, yaw_deg, &mut noise);
                assert_eq!(found.len(), 1, "one gap of {length_m} m at {yaw_deg} degrees: {found:?}");
                let gap = found[0];
                let text = format!("{gap:?} of {length_m} m at {yaw_deg} degrees");
                assert!((gap.length_m - length_m).abs() < 0.05, "{text}");
                assert!(gap.row.x_m.abs() < 0.04 && gap.row.y_m.abs() < 0.02, "{text}");
                assert!(gap.row.yaw_rad.abs() < 1.5_f64.to_radians(), "{text}");
            }
        }
    }

    #[test]
    fn the_end_of_a_row_and_what_is_in_it_are_no_gap() {
        let mut noise = Noise::new(4);
        let found = past(&World::row(&[(-1.2, 0.4), (-0.75, 0.4)]), 0.0, &mut noise);
        assert_eq!(found, [], "nothing stands before it");
        let found = past(&World::default(), 0.0, &mut noise);
        assert_eq!(found, [], "nothing at all");
        let mut world = World::row(&[(-0.75, 0.4), (-0.4, 0.4), (0.6, 0.4)]);
        world.add_box([0.3, -0.12], [0.06, 0.06]);
        let found = past(&world, 0.0, &mut noise);
        assert!(found.iter().all(|gap| gap.length_m < 0.36), "something small stands in the middle: {found:?}");
    }
}
