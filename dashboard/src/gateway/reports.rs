//! Refusals in the log of a run: each kind now and then, the rest counted, so that a flood of them fills nothing.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Refusals of one kind are reported this often; the rest is counted.
const REPORT_AGAIN: Duration = Duration::from_secs(10);
/// Keys are somebody else's choice: there may be any number.
const MOST_KINDS: usize = 1000;

/// When each kind of refusal was last said, and how often it came since.
#[derive(Default)]
pub struct Reports(HashMap<(String, String), (Instant, u64)>);

impl Reports {
    /// Whether to say it now, and how many were not said before it. `who` and `what` make its kind.
    pub fn due(&mut self, who: &str, what: &str, now: Instant) -> Option<u64> {
        if self.0.len() > MOST_KINDS {
            self.0.clear();
        }
        match self.0.get_mut(&(who.to_owned(), what.to_owned())) {
            Some((said, count)) if now < *said + REPORT_AGAIN => {
                *count += 1;
                None
            }
            Some((said, count)) => {
                *said = now;
                Some(std::mem::take(count))
            }
            None => {
                self.0.insert((who.to_owned(), what.to_owned()), (now, 0));
                Some(0)
            }
        }
    }
}

/// ` (3 more since it was last said)`
pub fn more(before: u64) -> String {
    if before > 0 { format!(" ({before} more since it was last said)") } else { String::new() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_is_said_at_once_and_then_now_and_then() {
        let (mut reports, start) = (Reports::default(), Instant::now());
        assert_eq!(reports.due("a", "put x", start), Some(0), "the first");
        assert_eq!(reports.due("a", "put x", start), None, "not again at once");
        assert_eq!(reports.due("a", "put y", start), Some(0), "another kind");
        assert_eq!(reports.due("a", "put x", start + REPORT_AGAIN), Some(1), "later, with the count");
    }
}
