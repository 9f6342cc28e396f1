//! The operator `sim-avr`: the real firmware on a simulated ATmega328P (simavr, a program of its own) at the end of a serial line.
//! Live the chip keeps up with real time; in lockstep it follows the virtual one.

use std::path::Path;
use std::time::Duration;

use carril_messages::{McuPins, McuSensors, Stamp};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::chip_program::{CYCLES_PER_US, ChipInputs, ChipProgram, Happened, Stretch};
use crate::device_line::DeviceLine;
use crate::mcu_link::{is_line_name, line_name_rule};

/// Time between two looks at the chip.
const PERIOD: Duration = Duration::from_millis(2);
/// When this program was held up for longer, the chip sleeps through the rest: it could not catch up.
const LONGEST_STRETCH: Duration = Duration::from_millis(100);
/// The count of the encoder is drawn to the true one within about this time, s.
const DRAW_S: f32 = 0.2;
/// A wheel whose next edge is so many periods late stands.
const LATE: u32 = 3;
/// A servo that gets no pulse for so long is free.
const SERVO_FREE_AFTER_CYCLES: u64 = 100_000 * CYCLES_PER_US;

/// Configuration of [`SimAvr`].
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SimAvrConfig {
    /// Name of the line; the other end is `sim:NAME`.
    #[serde(default = "default_line")]
    pub line: String,
    /// The program that runs the chip: bridge/firmware/simulator, built by `./dev firmware`.
    pub program: String,
    /// The firmware: an ELF for the ATmega328P, built by `./dev firmware`.
    pub elf: String,
}

fn default_line() -> String {
    "mcu".to_owned()
}

impl OperatorConfig for SimAvrConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.require(is_line_name(&self.line), "line", || line_name_rule(&self.line));
        for (key, path) in [("program", &self.program), ("elf", &self.elf)] {
            findings.require(!path.is_empty(), key, || "got nothing, allowed is a path".into());
            if findings.probe_devices() {
                let full = findings.base_dir().join(path);
                findings.require(full.is_file(), key, || {
                    format!("there is no `{}`; `./dev firmware` builds it", full.display())
                });
            }
        }
    }
}

carril_runtime::inputs! {
    /// Inputs of [`SimAvr`].
    pub struct SimAvrInputs {
        /// What its input pins carry.
        sensors: McuSensors [hold],
    }
}

carril_runtime::outputs! {
    /// Outputs of [`SimAvr`].
    pub struct SimAvrOutputs {
        /// What its output pins carry, every 2 ms.
        pins: McuPins,
    }
}

/// The chip with the firmware in it.
pub struct SimAvr {
    chip: ChipProgram,
    line: DeviceLine,
    wheel: Wheel,
    pins: Pins,
    /// The chip has run until then.
    now: Option<Stamp>,
}

impl Operator for SimAvr {
    const KIND: &'static str = "sim-avr";
    const SUMMARY: &'static str = "Runs the real firmware on a simulated ATmega328P at the end of a serial line";
    const STAYS_ON_CAR: bool = true;
    type Config = SimAvrConfig;
    type Inputs = SimAvrInputs;
    type Outputs = SimAvrOutputs;
    // A successor starts a chip of its own, as after a loss of power.
    carril_runtime::stateless!();

    fn new(config: SimAvrConfig, setup: &Setup) -> Result<Self, SetupError> {
        let [program, elf] = [&config.program, &config.elf].map(|path| setup.path(path));
        for path in [&program, &elf] {
            must_be_there(path)?;
        }
        let chip = ChipProgram::start(&program, Some(&elf))
            .map_err(|error| SetupError::new(format!("cannot start `{}`: {error}", program.display())))?;
        let line = DeviceLine::open(&config.line, setup)?;
        Ok(Self { chip, line, wheel: Wheel::default(), pins: Pins::default(), now: None })
    }

    fn step(
        &mut self,
        inputs: &mut SimAvrInputs,
        outputs: &mut SimAvrOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let now = context.now();
        let before = self.now.replace(now).unwrap_or(now);
        let elapsed = now.since(before).to_duration().min(LONGEST_STRETCH);
        let bytes: Vec<u8> = self.line.take(now).into_iter().flat_map(|(_, bytes)| bytes).collect();
        let sensors = inputs.sensors.latest();
        let chip_inputs = sensors.as_deref().map_or_else(ChipInputs::default, |sensors| ChipInputs {
            encoder_edges_per_s: self.wheel.edges_per_s(sensors, now),
            battery_mv: (sensors.battery_v * 1_000.0).clamp(0.0, 65_535.0) as u16,
            estop_pressed: sensors.estop_pressed,
        });
        let stretch = self.chip.advance(elapsed.as_micros() as u32, chip_inputs, &bytes).map_err(|error| {
            StepError::new(format!("the program of the simulated chip has ended: {error}; restart this node"))
        })?;
        self.wheel.given = stretch.edges;
        self.line.write(&stretch.sent());
        self.pins.follow(&stretch);
        outputs.pins.send(self.pins.now(stretch.end_cycles));
        if self.pins.crashed { Err(StepError::new("the firmware has crashed")) } else { Ok(()) }
    }

    fn period(_config: &SimAvrConfig) -> Option<Duration> {
        Some(PERIOD)
    }

    /// It holds its end of the line.
    fn exclusive(_config: &SimAvrConfig) -> bool {
        true
    }
}

fn must_be_there(path: &Path) -> Result<(), SetupError> {
    if path.is_file() {
        return Ok(());
    }
    Err(SetupError::new(format!("there is no `{}`; `./dev firmware` builds it", path.display())))
}

/// Turns the count and period of the simulated wheel into a rate of edges, so that they come evenly and none is missed.
#[derive(Default)]
struct Wheel {
    /// Edges that the chip was given.
    given: u32,
    first: Option<u64>,
    last: Option<(u64, Stamp)>,
}

impl Wheel {
    fn edges_per_s(&mut self, sensors: &McuSensors, now: Stamp) -> f32 {
        let first = *self.first.get_or_insert(sensors.encoder_ticks);
        let (ticks, since) = match self.last {
            Some((ticks, since)) if ticks == sensors.encoder_ticks => (ticks, since),
            _ => (sensors.encoder_ticks, now),
        };
        self.last = Some((ticks, since));
        let missing = ticks.saturating_sub(first) as f32 - self.given as f32;
        let period = sensors.encoder_period_us.filter(|period_us| *period_us > 0);
        let rolling = period
            .filter(|period_us| now.since(since).to_duration() < Duration::from_micros(u64::from(*period_us)) * LATE);
        let rate = rolling.map_or(0.0, |period_us| 1e6 / period_us as f32);
        (rate + missing / DRAW_S).max(0.0)
    }
}

/// The pins as the events of the chip have left them.
#[derive(Default)]
struct Pins {
    duty: u8,
    backward: bool,
    driver_awake: bool,
    servo: Option<(u64, u32)>,
    crashed: bool,
}

impl Pins {
    fn follow(&mut self, stretch: &Stretch) {
        for event in &stretch.events {
            match event.what {
                Happened::MotorDuty(duty) => self.duty = duty,
                Happened::Direction(level) => self.backward = !level,
                Happened::ResetPin(level) => self.driver_awake = level,
                Happened::ServoPulse(cycles) => self.servo = Some((event.cycles, cycles)),
                Happened::Crashed => self.crashed = true,
                Happened::WatchdogReset => tracing::warn!("the watchdog has restarted the simulated chip"),
                Happened::ReceivedByteLost => tracing::debug!("the simulated chip has lost a byte"),
                _ => {}
            }
        }
    }

    fn now(&self, cycles: u64) -> McuPins {
        let duty = if self.driver_awake { f32::from(self.duty) / 255.0 } else { 0.0 };
        let fresh = self.servo.filter(|(at, _)| cycles.saturating_sub(*at) < SERVO_FREE_AFTER_CYCLES);
        McuPins {
            servo_us: fresh.map(|(_, width)| (u64::from(width) / CYCLES_PER_US) as u16),
            motor_duty: if self.backward { -duty } else { duty },
            // The driver grounds both terminals while its PWM is low; asleep it lets go.
            brake: self.driver_awake && self.duty == 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use carril_runtime::clock::VirtualClock;

    use super::*;
    use crate::chip_program::ChipEvent;

    #[test]
    fn edges_follow_the_wheel_and_none_is_missed() {
        let mut wheel = Wheel::default();
        let (mut given, mut ticks) = (0.0, 100.0_f64);
        for step in 0..1_000 {
            let now = Stamp::from_nanos(step * 5_000_000);
            let turning = step < 600;
            ticks += if turning { 318.0 * 0.005 } else { 0.0 };
            let sensors = McuSensors {
                encoder_ticks: ticks as u64,
                encoder_period_us: Some(3_145),
                battery_v: 8.0,
                estop_pressed: false,
            };
            let rate = wheel.edges_per_s(&sensors, now);
            if (100..600).contains(&step) {
                assert!((rate - 318.0).abs() < 20.0, "evenly: {rate} edges/s at step {step}");
            }
            given += f64::from(rate) * 0.005;
            wheel.given = given as u32;
        }
        // A wheel that stops is given the edges of a few more periods.
        assert!((given - (ticks - 100.0)).abs() < 4.0, "{given} edges for {} ticks", ticks - 100.0);
    }

    #[test]
    fn pins_are_as_the_last_events_left_them() {
        let mut pins = Pins::default();
        let event = |cycles, what| ChipEvent { cycles, what };
        let events = vec![
            event(1, Happened::ResetPin(true)),
            event(2, Happened::Direction(false)),
            event(3, Happened::MotorDuty(51)),
            event(4, Happened::ServoPulse(1_465 * 16)),
        ];
        pins.follow(&Stretch { end_cycles: 10, edges: 0, events });
        let expected = McuPins { servo_us: Some(1_465), motor_duty: -0.2, brake: false };
        assert_eq!(pins.now(10), expected, "backwards with a fifth");
        assert_eq!(pins.now(SERVO_FREE_AFTER_CYCLES + 5).servo_us, None, "no pulses, no servo");
        pins.follow(&Stretch { end_cycles: 20, edges: 0, events: vec![event(11, Happened::MotorDuty(0))] });
        assert!(pins.now(20).brake, "PWM low is the brake");
        pins.follow(&Stretch { end_cycles: 30, edges: 0, events: vec![event(21, Happened::ResetPin(false))] });
        assert!(!pins.now(30).brake, "asleep it coasts");
    }

    #[test]
    fn a_program_that_is_not_there_says_what_to_do() {
        let mut setup = Setup::for_tests("mcu");
        setup.clock = std::sync::Arc::new(VirtualClock::default());
        let config =
            SimAvrConfig { line: "mcu".into(), program: "/nothing/simulated-chip".into(), elf: "/nothing.elf".into() };
        let error = SimAvr::new(config, &setup).err().expect("nothing is there").to_string();
        assert!(error.contains("`/nothing/simulated-chip`") && error.contains("./dev firmware"), "{error}");
    }
}
