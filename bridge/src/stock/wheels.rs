//! What the car has told of its wheels and its battery, gathered for the next report. Pure.

use super::config::{StockConfig, TickMeaning};
use super::units;

/// Readings of one car.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Wheels {
    /// All that were counted; wraps.
    pub ticks: u32,
    /// m/s. `None` before the first wheel figure: there is no speed to tell.
    pub speed_m_s: Option<f32>,
    /// V.
    pub battery_v: Option<f32>,
    /// The car's own counter, as it last came.
    counter: Option<u16>,
}

impl Wheels {
    /// As the first time, but for the count: the car may have started anew.
    pub fn restart(&mut self) {
        *self = Self { ticks: self.ticks, ..Self::default() };
    }

    /// Takes a wheel figure. `None`: no car has such a one, and nothing has changed.
    pub fn take_figure(&mut self, figure: f64, config: &StockConfig) -> Option<()> {
        self.speed_m_s = Some(units::m_s_of_wheel_figure(figure, config)?);
        Some(())
    }

    /// Takes a report of ticks. A counter wraps after so many bits; its first value only says where it stands.
    pub fn take_ticks(&mut self, value: u16, bits: u32, meaning: TickMeaning) {
        let new = match meaning {
            TickMeaning::SinceLast => value,
            TickMeaning::Counter => {
                let before = self.counter.replace(value).unwrap_or(value);
                value.wrapping_sub(before) & (u16::MAX >> (u16::BITS - bits))
            }
        };
        self.ticks = self.ticks.wrapping_add(new.into());
    }
}
