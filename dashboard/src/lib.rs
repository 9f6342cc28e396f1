//! What a running car shows beyond its own machine, and to whom: the gateway, keys, the dashboard in the browser, Foxglove; and the link of
//! machines that run nodes of its graph.

pub mod access;
pub mod foxglove;
pub mod gateway;
pub mod machine;
pub mod pictures;
pub mod server;
