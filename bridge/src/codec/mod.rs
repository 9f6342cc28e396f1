//! The language of the serial line, as `bridge/protocol.md` fixes it: bytes in, frames out, and back. Pure: no port, no clock,
//! no thread; a decoder never allocates and no input makes it panic.

mod calibration;
mod decoder;
mod fields;
mod frame;

pub use calibration::{CalibrationState, CalibrationStatus, CalibrationStore, Parameter, ParameterWrite};
pub use decoder::{DamageCounts, Decoder, Direction};
pub use frame::{
    Capabilities, Command, DecodeError, Drive, FULL_DUTY, FirmwareVersion, Frame, FrameKind, HelloAck, LastCommand,
    MAX_LEASE_MS, MAX_RAW_BYTES, MAX_WIRE_BYTES, PROTOCOL_VERSION, Packet, Session, Telemetry, TimeSyncAck, checksum,
    decode_raw, encode, encode_with_version,
};
