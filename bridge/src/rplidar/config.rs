//! The configuration of `rplidar`.

use std::time::Duration;

use carril_runtime::{Findings, OperatorConfig};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::link::SIMULATED;
use crate::mcu_link::{is_line_name, line_name_rule};

/// Configuration of [`Rplidar`](super::Rplidar).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RplidarConfig {
    /// The serial port: a path, best below /dev/serial/by-id, or `sim:NAME` for the line NAME of a `sim-rplidar` node.
    pub port: String,
    /// Speed of the line, baud. 115200: A1 and A2M8; 256000: A2M12 and A3.
    #[serde(default = "default_baud")]
    #[schemars(range(min = 9600, max = 2_000_000), extend("unit" = "baud"))]
    pub baud: u32,
    /// How measurements come.
    #[serde(default)]
    pub mode: Mode,
    /// Points of a scan, evenly around the device, 36 to 4096. Of several measurements for a point the nearest counts.
    #[serde(default = "default_points")]
    #[schemars(range(min = 36, max = 4096), extend("unit" = "points"))]
    pub points: u32,
    /// Nearest range that is believed, m, 0 to 2.
    #[serde(default = "default_range_min_m")]
    #[schemars(range(min = 0, max = 2), extend("unit" = "m"))]
    pub range_min_m: f64,
    /// Farthest range that is believed, m, more than `range_min_m`, to 50. What is farther, and what sends nothing back, is free.
    #[serde(default = "default_range_max_m")]
    #[schemars(range(max = 50), extend("exclusiveMinimum" = 0, "unit" = "m"))]
    pub range_max_m: f64,
    /// Speed of the motor of an A2 or A3, share of full speed in 1/1023, 0 to 1023. An A1 turns as fast as its supply says.
    #[serde(default = "default_motor_pwm")]
    #[schemars(range(min = 0, max = 1023), extend("unit" = ""))]
    pub motor_pwm: u16,
    /// Without a measurement for so long the conversation begins again, ms, 100 to 10000.
    #[serde(default = "default_silence_ms")]
    #[schemars(range(min = 100, max = 10000), extend("unit" = "ms"))]
    pub silence_ms: u32,
}

/// How measurements come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// One at a time: every device, half as many points.
    Standard,
    /// In capsules of 32 with a checksum: firmware 1.17 and newer.
    #[default]
    Express,
}

fn default_baud() -> u32 {
    115_200
}

fn default_points() -> u32 {
    360
}

fn default_range_min_m() -> f64 {
    0.15
}

fn default_range_max_m() -> f64 {
    12.0
}

fn default_motor_pwm() -> u16 {
    660
}

fn default_silence_ms() -> u32 {
    1000
}

impl RplidarConfig {
    /// With its defaults.
    pub fn on(port: &str) -> Self {
        Self {
            port: port.to_owned(),
            baud: default_baud(),
            mode: Mode::default(),
            points: default_points(),
            range_min_m: default_range_min_m(),
            range_max_m: default_range_max_m(),
            motor_pwm: default_motor_pwm(),
            silence_ms: default_silence_ms(),
        }
    }

    pub(super) fn reach_m(&self) -> [f32; 2] {
        [self.range_min_m as f32, self.range_max_m as f32]
    }

    pub(super) fn silence(&self) -> Duration {
        Duration::from_millis(u64::from(self.silence_ms))
    }
}

impl OperatorConfig for RplidarConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        if let Some(name) = self.port.strip_prefix(SIMULATED) {
            findings.require(is_line_name(name), "port", || line_name_rule(name));
        } else {
            findings.require(!self.port.is_empty(), "port", || "got nothing, allowed is a path or `sim:NAME`".into());
            findings.device("port", &self.port);
        }
        findings.range("baud", f64::from(self.baud), 9_600.0, 2_000_000.0, "baud");
        findings.range("points", f64::from(self.points), 36.0, 4096.0, "points");
        findings.range("range_min_m", self.range_min_m, 0.0, 2.0, "m");
        findings.require(self.range_max_m > self.range_min_m && self.range_max_m <= 50.0, "range_max_m", || {
            format!(
                "got {} m, allowed is more than `range_min_m` ({} m), up to 50 m",
                self.range_max_m, self.range_min_m
            )
        });
        findings.range("motor_pwm", f64::from(self.motor_pwm), 0.0, 1023.0, "");
        findings.range("silence_ms", f64::from(self.silence_ms), 100.0, 10_000.0, "ms");
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use carril_runtime::OperatorKind;
    use serde_json::{Value, json};

    use super::super::Rplidar;

    fn problems(config: &Value) -> Vec<String> {
        let found = OperatorKind::of::<Rplidar>().check_config(config, Path::new("."), false);
        found.into_iter().map(|finding| format!("{}: {}", finding.path.join("."), finding.message)).collect()
    }

    #[test]
    fn every_bound_is_checked() {
        for (config, field) in [
            (json!({"port": ""}), "port"),
            (json!({"port": "sim:a/b"}), "port"),
            (json!({"port": "sim:lidar", "baud": 300}), "baud"),
            (json!({"port": "sim:lidar", "points": 8}), "points"),
            (json!({"port": "sim:lidar", "range_min_m": 3, "range_max_m": 12}), "range_min_m"),
            (json!({"port": "sim:lidar", "range_max_m": 0.1}), "range_max_m"),
            (json!({"port": "sim:lidar", "motor_pwm": 2000}), "motor_pwm"),
            (json!({"port": "sim:lidar", "silence_ms": 10}), "silence_ms"),
        ] {
            let found = problems(&config);
            assert!(found.len() == 1 && found[0].starts_with(&format!("{field}: got ")), "{config}: {found:?}");
        }
        assert_eq!(problems(&json!({"port": "sim:lidar"})), Vec::<String>::new(), "the defaults pass");
    }
}
