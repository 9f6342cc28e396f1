//! The configuration of the lane detector: what counts as marking, where to look for it, and what is believed.

use std::borrow::Cow;
use std::fmt;

use carril_runtime::{Findings, OperatorConfig};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Deserializer, Error, Visitor};
use serde::{Deserialize, Serialize, Serializer};

/// Configuration of the lane detector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LaneDetectorConfig {
    /// Grey value that divides marking from floor, 0 to 255: marking is brighter (`marking: bright`) or not brighter (`dark`).
    /// `otsu`: chosen anew for each image, from the pixels of both bands. Without effect on an `hsv` marking.
    pub threshold: Threshold,
    /// What the marking looks like: `bright`, `dark`, or a range of colours, `{ hsv: { h: [90, 130], s: [80, 255], v: [40, 255] } }`.
    pub marking: Marking,
    /// Middle of the band that is farther from the car, share of the image height from the top, 0 to 1.
    #[schemars(range(min = 0, max = 1), extend("unit" = "share of the height"))]
    pub row_far: f64,
    /// Middle of the band that is nearer to the car, share of the image height from the top, 0 to 1, > `row_far`.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0, "unit" = "share of the height"))]
    pub row_near: f64,
    /// Height of each band, rows, 1 to 200.
    #[schemars(range(min = 1, max = 200), extend("unit" = "px"))]
    pub band_px: u32,
    /// Fewer marking pixels in a band are no lane, 1 to 1000000.
    #[schemars(range(min = 1, max = 1_000_000), extend("unit" = "px"))]
    pub min_pixels: u32,
    /// A larger share of marking pixels in a band is glare, not a lane, > 0 to 1.
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0, "unit" = "share"))]
    pub max_share: f64,
    /// With `otsu`: marking and floor must differ by at least this in the mean, grey values, 0 to 255. Keeps an empty floor from
    /// being divided into "marking" and "floor".
    #[schemars(range(min = 0, max = 255), extend("unit" = "grey values"))]
    pub min_contrast: f64,
    /// Metres on the ground per pixel in the bands, > 0 to 1 m/px. Without it, `distance_m` is "no data".
    #[schemars(range(max = 1), extend("exclusiveMinimum" = 0, "unit" = "m/px"))]
    pub metres_per_px: Option<f64>,
}

impl Default for LaneDetectorConfig {
    fn default() -> Self {
        Self {
            threshold: Threshold::Fixed(190.0),
            marking: Marking::Bright,
            row_far: 0.75,
            row_near: 0.85,
            band_px: 1,
            min_pixels: 3,
            max_share: 0.4,
            min_contrast: 30.0,
            metres_per_px: None,
        }
    }
}

impl OperatorConfig for LaneDetectorConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        if let Threshold::Fixed(value) = self.threshold {
            findings.require((0.0..=255.0).contains(&value), "threshold", || {
                format!("got {value}, allowed is 0 to 255, or `otsu`")
            });
        }
        if let Marking::Hsv(range) = &self.marking {
            range.check_at("marking.hsv", findings);
        }
        findings.range("row_far", self.row_far, 0.0, 1.0, "");
        findings.range("row_near", self.row_near, 0.0, 1.0, "");
        findings.require(self.row_far < self.row_near, "row_near", || {
            format!("got {}, allowed is more than `row_far` ({}): rows count from the top", self.row_near, self.row_far)
        });
        findings.range("band_px", f64::from(self.band_px), 1.0, 200.0, "rows");
        findings.range("min_pixels", f64::from(self.min_pixels), 1.0, 1e6, "pixels");
        findings.require(self.max_share > 0.0 && self.max_share <= 1.0, "max_share", || {
            format!("got {}, allowed is more than 0, up to 1", self.max_share)
        });
        findings.range("min_contrast", self.min_contrast, 0.0, 255.0, "grey values");
        if let Some(scale) = self.metres_per_px {
            findings.require(scale > 0.0 && scale <= 1.0, "metres_per_px", || {
                format!("got {scale} m/px, allowed is more than 0, up to 1 m/px")
            });
        }
    }
}

/// What the marking looks like.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Marking {
    /// Brighter than the floor.
    #[default]
    Bright,
    /// Darker than the floor.
    Dark,
    /// Coloured tape.
    Hsv(HsvRange),
}

/// A range of colours in OpenCV's 8-bit HSV; both ends belong to it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HsvRange {
    /// Hue, 0 to 179 (half degrees: red 0, green 60, blue 120). `[170, 10]` runs through red.
    #[schemars(inner(range(min = 0, max = 179)), extend("unit" = "half degrees"))]
    pub h: [i32; 2],
    /// Saturation, 0 (grey) to 255.
    #[serde(default = "full")]
    #[schemars(inner(range(min = 0, max = 255)), extend("unit" = ""))]
    pub s: [i32; 2],
    /// Value, 0 (black) to 255.
    #[serde(default = "full")]
    #[schemars(inner(range(min = 0, max = 255)), extend("unit" = ""))]
    pub v: [i32; 2],
}

fn full() -> [i32; 2] {
    [0, 255]
}

impl HsvRange {
    /// Checks it as the value of a key.
    pub(crate) fn check_at(&self, key: &str, findings: &mut Findings<'_>) {
        for (name, [from, to], max) in [("h", self.h, 179), ("s", self.s, 255), ("v", self.v, 255)] {
            for (end, value) in [from, to].into_iter().enumerate() {
                findings.range(&format!("{key}.{name}.{end}"), f64::from(value), 0.0, f64::from(max), "");
            }
            findings.require(name == "h" || from <= to, &format!("{key}.{name}"), || {
                format!("got {from} to {to}, the first may not be larger (only the hue runs around)")
            });
        }
    }
}

/// The grey value that divides marking from floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Threshold {
    /// This one, 0 to 255. A float only so that every number reaches the check, which says what is allowed.
    Fixed(f64),
    /// Chosen anew for each image.
    Otsu,
}

impl Serialize for Threshold {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Fixed(value) => serializer.serialize_f64(*value),
            Self::Otsu => serializer.serialize_str("otsu"),
        }
    }
}

impl<'de> Deserialize<'de> for Threshold {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NumberOrWord;

        impl Visitor<'_> for NumberOrWord {
            type Value = Threshold;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a number from 0 to 255, or `otsu`")
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Threshold, E> {
                Ok(Threshold::Fixed(value))
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Threshold, E> {
                Ok(Threshold::Fixed(value as f64))
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Threshold, E> {
                Ok(Threshold::Fixed(value as f64))
            }

            fn visit_str<E: Error>(self, word: &str) -> Result<Threshold, E> {
                match word {
                    "otsu" => Ok(Threshold::Otsu),
                    _ => Err(E::custom(format!("got `{word}`, allowed is a number from 0 to 255, or `otsu`"))),
                }
            }
        }

        deserializer.deserialize_any(NumberOrWord)
    }
}

impl JsonSchema for Threshold {
    fn schema_name() -> Cow<'static, str> {
        "Threshold".into()
    }

    fn json_schema(_generator: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": "Grey value that divides marking from floor, or `otsu` to have it chosen for each image.",
            "unit": "grey value",
            "oneOf": [{ "type": "number", "minimum": 0, "maximum": 255 }, { "const": "otsu" }]
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::testing::problems;

    #[test]
    fn takes_a_number_or_a_word_as_threshold() {
        let read = |value: serde_json::Value| serde_json::from_value::<Threshold>(value).map_err(|e| e.to_string());
        assert_eq!(read(json!(120)), Ok(Threshold::Fixed(120.0)), "a number");
        assert_eq!(read(json!("otsu")), Ok(Threshold::Otsu), "the word");
        let error = read(json!("otsi")).expect_err("another word");
        assert_eq!(error, "got `otsi`, allowed is a number from 0 to 255, or `otsu`", "the message");
        let error = read(json!(true)).expect_err("no number, no word");
        assert!(error.contains("a number from 0 to 255, or `otsu`"), "{error}");
    }

    #[test]
    fn defaults_pass_their_own_check() {
        assert_eq!(problems::<super::super::LaneDetector>(&json!({})), Vec::<String>::new(), "no problem");
    }

    #[test]
    fn every_bound_is_checked() {
        for (config, field) in [
            (json!({"threshold": -1}), "threshold"),
            (json!({"threshold": 255.5}), "threshold"),
            (json!({"threshold": null}), "threshold"),
            (json!({"row_far": -0.1}), "row_far"),
            (json!({"row_near": 1.1}), "row_near"),
            (json!({"row_far": 0.85, "row_near": 0.85}), "row_near"),
            (json!({"band_px": 0}), "band_px"),
            (json!({"band_px": 201}), "band_px"),
            (json!({"min_pixels": 0}), "min_pixels"),
            (json!({"max_share": 0.0}), "max_share"),
            (json!({"max_share": 1.01}), "max_share"),
            (json!({"min_contrast": 256}), "min_contrast"),
            (json!({"metres_per_px": 0.0}), "metres_per_px"),
            (json!({"metres_per_px": 2.0}), "metres_per_px"),
            (json!({"marking": {"hsv": {"h": [0, 180]}}}), "marking.hsv.h.1"),
            (json!({"marking": {"hsv": {"h": [0, 10], "s": [200, 100]}}}), "marking.hsv.s"),
            (json!({"marking": {"hsv": {"h": [0, 10], "v": [-1, 100]}}}), "marking.hsv.v.0"),
        ] {
            let found = problems::<super::super::LaneDetector>(&config);
            assert!(found.iter().any(|one| one.starts_with(&format!("{field}: "))), "{config}: {found:?}");
        }
    }

    #[test]
    fn nan_is_refused_everywhere() {
        let nan = f64::NAN;
        let config = LaneDetectorConfig {
            threshold: Threshold::Fixed(nan),
            row_far: nan,
            row_near: nan,
            max_share: nan,
            min_contrast: nan,
            metres_per_px: Some(nan),
            ..LaneDetectorConfig::default()
        };
        let fields = crate::testing::fields_found(&config);
        for field in ["threshold", "row_far", "row_near", "max_share", "min_contrast", "metres_per_px"] {
            assert!(fields.iter().any(|found| found == field), "{field} is not in {fields:?}");
        }
    }

    #[test]
    fn the_hue_may_run_through_red() {
        let config = json!({"marking": {"hsv": {"h": [170, 10]}}});
        assert_eq!(problems::<super::super::LaneDetector>(&config), Vec::<String>::new(), "170 to 10 is red");
    }
}
