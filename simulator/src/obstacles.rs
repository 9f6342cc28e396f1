//! What the car can run into: the boxes and walls of the track, and boxes put on the lane by the configuration, which may crawl along it.

use carril_messages::Pose;
use carril_messages::car::{BODY_FRONT_M, BODY_REAR_M, BODY_WIDTH_M};
use nalgebra::{Isometry2, Point2, Vector2};

use crate::centre_line::{left_of, wrap_angle};
use crate::config::ObstacleConfig;
use crate::track::{Bgr, Block, Track};

/// Colour of the boxes that the configuration puts on the lane.
pub const COLOUR: Bgr = [120; 3];
/// One that crawls waits when the car is this near to where it would go next, m.
const WAITS_AT_M: f64 = 0.1;

/// Everything that the body can run into.
#[derive(Clone, Debug, Default)]
pub struct Obstacles {
    fixed: Vec<Outline>,
    placed: Vec<Outline>,
}

/// A convex outline on the floor, in a circle that lets most of them be passed over quickly.
#[derive(Clone, Debug)]
struct Outline {
    corners: Vec<Point2<f64>>,
    middle: Point2<f64>,
    radius_m: f64,
}

impl Outline {
    fn new(corners: Vec<Point2<f64>>) -> Self {
        let sum: Vector2<f64> = corners.iter().map(|corner| corner.coords).sum();
        let middle = Point2::from(sum / corners.len() as f64);
        let radius_m = corners.iter().map(|corner| (corner - middle).norm()).fold(0.0, f64::max);
        Self { corners, middle, radius_m }
    }

    fn of_block(block: &Block) -> Self {
        Self::new(block.corners().to_vec())
    }

    /// The car's body, made larger by `reach_m` on all sides.
    fn of_body(pose: Pose, reach_m: f64) -> Self {
        let map_from_body = Isometry2::new(Vector2::new(pose.x_m, pose.y_m), pose.yaw_rad);
        let (rear, front, half) = (BODY_REAR_M - reach_m, BODY_FRONT_M + reach_m, BODY_WIDTH_M / 2.0 + reach_m);
        let corners = [(front, half), (rear, half), (rear, -half), (front, -half)];
        Self::new(corners.map(|(x, y)| map_from_body * Point2::new(x, y)).to_vec())
    }

    fn touches(&self, other: &Self) -> bool {
        self.is_within(other, 0.0) && overlap(&self.corners, &other.corners)
    }

    /// Whether the circles around both come so near.
    fn is_within(&self, other: &Self, distance_m: f64) -> bool {
        let near_m = self.radius_m + other.radius_m + distance_m;
        (self.middle - other.middle).norm_squared() <= near_m * near_m
    }

    /// 0 when they touch.
    fn distance_m(&self, other: &Self) -> f64 {
        if overlap(&self.corners, &other.corners) {
            return 0.0;
        }
        let between = |points: &[Point2<f64>], edges: &[Point2<f64>]| {
            let ends = (0..edges.len()).map(|i| [edges[i], edges[(i + 1) % edges.len()]]);
            ends.flat_map(|edge| points.iter().map(move |point| to_edge_m(*point, edge))).fold(f64::INFINITY, f64::min)
        };
        between(&self.corners, &other.corners).min(between(&other.corners, &self.corners))
    }
}

fn to_edge_m(point: Point2<f64>, [from, to]: [Point2<f64>; 2]) -> f64 {
    let along = to - from;
    let share = ((point - from).dot(&along) / along.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (point - (from + along * share)).norm()
}

impl Obstacles {
    /// The boxes and walls of a track.
    pub fn of(track: &Track) -> Self {
        let boxes = track.boxes.iter().map(Outline::of_block);
        let walls = track.walls.iter().map(|wall| Outline::new(vec![wall.from, wall.to]));
        Self { fixed: boxes.chain(walls).collect(), placed: Vec::new() }
    }

    /// Beside these, the boxes that the configuration puts on the lane, as they stand now.
    pub fn place(&mut self, blocks: &[Block]) {
        self.placed = blocks.iter().map(Outline::of_block).collect();
    }

    fn all(&self) -> impl Iterator<Item = &Outline> {
        self.fixed.iter().chain(&self.placed)
    }

    /// Whether the body touches one of them.
    pub fn touches(&self, pose: Pose) -> bool {
        let body = Outline::of_body(pose, 0.0);
        self.all().any(|outline| outline.touches(&body))
    }

    /// Distance of the body to the nearest of them, m, 0 when it touches. `None`: none within `within_m`.
    pub fn distance_m(&self, pose: Pose, within_m: f64) -> Option<f64> {
        let body = Outline::of_body(pose, 0.0);
        let near = self.all().filter(|outline| outline.is_within(&body, within_m));
        near.map(|outline| outline.distance_m(&body))
            .filter(|distance_m| *distance_m <= within_m)
            .min_by(f64::total_cmp)
    }
}

/// The boxes that the configuration puts on the lane.
pub struct Placed {
    boxes: Vec<ObstacleConfig>,
    /// Where the track's start lies along its lane, m.
    start_along_m: f64,
}

impl Placed {
    /// On the lane of a track.
    pub fn new(boxes: &[ObstacleConfig], track: &Track) -> Self {
        let start = Point2::new(track.start.x_m, track.start.y_m);
        let start_along_m = track.lane.as_ref().map_or(0.0, |lane| lane.centre.locate(start, None).along_m);
        Self { boxes: boxes.to_vec(), start_along_m }
    }

    /// As they stand after the ways `driven_m` of each.
    pub fn blocks(&self, track: &Track, driven_m: &[f64]) -> Vec<Block> {
        let way_m = |index: usize| driven_m.get(index).copied().unwrap_or_default();
        self.boxes.iter().enumerate().map(|(index, placed)| self.block(track, placed, way_m(index))).collect()
    }

    fn block(&self, track: &Track, placed: &ObstacleConfig, driven_m: f64) -> Block {
        let along_m = placed.along_m + driven_m;
        let (point, direction) = if let Some(lane) = &track.lane {
            lane.centre.between_samples(self.start_along_m + along_m, placed.left_m)
        } else {
            let direction = Vector2::new(track.start.yaw_rad.cos(), track.start.yaw_rad.sin());
            let start = Point2::new(track.start.x_m, track.start.y_m);
            (start + direction * along_m + left_of(direction) * placed.left_m, direction)
        };
        let yaw_rad = wrap_angle(direction.y.atan2(direction.x) + placed.yaw_deg.to_radians());
        let ObstacleConfig { length_m, width_m, height_m, .. } = *placed;
        Block { pose: Pose { x_m: point.x, y_m: point.y, yaw_rad }, length_m, width_m, height_m, colour: COLOUR }
    }

    /// Lets each drive on for `seconds`. It waits for a car that is in its way.
    pub fn drive_on(&self, track: &Track, driven_m: &mut Vec<f64>, car: Pose, seconds: f64) {
        driven_m.resize(self.boxes.len(), 0.0);
        let body = Outline::of_body(car, WAITS_AT_M);
        for (placed, driven_m) in self.boxes.iter().zip(driven_m).filter(|(placed, _)| placed.speed_m_s != 0.0) {
            let next_m = *driven_m + placed.speed_m_s * seconds;
            let [here, next] = [*driven_m, next_m].map(|way_m| self.block(track, placed, way_m));
            let away_m = |pose: Pose| (pose.x_m - car.x_m).hypot(pose.y_m - car.y_m);
            let waits = Outline::of_block(&next).touches(&body) && away_m(next.pose) < away_m(here.pose);
            if !waits {
                *driven_m = next_m;
            }
        }
    }
}

/// Whether two convex outlines share a point: no edge of either separates them (separating axis theorem).
fn overlap(a: &[Point2<f64>], b: &[Point2<f64>]) -> bool {
    let normals = |outline: &[Point2<f64>]| -> Vec<Vector2<f64>> {
        let edge = |i: usize| outline[(i + 1) % outline.len()] - outline[i];
        let mut normals: Vec<Vector2<f64>> = (0..outline.len()).map(|i| Vector2::new(-edge(i).y, edge(i).x)).collect();
        if outline.len() == 2 {
            normals.push(edge(0));
        }
        normals
    };
    let extent = |outline: &[Point2<f64>], axis: &Vector2<f64>| {
        outline
            .iter()
            .map(|corner| corner.coords.dot(axis))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
    };
    normals(a).iter().chain(&normals(b)).all(|axis| {
        let ((a_low, a_high), (b_low, b_high)) = (extent(a, axis), extent(b, axis));
        a_low <= b_high && b_low <= a_high
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn oval() -> Track {
        Track::load("oval", Path::new(".")).expect("built in")
    }

    fn crawler(track: &Track) -> Placed {
        Placed::new(&[ObstacleConfig { along_m: 1.0, speed_m_s: 0.1, ..ObstacleConfig::default() }], track)
    }

    /// A car on the oval's first straight.
    fn car(along_m: f64) -> Pose {
        oval().lane.expect("the oval has a lane").pose_at(along_m, 0.0)
    }

    fn apart_m(a: Pose, b: Pose) -> f64 {
        (a.x_m - b.x_m).hypot(a.y_m - b.y_m)
    }

    #[test]
    fn measures_the_distance_to_the_nearest() {
        let (track, mut obstacles) = (oval(), Obstacles::default());
        let standing = ObstacleConfig { along_m: 1.0, ..ObstacleConfig::default() };
        obstacles.place(&Placed::new(std::slice::from_ref(&standing), &track).blocks(&track, &[]));
        let distance_m = obstacles.distance_m(track.start, 1.0).expect("it is near");
        let expected_m = 1.0 - standing.length_m / 2.0 - BODY_FRONT_M;
        assert!((distance_m - expected_m).abs() < 0.01, "{distance_m} m instead of {expected_m} m");
        assert_eq!(obstacles.distance_m(track.start, 0.2), None, "not within 20 cm");
        let start_m =
            track.lane.as_ref().expect("a lane").centre.locate(Point2::new(track.start.x_m, track.start.y_m), None);
        let inside = car(start_m.along_m + 0.9);
        assert_eq!(obstacles.distance_m(inside, 1.0), Some(0.0), "it touches");
        assert!(obstacles.touches(inside) && !obstacles.touches(track.start), "and says so");
    }

    #[test]
    fn crawls_along_the_lane_evenly_and_round() {
        let track = oval();
        let placed = crawler(&track);
        let length_m = track.lane.as_ref().expect("the oval has a lane").centre.length_m();
        let (mut driven_m, far) = (Vec::new(), Pose { x_m: 50.0, ..Pose::default() });
        let first = placed.blocks(&track, &driven_m)[0].pose;
        let mut before = first;
        for _ in 0..(length_m / 0.005).round() as u32 {
            placed.drive_on(&track, &mut driven_m, far, 0.05);
            let now = placed.blocks(&track, &driven_m)[0].pose;
            let step_m = apart_m(now, before);
            assert!((step_m - 0.005).abs() < 0.0005, "5 mm each step, not in jumps: {step_m} m");
            before = now;
        }
        assert!(apart_m(first, before) < 0.02, "round: {first:?}, {before:?}");
    }

    #[test]
    fn waits_for_a_car_in_its_way_but_not_for_one_behind() {
        let (track, mut driven_m) = (oval(), Vec::new());
        let placed = crawler(&track);
        let along_m = placed.start_along_m + 1.0;
        let ahead = car(along_m + 0.6);
        for _ in 0..1000 {
            placed.drive_on(&track, &mut driven_m, ahead, 0.01);
        }
        let mut around = Obstacles::default();
        around.place(&placed.blocks(&track, &driven_m));
        let distance_m = around.distance_m(ahead, 1.0).expect("it is near");
        assert!(driven_m[0] > 0.1 && (0.08..0.12).contains(&distance_m), "waits {distance_m} m behind the car");
        let before_m = driven_m[0];
        placed.drive_on(&track, &mut driven_m, car(along_m + before_m - 0.54), 0.01);
        assert!(driven_m[0] > before_m, "drives away from a car behind it");
    }
}
