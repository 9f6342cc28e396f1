//! How a lidar is mounted, from what changed in its scans when something was put beside the car: "which return moved". Pure.
//!
//! Rays are compared one by one, as medians over all scans of each side. What came nearer must be one block of neighbours: single rays are
//! noise and holes. When nothing came nearer, several things did, or half of the world moved, it says so and guesses nothing.

use std::f64::consts::{PI, TAU};

use carril_messages::{LaserScan, MAX_SCAN_POINTS};
use serde::Serialize;

use super::check_scan;

/// A ray came nearer when its range shrank by at least this, m, and by this share of what it was, and by so many times its scatter.
const NEARER: (f64, f64, f64) = (0.10, 0.10, 4.0);
/// Rays that did not come nearer inside of a block: holes in its returns.
const BRIDGED_DEG: f64 = 2.5;
/// A ray is taken together with its neighbours up to here to both sides, as their median: single holes go, edges stay.
const NEIGHBOURS_DEG: f64 = 2.0;
/// Less is no box, degrees and rays. 10 cm at a metre are 6 degrees.
const LEAST_WIDTH_DEG: f64 = 5.0;
const LEAST_RAYS: usize = 3;
/// Share of the rays of a block that must have come nearer.
const LEAST_DENSITY: f64 = 0.7;
/// The second block may have this share of the first one's rays.
const SECOND_SHARE: f64 = 0.5;
/// When more of the directions changed, be it nearer or farther, it was the car that moved.
const MOST_CHANGED: f64 = 0.35;
/// Share of the scans in which a ray must have measured something or nothing, but not failed.
const LEAST_MEASURED: f64 = 0.5;

/// What came nearer.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Block {
    /// Its middle, degrees, lidar frame, -180 to 180, + counter-clockwise.
    pub bearing_deg: f64,
    /// From edge to edge, degrees.
    pub width_deg: f64,
    /// Rays that came nearer.
    pub rays: usize,
    /// Median range before, m. `None`: nothing was within reach.
    pub before_m: Option<f64>,
    /// Median range after, m.
    pub after_m: f64,
}

/// What the comparison rests on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Figures {
    /// Scans before.
    pub scans_before: usize,
    /// Scans after.
    pub scans_after: usize,
    /// Rays of a scan.
    pub rays: usize,
    /// Rays that measured on both sides.
    pub compared: usize,
    /// Rays that came nearer.
    pub nearer: usize,
    /// Rays that went farther.
    pub farther: usize,
    /// Blocks that came nearer.
    pub blocks: usize,
}

/// Why nothing can be said.
#[derive(Clone, Debug, PartialEq)]
pub enum Refusal {
    /// A scan cannot be compared.
    Scan(String),
    /// Nothing came nearer, or too little for a thing.
    Nothing(Figures),
    /// So much changed that it was not a thing that came.
    TooMuch(Figures),
    /// Several things came nearer, none of them much more than the others. The two largest.
    Several(Figures, Box<[Block; 2]>),
}

/// Finds the one thing that came nearer between two series of scans.
pub fn what_came_nearer(
    before: &[LaserScan],
    after: &[LaserScan],
    min_range_m: f64,
) -> Result<(Block, Figures), Refusal> {
    let first = check_series(before, after)?;
    let rays = first.ranges_m.len();
    let (step_deg, around) = (f64::from(first.angle_increment_rad).abs().to_degrees(), all_around(first));
    let sides = [before, after].map(|scans| {
        let single: Vec<Ray> = (0..rays).map(|ray| Ray::of(scans, ray, min_range_m)).collect();
        smoothed(&single, (NEIGHBOURS_DEG / step_deg) as usize, around)
    });
    let changes: Vec<Change> = sides[0].iter().zip(&sides[1]).map(|(before, after)| change(*before, *after)).collect();
    let count = |wanted| changes.iter().filter(|change| **change == wanted).count();
    let (nearer, farther, blind) = (count(Change::Nearer), count(Change::Farther), count(Change::Unknown));
    let mut blocks = blocks(&changes, step_deg, around);
    blocks.retain(|block| is_thing(block, &changes, step_deg));
    blocks.sort_by_key(|block| std::cmp::Reverse(nearer_in(block, &changes)));
    let figures = Figures {
        scans_before: before.len(),
        scans_after: after.len(),
        rays,
        compared: rays - blind,
        nearer,
        farther,
        blocks: blocks.len(),
    };
    if (nearer + farther) as f64 > MOST_CHANGED * (rays - blind) as f64 {
        return Err(Refusal::TooMuch(figures));
    }
    let described = |block: &Vec<usize>| describe(block, &changes, &sides, first);
    match &blocks[..] {
        [] => Err(Refusal::Nothing(figures)),
        [first, second, ..]
            if nearer_in(second, &changes) as f64 > SECOND_SHARE * nearer_in(first, &changes) as f64 =>
        {
            Err(Refusal::Several(figures, Box::new([described(first), described(second)])))
        }
        [first, ..] => Ok((described(first), figures)),
    }
}

/// `mounting_deg` with which what lies at `bearing_deg` in the lidar's frame lies at `wanted_deg` in the body frame. -180 to 180.
pub fn mounting_deg(bearing_deg: f64, wanted_deg: f64) -> f64 {
    let mounting = (wanted_deg - bearing_deg + 180.0).rem_euclid(360.0) - 180.0;
    // Backwards is 180, from whichever side.
    if mounting == -180.0 { 180.0 } else { mounting }
}

/// The scans are in order and look into the same directions.
fn check_series<'a>(before: &'a [LaserScan], after: &'a [LaserScan]) -> Result<&'a LaserScan, Refusal> {
    let refuse = |reason: String| Err(Refusal::Scan(reason));
    let Some(first) = before.first() else { return refuse("there is no scan before".into()) };
    if after.is_empty() {
        return refuse("there is no scan after".into());
    }
    for scan in before.iter().chain(after) {
        check_scan(scan).map_err(Refusal::Scan)?;
        let (points, expected) = (scan.ranges_m.len(), first.ranges_m.len());
        if points != expected {
            return refuse(format!("the scans do not fit together: one has {points} points, another {expected}"));
        }
        let same = |a: f32, b: f32| (a - b).abs() < 1e-3;
        if !same(scan.angle_min_rad, first.angle_min_rad) || !same(scan.angle_increment_rad, first.angle_increment_rad)
        {
            return refuse("the scans do not fit together: they begin at other angles or have other steps".into());
        }
    }
    let points = first.ranges_m.len();
    if points < 8 {
        return refuse(format!("a scan has {points} points, needed are 8 to {MAX_SCAN_POINTS}"));
    }
    if first.angle_increment_rad == 0.0 {
        return refuse("the scans have a step of 0 rad from ray to ray".into());
    }
    Ok(first)
}

/// Whether the last ray lies beside the first.
fn all_around(scan: &LaserScan) -> bool {
    let increment = f64::from(scan.angle_increment_rad).abs();
    (increment * scan.ranges_m.len() as f64 - TAU).abs() < 2.0 * increment
}

/// What a ray measured in a series of scans.
#[derive(Clone, Copy, Debug)]
struct Ray {
    /// Median range, m; the device's reach where nothing was within it. `None`: it mostly failed.
    median_m: Option<f64>,
    /// Whether the median is a return.
    returned: bool,
    /// Median distance from the median, m.
    scatter_m: f64,
}

impl Ray {
    fn of(scans: &[LaserScan], ray: usize, min_range_m: f64) -> Self {
        let mut ranges: Vec<f64> = scans.iter().filter_map(|scan| measured(scan, ray, min_range_m)).collect();
        if (ranges.len() as f64) < LEAST_MEASURED * scans.len() as f64 || ranges.is_empty() {
            return Self { median_m: None, returned: false, scatter_m: 0.0 };
        }
        let median = median(&mut ranges);
        let reach = f64::from(scans[0].range_max_m);
        let mut distances: Vec<f64> =
            ranges.iter().filter(|range| **range < reach).map(|range| (range - median).abs()).collect();
        let scatter_m = if distances.is_empty() { 0.0 } else { self::median(&mut distances) };
        Self { median_m: Some(median), returned: median < reach, scatter_m }
    }
}

/// Each ray with the median of its neighbours' medians; a ray that has failed stays so.
fn smoothed(rays: &[Ray], neighbours: usize, around: bool) -> Vec<Ray> {
    let count = rays.len();
    let neighbours = neighbours.min(count.saturating_sub(1) / 2);
    let one = |index: usize| {
        let near = (index + count - neighbours..=index + count + neighbours)
            .filter(|near| around || (count..2 * count).contains(near))
            .map(|near| rays[near % count]);
        let near: Vec<Ray> = near.filter(|ray| ray.median_m.is_some()).collect();
        let mut medians: Vec<f64> = near.iter().filter_map(|ray| ray.median_m).collect();
        let own = rays[index];
        if own.median_m.is_none() {
            return own;
        }
        let returns = near.iter().filter(|ray| ray.returned).count();
        Ray { median_m: Some(median(&mut medians)), returned: 2 * returns > near.len(), ..own }
    };
    (0..count).map(one).collect()
}

/// A range; the device's reach for "nothing there". `None`: no measurement, or too near to be one.
fn measured(scan: &LaserScan, ray: usize, min_range_m: f64) -> Option<f64> {
    let range = f64::from(scan.ranges_m[ray]);
    let reach = f64::from(scan.range_max_m);
    if range > reach {
        return Some(reach);
    }
    (range > 0.0 && range >= min_range_m.max(f64::from(scan.range_min_m))).then_some(range)
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    if values.len() % 2 == 1 { values[middle] } else { f64::midpoint(values[middle - 1], values[middle]) }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Change {
    Same,
    Nearer,
    Farther,
    /// The ray has failed on one side.
    Unknown,
}

fn change(before: Ray, after: Ray) -> Change {
    let (Some(was), Some(is)) = (before.median_m, after.median_m) else { return Change::Unknown };
    let (least, share, scatters) = NEARER;
    let limit = least.max(share * was.min(is)).max(scatters * before.scatter_m.max(after.scatter_m));
    if was - is > limit && after.returned {
        Change::Nearer
    } else if is - was > limit && before.returned {
        Change::Farther
    } else {
        Change::Same
    }
}

/// Rays that came nearer, with the small gaps between them.
fn blocks(changes: &[Change], step_deg: f64, around: bool) -> Vec<Vec<usize>> {
    let bridged = (BRIDGED_DEG / step_deg) as usize;
    let count = changes.len();
    let nearer: Vec<usize> = (0..count).filter(|ray| changes[*ray] == Change::Nearer).collect();
    let mut blocks: Vec<Vec<usize>> = Vec::new();
    for ray in nearer {
        match blocks.last_mut() {
            Some(block) if block.last().is_some_and(|last| ray - last <= bridged + 1) => {
                let next = block.last().map_or(ray, |last| last + 1);
                block.extend(next..=ray);
            }
            _ => blocks.push(vec![ray]),
        }
    }
    if around && blocks.len() > 1 {
        let (first, last) = (blocks[0][0], *blocks[blocks.len() - 1].last().expect("no block is empty"));
        if first + count - last <= bridged + 1 {
            // It lies across the seam: what comes first there counts on behind the last ray.
            let mut across = blocks.pop().expect("there are two");
            let rest = blocks.remove(0);
            let end = rest.last().expect("no block is empty") + count;
            across.extend(last + 1..=end);
            blocks.push(across);
        }
    }
    blocks
}

fn nearer_in(block: &[usize], changes: &[Change]) -> usize {
    block.iter().filter(|ray| changes[**ray % changes.len()] == Change::Nearer).count()
}

fn is_thing(block: &[usize], changes: &[Change], step_deg: f64) -> bool {
    let nearer = nearer_in(block, changes);
    nearer >= LEAST_RAYS
        && block.len() as f64 * step_deg >= LEAST_WIDTH_DEG
        && nearer as f64 >= LEAST_DENSITY * block.len() as f64
}

fn describe(block: &[usize], changes: &[Change], sides: &[Vec<Ray>; 2], scan: &LaserScan) -> Block {
    let count = changes.len();
    let step = f64::from(scan.angle_increment_rad);
    let (first, last) = (block[0] as f64, block[block.len() - 1] as f64);
    let middle = f64::from(scan.angle_min_rad) + f64::midpoint(first, last) * step;
    let nearer: Vec<usize> =
        block.iter().map(|ray| ray % count).filter(|ray| changes[*ray] == Change::Nearer).collect();
    let mut before: Vec<f64> = nearer.iter().filter_map(|ray| sides[0][*ray].median_m).collect();
    let mut after: Vec<f64> = nearer.iter().filter_map(|ray| sides[1][*ray].median_m).collect();
    let before_m = median(&mut before);
    Block {
        bearing_deg: rounded(((middle + PI).rem_euclid(TAU) - PI).to_degrees()),
        width_deg: rounded(block.len() as f64 * step.abs().to_degrees()),
        rays: nearer.len(),
        before_m: (before_m < f64::from(scan.range_max_m)).then_some(before_m),
        after_m: median(&mut after),
    }
}

/// To a hundredth of a degree: scans carry their angles in 32 bits.
fn rounded(degrees: f64) -> f64 {
    (degrees * 100.0).round() / 100.0
}

#[cfg(test)]
mod tests;
