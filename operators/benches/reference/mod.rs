//! The lane detector as one would write it with OpenCV: the whole image to grey, the whole image thresholded, moments of two rows.
//! The yardstick of the benchmark, and a second opinion for the tests.

use carril_messages::{Encoding, Image};
use opencv::core::{Mat, Range, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;

/// Memory that is used again and again, so that the comparison is fair.
#[derive(Default)]
pub struct Reference {
    grey: Mat,
    binary: Mat,
}

impl Reference {
    /// Angle, rad, and distance, px, in the car's pixel frame; `None` when a row has no marking. Takes bgr8 images.
    pub fn detect(&mut self, image: &Image, threshold: f64, row_far: f64, row_near: f64) -> Option<(f64, f64)> {
        assert_eq!(image.encoding(), Encoding::Bgr8, "the yardstick takes bgr8 only");
        let (width, height) = (image.width() as i32, image.height() as i32);
        let frame = Mat::new_rows_cols_with_bytes::<Vec3b>(height, width, image.pixels()).expect("a packed image");
        imgproc::cvt_color_def(&frame, &mut self.grey, imgproc::COLOR_BGR2GRAY).expect("bgr to grey");
        imgproc::threshold(&self.grey, &mut self.binary, threshold, 255.0, imgproc::THRESH_BINARY).expect("8 bits");
        let (far_left, far_ahead) = self.centroid((f64::from(height) * row_far) as i32)?;
        let (near_left, near_ahead) = self.centroid((f64::from(height) * row_near) as i32)?;
        let angle = ((far_left - near_left) / (far_ahead - near_ahead)).atan();
        Some((angle, (far_left - angle.tan() * far_ahead) * angle.cos()))
    }

    fn centroid(&self, row: i32) -> Option<(f64, f64)> {
        let rows = Range::new(row, row + 1).expect("one row");
        let band = Mat::rowscols_def(&self.binary, &rows).expect("a row of the image");
        let moments = imgproc::moments(&band, true).expect("a binary image");
        let left = f64::from(self.binary.cols() - 1) / 2.0 - moments.m10 / moments.m00;
        (moments.m00 > 0.0).then_some((left, f64::from(self.binary.rows() - 1 - row)))
    }
}
