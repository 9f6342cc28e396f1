//! What is on serial lines: the host side of the microcontroller link, a lidar ([`rplidar`]), and models of both for simulation. `bridge/protocol.md` is the
//! contract between the two; the firmware speaks the same.
//!
//! Pure: [`calibration`], [`codec`], [`host`], [`stock`], [`mcu_model`]. Touching the machine: `link` (the serial port),
//! [`workbench`] (a chip alone on it), `pty` (the simulated port), [`chip_program`] (a program that plays the chip).

pub mod calibration;
pub mod chip_program;
pub mod codec;
mod conversation;
mod device_line;
pub mod host;
mod link;
mod mcu_link;
pub mod mcu_model;
mod pty;
pub mod rplidar;
mod sim_avr;
mod sim_mcu;
mod speed_control;
pub mod stock;
mod units;
mod watch;
pub mod workbench;

use carril_runtime::Registry;

pub use conversation::LinkState;
pub use mcu_link::{McuLink, McuLinkConfig, McuLinkInputs, McuLinkOutputs, Protocol};
pub use sim_avr::{SimAvr, SimAvrConfig, SimAvrInputs, SimAvrOutputs};
pub use sim_mcu::{SimMcu, SimMcuConfig, SimMcuInputs, SimMcuOutputs};

/// The operators of this crate.
pub fn registry() -> Registry {
    Registry::new()
        .with::<McuLink>()
        .with::<SimMcu>()
        .with::<SimAvr>()
        .with::<rplidar::Rplidar>()
        .with::<rplidar::SimRplidar>()
}
