//! What a running car shows beyond its own machine, and to whom: the gateway, keys, the dashboard in the browser, Foxglove.

pub mod access;
pub mod foxglove;
pub mod gateway;
pub mod pictures;
pub mod server;
