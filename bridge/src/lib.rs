//! Host side of the microcontroller link.
