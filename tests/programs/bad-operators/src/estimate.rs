//! A lane estimate that may be none: on the wire it says that it is one.

use carril_messages::{CodecError, Encoded, LaneEstimate, Message, MessageType, Meta, Payload};

/// What goes out as `carril/LaneEstimate`.
#[derive(Clone, Debug)]
pub enum Estimate {
    /// An estimate, sane or not.
    Lane(LaneEstimate),
    /// Bytes that nobody can decode.
    Bytes(Vec<u8>),
}

impl Message for Estimate {
    const TYPE: MessageType = LaneEstimate::TYPE;

    fn encode(&self) -> Result<Encoded, CodecError> {
        match self {
            Self::Lane(estimate) => estimate.encode(),
            Self::Bytes(bytes) => Ok(Encoded { meta: Meta::new(), payload: Payload::from(bytes.clone()) }),
        }
    }

    fn decode(meta: &[u8], payload: &Payload) -> Result<Self, CodecError> {
        LaneEstimate::decode(meta, payload).map(Self::Lane)
    }
}
