//! The host's side of the conversation with the microcontroller: handshake, commands with a lease, e-stop, reset, telemetry.
//! Pure: bytes, commands and times in, bytes, telemetry and notes out. It opens no port, logs nothing, and never repeats a
//! command by itself: when commands stop coming, the lease at the wheels must run out.

mod chip_clock;
mod types;

use std::collections::VecDeque;
use std::time::Duration;

use carril_messages::{Command, Control, Fault, FaultSet, Stamp};
use serde::{Deserialize, Serialize};

use crate::codec::{
    self, Capabilities, DecodeError, Decoder, Direction, Drive, FULL_DUTY, Frame, HelloAck, Packet, Session, Telemetry,
};
use crate::mcu_model::STOPPING_FAULTS;
use crate::units;

pub use chip_clock::ChipClock;
pub use types::{CommandError, Effects, HostState, Latches, LinkCounts, Note};

/// Between two tries of a handshake.
const HELLO_PERIOD: Duration = Duration::from_millis(100);
/// Between two tries with a chip that speaks another version: somebody must act, but may do so at any time.
const REFUSED_PERIOD: Duration = Duration::from_secs(1);
/// Without a word from the chip for so long, the link counts as silent and no command is sent.
const SILENT_AFTER: Duration = Duration::from_millis(500);
/// So many looks must have passed without a word, too: after a pause of this program, the words may be waiting.
const SILENT_TICKS: u32 = 5;
/// A link that has never been up may take so long before that is an error: programs and chips take time to start.
const GRACE: Duration = Duration::from_secs(1);
/// Between two tries to clear the chip's faults, and when to give up.
const CLEAR_PERIOD: Duration = Duration::from_millis(50);
const CLEAR_FOR: Duration = Duration::from_secs(1);
/// A port that was lost may be back within this time without the car being stopped for it, if the chip has not ended the session:
/// then its lease has never run out. Longer than any lease.
const RESUME_WITHIN: Duration = Duration::from_millis(2_500);
/// A chip that has not ended the session says so within this time: ten reports.
const RESUME_PATIENCE: Duration = Duration::from_millis(100);
/// Commands whose echo may still come.
const COMMANDS_IN_FLIGHT: usize = 64;

/// Why a new port is closed.
const NOT_OPENED: &str = "not opened yet";

/// Where the conversation stands.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Phase {
    /// The port is not open. `kept`: the session that the chip may not have ended.
    Closed { reason: String, kept: Option<Session> },
    /// The port is open again; does the chip go on with the session? Commands go out: to any other session they mean nothing.
    Resuming { session: Session, until: Stamp },
    /// Hellos go out; no answer yet.
    Greeting { session: Session, next_hello: Stamp },
    /// The chip speaks another version.
    Refused { version: u8, next_hello: Stamp },
    /// Commands may go out.
    Up { session: Session },
}

/// A person's `reset` on its way to the chip.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Clearing {
    until: Stamp,
    next: Stamp,
    /// The session in which it was first sent. A fault that comes later ends that session, and is not cleared by it.
    session: Option<Session>,
}

/// The host's side.
pub struct Host {
    /// Speed at full duty, m/s, for a car without encoder: it is told a duty instead of a speed.
    full_duty_m_s: Option<f32>,
    port: String,
    lease_ms: u16,
    decoder: Decoder,
    next_seq: u16,
    session_seed: u64,
    phase: Phase,
    /// The handshake in which a predecessor was, until the port is open.
    greeting: Option<(Session, Stamp)>,
    not_up_since: Stamp,
    was_up: bool,
    silent: bool,
    last_heard: Stamp,
    quiet_ticks: u32,
    last_telemetry: Option<Telemetry>,
    expected_seq: Option<u16>,
    latches: Latches,
    /// The last command of this session was to move.
    told_to_move: bool,
    clearing: Option<Clearing>,
    sent: VecDeque<(u16, Stamp)>,
    last_echo: Option<u16>,
    /// `None`: the chip does not tell its time.
    chip_clock: Option<ChipClock>,
    counts: LinkCounts,
}

impl Host {
    /// `port` names the port in messages; `lease_ms` is 1 to [`codec::MAX_LEASE_MS`]; `seed` makes the numbers of the sessions.
    pub fn new(port: &str, lease_ms: u16, seed: u64, now: Stamp) -> Self {
        Self {
            full_duty_m_s: None,
            port: port.to_owned(),
            lease_ms,
            decoder: Decoder::new(Direction::FromChip),
            next_seq: 0,
            session_seed: seed,
            phase: Phase::Closed { reason: NOT_OPENED.to_owned(), kept: None },
            greeting: None,
            not_up_since: now,
            was_up: false,
            silent: false,
            last_heard: now,
            quiet_ticks: 0,
            last_telemetry: None,
            expected_seq: None,
            latches: Latches::default(),
            told_to_move: false,
            clearing: None,
            sent: VecDeque::with_capacity(COMMANDS_IN_FLIGHT),
            last_echo: None,
            chip_clock: None,
            counts: LinkCounts::default(),
        }
    }

    /// The port is open.
    pub fn opened(&mut self, now: Stamp, effects: &mut Effects) {
        self.decoder.restart();
        self.expected_seq = None;
        self.last_heard = now;
        self.quiet_ticks = 0;
        if let Phase::Closed { kept: Some(session), .. } = self.phase {
            self.phase = Phase::Resuming { session, until: now + RESUME_PATIENCE };
            self.repeat_estop(effects);
            return;
        }
        if let Some((session, next_hello)) = self.greeting.take() {
            self.phase = Phase::Greeting { session, next_hello };
            self.repeat_estop(effects);
            return;
        }
        self.last_telemetry = None;
        self.repeat_estop(effects);
        self.greet(now, effects);
    }

    /// The port is not open any more, or still not.
    pub fn closed(&mut self, now: Stamp, reason: String) {
        self.not_up(now);
        self.phase = Phase::Closed { reason, kept: self.session() };
    }

    /// Takes bytes that arrived at `arrived`.
    pub fn receive(&mut self, arrived: Stamp, bytes: &[u8], effects: &mut Effects) {
        for byte in bytes {
            match self.decoder.push(*byte) {
                Some(Ok(packet)) => self.hear(packet, arrived, effects),
                Some(Err(DecodeError::Version { got, kind })) if kind & 0x80 != 0 => self.refuse(got, arrived, effects),
                Some(Err(_)) | None => {}
            }
        }
    }

    /// Sends a command that was made at `made`. Its lease counts from then.
    pub fn command(
        &mut self,
        command: &Command,
        made: Stamp,
        now: Stamp,
        effects: &mut Effects,
    ) -> Result<(), CommandError> {
        let Command { steering_rad, speed_m_s } = *command;
        if !command.is_finite() {
            return Err(CommandError::NotFinite { steering_rad, speed_m_s });
        }
        let age_ms = now.since(made).to_duration().as_millis();
        let left_ms = u128::from(self.lease_ms).checked_sub(age_ms).filter(|left| *left > 0);
        let left_ms = left_ms.ok_or(CommandError::TooOld { age_ms, lease_ms: self.lease_ms })?;
        let (Phase::Up { session } | Phase::Resuming { session, .. }) = self.phase else {
            self.counts.commands_withheld += 1;
            return Ok(());
        };
        let drive = self.drive(if self.latches.any() { 0.0 } else { speed_m_s });
        // Until the chip has said that it goes on, it counts what it was told before.
        if self.is_up() {
            self.told_to_move = !matches!(drive, Drive::Speed(0) | Drive::Duty(0));
        }
        let frame = Frame::Command(codec::Command {
            session,
            steering_tenth_mrad: units::tenth_mrad_of_rad(steering_rad),
            drive,
            lease_ms: left_ms as u16,
        });
        if self.sent.len() == COMMANDS_IN_FLIGHT {
            self.sent.pop_front();
        }
        self.sent.push_back((self.next_seq, now));
        self.counts.commands_sent += 1;
        let mut bytes = effects.command.take().unwrap_or_default();
        bytes.clear();
        self.encode(frame, &mut bytes);
        effects.command = Some(bytes);
        Ok(())
    }

    /// Hears a word from a person.
    pub fn control(&mut self, control: Control, now: Stamp, effects: &mut Effects) {
        match control {
            Control::EStop => {
                self.latches.estop = true;
                self.clearing = None;
                self.send(Frame::EStop, effects);
            }
            Control::Reset => {
                self.greeting = None;
                self.latches = Latches::default();
                // The new session stops the car, in order: this is no loss of the link.
                self.told_to_move = false;
                self.clearing = Some(Clearing { until: now + CLEAR_FOR, next: now, session: None });
                if let Phase::Closed { kept, .. } = &mut self.phase {
                    *kept = None;
                } else {
                    self.greet(now, effects);
                }
            }
            Control::Start | Control::Stop => {}
        }
    }

    /// Does what time asks for: tries again, gives up, notices silence.
    pub fn tick(&mut self, now: Stamp, effects: &mut Effects) {
        self.quiet_ticks = self.quiet_ticks.saturating_add(1);
        match self.phase {
            Phase::Greeting { session, next_hello } if now >= next_hello => {
                self.phase = Phase::Greeting { session, next_hello: now + HELLO_PERIOD };
                self.send(Frame::Hello(session), effects);
                self.repeat_estop(effects);
            }
            Phase::Refused { version, next_hello } if now >= next_hello => {
                self.phase = Phase::Refused { version, next_hello: now + REFUSED_PERIOD };
                let session = self.draw_session();
                self.send(Frame::Hello(session), effects);
                self.repeat_estop(effects);
            }
            Phase::Closed { kept: Some(_), .. } if now.since(self.not_up_since).to_duration() >= RESUME_WITHIN => {
                self.lose(now);
                if let Phase::Closed { kept, .. } = &mut self.phase {
                    *kept = None;
                }
            }
            Phase::Resuming { until, .. } if now >= until => {
                self.lose(now);
                self.last_telemetry = None;
                self.greet(now, effects);
            }
            Phase::Up { .. } if self.is_silent(now) => {
                effects.notes.push(Note::Silent);
                self.silent = true;
                self.lose(now);
                self.greet(now, effects);
            }
            _ => {}
        }
        self.go_on_clearing(now, effects);
        self.ask_for_time(now, effects);
    }

    /// In a session only: a firmware that does not know the question would count it as damage.
    fn ask_for_time(&mut self, now: Stamp, effects: &mut Effects) {
        if self.is_up()
            && let Some(token) = self.chip_clock.as_mut().and_then(|clock| clock.ask(now))
        {
            self.send(Frame::TimeSync(token), effects);
        }
    }

    /// Ends the session in order: the motor brakes at once, and no fault is latched.
    pub fn release(&mut self, effects: &mut Effects) {
        if let Phase::Up { session } | Phase::Resuming { session, .. } = self.phase {
            self.send(Frame::Release(session), effects);
        }
    }

    /// What keeps the car from driving, in words that stay the same while it lasts. `None`: nothing on this side.
    pub fn problem(&self, now: Stamp) -> Option<String> {
        let port = &self.port;
        let patience = if self.was_up { HELLO_PERIOD * 3 } else { GRACE };
        let patient = now.since(self.not_up_since).to_duration() < patience;
        match &self.phase {
            Phase::Closed { .. } if patient && !self.was_up => None,
            Phase::Closed { kept: Some(_), .. } if patient => None,
            Phase::Closed { reason, .. } => Some(format!("`{port}`: {reason}; trying again")),
            Phase::Greeting { .. } if patient && !self.silent => self.fault_problem(),
            Phase::Greeting { .. } => Some(format!(
                "`{port}`: the microcontroller {}; check its power, the cable, the baud rate and its firmware",
                if self.silent { "has fallen silent" } else { "does not answer" }
            )),
            Phase::Refused { version, .. } => Some(format!(
                "`{port}`: the microcontroller speaks protocol version {version}, expected {}; flash the firmware that \
                 belongs to this carril",
                codec::PROTOCOL_VERSION
            )),
            Phase::Resuming { .. } | Phase::Up { .. } => self.fault_problem().or_else(|| self.latch_problem()),
        }
    }

    fn latch_problem(&self) -> Option<String> {
        let port = &self.port;
        let Latches { estop, link_lost } = self.latches;
        if estop {
            Some(format!("`{port}`: e-stop; `carril reset`, then `carril start`"))
        } else {
            let text = "the link was lost while the car drove, and is back; `carril reset`, then `carril start`";
            link_lost.then(|| format!("`{port}`: {text}"))
        }
    }

    fn fault_problem(&self) -> Option<String> {
        let stopping = FaultSet(self.faults().0 & STOPPING_FAULTS.0);
        let texts: Vec<&str> = stopping.iter().map(Fault::text).collect();
        (!texts.is_empty())
            .then(|| format!("`{}`: the microcontroller has stopped the car: {}", self.port, texts.join("; ")))
    }

    /// Whether commands go out.
    pub fn is_up(&self) -> bool {
        matches!(self.phase, Phase::Up { .. })
    }

    /// The chip's faults, as it last told them.
    pub fn faults(&self) -> FaultSet {
        self.last_telemetry.map_or(FaultSet::NONE, |telemetry| telemetry.faults)
    }

    /// The stops of this side.
    pub fn latches(&self) -> Latches {
        self.latches
    }

    /// What a successor needs to go on with the conversation.
    pub fn state(&self) -> HostState {
        HostState {
            latches: self.latches,
            session: self.session(),
            greeting: match self.phase {
                Phase::Greeting { session, next_hello } => Some((session, next_hello)),
                _ => self.greeting,
            },
            session_seed: Some(self.session_seed),
            next_seq: self.next_seq,
            was_up: self.was_up,
            last_telemetry: self.last_telemetry,
            clearing: self.clearing,
            sent: self.sent.clone(),
            last_echo: self.last_echo,
        }
    }

    /// Goes on where a predecessor has stopped, once the port is open. That it was closed meanwhile was wanted: whatever the chip
    /// made of it, this is no loss of the link.
    pub fn restore(&mut self, state: HostState, effects: &mut Effects) {
        self.latches = state.latches;
        self.phase = Phase::Closed { reason: NOT_OPENED.to_owned(), kept: state.session };
        self.greeting = state.greeting;
        self.session_seed = state.session_seed.unwrap_or(self.session_seed);
        self.next_seq = state.next_seq;
        self.was_up = state.was_up;
        self.last_telemetry = state.last_telemetry;
        self.clearing = state.clearing;
        self.sent = state.sent;
        self.sent.truncate(COMMANDS_IN_FLIGHT);
        self.last_echo = state.last_echo;
        self.repeat_estop(effects);
    }

    fn drive(&self, speed_m_s: f32) -> Drive {
        match self.full_duty_m_s {
            None => Drive::Speed(units::mm_s_of_m_s(speed_m_s)),
            Some(full_m_s) => {
                let share = (speed_m_s / full_m_s).clamp(-1.0, 1.0);
                Drive::Duty((share * f32::from(FULL_DUTY)).round() as i16)
            }
        }
    }

    /// What is known of the chip's time, for a successor. `None`: it does not tell it.
    pub fn chip_clock(&self) -> Option<&ChipClock> {
        self.chip_clock.as_ref()
    }

    /// As a predecessor knew it.
    pub fn set_chip_clock(&mut self, chip_clock: Option<ChipClock>) {
        self.chip_clock = chip_clock;
    }

    /// For a car without encoder: speed at full duty, m/s. `None`: the chip holds the speed.
    pub fn set_full_duty_m_s(&mut self, full_duty_m_s: Option<f32>) {
        self.full_duty_m_s = full_duty_m_s;
    }

    /// Another lease, from the next command on.
    pub fn set_lease_ms(&mut self, lease_ms: u16) {
        self.lease_ms = lease_ms;
    }

    /// Counters.
    pub fn counts(&self) -> LinkCounts {
        self.counts
    }

    /// Damaged frames that arrived here.
    pub fn damaged(&self) -> u64 {
        self.decoder.damage().total()
    }

    fn hear(&mut self, packet: Packet, arrived: Stamp, effects: &mut Effects) {
        self.last_heard = self.last_heard.max(arrived);
        self.quiet_ticks = 0;
        let gap = self.expected_seq.map_or(0, |expected| packet.seq.wrapping_sub(expected));
        self.expected_seq = Some(packet.seq.wrapping_add(1));
        match packet.frame {
            Frame::HelloAck(ack) => self.hear_ack(ack, effects),
            Frame::TimeSyncAck(ack) => {
                if let Some(clock) = &mut self.chip_clock {
                    clock.hear(ack, arrived);
                }
            }
            Frame::Telemetry(telemetry) => self.hear_telemetry(telemetry, gap, arrived, effects),
            // The decoder refuses the host's own kinds.
            _ => {}
        }
    }

    fn hear_ack(&mut self, ack: HelloAck, effects: &mut Effects) {
        if !matches!(self.phase, Phase::Greeting { session, .. } if session == ack.session) {
            return;
        }
        self.phase = Phase::Up { session: ack.session };
        self.was_up = true;
        self.silent = false;
        self.chip_clock = ack.capabilities.contains(Capabilities::TIME_SYNC).then(ChipClock::default);
        self.sent.clear();
        self.last_echo = None;
        self.counts.handshakes += 1;
        effects.notes.push(Note::Up(ack));
    }

    fn hear_telemetry(&mut self, telemetry: Telemetry, gap: u16, arrived: Stamp, effects: &mut Effects) {
        self.counts.telemetry += 1;
        let before = self.last_telemetry.replace(telemetry);
        let ran_backwards = |before: Telemetry| (telemetry.chip_time_us.wrapping_sub(before.chip_time_us) as i32) < 0;
        if before.is_some_and(ran_backwards) {
            effects.notes.push(Note::Restarted);
            self.chip_clock.iter_mut().for_each(ChipClock::forget);
        } else {
            self.counts.lost += u64::from(gap);
        }
        let (old, new) = (before.map_or(0, |before| before.faults.0), telemetry.faults.0);
        if old != new {
            effects.notes.push(Note::Faults { came: FaultSet(new & !old), went: FaultSet(old & !new) });
        }
        let round_trip_us = self.round_trip_us(&telemetry, arrived);
        let clock = self.chip_clock.as_ref();
        let made = clock.and_then(|clock| clock.stamp_of(telemetry.chip_time_us, arrived)).unwrap_or(arrived);
        effects
            .telemetry
            .push((made, units::wheel_telemetry(&telemetry, round_trip_us, (self.counts.lost, self.damaged()))));
        self.repeat_estop(effects);
        match self.phase {
            Phase::Resuming { session, .. } if telemetry.session == Some(session) => {
                self.phase = Phase::Up { session };
            }
            Phase::Up { session } | Phase::Resuming { session, .. } if telemetry.session != Some(session) => {
                effects.notes.push(Note::SessionLost);
                self.lose(arrived);
                self.greet(arrived, effects);
            }
            // It was flashed meanwhile, or what spoke another version was something else.
            Phase::Refused { .. } => self.greet(arrived, effects),
            _ => {}
        }
    }

    /// Time on the line, there and back: without the time that the chip waited for its next report.
    fn round_trip_us(&mut self, telemetry: &Telemetry, arrived: Stamp) -> Option<u32> {
        let last = telemetry.last_command.filter(|last| self.last_echo != Some(last.seq))?;
        let position = self.sent.iter().position(|(seq, _)| *seq == last.seq)?;
        let (seq, sent) = self.sent.drain(..=position).next_back()?;
        self.last_echo = Some(seq);
        let there_and_back_us = arrived.since(sent).to_duration().as_micros();
        let known = last.age_us < u16::MAX;
        known.then(|| u32::try_from(there_and_back_us.saturating_sub(last.age_us.into())).unwrap_or(u32::MAX))
    }

    fn is_silent(&self, now: Stamp) -> bool {
        self.quiet_ticks >= SILENT_TICKS && now.since(self.last_heard).to_duration() >= SILENT_AFTER
    }

    fn refuse(&mut self, version: u8, now: Stamp, effects: &mut Effects) {
        self.last_heard = self.last_heard.max(now);
        if matches!(self.phase, Phase::Refused { version: known, .. } if known == version) {
            return;
        }
        self.lose(now);
        self.phase = Phase::Refused { version, next_hello: now + REFUSED_PERIOD };
        effects.notes.push(Note::Refused { got: version });
    }

    fn greet(&mut self, now: Stamp, effects: &mut Effects) {
        self.not_up(now);
        let session = self.draw_session();
        self.phase = Phase::Greeting { session, next_hello: now + HELLO_PERIOD };
        self.send(Frame::Hello(session), effects);
    }

    /// The session that the chip has not ended, as far as is known.
    fn session(&self) -> Option<Session> {
        match self.phase {
            Phase::Up { session } | Phase::Resuming { session, .. } => Some(session),
            Phase::Closed { kept, .. } => kept,
            Phase::Greeting { .. } | Phase::Refused { .. } => None,
        }
    }

    /// Begins the time that an outage has lasted; an outage that goes on keeps its beginning.
    fn not_up(&mut self, now: Stamp) {
        if self.is_up() {
            self.not_up_since = now;
        }
    }

    /// As [`Host::not_up`], for an end that this side did not want.
    fn lose(&mut self, now: Stamp) {
        self.not_up(now);
        self.latches.link_lost |= self.session().is_some() && self.told_to_move;
        self.told_to_move = false;
    }

    /// An e-stop goes out again and again until the chip says that it has it.
    fn repeat_estop(&mut self, effects: &mut Effects) {
        if self.latches.estop && !self.faults().contains(Fault::EstopByHost) {
            self.send(Frame::EStop, effects);
        }
    }

    fn go_on_clearing(&mut self, now: Stamp, effects: &mut Effects) {
        let Some(mut clearing) = self.clearing else { return };
        let reached = clearing.session;
        let told_in = self.last_telemetry.and_then(|telemetry| telemetry.session);
        let clear = reached.is_some() && told_in == reached && self.faults().0 & STOPPING_FAULTS.0 == 0;
        let overtaken = matches!((reached, &self.phase), (Some(sent), Phase::Up { session }) if sent != *session);
        if clear || overtaken {
            self.clearing = None;
        } else if now >= clearing.until {
            self.clearing = None;
            effects.notes.push(Note::ResetFailed(reached.map(|_| self.faults())));
        } else if let Phase::Up { session } = self.phase
            && now >= clearing.next
        {
            clearing.session = Some(session);
            clearing.next = now + CLEAR_PERIOD;
            self.clearing = Some(clearing);
            self.send(Frame::FaultClear(session), effects);
        }
    }

    /// A number that differs from the last one (SplitMix64; Steele, Lea, Flood: Fast splittable pseudorandom number generators).
    fn draw_session(&mut self) -> Session {
        let last = match self.phase {
            Phase::Greeting { session, .. } | Phase::Up { session } | Phase::Resuming { session, .. } => Some(session),
            Phase::Closed { .. } | Phase::Refused { .. } => self.last_telemetry.and_then(|telemetry| telemetry.session),
        };
        loop {
            self.session_seed = self.session_seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut mixed = self.session_seed;
            mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            let session = Session((mixed ^ (mixed >> 31)) as u16);
            if Some(session) != last {
                return session;
            }
        }
    }

    fn send(&mut self, frame: Frame, effects: &mut Effects) {
        if !matches!(self.phase, Phase::Closed { .. }) || matches!(frame, Frame::EStop) {
            self.encode(frame, &mut effects.urgent);
        }
    }

    fn encode(&mut self, frame: Frame, bytes: &mut Vec<u8>) {
        codec::encode(&Packet { seq: self.next_seq, frame }, bytes);
        self.next_seq = self.next_seq.wrapping_add(1);
    }
}
