//! Where a row of the image crosses a line: a ridge as wide as a line is there, brighter than the floor on both of its sides. So the
//! edge of a shadow, a gradient of light, and glare that is wider than a line are none, at any exposure.

use carril_messages::Image;

use super::config::LaneLinesConfig;
use super::floor::Row;
use crate::lane_detector::{Marking, pixels};

/// Keeps the contrast of a ridge against its floor finite where the floor is black, grey values.
const DARKEST_FLOOR: f32 = 16.0;
/// A ridge is kept when its contrast is this share of that of the image's lines.
const SHARE_OF_STRONG: f32 = 0.35;
/// In a row no more ridges are kept.
const MAX_PER_ROW: usize = 12;

/// Where a row crosses what may be a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Ridge {
    /// Ahead of the rear axle, m.
    pub ahead_m: f64,
    /// To the left, m.
    pub left_m: f64,
    /// Which of the searched rows.
    pub row: u16,
    /// Contrast against the floor beside it.
    strength: f32,
}

/// Memory that is used again and again.
#[derive(Clone, Debug, Default)]
pub(crate) struct Scratch {
    values: Vec<u8>,
    sums: Vec<i32>,
    rises: Vec<f32>,
    floors: Vec<f32>,
    strongest: Vec<f32>,
    pub ridges: Vec<Ridge>,
}

impl Scratch {
    /// Searches the rows of an image; what is found lies in `ridges`.
    pub fn search(&mut self, image: &Image, rows: &[Row], middle_column: f64, config: &LaneLinesConfig) {
        self.ridges.clear();
        self.strongest.clear();
        let least = match config.marking {
            // Half of a line is of its colour.
            Marking::Hsv(_) => 127.0,
            Marking::Bright | Marking::Dark => config.min_contrast as f32,
        };
        for (index, row) in rows.iter().enumerate() {
            self.read_row(image, row.y, &config.marking);
            self.respond((config.line_width_m / row.metres_per_px) as f32);
            let before = self.ridges.len();
            self.collect(index as u16, row, middle_column, least);
            self.keep_strongest_of_row(before);
        }
        self.keep_strong();
    }

    fn read_row(&mut self, image: &Image, y: u32, marking: &Marking) {
        self.values.resize(image.width() as usize, 0);
        match marking {
            Marking::Hsv(range) => {
                pixels::hsv_mask_row(image.encoding(), image.row(y), range, &mut self.values);
                self.values.iter_mut().for_each(|value| *value *= 255);
            }
            Marking::Bright => pixels::grey_row(image.encoding(), image.row(y), &mut self.values),
            Marking::Dark => {
                pixels::grey_row(image.encoding(), image.row(y), &mut self.values);
                self.values.iter_mut().for_each(|value| *value = 255 - *value);
            }
        }
    }

    /// How much each pixel's neighbourhood, as wide as a line, rises above the brighter one of the two beside it; and that one.
    fn respond(&mut self, line_px: f32) {
        let width = self.values.len();
        let half = ((line_px / 2.0).round() as usize).clamp(1, width / 8 + 1);
        let (wide, gap) = (2 * half + 1, half);
        let pad = half + gap + wide + 1;
        self.sums.clear();
        self.sums.push(0);
        let mut sum = 0_i32;
        // Beyond the edge the row goes on as at its edge.
        let (first, last) = (i32::from(self.values[0]), i32::from(self.values[width - 1]));
        for _ in 0..pad {
            sum += first;
            self.sums.push(sum);
        }
        for value in &self.values {
            sum = sum.wrapping_add(i32::from(*value));
            self.sums.push(sum);
        }
        for _ in 0..pad {
            sum += last;
            self.sums.push(sum);
        }
        self.rises.resize(width, 0.0);
        self.floors.resize(width, 0.0);
        let sums = &self.sums[..];
        let at = |offset: usize| &sums[offset..offset + width];
        // Column x has its own pixel between the sums x + pad and x + pad + 1.
        let (left_0, left_1) = (at(pad - half - gap - wide), at(pad - half - gap));
        let (middle_0, middle_1) = (at(pad - half), at(pad + half + 1));
        let (right_0, right_1) = (at(pad + half + 1 + gap), at(pad + half + 1 + gap + wide));
        let scale = 1.0 / wide as f32;
        // A line that is cut by the edge of the image has floor on one side only: the other one is not asked.
        let (first_asked, last_asked) =
            ((half + gap + wide / 2).min(width), width.saturating_sub(half + gap + wide / 2));
        for x in 0..width {
            let left = left_1[x].wrapping_sub(left_0[x]);
            let right = right_1[x].wrapping_sub(right_0[x]);
            let middle = middle_1[x].wrapping_sub(middle_0[x]);
            let floor = if x < first_asked {
                right
            } else if x >= last_asked {
                left
            } else {
                left.max(right)
            };
            self.floors[x] = floor as f32 * scale;
            self.rises[x] = middle.wrapping_sub(floor) as f32 * scale;
        }
    }

    /// One ridge for each stretch of the row that rises enough: the middle of its upper half.
    fn collect(&mut self, index: u16, row: &Row, middle_column: f64, least: f32) {
        let rises = &self.rises;
        let mut x = 0;
        while x < rises.len() {
            if rises[x] < least {
                x += 1;
                continue;
            }
            let start = x;
            let mut peak = x;
            while x < rises.len() && rises[x] >= least {
                if rises[x] > rises[peak] {
                    peak = x;
                }
                x += 1;
            }
            let limit = rises[peak] / 2.0;
            let (mut weight, mut moment) = (0.0, 0.0);
            for (column, rise) in rises[start..x].iter().enumerate().map(|(i, rise)| (start + i, *rise)) {
                let share = (rise - limit).max(0.0);
                weight += share;
                moment += share * (column - start) as f32;
            }
            let column = start as f64 + f64::from(moment / weight);
            self.ridges.push(Ridge {
                ahead_m: row.ahead_m,
                left_m: (middle_column - column) * row.metres_per_px,
                row: index,
                strength: rises[peak] / (self.floors[peak] + DARKEST_FLOOR),
            });
        }
    }

    fn keep_strongest_of_row(&mut self, from: usize) {
        let row = &mut self.ridges[from..];
        row.sort_unstable_by(|a, b| b.strength.total_cmp(&a.strength));
        if let Some(strongest) = row.first() {
            self.strongest.push(strongest.strength);
        }
        self.ridges.truncate(from + MAX_PER_ROW);
    }

    /// Leaves out what is weak beside the lines of this image: the median of the rows' strongest ridges says how strong lines are.
    fn keep_strong(&mut self) {
        if self.strongest.is_empty() {
            return;
        }
        let middle = self.strongest.len() / 2;
        let (_, median, _) = self.strongest.select_nth_unstable_by(middle, f32::total_cmp);
        let limit = *median * SHARE_OF_STRONG;
        self.ridges.retain(|ridge| ridge.strength >= limit);
    }
}
