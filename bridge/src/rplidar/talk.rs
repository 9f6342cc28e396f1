//! The conversation with the device: who are you, how are you, turn, scan; and again when it falls silent or restarts. Pure: news of the
//! line and a time in, requests and measurements out.

use std::time::Duration;

use carril_messages::Stamp;

use super::codec::{Answer, Decoder, Event, Health, HealthStatus, Info, Point, Request};
use super::config::Mode;

/// What still comes from the scan before is let pass.
const QUIET: Duration = Duration::from_millis(50);
/// An answer comes within this time, or is asked for again.
const PATIENCE: Duration = Duration::from_millis(700);
/// A device that starts anew needs this long.
const START: Duration = Duration::from_millis(1500);
/// The motor needs this long until measurements come.
const SPIN_UP: Duration = Duration::from_secs(4);
/// So many unanswered questions in a row are worth a word; it is asked on.
const UNANSWERED: u32 = 3;

/// Where the conversation is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// The line is not open.
    Closed,
    /// Told to stop: what comes is old.
    Quieting,
    /// Asked who it is.
    Info,
    /// Asked how it is.
    Health,
    /// It starts anew.
    Resetting,
    /// Asked to scan.
    Starting,
    /// Measurements come.
    Scanning,
}

/// What people should know.
#[derive(Clone, Debug, PartialEq)]
pub enum Note {
    /// It has said who it is.
    Found(Info),
    /// It is not well. With [`HealthStatus::Error`] it is reset.
    Unwell(Health),
    /// It does not answer.
    NoAnswer,
    /// Measurements came, and then none did any more, for so long.
    Silent(Duration),
    /// Measurements come.
    Scanning,
}

/// What a step gives.
#[derive(Debug, Default)]
pub struct Outcome {
    /// Bytes for the device.
    pub send: Vec<u8>,
    /// Measurements.
    pub points: Vec<Point>,
    /// The measurements begin anew: what was collected of a rotation is none.
    pub anew: bool,
    /// For people.
    pub notes: Vec<Note>,
}

/// What is said at the end: the device rests.
pub fn farewell() -> Vec<u8> {
    [Request::Stop.encode(), Request::MotorPwm(0).encode()].concat()
}

/// The host's side.
#[derive(Clone, Debug)]
pub struct Talk {
    mode: Mode,
    motor_pwm: u16,
    silence: Duration,
    decoder: Decoder,
    stage: Stage,
    since: Stamp,
    heard: Stamp,
    unanswered: u32,
}

impl Talk {
    /// Before the line is open. After `silence` without a measurement it begins again.
    pub fn new(mode: Mode, motor_pwm: u16, silence: Duration) -> Self {
        let decoder = Decoder::default();
        let (stage, never) = (Stage::Closed, Stamp::ZERO);
        Self { mode, motor_pwm, silence, decoder, stage, since: never, heard: never, unanswered: 0 }
    }

    /// Bytes that belonged to nothing, since the start.
    pub fn lost(&self) -> u64 {
        self.decoder.lost()
    }

    /// The line was opened.
    pub fn opened(&mut self, now: Stamp, out: &mut Outcome) {
        self.unanswered = 0;
        self.begin(now, out);
    }

    /// The line was lost.
    pub fn closed(&mut self) {
        self.stage = Stage::Closed;
        self.decoder.reset();
    }

    /// Bytes have come.
    pub fn heard(&mut self, bytes: &[u8], now: Stamp, out: &mut Outcome) {
        if matches!(self.stage, Stage::Closed | Stage::Quieting | Stage::Resetting) {
            return;
        }
        let mut events = Vec::new();
        self.decoder.push(bytes, &mut events);
        for event in events {
            self.take(event, now, out);
        }
    }

    /// Time has passed.
    pub fn tick(&mut self, now: Stamp, out: &mut Outcome) {
        let waited = now.since(self.since).to_duration();
        match self.stage {
            Stage::Quieting if waited >= QUIET => self.ask(Stage::Info, Request::Info, now, out),
            Stage::Resetting if waited >= START => self.begin(now, out),
            Stage::Info | Stage::Health if waited >= PATIENCE => self.not_answered(now, out),
            Stage::Starting if waited >= SPIN_UP => self.not_answered(now, out),
            Stage::Scanning => {
                let silent = now.since(self.heard).to_duration();
                if silent > self.silence {
                    out.notes.push(Note::Silent(silent));
                    self.begin(now, out);
                }
            }
            _ => {}
        }
    }

    fn enter(&mut self, stage: Stage, now: Stamp) {
        (self.stage, self.since) = (stage, now);
    }

    fn begin(&mut self, now: Stamp, out: &mut Outcome) {
        out.send.extend(Request::Stop.encode());
        self.enter(Stage::Quieting, now);
    }

    fn ask(&mut self, stage: Stage, request: Request, now: Stamp, out: &mut Outcome) {
        self.decoder.reset();
        out.send.extend(request.encode());
        self.enter(stage, now);
    }

    fn not_answered(&mut self, now: Stamp, out: &mut Outcome) {
        self.unanswered += 1;
        if self.unanswered == UNANSWERED {
            out.notes.push(Note::NoAnswer);
        }
        self.begin(now, out);
    }

    fn take(&mut self, event: Event, now: Stamp, out: &mut Outcome) {
        match (self.stage, event) {
            (Stage::Info, Event::Info(info)) => {
                out.notes.push(Note::Found(info));
                self.ask(Stage::Health, Request::Health, now, out);
            }
            (Stage::Health, Event::Health(health)) => self.examine(health, now, out),
            (Stage::Starting, Event::Scanning(answer)) if answer == self.answer() => {
                out.anew = true;
                self.heard = now;
            }
            (Stage::Starting, Event::Point(point)) => {
                out.notes.push(Note::Scanning);
                self.unanswered = 0;
                self.enter(Stage::Scanning, now);
                self.measured(point, now, out);
            }
            (Stage::Scanning, Event::Point(point)) => self.measured(point, now, out),
            _ => {}
        }
    }

    fn measured(&mut self, point: Point, now: Stamp, out: &mut Outcome) {
        self.heard = now;
        out.points.push(point);
    }

    fn answer(&self) -> Answer {
        match self.mode {
            Mode::Standard => Answer::Nodes,
            Mode::Express => Answer::Capsules,
        }
    }

    fn examine(&mut self, health: Health, now: Stamp, out: &mut Outcome) {
        if health.status != HealthStatus::Good {
            out.notes.push(Note::Unwell(health));
        }
        if health.status == HealthStatus::Error {
            out.send.extend(Request::Reset.encode());
            return self.enter(Stage::Resetting, now);
        }
        out.send.extend(Request::MotorPwm(self.motor_pwm).encode());
        let scan = if self.mode == Mode::Standard { Request::Scan } else { Request::ExpressScan };
        self.ask(Stage::Starting, scan, now, out);
    }
}
