//! The operator: a plain struct with a typed configuration, typed ports and one step function.

use std::time::Duration;

use carril_messages::{Control, PayloadMut, Stamp};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::config::OperatorConfig;
use crate::ports::{InputPorts, OutputPorts};
use crate::setup::{BufferPool, Setup};

/// A node's algorithm. It sees its inputs and the time, and gives outputs; it never asks a clock, starts no thread (drivers
/// excepted) and knows neither Zenoh nor the graph.
pub trait Operator: Sized + Send + 'static {
    /// Name in the graph file: `lane-detector`.
    const KIND: &'static str;
    /// One line on what it does.
    const SUMMARY: &'static str;
    /// Whose state `State` is. An operator that can go on where another kind stopped gives the name of that kind.
    const STATE_NAME: &'static str = Self::KIND;
    /// Raised when `State` changes its layout.
    const STATE_VERSION: u32 = 1;
    /// It has hardware of the car, or is a link of its safety chain: `machine:` cannot place it elsewhere.
    const STAYS_ON_CAR: bool = false;

    /// The configuration.
    type Config: OperatorConfig;
    /// Made by [`inputs!`](crate::inputs!), or [`NoInputs`](crate::NoInputs).
    type Inputs: InputPorts;
    /// Made by [`outputs!`](crate::outputs!), or [`NoOutputs`](crate::NoOutputs).
    type Outputs: OutputPorts;
    /// All that a successor needs to go on where this instance stopped; nothing: [`stateless!`](crate::stateless!).
    type State: Serialize + DeserializeOwned;

    /// Builds it. The configuration has passed its check.
    fn new(config: Self::Config, setup: &Setup) -> Result<Self, SetupError>;

    /// One step. Runs when a triggering input has something, when the period has come, or when woken.
    ///
    /// An error is counted and published; the node goes on with its next step. What was sent before the error still goes out.
    fn step(
        &mut self,
        inputs: &mut Self::Inputs,
        outputs: &mut Self::Outputs,
        context: &Context<'_>,
    ) -> Result<(), StepError>;

    /// How often it steps of its own accord; `None`: only when triggered. `period_ms` in the graph file overrides it.
    fn period(_config: &Self::Config) -> Option<Duration> {
        None
    }

    /// Hears a word from a person. A step with [`Trigger::Control`] follows at once.
    fn control(&mut self, _control: Control, _now: Stamp) {}

    /// The state, for a successor.
    fn snapshot(&self) -> Self::State;

    /// Takes over the state of a predecessor.
    fn restore(&mut self, state: Self::State) -> Result<(), StateError>;

    /// Reads the state of another version, as [`codec`](carril_messages::codec) wrote it. Default: refused.
    fn migrate(version: u32, _state: &[u8]) -> Result<Self::State, StateError> {
        let (kind, own) = (Self::KIND, Self::STATE_VERSION);
        Err(StateError::new(format!("the state has version {version}, `{kind}` takes version {own}")))
    }

    /// Whether an instance with this configuration holds something that no second one can have at the same time: a device, a
    /// serial line. Its successor is built only after it is gone, and runs no shadow.
    fn exclusive(_config: &Self::Config) -> bool {
        false
    }

    /// Goes on with another configuration, between two steps. Default, `None`: only a new instance can, which takes over the
    /// state. Worth it for an operator that holds a device. `Some(Err)`: refused, nothing has changed.
    fn reconfigure(&mut self, _config: &Self::Config) -> Option<Result<(), SetupError>> {
        None
    }
}

/// Stands in the `impl` of an operator that keeps nothing between two steps, in the place of `State`, `snapshot` and `restore`.
/// It is no default of the trait: a state that was forgotten would be lost at each swap, and nothing would say so.
///
/// ```
/// # use carril_runtime::{Context, Findings, NoInputs, NoOutputs, Operator, OperatorConfig, Setup, SetupError, StepError};
/// # #[derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
/// # struct Nothing {}
/// # impl OperatorConfig for Nothing {
/// #     fn check(&self, _: &mut Findings<'_>) {}
/// # }
/// struct Idle;
///
/// impl Operator for Idle {
///     const KIND: &'static str = "idle";
///     const SUMMARY: &'static str = "does nothing";
///     type Config = Nothing;
///     type Inputs = NoInputs;
///     type Outputs = NoOutputs;
///
///     fn new(_: Nothing, _: &Setup) -> Result<Self, SetupError> {
///         Ok(Self)
///     }
///
///     fn step(&mut self, _: &mut NoInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
///         Ok(())
///     }
///
///     carril_runtime::stateless!();
/// }
/// ```
#[macro_export]
macro_rules! stateless {
    () => {
        type State = $crate::NoState;

        fn snapshot(&self) -> $crate::NoState {
            $crate::NoState
        }

        fn restore(&mut self, _state: $crate::NoState) -> Result<(), $crate::StateError> {
            Ok(())
        }
    };
}

/// The state of an operator that has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct NoState;

/// Why a step runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Trigger {
    /// A triggering input has something new.
    Input,
    /// The period has come.
    Period,
    /// A driver's thread or a serial line has something.
    Wake,
    /// A word from a person was heard.
    Control,
}

/// What a step may know besides its inputs.
pub struct Context<'a> {
    now: Stamp,
    trigger: Trigger,
    buffers: &'a dyn BufferPool,
}

impl<'a> Context<'a> {
    /// Made by executors and by tests.
    pub fn new(now: Stamp, trigger: Trigger, buffers: &'a dyn BufferPool) -> Self {
        Self { now, trigger, buffers }
    }

    /// The time of this step, on the car's clock. Constant during the step.
    pub fn now(&self) -> Stamp {
        self.now
    }

    /// Why the step runs.
    pub fn trigger(&self) -> Trigger {
        self.trigger
    }

    /// Memory for a large payload, shared between processes where that helps.
    pub fn buffer(&self, len: usize) -> PayloadMut {
        self.buffers.buffer(len)
    }
}

/// Why an operator could not be built.
#[derive(Clone, Debug, Error)]
#[error("{0}")]
pub struct SetupError(String);

/// Why a step failed.
#[derive(Clone, Debug, Error)]
#[error("{0}")]
pub struct StepError(String);

/// Why an operator refuses the state of its predecessor.
#[derive(Clone, Debug, Error)]
#[error("{0}")]
pub struct StateError(String);

macro_rules! from_text {
    ($($type:ident),*) => {$(
        impl $type {
            /// From any error or text.
            pub fn new(reason: impl std::fmt::Display) -> Self {
                Self(reason.to_string())
            }
        }
    )*};
}
from_text!(SetupError, StepError, StateError);
