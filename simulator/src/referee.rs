//! The referee: knows the truth, counts laps, departures and collisions, and measures how well the lane is kept.

use carril_messages::car::{BODY_FRONT_M, BODY_WIDTH_M, WHEELBASE_M};
use carril_messages::{LightColour, Pose, TrackProgress};
use nalgebra::{Isometry2, Point2, Vector2};
use serde::{Deserialize, Serialize};

use crate::obstacles::Obstacles;
use crate::track::Lane;
use crate::traffic_light::TrafficLight;

/// A departure ends when every wheel is this far inside again, m.
const DEPARTURE_HYSTERESIS_M: f64 = 0.01;
/// A contact ends when the body is this far away, m.
const CONTACT_HYSTERESIS_M: f64 = 0.01;
/// Clearance from what is farther away is not measured, m.
const CLEARANCE_WITHIN_M: f64 = 1.0;
/// Progress along the lane cannot outrun the way driven by more than this factor: in a tight curve, with the car at its inner edge,
/// the middle of the lane goes by 1.25 times as fast. What is faster is a short cut, and does not count.
const MAX_GAIN: f64 = 2.0;

/// A light that turns red when the car is about to cross its line cannot be obeyed: a red that is younger does not count, s.
const RED_GRACE_S: f64 = 1.0;
/// A car that stands no farther before a stop line has stopped for it, m.
const STOPS_FOR_LINE_M: f64 = 1.0;
/// A car that is slower stands, m/s.
const STANDS_M_S: f64 = 0.005;

/// What the referee remembers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Referee {
    progress: TrackProgress,
    last: Option<Seen>,
    /// Way along the lane since the start, m, short cuts left out, reversing taken off.
    along_lane_m: f64,
    lap_began_s: f64,
    square_m3: f64,
    touching: bool,
    /// From the front to the stop line of each light when last seen, m; below 0 behind it.
    to_line_m: Vec<f64>,
}

/// Where the car was last seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Seen {
    point: [f64; 2],
    along_m: f64,
    index: usize,
}

impl Referee {
    /// What it would say now.
    pub fn progress(&self) -> TrackProgress {
        self.progress
    }

    /// The sample of the lane's middle nearest to the car when last seen.
    pub fn lane_index(&self) -> Option<usize> {
        self.last.map(|last| last.index)
    }

    /// Looks at the car.
    pub fn observe(&mut self, pose: Pose, lane: Option<&Lane>, time_s: f64) {
        let point = Point2::new(pose.x_m, pose.y_m);
        let driven_m = self.last.map_or(0.0, |last| (point - Point2::from(last.point)).norm());
        self.progress.distance_m += driven_m;
        let Some(lane) = lane else {
            self.last = Some(Seen { point: [pose.x_m, pose.y_m], along_m: 0.0, index: 0 });
            return;
        };
        let here = lane.centre.locate(point, self.lane_index());
        if let Some(last) = self.last {
            self.advance(here.along_m - last.along_m, driven_m, lane, time_s);
        }
        self.last = Some(Seen { point: [pose.x_m, pose.y_m], along_m: here.along_m, index: here.index });
        self.measure(here.left_m, driven_m);
        self.watch_wheels(pose, lane, here.index);
    }

    fn advance(&mut self, along_m: f64, driven_m: f64, lane: &Lane, time_s: f64) {
        let length_m = lane.centre.length_m();
        let along_m = (along_m + length_m / 2.0).rem_euclid(length_m) - length_m / 2.0;
        if along_m.abs() <= MAX_GAIN * driven_m {
            self.along_lane_m += along_m;
        }
        if self.along_lane_m >= f64::from(self.progress.laps + 1) * length_m {
            self.progress.laps += 1;
            self.progress.last_lap_s = Some(time_s - self.lap_began_s);
            self.lap_began_s = time_s;
        }
    }

    fn measure(&mut self, left_m: f64, driven_m: f64) {
        self.square_m3 += left_m * left_m * driven_m;
        let progress = &mut self.progress;
        progress.cross_track_m = left_m as f32;
        progress.cross_track_max_m = progress.cross_track_max_m.max(left_m.abs() as f32);
        if progress.distance_m > 0.0 {
            progress.cross_track_rms_m = (self.square_m3 / progress.distance_m).sqrt() as f32;
        }
    }

    fn watch_wheels(&mut self, pose: Pose, lane: &Lane, index: usize) {
        let farthest_m = wheel_edges(pose)
            .into_iter()
            .map(|edge| lane.centre.locate(edge, Some(index)).left_m.abs())
            .fold(0.0, f64::max);
        let outside_m = farthest_m - lane.width_m / 2.0;
        if self.progress.outside {
            self.progress.outside = outside_m > -DEPARTURE_HYSTERESIS_M;
        } else if outside_m > 0.0 {
            self.progress.outside = true;
            self.progress.departures += 1;
        }
    }

    /// Takes note of red lights that are passed, and of where the car stops before them.
    pub fn watch_lights(&mut self, speed_m_s: f64, lane: &Lane, lights: &[TrafficLight], time_s: f64) {
        let Some(last) = self.last.filter(|_| !lights.is_empty()) else { return };
        let to_line_m: Vec<f64> =
            lights.iter().map(|light| light.ahead_of(last.along_m + BODY_FRONT_M, lane)).collect();
        for (index, (light, ahead_m)) in lights.iter().zip(&to_line_m).enumerate() {
            let shown = light.shown(time_s);
            if shown.colour != Some(LightColour::Red) {
                continue;
            }
            let before_m = self.to_line_m.get(index).copied().unwrap_or(*ahead_m);
            // Half a lap away the sign changes, too.
            let crosses = before_m > 0.0 && *ahead_m <= 0.0 && before_m - ahead_m < STOPS_FOR_LINE_M;
            self.progress.red_runs += u32::from(crosses && shown.for_s >= RED_GRACE_S);
            if speed_m_s.abs() < STANDS_M_S && (0.0..=STOPS_FOR_LINE_M).contains(ahead_m) {
                self.progress.stopped_before_line_m = Some(*ahead_m as f32);
            }
        }
        self.to_line_m = to_line_m;
    }

    /// Takes note of how near the body comes to something, and counts each contact once.
    pub fn watch_body(&mut self, pose: Pose, obstacles: &Obstacles) {
        let distance_m = obstacles.distance_m(pose, CLEARANCE_WITHIN_M);
        if let Some(distance_m) = distance_m {
            let nearest_m =
                self.progress.clearance_min_m.map_or(distance_m, |before| distance_m.min(f64::from(before)));
            self.progress.clearance_min_m = Some(nearest_m as f32);
        }
        let reach_m = if self.touching { CONTACT_HYSTERESIS_M } else { 0.0 };
        let touches = distance_m.is_some_and(|distance_m| distance_m <= reach_m);
        self.progress.collisions += u32::from(touches && !self.touching);
        self.touching = touches;
    }
}

/// The outer edges of the four wheels on the floor, map frame.
fn wheel_edges(pose: Pose) -> [Point2<f64>; 4] {
    let half_m = BODY_WIDTH_M / 2.0;
    let corners = [(0.0, half_m), (0.0, -half_m), (WHEELBASE_M, half_m), (WHEELBASE_M, -half_m)];
    let map_from_body = Isometry2::new(Vector2::new(pose.x_m, pose.y_m), pose.yaw_rad);
    corners.map(|(x, y)| map_from_body * Point2::new(x, y))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::track::{Block, Track, Wall};

    fn oval() -> Lane {
        Track::load("oval", Path::new(".")).expect("built in").lane.expect("the oval has a lane")
    }

    /// Carries the car along the lane, `left_m` beside its middle, from and to a way along it.
    fn carry(referee: &mut Referee, lane: &Lane, from_m: f64, to_m: f64, left_m: f64) {
        let steps = ((to_m - from_m).abs() / 0.005).ceil();
        for k in 0..=steps as u32 {
            let along_m = from_m + (to_m - from_m) * f64::from(k) / steps;
            referee.observe(lane.pose_at(along_m, left_m), Some(lane), along_m / 0.5);
        }
    }

    #[test]
    fn counts_laps_forward_only() {
        let (lane, mut referee) = (oval(), Referee::default());
        let length_m = lane.centre.length_m();
        carry(&mut referee, &lane, 0.0, 0.99 * length_m, 0.0);
        assert_eq!(referee.progress().laps, 0, "not quite round");
        carry(&mut referee, &lane, 0.99 * length_m, 1.02 * length_m, 0.0);
        assert_eq!(referee.progress().laps, 1, "round");
        let lap_s = referee.progress().last_lap_s.expect("a lap");
        assert!((lap_s - length_m / 0.5).abs() < 0.1, "a lap at 0.5 m/s takes {lap_s} s");
        carry(&mut referee, &lane, 1.02 * length_m, 0.95 * length_m, 0.0);
        carry(&mut referee, &lane, 0.95 * length_m, 1.5 * length_m, 0.0);
        assert_eq!(referee.progress().laps, 1, "back and forth over the line is no lap");
    }

    #[test]
    fn a_short_cut_is_no_progress() {
        let (lane, mut referee) = (oval(), Referee::default());
        let length_m = lane.centre.length_m();
        carry(&mut referee, &lane, 0.0, 1.0, 0.0);
        // Across the infield: from the first straight to the second, 2 m away.
        let (from, to) = (lane.pose_at(1.0, 0.0), lane.pose_at(0.5 * length_m + 1.0, 0.0));
        for k in 0..=400 {
            let share = f64::from(k) / 400.0;
            let pose = Pose {
                x_m: from.x_m + (to.x_m - from.x_m) * share,
                y_m: from.y_m + (to.y_m - from.y_m) * share,
                ..from
            };
            referee.observe(pose, Some(&lane), 0.0);
        }
        carry(&mut referee, &lane, 0.5 * length_m + 1.0, 1.4 * length_m, 0.0);
        assert_eq!(referee.progress().laps, 0, "half a lap was left out");
        assert_eq!(referee.progress().departures, 1, "one excursion");
    }

    #[test]
    fn measures_over_distance() {
        let (lane, mut referee) = (oval(), Referee::default());
        carry(&mut referee, &lane, 0.0, 1.0, 0.05);
        for _ in 0..1000 {
            referee.observe(lane.pose_at(1.0, 0.05), Some(&lane), 2.0);
        }
        let progress = referee.progress();
        assert!((progress.distance_m - 1.0).abs() < 0.01, "standing adds no distance, {} m", progress.distance_m);
        assert!((progress.cross_track_rms_m - 0.05).abs() < 1e-4, "rms {} m", progress.cross_track_rms_m);
        assert!((progress.cross_track_max_m - 0.05).abs() < 1e-4, "max {} m", progress.cross_track_max_m);
        assert!((progress.cross_track_m - 0.05).abs() < 1e-4, "left is positive, {} m", progress.cross_track_m);
    }

    #[test]
    fn an_excursion_counts_once() {
        let (lane, mut referee) = (oval(), Referee::default());
        let edge_m = lane.width_m / 2.0 - BODY_WIDTH_M / 2.0;
        for left_m in [0.0, edge_m - 0.002, edge_m + 0.002, edge_m - 0.005, edge_m + 0.002, 0.0] {
            referee.observe(lane.pose_at(0.5, left_m), Some(&lane), 0.0);
        }
        assert_eq!((referee.progress().departures, referee.progress().outside), (1, false), "out once, with a waver");
        referee.observe(lane.pose_at(0.5, -edge_m - 0.002), Some(&lane), 0.0);
        assert_eq!((referee.progress().departures, referee.progress().outside), (2, true), "out on the right");
    }

    #[test]
    fn contacts_count_once_each() {
        let mut track = Track::load("oval", Path::new(".")).expect("built in");
        let pose = Pose { x_m: 1.0, y_m: 0.0, yaw_rad: 0.7 };
        track.boxes = vec![Block { pose, length_m: 0.2, width_m: 0.2, height_m: 0.2, colour: [0; 3] }];
        track.walls =
            vec![Wall { from: Point2::new(3.0, -1.0), to: Point2::new(3.0, 1.0), height_m: 1.0, colour: [0; 3] }];
        let (obstacles, mut referee) = (Obstacles::of(&track), Referee::default());
        referee.watch_body(Pose { x_m: -1.0, ..Pose::default() }, &obstacles);
        assert_eq!(referee.progress().clearance_min_m, None, "too far away to be measured");
        referee.watch_body(Pose { x_m: 0.4, ..Pose::default() }, &obstacles);
        let clearance_m = referee.progress().clearance_min_m.expect("it is near");
        assert!((clearance_m - 0.159).abs() < 0.001, "to the corner of the turned box, {clearance_m} m");
        let mut at = |x_m: f64| {
            referee.watch_body(Pose { x_m, ..Pose::default() }, &obstacles);
            referee.progress().collisions
        };
        assert_eq!(at(0.4), 0, "16 cm before the box");
        assert_eq!(
            at(0.56 + 0.01),
            1,
            "the corner of the turned box is 0.139 m from its middle, the nose 0.30 m ahead"
        );
        assert_eq!(at(0.555), 1, "5 mm back is the same contact");
        assert_eq!(at(0.40), 1, "away");
        assert_eq!(at(2.69), 1, "before the wall");
        assert_eq!(at(2.71), 2, "in the wall");
    }
}
