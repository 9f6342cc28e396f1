//! `bad-lane`: a lane detector that misbehaves when told to.

use std::time::Duration;

use carril_messages::{Image, Lane, LaneEstimate};
use carril_operators::lane_detector::{LaneDetectorConfig, Scratch, detect};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StateError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::estimate::Estimate;

/// How it misbehaves; by default not at all. Frames are counted from 1, by each instance anew, from the last state on that it took.
/// While it is swapped in it says on standard error how far it has come, for tests that want to strike just then.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[allow(clippy::struct_excessive_bools, reason = "each is a switch of its own")]
pub struct BadLaneConfig {
    /// Its own check finds this configuration wrong.
    pub refuse_config: bool,
    /// The program dies when it is asked about this configuration.
    pub die_at_check: bool,
    /// The program is ended by SIGABRT while it is built.
    pub crash_at_start: bool,
    /// It says that it cannot be built.
    pub refuse_setup: bool,
    /// It refuses every state.
    pub refuse_state: bool,
    /// Behaves until it has taken so many states: 1 is that of the shadow, 2 that of the hand-over.
    pub after_states: u32,
    /// To build it takes so much longer, ms, 0 to 10000.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub build_ms: f64,
    /// To take the state of the hand-over takes so much longer, ms, 0 to 10000.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub take_over_ms: f64,
    /// Panics at this frame.
    pub panic_at: Option<u64>,
    /// Fails, without a panic, at each frame from this one on.
    pub fail_from: Option<u64>,
    /// At this frame it begins a step that does not end.
    pub stall_at: Option<u64>,
    /// Each step takes so much longer, ms, 0 to 10000.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub slow_ms: f64,
    /// Keeps so much more memory with each frame, MB, 0 to 100.
    #[schemars(range(min = 0, max = 100), extend("unit" = "MB"))]
    pub grow_mb: f64,
    /// From this frame on it sends bytes that are no estimate.
    pub garbage_from: Option<u64>,
    /// From this frame on its estimates are absurd: a lane behind the horizon, no number for an angle, a quality of 7.
    pub absurd_from: Option<u64>,
    /// From this frame on it sends nothing.
    pub silent_from: Option<u64>,
}

impl OperatorConfig for BadLaneConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        assert!(!self.die_at_check, "told to die at the check");
        findings.require(!self.refuse_config, "refuse_config", || "got true, allowed is false".to_owned());
        findings.range("build_ms", self.build_ms, 0.0, 10_000.0, "ms");
        findings.range("take_over_ms", self.take_over_ms, 0.0, 10_000.0, "ms");
        findings.range("slow_ms", self.slow_ms, 0.0, 10_000.0, "ms");
        findings.range("grow_mb", self.grow_mb, 0.0, 100.0, "MB");
    }
}

carril_runtime::inputs! {
    /// What it reads.
    pub struct BadLaneInputs {
        /// Camera frames, any size and encoding.
        image: Image,
    }
}

carril_runtime::outputs! {
    /// What it gives.
    pub struct BadLaneOutputs {
        /// The lane, one estimate per frame.
        lane: Estimate,
        /// Never sent; there so that the ports are those of `lane-detector`.
        debug: Image [on_demand],
    }
}

/// What a successor takes over.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BadLaneState {
    frames: u64,
}

/// Misbehaves when told to.
pub struct BadLane {
    config: BadLaneConfig,
    state: BadLaneState,
    /// States taken.
    states: u32,
    /// Frames since the last state.
    own_frames: u64,
    scratch: Scratch,
    hoard: Vec<Vec<u8>>,
}

impl Operator for BadLane {
    const KIND: &'static str = "bad-lane";
    const SUMMARY: &'static str = "a lane detector that misbehaves when told to";

    type Config = BadLaneConfig;
    type Inputs = BadLaneInputs;
    type Outputs = BadLaneOutputs;
    type State = BadLaneState;

    fn new(config: BadLaneConfig, _setup: &Setup) -> Result<Self, SetupError> {
        say("is being built");
        pause(config.build_ms);
        if config.crash_at_start {
            std::process::abort();
        }
        if config.refuse_setup {
            return Err(SetupError::new("told to refuse"));
        }
        let (state, scratch) = (BadLaneState::default(), Scratch::default());
        Ok(Self { config, state, states: 0, own_frames: 0, scratch, hoard: Vec::new() })
    }

    fn step(
        &mut self,
        inputs: &mut BadLaneInputs,
        outputs: &mut BadLaneOutputs,
        _context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(image) = inputs.image.take() {
            self.state.frames += 1;
            self.own_frames += 1;
            let frame = self.own_frames;
            if frame == 1 && self.states > 0 {
                say(&format!("steps with state {}", self.states));
            }
            if self.states < self.config.after_states {
                outputs.lane.send(Estimate::Lane(self.detect(&image)));
                continue;
            }
            self.misbehave(frame)?;
            if self.config.silent_from.is_none_or(|from| frame < from) {
                outputs.lane.send(self.estimate(&image, frame));
            }
        }
        Ok(())
    }

    fn snapshot(&self) -> BadLaneState {
        self.state.clone()
    }

    fn restore(&mut self, state: BadLaneState) -> Result<(), StateError> {
        if self.config.refuse_state {
            return Err(StateError::new("told to refuse the state"));
        }
        self.states += 1;
        self.own_frames = 0;
        say(&format!("takes state {}", self.states));
        if self.states == 2 {
            pause(self.config.take_over_ms);
        }
        self.state = state;
        Ok(())
    }
}

fn say(what: &str) {
    eprintln!("bad-lane {what}");
}

fn pause(ms: f64) {
    std::thread::sleep(Duration::from_secs_f64(ms / 1e3));
}

impl BadLane {
    fn detect(&mut self, image: &Image) -> LaneEstimate {
        detect(image, &LaneDetectorConfig::default(), &mut self.scratch)
    }

    fn misbehave(&mut self, frame: u64) -> Result<(), StepError> {
        let config = &self.config;
        assert!(config.panic_at != Some(frame), "told to panic at frame {frame}");
        if config.stall_at == Some(frame) {
            loop {
                std::thread::sleep(Duration::from_secs(3600));
            }
        }
        if config.fail_from.is_some_and(|from| frame >= from) {
            return Err(StepError::new(format!("told to fail at frame {frame}")));
        }
        pause(config.slow_ms);
        if config.grow_mb > 0.0 {
            // Not zeros: those would cost no memory before they are written.
            self.hoard.push(vec![1; (config.grow_mb * 1e6) as usize]);
        }
        Ok(())
    }

    fn estimate(&mut self, image: &Image, frame: u64) -> Estimate {
        let from = |begin: Option<u64>| begin.is_some_and(|begin| frame >= begin);
        if from(self.config.garbage_from) {
            return Estimate::Bytes(vec![0xff; 64]);
        }
        let estimate = self.detect(image);
        match estimate.lane {
            Some(lane) if from(self.config.absurd_from) => {
                let lane = Lane { angle_rad: f32::NAN, distance_px: 1e30, ..lane };
                Estimate::Lane(LaneEstimate { lane: Some(lane), quality: 7.0, threshold: None })
            }
            _ => Estimate::Lane(estimate),
        }
    }
}
