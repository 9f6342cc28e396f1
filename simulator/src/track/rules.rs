//! What a track file must keep to. Each rule reports with the place of the value; all problems come in one run.

use std::path::Path;

use carril_messages::{LightColour, Pose};
use nalgebra::Point2;
use serde_saphyr::Spanned;

use super::centre::{self, Piece};
use super::file::{
    RawArc, RawBox, RawCentre, RawFloor, RawLane, RawLight, RawPhase, RawPiece, RawStart, RawTrack, RawWall,
};
use super::{Bgr, Block, Floor, Lane, Markings, Picture, Problem, Style, Track, TrackError, Wall};
use crate::centre_line::CentreLine;
use crate::picture;
use crate::traffic_light::TrafficLight;

/// The default lane, and the greys that a fixed threshold of 190 divides.
pub const LANE_WIDTH_M: f64 = 0.40;
/// Of a marking, m.
pub const MARKING_WIDTH_M: f64 = 0.02;
/// Length of a dash and of a gap, m.
pub const DASH_M: f64 = 0.20;
/// Of a bare floor.
pub const FLOOR: Bgr = [60; 3];
/// Of markings.
pub const PAINT: Bgr = [230; 3];
/// Nothing lies farther from the origin, m.
const MAX_COORDINATE_M: f64 = 100.0;
/// No lane is longer, m.
const MAX_LENGTH_M: f64 = 500.0;
/// A lane so wide cannot turn tighter than half its width.
const MIN_RADIUS_OF_WIDTH: f64 = 0.55;
/// Fences are made of walls of this length, m.
const FENCE_STEP_M: f64 = 0.20;

struct Checker<'a> {
    name: &'a str,
    base_dir: &'a Path,
    problems: Vec<Problem>,
}

/// Checks a raw track.
pub fn check(name: &str, raw: RawTrack, base_dir: &Path) -> Result<Track, TrackError> {
    let mut checker = Checker { name, base_dir, problems: Vec::new() };
    match checker.track(raw) {
        Some(track) if checker.problems.is_empty() => Ok(track),
        _ => {
            checker.problems.sort_by_key(|problem| problem.place.unwrap_or((u32::MAX, 0)));
            Err(TrackError { track: name.to_owned(), problems: checker.problems })
        }
    }
}

fn place<T>(value: &Spanned<T>) -> Option<(u32, u32)> {
    let at = value.referenced;
    (at.line() > 0).then_some((at.line() as u32, at.column() as u32))
}

impl Checker<'_> {
    fn report<T>(&mut self, at: &Spanned<T>, message: String, hint: Option<&str>) {
        self.problems.push(Problem { place: place(at), message, hint: hint.map(str::to_owned) });
    }

    /// A number within its range; NaN is out of every range.
    fn number(&mut self, what: &str, value: &Spanned<f64>, min: f64, max: f64) -> f64 {
        if !(value.value >= min && value.value <= max) {
            self.report(value, format!("{what}: got {}, allowed is {min} to {max}", value.value), None);
        }
        value.value
    }

    fn number_or(&mut self, what: &str, value: Option<&Spanned<f64>>, default: f64, min: f64, max: f64) -> f64 {
        value.map_or(default, |value| self.number(what, value, min, max))
    }

    fn coordinate(&mut self, what: &str, value: &Spanned<f64>) -> f64 {
        self.number(what, value, -MAX_COORDINATE_M, MAX_COORDINATE_M)
    }

    fn point(&mut self, what: &str, value: &Spanned<Vec<f64>>) -> Point2<f64> {
        let [x, y] = value.value[..] else {
            self.report(value, format!("{what}: got {} numbers, expected two, `[x, y]`", value.value.len()), None);
            return Point2::origin();
        };
        if !(x.abs() <= MAX_COORDINATE_M && y.abs() <= MAX_COORDINATE_M) {
            let allowed = format!("allowed is -{MAX_COORDINATE_M} to {MAX_COORDINATE_M} m");
            self.report(value, format!("{what}: got [{x}, {y}], {allowed}"), None);
        }
        Point2::new(x, y)
    }

    fn colour(&mut self, what: &str, value: Option<&Spanned<Vec<i64>>>, default: Bgr) -> Bgr {
        let Some(value) = value else { return default };
        if let [r, g, b] = value.value[..]
            && let (Ok(r), Ok(g), Ok(b)) = (r.try_into(), g.try_into(), b.try_into())
        {
            return [b, g, r];
        }
        let message = format!("{what}: got {:?}, expected `[red, green, blue]`, each 0 to 255", value.value);
        self.report(value, message, None);
        default
    }

    fn track(&mut self, raw: RawTrack) -> Option<Track> {
        let floor = raw.floor.unwrap_or_default();
        let picture = self.picture(&floor);
        let lane = raw.lane.as_ref().and_then(|lane| self.lane(&lane.value));
        let mut walls: Vec<Wall> = raw.walls.iter().map(|wall| self.wall(wall)).collect();
        if let (Some(raw_lane), Some(lane)) = (&raw.lane, &lane) {
            walls.extend(self.fence(&raw_lane.value, lane));
        }
        let markings = self.markings(&floor, raw.lane.as_ref().map(|lane| &lane.value));
        if floor.image.is_none() && raw.lane.is_none() {
            let hint = "give a `lane` with its `centre`, or a floor `image` with `width_m` and `height_m`";
            let message = "there is neither a lane nor a floor picture".to_owned();
            self.problems.push(Problem { place: None, message, hint: Some(hint.to_owned()) });
        }
        let boxes = raw.boxes.iter().map(|block| self.block(block)).collect();
        let lights = raw.lights.iter().filter_map(|light| self.light(light, lane.as_ref())).collect();
        let start = self.start(raw.start.as_ref(), lane.as_ref(), picture.is_some())?;
        let floor = picture.map_or(Floor::Drawn(markings), Floor::Picture);
        Some(Track { name: self.name.to_owned(), lane, floor, boxes, walls, lights, start })
    }

    fn lane(&mut self, raw: &RawLane) -> Option<Lane> {
        let width_m = self.number_or("lane width_m", raw.width_m.as_ref(), LANE_WIDTH_M, 0.1, 5.0);
        let before = self.problems.len();
        let points = match &raw.centre.value {
            RawCentre::Pieces(pieces) => self.pieces(&raw.centre, pieces),
            RawCentre::Points(points) => self.points(&raw.centre, points),
        };
        if self.problems.len() > before {
            return None;
        }
        let centre = CentreLine::through(&points);
        let radius_m = centre.min_radius_m();
        if radius_m < width_m * MIN_RADIUS_OF_WIDTH {
            let allowed = format!("a lane {width_m} m wide needs at least {:.2} m", width_m * MIN_RADIUS_OF_WIDTH);
            let hint = "move the points apart, or make the lane narrower";
            self.report(
                &raw.centre,
                format!("the tightest curve has a radius of {radius_m:.2} m, {allowed}"),
                Some(hint),
            );
        }
        Some(Lane { centre, width_m })
    }

    fn pieces<T>(&mut self, at: &Spanned<T>, raw: &[Spanned<RawPiece>]) -> Vec<Point2<f64>> {
        if raw.len() < 3 {
            self.report(at, format!("got {} pieces, expected at least 3", raw.len()), None);
        }
        let before = self.problems.len();
        let pieces: Vec<Piece> = raw.iter().map(|piece| self.piece(&piece.value)).collect();
        if self.problems.len() > before || self.too_long(at, pieces.iter().map(|piece| piece.length_m).sum()) {
            return Vec::new();
        }
        centre::chain(&pieces).unwrap_or_else(|gap| {
            let missing = format!(
                "{:.2} m ahead, {:.2} m left, {:.1} degrees",
                gap.ahead_m,
                gap.left_m,
                gap.turn_rad.to_degrees()
            );
            let hint = "the last piece must end where the first begins, in the same direction";
            self.report(
                at,
                format!("the centre line is open: {missing} are missing from the end to the start"),
                Some(hint),
            );
            Vec::new()
        })
    }

    fn too_long<T>(&mut self, at: &Spanned<T>, length_m: f64) -> bool {
        let too_long = length_m.is_nan() || length_m > MAX_LENGTH_M;
        if too_long {
            self.report(
                at,
                format!("the centre line is {length_m:.0} m long, allowed are at most {MAX_LENGTH_M} m"),
                None,
            );
        }
        too_long
    }

    fn piece(&mut self, raw: &RawPiece) -> Piece {
        match raw {
            RawPiece::StraightM(length) => {
                Piece { length_m: self.number("straight_m", length, 0.01, 100.0), curvature: 0.0 }
            }
            RawPiece::Left(arc) => self.arc(arc, 1.0),
            RawPiece::Right(arc) => self.arc(arc, -1.0),
        }
    }

    fn arc(&mut self, raw: &RawArc, side: f64) -> Piece {
        let radius_m = self.number("radius_m", &raw.radius_m, 0.1, 100.0);
        let angle_rad = self.number("angle_deg", &raw.angle_deg, 0.1, 360.0).to_radians();
        Piece { length_m: radius_m * angle_rad, curvature: side / radius_m }
    }

    fn points<T>(&mut self, at: &Spanned<T>, raw: &[Spanned<Vec<f64>>]) -> Vec<Point2<f64>> {
        if raw.len() < 3 {
            self.report(at, format!("got {} points, expected at least 3", raw.len()), None);
        }
        let before = self.problems.len();
        let points: Vec<Point2<f64>> = raw.iter().map(|point| self.point("point of the centre line", point)).collect();
        for (index, point) in points.iter().enumerate() {
            let next = points[(index + 1) % points.len()];
            if (next - point).norm() < 0.01 {
                let hint = "the curve closes by itself: do not repeat the first point at the end";
                self.report(&raw[index], "the next point is less than 1 cm away".to_owned(), Some(hint));
            }
        }
        let length_m = (0..points.len()).map(|i| (points[(i + 1) % points.len()] - points[i]).norm()).sum();
        if self.problems.len() > before || raw.len() < 3 || self.too_long(at, length_m) {
            return Vec::new();
        }
        centre::smooth(&points)
    }

    fn markings(&mut self, floor: &RawFloor, lane: Option<&RawLane>) -> Markings {
        let [width, dash, gap] =
            lane.map_or([None; 3], |lane| [lane.marking_width_m.as_ref(), lane.dash_m.as_ref(), lane.gap_m.as_ref()]);
        let style = |choose: fn(&RawLane) -> Option<Style>| lane.and_then(choose);
        Markings {
            floor: self.colour("floor colour", floor.colour.as_ref(), FLOOR),
            paint: self.colour("marking", floor.marking.as_ref(), PAINT),
            width_m: self.number_or("marking_width_m", width, MARKING_WIDTH_M, 0.005, 0.5),
            styles: [
                style(|lane| lane.left).unwrap_or(Style::Solid),
                style(|lane| lane.middle).unwrap_or(Style::None),
                style(|lane| lane.right).unwrap_or(Style::Solid),
                style(|lane| lane.far_left).unwrap_or(Style::None),
            ],
            dash_m: self.number_or("dash_m", dash, DASH_M, 0.02, 10.0),
            gap_m: self.number_or("gap_m", gap, DASH_M, 0.02, 10.0),
        }
    }

    fn picture(&mut self, raw: &RawFloor) -> Option<Picture> {
        let image = raw.image.as_ref()?;
        let mut size = |what: &str, value: Option<&Spanned<f64>>| {
            if value.is_none() {
                self.report(image, format!("a floor picture needs `{what}`: its size on the ground in metres"), None);
            }
            self.number_or(what, value, 1.0, 0.1, MAX_COORDINATE_M)
        };
        let (width_m, height_m) = (size("width_m", raw.width_m.as_ref()), size("height_m", raw.height_m.as_ref()));
        let path = self.base_dir.join(&image.value);
        if let Err(problem) = picture::probe(&path) {
            self.report(image, problem, Some("pictures are found from the folder of the track file"));
        }
        let outside = self.colour("floor colour", raw.colour.as_ref(), [0; 3]);
        Some(Picture { path, width_m, height_m, outside, place: place(image).unwrap_or((1, 1)) })
    }

    fn block(&mut self, raw: &RawBox) -> Block {
        let yaw_deg = self.number_or("yaw_deg", raw.yaw_deg.as_ref(), 0.0, -360.0, 360.0);
        let (x_m, y_m) = (self.coordinate("box x_m", &raw.x_m), self.coordinate("box y_m", &raw.y_m));
        Block {
            pose: Pose { x_m, y_m, yaw_rad: yaw_deg.to_radians() },
            length_m: self.number("box length_m", &raw.length_m, 0.01, 20.0),
            width_m: self.number("box width_m", &raw.width_m, 0.01, 20.0),
            height_m: self.number_or("box height_m", raw.height_m.as_ref(), 0.20, 0.01, 5.0),
            colour: self.colour("box colour", raw.colour.as_ref(), [120; 3]),
        }
    }

    fn wall(&mut self, raw: &RawWall) -> Wall {
        let (from, to) = (self.point("wall from", &raw.from), self.point("wall to", &raw.to));
        if (to - from).norm() < 0.01 {
            self.report(&raw.to, "the wall is shorter than 1 cm".to_owned(), None);
        }
        let height_m = self.number_or("wall height_m", raw.height_m.as_ref(), 0.50, 0.01, 5.0);
        Wall { from, to, height_m, colour: self.colour("wall colour", raw.colour.as_ref(), [100; 3]) }
    }

    /// On the left of the lane and a bit beyond its stop line, unless something else is said.
    fn light(&mut self, spanned: &Spanned<RawLight>, lane: Option<&Lane>) -> Option<TrafficLight> {
        let raw = &spanned.value;
        let along_m = self.number("light along_m", &raw.along_m, 0.0, MAX_LENGTH_M);
        let beyond_m = self.number_or("light beyond_m", raw.beyond_m.as_ref(), 0.3, 0.0, 5.0);
        let height_m = self.number_or("light height_m", raw.height_m.as_ref(), 0.30, 0.1, 2.0);
        let line_width_m = self.number_or("light line_width_m", raw.line_width_m.as_ref(), 0.04, 0.005, 0.5);
        let offset_s = self.number_or("light offset_s", raw.offset_s.as_ref(), 0.0, 0.0, 1e4);
        let beside_m = lane.map_or(0.0, |lane| lane.width_m / 2.0 + 0.15);
        let left_m = self.number_or("light left_m", raw.left_m.as_ref(), beside_m, -5.0, 5.0);
        let phases: Vec<_> = raw.phases.value.iter().map(|phase| self.phase(phase)).collect();
        if phases.is_empty() {
            let hint = Some("write `phases: [{ red: 8 }, { green: 6 }]`: what it shows in turn, and for how long, s");
            self.report(&raw.phases, "the light shows nothing, ever".to_owned(), hint);
        }
        let Some(lane) = lane else {
            // A lane that is there but wrong has been reported already.
            if self.problems.is_empty() {
                self.report(spanned, "a light needs a lane that its stop line crosses".to_owned(), None);
            }
            return None;
        };
        let post = lane.pose_at(along_m + beyond_m, left_m);
        Some(TrafficLight { along_m, line_width_m, post, height_m, phases, offset_s })
    }

    fn phase(&mut self, raw: &RawPhase) -> (Option<LightColour>, f64) {
        let (colour, lasts_s) = match raw {
            RawPhase::Red(lasts_s) => (Some(LightColour::Red), lasts_s),
            RawPhase::Green(lasts_s) => (Some(LightColour::Green), lasts_s),
            RawPhase::Dark(lasts_s) => (None, lasts_s),
        };
        (colour, self.number("a phase of a light, s", lasts_s, 0.05, 1e4))
    }

    /// Walls along both sides of the lane.
    fn fence(&mut self, raw: &RawLane, lane: &Lane) -> Vec<Wall> {
        let Some(fence) = &raw.fence else { return Vec::new() };
        let largest = (lane.centre.min_radius_m() * 0.9).min(10.0);
        let distance_m =
            self.number("fence distance_m", &fence.distance_m, lane.width_m / 2.0, largest.max(lane.width_m));
        let height_m = self.number_or("fence height_m", fence.height_m.as_ref(), 0.30, 0.01, 5.0);
        let count = (lane.centre.length_m() / FENCE_STEP_M).ceil().max(3.0) as usize;
        let at = |k: usize, side: f64| {
            let along_m = lane.centre.length_m() * (k % count) as f64 / count as f64;
            lane.centre.beside(lane.centre.index_at(along_m), side * distance_m)
        };
        let piece = |side: f64, k| Wall { from: at(k, side), to: at(k + 1, side), height_m, colour: [100; 3] };
        [1.0, -1.0].into_iter().flat_map(|side| (0..count).map(move |k| piece(side, k))).collect()
    }

    fn start(&mut self, raw: Option<&Spanned<RawStart>>, lane: Option<&Lane>, on_picture: bool) -> Option<Pose> {
        let Some(spanned) = raw else {
            // A lane that is there but wrong has been reported already.
            if lane.is_none() && on_picture && self.problems.is_empty() {
                let message = "there is no `start`, and no lane whose beginning could be it".to_owned();
                let hint = Some("write `start: { x_m: 1.0, y_m: 2.0, yaw_deg: 90 }`".to_owned());
                self.problems.push(Problem { place: None, message, hint });
            }
            return lane.map(|lane| lane.pose_at(0.0, 0.0));
        };
        let raw = &spanned.value;
        let yaw_rad = self.number_or("start yaw_deg", raw.yaw_deg.as_ref(), 0.0, -360.0, 360.0).to_radians();
        match (&raw.x_m, &raw.y_m, &raw.along_m, &raw.left_m) {
            (Some(x), Some(y), None, None) => {
                Some(Pose { x_m: self.coordinate("start x_m", x), y_m: self.coordinate("start y_m", y), yaw_rad })
            }
            (None, None, _, _) => self.start_on_lane(spanned, lane, yaw_rad),
            _ => {
                let message =
                    "a start is `x_m`, `y_m`, `yaw_deg` in the map, or `along_m`, `left_m`, `yaw_deg` on the lane";
                self.report(spanned, message.to_owned(), None);
                None
            }
        }
    }

    fn start_on_lane(&mut self, spanned: &Spanned<RawStart>, lane: Option<&Lane>, yaw_rad: f64) -> Option<Pose> {
        let raw = &spanned.value;
        let along_m = self.number_or("start along_m", raw.along_m.as_ref(), 0.0, 0.0, MAX_LENGTH_M);
        let left_m = self.number_or("start left_m", raw.left_m.as_ref(), 0.0, -5.0, 5.0);
        if lane.is_none() && self.problems.is_empty() {
            self.report(spanned, "`along_m` and `left_m` need a lane; write `x_m` and `y_m`".to_owned(), None);
        }
        let pose = lane?.pose_at(along_m, left_m);
        Some(Pose { yaw_rad: pose.yaw_rad + yaw_rad, ..pose })
    }
}
