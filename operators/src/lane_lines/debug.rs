//! The debug view: the image in grey, what may be a piece of a line, the lane's middle and its lines. Made only while somebody watches.

use carril_messages::{CodecError, Encoding, GroundLane, Image, LaneEstimate};
use carril_runtime::Context;

use super::detect::Detector;
use super::floor::Floor;
use crate::lane_detector::pixels;

const RIDGE: [u8; 3] = [80, 220, 60];
const LINE: [u8; 3] = [220, 200, 0];
const MIDDLE: [u8; 3] = [0, 220, 255];
/// Between two dots of a drawn line, m.
const DOT_STEP_M: f64 = 0.004;

/// The frame being drawn: bgr8, without padding.
struct Canvas<'a> {
    pixels: &'a mut [u8],
    width: u32,
    height: u32,
}

/// Draws what the detector saw in its last image. Has the size of the image, in bgr8.
pub(crate) fn draw(
    image: &Image,
    detector: &Detector,
    estimate: &LaneEstimate,
    context: &Context<'_>,
) -> Result<Image, CodecError> {
    let (width, height) = (image.width(), image.height());
    let len = width as usize * height as usize * 3;
    let mut buffer = context.buffer(len);
    let mut canvas = Canvas { pixels: &mut buffer[..len], width, height };
    canvas.paint_grey(image);
    if let Some(floor) = detector.floor() {
        let config = detector.config();
        if let Some(ground) = estimate.lane.and_then(|lane| lane.ground) {
            for line in config.lane.lines() {
                canvas.curve(floor, &ground, line * f64::from(ground.width_m), config.far_m, LINE);
            }
            canvas.curve(floor, &ground, 0.0, config.far_m, MIDDLE);
        }
        for ridge in detector.ridges() {
            canvas.cross(floor, [ridge.ahead_m, ridge.left_m], RIDGE);
        }
    }
    Image::packed(width, height, Encoding::Bgr8, buffer.freeze())
}

impl Canvas<'_> {
    fn paint_grey(&mut self, image: &Image) {
        let width = self.width as usize;
        let mut grey = vec![0; width];
        for (y, out) in (0..self.height).zip(self.pixels.chunks_exact_mut(width * 3)) {
            pixels::grey_row(image.encoding(), image.row(y), &mut grey);
            for (out, grey) in out.chunks_exact_mut(3).zip(&grey) {
                out.fill(*grey);
            }
        }
    }

    fn dot(&mut self, x: f64, y: f64, colour: [u8; 3]) {
        let (x, y) = (x.round(), y.round());
        if x >= 0.0 && y >= 0.0 && x < f64::from(self.width) && y < f64::from(self.height) {
            let start = (y as usize * self.width as usize + x as usize) * 3;
            self.pixels[start..start + 3].copy_from_slice(&colour);
        }
    }

    fn cross(&mut self, floor: &Floor, point: [f64; 2], colour: [u8; 3]) {
        if let Some((x, y)) = floor.pixel(point) {
            for offset in -2..=2 {
                self.dot(x + f64::from(offset), y, colour);
                self.dot(x, y + f64::from(offset), colour);
            }
        }
    }

    /// The curve `left_m` to the left of the lane's middle.
    fn curve(&mut self, floor: &Floor, ground: &GroundLane, left_m: f64, far_m: f64, colour: [u8; 3]) {
        for index in 0..(far_m / DOT_STEP_M) as u32 {
            let s = f64::from(index) * DOT_STEP_M;
            let [x, y] = ground.point_at(s);
            let [next_x, next_y] = ground.point_at(s + DOT_STEP_M);
            let (along_x, along_y) = ((next_x - x) / DOT_STEP_M, (next_y - y) / DOT_STEP_M);
            if let Some((x, y)) = floor.pixel([x - along_y * left_m, y + along_x * left_m]) {
                self.dot(x, y, colour);
            }
        }
    }
}
