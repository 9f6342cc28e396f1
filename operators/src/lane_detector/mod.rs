//! Operator `lane-detector`: where the lane lies in an image. Keeps no state: each image is judged on its own.

mod config;
mod debug;
mod detect;
mod otsu;
pub(crate) mod pixels;
pub mod survey;

use carril_messages::{Image, LaneEstimate};
use carril_runtime::{Context, NoState, Operator, Setup, SetupError, StateError, StepError};

pub use config::{HsvRange, LaneDetectorConfig, Marking, Threshold};
pub use detect::{Scratch, detect};

carril_runtime::inputs! {
    /// What the lane detector reads.
    pub struct LaneDetectorInputs {
        /// Camera frames, any size and encoding.
        image: Image,
    }
}

carril_runtime::outputs! {
    /// What the lane detector gives.
    pub struct LaneDetectorOutputs {
        /// The lane, one estimate per frame; "no lane" is an estimate too.
        lane: LaneEstimate,
        /// What the detector sees: marking, bands, centroids. Made only while somebody watches.
        debug: Image [on_demand],
    }
}

/// Finds the lane by the centroids of its markings in two bands of the image.
pub struct LaneDetector {
    config: LaneDetectorConfig,
    scratch: Scratch,
}

impl Operator for LaneDetector {
    const KIND: &'static str = "lane-detector";
    const SUMMARY: &'static str = "where the lane lies: centroids of its markings in two bands of the image";

    type Config = LaneDetectorConfig;
    type Inputs = LaneDetectorInputs;
    type Outputs = LaneDetectorOutputs;

    fn new(config: LaneDetectorConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { config, scratch: Scratch::default() })
    }

    fn step(
        &mut self,
        inputs: &mut LaneDetectorInputs,
        outputs: &mut LaneDetectorOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(image) = inputs.image.take() {
            let estimate = detect(&image, &self.config, &mut self.scratch);
            if outputs.debug.wanted() {
                let view = debug::draw(&image, &self.config, &estimate, context);
                outputs.debug.send(view.map_err(StepError::new)?);
            }
            outputs.lane.send(estimate);
        }
        Ok(())
    }

    carril_runtime::stateless!();

    /// What `lane-lines` remembers is of no use here.
    fn migrate(version: u32, _state: &[u8]) -> Result<NoState, StateError> {
        if version == crate::lane_lines::LaneLines::STATE_VERSION {
            return Ok(NoState);
        }
        Err(StateError::new(format!(
            "the state has version {version}, `lane-detector` takes 1, and 101 of `lane-lines`"
        )))
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Encoding, Payload};
    use carril_runtime::Trigger;

    use super::*;
    use crate::testing::{at_ms, context, header};

    #[test]
    fn answers_each_frame_and_draws_only_when_watched() {
        let setup = Setup::for_tests("lane");
        let mut detector = LaneDetector::new(LaneDetectorConfig::default(), &setup).expect("the defaults do");
        let (mut inputs, mut outputs) = (LaneDetectorInputs::default(), LaneDetectorOutputs::default());
        let image = Image::packed(8, 40, Encoding::Mono8, Payload::from(vec![9; 320])).expect("the size fits");
        for watched in [false, true] {
            outputs.debug.set_wanted(watched);
            inputs.image.put(image.clone(), header::<Image>(at_ms(5)));
            detector.step(&mut inputs, &mut outputs, &context(at_ms(6), Trigger::Input)).expect("a step");
            assert_eq!(outputs.lane.sent().len(), 1, "one estimate per frame");
            assert_eq!(outputs.debug.sent().len(), usize::from(watched), "watched: {watched}");
        }
        detector.step(&mut inputs, &mut outputs, &context(at_ms(7), Trigger::Control)).expect("a step");
        assert!(outputs.lane.sent().is_empty(), "no frame, no estimate");
    }
}
