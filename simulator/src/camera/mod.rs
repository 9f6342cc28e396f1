//! The simulated camera. A frame is a function of the pose, the frame's number and the seed.
//!
//! Per row: the floor's raster is sampled along a straight line (there is no roll, so the floor points of a row lie on one),
//! then boxes and walls are filled in, then blur, light and noise, straight into the message's buffer.

pub mod light;
pub mod model;
mod solids;

use std::ops::Range;

use carril_messages::{LightColour, Pose};

use crate::config::CameraConfig;
use crate::floor::{Level, Raster};
use crate::noise::GaussianTable;
use crate::track::{Bgr, Block, Track, TrackError};
use model::{CameraModel, GroundRow};
use solids::Solids;

/// Above the horizon, and floor farther away than this (m), the camera sees an unlit room.
const ROOM: Bgr = [40; 3];
const FAR_M: f64 = 40.0;
/// Fixed point of raster coordinates.
const FRACTION_BITS: u32 = 16;

/// What changes in the world from frame to frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Scene<'a> {
    /// By the traffic lights of the track.
    pub shown: &'a [Option<LightColour>],
    /// Grey boxes beside those of the track.
    pub blocks: &'a [Block],
}

/// Renders frames.
pub struct Camera {
    model: CameraModel,
    raster: Raster,
    solids: Solids,
    rows: Vec<Option<(GroundRow, usize)>>,
    gains: Option<Vec<u16>>,
    noise: Option<GaussianTable<i8>>,
    blur_px: usize,
    seed: u64,
    scene: Vec<Vec<u8>>,
    lines: Vec<Vec<u8>>,
}

impl Camera {
    /// Draws the floor of `track`, or decodes its picture.
    pub fn new(config: &CameraConfig, track: &Track, seed: u64) -> Result<Self, TrackError> {
        let model = config.model();
        let raster = Raster::of(track, config.floor_texel_mm * 1e-3)?;
        let solids = Solids::of(track);
        let planes = if raster.is_grey() && solids.is_grey() { 1 } else { 3 };
        let (width, height) = (model.width, model.height);
        let noise = (config.noise_grey > 0.0)
            .then(|| GaussianTable::new(seed, |x| (x * config.noise_grey).round().clamp(-127.0, 127.0) as i8));
        Ok(Self {
            rows: (0..height).map(|row| row_source(&model, &raster, row)).collect(),
            gains: light::gains(config.lighting, config.exposure, width, height),
            scene: vec![vec![0; width * height]; planes],
            lines: vec![vec![0; width]; planes],
            blur_px: config.blur_px,
            model,
            raster,
            solids,
            noise,
            seed,
        })
    }

    /// Bytes of a frame.
    pub fn frame_len(&self) -> usize {
        self.model.width * self.model.height * 3
    }

    /// Renders frame number `frame` as seen from `pose` into `out`: rows of blue, green, red; [`Self::frame_len`] bytes.
    pub fn render(&mut self, pose: Pose, scene: Scene<'_>, frame: u64, out: &mut [u8]) {
        for plane in 0..self.scene.len() {
            self.render_floor(pose, plane);
        }
        self.render_solids(pose, scene);
        if self.blur_px > 0 {
            for plane in &mut self.scene {
                light::blur(plane, self.model.width, self.model.height, self.blur_px);
            }
        }
        self.develop(frame, out);
    }

    fn render_floor(&mut self, pose: Pose, plane: usize) {
        let (sin, cos) = pose.yaw_rad.sin_cos();
        let Self { model, raster, scene, rows, .. } = self;
        for (source, out) in rows.iter().zip(scene[plane].chunks_exact_mut(model.width)) {
            let Some((ground, level)) = source else {
                out.fill(ROOM[plane]);
                continue;
            };
            let level = &raster.levels[*level];
            // Column c shows the body point (ahead, (middle - c) * metres_per_px).
            let left_m = model.middle_column() * ground.metres_per_px;
            let x_m = pose.x_m + cos * ground.ahead_m - sin * left_m - raster.origin.x;
            let y_m = pose.y_m + sin * ground.ahead_m + cos * left_m - raster.origin.y;
            let line = Line {
                start: [x_m / level.texel_x_m, y_m / level.texel_y_m],
                step: [sin * ground.metres_per_px / level.texel_x_m, -cos * ground.metres_per_px / level.texel_y_m],
            };
            sample(level, plane, &line, raster.outside[plane], out);
        }
    }

    fn render_solids(&mut self, pose: Pose, seen: Scene<'_>) {
        let Self { model, solids, scene, .. } = self;
        for polygon in solids.visible(model, pose, seen) {
            polygon.rows(model.width, model.height, |row, columns: Range<usize>| {
                let start = row * model.width;
                for (plane, pixels) in scene.iter_mut().enumerate() {
                    pixels[start + columns.start..start + columns.end].fill(polygon.colour[plane]);
                }
            });
        }
    }

    /// Light, noise, and the sensor's layout.
    fn develop(&mut self, frame: u64, out: &mut [u8]) {
        let Self { model, scene, lines, gains, noise, seed, .. } = self;
        let width = model.width;
        for (row, out) in out.chunks_exact_mut(width * 3).enumerate() {
            let pixels = row * width..(row + 1) * width;
            let gains = gains.as_ref().map(|gains| &gains[pixels.clone()]);
            for (plane, (scene, line)) in scene.iter().zip(&mut *lines).enumerate() {
                let purpose = [*seed, frame, row as u64, plane as u64];
                let noise = noise.as_ref().map(|noise| noise.slice(&purpose, width));
                light::shade(&scene[pixels.clone()], gains, noise, line);
            }
            match &lines[..] {
                [blue, green, red] => light::interleave(blue, green, red, out),
                grey => light::spread_grey(&grey[0], out),
            }
        }
    }
}

/// Which floor line a row shows, and the raster level whose texels are about as large as its pixels.
fn row_source(model: &CameraModel, raster: &Raster, row: usize) -> Option<(GroundRow, usize)> {
    let ground = model.ground_row(row as f64)?;
    if ground.ahead_m > FAR_M {
        return None;
    }
    // A pixel near the horizon is much longer than wide on the floor: its side is that of the square of the same area.
    let length_m = (model.ground_row(row as f64 - 1.0)?.ahead_m - ground.ahead_m).min(FAR_M);
    let side_m = (length_m * ground.metres_per_px).sqrt();
    let finer = |level: &&Level| level.texel_x_m <= side_m;
    let level = raster.levels.iter().take_while(finer).count().saturating_sub(1);
    Some((ground, level))
}

/// A straight line over a raster, in texels, column by column of the image.
struct Line {
    start: [f64; 2],
    step: [f64; 2],
}

impl Line {
    /// The columns whose points lie on the raster.
    fn columns(&self, level: &Level, count: usize) -> Range<usize> {
        let (mut first, mut end) = (0.0_f64, count as f64);
        for (axis, limit) in [level.width as f64, level.height as f64].into_iter().enumerate() {
            let (start, step) = (self.start[axis], self.step[axis]);
            if step.abs() < 1e-9 {
                if !(start >= 0.0 && start < limit) {
                    return 0..0;
                }
            } else {
                let (enter, leave) = (-start / step, (limit - start) / step);
                first = first.max(enter.min(leave));
                end = end.min(enter.max(leave));
            }
        }
        let first = first.ceil().clamp(0.0, count as f64) as usize;
        first..(end.ceil().clamp(0.0, count as f64) as usize).max(first)
    }
}

/// Reads the raster along a line, nearest texel.
fn sample(level: &Level, plane: usize, line: &Line, outside: u8, out: &mut [u8]) {
    let columns = line.columns(level, out.len());
    out[..columns.start].fill(outside);
    out[columns.end..].fill(outside);
    let fixed = |value: f64| (value * f64::from(1_u32 << FRACTION_BITS)) as i64;
    let at = |axis: usize| fixed(line.start[axis] + line.step[axis] * columns.start as f64);
    let (mut x, mut y) = (at(0), at(1));
    let (step_x, step_y) = (fixed(line.step[0]), fixed(line.step[1]));
    let texels = &level.planes[plane.min(level.planes.len() - 1)][..];
    for out in &mut out[columns] {
        // A rounding at the raster's edge may step over it: then the neighbouring row, or nothing, is read.
        let row = ((y >> FRACTION_BITS) as usize).wrapping_mul(level.width);
        *out = texels.get(row.wrapping_add((x >> FRACTION_BITS) as usize)).copied().unwrap_or(outside);
        (x, y) = (x.wrapping_add(step_x), y.wrapping_add(step_y));
    }
}
