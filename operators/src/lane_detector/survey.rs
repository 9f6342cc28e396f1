//! What grey values marking and floor have in the rows that the detector looks at, and which threshold divides them. For
//! calibration, not for driving: it looks at many frames at leisure. Pure.
//!
//! Markings are told from the floor by their surroundings, not by a threshold: a marking is a short run of pixels that stand out from the
//! median of their row near by. So both classes are known in any light, and whether one threshold can divide them is a question
//! that can be answered with no.

use std::ops::Range;

use carril_messages::Image;
use serde::Serialize;

use super::config::{LaneDetectorConfig, Marking};
use super::detect::band_rows;
use super::pixels;

/// Rows above and below a band that are looked at too: one part in so many of the height. The car pitches, and markings are a few
/// per cent of a row.
const NEIGHBOURHOOD: u32 = 60;
/// The floor near a pixel is that of a quarter of the width to each side. It must be most of it, also beside a slanting marking.
const WINDOW: usize = 4;
/// A run that is longer than this part of the width is no marking that is crossed, but glare or a line along the row.
const LONGEST_RUN: usize = 6;
/// A pixel stands out when it differs from the floor near by by so many grey values, and so many standard deviations of the floor.
const STANDS_OUT: (f64, f64) = (6.0, 5.0);
/// Pixels beside a run that belong to neither: lenses and scaling blur edges.
const BLURRED_PX: usize = 2;
/// Of a run only pixels with this share of its contrast count as marking; the rest is its edge.
const CORE: f64 = 0.6;
/// Runs with less than this share of the contrast that markings have are specks of the floor.
const SPECK: f64 = 0.5;
/// Markings have the contrast of the run below which this share of all pixels that stand out lies.
const CONTRAST_SHARE: f64 = 0.8;
/// On a floor that is darker than this, grey values are mostly noise of the camera.
const DARKEST_FLOOR: f64 = 16.0;
/// Least contrast of a marking against the floor near by, grey values.
const LEAST_CONTRAST: f64 = 12.0;
/// So much of the floor lies on its side of a threshold, and so much of the marking on the other. Three pixels of a row of 640 are 0.5 %.
const FLOOR_SHARE: f64 = 0.995;
const MARKING_SHARE: f64 = 0.95;
/// Least distance between the two, grey values: with less, a cloud moves one over the other.
const LEAST_GAP: i32 = 10;
/// More frames say nothing new.
pub const MAX_FRAMES: usize = 300;

/// Counts of the 256 grey values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Greys(pub [u64; 256]);

/// What has been seen so far.
#[derive(Clone, Debug)]
pub struct Survey {
    config: LaneDetectorConfig,
    dark: bool,
    frames: Vec<Frame>,
}

/// The pixels of one frame.
#[derive(Clone, Debug)]
struct Frame {
    floor: Greys,
    runs: Vec<Run>,
    pixels: u64,
}

/// Pixels side by side that stand out.
#[derive(Clone, Debug)]
struct Run {
    greys: Vec<u8>,
    /// Of its middle against the floor near by, grey values.
    contrast: f64,
    /// The same as a multiple of the floor near by: light and shade change it little.
    relative: f64,
    /// How far each pixel stands out.
    rises: Vec<f64>,
}

/// What the grey values are, and what follows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Findings {
    /// Frames that were looked at.
    pub frames: usize,
    /// Frames in which there was marking.
    pub frames_with_marking: usize,
    /// Of the floor; `None`: there was no pixel of it.
    pub floor: Option<Class>,
    /// Of the marking; `None`: there was no pixel of it.
    pub marking: Option<Class>,
    /// Share of the pixels that belong to neither for sure: edges of markings, and what is too long for one.
    pub unclear_share: f64,
    /// What follows.
    pub verdict: Verdict,
    /// The counts of grey values, for pictures.
    #[serde(skip)]
    pub greys: [Greys; 2],
}

/// The grey values of floor or marking.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Class {
    /// Pixels.
    pub pixels: u64,
    /// Percentiles: 0.5, 5, 50, 95, 99.5 %.
    pub p0_5: u8,
    /// 5 %.
    pub p5: u8,
    /// 50 %.
    pub p50: u8,
    /// 95 %.
    pub p95: u8,
    /// 99.5 %.
    pub p99_5: u8,
}

/// What the grey values mean for a threshold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// This one divides marking and floor.
    Divided {
        /// For the detector's `threshold`.
        threshold: u8,
        /// Grey values between the two.
        gap: i32,
    },
    /// None does.
    Overlap {
        /// Grey values between the two; below 0: so far they reach into each other.
        gap: i32,
        /// Share of the frames in which, each by itself, a threshold would do.
        frames_divided: f64,
    },
    /// Nothing stands out from the floor, or hardly anything.
    NoMarking,
}

impl Survey {
    /// Of the rows of a detector. `Err`: its marking is told by colour, and no grey value divides anything.
    pub fn new(config: &LaneDetectorConfig) -> Result<Self, &'static str> {
        match config.marking {
            Marking::Hsv(_) => {
                Err("the marking is told by its colour (`marking: { hsv: .. }`), for which `threshold` means nothing")
            }
            Marking::Bright | Marking::Dark => {
                Ok(Self { dark: config.marking == Marking::Dark, config: config.clone(), frames: Vec::new() })
            }
        }
    }

    /// How many frames were looked at.
    pub fn frames(&self) -> usize {
        self.frames.len()
    }

    /// Looks at a frame. After [`MAX_FRAMES`] nothing happens.
    pub fn add(&mut self, image: &Image) {
        if self.frames.len() >= MAX_FRAMES || image.width() == 0 {
            return;
        }
        let mut frame = Frame { floor: Greys([0; 256]), runs: Vec::new(), pixels: 0 };
        let mut grey = vec![0; image.width() as usize];
        for y in rows(image.height(), &self.config) {
            pixels::grey_row(image.encoding(), image.row(y), &mut grey);
            frame.add_row(&grey, self.dark);
        }
        self.frames.push(frame);
    }

    /// What follows from all frames.
    pub fn findings(&self) -> Findings {
        let contrast = contrast_of_markings(self.frames.iter().flat_map(|frame| &frame.runs));
        let each: Vec<[Greys; 2]> = self.frames.iter().map(|frame| frame.divided(contrast)).collect();
        let [mut floor, mut marking] = [Greys([0; 256]), Greys([0; 256])];
        for [one_floor, one_marking] in &each {
            floor.merge(one_floor);
            marking.merge(one_marking);
        }
        let least = u64::from(self.config.min_pixels);
        let frames_with_marking = each.iter().filter(|[_, marking]| marking.total() >= least).count();
        let pixels: u64 = self.frames.iter().map(|frame| frame.pixels).sum();
        let known = floor.total() + marking.total();
        Findings {
            frames: self.frames.len(),
            frames_with_marking,
            floor: floor.class(),
            marking: marking.class(),
            unclear_share: if pixels == 0 { 0.0 } else { 1.0 - known as f64 / pixels as f64 },
            verdict: self.verdict([&floor, &marking], &each),
            greys: [floor, marking],
        }
    }

    fn verdict(&self, [floor, marking]: [&Greys; 2], each: &[[Greys; 2]]) -> Verdict {
        let least = u64::from(self.config.min_pixels) * self.frames.len().max(1) as u64;
        let Some((low, high)) = edges(floor, marking, self.dark).filter(|_| marking.total() >= least) else {
            return Verdict::NoMarking;
        };
        let gap = high - low;
        if gap >= LEAST_GAP {
            // Bright is what is above the threshold, dark what is not: the middle serves both.
            return Verdict::Divided { threshold: i32::midpoint(low, high) as u8, gap };
        }
        let with_marking = each.iter().filter_map(|[floor, marking]| edges(floor, marking, self.dark));
        let gaps: Vec<i32> = with_marking.map(|(low, high)| high - low).collect();
        let divided = gaps.iter().filter(|gap| **gap >= LEAST_GAP).count();
        Verdict::Overlap { gap, frames_divided: divided as f64 / gaps.len().max(1) as f64 }
    }
}

/// The rows of both bands and some above and below.
fn rows(height: u32, config: &LaneDetectorConfig) -> impl Iterator<Item = u32> + use<> {
    let around = |band: Range<u32>| {
        let more = height / NEIGHBOURHOOD;
        band.start.saturating_sub(more)..band.end.saturating_add(more).min(height)
    };
    let far = around(band_rows(height, config.row_far, config.band_px));
    let near = around(band_rows(height, config.row_near, config.band_px));
    let near = near.start.max(far.end)..near.end;
    far.chain(near)
}

/// Where the class below the gap ends and the one above begins.
fn edges(floor: &Greys, marking: &Greys, dark: bool) -> Option<(i32, i32)> {
    let (floor_end, marking_end) =
        if dark { (1.0 - FLOOR_SHARE, MARKING_SHARE) } else { (FLOOR_SHARE, 1.0 - MARKING_SHARE) };
    let (floor, marking) = (i32::from(floor.percentile(floor_end)?), i32::from(marking.percentile(marking_end)?));
    Some(if dark { (marking, floor) } else { (floor, marking) })
}

/// How much markings stand out, as a multiple of the floor. 0: nothing does.
fn contrast_of_markings<'a>(runs: impl Iterator<Item = &'a Run>) -> f64 {
    let mut runs: Vec<(f64, usize)> = runs.map(|run| (run.relative, run.greys.len())).collect();
    runs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let wanted = runs.iter().map(|(_, pixels)| *pixels).sum::<usize>() as f64 * CONTRAST_SHARE;
    let mut seen = 0.0;
    for (relative, pixels) in runs {
        seen += pixels as f64;
        if seen >= wanted {
            return relative;
        }
    }
    0.0
}

impl Frame {
    fn add_row(&mut self, grey: &[u8], dark: bool) {
        self.pixels += grey.len() as u64;
        let floor = floor_near_by(grey);
        let rises: Vec<f64> = grey.iter().zip(&floor).map(|(grey, floor)| rise(*grey, *floor, dark)).collect();
        let limit = STANDS_OUT.0.max(STANDS_OUT.1 * spread(&rises));
        let runs = runs(&rises, limit);
        let mut known = 0;
        for run in runs {
            let begin = run.start.saturating_sub(BLURRED_PX).max(known);
            self.floor.count(&grey[known..begin]);
            known = (run.end + BLURRED_PX).min(grey.len());
            // What is longer is glare or a line along the row, and counts as neither.
            if run.len() <= grey.len() / LONGEST_RUN {
                self.runs.push(Run::of(&grey[run.clone()], &rises[run.clone()], &floor[run]));
            }
        }
        self.floor.count(&grey[known..]);
    }

    /// Floor and marking, when markings stand out this much.
    fn divided(&self, contrast: f64) -> [Greys; 2] {
        let (mut floor, mut marking) = (self.floor.clone(), Greys([0; 256]));
        for run in &self.runs {
            if run.relative < SPECK * contrast || run.contrast < LEAST_CONTRAST {
                floor.count(&run.greys);
            } else {
                let core = run.greys.iter().zip(&run.rises).filter(|(_, rise)| **rise >= CORE * run.contrast);
                core.for_each(|(grey, _)| marking.0[usize::from(*grey)] += 1);
            }
        }
        [floor, marking]
    }
}

impl Run {
    fn of(greys: &[u8], rises: &[f64], floor: &[u8]) -> Self {
        let mut sorted = rises.to_vec();
        sorted.sort_by(f64::total_cmp);
        // Not the highest: that may be noise.
        let contrast = sorted[sorted.len() * 3 / 4];
        let near = f64::from(floor[floor.len() / 2]);
        Self { greys: greys.to_vec(), contrast, relative: contrast / near.max(DARKEST_FLOOR), rises: rises.to_vec() }
    }
}

/// How far a pixel stands out.
fn rise(grey: u8, floor: u8, dark: bool) -> f64 {
    let rise = f64::from(grey) - f64::from(floor);
    if dark { -rise } else { rise }
}

/// The median of the row around each pixel.
fn floor_near_by(grey: &[u8]) -> Vec<u8> {
    let half = (grey.len() / WINDOW).max(1);
    let mut window = Greys([0; 256]);
    let mut floor = Vec::with_capacity(grey.len());
    let mut held = 0..0;
    for x in 0..grey.len() {
        let wanted = x.saturating_sub(half)..(x + half + 1).min(grey.len());
        window.count(&grey[held.end..wanted.end]);
        for gone in &grey[held.start..wanted.start] {
            window.0[usize::from(*gone)] -= 1;
        }
        held = wanted;
        floor.push(window.percentile(0.5).unwrap_or_default());
    }
    floor
}

/// The standard deviation of most values around 0, from their median: those that stand out do not count.
fn spread(rises: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = rises.iter().map(|rise| rise.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    // The median of the size of a normal variable is 0.6745 of its standard deviation.
    sizes.get(sizes.len() / 2).map_or(0.0, |median| median / 0.6745)
}

/// Where pixels side by side stand out by more than `limit`; one alone is noise.
fn runs(rises: &[f64], limit: f64) -> Vec<Range<usize>> {
    let mut runs = Vec::new();
    let mut begin = None;
    for x in 0..=rises.len() {
        let out = rises.get(x).is_some_and(|rise| *rise > limit);
        match (begin, out) {
            (None, true) => begin = Some(x),
            (Some(start), false) => {
                begin = None;
                if x - start > 1 {
                    runs.push(start..x);
                }
            }
            _ => {}
        }
    }
    runs
}

impl Greys {
    fn count(&mut self, greys: &[u8]) {
        for grey in greys {
            self.0[usize::from(*grey)] += 1;
        }
    }

    fn merge(&mut self, other: &Self) {
        self.0.iter_mut().zip(&other.0).for_each(|(own, other)| *own += other);
    }

    /// How many values.
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// Share of the values above `threshold`. `None`: there are none.
    pub fn share_above(&self, threshold: u8) -> Option<f64> {
        let above: u64 = self.0[usize::from(threshold) + 1..].iter().sum();
        let total = self.total();
        (total > 0).then(|| above as f64 / total as f64)
    }

    /// The value that this share does not exceed. `None`: there are no values.
    fn percentile(&self, share: f64) -> Option<u8> {
        let wanted = ((self.total() as f64 * share).ceil() as u64).max(1);
        let mut seen = 0;
        let found = self.0.iter().position(|count| {
            seen += count;
            seen >= wanted
        });
        found.map(|grey| grey as u8)
    }

    fn class(&self) -> Option<Class> {
        let at = |share| self.percentile(share);
        let (p0_5, p5, p50) = (at(0.005)?, at(0.05)?, at(0.5)?);
        Some(Class { pixels: self.total(), p0_5, p5, p50, p95: at(0.95)?, p99_5: at(0.995)? })
    }
}

#[cfg(test)]
mod tests;
