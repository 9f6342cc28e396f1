//! The thread between the two devices: reads packets, asks the schedule what is due, writes it to the other side. Decides nothing.

use std::fs::File;
use std::io::{self, Read, Write};
use std::net::Shutdown;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::prctl::set_timerslack;
use nix::sys::signal::SigSet;
use nix::sys::time::TimeSpec;

use crate::kernel;
use crate::schedule::{Direction, Schedule};

/// The largest IP packet.
const MAX_PACKET_BYTES: usize = 65_535;
/// Packets read from one device before the other has its turn, and what is due is written.
const READ_AT_ONCE: usize = 32;

struct Shared {
    schedule: Mutex<Schedule<Vec<u8>>>,
    started: Instant,
    failure: Mutex<Option<String>>,
}

/// A running relay; ends with this value.
pub struct Relay {
    shared: Arc<Shared>,
    /// A byte wakes the thread, the end of file ends it.
    wake: UnixStream,
    thread: Option<JoinHandle<()>>,
}

impl Relay {
    /// Begins. The devices are in the order of the directions in which they send: the car's first.
    pub fn start(schedule: Schedule<Vec<u8>>, devices: [File; 2]) -> io::Result<Self> {
        let (wake, woken) = UnixStream::pair()?;
        wake.set_nonblocking(true)?;
        woken.set_nonblocking(true)?;
        let shared =
            Arc::new(Shared { schedule: Mutex::new(schedule), started: Instant::now(), failure: Mutex::new(None) });
        let thread = thread::Builder::new().name("wifi-link".into()).spawn({
            let shared = Arc::clone(&shared);
            move || {
                if let Err(error) = relay(&shared, &devices, &woken) {
                    *locked(&shared.failure) = Some(error.to_string());
                }
            }
        })?;
        Ok(Self { shared, wake, thread: Some(thread) })
    }

    /// Does something with the schedule at the present time. Nothing passes meanwhile.
    pub fn with<T>(&self, act: impl FnOnce(&mut Schedule<Vec<u8>>, Duration) -> T) -> T {
        let mut schedule = locked(&self.shared.schedule);
        let result = act(&mut schedule, self.shared.started.elapsed());
        drop(schedule);
        // A full pipe wakes just as well.
        let _ = (&self.wake).write(&[0]);
        result
    }

    /// Why it relays no longer, if it does not.
    pub fn failure(&self) -> Option<String> {
        locked(&self.shared.failure).clone()
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        // Not only closed: a child between fork and exec may hold a copy.
        let _ = self.wake.shutdown(Shutdown::Both);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread was printed by it, and this may run in a panic itself.
            let _ = thread.join();
        }
    }
}

/// A panic elsewhere leaves nothing half done that matters here.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn relay(shared: &Shared, devices: &[File; 2], woken: &UnixStream) -> io::Result<()> {
    // Signals are for the threads of whoever uses this.
    SigSet::all().thread_block()?;
    // The kernel's 50 us of slack would add to every delay.
    set_timerslack(1)?;
    kernel::hurry();
    let mut buffer = vec![0; MAX_PACKET_BYTES];
    loop {
        let next = {
            let mut schedule = locked(&shared.schedule);
            for direction in Direction::BOTH {
                take_packets(&mut schedule, direction, &devices[direction as usize], shared.started, &mut buffer)?;
            }
            while let Some((direction, packet)) = schedule.due(shared.started.elapsed()) {
                // Fails while the device is down. The link goes on, as the air does when a receiver is off.
                if (&devices[1 - direction as usize]).write(&packet).is_err() {
                    schedule.refused(direction, packet.len());
                }
            }
            schedule.next_event()
        };
        let mut fds = [
            PollFd::new(devices[0].as_fd(), PollFlags::POLLIN),
            PollFd::new(devices[1].as_fd(), PollFlags::POLLIN),
            PollFd::new(woken.as_fd(), PollFlags::POLLIN),
        ];
        let timeout = next.map(|next| TimeSpec::from_duration(next.saturating_sub(shared.started.elapsed())));
        match ppoll(&mut fds, timeout, None) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(error) => return Err(error.into()),
        }
        if fds[2].any() == Some(true) && has_ended(woken) {
            return Ok(());
        }
    }
}

/// Hands waiting packets to the schedule.
fn take_packets(
    schedule: &mut Schedule<Vec<u8>>,
    direction: Direction,
    mut device: &File,
    started: Instant,
    buffer: &mut [u8],
) -> io::Result<()> {
    for _ in 0..READ_AT_ONCE {
        match device.read(buffer) {
            Ok(len) => schedule.offer(started.elapsed(), direction, len, buffer[..len].to_vec()),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(io::Error::new(error.kind(), format!("the network device is gone: {error}"))),
        }
    }
    Ok(())
}

/// Takes the bytes that woke us.
fn has_ended(mut woken: &UnixStream) -> bool {
    let mut bytes = [0; 64];
    loop {
        match woken.read(&mut bytes) {
            Ok(0) => return true,
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(_) => return false,
        }
    }
}
