//! The one file that names bincode. Little endian, variable-length integers; a decode allocates at most what the bytes justify.

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

/// No structured message may be larger, B. Images are raw and have a bound of their own.
pub const MAX_STRUCTURED_BYTES: usize = 4 << 20;

/// Why bytes are not the message that they should be.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum CodecError {
    /// The bytes do not spell the type.
    #[error("the bytes are not a valid message: {reason}")]
    Malformed {
        /// What the decoder stumbled over.
        reason: String,
    },
    /// Something stands behind the message.
    #[error("the message ends after {used} of {got} bytes; the rest belongs to no field")]
    TrailingBytes {
        /// Bytes that the message took.
        used: usize,
        /// Bytes that arrived.
        got: usize,
    },
    /// Larger than any message of ours.
    #[error("{got} bytes, but a message has at most {limit}")]
    TooLarge {
        /// Bytes that arrived.
        got: usize,
        /// Bytes that are allowed.
        limit: usize,
    },
    /// The writer speaks another version of the header.
    #[error("header version {got}, expected {expected}; update the older of the two programs")]
    HeaderVersion {
        /// The version that arrived.
        got: u8,
        /// Ours.
        expected: u8,
    },
    /// Another type than the reader's.
    #[error("the sample is a `{got}`, expected `{expected}`")]
    WrongType {
        /// The type that arrived.
        got: String,
        /// The reader's type.
        expected: String,
    },
    /// The value decodes, but breaks a rule of its type.
    #[error("{what}: got {got}, expected {expected}")]
    Invalid {
        /// Which field.
        what: &'static str,
        /// What it holds.
        got: String,
        /// What it may hold.
        expected: String,
    },
}

type Config = bincode::config::Configuration<
    bincode::config::LittleEndian,
    bincode::config::Varint,
    bincode::config::Limit<MAX_STRUCTURED_BYTES>,
>;

const fn config() -> Config {
    bincode::config::standard().with_limit()
}

/// Serialises `value`.
pub fn encode<T: Serialize>(value: &T) -> Result<Vec<u8>, CodecError> {
    bincode::serde::encode_to_vec(value, config()).map_err(|error| CodecError::Malformed { reason: error.to_string() })
}

/// Appends `value` to `buffer`; without an allocation when the buffer has room.
pub fn encode_into<T: Serialize>(value: &T, buffer: &mut Vec<u8>) -> Result<(), CodecError> {
    bincode::serde::encode_into_std_write(value, buffer, config())
        .map(drop)
        .map_err(|error| CodecError::Malformed { reason: error.to_string() })
}

/// Reads a `T` that takes up all of `bytes`.
pub fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CodecError> {
    if bytes.len() > MAX_STRUCTURED_BYTES {
        return Err(CodecError::TooLarge { got: bytes.len(), limit: MAX_STRUCTURED_BYTES });
    }
    let (value, used) = bincode::serde::decode_from_slice(bytes, config())
        .map_err(|error| CodecError::Malformed { reason: error.to_string() })?;
    if used == bytes.len() { Ok(value) } else { Err(CodecError::TrailingBytes { used, got: bytes.len() }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refuses_trailing_bytes() {
        let mut bytes = encode(&7_u32).expect("a number encodes");
        bytes.push(0);
        assert_eq!(decode::<u32>(&bytes), Err(CodecError::TrailingBytes { used: 1, got: 2 }), "one byte too many");
    }

    #[test]
    fn a_forged_length_allocates_nothing() {
        // A vector that claims 2^40 elements in nine bytes.
        let mut bytes = vec![253];
        bytes.extend_from_slice(&(1_u64 << 40).to_le_bytes());
        assert!(decode::<Vec<u64>>(&bytes).is_err(), "the claim is refused before memory is taken");
    }
}
