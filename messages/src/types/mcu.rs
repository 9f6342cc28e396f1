//! What passes between the microcontroller and the car's electrics. Only a simulated microcontroller speaks these; a real one
//! has copper.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The output pins of the microcontroller.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct McuPins {
    /// Servo pulse, µs. `None`: the pin gives no pulses and the servo is free.
    pub servo_us: Option<u16>,
    /// Motor duty, -1 (full backward) to 1 (full forward). 0 with `brake` false: the motor coasts.
    pub motor_duty: f32,
    /// Both motor terminals are shorted: the motor brakes.
    pub brake: bool,
}

crate::message!(McuPins, "carril/McuPins", 1);

/// The input pins of the microcontroller.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct McuSensors {
    /// Edges of the wheel encoder since the start, one channel: counts up in both directions.
    pub encoder_ticks: u64,
    /// Time between the last two edges, µs. `None` before the second edge.
    pub encoder_period_us: Option<u32>,
    /// Battery voltage, V.
    pub battery_v: f32,
    /// The e-stop button is pressed.
    pub estop_pressed: bool,
}

crate::message!(McuSensors, "carril/McuSensors", 1);
