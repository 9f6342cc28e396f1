//! How far a reader has come in the stream of a port.

use serde::{Deserialize, Serialize};

/// So many lives of a writer are remembered. One is usual; every `carril pub` is another.
const LIVES: usize = 8;

/// Per life (epoch) of the writers of a port, one more than the last sequence number: the samples before that were seen.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Positions(Vec<(u64, u64)>);

impl Positions {
    /// Sample `seq` of `epoch` was seen, and all before it.
    pub fn advance(&mut self, epoch: u64, seq: u64) {
        let next = seq.saturating_add(1);
        if let Some((_, known)) = self.0.iter_mut().find(|(life, _)| *life == epoch) {
            *known = next.max(*known);
        } else {
            if self.0.len() == LIVES {
                self.0.remove(0);
            }
            self.0.push((epoch, next));
        }
    }

    /// What comes next in a life; `None`: nothing of it was seen.
    pub fn next(&self, epoch: u64) -> Option<u64> {
        self.0.iter().find(|(life, _)| *life == epoch).map(|(_, next)| *next)
    }

    /// Whether the sample was seen.
    pub fn has(&self, epoch: u64, seq: u64) -> bool {
        self.next(epoch).is_some_and(|next| seq < next)
    }

    /// Whether this has come at least as far as `other`. Lives that are forgotten here count as seen.
    pub fn cover(&self, other: &Self) -> bool {
        let oldest = self.0.iter().map(|(life, _)| *life).min();
        let forgotten = |epoch: u64| self.0.len() == LIVES && oldest.is_some_and(|oldest| epoch < oldest);
        other.0.iter().all(|(epoch, next)| self.next(*epoch).map_or(forgotten(*epoch), |own| own >= *next))
    }

    /// How many samples lie between `earlier` and this.
    pub fn since(&self, earlier: &Self) -> u64 {
        self.0.iter().map(|(epoch, next)| next.saturating_sub(earlier.next(*epoch).unwrap_or(*next))).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(positions: &[(u64, u64)]) -> Positions {
        let mut all = Positions::default();
        for (epoch, seq) in positions {
            all.advance(*epoch, *seq);
        }
        all
    }

    #[test]
    fn knows_what_was_seen() {
        let positions = at(&[(1, 4), (1, 2), (2, 0)]);
        assert!(positions.has(1, 4) && !positions.has(1, 5), "up to the highest");
        assert!(positions.has(2, 0) && !positions.has(3, 0), "each life on its own");
        assert!(positions.cover(&at(&[(1, 4)])) && !positions.cover(&at(&[(1, 5)])), "as far, and no farther");
        assert!(!positions.cover(&at(&[(3, 0)])), "another life is not covered");
        assert_eq!(at(&[(1, 9), (2, 0)]).since(&positions), 5, "5 to 9 of the first life");
    }

    #[test]
    fn forgets_the_oldest_life() {
        let many: Vec<(u64, u64)> = (1..=20).map(|epoch| (epoch, 3)).collect();
        let positions = at(&many);
        assert_eq!(positions.next(12), None, "forgotten");
        assert!(positions.cover(&at(&[(5, 3), (20, 3)])), "a forgotten life was seen");
    }
}
