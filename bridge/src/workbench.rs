//! A chip on its serial line with nobody else: for calibration, and to see what a chip says. One thing after the other, each with an
//! answer or a reason; a graph does not use it. It never leaves the motor on: commands have short leases, and the end releases.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use carril_messages::{Fault, FaultSet};
use carril_runtime::clock::{Clock, LiveClock};
use carril_runtime::{SetupError, Waker};
use thiserror::Error;

use crate::calibration::{Calibration, Param, SPECS};
use crate::codec::{
    CalibrationState, CalibrationStatus, CalibrationStore, Capabilities, Command, DecodeError, Decoder, Direction,
    Drive, Frame, HelloAck, PROTOCOL_VERSION, Packet, ParameterWrite, Session, Telemetry, encode,
};
use crate::link::{self, Dtr, Line, LineEvent};
use crate::mcu_model::STOPPING_FAULTS;

/// Many boards restart when their port is opened, and take a second or two.
const START_PATIENCE: Duration = Duration::from_secs(5);
/// A question is asked again after so long, and so often.
const ASK_AGAIN: Duration = Duration::from_millis(100);
const TRIES: u32 = 10;
/// Storing takes 3.3 ms a byte.
const STORE_PATIENCE: Duration = Duration::from_secs(2);
/// Telemetry comes at 100 Hz.
const TELEMETRY_PATIENCE: Duration = Duration::from_millis(500);
/// The lease of a command, and how often it is repeated while it is to last.
const LEASE_MS: u16 = 400;
const REPEAT: Duration = Duration::from_millis(30);

/// Why the chip does not do what was asked.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum WorkbenchError {
    /// The port cannot be opened, or is lost.
    #[error("{0}; is it plugged in, and is no graph running on it?")]
    Port(String),
    /// The line cannot be set up.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// No word from it.
    #[error(
        "`{port}`: the microcontroller does not answer; check its power, the cable, the baud rate and its firmware"
    )]
    Silent {
        /// The port.
        port: String,
    },
    /// It speaks another version.
    #[error(
        "`{port}`: the microcontroller speaks protocol version {got}, expected {PROTOCOL_VERSION}; flash the firmware that belongs to this carril"
    )]
    Version {
        /// The port.
        port: String,
        /// What it speaks.
        got: u8,
    },
    /// It cannot do this.
    #[error("the firmware {firmware} cannot {what}; flash bridge/firmware of this carril")]
    Cannot {
        /// Its version.
        firmware: String,
        /// What was wanted.
        what: &'static str,
    },
    /// It has other parameters.
    #[error("the firmware has {got} parameters, expected {expected}; flash the firmware that belongs to this carril")]
    OtherParameters {
        /// How many it has.
        got: usize,
        /// How many are known here.
        expected: usize,
    },
    /// It refuses.
    #[error("{what}: {}", status.text())]
    Refused {
        /// What was asked.
        what: String,
        /// Its answer.
        status: CalibrationStatus,
    },
    /// A fault stops it.
    #[error("the microcontroller has stopped: {0}")]
    Fault(String),
}

/// A chip that nobody else speaks to.
pub struct Workbench {
    port: String,
    line: Box<dyn Line>,
    woken: Receiver<()>,
    clock: Arc<dyn Clock>,
    decoder: Decoder,
    next_seq: u16,
    session: Session,
    hello: Option<HelloAck>,
    telemetry: Option<Telemetry>,
    heard: VecDeque<Frame>,
}

impl Workbench {
    /// Opens the port and greets the chip.
    pub fn open(port: &Path, baud: u32) -> Result<Self, WorkbenchError> {
        let (wake, woken) = channel();
        let waker = Waker::new(move || {
            // Nobody waits any more when this fails.
            let _ = wake.send(());
        });
        let clock: Arc<dyn Clock> = Arc::new(LiveClock::anchored_now());
        let line = link::open_device(port.to_owned(), baud, Dtr::Set, Arc::clone(&clock), waker)?;
        let session = Session((clock.now().as_nanos() as u64 >> 16) as u16 | 1);
        let mut bench = Self {
            port: port.display().to_string(),
            line,
            woken,
            clock,
            decoder: Decoder::new(Direction::FromChip),
            next_seq: 0,
            session,
            hello: None,
            telemetry: None,
            heard: VecDeque::new(),
        };
        bench.greet(START_PATIENCE)?;
        Ok(bench)
    }

    /// What the chip said of itself.
    pub fn hello(&self) -> Option<HelloAck> {
        self.hello
    }

    /// A new session: the one before, if there is one, ends in order.
    pub fn greet(&mut self, patience: Duration) -> Result<(), WorkbenchError> {
        let deadline = Instant::now() + patience;
        self.session = Session(self.session.0.wrapping_add(2));
        self.hello = None;
        loop {
            self.say(Frame::Hello(self.session));
            self.listen(ASK_AGAIN, |bench| bench.hello.is_some())?;
            if self.hello.is_some() {
                return Ok(());
            }
            if Instant::now() >= deadline {
                return Err(WorkbenchError::Silent { port: self.port.clone() });
            }
        }
    }

    /// Clears what is latched, in a new session. An error names what stays.
    pub fn clear_faults(&mut self) -> Result<(), WorkbenchError> {
        self.greet(START_PATIENCE)?;
        for _ in 0..TRIES {
            self.say(Frame::FaultClear(self.session));
            if stopping(self.newest_telemetry()?.faults).is_empty() {
                return Ok(());
            }
        }
        let faults = stopping(self.newest_telemetry()?.faults);
        let texts: Vec<&str> = faults.iter().map(Fault::text).collect();
        Err(WorkbenchError::Fault(texts.join("; ")))
    }

    /// The calibration in force.
    pub fn read(&mut self) -> Result<Calibration, WorkbenchError> {
        self.needs(Capabilities::CALIBRATION, "keep a calibration")?;
        let count = usize::from(self.state(Frame::CalibrationQuery, ASK_AGAIN, "reading the calibration")?.count);
        if count != SPECS.len() {
            return Err(WorkbenchError::OtherParameters { got: count, expected: SPECS.len() });
        }
        let mut calibration = Calibration::default();
        for param in Param::ALL {
            let value = self.parameter(param, Frame::ParameterRead(param as u8), "reading it")?;
            calibration.set(param, value).map_err(|status| refused(param, "it holds a value of its own", status))?;
        }
        Ok(calibration)
    }

    /// Whether what is in force is what is stored.
    pub fn is_stored(&mut self) -> Result<bool, WorkbenchError> {
        let state = self.state(Frame::CalibrationQuery, ASK_AGAIN, "reading the calibration")?;
        Ok(state.crc_stored == state.crc_in_force)
    }

    /// Puts a calibration into force, without storing it. The chip must not drive.
    pub fn write(&mut self, wanted: &Calibration) -> Result<(), WorkbenchError> {
        self.greet(START_PATIENCE)?;
        let before = self.read()?;
        for param in Param::ALL.into_iter().filter(|param| before.get(*param) != wanted.get(*param)) {
            let write = ParameterWrite { session: self.session, index: param as u8, value: wanted.get(param) };
            self.parameter(param, Frame::ParameterWrite(write), "writing it")?;
        }
        Ok(())
    }

    /// Puts a calibration into force and makes it outlast a restart.
    pub fn store(&mut self, wanted: &Calibration) -> Result<(), WorkbenchError> {
        self.write(wanted)?;
        let store = CalibrationStore { session: self.session, crc: wanted.crc() };
        self.state(Frame::CalibrationStore(store), STORE_PATIENCE, "storing the calibration").map(|_| ())
    }

    /// Drives like this for so long. The motor brakes soon after, whatever happens here.
    pub fn hold(&mut self, steering_tenth_mrad: i16, drive: Drive, time: Duration) -> Result<(), WorkbenchError> {
        let until = Instant::now() + time;
        loop {
            let session = self.session;
            self.say(Frame::Command(Command { session, steering_tenth_mrad, drive, lease_ms: LEASE_MS }));
            let left = until.saturating_duration_since(Instant::now());
            self.listen(REPEAT.min(left), |_| false)?;
            if let Some(telemetry) = self.telemetry
                && !stopping(telemetry.faults).is_empty()
            {
                let texts: Vec<&str> = stopping(telemetry.faults).iter().map(Fault::text).collect();
                return Err(WorkbenchError::Fault(texts.join("; ")));
            }
            if left.is_zero() {
                return Ok(());
            }
        }
    }

    /// Ends the session in order: the motor brakes, the servo holds its angle, nothing is latched.
    pub fn release(&mut self) {
        self.say(Frame::Release(self.session));
    }

    /// The next report.
    pub fn newest_telemetry(&mut self) -> Result<Telemetry, WorkbenchError> {
        self.telemetry = None;
        self.listen(TELEMETRY_PATIENCE, |bench| bench.telemetry.is_some())?;
        self.telemetry.ok_or_else(|| WorkbenchError::Silent { port: self.port.clone() })
    }

    fn needs(&self, capability: Capabilities, what: &'static str) -> Result<(), WorkbenchError> {
        let Some(hello) = self.hello else { return Err(WorkbenchError::Silent { port: self.port.clone() }) };
        if hello.capabilities.contains(capability) {
            return Ok(());
        }
        Err(WorkbenchError::Cannot { firmware: hello.firmware.to_string(), what })
    }

    /// Asks for a parameter, or writes one.
    fn parameter(&mut self, param: Param, question: Frame, what: &str) -> Result<i32, WorkbenchError> {
        let answer = self.ask(question, ASK_AGAIN, |frame| match frame {
            Frame::Parameter(parameter) if parameter.index == param as u8 => Some(parameter),
            _ => None,
        })?;
        match answer.status {
            CalibrationStatus::Done => Ok(answer.value),
            status => Err(refused(param, what, status)),
        }
    }

    /// Asks for the calibration as a whole, or has something done to it.
    fn state(&mut self, question: Frame, again: Duration, what: &str) -> Result<CalibrationState, WorkbenchError> {
        let state = self.ask(question, again, |frame| match frame {
            Frame::Calibration(state) => Some(state),
            _ => None,
        })?;
        match state.status {
            CalibrationStatus::Done => Ok(state),
            status => Err(WorkbenchError::Refused { what: what.to_owned(), status }),
        }
    }

    /// Asks until there is an answer: a frame may be damaged on the line, and every question may be asked twice.
    fn ask<R>(
        &mut self,
        question: Frame,
        again: Duration,
        answer: impl Fn(Frame) -> Option<R>,
    ) -> Result<R, WorkbenchError> {
        for _ in 0..TRIES {
            self.heard.clear();
            self.say(question);
            let mut found = None;
            self.listen(again, |bench| {
                found = bench.heard.drain(..).find_map(&answer);
                found.is_some()
            })?;
            if let Some(found) = found {
                return Ok(found);
            }
        }
        Err(WorkbenchError::Silent { port: self.port.clone() })
    }

    fn say(&mut self, frame: Frame) {
        let mut bytes = Vec::new();
        encode(&Packet { seq: self.next_seq, frame }, &mut bytes);
        self.next_seq = self.next_seq.wrapping_add(1);
        self.line.send_urgent(&bytes);
    }

    /// Takes in what comes, until `enough` or the time is up.
    fn listen(&mut self, time: Duration, mut enough: impl FnMut(&mut Self) -> bool) -> Result<(), WorkbenchError> {
        let until = Instant::now() + time;
        loop {
            let mut events = Vec::new();
            self.line.poll(self.clock.now(), &mut events);
            for event in events {
                match event {
                    LineEvent::Bytes(_, bytes) => self.hear(&bytes)?,
                    LineEvent::Closed(reason) => return Err(WorkbenchError::Port(reason)),
                    LineEvent::Opened => {}
                }
            }
            let left = until.saturating_duration_since(Instant::now());
            if enough(self) || left.is_zero() {
                return Ok(());
            }
            // Woken or not: it looks again.
            let _ = self.woken.recv_timeout(left);
        }
    }

    fn hear(&mut self, bytes: &[u8]) -> Result<(), WorkbenchError> {
        for byte in bytes {
            match self.decoder.push(*byte) {
                Some(Ok(packet)) => self.take(packet.frame),
                Some(Err(DecodeError::Version { got, kind })) if kind & 0x80 != 0 => {
                    return Err(WorkbenchError::Version { port: self.port.clone(), got });
                }
                Some(Err(_)) | None => {}
            }
        }
        Ok(())
    }

    fn take(&mut self, frame: Frame) {
        match frame {
            Frame::HelloAck(ack) if ack.session == self.session => self.hello = Some(ack),
            Frame::Telemetry(telemetry) => self.telemetry = Some(telemetry),
            Frame::Parameter(_) | Frame::Calibration(_) => self.heard.push_back(frame),
            _ => {}
        }
    }
}

impl Drop for Workbench {
    fn drop(&mut self) {
        self.release();
    }
}

fn stopping(faults: FaultSet) -> FaultSet {
    FaultSet(faults.0 & STOPPING_FAULTS.0)
}

fn refused(param: Param, what: &str, status: CalibrationStatus) -> WorkbenchError {
    WorkbenchError::Refused { what: format!("{}: {what}", param.spec().name), status }
}
