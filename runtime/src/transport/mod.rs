//! Carries samples from the outputs of nodes to inputs in other processes. What a node hears from its own process never
//! comes here: it goes straight into the mailbox.
//!
//! Two transports pass one test suite (`tests/transports.rs`): [`memory`] within a program, [`zenoh`] between processes.

#[cfg(feature = "live")]
mod knock;
pub mod memory;
#[cfg(feature = "live")]
pub mod reliable;
#[cfg(feature = "live")]
pub mod zenoh;

use std::any::Any;
use std::sync::Arc;

use carril_messages::{CodecError, Header, Key, MAX_IMAGE_BYTES, MessageType, Payload};
use thiserror::Error;

use crate::ports::{AnyMessage, Incoming};
use crate::setup::BufferPool;

/// Keeps what it stands for: a subscription, a token. Dropping it ends that.
pub type Guard = Box<dyn Any + Send + Sync>;

/// Where samples of a subscription go. Called on the transport's thread: it must return soon.
pub trait Sink: Send + Sync {
    /// A sample has come.
    fn deliver(&self, incoming: Incoming);
    /// Something has come that is no sample for this port.
    fn refuse(&self, reason: String);
}

/// Carries samples.
pub trait Transport: Send + Sync {
    /// Opens an output port. `reliable`: some reader wants every sample, so that the last ones are kept for it.
    fn publish_on(&self, port: &Key, reliable: bool) -> Result<Box<dyn Publisher>, TransportError>;

    /// Reads a port, or an input's own key. `reliable`: gaps are noticed and filled, in order, nothing twice.
    fn subscribe(&self, port: &Key, reliable: bool, sink: Arc<dyn Sink>) -> Result<Guard, TransportError>;

    /// Puts bytes on a port as they are: for `carril pub`, and for tests that put garbage.
    fn put_raw(&self, port: &Key, header: &[u8], payload: Payload) -> Result<(), TransportError>;

    /// Memory for large payloads that travels without a copy.
    fn buffers(&self) -> Arc<dyn BufferPool>;
}

/// An output port, opened for publishing.
pub trait Publisher: Send + Sync {
    /// Whether anybody beyond this process reads the port.
    fn matched(&self) -> bool;

    /// Sends a sample to all readers beyond this process; how many bytes its payload has. Encodes it; call it only when
    /// [`Publisher::matched`].
    fn publish(&self, header: &Header, message: &dyn AnyMessage) -> Result<usize, TransportError>;
}

/// Why a transport could not do its work.
#[derive(Clone, Debug, Error)]
#[non_exhaustive]
pub enum TransportError {
    /// The message could not be encoded.
    #[error(transparent)]
    Codec(#[from] CodecError),
    /// The link itself failed.
    #[error("{doing}: {reason}")]
    Link {
        /// What was being done, with the key or endpoint.
        doing: String,
        /// What the library says.
        reason: String,
    },
    /// Nobody answers.
    #[error("nobody answered on `{key}` within {timeout_ms} ms")]
    NoAnswer {
        /// The key that was asked.
        key: String,
        /// How long.
        timeout_ms: u128,
    },
}

/// A sample in the form that goes over the wire.
pub(crate) struct Wire {
    /// The encoded header.
    pub header: Vec<u8>,
    /// The payload.
    pub payload: Payload,
}

impl Wire {
    pub(crate) fn of(header: &Header, message: &dyn AnyMessage) -> Result<Self, CodecError> {
        let encoded = message.encode()?;
        let bytes = if encoded.meta.is_empty() {
            header.encode()?
        } else {
            Header { meta: encoded.meta, ..header.clone() }.encode()?
        };
        Ok(Self { header: bytes, payload: encoded.payload })
    }
}

/// Reads what came over the wire. The payload is decoded only when the node takes it.
pub(crate) fn receive(header: &[u8], payload: Payload) -> Result<Incoming, CodecError> {
    if payload.len() > MAX_IMAGE_BYTES {
        return Err(CodecError::TooLarge { got: payload.len(), limit: MAX_IMAGE_BYTES });
    }
    let header = Header::decode(header)?;
    Ok(Incoming::Wire(Arc::new(header), payload))
}

/// The error of a sample that has another type than the port.
#[cfg(feature = "live")]
pub(crate) fn expect_type(header: &Header, expected: &MessageType) -> Result<(), CodecError> {
    if header.message_type == *expected {
        return Ok(());
    }
    Err(CodecError::WrongType { got: header.message_type.to_string(), expected: expected.to_string() })
}
