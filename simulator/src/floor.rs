//! The floor as the camera samples it: a raster in the map frame, drawn once from the track, with ever coarser copies for
//! distant rows.

use nalgebra::Point2;

use crate::centre_line::CentreLine;
use crate::picture;
use crate::track::{Bgr, Floor, Lane, Markings, Picture, Style, Track, TrackError};
use crate::traffic_light::TrafficLight;

/// No raster has more texels; a larger floor gets larger texels.
const MAX_TEXELS: f64 = 64e6;
/// Nor a longer side: coordinates are sampled with 16 bits for the integer part.
const MAX_SIDE: f64 = 16_384.0;
/// Coarser copies, each of half the resolution.
const COARSER_LEVELS: usize = 5;

/// A floor raster.
#[derive(Clone, Debug)]
pub struct Raster {
    /// The map point at the lower left corner of the lower left texel.
    pub origin: Point2<f64>,
    /// From fine to coarse.
    pub levels: Vec<Level>,
    /// Beyond the raster.
    pub outside: Bgr,
}

/// The raster at one resolution. Rows go from south to north.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    /// Texels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Side of a texel in x, m.
    pub texel_x_m: f64,
    /// Side of a texel in y, m.
    pub texel_y_m: f64,
    /// One plane of grey, or three: blue, green, red.
    pub planes: Vec<Vec<u8>>,
}

impl Raster {
    /// The floor of a track with texels of `texel_m`. Decodes the floor picture, if there is one.
    pub fn of(track: &Track, texel_m: f64) -> Result<Self, TrackError> {
        match (&track.floor, &track.lane) {
            (Floor::Picture(picture), _) => Self::from_picture(picture, texel_m)
                .map_err(|problem| TrackError::at(&track.name, picture.place, problem, None)),
            (Floor::Drawn(markings), Some(lane)) => Ok(Self::drawn(markings, lane, &track.lights, texel_m)),
            (Floor::Drawn(markings), None) => Ok(Self::bare(markings.floor)),
        }
    }

    /// Whether it has one plane only.
    pub fn is_grey(&self) -> bool {
        self.levels[0].planes.len() == 1 && self.outside[0] == self.outside[1] && self.outside[1] == self.outside[2]
    }

    fn new(origin: Point2<f64>, finest: Level, outside: Bgr) -> Self {
        let mut levels = vec![finest];
        for _ in 0..COARSER_LEVELS {
            levels.push(levels[levels.len() - 1].halved());
        }
        Self { origin, levels, outside }
    }

    fn bare(colour: Bgr) -> Self {
        let planes = colour.map(|value| vec![value; 1]).to_vec();
        Self::new(Point2::origin(), Level { width: 1, height: 1, texel_x_m: 0.01, texel_y_m: 0.01, planes }, colour)
    }

    fn from_picture(picture: &Picture, texel_m: f64) -> Result<Self, String> {
        let side = |size_m: f64| (size_m / texel_m).clamp(1.0, MAX_SIDE / 2.0).ceil() as usize;
        let reduced = picture::load(&picture.path, side(picture.width_m), side(picture.height_m))?;
        let level = Level {
            width: reduced.width,
            height: reduced.height,
            texel_x_m: picture.width_m / reduced.width as f64,
            texel_y_m: picture.height_m / reduced.height as f64,
            planes: reduced.planes,
        };
        Ok(Self::new(Point2::origin(), level, picture.outside))
    }

    fn drawn(markings: &Markings, lane: &Lane, lights: &[TrafficLight], texel_m: f64) -> Self {
        let road = markings.styles[3] != Style::None;
        let margin_m = if road { 2.0 } else { 1.0 } * lane.width_m + markings.width_m;
        let (low, high) = bounds(lane.centre.points());
        let (width_m, height_m) = (high.x - low.x + 2.0 * margin_m, high.y - low.y + 2.0 * margin_m);
        let smallest_m = (width_m * height_m / MAX_TEXELS).sqrt().max(width_m.max(height_m) / MAX_SIDE);
        let mut canvas =
            Canvas::new(low - nalgebra::Vector2::repeat(margin_m), width_m, height_m, texel_m.max(smallest_m));
        for (style, side) in markings.styles.into_iter().zip([0.5, 0.0, -0.5, 1.5]) {
            canvas.marking(&lane.centre, side * lane.width_m, style, markings);
        }
        for light in lights {
            canvas.stop_line(lane, light);
        }
        canvas.into_raster(markings)
    }
}

fn bounds(points: &[Point2<f64>]) -> (Point2<f64>, Point2<f64>) {
    let far = f64::INFINITY;
    points
        .iter()
        .fold((Point2::new(far, far), Point2::new(-far, -far)), |(low, high), point| (low.inf(point), high.sup(point)))
}

/// How much of each texel is painted, 0 to 255.
struct Canvas {
    origin: Point2<f64>,
    width: usize,
    height: usize,
    texel_m: f64,
    paint: Vec<u8>,
}

impl Canvas {
    fn new(origin: Point2<f64>, width_m: f64, height_m: f64, texel_m: f64) -> Self {
        let (width, height) = ((width_m / texel_m).ceil() as usize, (height_m / texel_m).ceil() as usize);
        Self { origin, width, height, texel_m, paint: vec![0; width * height] }
    }

    fn marking(&mut self, centre: &CentreLine, left_m: f64, style: Style, markings: &Markings) {
        let count = centre.points().len();
        let period_m = markings.dash_m + markings.gap_m;
        for index in 0..count {
            let drawn = match style {
                Style::Solid => true,
                Style::Dashed => (index as f64 * centre.step_m()).rem_euclid(period_m) < markings.dash_m,
                Style::None => false,
            };
            if drawn {
                self.stroke(centre.beside(index, left_m), centre.beside((index + 1) % count, left_m), markings.width_m);
            }
        }
    }

    /// Across the lane, between its markings.
    fn stop_line(&mut self, lane: &Lane, light: &TrafficLight) {
        let middle_m = light.along_m + light.line_width_m / 2.0;
        // A stroke is longer than its ends by half of its width.
        let half_m = (lane.width_m - light.line_width_m).max(0.0) / 2.0;
        let end = |left_m: f64| {
            let pose = lane.pose_at(middle_m, left_m);
            Point2::new(pose.x_m, pose.y_m)
        };
        self.stroke(end(half_m), end(-half_m), light.line_width_m);
    }

    /// Paints a short straight stroke; texels at its edge are painted in part.
    fn stroke(&mut self, from: Point2<f64>, to: Point2<f64>, width_m: f64) {
        let reach_m = width_m / 2.0 + self.texel_m;
        let texel = |value_m: f64, limit: usize| ((value_m / self.texel_m).max(0.0) as usize).min(limit);
        let (low, high) = (from.inf(&to) - self.origin, from.sup(&to) - self.origin);
        let columns = texel(low.x - reach_m, self.width)..texel(high.x + reach_m + self.texel_m, self.width);
        let (along, length_sq) = (to - from, (to - from).norm_squared().max(1e-12));
        for row in texel(low.y - reach_m, self.height)..texel(high.y + reach_m + self.texel_m, self.height) {
            for column in columns.clone() {
                let middle = nalgebra::Vector2::new(column as f64 + 0.5, row as f64 + 0.5) * self.texel_m;
                let offset = self.origin + middle - from;
                let share = (offset.dot(&along) / length_sq).clamp(0.0, 1.0);
                let distance_m = (offset - along * share).norm();
                let coverage = (0.5 + (width_m / 2.0 - distance_m) / self.texel_m).clamp(0.0, 1.0);
                let texel = &mut self.paint[row * self.width + column];
                *texel = (*texel).max((coverage * 255.0) as u8);
            }
        }
    }

    fn into_raster(self, markings: &Markings) -> Raster {
        let Self { origin, width, height, texel_m, paint } = self;
        let is_grey = |colour: Bgr| colour[0] == colour[1] && colour[1] == colour[2];
        let planes = if is_grey(markings.floor) && is_grey(markings.paint) { 1 } else { 3 };
        let blend = |plane: usize, paint: u8| {
            let (floor, marking) = (u32::from(markings.floor[plane]), u32::from(markings.paint[plane]));
            ((floor * u32::from(255 - paint) + marking * u32::from(paint) + 127) / 255) as u8
        };
        let planes = (0..planes).map(|plane| paint.iter().map(|paint| blend(plane, *paint)).collect()).collect();
        Raster::new(origin, Level { width, height, texel_x_m: texel_m, texel_y_m: texel_m, planes }, markings.floor)
    }
}

impl Level {
    /// Half the resolution, by averaging.
    fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mean = |plane: &Vec<u8>, x: usize, y: usize| {
            let (x1, y1) = ((2 * x + 1).min(self.width - 1), (2 * y + 1).min(self.height - 1));
            let at = |x: usize, y: usize| u32::from(plane[y * self.width + x]);
            ((at(2 * x, 2 * y) + at(x1, 2 * y) + at(2 * x, y1) + at(x1, y1) + 2) / 4) as u8
        };
        let coarse = |plane: &Vec<u8>| (0..width * height).map(|i| mean(plane, i % width, i / width)).collect();
        let planes = self.planes.iter().map(coarse).collect();
        Self { width, height, texel_x_m: 2.0 * self.texel_x_m, texel_y_m: 2.0 * self.texel_y_m, planes }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn grey_at(raster: &Raster, level: usize, x_m: f64, y_m: f64) -> u8 {
        let level = &raster.levels[level];
        let column = ((x_m - raster.origin.x) / level.texel_x_m) as usize;
        let row = ((y_m - raster.origin.y) / level.texel_y_m) as usize;
        level.planes[0][row * level.width + column]
    }

    #[test]
    fn markings_lie_where_the_track_says() {
        let track = Track::load("oval", Path::new(".")).expect("the oval is built in");
        let raster = Raster::of(&track, 0.004).expect("drawn");
        assert!(raster.is_grey(), "the default colours are greys");
        for level in 0..2 {
            assert_eq!(grey_at(&raster, level, 1.0, 0.2), 230, "left marking of the first straight, level {level}");
            assert_eq!(grey_at(&raster, level, 1.0, -0.2), 230, "right marking, level {level}");
            assert_eq!(grey_at(&raster, level, 1.0, 0.0), 60, "middle, level {level}");
            assert_eq!(grey_at(&raster, level, 1.0, 0.22), 60, "beside the marking, level {level}");
        }
        assert_eq!(grey_at(&raster, 0, 2.0 + 1.2, 1.0), 230, "outer marking of the first curve");
        assert_eq!(grey_at(&raster, 0, 2.0 + 0.8, 1.0), 230, "inner marking of the first curve");
    }

    #[test]
    fn dashes_have_gaps() {
        let mut track = Track::load("oval", Path::new(".")).expect("the oval is built in");
        if let Floor::Drawn(markings) = &mut track.floor {
            markings.styles[1] = Style::Dashed;
            markings.paint = [255, 0, 0];
            markings.styles[3] = Style::Solid;
        }
        let raster = Raster::of(&track, 0.004).expect("drawn");
        assert!(!raster.is_grey(), "blue paint needs three planes");
        assert_eq!(grey_at(&raster, 0, 0.1, 0.0), 255, "the first dash is blue");
        assert_eq!(grey_at(&raster, 0, 0.3, 0.0), 60, "the first gap is floor");
        assert_eq!(grey_at(&raster, 0, 1.0, 0.6), 255, "the far side of the oncoming lane");
    }
}
