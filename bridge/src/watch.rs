//! What the microcontroller keeps an eye on besides the lease: its battery, its encoder, the noise on its line. Pure: readings
//! and times in, verdicts out. Times are µs since the start of the chip.

use serde::{Deserialize, Serialize};

/// The battery must be low for so long before it counts, µs: a starting motor makes it sag.
const BATTERY_LOW_AFTER_US: u64 = 1_000_000;
/// A battery that was low must rise by so much before it counts as good, V.
const BATTERY_HYSTERESIS_V: f32 = 0.2;
/// A motor driven at least so hard must turn the wheel, duty.
const ENCODER_EXPECTED_DUTY: f32 = 0.2;
/// Without a tick for so long, it does not, µs.
const ENCODER_SILENT_AFTER_US: u64 = 1_000_000;
/// More damaged frames within a second make a noisy line.
const NOISY_FRAMES: u16 = 100;
/// The second, µs.
const NOISY_WINDOW_US: u64 = 1_000_000;

/// Tells a low battery from one that sags for a moment.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct BatteryWatch {
    low_v: f32,
    low_since_us: Option<u64>,
}

impl BatteryWatch {
    /// Below `low_v` it is low.
    pub fn new(low_v: f32) -> Self {
        Self { low_v, low_since_us: None }
    }

    /// Another limit, for the readings to come.
    pub fn set_low(&mut self, low_v: f32) {
        self.low_v = low_v;
    }

    /// Whether it has been low for a second. A reading that is no number counts as low.
    pub fn is_low(&mut self, battery_v: f32, now_us: u64) -> bool {
        if battery_v >= self.low_v {
            self.low_since_us = None;
            return false;
        }
        let since_us = *self.low_since_us.get_or_insert(now_us);
        now_us.saturating_sub(since_us) >= BATTERY_LOW_AFTER_US
    }

    /// Whether it has recovered enough to drive again.
    pub fn is_good(&self, battery_v: f32) -> bool {
        battery_v >= self.low_v + BATTERY_HYSTERESIS_V
    }
}

/// Notices a motor that is driven while the wheel does not turn.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct EncoderWatch {
    driven_since_us: Option<u64>,
}

impl EncoderWatch {
    /// Whether the motor has been driven for a second and no tick has come in it. `silent_us` is the time since the last tick;
    /// `None` when there never was one.
    pub fn is_silent(&mut self, duty: f32, silent_us: Option<u64>, now_us: u64) -> bool {
        if duty.abs() < ENCODER_EXPECTED_DUTY {
            self.driven_since_us = None;
            return false;
        }
        let driven_us = now_us.saturating_sub(*self.driven_since_us.get_or_insert(now_us));
        driven_us.min(silent_us.unwrap_or(u64::MAX)) >= ENCODER_SILENT_AFTER_US
    }
}

/// Counts damaged frames, second by second.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct NoiseWatch {
    began_us: u64,
    damaged: u16,
    was_noisy: bool,
}

impl NoiseWatch {
    /// A damaged frame has come.
    pub fn count(&mut self) {
        self.damaged = self.damaged.saturating_add(1);
    }

    /// Whether this second or the one before has had too many of them.
    pub fn is_noisy(&mut self, now_us: u64) -> bool {
        let noisy = self.damaged > NOISY_FRAMES;
        let verdict = noisy || self.was_noisy;
        if now_us.saturating_sub(self.began_us) >= NOISY_WINDOW_US {
            *self = Self { began_us: now_us, damaged: 0, was_noisy: noisy };
        }
        verdict
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sagging_battery_is_not_low_and_a_low_one_must_rise() {
        let mut watch = BatteryWatch::new(6.4);
        assert!(!watch.is_low(6.0, 0) && !watch.is_low(6.0, 999_000), "for less than a second");
        assert!(!watch.is_low(6.4, 999_500) && !watch.is_low(6.0, 1_000_000), "a good reading begins anew");
        assert!(watch.is_low(f32::NAN, 2_000_000), "no number is no good reading");
        assert!(!watch.is_good(6.5) && watch.is_good(6.7) && !watch.is_good(f32::NAN), "with hysteresis");
    }

    #[test]
    fn an_encoder_is_silent_only_while_the_motor_pushes() {
        let mut watch = EncoderWatch::default();
        assert!(!watch.is_silent(0.1, None, 0) && !watch.is_silent(0.1, None, 5_000_000), "a gentle push may stall");
        assert!(!watch.is_silent(-0.5, None, 5_000_000), "the push begins");
        assert!(!watch.is_silent(-0.5, Some(20_000), 6_000_000), "a tick 20 ms ago");
        assert!(watch.is_silent(-0.5, Some(1_000_000), 7_000_000), "none for a second");
    }

    #[test]
    fn noise_lasts_until_a_quiet_second() {
        let mut watch = NoiseWatch::default();
        (0..100).for_each(|_| watch.count());
        assert!(!watch.is_noisy(500_000), "a hundred are allowed");
        watch.count();
        assert!(watch.is_noisy(600_000) && watch.is_noisy(1_000_000), "one more is not");
        assert!(watch.is_noisy(1_900_000), "the second before was noisy");
        assert!(watch.is_noisy(2_000_000) && !watch.is_noisy(2_000_001), "until a quiet one has passed");
    }
}
