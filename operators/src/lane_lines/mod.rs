//! Operator `lane-lines`: where the lane lies on the floor, from its lines. Same ports and messages as `lane-detector`, so that one
//! takes the other's place while the car drives; it needs to know how the camera looks at the floor, and remembers the lane.

mod config;
mod debug;
mod detect;
mod fit;
mod floor;
mod ridges;
pub mod survey;
#[cfg(test)]
mod tests;
mod track;

use carril_messages::{Image, LaneEstimate, WheelTelemetry};
use carril_runtime::{Context, Operator, Setup, SetupError, StateError, StepError};

pub use config::{CameraPose, LaneLinesConfig, Which};
pub use detect::{Detector, LaneMemory};

use crate::lane_detector::LaneDetector;
use crate::odometry::Wheels;
pub(crate) use floor::Floor;

carril_runtime::inputs! {
    /// What `lane-lines` reads.
    pub struct LaneLinesInputs {
        /// Camera frames, any size and encoding.
        image: Image,
        /// What the wheels do: carries the lane over gaps in its lines.
        wheels: WheelTelemetry [hold optional],
    }
}

carril_runtime::outputs! {
    /// What `lane-lines` gives.
    pub struct LaneLinesOutputs {
        /// The lane, one estimate per frame; "no lane" is an estimate too.
        lane: LaneEstimate,
        /// What the detector sees: pieces of lines, the lane. Made only while somebody watches.
        debug: Image [on_demand],
    }
}

/// Finds the lane by its lines on the floor.
pub struct LaneLines {
    detector: Detector,
}

impl Operator for LaneLines {
    const KIND: &'static str = "lane-lines";
    const SUMMARY: &'static str = "where the lane lies on the floor, from its lines: offset, heading, curvature";
    /// That of `lane-detector`, which keeps nothing: each can go on where the other stopped. Its versions stay below 100.
    const STATE_NAME: &'static str = LaneDetector::KIND;
    const STATE_VERSION: u32 = 101;

    type Config = LaneLinesConfig;
    type Inputs = LaneLinesInputs;
    type Outputs = LaneLinesOutputs;
    type State = LaneMemory;

    fn new(config: LaneLinesConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { detector: Detector::new(config) })
    }

    fn step(
        &mut self,
        inputs: &mut LaneLinesInputs,
        outputs: &mut LaneLinesOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(image) = inputs.image.take() {
            let captured = context.now() - image.age(context.now()).to_duration();
            let wheels = Wheels::newest(&mut inputs.wheels, context.now());
            let estimate = self.detector.detect(&image, captured, wheels);
            if outputs.debug.wanted() {
                let view = debug::draw(&image, &self.detector, &estimate, context);
                outputs.debug.send(view.map_err(StepError::new)?);
            }
            outputs.lane.send(estimate);
        }
        Ok(())
    }

    fn snapshot(&self) -> LaneMemory {
        self.detector.memory().clone()
    }

    fn restore(&mut self, memory: LaneMemory) -> Result<(), StateError> {
        self.detector.remember(memory).map_err(StateError::new)
    }

    fn migrate(version: u32, _state: &[u8]) -> Result<LaneMemory, StateError> {
        if version == LaneDetector::STATE_VERSION {
            return Ok(LaneMemory::default());
        }
        Err(StateError::new(format!(
            "the state has version {version}, `lane-lines` takes 101, and 1 of `lane-detector`"
        )))
    }
}
