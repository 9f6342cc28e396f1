//! The message types. Each field says unit, frame, range and what stands for "no data".

mod command;
mod control;
mod decision;
mod health;
mod image;
mod lane;
mod lidar;
mod light;
mod mcu;
mod vehicle;
mod wheel;

pub use command::{Command, Goal, Parking};
pub use control::Control;
pub use decision::{DecisionState, DriveState};
pub use health::{Health, InputHealth, NodeState, OutputHealth, Percentiles};
pub use image::{CompressedImage, Encoding, Image, MAX_IMAGE_BYTES};
pub use lane::{Centroid, GroundLane, Lane, LaneEstimate};
pub use lidar::{LaserScan, MAX_SCAN_POINTS, Sector, Sectors};
pub use light::{Lamp, LightColour, TrafficLight};
pub use mcu::{McuPins, McuSensors};
pub use vehicle::{Pose, TrackProgress, VehicleState};
pub use wheel::{Fault, FaultSet, WheelTelemetry};
