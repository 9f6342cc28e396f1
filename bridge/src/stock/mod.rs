//! Adapters for the firmware that cars carry already: rosserial (the 1:10 car, AutoModelCar v3) and PacketSerial (v4). None of
//! it keeps a lease, so the host does (see [`StockHost`]).
//!
//! Pure: [`rosserial`] and [`packetserial`] turn bytes into frames and back, [`StockHost`] holds the conversation on top.

mod config;
mod host;
mod log_gate;
pub mod packetserial;
mod packetserial_talk;
mod ros_messages;
pub mod rosserial;
mod rosserial_talk;
mod talk;
mod types;
mod units;
mod wheels;

pub use config::{StockConfig, TickMeaning, WheelFigure};
pub use host::StockHost;
pub use ros_messages::{MessageKind, TopicInfo};
pub use types::{LogLevel, StockNote, StockProtocol, StockState};
