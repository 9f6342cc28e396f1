//! Operators for tests of the swap: a source that counts, and one that keeps a tally and fails when told.

#![allow(dead_code, missing_docs, reason = "shared by several test programs, each of which uses a part")]

use std::io::Write as _;
use std::time::Duration;

use carril_messages::{Command, Control, codec};
use carril_runtime::{
    Context, Findings, Input, NoInputs, NoState, Operator, OperatorConfig, Output, Registry, Setup, SetupError,
    StateError, StepError, inputs, outputs,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub fn registry() -> Registry {
    Registry::new().with::<Ticker>().with::<Tally>().with::<TallyTwo>().with::<Stranger>().with::<Device>()
}

/// Of a program that is named like one of these operators: only that one.
pub fn registry_of_program() -> Option<Registry> {
    let program = std::env::current_exe().ok()?;
    match program.file_stem()?.to_str()? {
        "tally" => Some(Registry::new().with::<Tally>()),
        "tally-two" => Some(Registry::new().with::<TallyTwo>()),
        "ticker" => Some(Registry::new().with::<Ticker>()),
        "device" => Some(Registry::new().with::<Device>()),
        _ => None,
    }
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TickerConfig {
    /// Between two numbers, ms.
    period_ms: Option<u64>,
}

impl OperatorConfig for TickerConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.require(self.period_ms != Some(0), "period_ms", || "got 0, allowed is 1 and more".into());
    }
}

outputs! {
    pub struct Numbers {
        /// The number, as the speed.
        number: Command,
    }
}

/// Counts in steady time.
pub struct Ticker(u32);

impl Operator for Ticker {
    const KIND: &'static str = "ticker";
    const SUMMARY: &'static str = "Counts";
    type Config = TickerConfig;
    type Inputs = NoInputs;
    type Outputs = Numbers;
    type State = u32;

    fn new(_config: TickerConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self(0))
    }

    fn period(config: &TickerConfig) -> Option<Duration> {
        Some(Duration::from_millis(config.period_ms.unwrap_or(1)))
    }

    fn step(&mut self, _: &mut NoInputs, outputs: &mut Numbers, _: &Context<'_>) -> Result<(), StepError> {
        outputs.number.send(number(self.0));
        self.0 += 1;
        Ok(())
    }

    fn snapshot(&self) -> u32 {
        self.0
    }

    fn restore(&mut self, state: u32) -> Result<(), StateError> {
        self.0 = state;
        Ok(())
    }
}

fn number(value: u32) -> Command {
    Command { speed_m_s: value as f32, steering_rad: 0.0 }
}

/// How a tally fails.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    #[default]
    None,
    Panic,
    Error,
    Stall,
    Garbage,
    Exit,
    Grow,
}

#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TallyConfig {
    /// Added to what it shows.
    offset: f32,
    fault: Fault,
    /// After so many numbers.
    after: u32,
    /// Cannot be built.
    unbuildable: bool,
    /// Takes over no state.
    refuse_state: bool,
}

impl Default for TallyConfig {
    fn default() -> Self {
        Self { offset: 0.0, fault: Fault::None, after: 0, unbuildable: false, refuse_state: false }
    }
}

impl OperatorConfig for TallyConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("offset", f64::from(self.offset), -1000.0, 1000.0, "");
    }
}

inputs! {
    pub struct TallyInputs {
        /// What is counted.
        number: Command,
    }
}

outputs! {
    pub struct TallyOutputs {
        /// The number as the speed, how many there were as the steering angle.
        tally: Command,
        /// The words that it heard.
        word: Control,
    }
}

/// Counts what comes.
pub struct Tally {
    config: TallyConfig,
    count: u32,
    own: u32,
    heard: Vec<Control>,
    hoard: Vec<Vec<u8>>,
}

impl Tally {
    fn take(&mut self, numbers: &mut Input<Command>, tallies: &mut Output<Command>) -> Result<(), StepError> {
        while let Some(number) = numbers.take() {
            self.own += 1;
            if self.own > self.config.after {
                self.fail()?;
            }
            self.count += 1;
            let garbage = self.config.fault == Fault::Garbage && self.own > self.config.after;
            let speed_m_s = if garbage { f32::NAN } else { number.speed_m_s + self.config.offset };
            tallies.send(Command { speed_m_s, steering_rad: self.count as f32 });
        }
        Ok(())
    }

    fn fail(&mut self) -> Result<(), StepError> {
        match self.config.fault {
            Fault::None | Fault::Garbage => {}
            Fault::Panic => panic!("told to panic"),
            Fault::Error => return Err(StepError::new("told to fail")),
            Fault::Stall => std::thread::sleep(Duration::from_secs(3)),
            Fault::Exit => std::process::exit(7),
            Fault::Grow => self.hoard.push(vec![1; 1 << 20]),
        }
        Ok(())
    }
}

impl Operator for Tally {
    const KIND: &'static str = "tally";
    const SUMMARY: &'static str = "Counts what comes";
    type Config = TallyConfig;
    type Inputs = TallyInputs;
    type Outputs = TallyOutputs;
    type State = u32;

    fn new(config: TallyConfig, _setup: &Setup) -> Result<Self, SetupError> {
        if config.unbuildable {
            return Err(SetupError::new("told not to be built"));
        }
        Ok(Self { config, count: 0, own: 0, heard: Vec::new(), hoard: Vec::new() })
    }

    fn step(&mut self, inputs: &mut TallyInputs, outputs: &mut TallyOutputs, _: &Context<'_>) -> Result<(), StepError> {
        self.heard.drain(..).for_each(|word| outputs.word.send(word));
        self.take(&mut inputs.number, &mut outputs.tally)
    }

    fn control(&mut self, control: Control, _now: carril_messages::Stamp) {
        self.heard.push(control);
    }

    fn snapshot(&self) -> u32 {
        self.count
    }

    fn restore(&mut self, state: u32) -> Result<(), StateError> {
        if self.config.refuse_state {
            return Err(StateError::new("told to refuse"));
        }
        self.count = state;
        Ok(())
    }
}

/// The same with a state of another version.
pub struct TallyTwo(Tally);

impl Operator for TallyTwo {
    const KIND: &'static str = "tally-two";
    const SUMMARY: &'static str = "Counts what comes, with another state";
    const STATE_NAME: &'static str = Tally::KIND;
    const STATE_VERSION: u32 = 2;
    type Config = TallyConfig;
    type Inputs = TallyInputs;
    type Outputs = TallyOutputs;
    type State = (u32, String);

    fn new(config: TallyConfig, setup: &Setup) -> Result<Self, SetupError> {
        Tally::new(config, setup).map(Self)
    }

    fn step(
        &mut self,
        inputs: &mut TallyInputs,
        outputs: &mut TallyOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        self.0.step(inputs, outputs, context)
    }

    fn snapshot(&self) -> (u32, String) {
        (self.0.count, "two".into())
    }

    fn restore(&mut self, state: (u32, String)) -> Result<(), StateError> {
        self.0.count = state.0;
        Ok(())
    }

    fn migrate(version: u32, state: &[u8]) -> Result<(u32, String), StateError> {
        match version {
            1 => Ok((codec::decode(state).map_err(StateError::new)?, "one".into())),
            other => Err(StateError::new(format!("version {other} is not known"))),
        }
    }
}

inputs! {
    pub struct StrangerInputs {
        /// Another type.
        number: Control,
    }
}

/// Has other ports.
pub struct Stranger;

impl Operator for Stranger {
    const KIND: &'static str = "stranger";
    const SUMMARY: &'static str = "Has other ports";
    type Config = TickerConfig;
    type Inputs = StrangerInputs;
    type Outputs = Numbers;
    type State = NoState;

    fn new(_config: TickerConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, _: &mut StrangerInputs, _: &mut Numbers, _: &Context<'_>) -> Result<(), StepError> {
        Ok(())
    }

    fn snapshot(&self) -> NoState {
        NoState
    }

    fn restore(&mut self, _state: NoState) -> Result<(), StateError> {
        Ok(())
    }
}

#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceConfig {
    /// Stands for the device: only one instance can have this file.
    lock: String,
    /// Written at each opening and each end of one: what the device has gone through.
    journal: Option<std::path::PathBuf>,
    /// Panics on its so-many-th number.
    panic_at: Option<u32>,
    /// It cannot be opened.
    broken: bool,
    /// It cannot be opened, and each step says so: as a driver that tries again and again on its own thread.
    dark: bool,
}

impl DeviceConfig {
    /// The file takes lines of several processes.
    fn note(&self, what: &str) {
        let Some(path) = &self.journal else { return };
        let file = std::fs::OpenOptions::new().create(true).append(true).open(path);
        file.and_then(|mut file| file.write_all(format!("{what}\n").as_bytes())).expect("the journal is writable");
    }
}

impl OperatorConfig for DeviceConfig {
    fn check(&self, _findings: &mut Findings<'_>) {}
}

/// Counts, and holds a device.
pub struct Device {
    config: DeviceConfig,
    count: u32,
    own: u32,
}

impl Operator for Device {
    const KIND: &'static str = "device";
    const SUMMARY: &'static str = "Holds a device";
    type Config = DeviceConfig;
    type Inputs = NoInputs;
    type Outputs = Numbers;
    type State = u32;

    fn new(config: DeviceConfig, _setup: &Setup) -> Result<Self, SetupError> {
        if config.broken {
            return Err(SetupError::new("the device cannot be opened"));
        }
        let taken = std::fs::OpenOptions::new().write(true).create_new(true).open(&config.lock);
        if let Err(error) = taken {
            config.note("taken");
            return Err(SetupError::new(format!("`{}` is taken: {error}", config.lock)));
        }
        config.note("opened");
        Ok(Self { config, count: 0, own: 0 })
    }

    fn period(_config: &DeviceConfig) -> Option<Duration> {
        Some(Duration::from_millis(5))
    }

    fn step(&mut self, _: &mut NoInputs, outputs: &mut Numbers, _: &Context<'_>) -> Result<(), StepError> {
        if self.config.dark {
            return Err(StepError::new("the device cannot be opened; tries again"));
        }
        self.own += 1;
        assert!(self.config.panic_at != Some(self.own), "told to panic");
        outputs.number.send(number(self.count));
        self.count += 1;
        Ok(())
    }

    fn snapshot(&self) -> u32 {
        self.count
    }

    fn restore(&mut self, state: u32) -> Result<(), StateError> {
        self.count = state;
        Ok(())
    }

    fn exclusive(_config: &DeviceConfig) -> bool {
        true
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // First the note: once the lock is gone the next may open.
        self.config.note("closed");
        let _ = std::fs::remove_file(&self.config.lock);
    }
}
