//! Small operators for tests of the live executor and the supervisor.

#![allow(dead_code, missing_docs, reason = "shared by several test programs, each of which uses a part")]

use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use carril_messages::{Command, Control, Goal, Image, Pose, Stamp, VehicleState};
use carril_runtime::{
    Context, Findings, NoInputs, Operator, OperatorConfig, Registry, Setup, SetupError, StepError, Trigger, inputs,
    outputs, stateless,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub fn registry() -> Registry {
    Registry::new().with::<Source>().with::<Follower>().with::<Car>()
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SourceConfig {
    /// Refuses to be built.
    refuse: bool,
}

impl OperatorConfig for SourceConfig {
    fn check(&self, _findings: &mut Findings<'_>) {}
}

outputs! {
    pub struct SourceOutputs {
        /// Speed counts the samples.
        command: Command,
    }
}

/// Counts, 200 times a second.
pub struct Source(u32);

impl Operator for Source {
    const KIND: &'static str = "source";
    const SUMMARY: &'static str = "Counts";
    type Config = SourceConfig;
    type Inputs = NoInputs;
    type Outputs = SourceOutputs;

    fn new(config: SourceConfig, _setup: &Setup) -> Result<Self, SetupError> {
        if config.refuse { Err(SetupError::new("no device here; plug it in")) } else { Ok(Self(0)) }
    }

    fn period(_config: &SourceConfig) -> Option<Duration> {
        Some(Duration::from_millis(5))
    }

    fn step(&mut self, _: &mut NoInputs, outputs: &mut SourceOutputs, _: &Context<'_>) -> Result<(), StepError> {
        outputs.command.send(Command { speed_m_s: self.0 as f32, steering_rad: 0.0 });
        self.0 += 1;
        Ok(())
    }

    stateless!();
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FollowerConfig {
    /// Panics on its so-many-th input.
    panic_at: Option<u32>,
    /// Each step takes so long.
    step_ms: u64,
    /// Its so-many-th step takes until the test releases it.
    hold_at: Option<u32>,
}

/// A step that the test holds: see `hold_at`. One at a time in a program.
pub struct Hold(&'static AtomicU8);

static HOLD: AtomicU8 = AtomicU8::new(0);
const WANTED: u8 = 1;
const AT_WORK: u8 = 2;

impl Hold {
    /// The step will be held.
    pub fn begin() -> Self {
        HOLD.store(WANTED, Ordering::SeqCst);
        Self(&HOLD)
    }

    /// Whether the step has begun.
    pub fn is_at_work(&self) -> bool {
        self.0.load(Ordering::SeqCst) == AT_WORK
    }

    /// Lets the step end.
    pub fn release(self) {
        self.0.store(0, Ordering::SeqCst);
    }

    fn wait() {
        // Where no test holds it, the step goes on.
        let held = HOLD.compare_exchange(WANTED, AT_WORK, Ordering::SeqCst, Ordering::SeqCst).is_ok();
        while held && HOLD.load(Ordering::SeqCst) == AT_WORK {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

impl OperatorConfig for FollowerConfig {
    fn check(&self, _findings: &mut Findings<'_>) {}
}

inputs! {
    pub struct FollowerInputs {
        /// What it follows.
        command: Command [optional],
        /// Anything to look at.
        image: Image [optional],
        /// What people want.
        goal: Goal [external],
    }
}

outputs! {
    pub struct FollowerOutputs {
        /// The same again.
        command: Command,
        /// The words that it hears.
        word: Control,
    }
}

/// Passes on what comes, and says which words it heard.
pub struct Follower {
    config: FollowerConfig,
    inputs_seen: u32,
    heard: Vec<Control>,
}

impl Operator for Follower {
    const KIND: &'static str = "follower";
    const SUMMARY: &'static str = "Passes on what comes";
    type Config = FollowerConfig;
    type Inputs = FollowerInputs;
    type Outputs = FollowerOutputs;

    fn new(config: FollowerConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { config, inputs_seen: 0, heard: Vec::new() })
    }

    fn step(
        &mut self,
        inputs: &mut FollowerInputs,
        outputs: &mut FollowerOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        self.heard.drain(..).for_each(|word| outputs.word.send(word));
        if context.trigger() != Trigger::Input {
            return Ok(());
        }
        self.inputs_seen += 1;
        assert!(self.config.panic_at != Some(self.inputs_seen), "told to panic");
        std::thread::sleep(Duration::from_millis(self.config.step_ms));
        if self.config.hold_at == Some(self.inputs_seen) {
            Hold::wait();
        }
        while let Some(command) = inputs.command.take() {
            outputs.command.send(*command);
        }
        Ok(())
    }

    fn control(&mut self, control: Control, _now: Stamp) {
        self.heard.push(control);
    }

    stateless!();
}

outputs! {
    pub struct CarOutputs {
        /// Its motion.
        state: VehicleState,
    }
}

/// Drives until it is told to stop.
pub struct Car(f32);

impl Operator for Car {
    const KIND: &'static str = "car";
    const SUMMARY: &'static str = "Drives until it is told to stop";
    type Config = SourceConfig;
    type Inputs = NoInputs;
    type Outputs = CarOutputs;

    fn new(_config: SourceConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self(0.5))
    }

    fn period(_config: &SourceConfig) -> Option<Duration> {
        Some(Duration::from_millis(10))
    }

    fn step(&mut self, _: &mut NoInputs, outputs: &mut CarOutputs, _: &Context<'_>) -> Result<(), StepError> {
        let pose_in_map = Pose { x_m: 0.0, y_m: 0.0, yaw_rad: 0.0 };
        outputs.state.send(VehicleState { pose_in_map, speed_m_s: self.0, yaw_rate_rad_s: 0.0, steering_rad: 0.0 });
        Ok(())
    }

    fn control(&mut self, control: Control, _now: Stamp) {
        if matches!(control, Control::Stop | Control::EStop) {
            self.0 = 0.0;
        }
    }

    stateless!();
}
