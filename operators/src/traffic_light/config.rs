//! The configuration of `traffic-light`: where in the image the lamps are, what they look like, and where the stop line is looked for.

use carril_runtime::{Findings, OperatorConfig};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::lane_detector::HsvRange;
use crate::lane_lines::CameraPose;

/// Configuration of `traffic-light`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrafficLightConfig {
    /// How a lamp is told from everything else.
    pub mode: Mode,
    /// The part of the image in which lamps are looked for.
    pub region: Region,
    /// Colours of a red lamp, and of the halo around its core.
    pub red: HsvRange,
    /// Colours of a green lamp.
    pub green: HsvRange,
    /// Smaller spots are no lamps, px in an image of 640 columns, 1 to 100.
    #[schemars(range(min = 1, max = 100), extend("unit" = "px"))]
    pub min_radius_px: f64,
    /// Larger ones neither, px in an image of 640 columns, `min_radius_px` to 300.
    #[schemars(range(min = 1, max = 300), extend("unit" = "px"))]
    pub max_radius_px: f64,
    /// A lamp that is lit has a core so bright that it is white: at least this share of its disc, 0 to 1. 0: painted lamps count too.
    #[schemars(range(min = 0, max = 1), extend("unit" = "share"))]
    pub min_core: f64,
    /// `plain`: columns from the left edge that are looked at, px in an image of 640 columns, 1 to 640.
    #[schemars(range(min = 1, max = 640), extend("unit" = "px"))]
    pub plain_columns_px: u32,
    /// `plain`: so many red pixels are a red light, 1 to 1000000.
    #[schemars(range(min = 1, max = 1_000_000), extend("unit" = "px"))]
    pub plain_min_pixels: u32,
    /// A light is on when it was seen in so many images, those without it taken off, 1 to 100.
    #[schemars(range(min = 1, max = 100), extend("unit" = "frames"))]
    pub on_frames: u32,
    /// And gone when it was missing in so many, 1 to 100. A lamp that flickers is on as long as it is seen often enough.
    #[schemars(range(min = 1, max = 100), extend("unit" = "frames"))]
    pub off_frames: u32,
    /// Where the stop line is looked for. `null`: nowhere.
    pub stop_line: Option<StopLineConfig>,
}

/// How a lamp is told from everything else.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// By colour, shape, size and its white core.
    #[default]
    Blob,
    /// The rule of the car that this one is the successor of: many pixels with red above 200, green and blue below 200, in the columns on
    /// the left. Knows no green: no red is go.
    Plain,
}

/// A part of the image, shares of its width and height from the upper left corner, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// Left edge.
    #[schemars(range(min = 0, max = 1), extend("unit" = "share"))]
    pub left: f64,
    /// Right edge, more than `left`.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0, "unit" = "share"))]
    pub right: f64,
    /// Upper edge.
    #[schemars(range(min = 0, max = 1), extend("unit" = "share"))]
    pub top: f64,
    /// Lower edge, more than `top`.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0, "unit" = "share"))]
    pub bottom: f64,
}

/// Where the stop line is looked for, and what it looks like.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StopLineConfig {
    /// How the camera looks at the floor: as in the configuration of `lane-lines`.
    pub camera: CameraPose,
    /// Of the line, along the car's way, m, 0.005 to 0.5.
    #[schemars(range(min = 0.005, max = 0.5), extend("unit" = "m"))]
    pub line_width_m: f64,
    /// The line covers at least this width across the car's way, in its middle, m, 0.05 to 5.
    #[schemars(range(min = 0.05, max = 5), extend("unit" = "m"))]
    pub across_m: f64,
    /// How far ahead of the rear axle it is looked for, m, 0.2 to 10.
    #[schemars(range(min = 0.2, max = 10), extend("unit" = "m"))]
    pub far_m: f64,
    /// Brighter than the floor before and behind it by at least this, grey values, 1 to 255.
    #[schemars(range(min = 1, max = 255), extend("unit" = "grey values"))]
    pub min_contrast: f64,
}

impl Default for StopLineConfig {
    fn default() -> Self {
        Self { camera: CameraPose::default(), line_width_m: 0.04, across_m: 0.24, far_m: 1.3, min_contrast: 20.0 }
    }
}

impl Default for Region {
    fn default() -> Self {
        Self { left: 0.0, right: 0.5, top: 0.0, bottom: 0.6 }
    }
}

impl Default for TrafficLightConfig {
    fn default() -> Self {
        Self {
            mode: Mode::Blob,
            region: Region::default(),
            red: HsvRange { h: [170, 10], s: [110, 255], v: [70, 255] },
            green: HsvRange { h: [48, 92], s: [90, 255], v: [60, 255] },
            min_radius_px: 2.5,
            max_radius_px: 40.0,
            min_core: 0.06,
            plain_columns_px: 190,
            plain_min_pixels: 50,
            on_frames: 3,
            off_frames: 8,
            stop_line: None,
        }
    }
}

impl Region {
    fn check(&self, findings: &mut Findings<'_>) {
        for ((low, from), (high, to)) in
            [(("left", self.left), ("right", self.right)), (("top", self.top), ("bottom", self.bottom))]
        {
            findings.range(&format!("region.{low}"), from, 0.0, 1.0, "");
            findings.require(to > 0.0 && to <= 1.0, &format!("region.{high}"), || {
                format!("got {to}, allowed is a share of the image, more than 0, up to 1")
            });
            if from >= to {
                findings.report(
                    &format!("region.{high}"),
                    format!("got {to}, allowed is more than `{low}` ({from})"),
                    None,
                );
            }
        }
    }
}

impl OperatorConfig for TrafficLightConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        self.region.check(findings);
        self.red.check_at("red", findings);
        self.green.check_at("green", findings);
        findings.range("min_radius_px", self.min_radius_px, 1.0, 100.0, "px");
        findings.require(
            self.max_radius_px >= self.min_radius_px && self.max_radius_px <= 300.0,
            "max_radius_px",
            || format!("got {}, allowed is `min_radius_px` ({}) to 300 px", self.max_radius_px, self.min_radius_px),
        );
        findings.range("min_core", self.min_core, 0.0, 1.0, "");
        findings.range("plain_columns_px", f64::from(self.plain_columns_px), 1.0, 640.0, "px");
        findings.range("plain_min_pixels", f64::from(self.plain_min_pixels), 1.0, 1e6, "px");
        findings.range("on_frames", f64::from(self.on_frames), 1.0, 100.0, "frames");
        findings.range("off_frames", f64::from(self.off_frames), 1.0, 100.0, "frames");
        if let Some(line) = &self.stop_line {
            line.camera.check_at("stop_line.camera", findings);
            findings.range("stop_line.line_width_m", line.line_width_m, 0.005, 0.5, "m");
            findings.range("stop_line.across_m", line.across_m, 0.05, 5.0, "m");
            findings.range("stop_line.far_m", line.far_m, 0.2, 10.0, "m");
            findings.range("stop_line.min_contrast", line.min_contrast, 1.0, 255.0, "grey values");
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::testing::{fields_found, problems};
    use crate::traffic_light::TrafficLights;

    #[test]
    fn every_bound_is_checked() {
        for (config, field) in [
            (json!({"region": {"left": 0.5, "right": 0.5, "top": 0, "bottom": 1}}), "region.right"),
            (json!({"region": {"left": 0, "right": 1, "top": -0.1, "bottom": 1}}), "region.top"),
            (json!({"region": {"left": 0, "right": 1, "top": 0, "bottom": 1.1}}), "region.bottom"),
            (json!({"red": {"h": [170, 180]}}), "red.h.1"),
            (json!({"green": {"h": [50, 80], "s": [200, 100]}}), "green.s"),
            (json!({"min_radius_px": 0.5}), "min_radius_px"),
            (json!({"max_radius_px": 2}), "max_radius_px"),
            (json!({"min_core": 1.5}), "min_core"),
            (json!({"plain_columns_px": 0}), "plain_columns_px"),
            (json!({"plain_min_pixels": 0}), "plain_min_pixels"),
            (json!({"on_frames": 0}), "on_frames"),
            (json!({"off_frames": 101}), "off_frames"),
            (json!({"stop_line": {"camera": {"height_m": 0}}}), "stop_line.camera.height_m"),
            (json!({"stop_line": {"line_width_m": 0}}), "stop_line.line_width_m"),
            (json!({"stop_line": {"across_m": 9}}), "stop_line.across_m"),
            (json!({"stop_line": {"far_m": 0}}), "stop_line.far_m"),
            (json!({"stop_line": {"min_contrast": 0}}), "stop_line.min_contrast"),
        ] {
            let found = problems::<TrafficLights>(&config);
            assert!(found.len() == 1 && found[0].starts_with(&format!("{field}: got ")), "{config}: {found:?}");
        }
        for config in [json!({}), json!({"stop_line": {}}), json!({"mode": "plain"})] {
            assert_eq!(problems::<TrafficLights>(&config), Vec::<String>::new(), "{config} passes");
        }
    }

    #[test]
    fn nan_is_refused_everywhere() {
        let nan = f64::NAN;
        let config = TrafficLightConfig {
            region: Region { left: nan, right: nan, top: nan, bottom: nan },
            min_radius_px: nan,
            max_radius_px: nan,
            min_core: nan,
            stop_line: Some(StopLineConfig {
                line_width_m: nan,
                across_m: nan,
                far_m: nan,
                min_contrast: nan,
                ..StopLineConfig::default()
            }),
            ..TrafficLightConfig::default()
        };
        assert_eq!(fields_found(&config).len(), 11, "every number: {:?}", fields_found(&config));
    }
}
