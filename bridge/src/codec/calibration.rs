//! The frames that read, change and store the calibration of a chip. `bridge/protocol.md` has the same tables.

use super::fields::{Reader, Writer};
use super::frame::{DecodeError, FrameKind, MAX_RAW_BYTES, Session};

/// Host: another value for a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ParameterWrite {
    /// The session that it belongs to.
    pub session: Session,
    /// The parameter.
    pub index: u8,
    /// Its value, in the parameter's unit.
    pub value: i32,
}

/// Host: make the values in force outlast a restart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CalibrationStore {
    /// The session that it belongs to.
    pub session: Session,
    /// CRC of the values that the host wants stored: others are not.
    pub crc: u16,
}

/// Chip: a parameter, after a question for it or a new value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// The parameter.
    pub index: u8,
    /// What became of the question.
    pub status: CalibrationStatus,
    /// The value in force; 0 when there is no such parameter.
    pub value: i32,
}

/// Chip: its calibration as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CalibrationState {
    /// What became of the question.
    pub status: CalibrationStatus,
    /// How many parameters it has.
    pub count: u8,
    /// CRC of the values in force.
    pub crc_in_force: u16,
    /// CRC of the values stored; 0xFFFF: nothing valid is.
    pub crc_stored: u16,
}

/// What became of a question for the calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum CalibrationStatus {
    /// Done.
    Done = 0,
    /// There is no such parameter.
    NoSuchParameter = 1,
    /// The value is out of the parameter's range.
    OutOfRange = 2,
    /// The car drives.
    Driving = 3,
    /// It came in a session that is not open.
    NotTheSession = 4,
    /// The values in force are not those that the host means.
    CrcDiffers = 5,
    /// The memory does not hold what was written into it.
    MemoryBroken = 6,
}

impl CalibrationStatus {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::Done,
        Self::NoSuchParameter,
        Self::OutOfRange,
        Self::Driving,
        Self::NotTheSession,
        Self::CrcDiffers,
        Self::MemoryBroken,
    ];

    /// What it means, for people.
    pub const fn text(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::NoSuchParameter => "the firmware has no such parameter",
            Self::OutOfRange => "the value is out of the parameter's range",
            Self::Driving => "the car drives; stop it first",
            Self::NotTheSession => "the session has ended",
            Self::CrcDiffers => "the values in force are not those that were meant; nothing was stored",
            Self::MemoryBroken => "the chip's memory does not hold what was written into it",
        }
    }

    fn read(kind: FrameKind, body: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let number = body.u8();
        let known = Self::ALL.into_iter().find(|status| *status as u8 == number);
        known.ok_or(DecodeError::Field { kind: kind as u8, field: "status" })
    }
}

impl ParameterWrite {
    pub(super) fn write(self, raw: &mut Writer<MAX_RAW_BYTES>) {
        raw.u16(self.session.0).u8(self.index).i32(self.value);
    }

    pub(super) fn read(body: &mut Reader<'_>) -> Self {
        Self { session: Session(body.u16()), index: body.u8(), value: body.i32() }
    }
}

impl CalibrationStore {
    pub(super) fn write(self, raw: &mut Writer<MAX_RAW_BYTES>) {
        raw.u16(self.session.0).u16(self.crc);
    }

    pub(super) fn read(body: &mut Reader<'_>) -> Self {
        Self { session: Session(body.u16()), crc: body.u16() }
    }
}

impl Parameter {
    pub(super) fn write(self, raw: &mut Writer<MAX_RAW_BYTES>) {
        raw.u8(self.index).u8(self.status as u8).i32(self.value);
    }

    pub(super) fn read(body: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let index = body.u8();
        Ok(Self { index, status: CalibrationStatus::read(FrameKind::Parameter, body)?, value: body.i32() })
    }
}

impl CalibrationState {
    pub(super) fn write(self, raw: &mut Writer<MAX_RAW_BYTES>) {
        raw.u8(self.status as u8).u8(self.count).u16(self.crc_in_force).u16(self.crc_stored);
    }

    pub(super) fn read(body: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let status = CalibrationStatus::read(FrameKind::Calibration, body)?;
        Ok(Self { status, count: body.u8(), crc_in_force: body.u16(), crc_stored: body.u16() })
    }
}
