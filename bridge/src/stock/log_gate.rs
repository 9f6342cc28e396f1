//! Texts of the device on their way to people: made safe to print, and not more of them than anybody reads. Pure.

use std::time::Duration;

use carril_messages::Stamp;

use super::types::{LogLevel, StockNote};

/// So many texts pass in [`WINDOW`]. These devices say about twenty when they start.
const PER_WINDOW: u32 = 50;
const WINDOW: Duration = Duration::from_secs(1);
/// Longer texts are cut, characters.
const MAX_CHARS: usize = 200;

/// Lets texts pass, and counts those that were too many.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct LogGate {
    window: Option<Stamp>,
    passed: u32,
    dropped: u32,
}

impl LogGate {
    /// The text as a note, unless there were too many lately.
    pub fn pass(&mut self, level: LogLevel, text: &str, now: Stamp) -> Option<StockNote> {
        if self.is_over(now) {
            self.window = Some(now);
            self.passed = 0;
        }
        if self.passed == PER_WINDOW {
            self.dropped = self.dropped.saturating_add(1);
            return None;
        }
        self.passed += 1;
        Some(StockNote::Log(level, clean(text)))
    }

    /// How many were too many in a window that is over; told once.
    pub fn dropped(&mut self, now: Stamp) -> Option<u32> {
        (self.dropped > 0 && self.is_over(now)).then(|| std::mem::take(&mut self.dropped))
    }

    fn is_over(&self, now: Stamp) -> bool {
        self.window.is_none_or(|window| now.since(window).to_duration() >= WINDOW)
    }
}

/// Without what moves a cursor.
fn clean(text: &str) -> String {
    let printable = |c: char| if c.is_control() { ' ' } else { c };
    text.trim_end().chars().take(MAX_CHARS).map(printable).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_texts_is_cut_and_told() {
        let mut gate = LogGate::default();
        let at = |ms: i64| Stamp::from_nanos(ms * 1_000_000);
        let passed = (0..80).filter(|_| gate.pass(LogLevel::Warn, "again", at(1)).is_some()).count();
        assert_eq!(passed, PER_WINDOW as usize, "the first ones");
        assert_eq!(gate.dropped(at(500)), None, "the window is not over");
        assert_eq!(gate.dropped(at(1_001)), Some(30), "then it is told");
        assert_eq!(gate.dropped(at(1_001)), None, "once");
        assert!(gate.pass(LogLevel::Warn, "again", at(1_001)).is_some(), "and texts pass again");
    }

    #[test]
    fn texts_cannot_move_the_cursor() {
        let mut gate = LogGate::default();
        let note = gate.pass(LogLevel::Info, "\x1b[2Jhello\r\n", Stamp::ZERO);
        assert_eq!(note, Some(StockNote::Log(LogLevel::Info, " [2Jhello".into())), "nothing but text");
        let Some(StockNote::Log(_, long)) = gate.pass(LogLevel::Info, &"x".repeat(5_000), Stamp::ZERO) else {
            panic!("it passes");
        };
        assert_eq!(long.len(), MAX_CHARS, "and not too much of it");
    }
}
