//! What Zenoh's access control has refused at the gateway. Zenoh tells it to its trace log only; from there it is read, so that a put on
//! somebody else's key does not pass unseen. A test sends such puts and fails when another Zenoh words it otherwise.

use std::cell::RefCell;
use std::fmt::{self, Write};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::{Event, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

/// Says what is allowed and what is not, for each of the subjects that a link counts as; the last word counts.
const RULES: &str = "zenoh::net::routing::interceptor::access_control";
/// Says that the message at hand is dropped.
const DROPS: &str = "zenoh::net::routing::interceptor";
const DROPPED: &str = "Msg intercepted!";
/// Refusals that wait to be reported; more are counted by nobody.
const WAITING: usize = 1024;

/// Something was refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Who sent it: the identity of the link.
    pub identity: String,
    /// `put`, `delete`, `query`, `queryable`
    pub what: &'static str,
    /// On which key.
    pub key: String,
}

/// The layer for the program's log, and where the refusals come out.
pub fn layer<S: Subscriber + for<'a> LookupSpan<'a>>() -> (impl Layer<S>, Receiver<Refusal>) {
    let (sender, receiver) = sync_channel(WAITING);
    let filter = Targets::new().with_target(DROPS, LevelFilter::TRACE).with_target(RULES, LevelFilter::TRACE);
    (Listener { sender }.with_filter(filter), receiver)
}

struct Listener {
    sender: SyncSender<Refusal>,
}

thread_local! {
    /// The last word of the rules on this thread, if it was a refusal.
    static LAST: RefCell<Option<String>> = const { RefCell::new(None) };
}

impl<S: Subscriber> Layer<S> for Listener {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut message = Message::default();
        event.record(&mut message);
        let text = message.0;
        if event.metadata().target() == RULES {
            let refused = text.contains(" is unauthorized to ");
            LAST.with_borrow_mut(|last| *last = refused.then_some(text));
        } else if text == DROPPED
            && let Some(refusal) = LAST.take().as_deref().and_then(read)
        {
            // When nobody keeps up, it is a flood: those that are reported say enough.
            let _ = self.sender.try_send(refusal);
        }
    }
}

#[derive(Default)]
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            // Writing to a text cannot fail.
            let _ = write!(self.0, "{value:?}");
        }
    }
}

/// `<identity> on <subject> is unauthorized to Put (ingress) on <key>`, with or without `Using cached result: ` and the subject.
fn read(text: &str) -> Option<Refusal> {
    let text = text.strip_prefix("Using cached result: ").unwrap_or(text);
    let (who, rest) = text.split_once(" is unauthorized to ")?;
    let (what, key) = rest.split_once(" (ingress) on ")?;
    let what = match what {
        "Put" => "put",
        "Delete" => "delete",
        "Query" => "query",
        "Declare/Undeclare Queryable" => "queryable",
        _ => return None,
    };
    let identity = who.split_once(' ').map_or(who, |(identity, _)| identity);
    Some(Refusal { identity: identity.to_owned(), what, key: key.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_read_and_all_else_is_not() {
        let key = "carril/car1/decision/command";
        let expected = Some(Refusal { identity: "ab12".into(), what: "put", key: key.into() });
        let fresh = format!("ab12 on {{interface: lo}} is unauthorized to Put (ingress) on {key}");
        assert_eq!(read(&fresh), expected, "decided now");
        let cached = format!("Using cached result: ab12 is unauthorized to Put (ingress) on {key}");
        assert_eq!(read(&cached), expected, "decided before");
        for other in [
            format!("ab12 on x is authorized to Put (ingress) on {key}"),
            format!("ab12 on x is unauthorized to Put (egress) on {key}"),
            format!("ab12 on x is unauthorized to Liveliness Query (ingress) on {key}"),
            "Access control is enabled".into(),
        ] {
            assert_eq!(read(&other), None, "{other}");
        }
    }
}
