//! The runtime of carril: reads and checks a graph file, hosts operators, and runs them live over Zenoh or in lockstep.
//!
//! An operator (see [`Operator`]) is pure: inputs and a time in, outputs out. Everything that touches the world (processes,
//! Zenoh, clocks, priorities) stands behind it and is the same for every operator.

pub mod backoff;
#[cfg(feature = "live")]
pub mod client;
pub mod clock;
pub mod config;
pub mod control_plane;
pub mod describe;
pub mod executor;
pub mod graph;
pub mod handover;
mod intern;
pub mod lines;
#[cfg(feature = "live")]
mod log;
pub mod machines;
pub mod mailbox;
pub mod node;
pub mod numbers;
mod operator;
pub mod parameters;
mod ports;
pub mod positions;
#[cfg(feature = "live")]
pub mod process;
#[cfg(feature = "live")]
pub mod realtime;
mod registry;
pub mod scenario;
#[cfg(feature = "live")]
pub mod seats;
mod setup;
#[cfg(feature = "live")]
pub mod shadow;
#[cfg(feature = "live")]
pub mod supervisor;
#[cfg(feature = "live")]
mod tap;
pub mod transport;

pub use carril_messages as messages;
pub use config::{Findings, OperatorConfig};
pub use operator::{Context, NoState, Operator, SetupError, StateError, StepError, Trigger};
pub use ports::{
    AnyInput, AnyMessage, AnyOutput, Held, Incoming, Input, InputPorts, InputSpec, NoInputs, NoOutputs, Outgoing,
    Output, OutputPorts, OutputSpec, Provenance, Sample,
};
pub use registry::{ErasedOperator, OperatorKind, Registry};
pub use setup::{BufferPool, HeapPool, Setup, Waker};
