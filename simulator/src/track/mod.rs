//! What stands and lies in the world: the lane, the floor, boxes, walls, and where the car starts. Checked: every number is
//! finite and within its range. Reading a file is in `file`, drawing the floor in [`crate::floor`].

mod centre;
mod file;
mod problems;
pub mod random;
mod rules;

use std::path::{Path, PathBuf};

use carril_messages::Pose;
use nalgebra::{Point2, Vector2};

use crate::centre_line::{CentreLine, left_of};
use crate::traffic_light::TrafficLight;

pub use problems::{Problem, TrackError};

/// The track of that name as it comes with the simulator.
const BUILT_IN: [(&str, &str); 3] = [
    ("oval", include_str!("../../../tracks/oval.yaml")),
    ("s-bends", include_str!("../../../tracks/s-bends.yaml")),
    ("two-lanes", include_str!("../../../tracks/two-lanes.yaml")),
];
/// Before the seed of a random track of one lane, and before that of a random road of two.
const RANDOM: [(&str, random::Kind); 2] = [("random:", random::Kind::Lane), ("random-road:", random::Kind::Road)];

/// A colour, blue, green, red, each 0 to 255 as the camera sees it at exposure 1 in even light.
pub type Bgr = [u8; 3];

/// A checked track.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// As configured: `oval`, `random:17`, `tracks/mine.yaml`.
    pub name: String,
    /// The lane that the referee watches. `None`: a picture without a centre line.
    pub lane: Option<Lane>,
    /// What the camera sees on the ground.
    pub floor: Floor,
    /// Boxes on the floor.
    pub boxes: Vec<Block>,
    /// Thin upright walls.
    pub walls: Vec<Wall>,
    /// Traffic lights, each with a stop line.
    pub lights: Vec<TrafficLight>,
    /// Pose of the car's rear axle at the start.
    pub start: Pose,
}

/// The lane.
#[derive(Clone, Debug, PartialEq)]
pub struct Lane {
    /// Its middle, in driving direction.
    pub centre: CentreLine,
    /// Between the middles of its two markings, m.
    pub width_m: f64,
}

/// What the camera sees on the ground.
#[derive(Clone, Debug, PartialEq)]
pub enum Floor {
    /// Markings along the lane.
    Drawn(Markings),
    /// A picture, its lower left corner at the origin of the map.
    Picture(Picture),
}

/// Markings along the lane.
#[derive(Clone, Debug, PartialEq)]
pub struct Markings {
    /// Of the floor.
    pub floor: Bgr,
    /// Of the markings.
    pub paint: Bgr,
    /// Of a marking, m.
    pub width_m: f64,
    /// On the left, in the middle, on the right, and a lane's width beyond the left: the far side of an oncoming lane.
    pub styles: [Style; 4],
    /// Length of a dash, m.
    pub dash_m: f64,
    /// From dash to dash, m.
    pub gap_m: f64,
}

/// How a marking is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Style {
    /// Without gaps.
    Solid,
    /// With gaps.
    Dashed,
    /// Not at all.
    None,
}

/// A floor picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Where it lies.
    pub path: PathBuf,
    /// What it covers in x, m.
    pub width_m: f64,
    /// What it covers in y, m.
    pub height_m: f64,
    /// Beyond its edges.
    pub outside: Bgr,
    /// Where in the track file it is named, for errors: line and column, from 1.
    pub place: (u32, u32),
}

/// A box on the floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Block {
    /// Of its middle.
    pub pose: Pose,
    /// Along its own x axis, m.
    pub length_m: f64,
    /// Along its own y axis, m.
    pub width_m: f64,
    /// m.
    pub height_m: f64,
    /// Of its lightest face.
    pub colour: Bgr,
}

/// A thin upright wall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wall {
    /// One end.
    pub from: Point2<f64>,
    /// The other end.
    pub to: Point2<f64>,
    /// m.
    pub height_m: f64,
    /// As seen at a right angle.
    pub colour: Bgr,
}

/// Part of a `track` setting, before anything is read.
enum Source<'a> {
    Seed(random::Kind, u64),
    Text(String, PathBuf),
    BuiltIn(&'a str),
}

impl Track {
    /// The track that a configuration names: `oval`, `s-bends`, `two-lanes`, `random:SEED`, `random-road:SEED`, or a file, relative to `base_dir`. Pictures are
    /// only looked at, not decoded.
    pub fn load(name: &str, base_dir: &Path) -> Result<Self, TrackError> {
        match Self::source(name, base_dir)? {
            Source::Seed(kind, seed) => Ok(random::track(name, kind, seed)),
            Source::BuiltIn(text) => file::read(name, text, base_dir),
            Source::Text(text, path) => file::read(name, &text, path.parent().unwrap_or(base_dir)),
        }
    }

    fn source(name: &str, base_dir: &Path) -> Result<Source<'static>, TrackError> {
        if let Some((kind, seed)) = Self::random(name) {
            let hint = "write a whole number, like `random:17`";
            let seed = seed.parse().map_err(|_| TrackError::whole(name, format!("`{seed}` is no seed"), Some(hint)))?;
            return Ok(Source::Seed(kind, seed));
        }
        if let Some((_, text)) = BUILT_IN.iter().find(|(known, _)| *known == name) {
            return Ok(Source::BuiltIn(text));
        }
        let path = base_dir.join(name);
        file::read_text(name, &path).map(|text| Source::Text(text, path))
    }

    /// Of a random track: its kind and what should be its seed.
    fn random(name: &str) -> Option<(random::Kind, &str)> {
        RANDOM.iter().find_map(|(prefix, kind)| Some((*kind, name.strip_prefix(prefix)?)))
    }

    /// Whether `name` is a file, not a built-in or random track.
    pub fn is_file(name: &str) -> bool {
        Self::random(name).is_none() && BUILT_IN.iter().all(|(known, _)| *known != name)
    }
}

impl Lane {
    /// The pose `left_m` to the left of the lane's middle, `along_m` from its start, looking along it.
    pub fn pose_at(&self, along_m: f64, left_m: f64) -> Pose {
        let index = self.centre.index_at(along_m);
        let point = self.centre.beside(index, left_m);
        let direction = self.centre.directions()[index];
        Pose { x_m: point.x, y_m: point.y, yaw_rad: direction.y.atan2(direction.x) }
    }
}

impl Block {
    /// Its corners on the floor, counter-clockwise.
    pub fn corners(&self) -> [Point2<f64>; 4] {
        let forward = Vector2::new(self.pose.yaw_rad.cos(), self.pose.yaw_rad.sin());
        let (x, y) = (forward * (self.length_m / 2.0), left_of(forward) * (self.width_m / 2.0));
        let middle = Point2::new(self.pose.x_m, self.pose.y_m);
        [middle + x + y, middle - x + y, middle - x - y, middle + x - y]
    }
}
