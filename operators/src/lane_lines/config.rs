//! The configuration of `lane-lines`: how the camera looks at the floor, what the lines look like, and which lane is kept.

use carril_messages::car;
use carril_runtime::{Findings, OperatorConfig};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::lane_detector::Marking;

/// Configuration of `lane-lines`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LaneLinesConfig {
    /// How the camera looks at the floor. `carril calibrate lane` finds `height_m` and `pitch_deg`.
    pub camera: CameraPose,
    /// What the lines look like: `bright`, `dark`, or a range of colours, `{ hsv: { h: [90, 130], s: [80, 255], v: [40, 255] } }`.
    pub marking: Marking,
    /// Width of a line, m, 0.002 to 0.5.
    #[schemars(range(min = 0.002, max = 0.5), extend("unit" = "m"))]
    pub line_width_m: f64,
    /// Lines stand out from the floor on both sides by at least this, grey values, 1 to 255. Far above it, the strongest lines of an
    /// image say what is strong. Without effect on an `hsv` marking.
    #[schemars(range(min = 1, max = 255), extend("unit" = "grey values"))]
    pub min_contrast: f64,
    /// Which lane is kept.
    pub lane: Which,
    /// Width of the lane, between the middles of its lines, m, 0.05 to 5. The one in view may differ by some percent.
    #[schemars(range(min = 0.05, max = 5), extend("unit" = "m"))]
    pub lane_width_m: f64,
    /// How far ahead of the rear axle lines are looked for, m, 0.2 to 10.
    #[schemars(range(min = 0.2, max = 10), extend("unit" = "m"))]
    pub far_m: f64,
    /// The tightest curve of the lane, radius, m, 0.1 to 100.
    #[schemars(range(min = 0.1, max = 100), extend("unit" = "m"))]
    pub min_radius_m: f64,
    /// Time constant with which what is given follows what is seen, s, 0 to 2. 0: at once.
    #[schemars(range(min = 0, max = 2), extend("unit" = "s"))]
    pub smoothing_s: f64,
    /// Without a line in view the lane is carried on by odometry (`wheels`) for this way, m, 0 to 5.
    #[schemars(range(min = 0, max = 5), extend("unit" = "m"))]
    pub bridge_m: f64,
    /// Without a line in view and without odometry the lane is held for this time, s, 0 to 2.
    #[schemars(range(min = 0, max = 2), extend("unit" = "s"))]
    pub bridge_s: f64,
    /// From axle to axle, m, 0.05 to 5: odometry knows the turn from it.
    #[schemars(range(min = 0.05, max = 5), extend("unit" = "m"))]
    pub wheelbase_m: f64,
    /// For the estimate's `far`, share of the image height from the top, 0 to 1.
    #[schemars(range(min = 0, max = 1), extend("unit" = "share of the height"))]
    pub row_far: f64,
    /// For the estimate's `near`, share of the image height from the top, 0 to 1, > `row_far`.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0, "unit" = "share of the height"))]
    pub row_near: f64,
}

/// How the camera looks at the floor: a pinhole without distortion.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CameraPose {
    /// Above the floor, m, 0.02 to 3.
    #[schemars(range(min = 0.02, max = 3), extend("unit" = "m"))]
    pub height_m: f64,
    /// Looking down, degrees, -20 to 80.
    #[schemars(range(min = -20, max = 80), extend("unit" = "degrees"))]
    pub pitch_deg: f64,
    /// From the left edge to the right edge of the image, degrees, 10 to 150.
    #[schemars(range(min = 10, max = 150), extend("unit" = "degrees"))]
    pub horizontal_fov_deg: f64,
    /// Ahead of the rear axle, m, -2 to 5.
    #[schemars(range(min = -2, max = 5), extend("unit" = "m"))]
    pub forward_m: f64,
}

/// Which lane is kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Which {
    /// The lane between two lines.
    #[default]
    Between,
    /// The right lane of a road with two lanes: its left line, often dashed, is the middle of the road.
    Right,
    /// There is one line only, and the car drives on it.
    Follow,
}

impl Which {
    /// Where the lines lie, in lane widths to the left of the lane's middle; the first two are the sides of the lane.
    pub(crate) fn lines(self) -> &'static [f64] {
        match self {
            Self::Between => &[0.5, -0.5],
            Self::Right => &[0.5, -0.5, 1.5],
            Self::Follow => &[0.0],
        }
    }
}

impl Default for CameraPose {
    /// That of the simulator.
    fn default() -> Self {
        Self { height_m: 0.30, pitch_deg: 22.0, horizontal_fov_deg: 110.0, forward_m: 0.10 }
    }
}

impl Default for LaneLinesConfig {
    fn default() -> Self {
        Self {
            camera: CameraPose::default(),
            marking: Marking::Bright,
            line_width_m: 0.02,
            min_contrast: 12.0,
            lane: Which::Between,
            lane_width_m: 0.40,
            far_m: 1.3,
            min_radius_m: 0.7,
            smoothing_s: 0.0,
            bridge_m: 0.6,
            bridge_s: 0.3,
            wheelbase_m: car::WHEELBASE_M,
            row_far: 0.75,
            row_near: 0.85,
        }
    }
}

impl CameraPose {
    /// Checks it as the value of a key.
    pub(crate) fn check_at(&self, key: &str, findings: &mut Findings<'_>) {
        findings.range(&format!("{key}.height_m"), self.height_m, 0.02, 3.0, "m");
        findings.range(&format!("{key}.pitch_deg"), self.pitch_deg, -20.0, 80.0, "degrees");
        findings.range(&format!("{key}.horizontal_fov_deg"), self.horizontal_fov_deg, 10.0, 150.0, "degrees");
        findings.range(&format!("{key}.forward_m"), self.forward_m, -2.0, 5.0, "m");
    }
}

impl OperatorConfig for LaneLinesConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        self.camera.check_at("camera", findings);
        if let Marking::Hsv(range) = &self.marking {
            range.check_at("marking.hsv", findings);
        }
        findings.range("line_width_m", self.line_width_m, 0.002, 0.5, "m");
        findings.range("min_contrast", self.min_contrast, 1.0, 255.0, "grey values");
        findings.range("lane_width_m", self.lane_width_m, 0.05, 5.0, "m");
        findings.range("far_m", self.far_m, 0.2, 10.0, "m");
        findings.range("min_radius_m", self.min_radius_m, 0.1, 100.0, "m");
        findings.range("smoothing_s", self.smoothing_s, 0.0, 2.0, "s");
        findings.range("bridge_m", self.bridge_m, 0.0, 5.0, "m");
        findings.range("bridge_s", self.bridge_s, 0.0, 2.0, "s");
        findings.range("wheelbase_m", self.wheelbase_m, 0.05, 5.0, "m");
        findings.range("row_far", self.row_far, 0.0, 1.0, "");
        findings.range("row_near", self.row_near, 0.0, 1.0, "");
        findings.require(self.row_far < self.row_near, "row_near", || {
            format!("got {}, allowed is more than `row_far` ({}): rows count from the top", self.row_near, self.row_far)
        });
        findings.require(self.lane_width_m >= 2.0 * self.line_width_m, "lane_width_m", || {
            format!("got {} m, allowed is at least twice `line_width_m` ({} m)", self.lane_width_m, self.line_width_m)
        });
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::lane_lines::LaneLines;
    use crate::testing::{fields_found, problems};

    #[test]
    fn every_bound_is_checked() {
        for (config, field) in [
            (json!({"camera": {"height_m": 0}}), "camera.height_m"),
            (json!({"camera": {"pitch_deg": 81}}), "camera.pitch_deg"),
            (json!({"camera": {"horizontal_fov_deg": 180}}), "camera.horizontal_fov_deg"),
            (json!({"camera": {"forward_m": 6}}), "camera.forward_m"),
            (json!({"marking": {"hsv": {"h": [0, 180]}}}), "marking.hsv.h.1"),
            (json!({"line_width_m": 0}), "line_width_m"),
            (json!({"min_contrast": 0}), "min_contrast"),
            (json!({"lane_width_m": 6}), "lane_width_m"),
            (json!({"lane_width_m": 0.06, "line_width_m": 0.04}), "lane_width_m"),
            (json!({"far_m": 0.1}), "far_m"),
            (json!({"min_radius_m": 0}), "min_radius_m"),
            (json!({"smoothing_s": -1}), "smoothing_s"),
            (json!({"bridge_m": 6}), "bridge_m"),
            (json!({"bridge_s": 3}), "bridge_s"),
            (json!({"wheelbase_m": 0}), "wheelbase_m"),
            (json!({"row_far": -0.1}), "row_far"),
            (json!({"row_far": 0.9}), "row_near"),
        ] {
            let found = problems::<LaneLines>(&config);
            assert!(found.len() == 1 && found[0].starts_with(&format!("{field}: got ")), "{config}: {found:?}");
        }
        assert_eq!(problems::<LaneLines>(&json!({})), Vec::<String>::new(), "the defaults pass");
    }

    #[test]
    fn nan_is_refused_everywhere() {
        let nan = f64::NAN;
        let camera = CameraPose { height_m: nan, pitch_deg: nan, horizontal_fov_deg: nan, forward_m: nan };
        let config = LaneLinesConfig {
            camera,
            marking: Marking::Bright,
            line_width_m: nan,
            min_contrast: nan,
            lane: Which::Between,
            lane_width_m: nan,
            far_m: nan,
            min_radius_m: nan,
            smoothing_s: nan,
            bridge_m: nan,
            bridge_s: nan,
            wheelbase_m: nan,
            row_far: nan,
            row_near: nan,
        };
        let fields = fields_found(&config);
        for field in [
            "camera.height_m",
            "camera.pitch_deg",
            "camera.horizontal_fov_deg",
            "camera.forward_m",
            "line_width_m",
            "min_contrast",
            "lane_width_m",
            "far_m",
            "min_radius_m",
            "smoothing_s",
            "bridge_m",
            "bridge_s",
            "wheelbase_m",
            "row_far",
            "row_near",
        ] {
            assert!(fields.iter().any(|found| found == field), "{field} is not in {fields:?}");
        }
    }
}
