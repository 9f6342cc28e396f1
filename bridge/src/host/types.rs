//! What the host's side of the conversation hands out: effects, notes, counters, errors.

use std::collections::VecDeque;

use carril_messages::{FaultSet, Stamp, WheelTelemetry};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::Clearing;
use crate::codec::{HelloAck, Session, Telemetry};
use crate::stock::StockNote;

/// What the host wants done, and what it has learnt. Emptied by whoever does it.
#[derive(Debug, Default)]
pub struct Effects {
    /// Bytes that go out in order and before any command.
    pub urgent: Vec<u8>,
    /// The newest command; an older one that is still here has been overtaken.
    pub command: Option<Vec<u8>>,
    /// What the chip reported, with the time at which it made the report; that at which it arrived, where the chip's time is not known.
    pub telemetry: Vec<(Stamp, WheelTelemetry)>,
    /// What people should hear of, once each.
    pub notes: Vec<Note>,
    /// The same, of a conversation with stock firmware.
    pub stock_notes: Vec<StockNote>,
}

/// Stops of this side. While one is latched, commands go out with speed 0; only `reset` ends it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Latches {
    /// A person, a budget or a deadline ordered it.
    pub estop: bool,
    /// The link was lost while the car was told to move. It must not set off by itself when the link is back.
    pub link_lost: bool,
}

impl Latches {
    /// Whether the car must stand.
    pub const fn any(self) -> bool {
        self.estop || self.link_lost
    }
}

/// The conversation as a successor takes it over.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct HostState {
    /// The stops in force.
    pub latches: Latches,
    /// The session that the chip has not ended, as far as is known.
    pub session: Option<Session>,
    /// The handshake that has begun, and when it is tried again.
    pub(super) greeting: Option<(Session, Stamp)>,
    /// `None`: the successor draws its own.
    pub(super) session_seed: Option<u64>,
    pub(super) next_seq: u16,
    pub(super) was_up: bool,
    pub(super) last_telemetry: Option<Telemetry>,
    pub(super) clearing: Option<Clearing>,
    pub(super) sent: VecDeque<(u16, Stamp)>,
    pub(super) last_echo: Option<u16>,
}

impl From<Latches> for HostState {
    /// The stops alone; the conversation begins anew.
    fn from(latches: Latches) -> Self {
        Self { latches, ..Self::default() }
    }
}

/// Something that happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Note {
    /// The handshake is done.
    Up(HelloAck),
    /// The chip speaks another version.
    Refused {
        /// Its version.
        got: u8,
    },
    /// No word from the chip for too long.
    Silent,
    /// The chip has ended the session: a fault, or a restart.
    SessionLost,
    /// The chip has started anew.
    Restarted,
    /// Its faults have changed.
    Faults {
        /// Those that came.
        came: FaultSet,
        /// Those that went.
        went: FaultSet,
    },
    /// A `reset` did not clear these within its time; `None`: it never reached the chip.
    ResetFailed(Option<FaultSet>),
}

/// Counters since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkCounts {
    /// Commands that went out.
    pub commands_sent: u64,
    /// Commands that did not, because the link was not up.
    pub commands_withheld: u64,
    /// Telemetry frames that arrived.
    pub telemetry: u64,
    /// Frames of the chip that did not arrive: gaps in its sequence numbers.
    pub lost: u64,
    /// Handshakes that succeeded.
    pub handshakes: u64,
}

/// Why a command was not sent.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CommandError {
    /// A number that is none.
    #[error("command not sent: steering {steering_rad} rad, speed {speed_m_s} m/s; both must be finite numbers")]
    NotFinite {
        /// As it came.
        steering_rad: f32,
        /// As it came.
        speed_m_s: f32,
    },
    /// Its lease had run out before it could be sent.
    #[error("command not sent: it is {age_ms} ms old and its lease is {lease_ms} ms; see why the node before is late")]
    TooOld {
        /// Age when it came here.
        age_ms: u128,
        /// The lease.
        lease_ms: u16,
    },
}
