//! Which point of the floor a pixel shows: a pinhole camera above a plane. The rows that are searched are chosen so that they lie
//! evenly on the floor: the distance counts, not the perspective.

use super::config::CameraPose;

/// Between two rows that are searched, as a share of the lane's width, at least.
const ROW_STEP: f64 = 0.05;
/// And at most so many rows.
const MAX_ROWS: usize = 64;

/// The camera above the floor, for images of one size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Floor {
    width: u32,
    height: u32,
    pose: CameraPose,
    focal_px: f64,
    sin_pitch: f64,
    cos_pitch: f64,
}

/// A row of the image, as a line across the car's direction on the floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Row {
    pub y: u32,
    /// Ahead of the rear axle, m.
    pub ahead_m: f64,
    /// From one column to the next, m.
    pub metres_per_px: f64,
}

impl Floor {
    pub fn new(width: u32, height: u32, pose: CameraPose) -> Self {
        let focal_px = f64::from(width) / 2.0 / (pose.horizontal_fov_deg.to_radians() / 2.0).tan();
        let (sin_pitch, cos_pitch) = pose.pitch_deg.to_radians().sin_cos();
        Self { width, height, pose, focal_px, sin_pitch, cos_pitch }
    }

    /// Whether it is that of such images.
    pub fn fits(&self, width: u32, height: u32) -> bool {
        (self.width, self.height) == (width, height)
    }

    pub fn middle_column(&self) -> f64 {
        (f64::from(self.width) - 1.0) / 2.0
    }

    /// Focal length, px.
    pub fn focal_px(&self) -> f64 {
        self.focal_px
    }

    /// Rows from the bottom one up to the middle.
    pub fn middle_up(&self) -> f64 {
        self.middle_row()
    }

    fn middle_row(&self) -> f64 {
        (f64::from(self.height) - 1.0) / 2.0
    }

    /// What a row shows of the floor; `None` at and above the horizon.
    pub fn row(&self, y: u32) -> Option<Row> {
        let down = (f64::from(y) - self.middle_row()) / self.focal_px;
        let drop_per_depth = self.sin_pitch + down * self.cos_pitch;
        if drop_per_depth < 1e-3 {
            return None;
        }
        let depth_m = self.pose.height_m / drop_per_depth;
        let ahead_m = self.pose.forward_m + depth_m * (self.cos_pitch - down * self.sin_pitch);
        Some(Row { y, ahead_m, metres_per_px: depth_m / self.focal_px })
    }

    /// The column and row at which a point of the floor appears; `None` when it lies behind the camera.
    pub fn pixel(&self, [ahead_m, left_m]: [f64; 2]) -> Option<(f64, f64)> {
        let forward = ahead_m - self.pose.forward_m;
        let depth = forward * self.cos_pitch + self.pose.height_m * self.sin_pitch;
        if depth < 1e-3 {
            return None;
        }
        let down = self.pose.height_m * self.cos_pitch - forward * self.sin_pitch;
        Some((self.middle_column() - left_m / depth * self.focal_px, self.middle_row() + down / depth * self.focal_px))
    }

    /// The rows to search, the nearest first.
    pub fn rows(&self, far_m: f64, lane_width_m: f64) -> Vec<Row> {
        let step_m = ROW_STEP * lane_width_m;
        let mut rows: Vec<Row> = Vec::new();
        for y in (0..self.height).rev() {
            let Some(row) = self.row(y).filter(|row| row.ahead_m <= far_m) else { break };
            if rows.last().is_none_or(|last| row.ahead_m - last.ahead_m >= step_m) {
                rows.push(row);
            }
        }
        if rows.len() > MAX_ROWS {
            let count = rows.len();
            rows = (0..MAX_ROWS).map(|index| rows[index * (count - 1) / (MAX_ROWS - 1)]).collect();
        }
        rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_and_floor_agree_both_ways() {
        let floor = Floor::new(640, 480, CameraPose::default());
        for (column, y) in [(0.0, 479), (100.0, 360), (639.0, 200)] {
            let row = floor.row(y).expect("below the horizon");
            let left_m = (floor.middle_column() - column) * row.metres_per_px;
            let (back_column, back_row) = floor.pixel([row.ahead_m, left_m]).expect("before the camera");
            assert!((back_column - column).abs() < 1e-6 && (back_row - f64::from(y)).abs() < 1e-6, "row {y}");
        }
        assert_eq!(floor.row(100), None, "the horizon of the default camera lies at row 149");
        assert_eq!(floor.pixel([-1.0, 0.0]), None, "behind the camera");
    }

    #[test]
    fn rows_lie_evenly_on_the_floor_and_are_few() {
        for (width, height, far_m) in [(640, 480, 1.3), (320, 240, 1.3), (640, 480, 10.0), (1920, 1080, 3.0)] {
            let rows = Floor::new(width, height, CameraPose::default()).rows(far_m, 0.4);
            assert!((8..=MAX_ROWS).contains(&rows.len()), "{width}x{height}: {} rows", rows.len());
            assert!(
                rows.windows(2).all(|pair| pair[1].ahead_m - pair[0].ahead_m >= ROW_STEP * 0.4),
                "{width}x{height}"
            );
            assert!(rows.iter().all(|row| row.ahead_m <= far_m), "none beyond {far_m} m");
        }
        assert_eq!(Floor::new(1, 1, CameraPose::default()).rows(1.3, 0.4).len(), 1, "the smallest image");
    }
}
