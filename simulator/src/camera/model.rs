//! The pinhole camera: where a point of the world appears in the image, and which point of the floor a pixel shows.

use nalgebra::{Point2, Point3};

/// A pinhole on the car, looking forward and down. Pixel coordinates count from the middle of the upper left pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraModel {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Focal length, px.
    pub focal_px: f64,
    /// Above the floor, m.
    pub height_m: f64,
    /// Ahead of the rear axle, m.
    pub forward_m: f64,
    sin_pitch: f64,
    cos_pitch: f64,
}

/// What a row of the image shows of the floor: a line across the car's direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundRow {
    /// Of the line, body frame: ahead of the rear axle, m.
    pub ahead_m: f64,
    /// On the line, from one column to the next, m.
    pub metres_per_px: f64,
}

impl CameraModel {
    /// A camera of `width` x `height` pixels with a horizontal field of view, looking down by `pitch_rad`.
    pub fn new(width: usize, height: usize, fov_rad: f64, pitch_rad: f64, height_m: f64, forward_m: f64) -> Self {
        let focal_px = width as f64 / 2.0 / (fov_rad / 2.0).tan();
        let (sin_pitch, cos_pitch) = pitch_rad.sin_cos();
        Self { width, height, focal_px, height_m, forward_m, sin_pitch, cos_pitch }
    }

    /// The column in the middle.
    pub fn middle_column(&self) -> f64 {
        (self.width as f64 - 1.0) / 2.0
    }

    fn middle_row(&self) -> f64 {
        (self.height as f64 - 1.0) / 2.0
    }

    /// What row `row` shows of the floor; `None` at and above the horizon.
    pub fn ground_row(&self, row: f64) -> Option<GroundRow> {
        let down = (row - self.middle_row()) / self.focal_px;
        let drop_per_depth = self.sin_pitch + down * self.cos_pitch;
        if drop_per_depth < 1e-6 {
            return None;
        }
        let depth_m = self.height_m / drop_per_depth;
        let ahead_m = self.forward_m + depth_m * (self.cos_pitch - down * self.sin_pitch);
        Some(GroundRow { ahead_m, metres_per_px: depth_m / self.focal_px })
    }

    /// The point of the floor that a pixel shows, body frame, m.
    pub fn ground_point(&self, column: f64, row: f64) -> Option<Point2<f64>> {
        let ground = self.ground_row(row)?;
        Some(Point2::new(ground.ahead_m, (self.middle_column() - column) * ground.metres_per_px))
    }

    /// From the body frame to the camera's own: x right, y down, z along its axis, m.
    pub fn from_body(&self, point: Point3<f64>) -> Point3<f64> {
        let (forward, down) = (point.x - self.forward_m, self.height_m - point.z);
        let depth_m = forward * self.cos_pitch + down * self.sin_pitch;
        Point3::new(-point.y, down * self.cos_pitch - forward * self.sin_pitch, depth_m)
    }

    /// The column and row at which a point of the camera's frame appears; only for z > 0.
    pub fn project(&self, point: Point3<f64>) -> Point2<f64> {
        let scale = self.focal_px / point.z;
        Point2::new(self.middle_column() + point.x * scale, self.middle_row() + point.y * scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> CameraModel {
        CameraModel::new(640, 480, 110_f64.to_radians(), 22_f64.to_radians(), 0.30, 0.10)
    }

    #[test]
    fn a_known_point_appears_where_trigonometry_says() {
        // On the axis: the camera looks down by 22 degrees from 0.30 m, so it sees the floor 0.30 / tan(22 deg) ahead of itself.
        let ahead_m = 0.10 + 0.30 / 22_f64.to_radians().tan();
        let pixel = camera().project(camera().from_body(Point3::new(ahead_m, 0.0, 0.0)));
        assert!((pixel - Point2::new(319.5, 239.5)).norm() < 1e-9, "the middle of the image, got {pixel}");
        // At the edge of the field of view of 110 degrees: as far to the left as tan(55 deg) times the distance along the axis.
        let left_m = 0.30 / 22_f64.to_radians().sin() * 55_f64.to_radians().tan();
        let pixel = camera().project(camera().from_body(Point3::new(ahead_m, left_m, 0.0)));
        assert!((pixel - Point2::new(-0.5, 239.5)).norm() < 1e-9, "the left edge, got {pixel}");
    }

    #[test]
    fn pixels_and_floor_agree_both_ways() {
        for (column, row) in [(0.0, 479.0), (100.0, 360.0), (319.5, 408.0), (639.0, 200.0)] {
            let floor = camera().ground_point(column, row).expect("below the horizon");
            let pixel = camera().project(camera().from_body(Point3::new(floor.x, floor.y, 0.0)));
            assert!((pixel - Point2::new(column, row)).norm() < 1e-6, "({column}, {row}) came back as {pixel}");
        }
        assert_eq!(camera().ground_point(320.0, 100.0), None, "the horizon lies at row 149");
    }
}
