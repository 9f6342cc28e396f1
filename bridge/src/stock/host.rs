//! The host's side of the conversation with stock firmware, which has no lease: **this side** keeps it. It repeats the newest
//! command while its lease runs, and tells the car to stop when the lease runs out, on an e-stop, on a reset, and on every way
//! out that it gets to know of. What it cannot do is stop a car when it is killed itself.
//!
//! Pure: bytes, commands and times in, bytes, telemetry and notes out. It opens no port and logs nothing.

use std::time::Duration;

use carril_messages::{Command, Control, Fault, FaultSet, Stamp, WheelTelemetry};

use super::config::StockConfig;
use super::log_gate::LogGate;
use super::talk::{Heard, Order, Talk};
use super::types::{LogLevel, StockNote, StockProtocol, StockState};
use super::units;
use super::wheels::Wheels;
use crate::host::{CommandError, Effects, Latches, LinkCounts};

/// Between two questions to a device that has not answered.
const ASK_PERIOD: Duration = Duration::from_millis(500);
/// Between two questions to a device that cannot be driven: somebody must act, but may do so at any time.
const REFUSED_PERIOD: Duration = Duration::from_secs(1);
/// So many looks must have passed without a word before a device counts as silent: after a pause of this program, the words may
/// be waiting.
const SILENT_TICKS: u32 = 5;
/// A link that has never been up may take so long before that is an error: these boards restart when their port is opened, and
/// start their sensors before they speak.
const GRACE: Duration = Duration::from_secs(5);
/// A link that was up may be down for so long before that is an error.
const PATIENCE: Duration = Duration::from_millis(300);
/// A device that tells nothing by itself asks for the time every 2.5 s.
const TIME_REQUESTS: Duration = Duration::from_secs(6);
/// Why a new port is closed.
const NOT_OPENED: &str = "not opened yet";
/// How often a stop is said at once: one may be lost on the line, and on the way out there is no later.
const STOP_REPEATS: usize = 3;

/// Where the conversation stands.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Phase {
    /// The port is not open.
    Closed { reason: String },
    /// The device has not yet said enough of itself. `silent`: it had, and then fell silent.
    Waiting { next_question: Stamp, silent: bool },
    /// It cannot be driven. `asked`: the question is out again, and the answer may be another one.
    Refused { why: String, next_question: Stamp, asked: bool },
    /// Commands may go out.
    Up,
}

/// A command in force.
#[derive(Clone, Copy, Debug)]
struct Leased {
    speed_m_s: f32,
    until: Stamp,
}

/// The host's side.
pub struct StockHost {
    port: String,
    lease_ms: u16,
    config: StockConfig,
    talk: Talk,
    phase: Phase,
    not_up_since: Stamp,
    was_up: bool,
    last_heard: Stamp,
    quiet_ticks: u32,
    latches: Latches,
    lease_expired: bool,
    leased: Option<Leased>,
    steering_rad: Option<f32>,
    /// The last word to the car was to move.
    told_to_move: bool,
    last_sent: Option<Stamp>,
    wheels: Wheels,
    implausible: u64,
    logs: LogGate,
    counts: LinkCounts,
    heard: Vec<Heard>,
}

impl StockHost {
    /// `port` names the port in messages; `lease_ms` is 1 and more.
    pub fn new(port: &str, protocol: StockProtocol, lease_ms: u16, config: StockConfig, now: Stamp) -> Self {
        Self {
            port: port.to_owned(),
            lease_ms,
            config,
            talk: Talk::new(protocol),
            phase: Phase::Closed { reason: NOT_OPENED.to_owned() },
            not_up_since: now,
            was_up: false,
            last_heard: now,
            quiet_ticks: 0,
            latches: Latches::default(),
            lease_expired: false,
            leased: None,
            steering_rad: None,
            told_to_move: false,
            last_sent: None,
            wheels: Wheels::default(),
            implausible: 0,
            logs: LogGate::default(),
            counts: LinkCounts::default(),
            heard: Vec::new(),
        }
    }

    /// What nobody who uses such firmware should have to find out.
    pub fn warning(&self) -> String {
        format!(
            "`{}`: stock firmware ({}) has no lease. This program stops the car when commands stop coming; but when it is \
             killed or hangs, or the cable breaks, the car keeps its last command for ever. Keep its power switch at hand, or \
             flash carril's own firmware (docs/hardware.md)",
            self.port,
            self.talk.protocol()
        )
    }

    /// The port is open.
    pub fn opened(&mut self, now: Stamp, effects: &mut Effects) {
        self.last_heard = now;
        self.quiet_ticks = 0;
        self.phase = Phase::Waiting { next_question: now, silent: false };
        self.talk.restart();
        // It may have been driving when the line broke. It may be another one, too: its servo is left alone.
        self.stop(now, effects);
        self.begin(false, now, effects);
    }

    /// The port is not open any more, or still not.
    pub fn closed(&mut self, now: Stamp, reason: String) {
        self.lose(now);
        self.phase = Phase::Closed { reason };
    }

    /// Takes bytes that arrived at `arrived`.
    pub fn receive(&mut self, arrived: Stamp, bytes: &[u8], effects: &mut Effects) {
        let mut heard = std::mem::take(&mut self.heard);
        self.talk.receive(arrived, bytes, &mut heard, &mut effects.urgent);
        for word in heard.drain(..) {
            self.hear(word, arrived, effects);
        }
        self.heard = heard;
        if self.talk.is_ready() && matches!(self.phase, Phase::Waiting { .. } | Phase::Refused { .. }) {
            self.come_up(arrived, effects);
        }
    }

    /// Takes a command that was made at `made`. It is in force, and repeated, until its lease has run out since then.
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
        let (age, lease) = (now.since(made).to_duration(), Duration::from_millis(self.lease_ms.into()));
        let left = lease.checked_sub(age).filter(|left| !left.is_zero());
        let left = left.ok_or(CommandError::TooOld { age_ms: age.as_millis(), lease_ms: self.lease_ms })?;
        self.watch_lease(now, effects);
        if self.phase != Phase::Up {
            self.counts.commands_withheld += 1;
            return Ok(());
        }
        if self.stopped() {
            return Ok(());
        }
        self.leased = Some(Leased { speed_m_s, until: now + left });
        self.steering_rad = Some(units::limited_rad(steering_rad, &self.config));
        self.counts.commands_sent += 1;
        // Faster than twice the rate is of no use to these devices, and fills their buffers; but to stop is always in time.
        let just_sent = self.last_sent.is_some_and(|sent| now.since(sent).to_duration() < self.period() / 2);
        if !just_sent || self.order().power == 0 {
            self.send(now, effects);
        }
        Ok(())
    }

    /// Hears a word from a person.
    pub fn control(&mut self, control: Control, now: Stamp, effects: &mut Effects) {
        match control {
            Control::EStop => self.latches.estop = true,
            Control::Reset => {
                self.latches = Latches::default();
                self.lease_expired = false;
            }
            Control::Start | Control::Stop => return,
        }
        self.stop(now, effects);
    }

    /// Does what time asks for: repeats, tries again, notices silence and the end of a lease.
    pub fn tick(&mut self, now: Stamp, effects: &mut Effects) {
        self.quiet_ticks = self.quiet_ticks.saturating_add(1);
        self.watch_lease(now, effects);
        let silent = self.is_silent(now);
        match &mut self.phase {
            Phase::Waiting { next_question, .. } if now >= *next_question => {
                *next_question = now + ASK_PERIOD;
                self.talk.ask(now, &mut effects.urgent);
            }
            Phase::Refused { next_question, asked, .. } if now >= *next_question => {
                *next_question = now + REFUSED_PERIOD;
                *asked = true;
                self.talk.restart();
                self.talk.ask(now, &mut effects.urgent);
            }
            Phase::Up if silent => {
                effects.stock_notes.push(StockNote::Silent);
                self.lose(now);
                self.stop(now, effects);
                self.begin(true, now, effects);
            }
            _ => {}
        }
        self.repeat(now, effects);
        if let Some(dropped) = self.logs.dropped(now) {
            effects.stock_notes.push(StockNote::LogsDropped(dropped));
        }
    }

    /// The way out: the car is told to stop, several times.
    pub fn release(&mut self, now: Stamp, effects: &mut Effects) {
        self.stop(now, effects);
    }

    /// What keeps the car from driving, in words that stay the same while it lasts. `None`: nothing on this side.
    pub fn problem(&self, now: Stamp) -> Option<String> {
        let port = &self.port;
        let patience = if self.was_up { PATIENCE } else { GRACE };
        let patient = now.since(self.not_up_since).to_duration() < patience;
        match &self.phase {
            Phase::Closed { reason } if patient && reason == NOT_OPENED => self.stop_problem(),
            Phase::Closed { .. } if patient && !self.was_up => self.stop_problem(),
            Phase::Closed { reason } => Some(format!("`{port}`: {reason}; trying again")),
            Phase::Waiting { silent: false, .. } if patient => self.stop_problem(),
            Phase::Waiting { silent, .. } => Some(format!("`{port}`: {}", self.waiting_problem(*silent))),
            Phase::Refused { why, .. } => Some(format!("`{port}`: {why}")),
            Phase::Up => self.stop_problem(),
        }
    }

    fn waiting_problem(&self, silent: bool) -> String {
        self.talk.missing().unwrap_or_else(|| {
            format!(
                "the microcontroller {}; check its power, the cable, the baud rate and its firmware",
                if silent { "has fallen silent" } else { "does not answer" }
            )
        })
    }

    fn stop_problem(&self) -> Option<String> {
        let port = &self.port;
        let texts: Vec<&str> = self.faults().iter().map(Fault::text).collect();
        if !texts.is_empty() {
            return Some(format!("`{port}`: the car is stopped: {}", texts.join("; ")));
        }
        let text = "the link was lost while the car drove, and is back; `carril reset`, then `carril start`";
        self.latches.link_lost.then(|| format!("`{port}`: {text}"))
    }

    /// Whether commands go out.
    pub fn is_up(&self) -> bool {
        self.phase == Phase::Up
    }

    /// What the firmware would latch if it were our own.
    pub fn faults(&self) -> FaultSet {
        let with = |set: FaultSet, fault, present| if present { set.with(fault) } else { set };
        let expired = with(FaultSet::NONE, Fault::LeaseExpired, self.lease_expired);
        with(expired, Fault::EstopByHost, self.latches.estop)
    }

    /// The stops in force.
    pub fn latches(&self) -> Latches {
        self.latches
    }

    /// What a successor needs besides the stops.
    pub fn state(&self) -> StockState {
        StockState { lease_expired: self.lease_expired, steering_rad: self.steering_rad, ticks: self.wheels.ticks }
    }

    /// Goes on where a predecessor has stopped. The conversation itself begins anew when the port opens.
    pub fn restore(&mut self, latches: Latches, state: StockState) {
        self.latches = latches;
        self.lease_expired = state.lease_expired;
        self.steering_rad = state.steering_rad.filter(|angle| angle.is_finite());
        self.wheels.ticks = state.ticks;
    }

    /// Another lease, from the next command on, and other meanings of numbers.
    pub fn set(&mut self, lease_ms: u16, config: StockConfig) {
        self.lease_ms = lease_ms;
        self.config = config;
    }

    /// Counters.
    pub fn counts(&self) -> LinkCounts {
        self.counts
    }

    /// Damaged frames that arrived here, and numbers that no car has.
    pub fn damaged(&self) -> u64 {
        self.talk.damaged() + self.implausible
    }

    fn hear(&mut self, word: Heard, arrived: Stamp, effects: &mut Effects) {
        match word {
            Heard::Alive => {
                self.last_heard = self.last_heard.max(arrived);
                self.quiet_ticks = 0;
            }
            Heard::Refused(why) => self.refuse(why, arrived, effects),
            Heard::Restarted => self.restarted(arrived, effects),
            Heard::WheelFigure(figure) => {
                let taken = self.wheels.take_figure(figure, &self.config);
                self.implausible += u64::from(taken.is_none());
            }
            Heard::Ticks { value, bits } => {
                let meaning = self.config.ticks.unwrap_or(self.talk.usual_ticks());
                self.wheels.take_ticks(value, bits, meaning);
            }
            Heard::Battery(volts) => self.wheels.battery_v = Some(volts),
            Heard::Report => self.report(arrived, effects),
            Heard::Log(level, text) => match LogLevel::of(level) {
                Some(level) => effects.stock_notes.extend(self.logs.pass(level, &text, arrived)),
                None => self.implausible += 1,
            },
            Heard::Note(note) => effects.stock_notes.push(note),
        }
    }

    /// Telemetry, once the wheel figure is known: before that, there is no speed to tell.
    fn report(&mut self, arrived: Stamp, effects: &mut Effects) {
        let Some(speed_m_s) = self.wheels.speed_m_s.filter(|_| self.is_up()) else { return };
        self.counts.telemetry += 1;
        let telemetry = WheelTelemetry {
            ticks: self.wheels.ticks,
            tick_period_us: None,
            speed_m_s,
            steering_rad: self.steering_rad.unwrap_or(0.0),
            battery_v: self.wheels.battery_v,
            faults: self.faults(),
            driving: self.leased.is_some() && !self.stopped(),
            last_command_seq: None,
            round_trip_us: None,
            frames_lost: self.counts.lost as u32,
            frames_damaged: self.damaged() as u32,
        };
        effects.telemetry.push((arrived, telemetry));
    }

    fn come_up(&mut self, now: Stamp, effects: &mut Effects) {
        self.phase = Phase::Up;
        self.was_up = true;
        self.last_heard = now;
        self.quiet_ticks = 0;
        self.counts.handshakes += 1;
        effects.stock_notes.push(StockNote::Up(self.talk.summary()));
        // Whatever it was told before, it stands until it is told to drive.
        self.stop(now, effects);
    }

    fn refuse(&mut self, why: String, now: Stamp, effects: &mut Effects) {
        // Of one answer, the first reason is told; the next answer may bring another.
        if let Phase::Refused { why: known, asked, .. } = &mut self.phase
            && (!std::mem::take(asked) || *known == why)
        {
            return;
        }
        self.lose(now);
        self.stop(now, effects);
        self.phase = Phase::Refused { why: why.clone(), next_question: now + REFUSED_PERIOD, asked: false };
        effects.stock_notes.push(StockNote::Refused(why));
    }

    fn restarted(&mut self, now: Stamp, effects: &mut Effects) {
        // All topics of one answer say so; the first has been enough.
        if !self.is_up() {
            return;
        }
        effects.stock_notes.push(StockNote::Restarted);
        self.lose(now);
        self.stop(now, effects);
        self.begin(false, now, effects);
    }

    /// Asks the device what it is, from the beginning.
    fn begin(&mut self, silent: bool, now: Stamp, effects: &mut Effects) {
        self.not_up(now);
        self.talk.restart();
        self.wheels.restart();
        self.phase = Phase::Waiting { next_question: now + ASK_PERIOD, silent };
        self.talk.ask(now, &mut effects.urgent);
    }

    /// Begins the time that an outage has lasted; an outage that goes on keeps its beginning.
    fn not_up(&mut self, now: Stamp) {
        if self.is_up() {
            self.not_up_since = now;
        }
    }

    /// As [`StockHost::not_up`], for an end that this side did not want.
    fn lose(&mut self, now: Stamp) {
        self.not_up(now);
        self.latches.link_lost |= self.told_to_move;
        self.told_to_move = false;
        self.leased = None;
    }

    fn stopped(&self) -> bool {
        self.latches.any() || self.lease_expired
    }

    fn is_silent(&self, now: Stamp) -> bool {
        let configured = Duration::from_millis(self.config.silent_after_ms.into());
        let patience = if self.talk.is_talkative() { configured } else { configured.max(TIME_REQUESTS) };
        self.quiet_ticks >= SILENT_TICKS && now.since(self.last_heard).to_duration() >= patience
    }

    fn watch_lease(&mut self, now: Stamp, effects: &mut Effects) {
        if self.leased.is_some_and(|leased| now >= leased.until) {
            self.lease_expired = true;
            effects.stock_notes.push(StockNote::LeaseExpired);
            self.stop(now, effects);
        }
    }

    /// Stops the car at once: before all that waits, and in the place of a command that waits.
    fn stop(&mut self, now: Stamp, effects: &mut Effects) {
        self.leased = None;
        let stop = Order { power: 0, steering_rad: None };
        for _ in 0..STOP_REPEATS {
            self.talk.encode(stop, &self.config, &mut effects.urgent);
        }
        self.send(now, effects);
    }

    /// Says again what the car shall do, when it is time. A car that shall stand is told so just as often.
    fn repeat(&mut self, now: Stamp, effects: &mut Effects) {
        // Steps come a little early or late; a beat that is missed by a hair would come a whole one later.
        let due = self.period() / 4 * 3;
        if self.last_sent.is_none_or(|sent| now.since(sent).to_duration() >= due) {
            self.send(now, effects);
        }
    }

    fn send(&mut self, now: Stamp, effects: &mut Effects) {
        if matches!(self.phase, Phase::Closed { .. }) {
            return;
        }
        let order = self.order();
        let mut bytes = effects.command.take().unwrap_or_default();
        bytes.clear();
        self.talk.encode(order, &self.config, &mut bytes);
        effects.command = (!bytes.is_empty()).then_some(bytes);
        self.told_to_move = order.power != 0;
        self.last_sent = Some(now);
    }

    fn order(&self) -> Order {
        let leased = self.leased.filter(|_| self.is_up() && !self.stopped());
        let power = leased.map_or(0, |leased| units::power_of_m_s(leased.speed_m_s, &self.config));
        // The servo holds its angle when the car stops: centring it in a bend would leave the lane.
        Order { power, steering_rad: self.steering_rad }
    }

    fn period(&self) -> Duration {
        Duration::from_secs(1) / self.config.send_hz.max(1)
    }
}
