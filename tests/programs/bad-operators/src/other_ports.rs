//! `other-ports`: cannot take the place of a lane detector.

use carril_messages::{LaneEstimate, LaserScan};
use carril_runtime::{Context, Operator, Setup, SetupError, StepError};

use crate::bad_lane::BadLaneConfig;

carril_runtime::inputs! {
    /// What it reads.
    pub struct OtherInputs {
        /// Another type under the name of the lane detector's input.
        image: LaserScan,
    }
}

carril_runtime::outputs! {
    /// What it gives.
    pub struct OtherOutputs {
        /// The right type under another name.
        lanes: LaneEstimate,
    }
}

/// Reads and says nothing.
pub struct OtherPorts;

impl Operator for OtherPorts {
    const KIND: &'static str = "other-ports";
    const SUMMARY: &'static str = "has ports that fit nowhere";

    type Config = BadLaneConfig;
    type Inputs = OtherInputs;
    type Outputs = OtherOutputs;

    fn new(_config: BadLaneConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(
        &mut self,
        inputs: &mut OtherInputs,
        _outputs: &mut OtherOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        while inputs.image.take().is_some() {}
        Ok(())
    }

    carril_runtime::stateless!();
}
