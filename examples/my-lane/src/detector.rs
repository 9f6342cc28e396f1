//! The operator `my-lane`: finds the lane in a camera image. Pure: an image in, an estimate out; no clock, no thread, no Zenoh.
//!
//! In two bands of rows, pixels much brighter than the floor are marking; the lane is the line through their mean positions.

use carril_runtime::messages::{Centroid, Image, Lane, LaneEstimate};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StateError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What can be set in the graph file, below `config`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DetectorConfig {
    /// Middle of the band farther from the car, share of the image height from the top, 0 to 1, < `row_near`.
    #[schemars(range(min = 0, max = 1), extend("unit" = ""))]
    pub row_far: f64,
    /// Middle of the band nearer to the car, share of the image height from the top, 0 to 1, > `row_far`.
    #[schemars(range(min = 0, max = 1), extend("unit" = ""))]
    pub row_near: f64,
    /// Marking begins at this share of the way from the darkest to the brightest pixel of a band, 0.1 to 0.9.
    #[schemars(range(min = 0.1, max = 0.9), extend("unit" = ""))]
    pub level: f64,
    /// A band whose pixels differ by less has no marking, grey values, 1 to 255.
    #[schemars(range(min = 1, max = 255), extend("unit" = ""))]
    pub min_contrast: f64,
    /// Share of the last estimate that goes into the next, 0 (none) to 0.95.
    #[schemars(range(min = 0, max = 0.95), extend("unit" = ""))]
    pub smoothing: f64,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self { row_far: 0.75, row_near: 0.85, level: 0.7, min_contrast: 60.0, smoothing: 0.1 }
    }
}

impl OperatorConfig for DetectorConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("row_far", self.row_far, 0.0, 1.0, "");
        findings.range("row_near", self.row_near, 0.0, 1.0, "");
        findings.require(self.row_far < self.row_near, "row_near", || {
            format!("got {}, allowed is more than `row_far` ({}): rows count from the top", self.row_near, self.row_far)
        });
        findings.range("level", self.level, 0.1, 0.9, "");
        findings.range("min_contrast", self.min_contrast, 1.0, 255.0, "grey values");
        findings.range("smoothing", self.smoothing, 0.0, 0.95, "");
    }
}

carril_runtime::inputs! {
    /// What the detector reads.
    pub struct DetectorInputs {
        /// Camera frames, any size and encoding.
        image: Image,
    }
}

carril_runtime::outputs! {
    /// What the detector gives.
    pub struct DetectorOutputs {
        /// The lane, one estimate per frame; "no lane" is an estimate too.
        lane: LaneEstimate,
    }
}

/// What a successor takes over when the node is swapped. Raise `STATE_VERSION` when its fields change.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DetectorState {
    /// Columns to the left of the middle in the far and near band, px; `None`: no lane in the last frame.
    last_left_px: Option<[f64; 2]>,
}

/// Finds the lane.
pub struct Detector {
    config: DetectorConfig,
    state: DetectorState,
}

impl Operator for Detector {
    const KIND: &'static str = "my-lane";
    const SUMMARY: &'static str = "where the lane lies: mean positions of what is bright in two bands of the image";
    const STATE_VERSION: u32 = 1;

    type Config = DetectorConfig;
    type Inputs = DetectorInputs;
    type Outputs = DetectorOutputs;
    type State = DetectorState;

    fn new(config: DetectorConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { config, state: DetectorState::default() })
    }

    fn step(
        &mut self,
        inputs: &mut DetectorInputs,
        outputs: &mut DetectorOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(image) = inputs.image.take() {
            let lane = self.find(&image);
            outputs.lane.send(LaneEstimate { lane, quality: if lane.is_some() { 1.0 } else { 0.0 }, threshold: None });
        }
        Ok(())
    }

    fn snapshot(&self) -> DetectorState {
        self.state.clone()
    }

    fn restore(&mut self, state: DetectorState) -> Result<(), StateError> {
        if state.last_left_px.is_some_and(|left_px| left_px.iter().any(|value| !value.is_finite())) {
            return Err(StateError::new(format!("the last positions are no numbers: {state:?}")));
        }
        self.state = state;
        Ok(())
    }
}

impl Detector {
    fn find(&mut self, image: &Image) -> Option<Lane> {
        let last = self.state.last_left_px.take();
        let [far, near] = [self.config.row_far, self.config.row_near].map(|row| self.centroid(image, row));
        let (mut far, mut near) = (far?, near?);
        if far.ahead_px <= near.ahead_px {
            return None;
        }
        if let Some([last_far, last_near]) = last {
            far.left_px = self.smooth(last_far, far.left_px);
            near.left_px = self.smooth(last_near, near.left_px);
        }
        self.state.last_left_px = Some([far.left_px, near.left_px].map(f64::from));
        let angle_rad = ((far.left_px - near.left_px) / (far.ahead_px - near.ahead_px)).atan();
        let distance_px = (far.left_px - angle_rad.tan() * far.ahead_px) * angle_rad.cos();
        Some(Lane { angle_rad, distance_px, distance_m: None, ground: None, far, near })
    }

    fn smooth(&self, last: f64, new: f32) -> f32 {
        (self.config.smoothing * last + (1.0 - self.config.smoothing) * f64::from(new)) as f32
    }

    /// The mean position of the marking in the row at `row`, a share of the height.
    fn centroid(&self, image: &Image, row: f64) -> Option<Centroid> {
        let y = ((f64::from(image.height()) * row) as u32).min(image.height() - 1);
        // The brightest channel tells a white marking as well as a yellow one, without knowing their order.
        let brightness = |pixel: &[u8]| f64::from(pixel.iter().copied().max().unwrap_or(0));
        let pixels = || image.row(y).chunks_exact(image.encoding().bytes_per_pixel()).map(brightness);
        let (darkest, brightest) =
            pixels().fold((255.0_f64, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
        if brightest - darkest < self.config.min_contrast {
            return None;
        }
        let marking = darkest + self.config.level * (brightest - darkest);
        let columns = pixels().enumerate().filter(|(_, value)| *value > marking).map(|(x, _)| x as f64);
        let (count, sum) = columns.fold((0_u32, 0.0), |(count, sum), x| (count + 1, sum + x));
        let middle = f64::from(image.width() - 1) / 2.0;
        let left_px = (middle - sum / f64::from(count.max(1))) as f32;
        (count > 0).then_some(Centroid { left_px, ahead_px: (image.height() - 1 - y) as f32, pixels: count })
    }
}

#[cfg(test)]
mod tests {
    use carril_runtime::messages::{Encoding, Header, Message, Meta, Origins, Payload, SourceId, Stamp};
    use carril_runtime::{HeapPool, Trigger};

    use super::*;

    const WIDTH: u32 = 64;
    const HEIGHT: u32 = 48;

    /// A dark floor with a white line whose middle is at `column(y)`.
    fn frame(column: impl Fn(u32) -> u32) -> Image {
        let pixels = (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (x, y)));
        let pixels = pixels.map(|(x, y)| if x.abs_diff(column(y)) <= 1 { 240 } else { 40 }).collect::<Vec<u8>>();
        Image::packed(WIDTH, HEIGHT, Encoding::Mono8, Payload::from(pixels)).expect("the size fits")
    }

    /// Feeds one frame to the operator and gives its answer.
    fn answer(detector: &mut Detector, image: Image) -> Option<Lane> {
        let (mut inputs, mut outputs) = (DetectorInputs::default(), DetectorOutputs::default());
        let stamp = Stamp::from_nanos(1_000_000);
        let origins = Origins::captured(SourceId::of("world", "camera"), stamp);
        let header = Header { epoch: 1, seq: 0, stamp, origins, message_type: Image::TYPE, meta: Meta::new() };
        inputs.image.put(image, header);
        let context = Context::new(stamp, Trigger::Input, &HeapPool);
        detector.step(&mut inputs, &mut outputs, &context).expect("a frame is no error");
        let sent = outputs.lane.sent();
        assert_eq!(sent.len(), 1, "one estimate per frame");
        sent[0].lane
    }

    fn detector() -> Detector {
        Detector::new(DetectorConfig::default(), &Setup::for_tests("lane")).expect("the defaults do")
    }

    #[test]
    fn a_line_on_the_left_that_leads_left_is_positive() {
        let ahead = answer(&mut detector(), frame(|_| 20)).expect("a clear line");
        assert!((ahead.distance_px - 11.5).abs() < 0.01 && ahead.angle_rad.abs() < 0.01, "11.5 px left: {ahead:?}");
        let leading = answer(&mut detector(), frame(|y| y)).expect("a clear line");
        assert!((leading.angle_rad - std::f32::consts::FRAC_PI_4).abs() < 0.01, "45 degrees left: {leading:?}");
    }

    #[test]
    fn an_empty_floor_is_no_lane() {
        assert_eq!(answer(&mut detector(), frame(|_| 1000)), None, "nothing is bright");
    }

    #[test]
    fn a_successor_goes_on_with_the_last_estimate() {
        let mut first = detector();
        answer(&mut first, frame(|_| 20)).expect("a clear line");
        let mut second = detector();
        second.restore(first.snapshot()).expect("its own state");
        let (own, after) = (answer(&mut detector(), frame(|_| 30)), answer(&mut second, frame(|_| 30)));
        assert!(after.map(|lane| lane.distance_px) > own.map(|lane| lane.distance_px), "smoothed: {after:?}, {own:?}");
        let broken = DetectorState { last_left_px: Some([f64::NAN, 0.0]) };
        assert!(second.restore(broken).is_err(), "a state that is no number is refused");
    }

    #[test]
    fn every_bound_of_the_configuration_is_checked() {
        let problems = |change: fn(&mut DetectorConfig)| {
            let mut config = DetectorConfig::default();
            change(&mut config);
            let mut findings = Findings::new(std::path::Path::new("."), false);
            config.check(&mut findings);
            findings.into_found().len()
        };
        assert_eq!(problems(|_| ()), 0, "the defaults pass");
        assert_eq!(problems(|config| config.row_far = -0.1), 1, "row_far");
        assert_eq!(problems(|config| config.row_near = config.row_far), 1, "row_near");
        assert_eq!(problems(|config| config.level = f64::NAN), 1, "level");
        assert_eq!(problems(|config| config.min_contrast = 0.0), 1, "min_contrast");
        assert_eq!(problems(|config| config.smoothing = 1.0), 1, "smoothing");
    }
}
