//! The track file as it is written: YAML with unknown keys refused. Every value knows its place; the rules are in `rules`.

use std::path::Path;

use serde::Deserialize;
use serde_saphyr::Spanned;

use super::rules;
use super::{Style, Track, TrackError};

/// No track file is larger, B. A centre line of 10 000 points takes about 200 kB.
const MAX_FILE_BYTES: u64 = 2 << 20;

/// A whole file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawTrack {
    pub lane: Option<Spanned<RawLane>>,
    pub floor: Option<RawFloor>,
    #[serde(default)]
    pub boxes: Vec<RawBox>,
    #[serde(default)]
    pub walls: Vec<RawWall>,
    #[serde(default)]
    pub lights: Vec<Spanned<RawLight>>,
    pub start: Option<Spanned<RawStart>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawLane {
    pub centre: Spanned<RawCentre>,
    pub width_m: Option<Spanned<f64>>,
    pub left: Option<Style>,
    pub middle: Option<Style>,
    pub right: Option<Style>,
    pub far_left: Option<Style>,
    pub marking_width_m: Option<Spanned<f64>>,
    pub dash_m: Option<Spanned<f64>>,
    pub gap_m: Option<Spanned<f64>>,
    pub fence: Option<RawFence>,
}

/// The middle of the lane: a chain of pieces, or points of a smooth curve.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RawCentre {
    Pieces(Vec<Spanned<RawPiece>>),
    Points(Vec<Spanned<Vec<f64>>>),
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RawPiece {
    StraightM(Spanned<f64>),
    Left(RawArc),
    Right(RawArc),
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawArc {
    pub radius_m: Spanned<f64>,
    pub angle_deg: Spanned<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawFence {
    pub distance_m: Spanned<f64>,
    pub height_m: Option<Spanned<f64>>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawFloor {
    pub image: Option<Spanned<String>>,
    pub width_m: Option<Spanned<f64>>,
    pub height_m: Option<Spanned<f64>>,
    pub colour: Option<Spanned<Vec<i64>>>,
    pub marking: Option<Spanned<Vec<i64>>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawBox {
    pub x_m: Spanned<f64>,
    pub y_m: Spanned<f64>,
    pub yaw_deg: Option<Spanned<f64>>,
    pub length_m: Spanned<f64>,
    pub width_m: Spanned<f64>,
    pub height_m: Option<Spanned<f64>>,
    pub colour: Option<Spanned<Vec<i64>>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawWall {
    pub from: Spanned<Vec<f64>>,
    pub to: Spanned<Vec<f64>>,
    pub height_m: Option<Spanned<f64>>,
    pub colour: Option<Spanned<Vec<i64>>>,
}

/// A traffic light beside the lane.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawLight {
    pub along_m: Spanned<f64>,
    pub left_m: Option<Spanned<f64>>,
    pub beyond_m: Option<Spanned<f64>>,
    pub height_m: Option<Spanned<f64>>,
    pub line_width_m: Option<Spanned<f64>>,
    pub phases: Spanned<Vec<RawPhase>>,
    pub offset_s: Option<Spanned<f64>>,
}

/// What it shows for how long, s.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RawPhase {
    Red(Spanned<f64>),
    Green(Spanned<f64>),
    Dark(Spanned<f64>),
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawStart {
    pub along_m: Option<Spanned<f64>>,
    pub left_m: Option<Spanned<f64>>,
    pub x_m: Option<Spanned<f64>>,
    pub y_m: Option<Spanned<f64>>,
    pub yaw_deg: Option<Spanned<f64>>,
}

/// The text of a track file.
pub fn read_text(name: &str, path: &Path) -> Result<String, TrackError> {
    let whole = |message, hint| TrackError::whole(name, message, hint);
    let hint = "a track is `oval`, `s-bends`, `two-lanes`, `random:SEED`, `random-road:SEED`, or a file below the folder of the graph file";
    let unreadable = |error| whole(format!("cannot read `{}`: {error}", path.display()), Some(hint));
    let size = std::fs::metadata(path).map_err(unreadable)?.len();
    if size > MAX_FILE_BYTES {
        return Err(whole(format!("the file has {size} B, allowed are at most {MAX_FILE_BYTES} B"), None));
    }
    let bytes = std::fs::read(path).map_err(unreadable)?;
    String::from_utf8(bytes).map_err(|_| whole("the file is not text in UTF-8".to_owned(), Some("is it a picture?")))
}

/// Reads and checks a track. Pictures are found relative to `base_dir`.
pub fn read(name: &str, text: &str, base_dir: &Path) -> Result<Track, TrackError> {
    let raw: RawTrack = serde_saphyr::from_str(text).map_err(|error| {
        let message = first_line(&error.without_snippet().to_string());
        match error.location() {
            Some(place) => TrackError::at(
                name,
                (place.line() as u32, place.column() as u32),
                message,
                Some("see docs/simulator.md"),
            ),
            None => TrackError::whole(name, message, Some("see docs/simulator.md")),
        }
    })?;
    rules::check(name, raw, base_dir)
}

/// The reader repeats the place at the end of its message; the error has it already.
fn first_line(message: &str) -> String {
    let line = message.lines().next().unwrap_or_default();
    let line = line.split(" at line ").next().unwrap_or(line);
    line.strip_prefix("error: ").unwrap_or(line).to_owned()
}
