//! The newest sample of a port, at most so many times a second, to whoever shows it. What comes in between is dropped: nothing queues up
//! and nobody catches up on the past.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Header, Payload};
use carril_runtime::client::{Client, ClientError};
use carril_runtime::transport::Guard;

/// A subscription of a port. Ends when dropped.
pub struct Feed {
    slot: Arc<Slot>,
    _guard: Guard,
}

/// Between the transport's thread and the one that shows.
#[derive(Default)]
struct Slot {
    state: Mutex<State>,
    news: Condvar,
}

#[derive(Default)]
struct State {
    newest: Option<(Header, Payload)>,
    closed: bool,
}

impl Feed {
    /// Hears a port of the running graph. `show` runs on a thread of its own.
    pub fn open(
        client: &Client,
        (node, port): (&str, &str),
        pause: Duration,
        show: impl FnMut(&Header, &Payload) + Send + 'static,
    ) -> Result<Self, ClientError> {
        let slot = Arc::<Slot>::default();
        let heard = Arc::clone(&slot);
        let guard = client.subscribe(node, port, move |header, payload, _| heard.put(header, payload))?;
        let own = Arc::clone(&slot);
        std::thread::spawn(move || own.run(pause, show));
        Ok(Self { slot, _guard: guard })
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        let mut state = self.slot.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.closed = true;
        state.newest = None;
        self.slot.news.notify_one();
    }
}

impl Slot {
    fn put(&self, header: Header, payload: Payload) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if !state.closed {
            state.newest = Some((header, payload));
            self.news.notify_one();
        }
    }

    fn run(&self, pause: Duration, mut show: impl FnMut(&Header, &Payload)) {
        let mut due = Instant::now();
        while let Some((header, payload)) = self.take(due) {
            show(&header, &payload);
            // A port as fast as the limit keeps its rate although its samples come now a bit early, now a bit late.
            due = (due + pause).max(Instant::now());
        }
    }

    /// The newest sample, not before `due`. `None`: closed.
    fn take(&self, due: Instant) -> Option<(Header, Payload)> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if state.closed {
                return None;
            }
            let rest = due.saturating_duration_since(Instant::now());
            state = if rest > Duration::ZERO {
                self.news.wait_timeout(state, rest).unwrap_or_else(PoisonError::into_inner).0
            } else if let Some(newest) = state.newest.take() {
                return Some(newest);
            } else {
                self.news.wait(state).unwrap_or_else(PoisonError::into_inner)
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Command, Message, Meta, Origins, Stamp};

    use super::*;

    fn sample(seq: u64) -> (Header, Payload) {
        let (stamp, origins) = (Stamp::ZERO, Origins::none());
        (Header { epoch: 0, seq, stamp, origins, message_type: Command::TYPE, meta: Meta::new() }, Payload::default())
    }

    #[test]
    fn only_the_newest_sample_is_shown() {
        let slot = Slot::default();
        for seq in 0..5 {
            let (header, payload) = sample(seq);
            slot.put(header, payload);
        }
        let (header, _) = slot.take(Instant::now()).expect("it is open");
        assert_eq!(header.seq, 4, "those before it are gone");
        assert!(slot.state.lock().expect("no panic").newest.is_none(), "nothing waits");
    }

    #[test]
    fn the_thread_ends_with_its_feed() {
        let slot = Arc::<Slot>::default();
        let own = Arc::clone(&slot);
        let (tell, told) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            // An hour until the next sample may be shown: closing must not wait for it.
            own.run(Duration::from_secs(3600), |header, _| tell.send(header.seq).expect("the test listens"));
        });
        let (header, payload) = sample(7);
        slot.put(header, payload);
        assert_eq!(told.recv(), Ok(7), "the first one is shown at once");
        drop(Feed { slot: Arc::clone(&slot), _guard: Box::new(()) });
        thread.join().expect("it ends");
        let (header, payload) = sample(8);
        slot.put(header, payload);
        assert!(slot.state.lock().expect("no panic").newest.is_none(), "a closed feed holds nothing");
    }
}
