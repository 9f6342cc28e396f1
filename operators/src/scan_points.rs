//! A scan as points on the floor plan, in the body frame: where the lidar sits, and which returns are the car itself.

use carril_messages::{LaserScan, car};
use carril_runtime::Findings;
use nalgebra::{Rotation2, Vector2};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The car's outline, and where its lidar sits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct BodyConfig {
    /// Front end, ahead of the rear axle, m, 0 to 5.
    #[schemars(range(min = 0, max = 5), extend("unit" = "m"))]
    pub front_m: f64,
    /// Rear end, ahead of the rear axle, m, -5 to 0.
    #[schemars(range(min = -5, max = 0), extend("unit" = "m"))]
    pub rear_m: f64,
    /// m, 0.02 to 3.
    #[schemars(range(min = 0.02, max = 3), extend("unit" = "m"))]
    pub width_m: f64,
    /// The lidar's middle, ahead of the rear axle, m, -5 to 5.
    #[schemars(range(min = -5, max = 5), extend("unit" = "m"))]
    pub lidar_forward_m: f64,
    /// The lidar's middle, to the left of the car's, m, -2 to 2.
    #[schemars(range(min = -2, max = 2), extend("unit" = "m"))]
    pub lidar_left_m: f64,
    /// Direction of the lidar's x axis, degrees, + counter-clockwise, -360 to 360. 180: mounted backwards.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub lidar_mounting_deg: f64,
}

impl Default for BodyConfig {
    fn default() -> Self {
        Self {
            front_m: car::BODY_FRONT_M,
            rear_m: car::BODY_REAR_M,
            width_m: car::BODY_WIDTH_M,
            lidar_forward_m: car::LIDAR_FORWARD_M,
            lidar_left_m: 0.0,
            lidar_mounting_deg: 0.0,
        }
    }
}

impl BodyConfig {
    /// Checks it as the value of a key.
    pub(crate) fn check_at(&self, key: &str, findings: &mut Findings<'_>) {
        for (name, value, min, max, unit) in [
            ("front_m", self.front_m, 0.0, 5.0, "m"),
            ("rear_m", self.rear_m, -5.0, 0.0, "m"),
            ("width_m", self.width_m, 0.02, 3.0, "m"),
            ("lidar_forward_m", self.lidar_forward_m, -5.0, 5.0, "m"),
            ("lidar_left_m", self.lidar_left_m, -2.0, 2.0, "m"),
            ("lidar_mounting_deg", self.lidar_mounting_deg, -360.0, 360.0, "degrees"),
        ] {
            findings.range(&format!("{key}.{name}"), value, min, max, unit);
        }
    }

    /// Where things were seen that are not the car itself, m ahead and left of the rear axle, in the order of the scan. At the moment of
    /// the scan.
    pub(crate) fn points(&self, scan: &LaserScan) -> Vec<Vector2<f64>> {
        let lidar = Vector2::new(self.lidar_forward_m, self.lidar_left_m);
        let mounting = Rotation2::new(self.lidar_mounting_deg.to_radians());
        let (first, step) = (f64::from(scan.angle_min_rad), f64::from(scan.angle_increment_rad));
        let points = scan.ranges_m.iter().enumerate().filter(|(_, range)| range.is_finite() && **range > 0.0);
        let points = points.map(|(index, range)| {
            let (sin, cos) = (first + step * index as f64).sin_cos();
            lidar + mounting * Vector2::new(cos, sin) * f64::from(*range)
        });
        points.filter(|point| point.iter().all(|number| number.is_finite()) && !self.holds(*point)).collect()
    }

    /// Whether a point lies within the outline.
    fn holds(&self, point: Vector2<f64>) -> bool {
        (self.rear_m..=self.front_m).contains(&point.x) && point.y.abs() <= self.width_m / 2.0
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_PI_2;

    use super::*;

    fn scan(ranges_m: Vec<f32>) -> LaserScan {
        LaserScan {
            angle_min_rad: -FRAC_PI_2,
            angle_increment_rad: FRAC_PI_2,
            scan_time_s: 0.1,
            range_min_m: 0.05,
            range_max_m: 16.0,
            ranges_m,
        }
    }

    #[test]
    fn points_lie_where_they_were_seen() {
        let points = BodyConfig::default().points(&scan(vec![0.5, 1.0, 0.4, 0.05]));
        let expected = [Vector2::new(0.18, -0.5), Vector2::new(1.18, 0.0), Vector2::new(0.18, 0.4)];
        assert_eq!(points.len(), 3, "the car itself is left out: {points:?}");
        assert!(points.iter().zip(expected).all(|(point, expected)| (point - expected).norm() < 1e-6), "{points:?}");
        let turned = BodyConfig { lidar_mounting_deg: 180.0, ..BodyConfig::default() };
        let points = turned.points(&scan(vec![0.5, 1.0]));
        assert!((points[0] - Vector2::new(0.18, 0.5)).norm() < 1e-6, "mounted backwards: {points:?}");
    }

    #[test]
    fn what_is_no_range_is_no_point() {
        let scan = scan(vec![f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 0.0, -1.0]);
        assert!(BodyConfig::default().points(&scan).is_empty(), "nothing was measured");
        let odd = LaserScan { angle_min_rad: f32::NAN, ranges_m: vec![1.0], ..scan };
        assert!(BodyConfig::default().points(&odd).is_empty(), "nobody knows where");
    }
}
