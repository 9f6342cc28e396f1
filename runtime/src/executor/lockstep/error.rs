//! Why a graph cannot run in lockstep, or stopped doing so.

use std::any::Any;

use carril_messages::{CodecError, Stamp};
use thiserror::Error;

use crate::executor::build::BuildError;

/// So many steps may happen at one moment of virtual time; more means that nodes wake each other for ever.
pub(super) const MAX_STEPS_AT_ONE_TIME: u64 = 1_000_000;

/// Why a graph cannot run in lockstep, or stopped doing so.
#[derive(Clone, Debug, Error)]
pub enum LockstepError {
    /// Binaries of the user's own have no place in one thread of ours.
    #[error(
        "{} run as binaries of their own (`exec:`), and lockstep has one thread; use `carril run`, or make operators of them",
        node_list(nodes)
    )]
    Exec {
        /// The nodes.
        nodes: Vec<String>,
    },
    /// An operator cannot be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// There is no such port.
    #[error("there is no {what} `{node}/{port}`")]
    NoPort {
        /// `input` or `output`.
        what: &'static str,
        /// The node.
        node: String,
        /// The port.
        port: String,
    },
    /// An operator panicked: a bug in it. The run has ended.
    #[error("node `{node}` panicked at {at} of virtual time: {message}")]
    Panicked {
        /// The node.
        node: String,
        /// When.
        at: Stamp,
        /// What the panic said.
        message: String,
    },
    /// Nodes wake each other without end. The run has ended.
    #[error(
        "virtual time stands still at {at}: {MAX_STEPS_AT_ONE_TIME} steps in one moment, the last of node `{node}`"
    )]
    StandsStill {
        /// When.
        at: Stamp,
        /// The node that stepped last.
        node: String,
    },
    /// A message could not be encoded for the hash: a bug in its type. The run has ended.
    #[error("`{key}` sent what cannot be encoded: {source}")]
    Encode {
        /// The output.
        key: String,
        /// Why.
        source: CodecError,
    },
}

fn node_list(nodes: &[String]) -> String {
    nodes.iter().map(|node| format!("`{node}`")).collect::<Vec<_>>().join(", ")
}

/// What a panic said.
pub(super) fn panic_message(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no text".into())
}
