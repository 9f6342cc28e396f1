//! The traffic light ahead: what is known of it, how far it is to where the car must stand, and how fast it may go there.

use std::time::Duration;

use carril_messages::{LightColour, Stamp, TrafficLight};
use carril_runtime::Findings;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Slower than this no car drives evenly, m/s.
const CREEP_M_S: f64 = 0.1;
/// A car that is so near to its place stands in it, m.
const IN_PLACE_M: f64 = 0.015;
/// Whose front is so far behind the stop line has passed it, m: less is the error of looking.
const PASSED_M: f64 = 0.05;
/// So far behind the line the light is behind the car, too, m.
const BEHIND_M: f64 = 1.0;

/// How the car behaves at a traffic light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LightConfig {
    /// From the front of the car to the stop line, where it stands at red, m, 0.02 to 2.
    #[schemars(range(min = 0.02, max = 2), extend("unit" = "m"))]
    pub stop_before_m: f64,
    /// The front of the car, ahead of its rear axle, m, 0 to 5.
    #[schemars(range(min = 0, max = 5), extend("unit" = "m"))]
    pub front_m: f64,
    /// How hard it brakes before a stop line, m/s², 0.05 to 10.
    #[schemars(range(min = 0.05, max = 10), extend("unit" = "m/s²"))]
    pub brake_m_s2: f64,
    /// Speed at red while no stop line is in view yet, m/s, 0 to 20. 0: it stops where it sees the red light.
    #[schemars(range(min = 0, max = 20), extend("unit" = "m/s"))]
    pub approach_speed_m_s: f64,
    /// An older word about the light counts as none, and stops the car, ms, 20 to 5000. Measured from the exposure.
    #[schemars(range(min = 20, max = 5000), extend("unit" = "ms"))]
    pub timeout_ms: f64,
    /// A car that stands at red goes on when no light has been in view for so long, s, 0 to 3600.
    #[schemars(range(min = 0, max = 3600), extend("unit" = "s"))]
    pub gone_s: f64,
}

impl Default for LightConfig {
    fn default() -> Self {
        Self {
            stop_before_m: 0.15,
            front_m: 0.30,
            brake_m_s2: 0.5,
            approach_speed_m_s: 0.0,
            timeout_ms: 500.0,
            gone_s: 10.0,
        }
    }
}

impl LightConfig {
    pub(super) fn check(&self, findings: &mut Findings<'_>) {
        findings.range("light.stop_before_m", self.stop_before_m, 0.02, 2.0, "m");
        findings.range("light.front_m", self.front_m, 0.0, 5.0, "m");
        findings.range("light.brake_m_s2", self.brake_m_s2, 0.05, 10.0, "m/s²");
        findings.range("light.approach_speed_m_s", self.approach_speed_m_s, 0.0, 20.0, "m/s");
        findings.range("light.timeout_ms", self.timeout_ms, 20.0, 5000.0, "ms");
        findings.range("light.gone_s", self.gone_s, 0.0, 3600.0, "s");
    }
}

/// What is known of the light. Survives from step to step and is handed over.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LightMemory {
    /// Exposure of the newest word; `None` before the first.
    captured: Option<Stamp>,
    /// What it said.
    colour: Option<LightColour>,
    /// When a light was last in view.
    seen: Option<Stamp>,
    /// From the car's front to the stop line, m: seen, and carried on by the speed that was asked for.
    to_line_m: Option<f64>,
    /// Way since a stop line was passed, m; `None`: none was, lately.
    passed_m: Option<f64>,
    /// When the ways were last carried on.
    moved: Option<Stamp>,
}

impl LightMemory {
    /// The car has gone on at this speed.
    pub fn drive_on(&mut self, speed_m_s: f64, now: Stamp) {
        let seconds = self.moved.map_or(0.0, |moved| now.since(moved).as_secs_f64().clamp(0.0, 0.5));
        self.moved = Some(now);
        let way_m = speed_m_s.max(0.0) * seconds;
        self.passed_m = self.passed_m.map(|passed_m| passed_m + way_m).filter(|passed_m| *passed_m < BEHIND_M);
        self.to_line_m = self.to_line_m.map(|line_m| line_m - way_m);
        if self.to_line_m.is_some_and(|line_m| line_m < -PASSED_M) {
            self.to_line_m = None;
            self.passed_m = Some(0.0);
        }
    }

    /// Takes in what was said, of an image exposed at `captured`, by a car that goes at this speed.
    pub fn observe(&mut self, light: &TrafficLight, captured: Stamp, speed_m_s: f64, now: Stamp, config: &LightConfig) {
        self.captured = Some(captured);
        self.colour = light.colour;
        if light.colour.is_some() {
            self.seen = Some(now);
        }
        if let Some(ahead_m) = light.stop_line_m.map(f64::from).filter(|ahead_m| ahead_m.is_finite()) {
            let since_m = speed_m_s.max(0.0) * now.since(captured).as_secs_f64().clamp(0.0, 0.5);
            let to_line_m = ahead_m - config.front_m - since_m;
            // The line that is being passed is none to stop for.
            if self.passed_m.is_none() || to_line_m > 0.0 {
                self.to_line_m = Some(to_line_m);
            }
        }
    }

    /// Whether the newest word still counts.
    pub fn counts(&self, now: Stamp, config: &LightConfig) -> bool {
        let timeout = Duration::from_secs_f64(config.timeout_ms * 1e-3);
        self.captured.is_some_and(|captured| now.since(captured).to_duration() <= timeout)
    }

    fn is_silent(&self, now: Stamp, config: &LightConfig) -> bool {
        self.captured.is_some() && !self.counts(now, config)
    }

    /// Whether all its numbers are some.
    pub fn is_finite(&self) -> bool {
        self.to_line_m.is_none_or(f64::is_finite) && self.passed_m.is_none_or(f64::is_finite)
    }

    /// Why the car must stop, or go no farther than the stop line.
    pub fn stops(&self, now: Stamp, config: &LightConfig) -> Option<String> {
        if self.is_silent(now, config) {
            return Some(silent(config));
        }
        if self.colour != Some(LightColour::Red) || self.passed_m.is_some() {
            return None;
        }
        match self.to_line_m {
            Some(line_m) if line_m < 0.0 => None,
            Some(line_m) => Some(format!("the light is red, {line_m:.2} m to the stop line")),
            None => Some("the light is red, no stop line in view yet".into()),
        }
    }

    /// Why the car may go on.
    pub fn lets_go(&self, now: Stamp, config: &LightConfig) -> Option<String> {
        if self.is_silent(now, config) {
            return None;
        }
        match (self.colour, self.seen) {
            (Some(LightColour::Red), _) => None,
            (Some(colour), _) => Some(format!("the light is {}", colour.name())),
            (None, None) => Some("no light is in view".into()),
            (None, Some(seen)) => {
                let gone_s = now.since(seen).as_secs_f64();
                (gone_s >= config.gone_s).then(|| format!("no light in view for {gone_s:.1} s"))
            }
        }
    }

    /// Speed towards the place where the car stands at red, m/s.
    pub fn speed_m_s(&self, cruise_m_s: f64, now: Stamp, config: &LightConfig) -> f64 {
        if self.is_silent(now, config) {
            return 0.0;
        }
        match self.to_line_m {
            Some(line_m) => {
                let left_m = line_m - config.stop_before_m;
                let braking = (2.0 * config.brake_m_s2 * left_m.max(0.0)).sqrt();
                if left_m <= IN_PLACE_M { 0.0 } else { braking.max(CREEP_M_S).min(cruise_m_s) }
            }
            None if self.colour == Some(LightColour::Red) => config.approach_speed_m_s.min(cruise_m_s),
            None => 0.0,
        }
    }
}

fn silent(config: &LightConfig) -> String {
    format!("nothing is known of the traffic light: no word of it for more than {:.0} ms", config.timeout_ms)
}
