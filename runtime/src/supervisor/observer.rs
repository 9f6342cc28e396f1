//! Watches the outputs of a node from outside while it is replaced: counts what is missing, what comes twice, and the longest
//! pause. It belongs to neither instance, so that its word counts.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use carril_messages::{Header, Key};

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
struct Seen(HashMap<String, Vec<(u64, u64, i64)>>);

pub(super) struct Observer {
    seen: Arc<Mutex<Seen>>,
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
        let seen: Arc<Mutex<Seen>> = Arc::default();
        let mut guards = Vec::new();
        for port in ports {
            let (seen, name) = (Arc::clone(&seen), port.clone());
            guards.push(transport.watch(&Key::new(robot, node, port).to_string(), move |_, header, _| {
                if let Ok(header) = Header::decode(header) {
                    let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
                    let outputs = seen.0.entry(name.clone()).or_default();
                    if outputs.len() < REMEMBERED {
                        outputs.push((header.epoch, header.seq, header.stamp.as_nanos()));
                    }
                }
            })?);
        }
        Ok(Self { seen, _guards: guards })
    }

    pub(super) fn observation(&self) -> Observation {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner).observation()
    }
}

impl Seen {
    /// The pauses are those of the port whose longest one stands out most.
    fn observation(&self) -> Observation {
        let mut all = Observation::default();
        let mut excess = f64::NEG_INFINITY;
        for outputs in self.0.values() {
            let mut sorted = outputs.clone();
            sorted.sort_unstable();
            all.outputs += sorted.len() as u64;
            let mut pauses = Vec::new();
            for pair in sorted.windows(2) {
                let [(epoch, seq, stamp), (next_epoch, next_seq, next_stamp)] = pair else { continue };
                if epoch != next_epoch {
                    continue;
                }
                match next_seq - seq {
                    0 => all.duplicated += 1,
                    distance => {
                        all.lost += distance - 1;
                        pauses.push((next_stamp - stamp) as f64 / 1e6);
                    }
                }
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
        let observed = seen.observation();
        assert_eq!(
            (observed.outputs, observed.lost, observed.duplicated),
            (7, 2, 1),
            "4 and 5 are missing, 3 came twice"
        );
        assert_eq!(observed.longest_gap_ms, Some(50.0), "from 3 to 6");
        assert_eq!(observed.usual_gap_ms, Some(20.0), "the median");
    }
}
