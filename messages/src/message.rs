//! The contract of a type that can travel between nodes.

use std::borrow::Cow;
use std::fmt;

use arrayvec::ArrayVec;
use serde::{Deserialize, Serialize};

use crate::codec::{self, CodecError};
use crate::payload::Payload;

/// Small fixed facts that travel in the header beside a raw payload: the size and encoding of an image.
pub type Meta = ArrayVec<u8, 24>;

/// Name and version of a message type. Both must agree between writer and reader.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct MessageType {
    /// `namespace/Name`, at most 64 bytes, for example `carril/LaneEstimate`.
    pub name: Cow<'static, str>,
    /// Raised with each change of the layout on the wire.
    pub version: u16,
}

impl MessageType {
    /// A type known at compile time.
    pub const fn new(name: &'static str, version: u16) -> Self {
        Self { name: Cow::Borrowed(name), version }
    }
}

impl fmt::Display for MessageType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} v{}", self.name, self.version)
    }
}

/// A message in the form that goes over the wire.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoded {
    /// Goes into the header. Empty for structured types.
    pub meta: Meta,
    /// Goes as the payload.
    pub payload: Payload,
}

/// A type that can travel between nodes. Structured types get it from [`message!`](crate::message!).
pub trait Message: Clone + fmt::Debug + Send + Sync + 'static {
    /// Name and version on the wire.
    const TYPE: MessageType;

    /// The wire form.
    fn encode(&self) -> Result<Encoded, CodecError>;

    /// Appends the payload of the wire form to `buffer`, without an allocation when there is room. `false`, and nothing appended,
    /// when the payload is raw bytes that [`encode`](Self::encode) hands out without a copy.
    fn encode_into(&self, _buffer: &mut Vec<u8>) -> Result<bool, CodecError> {
        Ok(false)
    }

    /// Back from the wire form. Never panics, whatever the bytes are.
    fn decode(meta: &[u8], payload: &Payload) -> Result<Self, CodecError>;
}

/// The wire form of a structured type.
pub fn encode_structured<T: Serialize>(value: &T) -> Result<Encoded, CodecError> {
    Ok(Encoded { meta: Meta::new(), payload: Payload::from(codec::encode(value)?) })
}

/// Makes serde types travel: `message!(LaneEstimate, "carril/LaneEstimate", 1);`
#[macro_export]
macro_rules! message {
    ($type:ty, $name:literal, $version:literal) => {
        impl $crate::Message for $type {
            const TYPE: $crate::MessageType = $crate::MessageType::new($name, $version);

            fn encode(&self) -> Result<$crate::Encoded, $crate::CodecError> {
                $crate::encode_structured(self)
            }

            fn encode_into(&self, buffer: &mut Vec<u8>) -> Result<bool, $crate::CodecError> {
                $crate::codec::encode_into(self, buffer)?;
                Ok(true)
            }

            fn decode(_meta: &[u8], payload: &$crate::Payload) -> Result<Self, $crate::CodecError> {
                $crate::codec::decode(payload)
            }
        }
    };
}
