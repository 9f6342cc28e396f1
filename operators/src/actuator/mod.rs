//! Operator `actuator`: the last word on a command before it leaves for the wheels. Clamps it, slews it, and stops the car on its
//! own when commands are late or a person said so. Never passes on what is not a finite number, and never moves on its own.

#[cfg(test)]
mod tests;

use std::time::Duration;

use carril_messages::{Command, Control, Header, Stamp, car};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StateError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// No step moves the outputs further than in this time, s: after a pause the slew does not catch up in one jump.
const LONGEST_STEP_S: f64 = 0.1;

/// Configuration of the actuator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ActuatorConfig {
    /// Largest road-wheel angle to either side, degrees, > 0 to 60. The 1:10 car's servo stops at 20.
    #[schemars(range(max = 60), extend("exclusiveMinimum" = 0, "unit" = "degrees"))]
    pub max_steering_deg: f64,
    /// Largest speed ahead, m/s, > 0 to 20.
    #[schemars(range(max = 20), extend("exclusiveMinimum" = 0, "unit" = "m/s"))]
    pub max_speed_m_s: f64,
    /// Largest speed backwards, m/s, 0 (never backwards) to 20.
    #[schemars(range(min = 0, max = 20), extend("unit" = "m/s"))]
    pub max_reverse_m_s: f64,
    /// Fastest change of the road-wheel angle, rad/s, > 0 to 100.
    #[schemars(range(max = 100), extend("exclusiveMinimum" = 0, "unit" = "rad/s"))]
    pub steering_rate_rad_s: f64,
    /// Strongest acceleration (away from speed 0), m/s², > 0 to 50.
    #[schemars(range(max = 50), extend("exclusiveMinimum" = 0, "unit" = "m/s²"))]
    pub acceleration_m_s2: f64,
    /// Strongest deceleration (towards speed 0), m/s², > 0 to 50. An e-stop does not wait for it.
    #[schemars(range(max = 50), extend("exclusiveMinimum" = 0, "unit" = "m/s²"))]
    pub deceleration_m_s2: f64,
    /// Older commands stop the car, ms, 20 to 2000. Name of the stop: `command-stale`.
    #[schemars(range(min = 20, max = 2000), extend("unit" = "ms"))]
    pub timeout_ms: f64,
    /// After `command-stale`, commands must have come without a gap for so long before the car moves again, ms, 0 to 10000.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub recover_ms: f64,
    /// `command-stale` stays until `reset` and `start`, however well commands come again.
    pub latch_stale: bool,
}

impl Default for ActuatorConfig {
    fn default() -> Self {
        Self {
            max_steering_deg: car::STEERING_LIMIT_RAD.to_degrees(),
            max_speed_m_s: 1.0,
            max_reverse_m_s: 0.5,
            steering_rate_rad_s: 8.0,
            acceleration_m_s2: 1.5,
            deceleration_m_s2: 3.0,
            timeout_ms: 200.0,
            recover_ms: 500.0,
            latch_stale: false,
        }
    }
}

impl OperatorConfig for ActuatorConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        for (field, value, max, unit) in [
            ("max_steering_deg", self.max_steering_deg, 60.0, "degrees"),
            ("max_speed_m_s", self.max_speed_m_s, 20.0, "m/s"),
            ("steering_rate_rad_s", self.steering_rate_rad_s, 100.0, "rad/s"),
            ("acceleration_m_s2", self.acceleration_m_s2, 50.0, "m/s²"),
            ("deceleration_m_s2", self.deceleration_m_s2, 50.0, "m/s²"),
        ] {
            findings.require(value > 0.0 && value <= max, field, || {
                format!("got {value} {unit}, allowed is more than 0, up to {max} {unit}")
            });
        }
        findings.range("max_reverse_m_s", self.max_reverse_m_s, 0.0, 20.0, "m/s");
        findings.range("timeout_ms", self.timeout_ms, 20.0, 2000.0, "ms");
        findings.range("recover_ms", self.recover_ms, 0.0, 10_000.0, "ms");
    }
}

/// Why the car is held at speed 0, whatever the commands say.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Stop {
    /// A person said `estop`. Ends with `reset`.
    EStop,
    /// A person said `stop` or `reset`. Ends with `start`.
    AwaitingStart,
    /// Commands are late. Ends by itself or, latched, with `reset`.
    CommandStale,
}

impl Stop {
    /// As in messages: `command-stale`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::EStop => "e-stop",
            Self::AwaitingStart => "awaiting-start",
            Self::CommandStale => "command-stale",
        }
    }
}

/// All that the actuator remembers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[allow(
    clippy::struct_excessive_bools,
    reason = "each is a stop of its own, and they hold independently of each other"
)]
pub struct ActuatorState {
    /// What was sent last.
    sent: Command,
    /// When.
    sent_at: Option<Stamp>,
    /// The last valid command.
    target: Command,
    /// When it was published, as far as it is to be believed; `None` before the first.
    heard_at: Option<Stamp>,
    /// Since when commands have come without a gap.
    flowing_since: Option<Stamp>,
    estop: bool,
    awaiting_start: bool,
    stale: bool,
    stale_latched: bool,
}

/// Limits commands, and stops the car when they are late.
pub struct Actuator {
    config: ActuatorConfig,
    timeout: Duration,
    recover: Duration,
    state: ActuatorState,
}

impl Actuator {
    /// From a configuration that has passed its check.
    pub fn from_config(config: ActuatorConfig) -> Self {
        let timeout = Duration::from_secs_f64(config.timeout_ms * 1e-3);
        let recover = Duration::from_secs_f64(config.recover_ms * 1e-3);
        Self { config, timeout, recover, state: ActuatorState::default() }
    }

    /// Why the car is held, if it is.
    pub fn stop(&self) -> Option<Stop> {
        let state = &self.state;
        if state.estop {
            Some(Stop::EStop)
        } else if state.stale || state.stale_latched {
            Some(Stop::CommandStale)
        } else if state.awaiting_start {
            Some(Stop::AwaitingStart)
        } else {
            None
        }
    }

    /// Takes in a command. One that is no number is refused, as if it had never come.
    fn hear(&mut self, command: Command, header: &Header, now: Stamp) -> Result<(), StepError> {
        if !command.is_finite() {
            return Err(StepError::new(format!(
                "command refused: got steering {} rad, speed {} m/s, both must be finite",
                command.steering_rad, command.speed_m_s
            )));
        }
        // A stamp from the future must not keep a command fresh for longer.
        self.state.heard_at = Some(header.stamp.min(now));
        self.state.target = command;
        Ok(())
    }

    fn fresh(&self, now: Stamp) -> bool {
        self.state.heard_at.is_some_and(|heard| now.since(heard).to_duration() <= self.timeout)
    }

    /// Begins and ends `command-stale`.
    fn watch(&mut self, now: Stamp) {
        if !self.fresh(now) {
            self.state.flowing_since = None;
            // Before the first command nothing is late: the car stands, and waits.
            self.state.stale |= self.state.heard_at.is_some();
            self.state.stale_latched |= self.state.stale && self.config.latch_stale;
            return;
        }
        let since = *self.state.flowing_since.get_or_insert(now);
        if now.since(since).to_duration() >= self.recover {
            self.state.stale = false;
        }
    }

    /// What to aim at: the command within the limits, or speed 0 with the wheels held.
    fn goal(&self) -> Command {
        let limit = self.config.max_steering_deg.to_radians();
        if self.stop().is_some() || self.state.heard_at.is_none() {
            return Command { steering_rad: self.state.sent.steering_rad, speed_m_s: 0.0 };
        }
        let Command { steering_rad, speed_m_s } = self.state.target;
        Command {
            steering_rad: f64::from(steering_rad).clamp(-limit, limit) as f32,
            // `+ 0.0` makes 0 of -0, which is what a limit of 0 backwards would give.
            speed_m_s: (f64::from(speed_m_s).clamp(-self.config.max_reverse_m_s, self.config.max_speed_m_s) + 0.0)
                as f32,
        }
    }

    /// The next output.
    fn advance(&mut self, now: Stamp) -> Command {
        let pause_s = self.state.sent_at.map_or(0.0, |sent_at| now.since(sent_at).as_secs_f64());
        let step_s = pause_s.clamp(0.0, LONGEST_STEP_S);
        let goal = self.goal();
        let sent = self.state.sent;
        let steering = approach(sent.steering_rad, goal.steering_rad, self.config.steering_rate_rad_s * step_s);
        let speed = if self.state.estop { 0.0 } else { self.slew_speed(sent.speed_m_s, goal.speed_m_s, step_s) };
        self.state.sent = Command { steering_rad: steering, speed_m_s: speed };
        self.state.sent_at = Some(now);
        self.state.sent
    }

    /// Towards 0 with the deceleration, away from it with the acceleration; through 0 only by way of 0.
    fn slew_speed(&self, from: f32, to: f32, step_s: f64) -> f32 {
        let brakes = f64::from(from) * f64::from(to) < 0.0 || to.abs() < from.abs();
        if brakes {
            let target = if from * to < 0.0 { 0.0 } else { to };
            approach(from, target, self.config.deceleration_m_s2 * step_s)
        } else {
            approach(from, to, self.config.acceleration_m_s2 * step_s)
        }
    }
}

/// From one value towards another, by at most `most`.
fn approach(from: f32, to: f32, most: f64) -> f32 {
    let difference = f64::from(to) - f64::from(from);
    if difference.abs() <= most { to } else { (f64::from(from) + most.copysign(difference)) as f32 }
}

carril_runtime::inputs! {
    /// What the actuator reads.
    pub struct ActuatorInputs {
        /// What the car shall do.
        command: Command,
    }
}

carril_runtime::outputs! {
    /// What the actuator gives.
    pub struct ActuatorOutputs {
        /// What the car shall do, within its limits. Comes every period, so that the lease at the motors never runs out by chance.
        command: Command,
    }
}

impl Operator for Actuator {
    const KIND: &'static str = "actuator";
    const SUMMARY: &'static str = "limits commands (clamp, slew), stops the car when they are late, latches the e-stop";
    const STAYS_ON_CAR: bool = true;

    type Config = ActuatorConfig;
    type Inputs = ActuatorInputs;
    type Outputs = ActuatorOutputs;
    type State = ActuatorState;

    fn new(config: ActuatorConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self::from_config(config))
    }

    fn step(
        &mut self,
        inputs: &mut ActuatorInputs,
        outputs: &mut ActuatorOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let now = context.now();
        // A command that no longer counts is not read, so that a stop does not carry the age of what it does not derive from.
        let counts = self.fresh(now) && self.stop().is_none();
        let mut refused = Ok(());
        let news = inputs.command.has_news();
        if (news || counts)
            && let Some(sample) = inputs.command.latest()
            && news
        {
            refused = self.hear(**sample.value(), sample.header(), now);
        }
        self.watch(now);
        let command = self.advance(now);
        outputs.command.send(command);
        refused?;
        match self.stop() {
            Some(Stop::EStop) => Err(StepError::new("stopped by `e-stop`; `carril reset`, then `carril start`")),
            Some(Stop::CommandStale) if self.state.stale_latched => {
                Err(StepError::new("stopped by `command-stale`, latched; `carril reset`, then `carril start`"))
            }
            Some(Stop::CommandStale) => Err(StepError::new(format!(
                "stopped by `command-stale`: no command for more than {} ms; goes on when commands have come for {} ms",
                self.config.timeout_ms, self.config.recover_ms
            ))),
            Some(Stop::AwaitingStart) | None => Ok(()),
        }
    }

    fn period(_config: &ActuatorConfig) -> Option<Duration> {
        Some(Duration::from_millis(20))
    }

    fn control(&mut self, control: Control, _now: Stamp) {
        let state = &mut self.state;
        match control {
            Control::EStop => state.estop = true,
            Control::Stop => state.awaiting_start = true,
            Control::Start if state.estop || state.stale_latched => {}
            Control::Start => state.awaiting_start = false,
            Control::Reset => {
                state.awaiting_start = true;
                state.estop = false;
                state.stale_latched = false;
            }
        }
    }

    fn snapshot(&self) -> ActuatorState {
        self.state.clone()
    }

    fn restore(&mut self, state: ActuatorState) -> Result<(), StateError> {
        if !state.sent.is_finite() || !state.target.is_finite() {
            return Err(StateError::new("the predecessor's last command is not finite"));
        }
        self.state = state;
        Ok(())
    }
}
