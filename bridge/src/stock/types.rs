//! What a conversation with stock firmware hands out, besides what it shares with our own: notes and state.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The protocols of stock firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StockProtocol {
    /// The 1:10 car, and AutoModelCar v3.
    Rosserial,
    /// AutoModelCar v4.
    PacketSerial,
}

impl fmt::Display for StockProtocol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Rosserial => "rosserial",
            Self::PacketSerial => "packetserial",
        })
    }
}

/// How much a text of the device matters to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogLevel {
    /// For those who look for faults.
    Debug,
    /// Worth knowing.
    Info,
    /// Something is wrong, and it goes on.
    Warn,
    /// Something does not work.
    Error,
}

impl LogLevel {
    /// From the numbers of rosserial_msgs/Log, which those of v4 agree with. 4 is fatal.
    pub(super) fn of(level: u8) -> Option<Self> {
        Some(match level {
            0 => Self::Debug,
            1 => Self::Info,
            2 => Self::Warn,
            3 | 4 => Self::Error,
            _ => return None,
        })
    }
}

/// Something that happened, for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StockNote {
    /// Commands may go out; what the device takes and tells.
    Up(String),
    /// The device cannot be driven: why, and what to do.
    Refused(String),
    /// A topic of the device is not read: why.
    TopicRefused(String),
    /// No word from the device for too long.
    Silent,
    /// The device has started anew.
    Restarted,
    /// Commands stopped coming while the lease ran; the car was told to stop.
    LeaseExpired,
    /// A text of the device.
    Log(LogLevel, String),
    /// So many texts of the device were too many.
    LogsDropped(u32),
}

/// What a successor needs. Its predecessor has told the car to stop, so that no lease goes over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StockState {
    /// A lease ran out, and nobody has said `reset` since.
    pub lease_expired: bool,
    /// Road-wheel angle that the servo was told, rad, + left.
    pub(super) steering_rad: Option<f32>,
    pub(super) ticks: u32,
}
