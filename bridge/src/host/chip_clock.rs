//! What time is it on the chip? Questions and answers over the line, as in bridge/protocol.md, "Time": tells when a report was made, not
//! only when it arrived.

use std::time::Duration;

use carril_messages::Stamp;
use serde::{Deserialize, Serialize};

use crate::codec::TimeSyncAck;

/// Between two questions. A ceramic resonator is off by up to 0.5 %: 1 ms in this time.
const ASK_PERIOD: Duration = Duration::from_millis(200);
/// An answer that took longer says too little.
const LONGEST_ROUND: Duration = Duration::from_millis(50);
/// An offset serves for so long.
const GOOD_FOR: Duration = Duration::from_secs(1);
/// A report cannot have been on its way for longer; then the chip has restarted, or its clock has wrapped.
const LONGEST_WAY: Duration = Duration::from_millis(500);

/// The chip's clock as this side knows it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ChipClock {
    next_ask: Option<Stamp>,
    asked: Option<(u16, Stamp)>,
    next_token: u16,
    /// A time on the chip, µs, and the same time here.
    known: Option<(u32, Stamp)>,
}

impl ChipClock {
    /// The number to ask with now, if it is time to ask.
    pub fn ask(&mut self, now: Stamp) -> Option<u16> {
        if self.next_ask.is_some_and(|next| now < next) {
            return None;
        }
        self.next_ask = Some(now + ASK_PERIOD);
        let token = self.next_token;
        self.next_token = token.wrapping_add(1);
        self.asked = Some((token, now));
        Some(token)
    }

    /// An answer has arrived.
    pub fn hear(&mut self, ack: TimeSyncAck, arrived: Stamp) {
        let Some((token, asked)) = self.asked else { return };
        if ack.token != token || arrived < asked {
            return;
        }
        self.asked = None;
        let round = arrived.since(asked).to_duration();
        let there_us = u64::from(ack.sent_us.wrapping_sub(ack.received_us));
        if round > LONGEST_ROUND || Duration::from_micros(there_us) > round {
            return;
        }
        // In the middle between question and answer it was the middle of the chip's two times.
        let chip_us = ack.received_us.wrapping_add(ack.sent_us.wrapping_sub(ack.received_us) / 2);
        self.known = Some((chip_us, asked + round / 2));
    }

    /// When it was `chip_us` on the chip, for a report that has arrived just now. `None`: not known well enough.
    pub fn stamp_of(&self, chip_us: u32, arrived: Stamp) -> Option<Stamp> {
        let (known_us, known) = self.known?;
        if arrived.since(known).to_duration() > GOOD_FOR {
            return None;
        }
        let apart_us = i64::from(chip_us.wrapping_sub(known_us) as i32);
        let stamp = Stamp::from_nanos(known.as_nanos() + apart_us * 1_000);
        // Nothing arrives before it was made: what is left of the error is taken off.
        let stamp = stamp.min(arrived);
        (arrived.since(stamp).to_duration() <= LONGEST_WAY).then_some(stamp)
    }

    /// The chip has started anew, or another one is there.
    pub fn forget(&mut self) {
        *self = Self { next_token: self.next_token, ..Self::default() };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at_us(us: i64) -> Stamp {
        Stamp::from_nanos(1_000_000_000_000 + us * 1_000)
    }

    /// A chip whose clock is 5 s behind, asked at `us`, with so many µs on the way there, at the chip, and back.
    fn synced(clock: &mut ChipClock, us: i64, (there, held, back): (i64, i64, i64)) {
        let token = clock.ask(at_us(us)).expect("it is time to ask");
        let received_us = (us + there - 5_000_000) as u32;
        let ack = TimeSyncAck { token, received_us, sent_us: received_us.wrapping_add(held as u32) };
        clock.hear(ack, at_us(us + there + held + back));
    }

    #[test]
    fn a_report_is_stamped_with_the_time_at_which_it_was_made() {
        let mut clock = ChipClock::default();
        assert_eq!(clock.stamp_of(0, at_us(0)), None, "nothing is known yet");
        synced(&mut clock, 6_000_000, (400, 300, 600));
        let made_us = 6_050_000;
        let stamp = clock.stamp_of((made_us - 5_000_000) as u32, at_us(made_us + 9_000)).expect("known");
        let error_us = (stamp.as_nanos() - at_us(made_us).as_nanos()) / 1_000;
        assert_eq!(error_us, 100, "half of what the two ways differ");
        assert_eq!(clock.ask(at_us(6_100_000)), None, "it was asked just now");
        assert!(clock.ask(at_us(6_200_001)).is_some(), "and is asked again");
    }

    #[test]
    fn the_wrap_of_the_chips_clock_is_no_jump() {
        let mut clock = ChipClock::default();
        let token = clock.ask(at_us(0)).expect("it is time to ask");
        clock.hear(TimeSyncAck { token, received_us: u32::MAX - 100, sent_us: u32::MAX - 100 }, at_us(200));
        let stamp = clock.stamp_of(899, at_us(2_000)).expect("known");
        assert_eq!(stamp, at_us(1_100), "1000 us after the middle of question and answer");
    }

    #[test]
    fn what_makes_no_sense_is_not_believed() {
        let mut clock = ChipClock::default();
        synced(&mut clock, 6_000_000, (40_000, 300, 40_000));
        assert_eq!(clock.stamp_of(1_000_000, at_us(6_081_000)), None, "an answer that took too long");
        let token = clock.ask(at_us(6_300_000)).expect("it is time to ask");
        clock.hear(TimeSyncAck { token: token + 1, received_us: 0, sent_us: 0 }, at_us(6_301_000));
        clock.hear(TimeSyncAck { token, received_us: 10, sent_us: 5 }, at_us(6_301_000));
        assert_eq!(clock.stamp_of(1_300_000, at_us(6_302_000)), None, "neither another's answer nor one out of time");
        synced(&mut clock, 6_600_000, (100, 0, 100));
        assert_eq!(clock.stamp_of(0, at_us(6_610_000)), None, "a chip that has restarted is no report of long ago");
        assert_eq!(clock.stamp_of(1_609_000, at_us(7_900_000)), None, "what was known is too old");
        let ahead = clock.stamp_of(1_620_000, at_us(6_610_000)).expect("known");
        assert_eq!(ahead, at_us(6_610_000), "nothing arrives before it was made");
        clock.forget();
        assert_eq!(clock.stamp_of(1_609_000, at_us(6_610_000)), None, "another chip");
    }
}
