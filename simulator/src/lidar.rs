//! The simulated lidar: a planar scan of boxes, walls and the car's own posts, with noise and holes.

use std::f64::consts::{PI, TAU};

use carril_messages::{LaserScan, Pose};
use nalgebra::{Isometry2, Point2, Vector2};

use crate::centre_line::wrap_angle;
use crate::config::LidarConfig;
use crate::noise::{self, GaussianTable};
use crate::track::{Block, Track};

/// An upright surface that reaches up to the lidar's plane, map frame.
type Surface = [Point2<f64>; 2];

/// Makes scans.
pub struct Lidar {
    config: LidarConfig,
    surfaces: Vec<Surface>,
    noise: GaussianTable<f32>,
    seed: u64,
}

impl Lidar {
    /// A lidar in the world of `track`. Boxes and walls that end below its plane are not seen.
    pub fn new(config: &LidarConfig, track: &Track, seed: u64) -> Self {
        let walls = track.walls.iter().filter(|wall| wall.height_m >= config.height_m);
        let surfaces = sides(&track.boxes, config).chain(walls.map(|wall| [wall.from, wall.to])).collect();
        let noise = GaussianTable::new(noise::mix(&[seed, 1]), |x| (x * config.noise_m) as f32);
        Self { config: config.clone(), surfaces, noise, seed }
    }

    /// Scan number `number` from a pose of the car, taken at one moment. `blocks`: boxes beside those of the track.
    pub fn scan(&self, pose: Pose, blocks: &[Block], number: u64) -> LaserScan {
        let config = &self.config;
        let mut ranges = vec![f64::INFINITY; config.points];
        let body = Isometry2::new(Vector2::new(pose.x_m, pose.y_m), pose.yaw_rad);
        let mounting = Isometry2::new(Vector2::new(config.forward_m, config.left_m), config.mounting_deg.to_radians());
        let sensor_from_map = (body * mounting).inverse();
        for [from, to] in self.surfaces.iter().copied().chain(sides(blocks, config)) {
            self.see(sensor_from_map * from, sensor_from_map * to, &mut ranges);
        }
        let ranges_m = self.disturb(ranges, number);
        LaserScan {
            angle_min_rad: -PI as f32,
            angle_increment_rad: self.increment_rad() as f32,
            scan_time_s: (1.0 / config.rate_hz) as f32,
            range_min_m: config.range_min_m as f32,
            range_max_m: config.range_max_m as f32,
            ranges_m,
        }
    }

    fn increment_rad(&self) -> f64 {
        TAU / self.config.points as f64
    }

    /// Angle of a ray, sensor frame.
    fn angle_rad(&self, ray: usize) -> f64 {
        -PI + ray as f64 * self.increment_rad()
    }

    /// Shortens the rays that hit a surface; only those between its ends are looked at.
    fn see(&self, from: Point2<f64>, to: Point2<f64>, ranges: &mut [f64]) {
        let (mut start, mut end) = (from.y.atan2(from.x), to.y.atan2(to.x));
        let mut sweep = wrap_angle(end - start);
        if sweep < 0.0 {
            (start, end) = (end, start);
            sweep = -sweep;
        }
        debug_assert!(wrap_angle(start + sweep - end).abs() < 1e-6, "the sweep leads from one end to the other");
        let first = ((start + PI) / self.increment_rad()).ceil() as usize;
        let last = ((start + sweep + PI) / self.increment_rad()).floor() as usize;
        for index in first..=last {
            let ray = index % ranges.len();
            if let Some(range) = hit(self.angle_rad(ray), from, to) {
                ranges[ray] = ranges[ray].min(range);
            }
        }
    }

    /// Posts, noise, reach and holes.
    fn disturb(&self, ranges: Vec<f64>, number: u64) -> Vec<f32> {
        let config = &self.config;
        let noise = self.noise.slice(&[self.seed, number], ranges.len());
        let disturbed = ranges.into_iter().zip(noise).enumerate().map(|(ray, (range, noise))| {
            let bearing = self.angle_rad(ray) + config.mounting_deg.to_radians();
            let post = config.posts.iter().find(|post| {
                let off = wrap_angle(bearing - post.bearing_deg.to_radians());
                off.abs() <= post.width_deg.to_radians() / 2.0 + 1e-9
            });
            let range = post.map_or(range, |post| range.min(post.range_m)) + f64::from(*noise);
            if noise::unit(&[self.seed, number, ray as u64]) < config.dropout || range > config.range_max_m {
                f32::INFINITY
            } else if range < config.range_min_m {
                f32::NEG_INFINITY
            } else {
                range as f32
            }
        });
        disturbed.collect()
    }
}

/// Sides of the boxes that reach up to the lidar's plane.
fn sides(blocks: &[Block], config: &LidarConfig) -> impl Iterator<Item = Surface> {
    let plane_m = config.height_m;
    blocks.iter().filter(move |block| block.height_m >= plane_m).flat_map(|block| {
        let corners = block.corners();
        (0..4).map(move |i| [corners[i], corners[(i + 1) % 4]])
    })
}

/// Distance along a ray from the origin to a surface.
fn hit(angle_rad: f64, from: Point2<f64>, to: Point2<f64>) -> Option<f64> {
    let ray = Vector2::new(angle_rad.cos(), angle_rad.sin());
    let along = to - from;
    let turn = ray.perp(&along);
    if turn.abs() < 1e-12 {
        return None;
    }
    let range = from.coords.perp(&along) / turn;
    let share = from.coords.perp(&ray) / turn;
    (range >= 0.0 && (0.0..=1.0).contains(&share)).then_some(range)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Post;
    use crate::track::Wall;

    fn world(config: &LidarConfig) -> Lidar {
        let mut track = crate::track::random::track("random", crate::track::random::Kind::Lane, 1);
        track.walls =
            vec![Wall { from: Point2::new(2.0, -3.0), to: Point2::new(2.0, 3.0), height_m: 0.5, colour: [0; 3] }];
        let pose = Pose { x_m: -1.0, y_m: 0.0, yaw_rad: 0.5 };
        track.boxes = vec![Block { pose, length_m: 0.4, width_m: 0.4, height_m: 0.05, colour: [0; 3] }];
        Lidar::new(config, &track, 1)
    }

    fn clean() -> LidarConfig {
        LidarConfig { noise_m: 0.0, dropout: 0.0, forward_m: 0.0, posts: Vec::new(), ..LidarConfig::default() }
    }

    #[test]
    fn measures_the_distance_to_a_wall() {
        let scan = world(&clean()).scan(Pose::default(), &[], 0);
        assert_eq!(scan.ranges_m.len(), 360, "a ray for each degree");
        assert!((scan.ranges_m[180] - 2.0).abs() < 1e-6, "straight ahead, got {} m", scan.ranges_m[180]);
        let at_30 = 2.0 / 30_f32.to_radians().cos();
        assert!((scan.ranges_m[210] - at_30).abs() < 1e-5, "30 degrees to the left, got {} m", scan.ranges_m[210]);
        assert_eq!(scan.ranges_m[0], f32::INFINITY, "behind is a box, but lower than the lidar");
        let turned = world(&clean()).scan(Pose { x_m: 1.0, y_m: 0.0, yaw_rad: PI }, &[], 0);
        assert!((turned.ranges_m[0] - 1.0).abs() < 1e-6, "the wall across the seam, got {} m", turned.ranges_m[0]);
        assert!((turned.ranges_m[359] - 1.0).abs() < 1e-3, "and beside it, got {} m", turned.ranges_m[359]);
    }

    #[test]
    fn sees_boxes_that_come_and_go() {
        let pose = Pose { x_m: 1.0, y_m: 0.0, yaw_rad: 0.0 };
        let block = Block { pose, length_m: 0.4, width_m: 0.4, height_m: 0.2, colour: [0; 3] };
        let range = world(&clean()).scan(Pose::default(), &[block], 0).ranges_m[180];
        assert!((range - 0.8).abs() < 1e-6, "the box before the wall, got {range} m");
        let low = Block { height_m: 0.1, ..block };
        assert!(world(&clean()).scan(Pose::default(), &[low], 0).ranges_m[180] > 1.9, "lower than the lidar");
    }

    #[test]
    fn mounting_turns_and_shifts() {
        let config = LidarConfig { mounting_deg: 90.0, forward_m: 0.5, ..clean() };
        let scan = world(&config).scan(Pose::default(), &[], 0);
        assert!(
            (scan.ranges_m[90] - 1.5).abs() < 1e-6,
            "ahead is to the right of the sensor, got {}",
            scan.ranges_m[90]
        );
    }

    #[test]
    fn posts_are_near_returns_in_the_body_frame() {
        let post = Post { bearing_deg: -150.0, width_deg: 8.0, range_m: 0.1 };
        for mounting_deg in [0.0, 180.0] {
            let config = LidarConfig { posts: vec![post.clone()], mounting_deg, ..clean() };
            let scan = world(&config).scan(Pose { x_m: -9.0, ..Pose::default() }, &[], 0);
            let near = (0..360).filter(|ray| scan.ranges_m[*ray] < 0.2).collect::<Vec<_>>();
            let middle = (30.0 - mounting_deg).rem_euclid(360.0) as usize;
            assert_eq!(near, (middle - 4..=middle + 4).collect::<Vec<_>>(), "mounted at {mounting_deg} degrees");
        }
    }

    #[test]
    fn noise_and_holes_have_their_share() {
        let config = LidarConfig { noise_m: 0.02, dropout: 0.05, ..clean() };
        let lidar = world(&config);
        let ahead: Vec<f32> = (0..2000).map(|number| lidar.scan(Pose::default(), &[], number).ranges_m[180]).collect();
        let holes = ahead.iter().filter(|range| range.is_infinite()).count();
        assert!((50..150).contains(&holes), "5 % of 2000 are holes, got {holes}");
        let seen: Vec<f64> = ahead.iter().filter(|range| range.is_finite()).map(|range| f64::from(*range)).collect();
        let variance = seen.iter().map(|range| (range - 2.0).powi(2)).sum::<f64>() / seen.len() as f64;
        assert!((variance.sqrt() - 0.02).abs() < 0.002, "noise {} m", variance.sqrt());
        assert_eq!(
            lidar.scan(Pose::default(), &[], 5),
            lidar.scan(Pose::default(), &[], 5),
            "a scan depends on its number only"
        );
    }

    #[test]
    fn out_of_reach_is_infinite_and_too_near_negative() {
        let config = LidarConfig { range_min_m: 0.5, range_max_m: 1.9, ..clean() };
        assert_eq!(world(&config).scan(Pose::default(), &[], 0).ranges_m[180], f32::INFINITY, "2 m is too far");
        let near = Pose { x_m: 1.8, ..Pose::default() };
        assert_eq!(world(&config).scan(near, &[], 0).ranges_m[180], f32::NEG_INFINITY, "0.2 m is too near");
    }
}
