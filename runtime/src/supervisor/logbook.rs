//! The log of a run: what its processes said and what became of them, the last lines for whoever asks, each new one for whoever listens.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;

use super::{Event, SUPERVISOR};
use crate::clock::Clock;
use crate::control_plane::{LogLevel, LogLine, Outcome, log_key, said_key};
use crate::transport::zenoh::ZenohTransport;
use crate::transport::{Guard, TransportError};

/// So many lines are kept.
const KEPT_LINES: usize = 500;

/// Keeps and tells the log until the last sender of events is gone. Also hears what tools have to say.
pub(super) fn keep(
    transport: &ZenohTransport,
    robot: &str,
    clock: Arc<dyn Clock>,
    mut events: Receiver<Event>,
) -> Result<[Guard; 2], TransportError> {
    let book = Arc::new(Book { lines: Mutex::default(), transport: transport.clone(), key: log_key(robot) });
    let asked = Arc::clone(&book);
    let answers = transport.answer(&book.key, move |question| {
        let lines = asked.lines.lock().unwrap_or_else(PoisonError::into_inner).clone();
        question.answer(serde_json::to_vec(&lines).map_err(|error| error.to_string()));
    })?;
    let (said, hears) = std::sync::mpsc::channel();
    let hears_said = transport.watch(&said_key(robot), move |_, _, payload| {
        if let Ok(line) = serde_json::from_slice::<LogLine>(&payload) {
            // The book is closed with the run.
            let _ = said.send(line);
        }
    })?;
    // Not on the thread of the transport, which must not wait for room to send.
    let of_tools = Arc::clone(&book);
    std::thread::spawn(move || hears.iter().for_each(|line| of_tools.add(line)));
    std::thread::spawn(move || {
        loop {
            let event = match events.blocking_recv() {
                Ok(event) => event,
                Err(RecvError::Lagged(missed)) => {
                    let text = format!("warning: {missed} lines came faster than they could be passed on");
                    Event::Line { process: SUPERVISOR.into(), text }
                }
                Err(RecvError::Closed) => return,
            };
            let (level, process, text) = read(event);
            book.add(LogLine { stamp: clock.now(), level, process, text });
        }
    });
    Ok([answers, hears_said])
}

struct Book {
    lines: Mutex<VecDeque<LogLine>>,
    transport: ZenohTransport,
    key: String,
}

impl Book {
    fn add(&self, line: LogLine) {
        if let Ok(bytes) = serde_json::to_vec(&line)
            && let Err(error) = self.transport.put(&self.key, None, bytes)
        {
            tracing::debug!("passing on the log: {error}");
        }
        let mut lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.len() == KEPT_LINES {
            lines.pop_front();
        }
        lines.push_back(line);
    }
}

/// Level, process and text.
fn read(event: Event) -> (LogLevel, String, String) {
    let own = || SUPERVISOR.to_owned();
    match event {
        Event::Line { process, text } => {
            let (level, text) = level_of(&text);
            (level, process, text.to_owned())
        }
        Event::Ready { process } => (LogLevel::Debug, process, "is up".into()),
        Event::AllReady(after) => {
            (LogLevel::Info, own(), format!("all processes up after {:.2} s", after.as_secs_f64()))
        }
        Event::Died { process, how, again_in: Some(_) } => {
            (LogLevel::Error, process, format!("died: {how}; starts again"))
        }
        Event::Died { process, how, again_in: None } => (LogLevel::Error, process, format!("died: {how}; stays down")),
        Event::GaveUp { process, nodes, why } => {
            let nodes = nodes.join(", carril restart ");
            (LogLevel::Error, process, format!("stays down: {why}; start it again: carril restart {nodes}"))
        }
        Event::Fault(fault) => (LogLevel::Error, fault.node, format!("the car is stopped: {}", fault.reason)),
        Event::Machine(machine) => {
            let (level, what) =
                if machine.joined { (LogLevel::Info, "has joined") } else { (LogLevel::Warning, "has left") };
            (level, own(), format!("machine `{}` {what}, which runs {}", machine.machine, machine.nodes.join(", ")))
        }
        Event::Changed(receipt) => {
            let went_well = matches!(receipt.outcome, Outcome::Done | Outcome::Compared | Outcome::Planned);
            let reason = receipt.reason.map(|reason| format!(": {reason}")).unwrap_or_default();
            let text = format!("{} {}{reason}", receipt.what, receipt.outcome);
            (if went_well { LogLevel::Info } else { LogLevel::Warning }, receipt.node, text)
        }
        Event::Applied(receipt) => {
            let reason = receipt.reason.map(|reason| format!(": {reason}")).unwrap_or_default();
            (LogLevel::Info, own(), format!("apply {}{reason}", receipt.outcome))
        }
        Event::Stopping => (LogLevel::Info, own(), "stopping: first the car, then the graph".into()),
    }
}

/// The level that a line begins with, as our processes write it; binaries of the user's own write what they like.
fn level_of(text: &str) -> (LogLevel, &str) {
    for (begin, level) in [("error: ", LogLevel::Error), ("warning: ", LogLevel::Warning), ("debug: ", LogLevel::Debug)]
    {
        if let Some(rest) = text.strip_prefix(begin) {
            return (level, rest);
        }
    }
    (LogLevel::Info, text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control_plane::Receipt;

    #[test]
    fn a_line_has_the_level_that_it_begins_with() {
        let line = |text: &str| read(Event::Line { process: "lane".into(), text: text.into() });
        assert_eq!(line("warning: dim"), (LogLevel::Warning, "lane".into(), "dim".into()), "a warning");
        assert_eq!(line("hello"), (LogLevel::Info, "lane".into(), "hello".into()), "no level: information");
        let (node, what) = ("lane".to_owned(), "swap".to_owned());
        let receipt = Receipt {
            node,
            what,
            outcome: Outcome::RolledBack,
            reason: Some("it panicked".into()),
            ..Receipt::default()
        };
        let told = read(Event::Changed(Box::new(receipt)));
        assert_eq!(
            told,
            (LogLevel::Warning, "lane".into(), "swap rolled back: it panicked".into()),
            "a receipt in words"
        );
        let fault = Event::Fault(crate::control_plane::FaultReport { node: "bridge".into(), reason: "late".into() });
        assert_eq!(read(fault).0, LogLevel::Error, "a stopped car is an error");
    }
}
