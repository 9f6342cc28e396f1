//! The control plane's four words to a car.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A word from a person to every node. It does not travel along edges: each node hears it, and acts on it at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Control {
    /// Drive. Nothing moves before it unless the graph says `auto_start`.
    Start,
    /// Slow down, stop and wait for `start`.
    Stop,
    /// Stop at once and stay stopped until `reset`, then `start`.
    EStop,
    /// Clears latched stops and faults. Nothing moves before `start`.
    Reset,
}

crate::message!(Control, "carril/Control", 1);

impl fmt::Display for Control {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::EStop => "estop",
            Self::Reset => "reset",
        })
    }
}
