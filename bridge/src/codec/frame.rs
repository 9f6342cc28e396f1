//! The frames: their fields, their bytes, and what makes them invalid. `bridge/protocol.md` has the same tables.

use carril_messages::FaultSet;
use crc::{CRC_16_IBM_3740, Crc};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::calibration::{CalibrationState, CalibrationStore, Parameter, ParameterWrite};
use super::fields::{Reader, Writer};

/// The version that this side speaks.
pub const PROTOCOL_VERSION: u8 = 1;
/// Largest frame before byte stuffing, from the version to the checksum, B.
pub const MAX_RAW_BYTES: usize = 60;
/// Largest frame on the line: stuffing adds one byte, and a zero stands on either side, B.
pub const MAX_WIRE_BYTES: usize = MAX_RAW_BYTES + 3;
/// Full duty of the motor on the line.
pub const FULL_DUTY: i16 = 1_020;
/// Longest lease, ms. A host that asks for more is refused: it would be no lease.
pub const MAX_LEASE_MS: u16 = 2_000;

const HEADER_BYTES: usize = 4;
const CRC_BYTES: usize = 2;
/// Polynomial 0x1021, begins with 0xFFFF, not reflected; also called CRC-16/CCITT-FALSE. Check value 0x29B1.
const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_IBM_3740);

const COMMAND_RAW: u8 = 1 << 0;
const FLAG_DRIVING: u8 = 1 << 0;
const FLAG_SESSION: u8 = 1 << 1;
const FLAG_TICK_PERIOD: u8 = 1 << 2;
const FLAG_BATTERY: u8 = 1 << 3;
const FLAG_LAST_COMMAND: u8 = 1 << 4;
const FLAGS_KNOWN: u8 = FLAG_DRIVING | FLAG_SESSION | FLAG_TICK_PERIOD | FLAG_BATTERY | FLAG_LAST_COMMAND;

/// One handshake and all that rests on it. The host draws a new number for each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Session(pub u16);

/// A frame with its sequence number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet {
    /// Counts the frames of one sender, all kinds together, and wraps.
    pub seq: u16,
    /// The frame.
    pub frame: Frame,
}

/// What the two sides say to each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Frame {
    /// Host: opens a session. The same session again changes nothing; another one stops the motor and begins anew.
    Hello(Session),
    /// Host: drive like this until the lease runs out.
    Command(Command),
    /// Host: brake now and stay stopped. Needs no session.
    EStop,
    /// Host: clears latched faults whose cause is gone.
    FaultClear(Session),
    /// Host: ends the session in order. The motor brakes; this is no fault.
    Release(Session),
    /// Host: what time is it there? With a number that comes back.
    TimeSync(u16),
    /// Host: which value has the parameter of this index?
    ParameterRead(u8),
    /// Host: another value for a parameter.
    ParameterWrite(ParameterWrite),
    /// Host: make the values in force outlast a restart.
    CalibrationStore(CalibrationStore),
    /// Host: back to the values that the firmware was built with, until they are stored or the chip restarts.
    CalibrationDefaults(Session),
    /// Host: which calibration is in force?
    CalibrationQuery,
    /// Chip: answers a `Hello`.
    HelloAck(HelloAck),
    /// Chip: what it measures and does, 100 times a second, session or not.
    Telemetry(Telemetry),
    /// Chip: answers a `TimeSync`.
    TimeSyncAck(TimeSyncAck),
    /// Chip: answers a `ParameterRead` or a `ParameterWrite`.
    Parameter(Parameter),
    /// Chip: answers a `CalibrationStore`, `CalibrationDefaults` or `CalibrationQuery`.
    Calibration(CalibrationState),
}

/// The kinds of frames by their number. Numbers with the high bit come from the chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum FrameKind {
    /// [`Frame::Hello`]
    Hello = 0x01,
    /// [`Frame::Command`]
    Command = 0x02,
    /// [`Frame::EStop`]
    EStop = 0x03,
    /// [`Frame::FaultClear`]
    FaultClear = 0x04,
    /// [`Frame::Release`]
    Release = 0x05,
    /// [`Frame::TimeSync`]
    TimeSync = 0x06,
    /// [`Frame::ParameterRead`]
    ParameterRead = 0x10,
    /// [`Frame::ParameterWrite`]
    ParameterWrite = 0x11,
    /// [`Frame::CalibrationStore`]
    CalibrationStore = 0x12,
    /// [`Frame::CalibrationDefaults`]
    CalibrationDefaults = 0x13,
    /// [`Frame::CalibrationQuery`]
    CalibrationQuery = 0x14,
    /// [`Frame::HelloAck`]
    HelloAck = 0x81,
    /// [`Frame::Telemetry`]
    Telemetry = 0x82,
    /// [`Frame::TimeSyncAck`]
    TimeSyncAck = 0x83,
    /// [`Frame::Parameter`]
    Parameter = 0x90,
    /// [`Frame::Calibration`]
    Calibration = 0x91,
}

/// Set points with a lease.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Command {
    /// The session that it belongs to; in another one it is ignored.
    pub session: Session,
    /// Road-wheel angle, 0.1 mrad, + left.
    pub steering_tenth_mrad: i16,
    /// How the motor shall turn.
    pub drive: Drive,
    /// The motor brakes when so much time passes without another command, ms. 1 to [`MAX_LEASE_MS`].
    pub lease_ms: u16,
}

/// How the motor shall turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drive {
    /// With this speed, mm/s, + forward; the chip holds it with its encoder.
    Speed(i16),
    /// With this duty, -[`FULL_DUTY`] to [`FULL_DUTY`], + forward; nothing is held.
    Duty(i16),
}

/// The chip tells its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeSyncAck {
    /// The number of the question.
    pub token: u16,
    /// When the question had arrived, µs since the chip started; wraps.
    pub received_us: u32,
    /// When this answer was made, µs since the chip started; wraps.
    pub sent_us: u32,
}

/// The chip introduces itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HelloAck {
    /// The session that is open now.
    pub session: Session,
    /// Version of the firmware.
    pub firmware: FirmwareVersion,
    /// What it can do.
    pub capabilities: Capabilities,
    /// CRC-16 of its stored calibration, so that the host notices another one.
    pub calibration_crc: u16,
}

/// Version of the firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FirmwareVersion {
    /// Breaking changes.
    pub major: u8,
    /// Additions.
    pub minor: u8,
    /// Repairs.
    pub patch: u8,
}

impl std::fmt::Display for FirmwareVersion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}.{}.{}", self.major, self.minor, self.patch)
    }
}

/// What a chip can do, as bits. Unknown bits are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Capabilities(pub u16);

impl Capabilities {
    /// Holds a speed with its encoder.
    pub const SPEED_CONTROL: Self = Self(1 << 0);
    /// Measures the battery.
    pub const BATTERY: Self = Self(1 << 1);
    /// Has an e-stop input.
    pub const ESTOP_INPUT: Self = Self(1 << 2);
    /// Takes a duty instead of a speed.
    pub const RAW_DUTY: Self = Self(1 << 3);
    /// Keeps a calibration.
    pub const CALIBRATION: Self = Self(1 << 4);
    /// Tells its time.
    pub const TIME_SYNC: Self = Self(1 << 5);

    /// Those of both.
    #[must_use]
    pub const fn and(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Whether all of `other` are there.
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

/// What the chip measures and does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Telemetry {
    /// The open session. `None`: a handshake is needed.
    pub session: Option<Session>,
    /// Encoder ticks since the chip started; wraps.
    pub ticks: u32,
    /// Time between the last two ticks, µs. `None` when the wheel stands.
    pub tick_period_us: Option<u32>,
    /// Speed from the encoder, mm/s, sign from the motor's direction.
    pub speed_mm_s: i16,
    /// Road-wheel angle that the servo is told, 0.1 mrad, + left.
    pub steering_tenth_mrad: i16,
    /// Battery voltage, mV. `None` when it is not measured.
    pub battery_mv: Option<u16>,
    /// Faults in force.
    pub faults: FaultSet,
    /// A session is open, the lease runs, and no fault stops the motor.
    pub driving: bool,
    /// The last command that the chip took. `None` before the first of the session.
    pub last_command: Option<LastCommand>,
    /// Time since the chip started, µs; wraps after 71 minutes.
    pub chip_time_us: u32,
    /// Damaged frames that the chip has received since it started; wraps.
    pub damaged_frames: u16,
}

/// The last command that the chip took.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastCommand {
    /// Its sequence number.
    pub seq: u16,
    /// How long ago it came, µs; 65535 stands for longer. Lets the host tell the line's delay from the chip's.
    pub age_us: u16,
}

/// Why bytes between two zeros are no frame for this side.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// More bytes than any frame has.
    #[error("more than {} bytes between two zeros", MAX_RAW_BYTES + 1)]
    TooLong,
    /// The byte stuffing does not come out even.
    #[error("the byte stuffing is damaged")]
    Stuffing,
    /// Fewer bytes than any frame has.
    #[error("a frame of {got} bytes, expected at least {}", HEADER_BYTES + CRC_BYTES)]
    TooShort {
        /// Bytes that arrived.
        got: usize,
    },
    /// The checksum differs.
    #[error("checksum {got:#06x}, expected {expected:#06x}")]
    Checksum {
        /// The one in the frame.
        got: u16,
        /// The one of its bytes.
        expected: u16,
    },
    /// An intact frame of another version of the protocol.
    #[error("protocol version {got}, expected {PROTOCOL_VERSION}")]
    Version {
        /// The version that arrived.
        got: u8,
        /// The number of the kind; `Hello` and `EStop` mean the same in every version.
        kind: u8,
    },
    /// No kind of frame that this side hears.
    #[error("frame kind {kind:#04x} is unknown or comes from this side")]
    Kind {
        /// Its number.
        kind: u8,
    },
    /// A known kind with too few or too many fields.
    #[error("frame kind {kind:#04x} has {got} bytes of fields, which is not its size")]
    Length {
        /// Its number.
        kind: u8,
        /// Bytes of fields that arrived.
        got: usize,
    },
    /// A field holds what it may not.
    #[error("frame kind {kind:#04x}: field `{field}` is out of range")]
    Field {
        /// The number of the kind.
        kind: u8,
        /// The field.
        field: &'static str,
    },
}

impl FrameKind {
    /// All of them.
    pub const ALL: [Self; 16] = [
        Self::Hello,
        Self::Command,
        Self::EStop,
        Self::FaultClear,
        Self::Release,
        Self::TimeSync,
        Self::ParameterRead,
        Self::ParameterWrite,
        Self::CalibrationStore,
        Self::CalibrationDefaults,
        Self::CalibrationQuery,
        Self::HelloAck,
        Self::Telemetry,
        Self::TimeSyncAck,
        Self::Parameter,
        Self::Calibration,
    ];

    /// The kind of that number.
    pub fn of(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| *kind as u8 == number)
    }

    /// Whether the chip sends it.
    pub const fn is_from_chip(self) -> bool {
        self as u8 & 0x80 != 0
    }

    const fn body_bytes(self) -> usize {
        match self {
            Self::EStop | Self::CalibrationQuery => 0,
            Self::ParameterRead => 1,
            Self::Hello | Self::FaultClear | Self::Release | Self::TimeSync | Self::CalibrationDefaults => 2,
            Self::CalibrationStore => 4,
            Self::Parameter | Self::Calibration => 6,
            Self::ParameterWrite => 7,
            Self::Command | Self::HelloAck => 9,
            Self::TimeSyncAck => 10,
            Self::Telemetry => 29,
        }
    }
}

impl Frame {
    /// Its kind.
    pub const fn kind(&self) -> FrameKind {
        match self {
            Self::Hello(_) => FrameKind::Hello,
            Self::Command(_) => FrameKind::Command,
            Self::EStop => FrameKind::EStop,
            Self::FaultClear(_) => FrameKind::FaultClear,
            Self::Release(_) => FrameKind::Release,
            Self::TimeSync(_) => FrameKind::TimeSync,
            Self::ParameterRead(_) => FrameKind::ParameterRead,
            Self::ParameterWrite(_) => FrameKind::ParameterWrite,
            Self::CalibrationStore(_) => FrameKind::CalibrationStore,
            Self::CalibrationDefaults(_) => FrameKind::CalibrationDefaults,
            Self::CalibrationQuery => FrameKind::CalibrationQuery,
            Self::HelloAck(_) => FrameKind::HelloAck,
            Self::Telemetry(_) => FrameKind::Telemetry,
            Self::TimeSyncAck(_) => FrameKind::TimeSyncAck,
            Self::Parameter(_) => FrameKind::Parameter,
            Self::Calibration(_) => FrameKind::Calibration,
        }
    }
}

/// The checksum of a frame, over any bytes.
pub fn checksum(bytes: &[u8]) -> u16 {
    CRC.checksum(bytes)
}

/// Appends the frame as it goes over the line: a zero, the stuffed bytes, a zero. Allocates only when `wire` has no room.
pub fn encode(packet: &Packet, wire: &mut Vec<u8>) {
    encode_with_version(PROTOCOL_VERSION, packet, wire);
}

/// As [`encode`], with another version in the header; for tests of how versions are refused.
pub fn encode_with_version(version: u8, packet: &Packet, wire: &mut Vec<u8>) {
    let mut raw = Writer::<MAX_RAW_BYTES>::new();
    raw.u8(version).u8(packet.frame.kind() as u8).u16(packet.seq);
    match &packet.frame {
        Frame::Hello(session)
        | Frame::FaultClear(session)
        | Frame::Release(session)
        | Frame::CalibrationDefaults(session) => drop(raw.u16(session.0)),
        Frame::Command(command) => write_command(*command, &mut raw),
        Frame::EStop | Frame::CalibrationQuery => {}
        Frame::TimeSync(token) => drop(raw.u16(*token)),
        Frame::ParameterRead(index) => drop(raw.u8(*index)),
        Frame::ParameterWrite(write) => write.write(&mut raw),
        Frame::CalibrationStore(store) => store.write(&mut raw),
        Frame::HelloAck(ack) => write_hello_ack(ack, &mut raw),
        Frame::Telemetry(telemetry) => write_telemetry(telemetry, &mut raw),
        Frame::TimeSyncAck(ack) => drop(raw.u16(ack.token).u32(ack.received_us).u32(ack.sent_us)),
        Frame::Parameter(parameter) => parameter.write(&mut raw),
        Frame::Calibration(state) => state.write(&mut raw),
    }
    let crc = checksum(raw.written());
    raw.u16(crc);
    let mut stuffed = [0; MAX_WIRE_BYTES];
    let len = cobs::encode_including_sentinels(raw.written(), &mut stuffed);
    wire.extend_from_slice(&stuffed[..len]);
}

fn write_command(command: Command, raw: &mut Writer<MAX_RAW_BYTES>) {
    let (drive, flags) = match command.drive {
        Drive::Speed(speed_mm_s) => (speed_mm_s, 0),
        Drive::Duty(duty) => (duty, COMMAND_RAW),
    };
    raw.u16(command.session.0).i16(command.steering_tenth_mrad).i16(drive).u16(command.lease_ms).u8(flags);
}

fn write_hello_ack(ack: &HelloAck, raw: &mut Writer<MAX_RAW_BYTES>) {
    let FirmwareVersion { major, minor, patch } = ack.firmware;
    raw.u16(ack.session.0).u8(major).u8(minor).u8(patch).u16(ack.capabilities.0).u16(ack.calibration_crc);
}

fn write_telemetry(telemetry: &Telemetry, raw: &mut Writer<MAX_RAW_BYTES>) {
    let flag = |set: bool, flag: u8| if set { flag } else { 0 };
    let flags = flag(telemetry.driving, FLAG_DRIVING)
        | flag(telemetry.session.is_some(), FLAG_SESSION)
        | flag(telemetry.tick_period_us.is_some(), FLAG_TICK_PERIOD)
        | flag(telemetry.battery_mv.is_some(), FLAG_BATTERY)
        | flag(telemetry.last_command.is_some(), FLAG_LAST_COMMAND);
    let (last_seq, last_age_us) = telemetry.last_command.map_or((0, 0), |last| (last.seq, last.age_us));
    raw.u8(flags).u16(telemetry.session.map_or(0, |session| session.0)).u16(telemetry.faults.0);
    raw.u32(telemetry.ticks).u32(telemetry.tick_period_us.unwrap_or(0));
    raw.i16(telemetry.speed_mm_s).i16(telemetry.steering_tenth_mrad).u16(telemetry.battery_mv.unwrap_or(0));
    raw.u16(last_seq).u16(last_age_us).u32(telemetry.chip_time_us);
    raw.u16(telemetry.damaged_frames);
}

/// Reads a frame after the byte stuffing was undone: from the version to the checksum.
pub fn decode_raw(raw: &[u8]) -> Result<Packet, DecodeError> {
    let too_short = DecodeError::TooShort { got: raw.len() };
    let (covered, crc) = raw.split_last_chunk::<CRC_BYTES>().ok_or(too_short)?;
    let ([version, kind, seq @ ..], body) = covered.split_first_chunk::<HEADER_BYTES>().ok_or(too_short)?;
    let (got, expected) = (u16::from_le_bytes(*crc), checksum(covered));
    if got != expected {
        return Err(DecodeError::Checksum { got, expected });
    }
    if *version != PROTOCOL_VERSION {
        return Err(DecodeError::Version { got: *version, kind: *kind });
    }
    let known = FrameKind::of(*kind).ok_or(DecodeError::Kind { kind: *kind })?;
    if body.len() != known.body_bytes() {
        return Err(DecodeError::Length { kind: *kind, got: body.len() });
    }
    let frame = read_frame(known, Reader(body))?;
    Ok(Packet { seq: u16::from_le_bytes(*seq), frame })
}

fn read_frame(kind: FrameKind, mut body: Reader<'_>) -> Result<Frame, DecodeError> {
    Ok(match kind {
        FrameKind::Hello => Frame::Hello(Session(body.u16())),
        FrameKind::EStop => Frame::EStop,
        FrameKind::FaultClear => Frame::FaultClear(Session(body.u16())),
        FrameKind::Release => Frame::Release(Session(body.u16())),
        FrameKind::Command => Frame::Command(read_command(&mut body)?),
        FrameKind::HelloAck => Frame::HelloAck(read_hello_ack(&mut body)),
        FrameKind::Telemetry => Frame::Telemetry(read_telemetry(&mut body)?),
        FrameKind::TimeSync => Frame::TimeSync(body.u16()),
        FrameKind::ParameterRead => Frame::ParameterRead(body.u8()),
        FrameKind::ParameterWrite => Frame::ParameterWrite(ParameterWrite::read(&mut body)),
        FrameKind::CalibrationStore => Frame::CalibrationStore(CalibrationStore::read(&mut body)),
        FrameKind::CalibrationDefaults => Frame::CalibrationDefaults(Session(body.u16())),
        FrameKind::CalibrationQuery => Frame::CalibrationQuery,
        FrameKind::TimeSyncAck => {
            Frame::TimeSyncAck(TimeSyncAck { token: body.u16(), received_us: body.u32(), sent_us: body.u32() })
        }
        FrameKind::Parameter => Frame::Parameter(Parameter::read(&mut body)?),
        FrameKind::Calibration => Frame::Calibration(CalibrationState::read(&mut body)?),
    })
}

fn read_command(body: &mut Reader<'_>) -> Result<Command, DecodeError> {
    let out_of_range = |field| Err(DecodeError::Field { kind: FrameKind::Command as u8, field });
    let (session, steering_tenth_mrad) = (Session(body.u16()), body.i16());
    let (drive, lease_ms, flags) = (body.i16(), body.u16(), body.u8());
    if !(1..=MAX_LEASE_MS).contains(&lease_ms) {
        return out_of_range("lease_ms");
    }
    let drive = match flags {
        0 => Drive::Speed(drive),
        COMMAND_RAW if (-FULL_DUTY..=FULL_DUTY).contains(&drive) => Drive::Duty(drive),
        COMMAND_RAW => return out_of_range("duty"),
        _ => return out_of_range("flags"),
    };
    Ok(Command { session, steering_tenth_mrad, drive, lease_ms })
}

fn read_hello_ack(body: &mut Reader<'_>) -> HelloAck {
    HelloAck {
        session: Session(body.u16()),
        firmware: FirmwareVersion { major: body.u8(), minor: body.u8(), patch: body.u8() },
        capabilities: Capabilities(body.u16()),
        calibration_crc: body.u16(),
    }
}

fn read_telemetry(body: &mut Reader<'_>) -> Result<Telemetry, DecodeError> {
    let flags = body.u8();
    let has = |flag: u8| flags & flag != 0;
    let (session, faults) = (body.u16(), body.u16());
    let (ticks, tick_period_us) = (body.u32(), body.u32());
    let (speed_mm_s, steering_tenth_mrad, battery_mv) = (body.i16(), body.i16(), body.u16());
    let (last_seq, last_age_us, chip_time_us) = (body.u16(), body.u16(), body.u32());
    let damaged_frames = body.u16();
    // A field without its flag is zero, so that a value has one spelling only.
    let unflagged = [
        ("flags", flags & !FLAGS_KNOWN == 0),
        ("session", has(FLAG_SESSION) || session == 0),
        ("tick_period_us", has(FLAG_TICK_PERIOD) || tick_period_us == 0),
        ("battery_mv", has(FLAG_BATTERY) || battery_mv == 0),
        ("last_command", has(FLAG_LAST_COMMAND) || (last_seq, last_age_us) == (0, 0)),
    ];
    if let Some((field, _)) = unflagged.into_iter().find(|(_, ok)| !ok) {
        return Err(DecodeError::Field { kind: FrameKind::Telemetry as u8, field });
    }
    Ok(Telemetry {
        session: has(FLAG_SESSION).then_some(Session(session)),
        ticks,
        tick_period_us: has(FLAG_TICK_PERIOD).then_some(tick_period_us),
        speed_mm_s,
        steering_tenth_mrad,
        battery_mv: has(FLAG_BATTERY).then_some(battery_mv),
        faults: FaultSet(faults),
        driving: has(FLAG_DRIVING),
        last_command: has(FLAG_LAST_COMMAND).then_some(LastCommand { seq: last_seq, age_us: last_age_us }),
        chip_time_us,
        damaged_frames,
    })
}
