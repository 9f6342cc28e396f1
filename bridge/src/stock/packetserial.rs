//! The frames of AutoModelCar v4 (its `main.ino` of 2018, on the Arduino library PacketSerial): COBS, ended by a zero, one byte
//! of type, fields in little endian. Bytes in, frames out, and back. Pure: no port, no clock; no input makes it panic.
//!
//! There is no checksum. All that a receiver can check is the stuffing, the length that belongs to each type, and whether floats
//! are numbers. And a sender must **not** put a zero before a frame, as our own protocol does: the library hands an empty frame
//! to a handler that reads a type from it.

/// Longest frame between two zeros, stuffed: the library's receive buffer has 256 bytes.
pub const MAX_STUFFED_BYTES: usize = 255;

/// Longest text that is taken or sent, bytes, so that a frame fits.
pub const MAX_TEXT_BYTES: usize = 250;

/// One frame. 4, 5 and 6 go to the device, the others come from it.
#[derive(Clone, Debug, PartialEq)]
pub enum Frame {
    /// 0 to 3: text for people.
    Log {
        /// 0 debug, 1 info, 2 warn, 3 error.
        level: u8,
        /// Up to the first zero.
        text: String,
    },
    /// 4: motor, -1020 to 1020, + is forward. The device divides it by 4 and takes that as duty of 255.
    SpeedCommand(i16),
    /// 5: servo, 0 to 180, 90 is straight.
    SteeringCommand(u8),
    /// 6: lights: `left`, `right`, `brake`, `disable`.
    LedCommand(String),
    /// 7: potentiometer of the servo, as the converter reads it.
    SteeringFeedback(u16),
    /// 8: encoder ticks since the last such frame.
    Ticks(u8),
    /// 9: of the motor, rad/s, sign from its direction.
    Speed(f32),
    /// 10: rad.
    Attitude {
        /// About z.
        yaw: f32,
        /// About y.
        pitch: f32,
        /// About x.
        roll: f32,
    },
    /// 11: of the battery, V.
    Voltage(f32),
}

/// Whose frames are heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The host hears the device.
    FromDevice,
    /// The device hears the host.
    FromHost,
}

/// Why a frame was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DecodeError {
    /// More bytes between two zeros than any frame has.
    TooLong,
    /// The stuffing does not come out even, or leaves nothing.
    Stuffing,
    /// No frame of the other side has this type.
    Type(u8),
    /// The type has another length.
    Length {
        /// The type.
        kind: u8,
        /// Bytes behind it.
        got: usize,
    },
    /// A float that is no number.
    NotFinite(u8),
}

/// Turns bytes, in pieces of any size, into frames. Back in step at the next zero after any damage.
#[derive(Clone, Debug)]
pub struct Decoder {
    side: Side,
    stuffed: Vec<u8>,
    too_long: bool,
    refused: u64,
}

impl Decoder {
    /// For the frames of one side.
    pub fn new(side: Side) -> Self {
        Self { side, stuffed: Vec::with_capacity(MAX_STUFFED_BYTES), too_long: false, refused: 0 }
    }

    /// Takes a byte; a zero ends a frame. Empty frames are passed over.
    pub fn push(&mut self, byte: u8) -> Option<Result<Frame, DecodeError>> {
        if byte != 0 {
            if self.stuffed.len() < MAX_STUFFED_BYTES {
                self.stuffed.push(byte);
            } else {
                self.too_long = true;
            }
            return None;
        }
        let too_long = std::mem::take(&mut self.too_long);
        let result = match (too_long, self.stuffed.is_empty()) {
            (true, _) => Err(DecodeError::TooLong),
            (false, true) => return None,
            (false, false) => decode(self.side, &self.stuffed),
        };
        self.stuffed.clear();
        self.refused += u64::from(result.is_err());
        Some(result)
    }

    /// Forgets a frame that has begun: the line was closed and opened.
    pub fn restart(&mut self) {
        self.stuffed.clear();
        self.too_long = false;
    }

    /// Frames that were refused since the start.
    pub fn refused(&self) -> u64 {
        self.refused
    }
}

fn decode(side: Side, stuffed: &[u8]) -> Result<Frame, DecodeError> {
    let raw = cobs::decode_vec(stuffed).map_err(|_| DecodeError::Stuffing)?;
    let (kind, fields) = raw.split_first().ok_or(DecodeError::Stuffing)?;
    let from_host = (4..=6).contains(kind);
    if *kind > 11 || from_host != (side == Side::FromHost) {
        return Err(DecodeError::Type(*kind));
    }
    let frame = read(*kind, fields).ok_or(DecodeError::Length { kind: *kind, got: fields.len() })?;
    if frame.is_finite() { Ok(frame) } else { Err(DecodeError::NotFinite(*kind)) }
}

fn read(kind: u8, fields: &[u8]) -> Option<Frame> {
    Some(match kind {
        0..=3 => Frame::Log { level: kind, text: text(fields) },
        4 => Frame::SpeedCommand(i16::from_le_bytes(fields.try_into().ok()?)),
        5 => Frame::SteeringCommand(u8::from_le_bytes(fields.try_into().ok()?)),
        6 => Frame::LedCommand(text(fields)),
        7 => Frame::SteeringFeedback(u16::from_le_bytes(fields.try_into().ok()?)),
        8 => Frame::Ticks(u8::from_le_bytes(fields.try_into().ok()?)),
        9 => Frame::Speed(f32::from_le_bytes(fields.try_into().ok()?)),
        10 => {
            let (yaw, rest) = fields.split_first_chunk()?;
            let (pitch, roll) = rest.split_first_chunk()?;
            let [yaw, pitch, roll] = [*yaw, *pitch, roll.try_into().ok()?].map(f32::from_le_bytes);
            Frame::Attitude { yaw, pitch, roll }
        }
        _ => Frame::Voltage(f32::from_le_bytes(fields.try_into().ok()?)),
    })
}

/// Texts end with a zero, or with their frame.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

/// Appends a frame with the zero that ends it. Texts are cut at [`MAX_TEXT_BYTES`].
pub fn encode(frame: &Frame, wire: &mut Vec<u8>) {
    let mut raw = vec![frame.kind()];
    match frame {
        Frame::Log { text, .. } | Frame::LedCommand(text) => {
            raw.extend(text.bytes().filter(|byte| *byte != 0).take(MAX_TEXT_BYTES));
            raw.push(0);
        }
        Frame::SpeedCommand(value) => raw.extend(value.to_le_bytes()),
        Frame::SteeringCommand(value) | Frame::Ticks(value) => raw.push(*value),
        Frame::SteeringFeedback(value) => raw.extend(value.to_le_bytes()),
        Frame::Speed(value) | Frame::Voltage(value) => raw.extend(value.to_le_bytes()),
        Frame::Attitude { yaw, pitch, roll } => {
            raw.extend([yaw, pitch, roll].into_iter().flat_map(|value| value.to_le_bytes()));
        }
    }
    wire.extend(cobs::encode_vec(&raw));
    wire.push(0);
}

impl Frame {
    fn kind(&self) -> u8 {
        match self {
            Self::Log { level, .. } => (*level).min(3),
            Self::SpeedCommand(_) => 4,
            Self::SteeringCommand(_) => 5,
            Self::LedCommand(_) => 6,
            Self::SteeringFeedback(_) => 7,
            Self::Ticks(_) => 8,
            Self::Speed(_) => 9,
            Self::Attitude { .. } => 10,
            Self::Voltage(_) => 11,
        }
    }

    fn is_finite(&self) -> bool {
        match self {
            Self::Speed(value) | Self::Voltage(value) => value.is_finite(),
            Self::Attitude { yaw, pitch, roll } => [yaw, pitch, roll].iter().all(|value| value.is_finite()),
            _ => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(side: Side, bytes: &[u8]) -> Vec<Result<Frame, DecodeError>> {
        let mut decoder = Decoder::new(side);
        bytes.iter().filter_map(|byte| decoder.push(*byte)).collect()
    }

    #[test]
    fn no_frame_begins_with_a_zero_and_each_ends_with_the_only_one() {
        for frame in [Frame::SpeedCommand(0), Frame::SteeringCommand(0), Frame::SpeedCommand(256), Frame::Ticks(0)] {
            let mut wire = Vec::new();
            encode(&frame, &mut wire);
            assert_eq!(wire.iter().position(|byte| *byte == 0), Some(wire.len() - 1), "{frame:?}: {wire:?}");
        }
    }

    #[test]
    fn a_side_does_not_hear_its_own_frames() {
        let mut wire = Vec::new();
        encode(&Frame::SpeedCommand(1), &mut wire);
        assert_eq!(decoded(Side::FromDevice, &wire), [Err(DecodeError::Type(4))], "a line that is shorted to itself");
        assert_eq!(decoded(Side::FromHost, &wire), [Ok(Frame::SpeedCommand(1))], "the device hears it");
    }

    #[test]
    fn floods_without_a_zero_do_not_pile_up() {
        let mut decoder = Decoder::new(Side::FromDevice);
        assert!((0..100_000).all(|_| decoder.push(1).is_none()), "no frame ends");
        assert!(decoder.stuffed.len() <= MAX_STUFFED_BYTES, "bounded");
        assert_eq!(decoder.push(0), Some(Err(DecodeError::TooLong)), "refused at the zero");
        let mut wire = Vec::new();
        encode(&Frame::Ticks(3), &mut wire);
        assert_eq!(wire.iter().find_map(|byte| decoder.push(*byte)), Some(Ok(Frame::Ticks(3))), "and back in step");
    }
}
