//! Executors run a checked graph: in lockstep with virtual time, or live. Both build their nodes the same way.

pub mod build;
#[cfg(feature = "live")]
pub mod live;
pub mod lockstep;
