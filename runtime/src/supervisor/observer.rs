//! Watches the outputs of a node from outside while it is replaced: counts what is missing, what comes twice, and the longest
//! pause. It belongs to neither instance, so that its word counts.

use std::collections::HashMap;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Header, Key};

use crate::numbers::Numbers;
use crate::transport::zenoh::ZenohTransport;
use crate::transport::{Guard, TransportError};

/// Outputs are remembered up to this many, per port.
const REMEMBERED: usize = 100_000;

/// What came out of a node.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Observation {
    pub outputs: u64,
    pub lost: u64,
    pub duplicated: u64,
    /// The longest pause between two outputs of a port, ms.
    pub longest_gap_ms: Option<f64>,
    /// The median of the pauses, ms.
    pub usual_gap_ms: Option<f64>,
}

#[derive(Default)]
struct Watched {
    seen: Mutex<Seen>,
    output: Condvar,
}

/// Life, sequence number and stamp (ns) of the outputs, by port.
#[derive(Clone, Default)]
pub(super) struct Seen(HashMap<String, Vec<(u64, u64, i64)>>);

pub(super) struct Observer {
    seen: Arc<Watched>,
    _guards: Vec<Guard>,
}

impl Observer {
    /// Watches these ports of a node.
    pub(super) fn watch(
        transport: &ZenohTransport,
        robot: &str,
        node: &str,
        ports: &[String],
    ) -> Result<Self, TransportError> {
        let seen: Arc<Watched> = Arc::default();
        let mut guards = Vec::new();
        for port in ports {
            let (seen, name) = (Arc::clone(&seen), port.clone());
            guards.push(transport.watch(&Key::new(robot, node, port).to_string(), move |_, header, _| {
                if let Ok(header) = Header::decode(header) {
                    let mut known = seen.lock();
                    let outputs = known.0.entry(name.clone()).or_default();
                    if outputs.len() < REMEMBERED {
                        outputs.push((header.epoch, header.seq, header.stamp.as_nanos()));
                    }
                    seen.output.notify_all();
                }
            })?);
        }
        Ok(Self { seen, _guards: guards })
    }

    /// What it has seen until now.
    pub(super) fn seen(&self) -> Seen {
        self.seen.lock().clone()
    }

    /// Waits for the next output. Not for more than two usual pauses, not for more than `longest`, and not at all when there are no
    /// usual pauses yet.
    pub(super) fn wait_for_output(&self, longest: Duration) {
        let mut seen = self.seen.lock();
        let observed = seen.observation(&HashMap::new());
        let Some(usual) = observed.usual_gap_ms else { return };
        let deadline = Instant::now() + longest.min(Duration::from_secs_f64(usual.max(0.0) / 1e3) * 2);
        while seen.count() as u64 == observed.outputs && Instant::now() < deadline {
            let left = deadline.saturating_duration_since(Instant::now());
            seen = self.seen.output.wait_timeout(seen, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Watched {
    fn lock(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Seen {
    fn count(&self) -> usize {
        self.0.values().map(Vec::len).sum()
    }

    /// `came_out`: the numbers that came out by the word of the instances. What is among them and was not seen here was lost on the
    /// way to the observer, as it may be on any edge that is not reliable: the change has not lost it. The pauses are those of the
    /// port whose longest one stands out most.
    pub(super) fn observation(&self, came_out: &HashMap<String, Numbers>) -> Observation {
        let mut all = Observation::default();
        let mut excess = f64::NEG_INFINITY;
        let unknown = Numbers::default();
        for (port, outputs) in &self.0 {
            let came_out = came_out.get(port).unwrap_or(&unknown);
            let mut sorted = outputs.clone();
            sorted.sort_unstable();
            all.outputs += sorted.len() as u64;
            let mut pauses = Vec::new();
            for pair in sorted.windows(2) {
                let [(epoch, seq, stamp), (next_epoch, next_seq, next_stamp)] = pair else { continue };
                if epoch != next_epoch {
                    continue;
                }
                if next_seq == seq {
                    all.duplicated += 1;
                    continue;
                }
                all.lost += came_out.missing_of(*epoch, seq + 1..*next_seq);
                pauses.push((next_stamp - stamp) as f64 / 1e6);
            }
            pauses.sort_by(f64::total_cmp);
            let (Some(longest), Some(usual)) = (pauses.last(), pauses.get(pauses.len() / 2)) else { continue };
            if longest - usual > excess {
                excess = longest - usual;
                (all.longest_gap_ms, all.usual_gap_ms) = (Some(*longest), Some(*usual));
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_what_is_missing_and_what_comes_twice() {
        let mut seen = Seen::default();
        let outputs = [(1, 0, 0), (1, 1, 10), (1, 3, 40), (1, 2, 30), (1, 3, 40), (1, 6, 90), (2, 0, 100)];
        seen.0.insert("lane".into(), outputs.iter().map(|&(e, s, ms)| (e, s, ms * 1_000_000)).collect());
        let observed = seen.observation(&HashMap::new());
        assert_eq!(
            (observed.outputs, observed.lost, observed.duplicated),
            (7, 2, 1),
            "4 and 5 are missing, 3 came twice"
        );
        let mut sent = Numbers::default();
        sent.add(1, 4);
        let observed = seen.observation(&HashMap::from([("lane".to_owned(), sent)]));
        assert_eq!((observed.lost, observed.duplicated), (1, 1), "4 came out, and did not get here");
        assert_eq!(observed.longest_gap_ms, Some(50.0), "from 3 to 6");
        assert_eq!(observed.usual_gap_ms, Some(20.0), "the median");
    }
}
