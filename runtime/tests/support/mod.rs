//! Small operators with the port types of the real ones, for tests of the graph reader and the executors. What they compute is
//! simple, but real: numbers from their seed, their configuration, their inputs and the time; nothing else.

#![allow(dead_code, missing_docs, reason = "shared by several test programs, each of which uses a part")]

pub mod probes;

use std::time::Duration;

use carril_runtime::messages::{
    Centroid, Command, Control, DecisionState, DriveState, Encoding, Goal, Image, Lane, LaneEstimate, LaserScan,
    McuPins, McuSensors, Sector, Sectors, Stamp,
};
use carril_runtime::{
    Context, Findings, NoInputs, NoOutputs, Operator, OperatorConfig, Registry, Setup, SetupError, StateError,
    StepError, inputs, outputs, stateless,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub fn registry() -> Registry {
    Registry::new()
        .with::<SimWorld>()
        .with::<LaneDetector>()
        .with::<LidarSectors>()
        .with::<Decision>()
        .with::<Actuator>()
        .with::<McuLink>()
        .with::<SimMcu>()
        .with::<Camera>()
        .with::<Clash>()
}

/// Empty configuration.
#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Nothing {}

impl OperatorConfig for Nothing {
    fn check(&self, _findings: &mut Findings<'_>) {}
}

/// A generator of numbers, as short as one can be (SplitMix64, Steele et al. 2014).
pub fn next_random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[derive(Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimWorldConfig {
    pub track: Option<String>,
    pub seed: u64,
    pub rate_hz: f64,
}

impl Default for SimWorldConfig {
    fn default() -> Self {
        Self { track: None, seed: 1, rate_hz: 30.0 }
    }
}

impl OperatorConfig for SimWorldConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("rate_hz", self.rate_hz, 1.0, 1000.0, "Hz");
        if let Some(track) = &self.track {
            findings.file("track", track);
        }
    }
}

inputs! {
    pub struct SimWorldInputs {
        /// What the microcontroller drives.
        pins: McuPins [hold optional],
    }
}

outputs! {
    pub struct SimWorldOutputs {
        /// Frames.
        camera: Image [on_demand],
        /// Scans.
        scan: LaserScan,
        /// What the microcontroller senses.
        sensors: McuSensors,
    }
}

pub struct SimWorld {
    random: u64,
    x_m: f64,
}

impl Operator for SimWorld {
    const KIND: &'static str = "sim-world";
    const SUMMARY: &'static str = "Stands in for the hardware";
    const STAYS_ON_CAR: bool = true;
    type Config = SimWorldConfig;
    type Inputs = SimWorldInputs;
    type Outputs = SimWorldOutputs;

    fn new(config: SimWorldConfig, setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { random: config.seed ^ (setup.seed << 32), x_m: 0.0 })
    }

    fn period(config: &SimWorldConfig) -> Option<Duration> {
        Some(Duration::from_secs_f64(1.0 / config.rate_hz))
    }

    fn step(
        &mut self,
        inputs: &mut SimWorldInputs,
        outputs: &mut SimWorldOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let duty = inputs.pins.latest().map_or(0.0, |pins| f64::from(pins.servo_us.unwrap_or(0)) * 1e-3);
        self.x_m += 0.01 + 1e-4 * duty;
        let noise = (next_random(&mut self.random) % 1000) as f32 * 1e-4;
        if outputs.camera.wanted() {
            let mut pixels = context.buffer(16 * 8);
            pixels.iter_mut().for_each(|pixel| *pixel = next_random(&mut self.random) as u8);
            let image = Image::packed(16, 8, Encoding::Mono8, pixels.freeze()).map_err(StepError::new)?;
            outputs.camera.send_captured(image, context.now());
        }
        let ranges_m = (0..8).map(|ray| 1.0 + noise + ray as f32 + self.x_m as f32).collect();
        let scan = LaserScan {
            angle_min_rad: 0.0,
            angle_increment_rad: 0.1,
            scan_time_s: 0.1,
            range_min_m: 0.1,
            range_max_m: 16.0,
            ranges_m,
        };
        outputs.scan.send_captured(scan, context.now());
        let encoder_ticks = (self.x_m * 100.0) as u64;
        outputs.sensors.send(McuSensors {
            encoder_ticks,
            encoder_period_us: None,
            battery_v: 7.4,
            estop_pressed: false,
        });
        Ok(())
    }

    stateless!();
}

inputs! {
    pub struct LaneInputs {
        /// Frames.
        image: Image,
    }
}

outputs! {
    pub struct LaneOutputs {
        /// The lane.
        lane: LaneEstimate,
        /// Drawn.
        debug: Image [on_demand],
    }
}

#[derive(Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LaneConfig {
    pub threshold: u8,
    pub row_far: f64,
    pub row_near: f64,
    pub mode: LaneMode,
    pub bands: Vec<Band>,
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LaneMode {
    #[default]
    Fixed,
    Otsu,
    Hsv {
        low: [u8; 3],
        high: [u8; 3],
    },
}

#[derive(Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Band {
    pub from: f64,
    pub to: f64,
}

impl Default for LaneConfig {
    fn default() -> Self {
        Self { threshold: 190, row_far: 0.75, row_near: 0.85, mode: LaneMode::Fixed, bands: Vec::new() }
    }
}

impl OperatorConfig for LaneConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("row_far", self.row_far, 0.0, 1.0, "");
        findings.range("row_near", self.row_near, 0.0, 1.0, "");
        findings.require(self.row_far < self.row_near, "row_far", || {
            format!("got {}, must be less than `row_near` ({})", self.row_far, self.row_near)
        });
        for (index, band) in self.bands.iter().enumerate() {
            findings.range(&format!("bands.{index}.from"), band.from, 0.0, 1.0, "");
            findings.range(&format!("bands.{index}.to"), band.to, 0.0, 1.0, "");
        }
    }
}

#[derive(Clone, Serialize, Deserialize)]
pub struct LaneDetector {
    frames: u64,
}

impl Operator for LaneDetector {
    const KIND: &'static str = "lane-detector";
    const SUMMARY: &'static str = "Finds the lane";
    type Config = LaneConfig;
    type Inputs = LaneInputs;
    type Outputs = LaneOutputs;
    type State = Self;

    fn new(_config: LaneConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { frames: 0 })
    }

    fn step(
        &mut self,
        inputs: &mut LaneInputs,
        outputs: &mut LaneOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(image) = inputs.image.take() {
            self.frames += 1;
            let sum: u32 = image.pixels().iter().map(|&pixel| u32::from(pixel)).sum();
            let centroid = Centroid { left_px: sum as f32 * 1e-3, ahead_px: 1.0, pixels: 1 };
            let lane = Lane {
                angle_rad: sum as f32 * 1e-5,
                distance_px: self.frames as f32,
                distance_m: None,
                ground: None,
                far: centroid,
                near: centroid,
            };
            outputs.lane.send(LaneEstimate { lane: Some(lane), quality: 1.0, threshold: Some(190) });
            if outputs.debug.wanted() {
                outputs.debug.send(image.value().as_ref().clone());
            }
        }
        Ok(())
    }

    fn snapshot(&self) -> Self {
        self.clone()
    }

    fn restore(&mut self, state: Self) -> Result<(), StateError> {
        *self = state;
        Ok(())
    }
}

inputs! {
    pub struct SectorsInputs {
        /// Scans.
        scan: LaserScan,
    }
}

outputs! {
    pub struct SectorsOutputs {
        /// Sectors.
        sectors: Sectors,
    }
}

pub struct LidarSectors;

impl Operator for LidarSectors {
    const KIND: &'static str = "lidar-sectors";
    const SUMMARY: &'static str = "Nearest return per sector";
    type Config = Nothing;
    type Inputs = SectorsInputs;
    type Outputs = SectorsOutputs;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(
        &mut self,
        inputs: &mut SectorsInputs,
        outputs: &mut SectorsOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(scan) = inputs.scan.take() {
            let nearest_m = scan.ranges_m.iter().copied().reduce(f32::min);
            let sector = Sector {
                name: "front".into(),
                from_rad: -0.2,
                to_rad: 0.2,
                nearest_m,
                nearest_bearing_rad: None,
                returns_within: 0,
                occupied: false,
                coverage: 1.0,
            };
            outputs.sectors.send(Sectors { sectors: vec![sector] });
        }
        Ok(())
    }

    stateless!();
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DecisionConfig {
    pub auto_start: bool,
    pub gains: Gains,
}

#[derive(Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Gains {
    pub angle: f64,
    pub distance_rad_px: f64,
}

impl Default for Gains {
    fn default() -> Self {
        Self { angle: 0.9, distance_rad_px: 0.005 }
    }
}

impl OperatorConfig for DecisionConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("gains.angle", self.gains.angle, 0.0, 10.0, "");
        findings.range("gains.distance_rad_px", self.gains.distance_rad_px, 0.0, 1.0, "rad/px");
    }
}

inputs! {
    pub struct DecisionInputs {
        /// The lane.
        lane: LaneEstimate,
        /// What lies around.
        sectors: Sectors [hold optional],
        /// What a person wants.
        goal: Goal [external],
    }
}

outputs! {
    pub struct DecisionOutputs {
        /// Set points.
        command: Command,
        /// The state.
        state: DecisionState,
    }
}

pub struct Decision {
    driving: bool,
    stopped: bool,
    transitions: u64,
}

impl Operator for Decision {
    const KIND: &'static str = "decision";
    const SUMMARY: &'static str = "Decides what the car does";
    const STAYS_ON_CAR: bool = true;
    type Config = DecisionConfig;
    type Inputs = DecisionInputs;
    type Outputs = DecisionOutputs;

    fn new(config: DecisionConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { driving: config.auto_start, stopped: false, transitions: 0 })
    }

    fn control(&mut self, control: Control, _now: Stamp) {
        self.transitions += 1;
        match control {
            Control::Start => self.driving = !self.stopped,
            Control::Stop => self.driving = false,
            Control::EStop => (self.driving, self.stopped) = (false, true),
            Control::Reset => self.stopped = false,
        }
    }

    fn step(
        &mut self,
        inputs: &mut DecisionInputs,
        outputs: &mut DecisionOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let lane = inputs.lane.latest().and_then(|estimate| estimate.lane);
        let nearest_m = inputs.sectors.latest().and_then(|sectors| sectors.get("front")?.nearest_m).unwrap_or(0.0);
        let steering_rad = lane.map_or(0.0, |lane| lane.angle_rad) + nearest_m * 1e-6;
        let speed_m_s = if self.driving { 0.5 } else { 0.0 };
        outputs.command.send(Command { steering_rad, speed_m_s });
        let state = if self.stopped { DriveState::EStop } else { DriveState::LaneFollow };
        outputs.state.send(DecisionState {
            state,
            since: context.now(),
            reason: String::new(),
            target_speed_m_s: speed_m_s,
            steering_rad,
            transitions: self.transitions,
        });
        Ok(())
    }

    stateless!();
}

inputs! {
    pub struct CommandInputs {
        /// Set points.
        command: Command,
    }
}

outputs! {
    pub struct CommandOutputs {
        /// Limited set points.
        command: Command,
    }
}

pub struct Actuator;

impl Operator for Actuator {
    const KIND: &'static str = "actuator";
    const SUMMARY: &'static str = "Limits commands";
    const STAYS_ON_CAR: bool = true;
    type Config = Nothing;
    type Inputs = CommandInputs;
    type Outputs = CommandOutputs;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn period(_config: &Nothing) -> Option<Duration> {
        Some(Duration::from_millis(10))
    }

    fn step(
        &mut self,
        inputs: &mut CommandInputs,
        outputs: &mut CommandOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        let command = inputs.command.latest().map(|command| **command.value()).unwrap_or_default();
        outputs.command.send(Command { steering_rad: command.steering_rad.clamp(-0.349, 0.349), ..command });
        Ok(())
    }

    stateless!();
}

#[derive(Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct McuLinkConfig {
    pub port: String,
    pub lease_ms: u32,
}

impl Default for McuLinkConfig {
    fn default() -> Self {
        Self { port: "sim:mcu".into(), lease_ms: 200 }
    }
}

impl OperatorConfig for McuLinkConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("lease_ms", f64::from(self.lease_ms), 20.0, 1000.0, "ms");
        if !self.port.starts_with("sim:") {
            findings.device("port", &self.port);
        }
    }
}

pub struct McuLink {
    line: Option<carril_runtime::lines::MemoryLine>,
}

impl Operator for McuLink {
    const KIND: &'static str = "mcu-link";
    const SUMMARY: &'static str = "The serial line to the microcontroller";
    const STAYS_ON_CAR: bool = true;
    type Config = McuLinkConfig;
    type Inputs = CommandInputs;
    type Outputs = NoOutputs;

    fn new(config: McuLinkConfig, setup: &Setup) -> Result<Self, SetupError> {
        let name = config.port.strip_prefix("sim:").unwrap_or(&config.port);
        let lines = setup.memory_lines.as_ref();
        let line = lines.map(|lines| lines.open(name, carril_runtime::lines::End::Host, setup.waker.clone()));
        Ok(Self { line })
    }

    fn step(
        &mut self,
        inputs: &mut CommandInputs,
        _outputs: &mut NoOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        if let (Some(line), Some(command)) = (&self.line, inputs.command.latest()) {
            line.write(&((command.steering_rad * 1e4) as i16).to_le_bytes());
        }
        Ok(())
    }

    stateless!();
}

inputs! {
    pub struct SimMcuInputs {
        /// What it senses.
        sensors: McuSensors [hold],
    }
}

outputs! {
    pub struct SimMcuOutputs {
        /// What it drives.
        pins: McuPins,
    }
}

#[derive(Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimMcuConfig {
    pub line: String,
}

impl Default for SimMcuConfig {
    fn default() -> Self {
        Self { line: "mcu".into() }
    }
}

impl OperatorConfig for SimMcuConfig {
    fn check(&self, _findings: &mut Findings<'_>) {}
}

pub struct SimMcu {
    line: Option<carril_runtime::lines::MemoryLine>,
    buffer: Vec<u8>,
}

impl Operator for SimMcu {
    const KIND: &'static str = "sim-mcu";
    const SUMMARY: &'static str = "A model of the microcontroller";
    const STAYS_ON_CAR: bool = true;
    type Config = SimMcuConfig;
    type Inputs = SimMcuInputs;
    type Outputs = SimMcuOutputs;

    fn new(config: SimMcuConfig, setup: &Setup) -> Result<Self, SetupError> {
        let lines = setup.memory_lines.as_ref();
        let line = lines.map(|lines| lines.open(&config.line, carril_runtime::lines::End::Device, setup.waker.clone()));
        Ok(Self { line, buffer: Vec::new() })
    }

    fn step(
        &mut self,
        inputs: &mut SimMcuInputs,
        outputs: &mut SimMcuOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        let _ = inputs.sensors.latest();
        if let Some(line) = &self.line {
            line.read_into(&mut self.buffer);
        }
        if let [.., low, high] = self.buffer[..] {
            let steering = i16::from_le_bytes([low, high]);
            let servo_us = Some((1500 + steering / 10) as u16);
            outputs.pins.send(McuPins { servo_us, motor_duty: 0.2, brake: false });
        }
        self.buffer.clear();
        Ok(())
    }

    stateless!();
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    pub source: String,
}

impl OperatorConfig for CameraConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        if self.source.starts_with("/dev/") {
            findings.device("source", &self.source);
        } else {
            findings.file("source", &self.source);
        }
    }
}

outputs! {
    pub struct CameraOutputs {
        /// Frames.
        image: Image,
    }
}

pub struct Camera;

impl Operator for Camera {
    const KIND: &'static str = "camera";
    const SUMMARY: &'static str = "Frames from a device or file";
    type Config = CameraConfig;
    type Inputs = NoInputs;
    type Outputs = CameraOutputs;

    fn new(_config: CameraConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(
        &mut self,
        _inputs: &mut NoInputs,
        _outputs: &mut CameraOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        Ok(())
    }

    stateless!();
}

inputs! {
    pub struct ClashInputs {
        /// From outside.
        goal: Goal [external],
    }
}

outputs! {
    pub struct ClashOutputs {
        /// Has the name, and so the key, of the input.
        goal: Goal,
    }
}

/// An operator whose ports come to the same key.
pub struct Clash;

impl Operator for Clash {
    const KIND: &'static str = "clash";
    const SUMMARY: &'static str = "Has two ports with one key";
    type Config = Nothing;
    type Inputs = ClashInputs;
    type Outputs = ClashOutputs;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(
        &mut self,
        _inputs: &mut ClashInputs,
        _outputs: &mut ClashOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        Ok(())
    }

    stateless!();
}
