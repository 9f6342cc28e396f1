//! Host side of the microcontroller link.

pub mod codec;
