//! Host side of the microcontroller link, and a model of the microcontroller for simulation. `bridge/protocol.md` is the
//! contract between the two; the firmware speaks the same.
//!
//! Pure: [`codec`], [`host`], [`stock`], [`mcu_model`]. Touching the machine: `link` (the serial port) and `pty` (the simulated one).

pub mod codec;
mod conversation;
pub mod host;
mod link;
mod mcu_link;
pub mod mcu_model;
mod pty;
mod sim_mcu;
mod speed_control;
pub mod stock;
mod units;
mod watch;

use carril_runtime::Registry;

pub use conversation::LinkState;
pub use mcu_link::{McuLink, McuLinkConfig, McuLinkInputs, McuLinkOutputs, Protocol};
pub use sim_mcu::{SimMcu, SimMcuConfig, SimMcuInputs, SimMcuOutputs};

/// The operators of this crate.
pub fn registry() -> Registry {
    Registry::new().with::<McuLink>().with::<SimMcu>()
}
