//! The host's end of the serial line: the one file that opens a serial port. In lockstep the line is memory. Live, a thread
//! opens, reads and reopens the port, and another writes, so that no step ever waits for the line.
//!
//! Bytes go out in two classes: what is urgent, in order; then the newest command. A command that could not be written before
//! the next one came is overtaken, and nothing that waited during an outage is written after it.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use carril_messages::Stamp;
use carril_runtime::clock::Clock;
use carril_runtime::lines::{End, MemoryLine};
use carril_runtime::{Setup, SetupError, Waker};
use serialport::{ClearBuffer, SerialPort, TTYPort};

/// Begins the name of a line that ends in a simulated microcontroller.
pub const SIMULATED: &str = "sim:";

/// Longest wait of the threads for anything; so long does closing take at most.
const POLL: Duration = Duration::from_millis(100);
/// First and longest pause between two tries to open the port.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(20), Duration::from_millis(250));
/// Bytes that wait for the next step, and urgent bytes that wait to be written; more are lost, the oldest first.
const INBOX_BYTES: usize = 16 * 1024;
const URGENT_BYTES: usize = 1024;

/// What happened on the line since it was last asked.
#[derive(Debug)]
pub enum LineEvent {
    /// The port is open.
    Opened,
    /// The port is lost, or could not be opened. Comes once until it is open again.
    Closed(String),
    /// Bytes, with the time at which they arrived.
    Bytes(Stamp, Vec<u8>),
}

/// The host's end of a line. No function of it ever waits for the line.
pub trait Line: Send {
    /// What happened since the last call, in order.
    fn poll(&mut self, now: Stamp, events: &mut Vec<LineEvent>);
    /// Sends bytes before any command, in order.
    fn send_urgent(&mut self, bytes: &[u8]);
    /// Sends a command; one that still waits is overtaken.
    fn send_command(&mut self, bytes: &[u8]);
}

/// What becomes of the line DTR of a serial port when it is opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dtr {
    /// As the kernel has it, which is: set. It restarts many boards.
    Set,
    /// Cleared: an RPLIDAR A1 turns.
    Clear,
}

/// Opens the line that `port` names: `sim:NAME`, or the path of a device.
pub fn open(port: &str, baud: u32, dtr: Dtr, setup: &Setup) -> Result<Box<dyn Line>, SetupError> {
    let simulated = port.strip_prefix(SIMULATED);
    if let Some(lines) = &setup.memory_lines {
        let Some(name) = simulated else {
            return Err(SetupError::new(format!(
                "port `{port}` is a device, and devices do not exist in virtual time; set `port: \"sim:NAME\"` with a \
                 `sim-mcu` (for a lidar `sim-rplidar`) node on that line, or use `carril run`"
            )));
        };
        return Ok(Box::new(MemoryPort::new(lines.open(name, End::Host, setup.waker.clone()))));
    }
    let path = match (simulated, &setup.run_dir) {
        (None, _) => setup.path(port),
        (Some(name), Some(run_dir)) => run_dir.join(name),
        (Some(_), None) => {
            return Err(SetupError::new(format!("port `{port}` needs the folder of a run; use `carril run`")));
        }
    };
    open_device(path, baud, dtr, Arc::clone(&setup.clock), setup.waker.clone())
}

/// Opens the line of a device.
pub fn open_device(
    path: PathBuf,
    baud: u32,
    dtr: Dtr,
    clock: Arc<dyn Clock>,
    waker: Waker,
) -> Result<Box<dyn Line>, SetupError> {
    Ok(Box::new(SerialLine::open(path, baud, dtr, clock, waker)?))
}

/// A line in memory.
struct MemoryPort {
    line: MemoryLine,
    opened: bool,
}

impl MemoryPort {
    fn new(line: MemoryLine) -> Self {
        Self { line, opened: false }
    }
}

impl Line for MemoryPort {
    fn poll(&mut self, now: Stamp, events: &mut Vec<LineEvent>) {
        if !std::mem::replace(&mut self.opened, true) {
            events.push(LineEvent::Opened);
        }
        let mut bytes = Vec::new();
        self.line.read_into(&mut bytes);
        if !bytes.is_empty() {
            events.push(LineEvent::Bytes(now, bytes));
        }
    }

    fn send_urgent(&mut self, bytes: &[u8]) {
        self.line.write(bytes);
    }

    fn send_command(&mut self, bytes: &[u8]) {
        self.line.write(bytes);
    }
}

/// What waits to be written.
#[derive(Debug, Default)]
struct Outbox {
    urgent: VecDeque<u8>,
    command: Option<Vec<u8>>,
}

impl Outbox {
    fn put_urgent(&mut self, bytes: &[u8]) {
        self.urgent.extend(bytes);
        let excess = self.urgent.len().saturating_sub(URGENT_BYTES);
        self.urgent.drain(..excess);
    }

    fn put_command(&mut self, bytes: &[u8]) {
        let slot = self.command.get_or_insert_default();
        slot.clear();
        slot.extend_from_slice(bytes);
    }

    /// What goes out next.
    fn take(&mut self) -> Option<Vec<u8>> {
        if self.urgent.is_empty() { self.command.take() } else { Some(self.urgent.drain(..).collect()) }
    }

    fn clear(&mut self) {
        *self = Self::default();
    }
}

/// What waits for the next step.
#[derive(Debug, Default)]
struct Inbox {
    events: VecDeque<LineEvent>,
    bytes: usize,
}

impl Inbox {
    fn put(&mut self, event: LineEvent) {
        self.bytes += event.len();
        self.events.push_back(event);
        while self.bytes > INBOX_BYTES {
            let oldest = self.events.iter().position(|event| event.len() > 0).and_then(|at| self.events.remove(at));
            self.bytes -= oldest.map_or(self.bytes, |event| event.len());
        }
    }

    fn drain(&mut self, events: &mut Vec<LineEvent>) {
        events.extend(self.events.drain(..));
        self.bytes = 0;
    }
}

impl LineEvent {
    fn len(&self) -> usize {
        match self {
            Self::Bytes(_, bytes) => bytes.len(),
            Self::Opened | Self::Closed(_) => 0,
        }
    }
}

/// What the step and the two threads share.
struct Shared {
    inbox: Mutex<Inbox>,
    outbox: Mutex<Writing>,
    /// Rings when there is something to write, or the end has come.
    rung: Condvar,
    clock: Arc<dyn Clock>,
    waker: Waker,
}

#[derive(Default)]
struct Writing {
    outbox: Outbox,
    /// `None` while the port is not open.
    port: Option<Arc<Mutex<TTYPort>>>,
    stop: bool,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    fn tell(&self, event: LineEvent) {
        lock(&self.inbox).put(event);
        self.waker.wake();
    }

    fn stopping(&self) -> bool {
        lock(&self.outbox).stop
    }

    /// Waits, or until the end has come.
    fn pause(&self, pause: Duration) {
        let writing = lock(&self.outbox);
        drop(self.rung.wait_timeout_while(writing, pause, |writing| !writing.stop));
    }

    /// The port is open, or is not any more. Nothing that waited before is written after.
    fn set_port(&self, port: Option<TTYPort>) {
        let mut writing = lock(&self.outbox);
        writing.outbox.clear();
        writing.port = port.map(|port| Arc::new(Mutex::new(port)));
    }
}

/// A device.
struct SerialLine {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl SerialLine {
    fn open(path: PathBuf, baud: u32, dtr: Dtr, clock: Arc<dyn Clock>, waker: Waker) -> Result<Self, SetupError> {
        let shared =
            Arc::new(Shared { inbox: Mutex::default(), outbox: Mutex::default(), rung: Condvar::new(), clock, waker });
        let mut line = Self { shared: Arc::clone(&shared), threads: Vec::new() };
        line.spawn("serial-write", {
            let shared = Arc::clone(&shared);
            move || write_on(&shared)
        })?;
        line.spawn("serial-read", move || keep_open(&path, baud, dtr, &shared))?;
        Ok(line)
    }

    fn spawn(&mut self, name: &str, body: impl FnOnce() + Send + 'static) -> Result<(), SetupError> {
        let thread = thread::Builder::new().name(name.to_owned()).spawn(body).map_err(SetupError::new)?;
        self.threads.push(thread);
        Ok(())
    }
}

impl Line for SerialLine {
    fn poll(&mut self, _now: Stamp, events: &mut Vec<LineEvent>) {
        lock(&self.shared.inbox).drain(events);
    }

    fn send_urgent(&mut self, bytes: &[u8]) {
        lock(&self.shared.outbox).outbox.put_urgent(bytes);
        self.shared.rung.notify_all();
    }

    fn send_command(&mut self, bytes: &[u8]) {
        lock(&self.shared.outbox).outbox.put_command(bytes);
        self.shared.rung.notify_all();
    }
}

impl Drop for SerialLine {
    fn drop(&mut self) {
        lock(&self.shared.outbox).stop = true;
        self.shared.rung.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has already said so.
            let _ = thread.join();
        }
    }
}

/// Opens the port, reads until it is lost, and opens it again. The path is resolved anew each time, so that a device that
/// comes back under another number is found through its `/dev/serial/by-id` name.
fn keep_open(path: &Path, baud: u32, dtr: Dtr, shared: &Shared) {
    let mut pause = BACK_OFF.0;
    let mut told = false;
    while !shared.stopping() {
        let reason = match connect(path, baud, dtr, shared) {
            Ok(port) => {
                shared.tell(LineEvent::Opened);
                told = false;
                let mut heard = false;
                let Some(reason) = read_on(port, shared, &mut heard) else { return };
                // A port that opens and is lost at once counts as one that does not open.
                pause = if heard { BACK_OFF.0 } else { pause };
                reason
            }
            Err(reason) => reason,
        };
        shared.set_port(None);
        if !std::mem::replace(&mut told, true) {
            shared.tell(LineEvent::Closed(reason));
        }
        shared.pause(pause);
        pause = (pause * 2).min(BACK_OFF.1);
    }
}

fn connect(path: &Path, baud: u32, dtr: Dtr, shared: &Shared) -> Result<TTYPort, String> {
    let cannot_open = |error: serialport::Error| format!("cannot open `{}`: {error}", path.display());
    // A pseudo-terminal outlives a host that was killed, and would keep its claim: do not claim those.
    let pseudo_terminal = path.canonicalize().is_ok_and(|real| real.starts_with("/dev/pts"));
    let builder = serialport::new(path.to_string_lossy(), baud).timeout(POLL).exclusive(!pseudo_terminal);
    let mut port = builder.open_native().map_err(cannot_open)?;
    if dtr == Dtr::Clear && !pseudo_terminal {
        port.write_data_terminal_ready(false).map_err(cannot_open)?;
    }
    // What the chip said while nobody listened is old; not all devices can forget it, and then the session tells.
    let _ = port.clear(ClearBuffer::All);
    shared.set_port(Some(port.try_clone_native().map_err(cannot_open)?));
    Ok(port)
}

/// Reads until the port is lost: gives the reason, or `None` when the end has come.
fn read_on(mut port: TTYPort, shared: &Shared, heard: &mut bool) -> Option<String> {
    let mut buffer = [0; 512];
    loop {
        let result = port.read(&mut buffer);
        let arrived = shared.clock.now();
        if shared.stopping() {
            return None;
        }
        match result {
            Ok(0) => return Some("the device is gone".to_owned()),
            Ok(len) => {
                *heard = true;
                shared.tell(LineEvent::Bytes(arrived, buffer[..len].to_vec()));
            }
            Err(error) if matches!(error.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted) => {}
            Err(error) => return Some(format!("the device is gone ({error})")),
        }
    }
}

/// Writes what comes into the outbox until the end has come; then what is urgent still goes out.
fn write_on(shared: &Shared) {
    loop {
        let mut writing = lock(&shared.outbox);
        let next = loop {
            let Writing { outbox, port, stop } = &mut *writing;
            match (outbox.take(), port) {
                (Some(bytes), Some(port)) => break Some((bytes, Arc::clone(port))),
                // Without a port there is nobody to say it to.
                (Some(_), None) => {}
                (None, _) if *stop => break None,
                (None, _) => {
                    writing = shared.rung.wait(writing).unwrap_or_else(PoisonError::into_inner);
                }
            }
        };
        drop(writing);
        let Some((bytes, port)) = next else { return };
        // The reader notices a lost device and says so; a full line loses the frame, and the chip's lease runs on.
        let _ = lock(&port).write_all(&bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn several_waiting_commands_collapse_to_the_newest_behind_what_is_urgent() {
        let mut outbox = Outbox::default();
        outbox.put_command(b"old");
        outbox.put_urgent(b"hello");
        outbox.put_command(b"newer");
        outbox.put_urgent(b" e-stop");
        outbox.put_command(b"newest");
        assert_eq!(outbox.take().as_deref(), Some(&b"hello e-stop"[..]), "urgent bytes first, in order");
        assert_eq!(outbox.take().as_deref(), Some(&b"newest"[..]), "then the newest command");
        assert_eq!(outbox.take(), None, "and nothing else");
        (0..10_000).for_each(|_| outbox.put_urgent(b"flood"));
        assert_eq!(outbox.take().map(|bytes| bytes.len()), Some(URGENT_BYTES), "bounded");
    }

    #[test]
    fn bytes_that_nobody_takes_are_bounded_and_the_newest_stay() {
        let mut inbox = Inbox::default();
        inbox.put(LineEvent::Opened);
        for chunk in 0..1_000 {
            inbox.put(LineEvent::Bytes(Stamp::from_nanos(chunk), vec![0; 100]));
        }
        let mut events = Vec::new();
        inbox.drain(&mut events);
        let kept: usize = events.iter().map(LineEvent::len).sum();
        assert!(kept <= INBOX_BYTES && kept > INBOX_BYTES - 100, "{kept} B were kept");
        assert!(matches!(events.first(), Some(LineEvent::Opened)), "the news of the port stay");
        assert!(matches!(events.last(), Some(LineEvent::Bytes(at, _)) if at.as_nanos() == 999), "and the newest bytes");
    }

    #[test]
    fn what_waited_during_an_outage_is_not_written_after_it() {
        let shared = Shared {
            inbox: Mutex::default(),
            outbox: Mutex::default(),
            rung: Condvar::new(),
            clock: Arc::new(carril_runtime::clock::VirtualClock::default()),
            waker: Waker::new(|| ()),
        };
        lock(&shared.outbox).outbox.put_command(b"old");
        lock(&shared.outbox).outbox.put_urgent(b"old");
        shared.set_port(None);
        assert_eq!(lock(&shared.outbox).outbox.take(), None, "neither commands nor urgent bytes");
    }

    #[test]
    fn a_device_in_lockstep_is_refused_with_what_to_do() {
        let error =
            open("/dev/ttyUSB0", 500_000, Dtr::Set, &Setup::for_tests("bridge")).err().expect("there are no devices");
        assert!(error.to_string().contains("`/dev/ttyUSB0` is a device"), "{error}");
        assert!(error.to_string().contains("sim:NAME"), "says what to do: {error}");
    }
}
