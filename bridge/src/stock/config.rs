//! What only stock firmware needs to be told: what its numbers mean on this car.

use carril_messages::car;
use carril_runtime::Findings;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Slowest and fastest rate at which the newest command is repeated, Hz.
const SEND_HZ: (u32, u32) = (20, 100);
/// Bounds of `silent_after_ms`, ms.
const SILENT_AFTER_MS: (u32, u32) = (100, 10_000);

/// What the wheel figure of the car is: linear.x of `twist`, or the speed of v4.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum WheelFigure {
    /// rad/s of what the encoder sits on, as AutoModelCar v3 and v4 send it.
    #[default]
    AngularSpeed,
    /// m/s of the car.
    Speed,
    /// Counts of `period_count_s` for one turn of the wheel; 0 when it stands.
    Period,
}

/// What a report of ticks means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum TickMeaning {
    /// A counter that wraps.
    Counter,
    /// Ticks since the last report, as AutoModelCar v3 and v4 count them.
    SinceLast,
}

/// Configuration of a link to stock firmware.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StockConfig {
    /// Speed at full power (1020) on level ground, m/s. Stock firmware holds no speed: this is a scale, no promise. 0.1 to 20.
    #[schemars(range(min = 0.1, max = 20), extend("unit" = "m/s"))]
    pub full_speed_m_s: f64,
    /// Road-wheel angle at the servo's stops, degrees, both sides. 1 to 45.
    #[schemars(range(min = 1, max = 45), extend("unit" = "deg"))]
    pub steering_limit_deg: f64,
    /// Steers to the other side. Not set: degrees count to the right, and of 0 to 180 the greater is left.
    pub steering_reversed: bool,
    /// Drives the other way. Not set: positive power is forward.
    pub motor_reversed: bool,
    /// Diameter of a wheel, m. 0.01 to 1.
    #[schemars(range(min = 0.01, max = 1), extend("unit" = "m"))]
    pub wheel_diameter_m: f64,
    /// What the car's wheel figure is.
    pub wheel_figure: WheelFigure,
    /// Turns of what the encoder sits on for one turn of the wheel; 1 when it sits on the wheel. For `angular_speed`. 0.01 to 100.
    #[schemars(range(min = 0.01, max = 100), extend("unit" = ""))]
    pub encoder_turns_per_wheel_turn: f64,
    /// Length of one count of the wheel's period, s. For `period`. 0.000001 to 1.
    #[schemars(range(min = 1e-6, max = 1), extend("unit" = "s"))]
    pub period_count_s: f64,
    /// What a report of ticks means. Not given: `counter` for cars that steer in degrees, `since_last` for the others.
    pub ticks: Option<TickMeaning>,
    /// How often the newest command, or stop, is repeated, Hz. 20 to 100.
    #[schemars(range(min = SEND_HZ.0, max = SEND_HZ.1), extend("unit" = "Hz"))]
    pub send_hz: u32,
    /// A car that says nothing for so long is lost, ms. 100 to 10000.
    #[schemars(range(min = SILENT_AFTER_MS.0, max = SILENT_AFTER_MS.1), extend("unit" = "ms"))]
    pub silent_after_ms: u32,
}

impl Default for StockConfig {
    fn default() -> Self {
        Self {
            full_speed_m_s: car::FULL_DUTY_SPEED_M_S,
            steering_limit_deg: 20.0,
            steering_reversed: false,
            motor_reversed: false,
            wheel_diameter_m: car::WHEEL_DIAMETER_M,
            wheel_figure: WheelFigure::default(),
            encoder_turns_per_wheel_turn: 1.0,
            period_count_s: 0.006,
            ticks: None,
            send_hz: 50,
            silent_after_ms: 500,
        }
    }
}

impl StockConfig {
    /// Reports what is out of range; `section` is the name of the section.
    pub(crate) fn check(&self, section: &str, findings: &mut Findings<'_>) {
        let mut range = |field: &str, value: f64, min: f64, max: f64, unit: &str| {
            findings.range(&format!("{section}.{field}"), value, min, max, unit);
        };
        range("full_speed_m_s", self.full_speed_m_s, 0.1, 20.0, "m/s");
        range("steering_limit_deg", self.steering_limit_deg, 1.0, 45.0, "deg");
        range("wheel_diameter_m", self.wheel_diameter_m, 0.01, 1.0, "m");
        range("encoder_turns_per_wheel_turn", self.encoder_turns_per_wheel_turn, 0.01, 100.0, "");
        range("period_count_s", self.period_count_s, 1e-6, 1.0, "s");
        range("send_hz", self.send_hz.into(), SEND_HZ.0.into(), SEND_HZ.1.into(), "Hz");
        let (min, max) = SILENT_AFTER_MS;
        range("silent_after_ms", self.silent_after_ms.into(), min.into(), max.into(), "ms");
    }
}
