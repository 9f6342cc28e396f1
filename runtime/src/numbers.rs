//! Which sequence numbers came out of a port.

use std::ops::Range;

use serde::{Deserialize, Serialize};

/// So many runs of numbers are remembered. A port that is replaced in order has one per life of its node.
const RUNS: usize = 64;

/// Sequence numbers, as runs without a gap, per life (epoch) of the node.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Numbers(Vec<(u64, Range<u64>)>);

impl Numbers {
    /// Number `seq` of `epoch` came out.
    pub fn add(&mut self, epoch: u64, seq: u64) {
        self.add_run(epoch, seq..seq.saturating_add(1));
    }

    /// All numbers of `epoch` up to `next` came out, from the newest known on.
    pub fn extend_to(&mut self, epoch: u64, next: u64) {
        let newest = self.0.iter_mut().rev().find(|(life, _)| *life == epoch);
        if let Some((_, run)) = newest {
            run.end = run.end.max(next);
        }
    }

    fn add_run(&mut self, epoch: u64, run: Range<u64>) {
        let joined = self.0.last_mut().filter(|(life, last)| *life == epoch && last.end == run.start);
        if let Some((_, last)) = joined {
            last.end = run.end;
            return;
        }
        if self.0.len() == RUNS {
            self.0.remove(0);
        }
        self.0.push((epoch, run));
    }

    /// What another instance of the node sent came out, too.
    pub fn merge(&mut self, other: &Self) {
        for (epoch, run) in &other.0 {
            self.0.push((*epoch, run.clone()));
        }
    }

    /// How many of these numbers never came out.
    pub fn missing_of(&self, epoch: u64, numbers: Range<u64>) -> u64 {
        let mut runs: Vec<_> = self.0.iter().filter(|(life, _)| *life == epoch).map(|(_, run)| run).collect();
        runs.sort_unstable_by_key(|run| run.start);
        let (mut missing, mut next) = (0, numbers.start);
        for run in runs {
            missing += run.start.min(numbers.end).saturating_sub(next);
            next = next.max(run.end).min(numbers.end);
        }
        missing + numbers.end.saturating_sub(next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(all: &[(u64, u64)]) -> Numbers {
        let mut numbers = Numbers::default();
        for (epoch, seq) in all {
            numbers.add(*epoch, *seq);
        }
        numbers
    }

    #[test]
    fn knows_what_is_missing() {
        let sent = numbers(&[(1, 3), (1, 4), (1, 5), (1, 8), (2, 0), (2, 6)]);
        let cases = [
            (1, 3..6, 0, "all came out"),
            (1, 5..9, 2, "6 and 7 did not"),
            (1, 0..4, 3, "nothing before 3"),
            (1, 9..12, 3, "nothing after 8"),
            (3, 0..2, 2, "nothing of another life"),
            (1, 6..6, 0, "no number, no gap"),
        ];
        for (epoch, range, missing, why) in cases {
            assert_eq!(sent.missing_of(epoch, range), missing, "{why}");
        }
    }

    #[test]
    fn instances_fill_each_others_gaps() {
        let mut both = numbers(&[(1, 5), (1, 6)]);
        both.merge(&numbers(&[(1, 2), (1, 3)]));
        assert_eq!(both.missing_of(1, 2..7), 1, "4 came out of neither");
    }

    #[test]
    fn a_successors_numbers_follow_the_own() {
        let mut sent = numbers(&[(1, 0), (1, 1)]);
        sent.extend_to(1, 4);
        sent.add(1, 4);
        sent.extend_to(1, 3);
        sent.extend_to(7, 9);
        assert_eq!(sent, Numbers(vec![(1, 0..5)]), "in one run, never shorter, and none of another life");
    }

    #[test]
    fn forgets_the_oldest_run() {
        let many: Vec<(u64, u64)> = (0..100).map(|at| (1, 2 * at)).collect();
        let sent = numbers(&many);
        assert_eq!((sent.missing_of(1, 0..1), sent.missing_of(1, 198..199)), (1, 0), "64 are remembered");
    }
}
