//! Waiting in tests: for what must happen sooner or later. Only a hang fails; no test asserts how long something takes.

use std::time::{Duration, Instant};

/// Longer than this nothing takes, even on an overloaded machine.
const HANGS_AFTER: Duration = Duration::from_secs(60);

/// Waits until it is done.
#[track_caller]
pub fn until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < HANGS_AFTER, "still waiting for: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}
