//! Executors run the nodes of a graph: [`live`] in OS processes on the real clock.

#[cfg(feature = "live")]
pub mod live;
