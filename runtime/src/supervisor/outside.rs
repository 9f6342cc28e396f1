//! What the gateway says of those who are connected from other machines: kept here, where every tool of the run can ask for it. Tools are
//! linked to the supervisor and the processes, not to each other.

use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::monitor::Message;
use crate::control_plane::{Who, gateway_key, who_key};
use crate::transport::zenoh::ZenohTransport;
use crate::transport::{Guard, TransportError};

/// A gateway that has said nothing for longer is gone.
pub(super) const SILENCE: Duration = Duration::from_secs(5);

/// Hears the gateway, tells the monitor which machines have joined, and answers who is connected; nothing while there is no gateway.
pub(super) fn listen(
    transport: &ZenohTransport,
    robot: &str,
    monitor: &Sender<Message>,
) -> Result<[Guard; 2], TransportError> {
    let last: Arc<Mutex<Option<(Instant, Who)>>> = Arc::default();
    let (heard, monitor) = (Arc::clone(&last), monitor.clone());
    let hears = transport.watch(&gateway_key(robot), move |_, _, payload| {
        if let Ok(who) = serde_json::from_slice::<Who>(&payload) {
            // The monitor ends last.
            let _ = monitor.send(Message::Machines(who.machines.clone()));
            *heard.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), who));
        }
    })?;
    let answers = transport.answer(&who_key(robot), move |question| {
        let last = last.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let who = last.filter(|(said, _)| said.elapsed() < SILENCE).map(|(_, who)| who);
        question.answer(serde_json::to_vec(&who).map_err(|error| error.to_string()));
    })?;
    Ok([hears, answers])
}
