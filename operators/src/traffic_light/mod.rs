//! Operator `traffic-light`: what a traffic light shows, and how far it is to the stop line. One image may be wrong: a light is on or gone
//! only when several agree.

mod config;
mod lamps;
mod stop_line;
#[cfg(test)]
mod tests;

use carril_messages::{Image, Lamp, LightColour, TrafficLight};
use carril_runtime::{Context, Operator, Setup, SetupError, StateError, StepError};
use serde::{Deserialize, Serialize};

pub use config::{Mode, Region, StopLineConfig, TrafficLightConfig};

carril_runtime::inputs! {
    /// What `traffic-light` reads.
    pub struct TrafficLightInputs {
        /// Camera frames, any size; grey ones show no light.
        image: Image,
    }
}

carril_runtime::outputs! {
    /// What `traffic-light` gives.
    pub struct TrafficLightOutputs {
        /// The light in view, one message per frame; "no light" is one too.
        light: TrafficLight,
    }
}

/// How sure it is that a light is on, from image to image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LightMemory {
    /// Red and green, 0 to 1.
    trust: [f32; 2],
    shown: Option<LightColour>,
}

/// Finds the traffic light in view.
pub struct TrafficLights {
    config: TrafficLightConfig,
    memory: LightMemory,
    scratch: lamps::Scratch,
}

impl TrafficLights {
    /// From a configuration that has passed its check.
    pub fn from_config(config: TrafficLightConfig) -> Self {
        Self { config, memory: LightMemory::default(), scratch: lamps::Scratch::default() }
    }

    /// What the light shows after this image.
    pub fn see(&mut self, image: &Image) -> TrafficLight {
        let lamp = self.lamp(image);
        let colour = match (self.config.mode, lamp) {
            (Mode::Blob, lamp) => lamp.map(|lamp| lamp.colour),
            (Mode::Plain, _) => {
                let red = lamps::plainly_red(image, self.config.plain_columns_px) >= self.config.plain_min_pixels;
                Some(if red { LightColour::Red } else { LightColour::Green })
            }
        };
        self.memory.observe(colour, &self.config);
        let stop_line_m = self.config.stop_line.as_ref().and_then(|config| stop_line::stop_line(image, config));
        TrafficLight { colour: self.memory.shown, lamp, stop_line_m }
    }

    /// The lamp in this image; of a red and a green one the red one.
    fn lamp(&mut self, image: &Image) -> Option<Lamp> {
        match self.config.mode {
            Mode::Blob => lamps::lamps(image, &self.config, &mut self.scratch).into_iter().next(),
            Mode::Plain => None,
        }
    }
}

impl LightMemory {
    fn observe(&mut self, seen: Option<LightColour>, config: &TrafficLightConfig) {
        // Sums of shares miss 0 and 1 by a little.
        const NEARLY: f32 = 1e-3;
        for (colour, trust) in [LightColour::Red, LightColour::Green].into_iter().zip(&mut self.trust) {
            let change =
                if seen == Some(colour) { 1.0 / config.on_frames as f32 } else { -1.0 / config.off_frames as f32 };
            *trust = (*trust + change).clamp(0.0, 1.0);
            if *trust >= 1.0 - NEARLY && seen == Some(colour) {
                self.shown = Some(colour);
            } else if *trust <= NEARLY && self.shown == Some(colour) {
                self.shown = None;
            }
        }
    }
}

impl Operator for TrafficLights {
    const KIND: &'static str = "traffic-light";
    const SUMMARY: &'static str = "what a traffic light shows, by colour and shape, and where its stop line is";

    type Config = TrafficLightConfig;
    type Inputs = TrafficLightInputs;
    type Outputs = TrafficLightOutputs;
    type State = LightMemory;

    fn new(config: TrafficLightConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self::from_config(config))
    }

    fn step(
        &mut self,
        inputs: &mut TrafficLightInputs,
        outputs: &mut TrafficLightOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(image) = inputs.image.take() {
            let light = self.see(&image);
            outputs.light.send(light);
        }
        Ok(())
    }

    fn snapshot(&self) -> LightMemory {
        self.memory
    }

    fn restore(&mut self, memory: LightMemory) -> Result<(), StateError> {
        if !memory.trust.iter().all(|trust| (0.0..=1.0).contains(trust)) {
            return Err(StateError::new(format!(
                "the predecessor trusts its light by {:?}, allowed is 0 to 1",
                memory.trust
            )));
        }
        self.memory = memory;
        Ok(())
    }
}
