//! Carries the newest sample of a port from one session to another, on a thread of its own: the threads of a transport must not wait for
//! room in another one, nor for a picture to be made.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use carril_messages::{Header, Payload};

/// A sample on its way.
pub type Sample = (Header, Payload);

/// Holds the newest of something until it is taken.
#[derive(Debug)]
pub struct Latest<T> {
    state: Mutex<(Option<T>, bool)>,
    came: Condvar,
}

impl<T> Default for Latest<T> {
    fn default() -> Self {
        Self { state: Mutex::new((None, false)), came: Condvar::new() }
    }
}

impl<T> Latest<T> {
    fn lock(&self) -> MutexGuard<'_, (Option<T>, bool)> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts a newer one in the place of whatever waits.
    pub fn put(&self, value: T) {
        self.lock().0 = Some(value);
        self.came.notify_one();
    }

    /// Nothing is taken any more.
    pub fn close(&self) {
        self.lock().1 = true;
        self.came.notify_all();
    }

    /// Waits for one. `None`: it is closed.
    pub fn take(&self) -> Option<T> {
        let mut state = self.lock();
        loop {
            if state.1 {
                return None;
            }
            if let Some(value) = state.0.take() {
                return Some(value);
            }
            state = self.came.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// Carries until it is dropped.
pub struct Carrier {
    latest: Arc<Latest<Sample>>,
    thread: Option<JoinHandle<()>>,
}

impl Carrier {
    /// Calls `carry` with the newest sample, again and again.
    pub fn start(mut carry: impl FnMut(Sample) + Send + 'static) -> Self {
        let latest: Arc<Latest<Sample>> = Arc::default();
        let taken = Arc::clone(&latest);
        let thread = std::thread::spawn(move || {
            while let Some(sample) = taken.take() {
                carry(sample);
            }
        });
        Self { latest, thread: Some(thread) }
    }

    /// Where samples are put in.
    pub fn slot(&self) -> Arc<Latest<Sample>> {
        Arc::clone(&self.latest)
    }
}

impl Drop for Carrier {
    fn drop(&mut self) {
        self.latest.close();
        if let Some(thread) = self.thread.take() {
            // If it panicked, it has said so.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_newer_one_takes_the_place_of_what_waits() {
        let latest = Latest::default();
        (0..5).for_each(|number| latest.put(number));
        assert_eq!(latest.take(), Some(4), "the newest");
        latest.put(5);
        latest.close();
        assert_eq!(latest.take(), None, "closed, whatever waits");
    }
}
