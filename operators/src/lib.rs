//! The operators of carril, one file each, and their registry. Pure: no Zenoh, no serial port, no wall clock.

pub mod actuator;
pub mod camera;
pub mod decision;
pub mod lane_detector;
pub mod lane_lines;
pub mod lidar_sectors;
mod odometry;
pub mod scan_points;
#[cfg(test)]
mod testing;
pub mod traffic_light;

use carril_runtime::Registry;

/// Every operator of this crate.
pub fn registry() -> Registry {
    Registry::new()
        .with::<camera::Camera>()
        .with::<lane_detector::LaneDetector>()
        .with::<lane_lines::LaneLines>()
        .with::<lidar_sectors::LidarSectors>()
        .with::<traffic_light::TrafficLights>()
        .with::<decision::Decision>()
        .with::<actuator::Actuator>()
}
