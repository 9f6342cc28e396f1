//! The operators of carril, one file each, and their registry. Pure: no Zenoh, no serial port, no wall clock.

pub mod lane_detector;
#[cfg(test)]
mod testing;

use carril_runtime::Registry;

/// Every operator of this crate.
pub fn registry() -> Registry {
    Registry::new().with::<lane_detector::LaneDetector>()
}
