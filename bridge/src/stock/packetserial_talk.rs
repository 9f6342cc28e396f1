//! The conversation with AutoModelCar v4. The device speaks by itself, a hundred rounds a second; there is no handshake, and
//! nothing that it can refuse. Later firmware of the same family (AutoMiny) gives other meanings to the same numbers: it is told
//! apart by its lengths, and refused.

use super::config::StockConfig;
use super::packetserial::{DecodeError, Decoder, Frame, Side, encode};
use super::talk::{Heard, Order};
use super::units;

/// So many foreign frames without one of our own say that the firmware is another one; fewer are damage.
const FOREIGN_FRAMES: u8 = 5;
/// The IMU frame of AutoMiny has the number of our speed, and so many bytes.
const AUTOMINY_IMU: DecodeError = DecodeError::Length { kind: 9, got: 22 };
/// Its voltage has the number of our attitude, and so many bytes.
const AUTOMINY_VOLTAGE: DecodeError = DecodeError::Length { kind: 10, got: 4 };
/// No battery of such a car has more, V. More is a damaged number.
const HIGHEST_V: f32 = 100.0;

pub(super) struct PacketSerialTalk {
    decoder: Decoder,
    /// A frame has come that only this firmware sends.
    known: bool,
    foreign: u8,
    implausible: u64,
}

impl Default for PacketSerialTalk {
    fn default() -> Self {
        Self { decoder: Decoder::new(Side::FromDevice), known: false, foreign: 0, implausible: 0 }
    }
}

impl PacketSerialTalk {
    pub fn restart(&mut self) {
        self.decoder.restart();
        self.known = false;
        self.foreign = 0;
    }

    pub fn is_ready(&self) -> bool {
        self.known
    }

    pub fn damaged(&self) -> u64 {
        self.decoder.refused() + self.implausible
    }

    pub fn receive(&mut self, bytes: &[u8], heard: &mut Vec<Heard>) {
        for byte in bytes {
            match self.decoder.push(*byte) {
                Some(Ok(frame)) => self.hear(frame, heard),
                Some(Err(AUTOMINY_IMU | AUTOMINY_VOLTAGE)) => self.hear_foreign(heard),
                Some(Err(_)) | None => {}
            }
        }
    }

    fn hear(&mut self, frame: Frame, heard: &mut Vec<Heard>) {
        if matches!(frame, Frame::Speed(_) | Frame::Attitude { .. } | Frame::Voltage(_)) {
            self.known = true;
            self.foreign = 0;
        }
        match frame {
            // Texts come from a device that has not got its sensors to run, too.
            Frame::Log { level, text } => return heard.push(Heard::Log(level, text)),
            Frame::Speed(rad_s) => heard.push(Heard::WheelFigure(rad_s.into())),
            Frame::Voltage(volts) if (0.0..=HIGHEST_V).contains(&volts) => heard.push(Heard::Battery(volts)),
            Frame::Voltage(_) => self.implausible += 1,
            Frame::Ticks(ticks) => heard.extend([Heard::Ticks { value: ticks.into(), bits: 8 }, Heard::Report]),
            // There is no place for attitude and feedback in the telemetry; the host's own frames the decoder refuses.
            _ => {}
        }
        heard.push(Heard::Alive);
    }

    fn hear_foreign(&mut self, heard: &mut Vec<Heard>) {
        self.foreign = self.foreign.saturating_add(1);
        if self.foreign >= FOREIGN_FRAMES {
            self.known = false;
            heard.push(Heard::Refused(
                "the device speaks as AutoMiny does since 2019 (frames of type 9 with 22 bytes, of type 10 with 4), allowed \
                 is AutoModelCar v4 (4 and 12); flash that, or carril's own firmware"
                    .to_owned(),
            ));
        }
    }
}

/// Appends the order.
pub(super) fn encode_order(order: Order, config: &StockConfig, wire: &mut Vec<u8>) {
    encode(&Frame::SpeedCommand(order.power), wire);
    if let Some(steering_rad) = order.steering_rad {
        encode(&Frame::SteeringCommand(units::servo_of_rad(steering_rad, config)), wire);
    }
}
