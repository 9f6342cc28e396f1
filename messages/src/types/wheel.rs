//! What the microcontroller reports.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Faults of the microcontroller. Numbers are bits on the wire and are never reused; `bridge/protocol.md` has the same table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Fault {
    /// Bit 0: the lease of the last command ran out.
    LeaseExpired = 0,
    /// Bit 1: the e-stop input is active.
    EstopPressed = 1,
    /// Bit 2: the host ordered an e-stop.
    EstopByHost = 2,
    /// Bit 3: the battery is too low to drive.
    BatteryLow = 3,
    /// Bit 4: the motor is driven and the encoder is silent.
    EncoderSilent = 4,
    /// Bit 5: the chip was reset by its watchdog.
    WatchdogReset = 5,
    /// Bit 6: the stored calibration is damaged; defaults are in force.
    CalibrationInvalid = 6,
    /// Bit 7: more than 100 damaged frames within a second.
    LinkNoisy = 7,
}

impl Fault {
    /// Every fault, by bit.
    pub const ALL: [Self; 8] = [
        Self::LeaseExpired,
        Self::EstopPressed,
        Self::EstopByHost,
        Self::BatteryLow,
        Self::EncoderSilent,
        Self::WatchdogReset,
        Self::CalibrationInvalid,
        Self::LinkNoisy,
    ];

    /// What happened and what to do, for people.
    pub const fn text(self) -> &'static str {
        match self {
            Self::LeaseExpired => {
                "the lease of the last command ran out; see why the host fell silent, then `carril reset`"
            }
            Self::EstopPressed => "the e-stop button is pressed; release it, then `carril reset`",
            Self::EstopByHost => "e-stop by the host; `carril reset`, then `carril start`",
            Self::BatteryLow => "the battery is too low to drive; charge it",
            Self::EncoderSilent => {
                "the motor is driven, but the encoder counts nothing; check motor, gear and encoder cable"
            }
            Self::WatchdogReset => {
                "the chip was reset by its watchdog; `carril reset`, and report it if it happens again"
            }
            Self::CalibrationInvalid => "the stored calibration is damaged; calibrate again",
            Self::LinkNoisy => "many damaged frames on the serial line; check the cable and its ground",
        }
    }
}

/// A set of faults, as one 16-bit word.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct FaultSet(pub u16);

impl FaultSet {
    /// No fault.
    pub const NONE: Self = Self(0);

    /// Whether `fault` is in the set.
    pub const fn contains(self, fault: Fault) -> bool {
        self.0 & (1 << fault as u16) != 0
    }

    /// With `fault`.
    #[must_use]
    pub const fn with(self, fault: Fault) -> Self {
        Self(self.0 | 1 << fault as u16)
    }

    /// Without `fault`.
    #[must_use]
    pub const fn without(self, fault: Fault) -> Self {
        Self(self.0 & !(1 << fault as u16))
    }

    /// Whether there is none.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// The known ones.
    pub fn iter(self) -> impl Iterator<Item = Fault> {
        Fault::ALL.into_iter().filter(move |fault| self.contains(*fault))
    }
}

impl fmt::Debug for FaultSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_set().entries(self.iter()).finish()
    }
}

/// What the microcontroller measures and does. Comes at 100 Hz.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct WheelTelemetry {
    /// Encoder ticks since the chip started, one channel: counts up in both directions.
    pub ticks: u32,
    /// Time between the last two ticks, µs. `None` when the wheel stands.
    pub tick_period_us: Option<u32>,
    /// Speed from the encoder, m/s, sign from the motor's direction.
    pub speed_m_s: f32,
    /// Road-wheel angle that the servo is told, rad, + left. An echo, not a measurement.
    pub steering_rad: f32,
    /// Battery voltage, V. `None` when it is not measured.
    pub battery_v: Option<f32>,
    /// Faults in force.
    pub faults: FaultSet,
    /// The motor is enabled: handshake done, lease running, no fault.
    pub driving: bool,
    /// Sequence number of the last command that the chip took, as on the link. `None` before the first.
    pub last_command_seq: Option<u16>,
    /// There and back on the line: from sending that command to hearing of it, less the time that the chip waited for its next
    /// report, µs. `None` when this report brings no news of one.
    pub round_trip_us: Option<u32>,
    /// Reports that did not arrive since the link was opened: gaps in their numbers. Wraps.
    pub frames_lost: u32,
    /// Damaged frames at both ends since each of them started. Wraps. 0 where the firmware does not count them and none was seen here.
    pub frames_damaged: u32,
}

crate::message!(WheelTelemetry, "carril/WheelTelemetry", 2);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_those_of_the_protocol() {
        for (bit, fault) in Fault::ALL.into_iter().enumerate() {
            assert_eq!(FaultSet::NONE.with(fault), FaultSet(1 << bit), "{fault:?} has bit {bit}");
        }
        let set = FaultSet::NONE.with(Fault::BatteryLow).with(Fault::LinkNoisy).without(Fault::BatteryLow);
        assert_eq!(set.iter().collect::<Vec<_>>(), [Fault::LinkNoisy], "added and taken away");
    }
}
