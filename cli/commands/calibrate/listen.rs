//! Hears a port of the running graph for some time.

use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use carril_messages::{Header, Message, Payload};

use crate::common::live::Run;
use crate::common::ports;

/// Samples that wait for being looked at; what comes on top is left out.
const QUEUE: usize = 4;
/// A port that is made on demand, or a sensor that starts, gives its first sample within this time.
const PATIENCE: Duration = Duration::from_secs(5);

/// Shows every sample of `name` (`node/port`) to `take`, for so long from the first one on.
pub fn listen<T: Message>(run: &Run, name: &str, span: Duration, mut take: impl FnMut(&T)) -> Result<()> {
    let port = ports::to_read(run.file(), name)?;
    if port.message_type != T::TYPE.name {
        bail!("`{name}` carries `{}`, allowed is a port with `{}`", port.message_type, T::TYPE.name);
    }
    let (samples, inbox) = mpsc::sync_channel::<(Header, Payload)>(QUEUE);
    let guard = run.hear(&port, move |header, payload| {
        // A full queue is no loss: more of the same comes.
        let _ = samples.try_send((header, payload));
    })?;
    let mut end = Instant::now() + PATIENCE;
    let mut taken = 0_u64;
    loop {
        match inbox.recv_timeout(end.saturating_duration_since(Instant::now())) {
            Ok((header, payload)) => {
                if taken == 0 {
                    end = Instant::now() + span;
                }
                taken += 1;
                take(&T::decode(&header.meta, &payload)?);
            }
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => break,
        }
        if Instant::now() >= end {
            break;
        }
    }
    drop(guard);
    if taken == 0 {
        bail!("nothing came on `{name}` within {} s: {}", PATIENCE.as_secs(), run.explain_silence(&port));
    }
    Ok(())
}

/// Reads a span in seconds, 0.1 to 60, for clap.
pub fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "write a number of seconds, for example 2".to_owned())?;
    if (0.1..=60.0).contains(&seconds) {
        Ok(Duration::from_secs_f64(seconds))
    } else {
        Err("allowed is 0.1 to 60 s".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_are_a_number_in_range() {
        assert_eq!(parse_seconds("2.5"), Ok(Duration::from_millis(2500)), "a number");
        for wrong in ["", "2s", "0", "61", "NaN", "inf", "-1"] {
            assert!(parse_seconds(wrong).is_err(), "`{wrong}` is refused");
        }
    }
}
