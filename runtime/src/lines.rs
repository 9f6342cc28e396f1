//! Serial lines that exist only in memory, for lockstep: what one end writes, the other reads, and is woken for.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::setup::Waker;

/// No line holds more unread bytes per direction; more is lost, as on a real line that nobody reads.
pub const LINE_CAPACITY_BYTES: usize = 4096;

/// Which end of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The computer.
    Host,
    /// The microcontroller.
    Device,
}

/// The lines of one lockstep run, by name. Cloning gives another handle to the same lines.
#[derive(Clone, Default)]
pub struct MemoryLines(Arc<Mutex<HashMap<String, Arc<Mutex<Wire>>>>>);

#[derive(Default)]
struct Wire {
    to_host: VecDeque<u8>,
    to_device: VecDeque<u8>,
    host: Option<Waker>,
    device: Option<Waker>,
    cut: bool,
}

/// One end of a line.
pub struct MemoryLine {
    wire: Arc<Mutex<Wire>>,
    end: End,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl MemoryLines {
    /// Opens one end. `waker` is called when bytes arrive there. Opening an end again replaces its waker.
    pub fn open(&self, name: &str, end: End, waker: Waker) -> MemoryLine {
        let wire = Arc::clone(lock(&self.0).entry(name.to_owned()).or_default());
        match end {
            End::Host => lock(&wire).host = Some(waker),
            End::Device => lock(&wire).device = Some(waker),
        }
        MemoryLine { wire, end }
    }

    /// Cuts or mends the line: what is written while it is cut is lost.
    pub fn set_cut(&self, name: &str, cut: bool) {
        lock(lock(&self.0).entry(name.to_owned()).or_default()).cut = cut;
    }
}

impl MemoryLine {
    /// Moves what has arrived to the end of `buffer`.
    pub fn read_into(&self, buffer: &mut Vec<u8>) {
        let mut wire = lock(&self.wire);
        match self.end {
            End::Host => buffer.extend(wire.to_host.drain(..)),
            End::Device => buffer.extend(wire.to_device.drain(..)),
        }
    }

    /// Sends bytes to the other end and wakes it.
    pub fn write(&self, bytes: &[u8]) {
        let waker = {
            let mut wire = lock(&self.wire);
            if wire.cut {
                return;
            }
            let (queue, peer) = match self.end {
                End::Host => (&mut wire.to_device, End::Device),
                End::Device => (&mut wire.to_host, End::Host),
            };
            let room = LINE_CAPACITY_BYTES - queue.len();
            queue.extend(&bytes[..bytes.len().min(room)]);
            match peer {
                End::Host => wire.host.clone(),
                End::Device => wire.device.clone(),
            }
        };
        if let Some(waker) = waker {
            waker.wake();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    #[test]
    fn carries_bytes_both_ways_and_wakes_the_reader() {
        let lines = MemoryLines::default();
        let woken = Arc::new(AtomicU32::new(0));
        let counter = Arc::clone(&woken);
        let host = lines.open(
            "mcu",
            End::Host,
            Waker::new(move || {
                counter.fetch_add(1, Ordering::Relaxed);
            }),
        );
        let device = lines.open("mcu", End::Device, Waker::new(|| ()));
        host.write(b"to device");
        device.write(b"to host");
        let (mut at_host, mut at_device) = (Vec::new(), Vec::new());
        host.read_into(&mut at_host);
        device.read_into(&mut at_device);
        assert_eq!((&at_host[..], &at_device[..]), (&b"to host"[..], &b"to device"[..]), "both directions");
        assert_eq!(woken.load(Ordering::Relaxed), 1, "the host was woken once");
    }

    #[test]
    fn loses_bytes_when_cut_or_full() {
        let lines = MemoryLines::default();
        let host = lines.open("mcu", End::Host, Waker::new(|| ()));
        let device = lines.open("mcu", End::Device, Waker::new(|| ()));
        lines.set_cut("mcu", true);
        host.write(b"lost");
        lines.set_cut("mcu", false);
        host.write(&[0; LINE_CAPACITY_BYTES + 7]);
        let mut read = Vec::new();
        device.read_into(&mut read);
        assert_eq!(read.len(), LINE_CAPACITY_BYTES, "nothing from the cut, no more than the capacity");
    }
}
