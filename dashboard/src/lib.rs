//! What a running car shows beyond its own machine: pictures small enough for Wi-Fi, the dashboard in the browser, Foxglove.

pub mod foxglove;
pub mod pictures;
