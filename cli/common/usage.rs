//! Processor time and memory of the processes of a run, from `/proc`.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// What a process uses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Usage {
    /// Share of one core since the last look, %. `None` at the first look.
    pub cpu_percent: Option<f64>,
    /// Resident memory, shared pages included, B.
    pub memory_b: u64,
}

/// Looks at processes again and again.
#[derive(Default)]
pub struct Meter {
    last: HashMap<u32, (Duration, Instant)>,
}

impl Meter {
    /// What a process uses; `None` when it is gone.
    pub fn look(&mut self, pid: u32) -> Option<Usage> {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
        let (busy, memory_b) = parse(&stat)?;
        let now = Instant::now();
        let before = self.last.insert(pid, (busy, now));
        let cpu_percent = before.and_then(|(busy_before, then)| {
            let elapsed = now.duration_since(then).as_secs_f64();
            (elapsed > 0.0).then(|| busy.saturating_sub(busy_before).as_secs_f64() / elapsed * 100.0)
        });
        Some(Usage { cpu_percent, memory_b })
    }
}

/// `/proc/<pid>/stat` counts processor time in hundredths of a second and memory in pages of 4 KiB on every Linux that we run on.
const TICK: Duration = Duration::from_millis(10);
const PAGE_B: u64 = 4096;

/// Processor time and resident memory. The second field, the name, may itself hold blanks and brackets.
fn parse(stat: &str) -> Option<(Duration, u64)> {
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let number = |index: usize| fields.get(index)?.parse::<u64>().ok();
    let ticks = u32::try_from(number(11)? + number(12)?).ok()?;
    Some((TICK * ticks, number(21)? * PAGE_B))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_behind_a_wicked_name() {
        let stat = "7 (a) b (c) S 1 7 7 0 -1 4194304 90 0 0 0 150 50 0 0 20 0 3 0 100 9000000 25 184 1 1";
        assert_eq!(parse(stat), Some((Duration::from_secs(2), 25 * 4096)), "200 ticks and 25 pages");
        assert_eq!(parse("7 (a) S 1"), None, "cut off");
    }

    #[test]
    fn finds_itself_and_no_ghost() {
        let mut meter = Meter::default();
        let own = meter.look(std::process::id()).expect("this process is there");
        assert!(own.memory_b > 0 && own.cpu_percent.is_none(), "the first look has no share yet: {own:?}");
        assert!(meter.look(u32::MAX).is_none(), "no process has this id");
    }
}
