//! The debug view: the image in grey, everything that counts as marking in green, the two bands, the centroids and the line.
//! Looks at every pixel, so it is made only while somebody watches.

use std::ops::Range;

use carril_messages::{Centroid, CodecError, Encoding, Image, LaneEstimate};
use carril_runtime::Context;

use super::config::{LaneDetectorConfig, Marking};
use super::detect::{Test, band_rows, grey_test};
use super::pixels;

const MARKING: [u8; 3] = [80, 220, 60];
const BAND: [u8; 3] = [220, 200, 0];
const CENTROID: [u8; 3] = [40, 40, 255];
const LINE: [u8; 3] = [0, 220, 255];

/// The frame being drawn: bgr8, without padding.
struct Canvas<'a> {
    pixels: &'a mut [u8],
    width: i64,
    height: i64,
}

/// Draws what the detector saw. Has the size of the image, in bgr8.
pub(crate) fn draw(
    image: &Image,
    config: &LaneDetectorConfig,
    estimate: &LaneEstimate,
    context: &Context<'_>,
) -> Result<Image, CodecError> {
    let (width, height) = (image.width(), image.height());
    let len = width as usize * height as usize * 3;
    let mut buffer = context.buffer(len);
    let mut canvas = Canvas { pixels: &mut buffer[..len], width: i64::from(width), height: i64::from(height) };
    paint_marking(image, config, estimate, &mut canvas);
    for row in [config.row_far, config.row_near] {
        canvas.frame_band(&band_rows(height, row, config.band_px));
    }
    if let Some(lane) = &estimate.lane {
        canvas.line(&lane.near, &lane.far);
        canvas.cross(&lane.far);
        canvas.cross(&lane.near);
    }
    Image::packed(width, height, Encoding::Bgr8, buffer.freeze())
}

fn paint_marking(image: &Image, config: &LaneDetectorConfig, estimate: &LaneEstimate, canvas: &mut Canvas<'_>) {
    let width = image.width() as usize;
    let (mut grey, mut mask) = (vec![0; width], vec![0; width]);
    let test = match (&config.marking, estimate.threshold) {
        (Marking::Hsv(_), _) | (_, None) => Test::Mask,
        (marking, Some(threshold)) => grey_test(marking, threshold),
    };
    for (y, out) in (0..image.height()).zip(canvas.pixels.chunks_exact_mut(width * 3)) {
        pixels::grey_row(image.encoding(), image.row(y), &mut grey);
        if let Marking::Hsv(range) = &config.marking {
            pixels::hsv_mask_row(image.encoding(), image.row(y), range, &mut mask);
        }
        for ((out, grey), mask) in out.chunks_exact_mut(3).zip(&grey).zip(&mask) {
            let marking = match test {
                Test::Above(limit) => *grey > limit,
                Test::UpTo(limit) => *grey <= limit,
                Test::Mask => *mask != 0,
            };
            out.copy_from_slice(&if marking { MARKING } else { [*grey; 3] });
        }
    }
}

impl Canvas<'_> {
    fn dot(&mut self, x: i64, y: i64, colour: [u8; 3]) {
        if (0..self.width).contains(&x) && (0..self.height).contains(&y) {
            let start = ((y * self.width + x) * 3) as usize;
            self.pixels[start..start + 3].copy_from_slice(&colour);
        }
    }

    /// Lines just above and just below the band, so that the pixels that count stay visible.
    fn frame_band(&mut self, rows: &Range<u32>) {
        for x in 0..self.width {
            self.dot(x, i64::from(rows.start) - 1, BAND);
            self.dot(x, i64::from(rows.end), BAND);
        }
    }

    /// Column and row of a point in the image.
    fn place(&self, point: &Centroid) -> (f64, f64) {
        ((self.width - 1) as f64 / 2.0 - f64::from(point.left_px), (self.height - 1) as f64 - f64::from(point.ahead_px))
    }

    fn cross(&mut self, at: &Centroid) {
        let (x, y) = self.place(at);
        for offset in -6..=6 {
            self.dot(x.round() as i64 + offset, y.round() as i64, CENTROID);
            self.dot(x.round() as i64, y.round() as i64 + offset, CENTROID);
        }
    }

    fn line(&mut self, from: &Centroid, to: &Centroid) {
        let ((x0, y0), (x1, y1)) = (self.place(from), self.place(to));
        let steps = (x1 - x0).abs().max((y1 - y0).abs()).ceil().max(1.0);
        for step in 0..=steps as i64 {
            let share = step as f64 / steps;
            self.dot((x0 + share * (x1 - x0)).round() as i64, (y0 + share * (y1 - y0)).round() as i64, LINE);
        }
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::Payload;
    use carril_runtime::Trigger;

    use super::super::detect::{Scratch, detect};
    use super::*;
    use crate::testing::{at_ms, context};

    #[test]
    fn shows_marking_bands_and_centroids() {
        let mut pixels = vec![50; 40 * 100];
        for row in pixels.chunks_exact_mut(40) {
            row[10..15].fill(240);
        }
        let image = Image::packed(40, 100, Encoding::Mono8, Payload::from(pixels)).expect("the size fits");
        let config = LaneDetectorConfig::default();
        let estimate = detect(&image, &config, &mut Scratch::default());
        let view = draw(&image, &config, &estimate, &context(at_ms(0), Trigger::Input)).expect("a valid image");
        let pixel = |x: usize, y: u32| &view.row(y)[x * 3..x * 3 + 3];
        assert_eq!((view.width(), view.height(), view.encoding()), (40, 100, Encoding::Bgr8), "size and encoding");
        assert_eq!(pixel(30, 50), [50; 3], "floor stays grey");
        assert_eq!(pixel(11, 20), MARKING, "marking is green, outside the bands too");
        assert_eq!(pixel(30, 74), BAND, "above the far band");
        assert_eq!(pixel(12, 75), CENTROID, "the far centroid");
        assert_eq!(pixel(12, 85), CENTROID, "the near centroid");
    }

    #[test]
    fn draws_on_the_smallest_image() {
        let image = Image::packed(1, 1, Encoding::Rgb8, Payload::from(vec![255; 3])).expect("the size fits");
        let config = LaneDetectorConfig::default();
        let estimate = detect(&image, &config, &mut Scratch::default());
        let view = draw(&image, &config, &estimate, &context(at_ms(0), Trigger::Input)).expect("a valid image");
        assert_eq!(view.pixels().len(), 3, "one pixel");
    }
}
