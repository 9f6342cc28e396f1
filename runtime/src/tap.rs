//! What supervisor and tools do alike on the link of a running graph: hear ports and health, and pass words on.

use std::sync::Arc;
use std::time::Duration;

use carril_messages::{Control, Header, Health, Key, Message, Payload, Stamp};

use crate::clock::Clock;
use crate::control_plane::{ControlReply, control_key};
use crate::process::CONTROL_PATIENCE;
use crate::transport::zenoh::ZenohTransport;
use crate::transport::{Guard, TransportError};

/// What a process needs beyond the patience of its nodes to answer.
const MARGIN: Duration = Duration::from_millis(500);

/// Hears a port. Samples without a readable header are left out.
pub(crate) fn subscribe(
    transport: &ZenohTransport,
    clock: &Arc<dyn Clock>,
    robot: &str,
    (node, port): (&str, &str),
    hear: impl Fn(Header, Payload, Stamp) + Send + Sync + 'static,
) -> Result<Guard, TransportError> {
    let clock = Arc::clone(clock);
    transport.watch(&Key::new(robot, node, port).to_string(), move |_, header, payload| {
        if let Ok(header) = Header::decode(header) {
            hear(header, payload, clock.now());
        }
    })
}

/// Tells all nodes of all processes; an answer, or an error text, per process.
pub(crate) fn control(
    transport: &ZenohTransport,
    robot: &str,
    control: Control,
) -> Result<Vec<Result<ControlReply, String>>, TransportError> {
    let word = serde_json::to_vec(&control)
        .map_err(|error| TransportError::Link { doing: format!("saying `{control}`"), reason: error.to_string() })?;
    let answers = transport.ask(&control_key(robot, "*"), word, CONTROL_PATIENCE + MARGIN)?;
    let read = |answer: Vec<u8>| serde_json::from_slice(&answer).map_err(|error| error.to_string());
    Ok(answers.into_iter().map(|answer| answer.and_then(read)).collect())
}

/// Reads the health of a node as its process puts it. `None`: it is none.
pub(crate) fn read_health(header: &[u8], payload: &Payload) -> Option<Health> {
    let header = Header::decode(header).ok()?;
    header.expect::<Health>().ok()?;
    Health::decode(&header.meta, payload).ok()
}
