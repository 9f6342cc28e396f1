//! When something that died is started again: policy, pauses that double, and a limit within a window. Pure: told the time.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::graph::{Restart, RestartPolicy};

/// Pause before the first restart within the window.
pub const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// No pause is longer.
pub const LONGEST_PAUSE: Duration = Duration::from_secs(5);

/// What to do with something that ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Start it again after a pause.
    After(Duration),
    /// Its policy leaves it down.
    StayDown,
    /// It died too often within the window.
    GiveUp,
}

/// The restarts of one process or node.
#[derive(Clone, Debug)]
pub struct Restarts {
    rule: Restart,
    recent: VecDeque<Instant>,
    total: u32,
}

impl Restarts {
    /// None yet.
    pub fn new(rule: Restart) -> Self {
        Self { rule, recent: VecDeque::new(), total: 0 }
    }

    /// It ended at `now`.
    pub fn ended(&mut self, failed: bool, now: Instant) -> Verdict {
        let again = match self.rule.policy {
            RestartPolicy::Never => false,
            RestartPolicy::OnFailure => failed,
            RestartPolicy::Always => true,
        };
        if !again {
            return Verdict::StayDown;
        }
        let window = self.rule.window;
        self.recent.retain(|&restart| now.duration_since(restart) < window);
        if self.recent.len() >= self.rule.max as usize {
            return Verdict::GiveUp;
        }
        let doublings = self.recent.len().min(16) as u32;
        self.recent.push_back(now);
        self.total += 1;
        Verdict::After(FIRST_PAUSE.saturating_mul(1 << doublings).min(LONGEST_PAUSE))
    }

    /// Restarts so far.
    pub fn total(&self) -> u32 {
        self.total
    }

    /// The limit, for messages: "5 times within 60 s".
    pub fn limit(&self) -> String {
        let times = if self.rule.max == 1 { "once".to_owned() } else { format!("{} times", self.rule.max) };
        format!("{times} within {} s", self.rule.window.as_secs_f64())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule(policy: RestartPolicy, max: u32) -> Restart {
        Restart { policy, max, window: Duration::from_secs(60) }
    }

    #[test]
    fn pauses_double_and_then_it_gives_up() {
        let start = Instant::now();
        let mut restarts = Restarts::new(rule(RestartPolicy::OnFailure, 8));
        let pauses: Vec<_> = (0..9).map(|_| restarts.ended(true, start)).collect();
        let after = |ms| Verdict::After(Duration::from_millis(ms));
        let expected = [100, 200, 400, 800, 1600, 3200, 5000, 5000].map(after);
        assert_eq!(pauses[..8], expected, "100 ms, doubling, at most 5 s");
        assert_eq!(pauses[8], Verdict::GiveUp, "the ninth is too many");
        assert_eq!(restarts.total(), 8, "so many restarts");
    }

    #[test]
    fn old_restarts_are_forgiven() {
        let start = Instant::now();
        let mut restarts = Restarts::new(rule(RestartPolicy::OnFailure, 1));
        assert_eq!(restarts.ended(true, start), Verdict::After(FIRST_PAUSE), "the first");
        assert_eq!(restarts.ended(true, start + Duration::from_secs(59)), Verdict::GiveUp, "within the window");
        assert_eq!(restarts.ended(true, start + Duration::from_secs(61)), Verdict::After(FIRST_PAUSE), "behind it");
    }

    #[test]
    fn policies_tell_failures_from_ends() {
        let now = Instant::now();
        let ended = |policy, failed| Restarts::new(rule(policy, 5)).ended(failed, now);
        assert_eq!(ended(RestartPolicy::Never, true), Verdict::StayDown, "never");
        assert_eq!(ended(RestartPolicy::OnFailure, false), Verdict::StayDown, "it ended in order");
        assert_eq!(ended(RestartPolicy::Always, false), Verdict::After(FIRST_PAUSE), "always");
    }
}
