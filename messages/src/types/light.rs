//! What a traffic light shows, and where to stop before it.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a traffic light says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum LightColour {
    /// Stop.
    Red,
    /// Go.
    Green,
}

impl LightColour {
    /// As on the wire and in the YAML: `red`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Red => "red",
            Self::Green => "green",
        }
    }
}

/// A lamp in the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Lamp {
    /// What it shows in this image.
    pub colour: LightColour,
    /// Column of its middle, px from the left edge.
    pub column_px: f32,
    /// Row of its middle, px from the top edge.
    pub row_px: f32,
    /// px, > 0.
    pub radius_px: f32,
}

/// The traffic light in view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrafficLight {
    /// What it shows, after several images that agree. `None`: no light is in view, or not for long enough yet.
    pub colour: Option<LightColour>,
    /// The lamp in this image. `None`: there is none in it.
    pub lamp: Option<Lamp>,
    /// The near edge of the stop line, m ahead of the rear axle, along the body's x axis. `None`: no stop line is in view.
    pub stop_line_m: Option<f32>,
}
crate::message!(TrafficLight, "carril/TrafficLight", 1);
