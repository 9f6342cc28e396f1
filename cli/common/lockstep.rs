//! A drive in lockstep: to its end or until it is stopped, and the newest message of a type.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Result;
use carril_messages::{Message, Stamp, TrackProgress};
use carril_runtime::executor::lockstep::Lockstep;
use carril_runtime::graph::Graph;

/// Between two looks at laps and at Ctrl-C, in virtual time.
pub const SLICE: Duration = Duration::from_millis(100);

/// Drives on until `seconds` of virtual time, `laps` or `stop`. `look` is called after each tenth of a second, with the laps where
/// the graph counts them; an error of it ends the drive.
pub fn drive_on(
    lockstep: &mut Lockstep,
    graph: &Graph,
    seconds: f64,
    laps: Option<u32>,
    stop: &AtomicBool,
    mut look: impl FnMut(&Lockstep, Option<u32>) -> Result<()>,
) -> Result<()> {
    let end = Stamp::ZERO + Duration::from_secs_f64(seconds);
    while lockstep.now() < end && !stop.load(Ordering::Relaxed) {
        lockstep.run_until((lockstep.now() + SLICE).min(end))?;
        let driven = newest::<TrackProgress>(lockstep, graph).map(|progress| progress.laps);
        look(lockstep, driven)?;
        if laps.is_some_and(|wanted| driven.is_some_and(|driven| driven >= wanted)) {
            break;
        }
    }
    Ok(())
}

/// The newest message of a type, from whichever node gives it.
pub fn newest<T: Message>(lockstep: &Lockstep, graph: &Graph) -> Option<Arc<T>> {
    let (node, port) = source::<T>(graph)?;
    lockstep.last::<T>(node, port)
}

/// The first node, and its output, that gives messages of a type.
pub fn source<T: Message>(graph: &Graph) -> Option<(&str, &str)> {
    graph.nodes.iter().find_map(|node| {
        let port = node.kind()?.outputs.iter().find(|port| port.message_type == T::TYPE)?;
        Some((node.name.as_str(), port.name))
    })
}
