//! Host side of the microcontroller link.

pub mod codec;
pub mod mcu_model;
mod speed_control;
mod units;
