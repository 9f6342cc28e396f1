//! The operator `sim-rplidar`: the device at the end of a line, which sees what a scan of the simulated world shows.

use std::time::Duration;

use carril_messages::{LaserScan, Stamp};
use carril_runtime::{
    Context, Findings, NoOutputs, Operator, OperatorConfig, Setup, SetupError, StateError, StepError,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::model::RplidarModel;
use crate::device_line::DeviceLine;
use crate::mcu_link::{is_line_name, line_name_rule};

/// Between two bursts of measurements.
const PERIOD: Duration = Duration::from_millis(5);

/// Configuration of [`SimRplidar`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimRplidarConfig {
    /// Name of the line; the other end is `sim:NAME`.
    pub line: String,
}

impl Default for SimRplidarConfig {
    fn default() -> Self {
        Self { line: "lidar".to_owned() }
    }
}

impl OperatorConfig for SimRplidarConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.require(is_line_name(&self.line), "line", || line_name_rule(&self.line));
    }
}

carril_runtime::inputs! {
    /// What is around the device.
    pub struct SimRplidarInputs {
        /// The newest scan of the world, in the frame of the device.
        scan: LaserScan [hold],
    }
}

/// The device with the time of its last burst.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SimRplidarState {
    model: RplidarModel,
    turned: Option<Stamp>,
}

/// The simulated lidar.
pub struct SimRplidar {
    line: DeviceLine,
    state: SimRplidarState,
    reply: Vec<u8>,
}

impl Operator for SimRplidar {
    const KIND: &'static str = "sim-rplidar";
    const SUMMARY: &'static str = "Models an RPLIDAR on a serial line: requests, answers, measurements";
    const STAYS_ON_CAR: bool = true;
    type Config = SimRplidarConfig;
    type Inputs = SimRplidarInputs;
    type Outputs = NoOutputs;
    type State = SimRplidarState;

    fn new(config: SimRplidarConfig, setup: &Setup) -> Result<Self, SetupError> {
        let line = DeviceLine::open(&config.line, setup)?;
        let state = SimRplidarState { model: RplidarModel::default(), turned: None };
        Ok(Self { line, state, reply: Vec::new() })
    }

    fn step(
        &mut self,
        inputs: &mut SimRplidarInputs,
        _outputs: &mut NoOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let now = context.now();
        self.reply.clear();
        for (_, bytes) in self.line.take(now) {
            self.state.model.hear(&bytes, &mut self.reply);
        }
        let turned = self.state.turned.replace(now).unwrap_or(now);
        let scan = inputs.scan.latest();
        self.state.model.turn(now.since(turned).as_secs_f64(), scan.as_deref(), &mut self.reply);
        if !self.reply.is_empty() {
            self.line.write(&self.reply);
        }
        Ok(())
    }

    fn period(_config: &SimRplidarConfig) -> Option<Duration> {
        Some(PERIOD)
    }

    fn snapshot(&self) -> SimRplidarState {
        self.state.clone()
    }

    fn restore(&mut self, state: SimRplidarState) -> Result<(), StateError> {
        self.state = state;
        Ok(())
    }

    /// It holds its end of the line.
    fn exclusive(_config: &SimRplidarConfig) -> bool {
        true
    }
}
