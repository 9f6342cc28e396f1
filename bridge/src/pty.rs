//! The simulated microcontroller's end of a live line: a real pseudo-terminal with a name in the folder of the run. It stays
//! when the host closes and reopens its end, and goes with its name when it is dropped.

use std::io;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use carril_messages::Stamp;
use carril_runtime::Waker;
use carril_runtime::clock::Clock;
use nix::errno::Errno;
use nix::fcntl::OFlag;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};

/// So long does closing take at most.
const POLL_MS: u16 = 100;
/// Between two looks whether a host has opened its end.
const ABSENT_PAUSE: Duration = Duration::from_millis(5);
/// Chunks of bytes that wait for the next step; more are lost, as in a chip that is too slow.
const MAX_CHUNKS: usize = 256;

/// A pseudo-terminal with a name.
pub struct Pty {
    shared: Arc<Shared>,
    link: PathBuf,
    device: PathBuf,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    master: PtyMaster,
    chunks: Mutex<Vec<(Stamp, Vec<u8>)>>,
    host_is_there: AtomicBool,
    stop: AtomicBool,
}

impl Shared {
    fn chunks(&self) -> MutexGuard<'_, Vec<(Stamp, Vec<u8>)>> {
        self.chunks.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Pty {
    /// Makes one whose other end is reached through `link`; what stood there before is replaced. `waker` is called when bytes
    /// have come, `clock` stamps them.
    pub fn create(link: PathBuf, clock: Arc<dyn Clock>, waker: Waker) -> io::Result<Self> {
        let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC | OFlag::O_NONBLOCK)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let device = PathBuf::from(ptsname_r(&master)?);
        let mut settings = tcgetattr(&master)?;
        cfmakeraw(&mut settings);
        tcsetattr(&master, SetArg::TCSANOW, &settings)?;
        // Until the other end has been opened and closed once, the system does not tell that nobody is there.
        drop(std::fs::OpenOptions::new().read(true).write(true).open(&device)?);
        let shared = Arc::new(Shared {
            master,
            chunks: Mutex::default(),
            host_is_there: AtomicBool::new(false),
            stop: AtomicBool::new(false),
        });
        let thread = {
            let shared = Arc::clone(&shared);
            thread::Builder::new().name("pty-read".to_owned()).spawn(move || read_on(&shared, &*clock, &waker))?
        };
        let pty = Self { shared, link, device, thread: Some(thread) };
        replace_link(&pty.device, &pty.link)?;
        Ok(pty)
    }

    /// Takes what has arrived, with the times at which it did.
    pub fn take(&self) -> Vec<(Stamp, Vec<u8>)> {
        std::mem::take(&mut *self.shared.chunks())
    }

    /// Sends bytes. Lost when nobody is there or nobody reads, as on a real line.
    pub fn write(&self, bytes: &[u8]) {
        if self.shared.host_is_there.load(Ordering::Acquire) {
            // A full line takes a part or nothing; the receiver's checksum tells.
            let _ = nix::unistd::write(&self.shared.master, bytes);
        }
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already said so.
            let _ = thread.join();
        }
        if std::fs::read_link(&self.link).is_ok_and(|target| target == self.device) {
            // Whoever opens a name that leads nowhere gets an error that says so.
            let _ = std::fs::remove_file(&self.link);
        }
    }
}

/// Puts the link in its place in one step, so that no reader ever sees none.
fn replace_link(device: &Path, link: &Path) -> io::Result<()> {
    let mut fresh = link.as_os_str().to_owned();
    fresh.push(format!(".{}", std::process::id()));
    let fresh = PathBuf::from(fresh);
    match std::fs::remove_file(&fresh) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    std::os::unix::fs::symlink(device, &fresh)?;
    std::fs::rename(&fresh, link)
}

fn read_on(shared: &Shared, clock: &dyn Clock, waker: &Waker) {
    let mut buffer = [0; 512];
    while !shared.stop.load(Ordering::Acquire) {
        let mut watched = [PollFd::new(shared.master.as_fd(), PollFlags::POLLIN)];
        let ready = poll(&mut watched, PollTimeout::from(POLL_MS));
        let hung_up = watched[0].revents().is_some_and(|events| events.contains(PollFlags::POLLHUP));
        shared.host_is_there.store(!hung_up, Ordering::Release);
        if matches!(ready, Ok(0)) {
            continue;
        }
        match nix::unistd::read(&shared.master, &mut buffer) {
            Ok(len) if len > 0 => {
                let mut chunks = shared.chunks();
                if chunks.len() < MAX_CHUNKS {
                    chunks.push((clock.now(), buffer[..len].to_vec()));
                }
                drop(chunks);
                waker.wake();
            }
            Err(Errno::EINTR | Errno::EAGAIN) => {}
            // EIO: the host has closed its end. It may come back.
            Ok(_) | Err(_) => thread::sleep(ABSENT_PAUSE),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::os::unix::fs::OpenOptionsExt;
    use std::time::Instant;

    use carril_runtime::clock::LiveClock;

    use super::*;

    fn open(link: &Path) -> std::fs::File {
        let flags = (OFlag::O_NONBLOCK | OFlag::O_NOCTTY).bits();
        std::fs::OpenOptions::new().read(true).write(true).custom_flags(flags).open(link).expect("the name opens")
    }

    fn until(mut reached: impl FnMut() -> bool) {
        let started = Instant::now();
        while !reached() {
            assert!(started.elapsed() < Duration::from_secs(60), "waited a minute");
            thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn carries_every_byte_both_ways_and_keeps_nothing_for_a_host_that_is_not_there() {
        let folder = tempfile::tempdir().expect("a folder");
        let link = folder.path().join("mcu");
        let woken = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&woken);
        let waker = Waker::new(move || flag.store(true, Ordering::Release));
        let clock = Arc::new(LiveClock::anchored_now());
        let pty = Pty::create(link.clone(), clock, waker).expect("a terminal");
        let every_byte: Vec<u8> = (0..=255).collect();
        for _ in 0..2 {
            until(|| !pty.shared.host_is_there.load(Ordering::Acquire));
            pty.write(b"old");
            let mut host = open(&link);
            let mut buffer = [0; 512];
            assert!(host.read(&mut buffer).is_err(), "nothing was kept");
            until(|| pty.shared.host_is_there.load(Ordering::Acquire));
            host.write_all(&every_byte).expect("there is room");
            let mut got = Vec::new();
            until(|| {
                got.extend(pty.take().into_iter().flat_map(|(_, bytes)| bytes));
                got.len() >= every_byte.len()
            });
            assert_eq!(got, every_byte, "raw, to the chip");
            until(|| woken.swap(false, Ordering::AcqRel));
            pty.write(&every_byte);
            got.clear();
            until(|| {
                let len = host.read(&mut buffer).unwrap_or(0);
                got.extend_from_slice(&buffer[..len]);
                got.len() >= every_byte.len()
            });
            assert_eq!(got, every_byte, "raw, to the host");
        }
    }
}
