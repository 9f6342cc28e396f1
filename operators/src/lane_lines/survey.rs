//! How the camera looks at the floor, found from a straight lane of known width. For calibration, not for driving: it looks at many
//! frames at leisure. Pure.
//!
//! On a flat floor the two lines of a straight lane are straight in the image too, and the width between them, across a row, grows evenly
//! from 0 at the horizon: `width = slope (row - horizon)`. With the focal length f, rows from the middle of the image, the lane's width W
//! and its direction psi: `tan(pitch) = -horizon / f`, and `height = W cos(pitch) / (slope cos(psi))`.

use carril_messages::Image;
use serde::Serialize;

use super::config::{CameraPose, LaneLinesConfig, Which};
use super::floor::{Floor, Row};
use super::ridges::{Ridge, Scratch};
use crate::lane_detector::survey::MAX_FRAMES;

/// The pose in force may be so far off: heights that are tried, against its own.
const HEIGHTS: [f64; 5] = [1.0, 0.7, 1.4, 0.5, 2.0];
/// And pitches, against its own, degrees.
const PITCHES_DEG: [f64; 5] = [0.0, -8.0, 8.0, -16.0, 16.0];
/// With what was found the lines are looked for again, so often, ...
const PASSES: usize = 6;
/// ... until it differs by no more than this share of the height, and this angle.
const SETTLED: (f64, f64) = (0.01, 0.3);
/// A ridge belongs to a line in the image when it lies this near, px in an image of 640 columns.
const NEAR_PX: f64 = 2.0;
/// A line is one with ridges in this share of the rows.
const LEAST_ROWS: f64 = 0.25;
/// Pairs of ridges that are tried for a line.
const TRIES: usize = 600;
/// Lines that are looked for in an image: a road has three, and there may be another thing.
const MOST_LINES: usize = 5;
/// What lies along a line is nearer to it than this share of the lane's width, ...
const ALONG: f64 = 0.35;
/// ... and is a piece of it when it is nearer than this one. Of a straight line nearly all are.
const PIECE: (f64, f64) = (0.03, 0.85);
/// One of the two lines is seen in this share of the rows at least: a curve leaves its tangent long before the last row.
const SEEN: f64 = 0.5;
/// Frames must agree within this share of the height, and this angle.
const SPREAD: (f64, f64) = (0.05, 1.0);
/// In so large a share of the frames the lane must have been seen.
const LEAST_FRAMES: f64 = 0.2;

/// What has been seen so far.
#[derive(Clone, Debug)]
pub struct CameraSurvey {
    config: LaneLinesConfig,
    poses: Vec<CameraPose>,
    bent: usize,
    frames: usize,
}

/// A value with its spread: half of what lies between the 10 % and the 90 % of the frames.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// The median.
    pub value: f64,
    /// Half of the range that holds the middle 80 %.
    pub spread: f64,
}

/// How the camera looks at the floor, or why that is not known.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraFindings {
    /// Frames that were looked at.
    pub frames: usize,
    /// Frames with both lines of a straight lane.
    pub straight: usize,
    /// Frames with both lines of a lane that bends.
    pub bent: usize,
    /// Above the floor, m. `None`: in no frame.
    pub height_m: Option<Spread>,
    /// Looking down, degrees. `None`: in no frame.
    pub pitch_deg: Option<Spread>,
    /// What follows.
    pub verdict: PoseVerdict,
}

/// What the frames are good for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseVerdict {
    /// The pose is known.
    Found,
    /// In too few frames both lines were seen.
    NoLane,
    /// The lane bends.
    NotStraight,
    /// The frames do not agree.
    Scattered,
}

/// A line in the image: the column at the bottom row, and columns per row upwards.
#[derive(Clone, Copy, Debug, PartialEq)]
struct ImageLine {
    at_bottom_px: f64,
    per_row: f64,
}

/// A ridge in the image.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Mark {
    column: f64,
    /// Rows above the bottom one.
    up: f64,
}

/// What one frame says.
enum View {
    Straight(CameraPose),
    Bent,
    Nothing,
}

impl CameraSurvey {
    /// For the camera of a detector. `Err`: its lane has no width that could be compared.
    pub fn new(config: &LaneLinesConfig) -> Result<Self, &'static str> {
        if config.lane == Which::Follow {
            return Err(
                "a lane of one line (`lane: follow`) has no width from which the camera's height could be told",
            );
        }
        Ok(Self { config: config.clone(), poses: Vec::new(), bent: 0, frames: 0 })
    }

    /// How many frames were looked at.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Looks at a frame. After [`MAX_FRAMES`] nothing happens.
    pub fn add(&mut self, image: &Image) {
        if self.frames >= MAX_FRAMES || image.width() == 0 || image.height() == 0 {
            return;
        }
        self.frames += 1;
        match self.look(image) {
            View::Straight(pose) => self.poses.push(pose),
            View::Bent => self.bent += 1,
            View::Nothing => {}
        }
    }

    /// What follows from all frames.
    pub fn findings(&self) -> CameraFindings {
        let height_m = Spread::of(self.poses.iter().map(|pose| pose.height_m));
        let pitch_deg = Spread::of(self.poses.iter().map(|pose| pose.pitch_deg));
        let (straight, bent) = (self.poses.len(), self.bent);
        let verdict = match (&height_m, &pitch_deg) {
            _ if bent > straight => PoseVerdict::NotStraight,
            (Some(height), Some(pitch)) if straight as f64 >= LEAST_FRAMES * self.frames as f64 => {
                let agree = height.spread <= SPREAD.0 * height.value && pitch.spread <= SPREAD.1;
                if agree { PoseVerdict::Found } else { PoseVerdict::Scattered }
            }
            _ => PoseVerdict::NoLane,
        };
        CameraFindings { frames: self.frames, straight, bent, height_m, pitch_deg, verdict }
    }

    /// The lines are found best by who knows the pose: from each guess it is refined, and the first that holds is taken.
    fn look(&self, image: &Image) -> View {
        let own = self.config.camera;
        // The last that held comes first.
        let known = self.poses.last().copied();
        let guesses = PITCHES_DEG.iter().flat_map(|more| HEIGHTS.iter().map(move |factor| (*more, *factor)));
        let guesses = guesses.map(|(more_deg, factor)| CameraPose {
            height_m: own.height_m * factor,
            pitch_deg: (own.pitch_deg + more_deg).clamp(-20.0, 80.0),
            ..own
        });
        let mut bent = false;
        for guess in known.into_iter().chain(guesses) {
            match self.refine(image, guess) {
                View::Straight(pose) => return View::Straight(pose),
                View::Bent => bent = true,
                View::Nothing => {}
            }
        }
        if bent { View::Bent } else { View::Nothing }
    }

    /// From a guess to the pose that fits: it must find itself again, and see a straight lane.
    fn refine(&self, image: &Image, mut pose: CameraPose) -> View {
        for pass in 0..PASSES {
            let floor = Floor::new(image.width(), image.height(), pose);
            let rows = floor.rows(self.config.far_m, self.config.lane_width_m);
            let marks = self.marks(image, &floor, &rows);
            let Some(lines) = sides(&marks, &rows, image) else { return View::Nothing };
            let Some(next) = self.pose_from(lines, &floor, pose) else { return View::Nothing };
            let settled = (next.height_m / pose.height_m - 1.0).abs() <= SETTLED.0
                && (next.pitch_deg - pose.pitch_deg).abs() <= SETTLED.1;
            if pass > 0 && settled {
                return if are_straight(lines, &marks, rows.len()) { View::Straight(next) } else { View::Bent };
            }
            pose = next;
        }
        View::Nothing
    }

    fn marks(&self, image: &Image, floor: &Floor, rows: &[Row]) -> Vec<Mark> {
        let mut scratch = Scratch::default();
        scratch.search(image, rows, floor.middle_column(), &self.config);
        let bottom = f64::from(image.height()) - 1.0;
        let mark = |ridge: &Ridge| {
            let row = rows[usize::from(ridge.row)];
            let column = floor.middle_column() - ridge.left_m / row.metres_per_px;
            Mark { column, up: bottom - f64::from(row.y) }
        };
        scratch.ridges.iter().map(mark).collect()
    }

    /// The pose in which these two lines are a lane's width apart everywhere.
    fn pose_from(&self, [left, right]: [ImageLine; 2], floor: &Floor, pose: CameraPose) -> Option<CameraPose> {
        let width_px = right.at_bottom_px - left.at_bottom_px;
        let per_row = left.per_row - right.per_row;
        if per_row < 1e-3 || width_px <= 0.0 {
            return None;
        }
        let horizon_up = width_px / per_row;
        let focal_px = floor.focal_px();
        let pitch_rad = ((horizon_up - floor.middle_up()) / focal_px).atan();
        let vanishing_px = left.at_bottom_px + left.per_row * horizon_up;
        let direction = (floor.middle_column() - vanishing_px) * pitch_rad.cos() / focal_px;
        let height_m = self.config.lane_width_m * pitch_rad.cos() / per_row * direction.hypot(1.0);
        let found = CameraPose { height_m, pitch_deg: pitch_rad.to_degrees(), ..pose };
        ((0.02..=3.0).contains(&found.height_m) && (-20.0..=80.0).contains(&found.pitch_deg)).then_some(found)
    }
}

impl Spread {
    fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get(((values.len() as f64 - 1.0) * share).round() as usize).copied();
        Some(Self { value: at(0.5)?, spread: (at(0.9)? - at(0.1)?) / 2.0 })
    }
}

/// The lines beside the car in the image, left and right.
fn sides(marks: &[Mark], rows: &[Row], image: &Image) -> Option<[ImageLine; 2]> {
    let near_px = NEAR_PX * (f64::from(image.width()) / 640.0).max(0.5);
    let least = ((rows.len() as f64 * LEAST_ROWS).ceil() as usize).max(4);
    let mut left_over = marks.to_vec();
    let mut lines = Vec::new();
    while lines.len() < MOST_LINES {
        let Some(line) = strongest_line(&left_over, near_px, least) else { break };
        lines.push(line);
        left_over.retain(|mark| line.distance_px(mark) > 4.0 * near_px);
    }
    let middle = (f64::from(image.width()) - 1.0) / 2.0;
    let of_side = |side: f64| {
        let beside = lines.iter().filter(|line| (line.at_bottom_px - middle) * side > 0.0);
        beside.min_by(|a, b| (a.at_bottom_px - middle).abs().total_cmp(&(b.at_bottom_px - middle).abs())).copied()
    };
    Some([of_side(-1.0)?, of_side(1.0)?])
}

/// Whether what lies along the lines lies on them, far ahead too.
fn are_straight(lines: [ImageLine; 2], marks: &[Mark], rows: usize) -> bool {
    let [left, right] = lines;
    let counts = lines.map(|line| {
        let away = |mark: &Mark| line.distance_px(mark) / (right.at(mark.up) - left.at(mark.up));
        let along: Vec<f64> = marks.iter().map(away).filter(|away| (0.0..=ALONG).contains(away)).collect();
        let pieces = along.iter().filter(|away| **away <= PIECE.0).count();
        (pieces as f64, along.len() as f64)
    });
    let seen_far = counts.iter().any(|(pieces, _)| *pieces >= SEEN * rows as f64);
    seen_far && counts.iter().all(|(pieces, along)| *pieces >= PIECE.1 * along)
}

impl ImageLine {
    fn through(a: &Mark, b: &Mark) -> Option<Self> {
        let rise = b.up - a.up;
        let per_row = (b.column - a.column) / rise;
        (rise.abs() >= 1.0).then_some(Self { at_bottom_px: a.column - per_row * a.up, per_row })
    }

    /// The line with the least squares along a row.
    fn fitted(marks: &[&Mark]) -> Option<Self> {
        let count = marks.len() as f64;
        let mean = |of: fn(&Mark) -> f64| marks.iter().map(|mark| of(mark)).sum::<f64>() / count;
        let (up, column) = (mean(|mark| mark.up), mean(|mark| mark.column));
        let spread: f64 = marks.iter().map(|mark| (mark.up - up).powi(2)).sum();
        let both: f64 = marks.iter().map(|mark| (mark.up - up) * (mark.column - column)).sum();
        let per_row = both / spread;
        (spread > 0.0).then_some(Self { at_bottom_px: column - per_row * up, per_row })
    }

    /// The column in a row.
    fn at(&self, up: f64) -> f64 {
        self.at_bottom_px + self.per_row * up
    }

    fn distance_px(&self, mark: &Mark) -> f64 {
        (self.at(mark.up) - mark.column).abs()
    }
}

/// The line through the most rows, of pairs that are drawn always in the same order.
fn strongest_line(marks: &[Mark], near_px: f64, least: usize) -> Option<ImageLine> {
    if marks.len() < least {
        return None;
    }
    let mut drawn = 1_u64;
    let mut draw = || {
        // The numbers of Knuth's MMIX; the upper bits are the good ones.
        drawn = drawn.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        marks[(drawn >> 33) as usize % marks.len()]
    };
    let near = |line: &ImageLine| marks.iter().filter(|mark| line.distance_px(mark) <= near_px).collect::<Vec<_>>();
    let tried = (0..TRIES).filter_map(|_| ImageLine::through(&draw(), &draw()));
    let best = tried.max_by_key(|line| near(line).len())?;
    let on_it = near(&best);
    let (first, last) = (on_it.first()?.up, on_it.last()?.up);
    // What a few rows see is a speck, however wide.
    (on_it.len() >= least && (last - first).abs() >= 4.0 * near_px).then(|| ImageLine::fitted(&on_it))?
}

#[cfg(test)]
mod tests {
    use carril_messages::Encoding;

    use super::*;

    /// A floor with lines as such a camera sees them, grey, each pixel by itself. `lines`: to the left, m; `bend`: 1/m.
    fn picture(pose: CameraPose, lines: &[f64], psi_rad: f64, bend: f64) -> Image {
        let (width, height) = (640_u32, 480_u32);
        let floor = Floor::new(width, height, pose);
        let mut bytes = vec![60; (width * height) as usize];
        for y in 0..height {
            let Some(row) = floor.row(y) else { continue };
            for x in 0..width {
                let left_m = (floor.middle_column() - f64::from(x)) * row.metres_per_px;
                let along = row.ahead_m * psi_rad.cos() + left_m * psi_rad.sin();
                let beside = left_m * psi_rad.cos() - row.ahead_m * psi_rad.sin() - bend * along.powi(2) / 2.0;
                if lines.iter().any(|line| (beside - line).abs() <= 0.01) {
                    bytes[(y * width + x) as usize] = 230;
                }
            }
        }
        Image::packed(width, height, Encoding::Mono8, bytes.into()).expect("a picture")
    }

    fn survey(config: &LaneLinesConfig, images: &[Image]) -> CameraFindings {
        let mut survey = CameraSurvey::new(config).expect("it has a width");
        for image in images {
            survey.add(image);
        }
        survey.findings()
    }

    #[test]
    fn finds_how_the_camera_looks_at_a_straight_lane() {
        for (height_m, pitch_deg, lines, psi) in [
            (0.30, 22.0, &[0.2, -0.2][..], 0.0),
            (0.20, 30.0, &[0.15, -0.25], 0.05),
            (0.45, 15.0, &[0.2, -0.2], -0.08),
            (0.33, 24.0, &[0.25, -0.15, 0.65], 0.1),
        ] {
            let pose = CameraPose { height_m, pitch_deg, ..CameraPose::default() };
            let found = survey(&LaneLinesConfig::default(), &[picture(pose, lines, psi, 0.0)]);
            assert_eq!(found.verdict, PoseVerdict::Found, "{height_m} m, {pitch_deg} degrees: {found:?}");
            let (height, pitch) = (found.height_m.expect("found").value, found.pitch_deg.expect("found").value);
            assert!((height / height_m - 1.0).abs() < 0.02, "height {height} m, expected {height_m} m");
            assert!((pitch - pitch_deg).abs() < 0.4, "pitch {pitch} degrees, expected {pitch_deg} degrees");
        }
    }

    #[test]
    fn a_lane_that_bends_is_told_and_not_measured() {
        let bent = picture(CameraPose::default(), &[0.2, -0.2], 0.0, 1.0);
        let found = survey(&LaneLinesConfig::default(), &[bent.clone(), bent]);
        assert!(found.verdict != PoseVerdict::Found, "a curve of 1 m: {found:?}");
    }

    #[test]
    fn without_two_lines_nothing_is_found() {
        let one = picture(CameraPose::default(), &[0.2], 0.0, 0.0);
        let none = picture(CameraPose::default(), &[], 0.0, 0.0);
        let dot = Image::packed(1, 1, Encoding::Mono8, vec![7].into()).expect("the smallest image");
        for (name, image) in [("one line", one), ("a bare floor", none), ("a dot", dot)] {
            let found = survey(&LaneLinesConfig::default(), &[image]);
            assert_eq!((found.verdict, found.frames), (PoseVerdict::NoLane, 1), "{name}: {found:?}");
        }
        assert_eq!(survey(&LaneLinesConfig::default(), &[]).verdict, PoseVerdict::NoLane, "no frame");
    }

    #[test]
    fn frames_that_do_not_agree_give_nothing() {
        let image = |height_m| picture(CameraPose { height_m, ..CameraPose::default() }, &[0.2, -0.2], 0.0, 0.0);
        let found = survey(&LaneLinesConfig::default(), &[image(0.25), image(0.30), image(0.36)]);
        assert_eq!(found.verdict, PoseVerdict::Scattered, "{found:?}");
    }

    #[test]
    fn a_lane_of_one_line_is_refused() {
        let config = LaneLinesConfig { lane: Which::Follow, ..LaneLinesConfig::default() };
        assert!(CameraSurvey::new(&config).is_err_and(|why| why.contains("one line")), "no width");
    }
}
