//! What one instance of a node hands over to its successor, so that nothing is lost and nothing comes twice: state, sequence
//! numbers, what its inputs hold, and how far it has come in each. In the wire form, as the successor may live in another
//! process and be another program.

use carril_messages::{CodecError, Header, Payload, Stamp};
use serde::{Deserialize, Serialize};

use crate::operator::Trigger;
use crate::ports::Incoming;
use crate::positions::Positions;
use crate::transport::{Wire, receive};

/// Everything that a successor needs.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Handover {
    /// Version and bytes of the operator's state. `None`: it begins afresh.
    pub state: Option<(u32, Vec<u8>)>,
    /// Life of the node: goes on.
    pub epoch: u64,
    /// Next sequence number of each output port, by name.
    pub next_seq: Vec<(String, u64)>,
    /// The inputs, by name.
    pub inputs: Vec<HandedInput>,
    /// When the next period begins.
    pub next_period: Option<Stamp>,
}

/// An input that is handed over.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct HandedInput {
    /// The port.
    pub port: String,
    /// What the operator was given.
    pub consumed: Positions,
    /// What has arrived; later samples are the successor's own affair.
    pub received: Positions,
    /// The newest sample that the operator has read.
    pub read: Option<WireSample>,
    /// Samples that wait, the oldest first.
    pub waiting: Vec<WireSample>,
}

/// A sample in its wire form.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireSample {
    header: Vec<u8>,
    payload: Vec<u8>,
}

impl WireSample {
    /// Encodes a sample.
    pub fn of(incoming: &Incoming) -> Result<Self, CodecError> {
        match incoming {
            Incoming::Local(header, message) => {
                let wire = Wire::of(header, message.as_ref())?;
                Ok(Self { header: wire.header, payload: wire.payload.to_vec() })
            }
            Incoming::Wire(header, payload) => Ok(Self { header: header.encode()?, payload: payload.to_vec() }),
        }
    }

    /// Reads it back.
    pub fn read(self) -> Result<Incoming, CodecError> {
        receive(&self.header, Payload::from(self.payload))
    }

    /// Life of its writer, and its sequence number.
    pub fn identity(&self) -> Result<(u64, u64), CodecError> {
        let header = Header::decode(&self.header)?;
        Ok((header.epoch, header.seq))
    }
}

impl Handover {
    /// Bytes of state.
    pub fn state_bytes(&self) -> Option<u64> {
        self.state.as_ref().map(|(_, state)| state.len() as u64)
    }

    /// Samples that wait.
    pub fn queued(&self) -> u64 {
        self.inputs.iter().map(|input| input.waiting.len() as u64).sum()
    }
}

/// A step that an instance on probation has made. Its predecessor, kept warm, makes the same step after it, so that it can take
/// over again at any time, exactly there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StepRecord {
    /// Counts the steps since the take-over, from 0.
    pub number: u64,
    /// The time of the step.
    pub now: Stamp,
    /// Why it ran.
    pub trigger: Trigger,
    /// How far it has come in each input, by name.
    pub consumed: Vec<(String, Positions)>,
    /// Next sequence number of each output port after the step, by name.
    pub next_seq: Vec<(String, u64)>,
}
