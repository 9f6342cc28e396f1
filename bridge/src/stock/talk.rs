//! What the two protocols have in common, seen from the conversation: what a device says, and what it can be told.

use carril_messages::Stamp;

use super::config::{StockConfig, TickMeaning};
use super::packetserial_talk::{self, PacketSerialTalk};
use super::rosserial_talk::RosserialTalk;
use super::types::{StockNote, StockProtocol};

/// What a device has said, in words of its own that mean the same in each protocol.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Heard {
    /// It works: something that it says only when its program runs.
    Alive,
    /// It cannot be driven.
    Refused(String),
    /// It has started anew, and must be asked again.
    Restarted,
    /// The wheel figure, in the car's unit.
    WheelFigure(f64),
    /// Encoder ticks.
    Ticks {
        /// As it came.
        value: u16,
        /// A counter wraps after so many bits.
        bits: u32,
    },
    /// Battery, V.
    Battery(f32),
    /// A round of reports is complete.
    Report,
    /// A text, with the level as a number.
    Log(u8, String),
    /// For people.
    Note(StockNote),
}

/// What goes to the car.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Order {
    pub power: i16,
    /// `None`: the servo is left alone.
    pub steering_rad: Option<f32>,
}

/// One of the protocols.
pub(super) enum Talk {
    Rosserial(RosserialTalk),
    PacketSerial(PacketSerialTalk),
}

impl Talk {
    pub fn new(protocol: StockProtocol) -> Self {
        match protocol {
            StockProtocol::Rosserial => Self::Rosserial(RosserialTalk::default()),
            StockProtocol::PacketSerial => Self::PacketSerial(PacketSerialTalk::default()),
        }
    }

    pub fn protocol(&self) -> StockProtocol {
        match self {
            Self::Rosserial(_) => StockProtocol::Rosserial,
            Self::PacketSerial(_) => StockProtocol::PacketSerial,
        }
    }

    /// Forgets what the device has said of itself, but not how to stop it.
    pub fn restart(&mut self) {
        match self {
            Self::Rosserial(talk) => talk.restart(),
            Self::PacketSerial(talk) => talk.restart(),
        }
    }

    /// Asks the device what it is.
    pub fn ask(&mut self, now: Stamp, wire: &mut Vec<u8>) {
        match self {
            Self::Rosserial(talk) => talk.ask(now, wire),
            // There is no question in this protocol: the device speaks by itself.
            Self::PacketSerial(_) => {}
        }
    }

    /// Takes bytes; answers that cannot wait go to `wire`.
    pub fn receive(&mut self, arrived: Stamp, bytes: &[u8], heard: &mut Vec<Heard>, wire: &mut Vec<u8>) {
        match self {
            Self::Rosserial(talk) => talk.receive(arrived, bytes, heard, wire),
            Self::PacketSerial(talk) => talk.receive(bytes, heard),
        }
    }

    /// Whether it has said enough of itself to be driven.
    pub fn is_ready(&self) -> bool {
        match self {
            Self::Rosserial(talk) => talk.is_ready(),
            Self::PacketSerial(talk) => talk.is_ready(),
        }
    }

    /// Whether silence means that it does not work.
    pub fn is_talkative(&self) -> bool {
        match self {
            Self::Rosserial(talk) => talk.is_talkative(),
            Self::PacketSerial(_) => true,
        }
    }

    /// What is still missing, for people.
    pub fn missing(&self) -> Option<String> {
        match self {
            Self::Rosserial(talk) => talk.missing(),
            Self::PacketSerial(_) => None,
        }
    }

    /// What the device takes and tells, for people.
    pub fn summary(&self) -> String {
        match self {
            Self::Rosserial(talk) => talk.summary(),
            Self::PacketSerial(_) => "AutoModelCar v4".to_owned(),
        }
    }

    /// Appends the order; as much of it as can be said now.
    pub fn encode(&self, order: Order, config: &StockConfig, wire: &mut Vec<u8>) {
        match self {
            Self::Rosserial(talk) => talk.encode(order, config, wire),
            Self::PacketSerial(_) => packetserial_talk::encode_order(order, config, wire),
        }
    }

    /// What a report of ticks means when the configuration does not say it.
    pub fn usual_ticks(&self) -> TickMeaning {
        match self {
            Self::Rosserial(talk) => talk.usual_ticks(),
            Self::PacketSerial(_) => TickMeaning::SinceLast,
        }
    }

    /// Frames that were refused.
    pub fn damaged(&self) -> u64 {
        match self {
            Self::Rosserial(talk) => talk.damaged(),
            Self::PacketSerial(talk) => talk.damaged(),
        }
    }
}
