//! The operator `sim-mcu`: the model of the microcontroller at the end of a line. Live the line is a real pseudo-terminal, so
//! that every command crosses what a serial port crosses; in lockstep it is memory.

use std::time::Duration;

use carril_messages::{McuPins, McuSensors, Stamp, car};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StateError, StepError, Trigger};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::device_line::DeviceLine;
use crate::mcu_link::{is_line_name, line_name_rule};
use crate::mcu_model::McuModel;

/// Time between two looks of the model at its pins and its lease.
const PERIOD: Duration = Duration::from_millis(5);

/// Configuration of [`SimMcu`].
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimMcuConfig {
    /// Name of the line; the other end is `sim:NAME`.
    pub line: String,
    /// Below this voltage the car does not drive, V. 0 to 60.
    #[schemars(range(min = 0, max = 60), extend("unit" = "V"))]
    pub battery_low_v: f64,
}

impl Default for SimMcuConfig {
    fn default() -> Self {
        Self { line: "mcu".to_owned(), battery_low_v: car::BATTERY_LOW_V }
    }
}

impl OperatorConfig for SimMcuConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.require(is_line_name(&self.line), "line", || line_name_rule(&self.line));
        findings.range("battery_low_v", self.battery_low_v, 0.0, 60.0, "V");
    }
}

carril_runtime::inputs! {
    /// Inputs of [`SimMcu`].
    pub struct SimMcuInputs {
        /// What its input pins carry.
        sensors: McuSensors [hold],
    }
}

carril_runtime::outputs! {
    /// Outputs of [`SimMcu`].
    pub struct SimMcuOutputs {
        /// What its output pins carry, every 5 ms and whenever they change.
        pins: McuPins,
    }
}

/// All that the chip remembers. Its successor takes over in the middle of a lease.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SimMcuState {
    model: McuModel,
    started: Option<Stamp>,
    pins: Option<McuPins>,
}

/// The simulated microcontroller.
pub struct SimMcu {
    config: SimMcuConfig,
    line: DeviceLine,
    state: SimMcuState,
    reply: Vec<u8>,
}

impl Operator for SimMcu {
    const KIND: &'static str = "sim-mcu";
    const SUMMARY: &'static str = "Models the microcontroller on a serial line: lease, faults, speed control, servo";
    const STAYS_ON_CAR: bool = true;
    const STATE_VERSION: u32 = 3;
    type Config = SimMcuConfig;
    type Inputs = SimMcuInputs;
    type Outputs = SimMcuOutputs;
    type State = SimMcuState;

    fn new(config: SimMcuConfig, setup: &Setup) -> Result<Self, SetupError> {
        let line = DeviceLine::open(&config.line, setup)?;
        let model = McuModel::new(config.battery_low_v as f32);
        let state = SimMcuState { model, started: None, pins: None };
        Ok(Self { config, line, state, reply: Vec::new() })
    }

    fn step(
        &mut self,
        inputs: &mut SimMcuInputs,
        outputs: &mut SimMcuOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let now = context.now();
        let started = *self.state.started.get_or_insert(now);
        self.receive(now, started);
        let sensors = inputs.sensors.latest();
        let pins = self.state.model.step(chip_time_us(now, started), sensors.as_deref(), &mut self.reply);
        self.answer();
        if self.state.pins.replace(pins) != Some(pins) || context.trigger() == Trigger::Period {
            outputs.pins.send(pins);
        }
        Ok(())
    }

    fn period(_config: &SimMcuConfig) -> Option<Duration> {
        Some(PERIOD)
    }

    fn snapshot(&self) -> SimMcuState {
        self.state.clone()
    }

    fn restore(&mut self, state: SimMcuState) -> Result<(), StateError> {
        if !state.model.is_sane() {
            return Err(StateError::new("the predecessor's chip drives with numbers out of range"));
        }
        self.state = state;
        self.state.model.set_battery_low(self.config.battery_low_v as f32);
        Ok(())
    }

    /// It holds its end of the line.
    fn exclusive(_config: &SimMcuConfig) -> bool {
        true
    }

    fn reconfigure(&mut self, config: &SimMcuConfig) -> Option<Result<(), SetupError>> {
        if config.line != self.config.line {
            return None;
        }
        self.config = config.clone();
        self.state.model.set_battery_low(config.battery_low_v as f32);
        Some(Ok(()))
    }
}

impl SimMcu {
    fn receive(&mut self, now: Stamp, started: Stamp) {
        for (arrived, bytes) in self.line.take(now) {
            self.state.model.receive(chip_time_us(arrived, started), &bytes, &mut self.reply);
        }
    }

    fn answer(&mut self) {
        if !self.reply.is_empty() {
            self.line.write(&self.reply);
            self.reply.clear();
        }
    }
}

fn chip_time_us(now: Stamp, started: Stamp) -> u64 {
    now.since(started).to_duration().as_micros() as u64
}
