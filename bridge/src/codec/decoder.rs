//! Finds frames in a stream of bytes. After any damage it is back in step at the next zero; it holds one frame's bytes and no
//! more, and counts what it refuses by kind.

use serde::{Deserialize, Serialize};

use super::frame::{DecodeError, FrameKind, MAX_RAW_BYTES, Packet, decode_raw};

const MAX_STUFFED_BYTES: usize = MAX_RAW_BYTES + 1;

/// Whose frames a decoder hears. Frames of its own side (a line shorted to itself) are refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Direction {
    /// The decoder of the chip.
    FromHost,
    /// The decoder of the host.
    FromChip,
}

/// How many frames were refused, by kind of damage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DamageCounts {
    /// More bytes between two zeros than any frame has.
    pub too_long: u64,
    /// Byte stuffing that does not come out even, or leaves less than any frame has.
    pub stuffing: u64,
    /// Wrong checksum.
    pub checksum: u64,
    /// Intact, but of another version of the protocol.
    pub version: u64,
    /// Intact, but of a kind that this side does not hear.
    pub kind: u64,
    /// Intact, but with fields that are too many, too few or out of range.
    pub fields: u64,
}

impl DamageCounts {
    /// All of them.
    pub const fn total(&self) -> u64 {
        self.too_long + self.stuffing + self.checksum + self.version + self.kind + self.fields
    }

    fn count(&mut self, error: DecodeError) {
        let counter = match error {
            DecodeError::TooLong => &mut self.too_long,
            DecodeError::Stuffing | DecodeError::TooShort { .. } => &mut self.stuffing,
            DecodeError::Checksum { .. } => &mut self.checksum,
            DecodeError::Version { .. } => &mut self.version,
            DecodeError::Kind { .. } => &mut self.kind,
            DecodeError::Length { .. } | DecodeError::Field { .. } => &mut self.fields,
        };
        *counter += 1;
    }
}

/// Turns bytes, in pieces of any size, into frames.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(from = "DecoderState", into = "DecoderState")]
pub struct Decoder {
    direction: Direction,
    bytes: [u8; MAX_STUFFED_BYTES],
    /// Bytes since the last zero; counts on when there are too many of them to keep.
    len: usize,
    frames: u64,
    damage: DamageCounts,
}

/// What a decoder remembers, for whoever goes on in its place.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct DecoderState {
    direction: Direction,
    beginning: Vec<u8>,
    len: usize,
    frames: u64,
    damage: DamageCounts,
}

impl From<Decoder> for DecoderState {
    fn from(decoder: Decoder) -> Self {
        let Decoder { direction, bytes, len, frames, damage } = decoder;
        Self { direction, beginning: bytes[..len.min(bytes.len())].to_vec(), len, frames, damage }
    }
}

impl From<DecoderState> for Decoder {
    fn from(state: DecoderState) -> Self {
        let DecoderState { direction, beginning, len, frames, damage } = state;
        let mut bytes = [0; MAX_STUFFED_BYTES];
        bytes.iter_mut().zip(beginning).for_each(|(slot, byte)| *slot = byte);
        Self { direction, bytes, len, frames, damage }
    }
}

impl Decoder {
    /// Hears frames of one direction.
    pub fn new(direction: Direction) -> Self {
        Self { direction, bytes: [0; MAX_STUFFED_BYTES], len: 0, frames: 0, damage: DamageCounts::default() }
    }

    /// Takes one byte; at the end of a frame, gives it or says what is wrong with it.
    pub fn push(&mut self, byte: u8) -> Option<Result<Packet, DecodeError>> {
        if byte != 0 {
            if let Some(slot) = self.bytes.get_mut(self.len) {
                *slot = byte;
            }
            self.len = self.len.saturating_add(1);
            return None;
        }
        let len = std::mem::take(&mut self.len);
        if len == 0 {
            return None;
        }
        let result = self.decode(len);
        match result {
            Ok(_) => self.frames += 1,
            Err(error) => self.damage.count(error),
        }
        Some(result)
    }

    fn decode(&mut self, len: usize) -> Result<Packet, DecodeError> {
        let stuffed = self.bytes.get_mut(..len).ok_or(DecodeError::TooLong)?;
        let raw_len = cobs::decode_in_place(stuffed).map_err(|_| DecodeError::Stuffing)?;
        let packet = decode_raw(&stuffed[..raw_len])?;
        if packet.frame.kind().is_from_chip() == (self.direction == Direction::FromChip) {
            Ok(packet)
        } else {
            Err(DecodeError::Kind { kind: packet.frame.kind() as u8 })
        }
    }

    /// Forgets the beginning of a frame: the line was cut.
    pub fn restart(&mut self) {
        self.len = 0;
    }

    /// Intact frames so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Refused frames so far.
    pub fn damage(&self) -> DamageCounts {
        self.damage
    }
}

impl DecodeError {
    /// Whether these bytes are a frame of another version that means the same in all versions.
    pub fn is_foreign(&self, kind: FrameKind) -> bool {
        matches!(self, Self::Version { kind: got, .. } if *got == kind as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::super::frame::{Frame, HelloAck, Session, Telemetry, encode, encode_with_version};
    use super::*;
    use crate::codec::{Capabilities, FirmwareVersion};

    fn wire(frame: Frame) -> Vec<u8> {
        let mut bytes = Vec::new();
        encode(&Packet { seq: 7, frame }, &mut bytes);
        bytes
    }

    fn feed(decoder: &mut Decoder, bytes: &[u8]) -> Vec<Result<Packet, DecodeError>> {
        bytes.iter().filter_map(|byte| decoder.push(*byte)).collect()
    }

    #[test]
    fn is_back_in_step_at_the_next_zero() {
        let mut decoder = Decoder::new(Direction::FromHost);
        let good = wire(Frame::EStop);
        let mut bytes = vec![0x55; 10_000];
        bytes.extend(&good);
        bytes.extend(&good[..4]);
        bytes.extend(&good);
        let read = feed(&mut decoder, &bytes);
        assert_eq!(read.iter().filter(|result| result.is_ok()).count(), 2, "both whole frames: {read:?}");
        let damage = decoder.damage();
        assert_eq!((damage.too_long, damage.stuffing, damage.total()), (1, 1, 2), "the flood and the cut: {damage:?}");
    }

    #[test]
    fn counts_each_kind_of_damage() {
        let mut decoder = Decoder::new(Direction::FromHost);
        let mut foreign = Vec::new();
        encode_with_version(9, &Packet { seq: 0, frame: Frame::Hello(Session(1)) }, &mut foreign);
        let ack = HelloAck {
            session: Session(1),
            firmware: FirmwareVersion { major: 0, minor: 1, patch: 0 },
            capabilities: Capabilities::default(),
            calibration_crc: 0,
        };
        let own_side = wire(Frame::HelloAck(ack));
        let mut flipped = wire(Frame::Hello(Session(0x1234)));
        flipped[6] ^= 1;
        let read = feed(&mut decoder, &[foreign, own_side, flipped].concat());
        assert!(read[0].is_err_and(|error| error.is_foreign(FrameKind::Hello)), "foreign version: {read:?}");
        let damage = decoder.damage();
        assert_eq!((damage.version, damage.kind, damage.checksum), (1, 1, 1), "{damage:?} from {read:?}");
        assert_eq!(decoder.frames(), 0, "nothing was taken");
    }

    #[test]
    fn the_longest_frame_fits_with_room_to_spare() {
        let telemetry = Telemetry {
            session: Some(Session(u16::MAX)),
            ticks: u32::MAX,
            tick_period_us: Some(u32::MAX),
            ..Telemetry::default()
        };
        let bytes = wire(Frame::Telemetry(telemetry));
        assert_eq!(bytes.len(), 38, "the longest frame of version 1");
        let mut decoder = Decoder::new(Direction::FromChip);
        let read = feed(&mut decoder, &bytes);
        assert_eq!(read, [Ok(Packet { seq: 7, frame: Frame::Telemetry(telemetry) })], "it comes back");
    }
}
