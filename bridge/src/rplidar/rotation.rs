//! From measurements to scans: a rotation ends where the angle begins anew. Pure.

use std::f32::consts::{PI, TAU};

use carril_messages::{LaserScan, Stamp};

use super::codec::Point;

/// A rotation takes no longer: a device that turns more slowly has stood meanwhile, s.
const LONGEST_S: f64 = 2.0;
/// A part of a rotation with fewer measurements is none.
const FEWEST: u32 = 8;
/// The angle has begun anew when it has fallen by so much, degrees.
const FALL_DEG: f32 = 180.0;

/// Collects the measurements of a rotation.
#[derive(Clone, Debug)]
pub struct Rotation {
    ranges_m: Vec<f32>,
    reach_m: [f32; 2],
    measured: u32,
    /// When it began; `None`: within the first, which is no whole one.
    began: Option<Stamp>,
    last_deg: Option<f32>,
}

impl Rotation {
    /// Of scans with so many points, from the nearest to the farthest range of the device, m.
    pub fn new(points: usize, reach_m: [f32; 2]) -> Self {
        Self { ranges_m: vec![f32::NAN; points], reach_m, measured: 0, began: None, last_deg: None }
    }

    /// Forgets what was collected: the device begins anew.
    pub fn reset(&mut self) {
        *self = Self::new(self.ranges_m.len(), self.reach_m);
    }

    /// Takes a measurement that arrived at `now`; gives the scan that it ends.
    pub fn add(&mut self, point: &Point, now: Stamp) -> Option<LaserScan> {
        let falls = self.last_deg.is_some_and(|last_deg| last_deg - point.clockwise_deg > FALL_DEG);
        self.last_deg = Some(point.clockwise_deg);
        let scan = if point.begins || falls { self.end(now) } else { None };
        self.put(point);
        scan
    }

    fn end(&mut self, now: Stamp) -> Option<LaserScan> {
        let began = self.began.replace(now);
        let points = self.ranges_m.len();
        let ranges_m = std::mem::replace(&mut self.ranges_m, vec![f32::NAN; points]);
        let measured = std::mem::take(&mut self.measured);
        let scan_time_s = now.since(began?).as_secs_f64();
        let whole = measured >= FEWEST && scan_time_s > 0.0 && scan_time_s <= LONGEST_S;
        whole.then(|| LaserScan {
            angle_min_rad: -PI,
            angle_increment_rad: TAU / points as f32,
            scan_time_s: scan_time_s as f32,
            range_min_m: self.reach_m[0],
            range_max_m: self.reach_m[1],
            ranges_m,
        })
    }

    /// The device turns clockwise, a scan goes counter-clockwise. Of several measurements in one direction the nearest counts; nothing that
    /// came back is free as far as the device reaches (REP-117).
    fn put(&mut self, point: &Point) {
        let points = self.ranges_m.len();
        let around = (PI - point.clockwise_deg.to_radians()).rem_euclid(TAU) / TAU;
        let index = (around * points as f32).round() as usize % points;
        let range_m = match point.range_m {
            None => f32::INFINITY,
            Some(range_m) if range_m < self.reach_m[0] => f32::NEG_INFINITY,
            Some(range_m) if range_m > self.reach_m[1] => f32::INFINITY,
            Some(range_m) => range_m,
        };
        let before = self.ranges_m[index];
        if before.is_nan() || range_m < before {
            self.ranges_m[index] = range_m;
        }
        self.measured += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turn(rotation: &mut Rotation, at_ms: i64, range_of: impl Fn(f32) -> Option<f32>) -> Option<LaserScan> {
        let mut scan = None;
        for index in 0..360 {
            let clockwise_deg = index as f32;
            let point = Point { clockwise_deg, range_m: range_of(clockwise_deg), begins: index == 0 };
            let now = Stamp::from_nanos((at_ms + i64::from(index) * 100 / 360) * 1_000_000);
            scan = rotation.add(&point, now).or(scan);
        }
        scan
    }

    #[test]
    fn a_rotation_becomes_a_scan_in_the_frame_of_the_others() {
        let mut rotation = Rotation::new(360, [0.15, 12.0]);
        let range_of = |deg: f32| match deg as i32 {
            90 => Some(1.0),
            10 => Some(0.01),
            20 => Some(20.0),
            30 => None,
            _ => Some(5.0),
        };
        assert_eq!(turn(&mut rotation, 0, range_of), None, "the first is not known to be whole");
        let scan = turn(&mut rotation, 100, range_of).expect("the first whole one has ended");
        assert_eq!((scan.ranges_m.len(), scan.scan_time_s), (360, 0.1), "points and time");
        let at = |bearing_deg: i32| scan.ranges_m[((bearing_deg + 180).rem_euclid(360)) as usize];
        assert_eq!(at(-90), 1.0, "90 degrees clockwise is the right");
        assert_eq!(at(90), 5.0, "and not the left");
        assert_eq!(at(-10), f32::NEG_INFINITY, "too near");
        assert_eq!((at(-20), at(-30)), (f32::INFINITY, f32::INFINITY), "too far, and nothing came back");
    }

    #[test]
    fn directions_that_were_not_measured_are_said_to_be_so() {
        let mut rotation = Rotation::new(360, [0.15, 12.0]);
        let mut scan = None;
        for index in 0..300 {
            // Every other degree from 0 to 198, again and again: no flag says where a rotation begins.
            let point = Point { clockwise_deg: (index % 100) as f32 * 2.0, range_m: Some(2.0), begins: false };
            scan = rotation.add(&point, Stamp::from_nanos(i64::from(index) * 1_000_000)).or(scan);
        }
        let scan = scan.expect("the angle fell twice");
        assert_eq!(scan.ranges_m.iter().filter(|range| range.is_nan()).count(), 260, "260 of 360 were not looked at");
    }

    #[test]
    fn a_device_that_stood_gives_no_scan() {
        let mut rotation = Rotation::new(360, [0.15, 12.0]);
        turn(&mut rotation, 0, |_| Some(1.0));
        assert_eq!(turn(&mut rotation, 60_000, |_| Some(1.0)), None, "a minute for a turn");
        assert!(turn(&mut rotation, 60_100, |_| Some(1.0)).is_some(), "then it goes on");
    }
}
