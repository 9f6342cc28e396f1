//! What travels between the parts of carril: typed payloads with units, the header that every sample carries,
//! the codec, and the key expressions. Pure data: no I/O, no clock, no thread.
//!
//! Conventions (docs/frames-and-units.md): SI units and radians; REP-103 body frame (x forward, y left, angles
//! counter-clockwise); field names carry the unit; "no data" is a value (`Option`, an age), never 0 or -1.

pub mod car;
pub mod codec;
pub mod dynamic;
pub mod header;
pub mod key;
mod message;
mod payload;
mod time;
pub mod types;

pub use codec::CodecError;
pub use header::{Header, Origin, Origins, SourceId};
pub use key::Key;
pub use message::{Encoded, Message, MessageType, Meta, encode_structured};
pub use payload::{Payload, PayloadMut, Writable};
pub use time::{Stamp, Timespan};
pub use types::*;
