//! Vehicle, world and sensors that take the place of the hardware: one operator, `sim-world`, on the same ports as a real car's
//! drivers and microcontroller. Deterministic: the same track, configuration and seed give the same bytes. docs/simulator.md says
//! what is modelled, and what is not.

pub mod camera;
pub mod centre_line;
pub mod config;
pub mod floor;
pub mod lane_sensor;
pub mod lidar;
mod noise;
pub mod obstacles;
mod picture;
pub mod referee;
mod schedule;
pub mod track;
pub mod traffic_light;
pub mod vehicle;
mod world;

pub use config::SimWorldConfig;
pub use world::{SimWorld, WorldInputs, WorldOutputs, WorldState};

/// The simulator's operators.
pub fn registry() -> carril_runtime::Registry {
    carril_runtime::Registry::new().with::<SimWorld>()
}
