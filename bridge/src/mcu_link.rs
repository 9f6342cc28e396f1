//! The operator `mcu-link`: commands to the microcontroller, telemetry from it. The conversation is in `host` or, for stock
//! firmware, in `stock`, the port in `link`; this joins them and tells people what happens.

use std::cell::Cell;
use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

use carril_messages::{Command, Control, Fault, FaultSet, Stamp, WheelTelemetry, codec};
use carril_runtime::clock::Clock;
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StateError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::codec::MAX_LEASE_MS;
use crate::conversation::{Conversation, LinkState};
use crate::host::{Effects, Host, HostState, Latches, LinkCounts, Note};
use crate::link::{self, Dtr, Line, LineEvent, SIMULATED};
use crate::mcu_model::STOPPING_FAULTS;
use crate::stock::{LogLevel, StockConfig, StockHost, StockNote, StockProtocol};

/// Shortest lease that may be asked for, ms: two commands at 100 Hz.
const MIN_LEASE_MS: u16 = 20;
/// How often the link looks at its own timers. Everything else happens when a command or a byte comes.
const PERIOD: Duration = Duration::from_millis(50);

/// Configuration of [`McuLink`].
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct McuLinkConfig {
    /// The serial port: a path, best below /dev/serial/by-id, or `sim:NAME` for the line NAME of a `sim-mcu` node.
    pub port: String,
    /// What the firmware speaks: `carril` (bridge/protocol.md), or what stock firmware does. That has no lease: see docs/hardware.md.
    #[serde(default)]
    pub protocol: Protocol,
    /// Speed of the line, baud. 9600 to 2000000. Not given: 500000, and 115200 for `packetserial`.
    #[serde(default)]
    #[schemars(range(min = 9600, max = 2_000_000), extend("unit" = "baud"))]
    pub baud: Option<u32>,
    /// The motor brakes when no further command comes for so long, ms. 20 to 2000.
    #[serde(default = "default_lease_ms")]
    #[schemars(range(min = MIN_LEASE_MS, max = MAX_LEASE_MS), extend("unit" = "ms"))]
    pub lease_ms: u16,
    /// For a car without encoder: its speed at full duty, m/s, 0.1 to 20. The chip then gets a share of full duty instead of a speed to
    /// hold. Only for `carril`.
    #[serde(default)]
    #[schemars(range(min = 0.1, max = 20), extend("unit" = "m/s"))]
    pub full_duty_speed_m_s: Option<f64>,
    /// What the numbers of stock firmware mean on this car; not for `carril`.
    #[serde(default)]
    pub stock: Option<StockConfig>,
}

/// What the firmware speaks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Protocol {
    /// Our own, with a lease.
    #[default]
    Carril,
    /// The 1:10 car, AutoModelCar v3.
    Rosserial,
    /// AutoModelCar v4.
    PacketSerial,
}

impl Protocol {
    /// `None`: our own.
    fn stock(self) -> Option<StockProtocol> {
        match self {
            Self::Carril => None,
            Self::Rosserial => Some(StockProtocol::Rosserial),
            Self::PacketSerial => Some(StockProtocol::PacketSerial),
        }
    }

    /// The usual speed of its line, baud.
    const fn usual_baud(self) -> u32 {
        match self {
            Self::Carril | Self::Rosserial => 500_000,
            Self::PacketSerial => 115_200,
        }
    }
}

impl McuLinkConfig {
    /// A link to our own firmware.
    pub fn carril(port: &str, lease_ms: u16) -> Self {
        Self {
            port: port.to_owned(),
            protocol: Protocol::Carril,
            baud: None,
            lease_ms,
            full_duty_speed_m_s: None,
            stock: None,
        }
    }

    fn baud(&self) -> u32 {
        self.baud.unwrap_or(self.protocol.usual_baud())
    }

    fn full_duty_m_s(&self) -> Option<f32> {
        self.full_duty_speed_m_s.map(|speed_m_s| speed_m_s as f32)
    }

    fn stock(&self) -> StockConfig {
        self.stock.clone().unwrap_or_default()
    }
}

fn default_lease_ms() -> u16 {
    200
}

impl OperatorConfig for McuLinkConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("baud", f64::from(self.baud()), 9_600.0, 2_000_000.0, "baud");
        findings.range("lease_ms", f64::from(self.lease_ms), f64::from(MIN_LEASE_MS), f64::from(MAX_LEASE_MS), "ms");
        if let Some(name) = self.port.strip_prefix(SIMULATED) {
            findings.require(is_line_name(name), "port", || line_name_rule(name));
        } else {
            findings.require(!self.port.is_empty(), "port", || "got nothing, allowed is a path or `sim:NAME`".into());
            findings.device("port", &self.port);
        }
        if let Some(full_duty_speed_m_s) = self.full_duty_speed_m_s {
            findings.range("full_duty_speed_m_s", full_duty_speed_m_s, 0.1, 20.0, "m/s");
            findings.require(self.protocol == Protocol::Carril, "full_duty_speed_m_s", || {
                "got a speed at full duty with stock firmware, which has it in its section `stock`".into()
            });
        }
        self.check_stock(findings);
    }
}

impl McuLinkConfig {
    fn check_stock(&self, findings: &mut Findings<'_>) {
        if let Some(stock) = &self.stock {
            stock.check("stock", findings);
        }
        if self.protocol == Protocol::Carril && self.stock.is_some() {
            let message = "got a section for stock firmware with `protocol: carril`, allowed is none".to_owned();
            let hint = "take it out, or set `protocol: rosserial` or `protocol: packetserial`".to_owned();
            findings.report("stock", message, Some(hint));
        }
        let simulated = self.port.starts_with(SIMULATED);
        findings.require(self.protocol == Protocol::Carril || !simulated, "port", || {
            format!(
                "got `{}`, where a `sim-mcu` speaks carril's protocol; stock firmware needs the path of a device",
                self.port
            )
        });
    }
}

/// Whether a line may have this name: it becomes the name of a file.
pub(crate) fn is_line_name(name: &str) -> bool {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_';
    !name.is_empty() && name.len() <= 32 && name.bytes().all(plain)
}

pub(crate) fn line_name_rule(name: &str) -> String {
    format!("got line name `{name}`, allowed are 1 to 32 letters, digits, `-` and `_`")
}

carril_runtime::inputs! {
    /// Inputs of [`McuLink`].
    pub struct McuLinkInputs {
        /// What the car shall do. Each sample goes out once; without new ones the lease runs out and the motor brakes.
        command: Command,
    }
}

carril_runtime::outputs! {
    /// Outputs of [`McuLink`].
    pub struct McuLinkOutputs {
        /// What the microcontroller measures and does, 100 times a second.
        telemetry: WheelTelemetry,
    }
}

/// The link to the microcontroller.
pub struct McuLink {
    config: McuLinkConfig,
    line: Box<dyn Line>,
    host: Conversation,
    clock: Arc<dyn Clock>,
    effects: Effects,
    events: Vec<LineEvent>,
    /// The state was taken after the last step: a successor goes on with the session, and it must not be ended.
    handed_over: Cell<bool>,
}

impl Operator for McuLink {
    const KIND: &'static str = "mcu-link";
    const SUMMARY: &'static str = "Sends commands with a lease to the microcontroller and publishes its telemetry";
    const STAYS_ON_CAR: bool = true;
    /// 1: the latches alone. 2: no stock firmware.
    const STATE_VERSION: u32 = 3;
    type Config = McuLinkConfig;
    type Inputs = McuLinkInputs;
    type Outputs = McuLinkOutputs;
    /// What stopped the car outlives the instance that stopped it, and the session goes on.
    type State = LinkState;

    fn new(config: McuLinkConfig, setup: &Setup) -> Result<Self, SetupError> {
        let line = link::open(&config.port, config.baud(), Dtr::Set, setup)?;
        let host = converse(&config, setup);
        let (clock, effects, events) = (Arc::clone(&setup.clock), Effects::default(), Vec::new());
        Ok(Self { config, line, host, clock, effects, events, handed_over: Cell::new(false) })
    }

    fn step(
        &mut self,
        inputs: &mut McuLinkInputs,
        outputs: &mut McuLinkOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let now = context.now();
        self.handed_over.set(false);
        self.hear(now);
        self.host.tick(now, &mut self.effects);
        let sent = match inputs.command.has_news().then(|| inputs.command.latest()).flatten() {
            Some(command) => self.host.command(*command, command.header().stamp, now, &mut self.effects),
            None => Ok(()),
        };
        self.carry_out();
        for (made, telemetry) in self.effects.telemetry.drain(..) {
            outputs.telemetry.send_captured(telemetry, made);
        }
        sent.map_err(StepError::new)?;
        // Every step fails while the link does not serve the car, so that health shows it for as long as it lasts.
        self.host.problem(now).map_or(Ok(()), |problem| Err(StepError::new(problem)))
    }

    fn period(config: &McuLinkConfig) -> Option<Duration> {
        // Stock firmware is told again in each period what it shall do.
        let stock = config.protocol.stock().map(|_| Duration::from_secs(1) / config.stock().send_hz.max(1));
        Some(stock.unwrap_or(PERIOD))
    }

    fn control(&mut self, control: Control, now: Stamp) {
        self.handed_over.set(false);
        self.host.control(control, now, &mut self.effects);
        self.carry_out();
    }

    fn snapshot(&self) -> LinkState {
        self.handed_over.set(true);
        self.host.state()
    }

    fn restore(&mut self, state: LinkState) -> Result<(), StateError> {
        self.host.restore(state, &mut self.effects);
        self.carry_out();
        Ok(())
    }

    fn migrate(version: u32, state: &[u8]) -> Result<LinkState, StateError> {
        let host: HostState = match version {
            1 => codec::decode::<Latches>(state).map_err(StateError::new)?.into(),
            2 => codec::decode(state).map_err(StateError::new)?,
            _ => {
                let (kind, own) = (Self::KIND, Self::STATE_VERSION);
                let problem = format!("the state has version {version}, `{kind}` takes versions 1 to {own}");
                return Err(StateError::new(problem));
            }
        };
        Ok(host.into())
    }

    /// It holds the serial port.
    fn exclusive(_config: &McuLinkConfig) -> bool {
        true
    }

    fn reconfigure(&mut self, config: &McuLinkConfig) -> Option<Result<(), SetupError>> {
        let line = |config: &McuLinkConfig| (config.port.clone(), config.protocol, config.baud());
        if line(config) != line(&self.config) {
            return None;
        }
        match &mut self.host {
            Conversation::Carril(host) => {
                host.set_lease_ms(config.lease_ms);
                host.set_full_duty_m_s(config.full_duty_m_s());
            }
            Conversation::Stock(host) => host.set(config.lease_ms, config.stock()),
        }
        self.config = config.clone();
        Some(Ok(()))
    }
}

impl McuLink {
    /// Counters since the start.
    pub fn counts(&self) -> LinkCounts {
        self.host.counts()
    }

    fn hear(&mut self, now: Stamp) {
        self.line.poll(now, &mut self.events);
        for event in self.events.drain(..) {
            match event {
                LineEvent::Opened => self.host.opened(now, &mut self.effects),
                LineEvent::Bytes(arrived, bytes) => self.host.receive(arrived, &bytes, &mut self.effects),
                // The failing steps tell of it, once it lasts.
                LineEvent::Closed(reason) => self.host.closed(now, reason),
            }
        }
    }

    /// Sends what the conversation wants sent, and tells what it has learnt.
    fn carry_out(&mut self) {
        let Effects { urgent, command, notes, stock_notes, .. } = &mut self.effects;
        if !urgent.is_empty() {
            self.line.send_urgent(urgent);
            urgent.clear();
        }
        if let Some(command) = command.take() {
            self.line.send_command(&command);
        }
        for note in notes.drain(..) {
            tell(note, &self.config.port);
        }
        for note in stock_notes.drain(..) {
            tell_stock(&note, &self.config.port);
        }
    }
}

/// The conversation that the configuration asks for.
fn converse(config: &McuLinkConfig, setup: &Setup) -> Conversation {
    let now = setup.clock.now();
    let Some(protocol) = config.protocol.stock() else {
        // Another life of this node shall use other sessions; in lockstep the clock is the same each time.
        let seed = setup.seed ^ now.as_nanos() as u64;
        let mut host = Host::new(&config.port, config.lease_ms, seed, now);
        host.set_full_duty_m_s(config.full_duty_m_s());
        return Conversation::Carril(Box::new(host));
    };
    let host = StockHost::new(&config.port, protocol, config.lease_ms, config.stock(), now);
    tracing::warn!("{}", host.warning());
    Conversation::Stock(Box::new(host))
}

impl Drop for McuLink {
    fn drop(&mut self) {
        self.host.leave(self.handed_over.get(), self.clock.now(), &mut self.effects);
        self.carry_out();
        let (counts, damaged) = (self.host.counts(), self.host.damaged());
        tracing::debug!(?counts, damaged, "`{}`: closed", self.config.port);
    }
}

fn tell(note: Note, port: &str) {
    match note {
        Note::Up(ack) => {
            tracing::info!("`{port}`: connected to firmware {}, calibration {:04x}", ack.firmware, ack.calibration_crc);
        }
        Note::Refused { got } => tracing::error!("`{port}`: the microcontroller speaks protocol version {got}"),
        Note::Silent => tracing::warn!("`{port}`: the microcontroller has fallen silent; no commands go out"),
        Note::SessionLost => {
            tracing::warn!("`{port}`: the microcontroller has ended the session; new handshake");
        }
        Note::Restarted => tracing::warn!("`{port}`: the microcontroller has restarted"),
        Note::Faults { came, went } => tell_faults(came, went, port),
        Note::ResetFailed(Some(faults)) => {
            tracing::warn!("`{port}`: reset did not clear: {}", texts(faults));
        }
        Note::ResetFailed(None) => {
            tracing::warn!("`{port}`: reset did not reach the microcontroller; repeat it when the link is up");
        }
    }
}

fn tell_stock(note: &StockNote, port: &str) {
    match note {
        StockNote::Up(summary) => tracing::info!("`{port}`: connected: {summary}"),
        StockNote::Refused(why) => tracing::error!("`{port}`: {why}"),
        StockNote::TopicRefused(why) => tracing::warn!("`{port}`: {why}"),
        StockNote::Silent => tracing::warn!("`{port}`: the microcontroller has fallen silent; it is told to stop"),
        StockNote::Restarted => tracing::warn!("`{port}`: the microcontroller has restarted"),
        StockNote::LeaseExpired => {
            tracing::warn!("`{port}`: the car is told to stop: {}", Fault::LeaseExpired.text());
        }
        StockNote::Log(LogLevel::Debug, text) => tracing::debug!("`{port}`: it says: {text}"),
        StockNote::Log(LogLevel::Info, text) => tracing::info!("`{port}`: it says: {text}"),
        StockNote::Log(LogLevel::Warn, text) => tracing::warn!("`{port}`: it says: {text}"),
        StockNote::Log(LogLevel::Error, text) => tracing::error!("`{port}`: it says: {text}"),
        StockNote::LogsDropped(count) => tracing::warn!("`{port}`: it says too much; {count} texts were dropped"),
    }
}

fn tell_faults(came: FaultSet, went: FaultSet, port: &str) {
    if !came.is_empty() {
        let stopping = came.0 & STOPPING_FAULTS.0 != 0;
        let effect = if stopping { "the microcontroller has stopped the car" } else { "the microcontroller warns" };
        tracing::warn!("`{port}`: {effect}: {}", texts(came));
    }
    if !went.is_empty() {
        tracing::info!("`{port}`: fault cleared: {went:?}");
    }
}

/// What the faults mean, with the bits that have no name yet.
fn texts(faults: FaultSet) -> String {
    let mut text = faults.iter().map(Fault::text).collect::<Vec<_>>().join("; ");
    let unknown = faults.iter().fold(faults, FaultSet::without);
    if !unknown.is_empty() {
        let gap = if text.is_empty() { "" } else { "; " };
        write!(text, "{gap}unknown faults {:#06x}", unknown.0).expect("writing to a string cannot fail");
    }
    text
}
