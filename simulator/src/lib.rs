//! Vehicle, world and sensors that take the place of the hardware.
