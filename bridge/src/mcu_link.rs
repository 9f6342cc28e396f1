//! The operator `mcu-link`: commands to the microcontroller, telemetry from it. The conversation is in `host`, the port in
//! `link`; this joins them and tells people what happens.

use std::cell::Cell;
use std::fmt::Write as _;
use std::time::Duration;

use carril_messages::{Command, Control, Fault, FaultSet, Stamp, WheelTelemetry, codec};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StateError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::codec::MAX_LEASE_MS;
use crate::host::{Effects, Host, HostState, Latches, LinkCounts, Note};
use crate::link::{self, Line, LineEvent, SIMULATED};
use crate::mcu_model::STOPPING_FAULTS;

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
    /// Speed of the line, baud. 9600 to 2000000.
    #[serde(default = "default_baud")]
    #[schemars(range(min = 9600, max = 2_000_000), extend("unit" = "baud"))]
    pub baud: u32,
    /// The motor brakes when no further command comes for so long, ms. 20 to 2000.
    #[serde(default = "default_lease_ms")]
    #[schemars(range(min = MIN_LEASE_MS, max = MAX_LEASE_MS), extend("unit" = "ms"))]
    pub lease_ms: u16,
}

fn default_baud() -> u32 {
    500_000
}

fn default_lease_ms() -> u16 {
    200
}

impl OperatorConfig for McuLinkConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("baud", f64::from(self.baud), 9_600.0, 2_000_000.0, "baud");
        findings.range("lease_ms", f64::from(self.lease_ms), f64::from(MIN_LEASE_MS), f64::from(MAX_LEASE_MS), "ms");
        if let Some(name) = self.port.strip_prefix(SIMULATED) {
            findings.require(is_line_name(name), "port", || line_name_rule(name));
        } else {
            findings.require(!self.port.is_empty(), "port", || "got nothing, allowed is a path or `sim:NAME`".into());
            findings.device("port", &self.port);
        }
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
    host: Host,
    effects: Effects,
    events: Vec<LineEvent>,
    /// The state was taken after the last step: a successor goes on with the session, and it must not be ended.
    handed_over: Cell<bool>,
}

impl Operator for McuLink {
    const KIND: &'static str = "mcu-link";
    const SUMMARY: &'static str = "Sends commands with a lease to the microcontroller and publishes its telemetry";
    /// 1: the latches alone.
    const STATE_VERSION: u32 = 2;
    type Config = McuLinkConfig;
    type Inputs = McuLinkInputs;
    type Outputs = McuLinkOutputs;
    /// What stopped the car outlives the instance that stopped it, and the session goes on.
    type State = HostState;

    fn new(config: McuLinkConfig, setup: &Setup) -> Result<Self, SetupError> {
        let line = link::open(&config.port, config.baud, setup)?;
        let now = setup.clock.now();
        // Another life of this node shall use other sessions; in lockstep the clock is the same each time.
        let seed = setup.seed ^ now.as_nanos() as u64;
        let host = Host::new(&config.port, config.lease_ms, seed, now);
        let (effects, events) = (Effects::default(), Vec::new());
        Ok(Self { config, line, host, effects, events, handed_over: Cell::new(false) })
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
            Some(command) => self.host.command(&command, command.header().stamp, now, &mut self.effects),
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

    fn period(_config: &McuLinkConfig) -> Option<Duration> {
        Some(PERIOD)
    }

    fn control(&mut self, control: Control, now: Stamp) {
        self.handed_over.set(false);
        self.host.control(control, now, &mut self.effects);
        self.carry_out();
    }

    fn snapshot(&self) -> HostState {
        self.handed_over.set(true);
        self.host.state()
    }

    fn restore(&mut self, state: HostState) -> Result<(), StateError> {
        self.host.restore(state, &mut self.effects);
        self.carry_out();
        Ok(())
    }

    fn migrate(version: u32, state: &[u8]) -> Result<HostState, StateError> {
        if version != 1 {
            let (kind, own) = (Self::KIND, Self::STATE_VERSION);
            return Err(StateError::new(format!(
                "the state has version {version}, `{kind}` takes versions 1 and {own}"
            )));
        }
        let latches: Latches = codec::decode(state).map_err(StateError::new)?;
        Ok(latches.into())
    }

    /// It holds the serial port.
    fn exclusive(_config: &McuLinkConfig) -> bool {
        true
    }

    fn reconfigure(&mut self, config: &McuLinkConfig) -> Option<Result<(), SetupError>> {
        if (&config.port, config.baud) != (&self.config.port, self.config.baud) {
            return None;
        }
        self.host.set_lease_ms(config.lease_ms);
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
        let Effects { urgent, command, notes, .. } = &mut self.effects;
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
    }
}

impl Drop for McuLink {
    fn drop(&mut self) {
        if !self.handed_over.get() {
            self.host.release(&mut self.effects);
            self.carry_out();
        }
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
