//! Small operators for tests: a world that shows something of everything, an eye that finds a lane, a brain that decides.

#![allow(dead_code, missing_docs, reason = "shared by several test programs, each of which uses a part")]

use std::time::Duration;

use carril_messages::{
    Centroid, DecisionState, DriveState, Encoding, Image, Lane, LaneEstimate, LaserScan, Payload, Pose, Sector,
    Sectors, VehicleState,
};
use carril_runtime::{
    Context, Findings, NoInputs, Operator, OperatorConfig, Registry, Setup, SetupError, StepError, inputs, outputs,
    stateless,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub fn registry() -> Registry {
    Registry::new().with::<World>().with::<Eye>()
}

#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct WorldConfig {
    /// Columns of the image.
    #[schemars(extend("unit" = "px"))]
    width: u32,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self { width: 64 }
    }
}

impl OperatorConfig for WorldConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("width", f64::from(self.width), 1.0, 4096.0, "px");
    }
}

outputs! {
    pub struct WorldOutputs {
        /// Grey, a bright column in the middle.
        camera: Image [on_demand],
        /// Nothing, ever: tests put their own images there.
        still: Image,
        /// A wall in front, nothing behind.
        scan: LaserScan,
        /// What the scan says.
        sectors: Sectors,
        /// Drives along x.
        vehicle: VehicleState,
        /// Changes its mind with each sample.
        state: DecisionState,
    }
}

/// Shows something of everything, 50 times a second.
pub struct World {
    config: WorldConfig,
    steps: u32,
}

impl Operator for World {
    const KIND: &'static str = "world";
    const SUMMARY: &'static str = "Shows something of everything";
    type Config = WorldConfig;
    type Inputs = NoInputs;
    type Outputs = WorldOutputs;

    fn new(config: WorldConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { config, steps: 0 })
    }

    fn period(_config: &WorldConfig) -> Option<Duration> {
        Some(Duration::from_millis(20))
    }

    fn step(&mut self, _: &mut NoInputs, outputs: &mut WorldOutputs, context: &Context<'_>) -> Result<(), StepError> {
        self.steps += 1;
        if outputs.camera.wanted() {
            let width = self.config.width;
            let row: Vec<u8> = (0..width).map(|x| if x == width / 2 { 255 } else { 40 }).collect();
            let image = Image::packed(width, 48, Encoding::Mono8, Payload::from(row.repeat(48)));
            outputs.camera.send(image.map_err(|error| StepError::new(error.to_string()))?);
        }
        outputs.scan.send(LaserScan {
            angle_min_rad: 0.0,
            angle_increment_rad: 1.0,
            scan_time_s: 0.02,
            range_min_m: 0.1,
            range_max_m: 8.0,
            ranges_m: vec![0.5, f32::INFINITY, f32::NAN, f32::NEG_INFINITY],
        });
        outputs.sectors.send(Sectors {
            sectors: vec![Sector {
                name: "front".into(),
                from_rad: -0.5,
                to_rad: 0.5,
                nearest_m: Some(0.5),
                nearest_bearing_rad: Some(0.0),
                returns_within: 1,
                occupied: true,
                coverage: 1.0,
            }],
        });
        let pose_in_map = Pose { x_m: f64::from(self.steps) * 0.01, y_m: 0.0, yaw_rad: 0.0 };
        outputs.vehicle.send(VehicleState { pose_in_map, speed_m_s: 0.5, yaw_rate_rad_s: 0.0, steering_rad: 0.0 });
        let state = if self.steps.is_multiple_of(2) { DriveState::LaneFollow } else { DriveState::ObstacleStop };
        outputs.state.send(DecisionState {
            state,
            since: context.now(),
            reason: "nearest 0.50 m".into(),
            target_speed_m_s: 0.5,
            steering_rad: 0.0,
            transitions: u64::from(self.steps),
        });
        Ok(())
    }

    stateless!();
}

#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EyeConfig {
    /// Divides marking from floor, 0 to 255.
    #[schemars(range(min = 0, max = 255), extend("unit" = ""))]
    threshold: f64,
    /// Rows of a band, 1 to 200.
    #[schemars(range(min = 1, max = 200), extend("unit" = "px"))]
    band_px: u32,
}

impl Default for EyeConfig {
    fn default() -> Self {
        Self { threshold: 190.0, band_px: 3 }
    }
}

impl OperatorConfig for EyeConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("threshold", self.threshold, 0.0, 255.0, "");
        findings.range("band_px", f64::from(self.band_px), 1.0, 200.0, "px");
    }
}

inputs! {
    pub struct EyeInputs {
        /// What it looks at.
        image: Image,
    }
}

outputs! {
    pub struct EyeOutputs {
        /// Straight ahead.
        lane: LaneEstimate,
    }
}

/// Finds a lane in the middle of each image. Its threshold shows in what it sends.
pub struct Eye(EyeConfig);

impl Operator for Eye {
    const KIND: &'static str = "eye";
    const SUMMARY: &'static str = "Finds a lane in the middle";
    type Config = EyeConfig;
    type Inputs = EyeInputs;
    type Outputs = EyeOutputs;

    fn new(config: EyeConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self(config))
    }

    fn step(&mut self, inputs: &mut EyeInputs, outputs: &mut EyeOutputs, _: &Context<'_>) -> Result<(), StepError> {
        if inputs.image.take().is_some() {
            let far = Centroid { left_px: 0.0, ahead_px: 30.0, pixels: 3 };
            let near = Centroid { left_px: 0.0, ahead_px: 10.0, pixels: 3 };
            let lane = Lane { angle_rad: 0.0, distance_px: 0.0, distance_m: None, ground: None, far, near };
            outputs.lane.send(LaneEstimate { lane: Some(lane), quality: 0.9, threshold: Some(self.0.threshold as u8) });
        }
        Ok(())
    }

    stateless!();
}
