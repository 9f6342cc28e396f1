//! The two operators in virtual time, over a line in memory.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use carril_bridge::{
    McuLink, McuLinkConfig, McuLinkInputs, McuLinkOutputs, SimMcu, SimMcuConfig, SimMcuInputs, SimMcuOutputs,
};
use carril_messages::{Command, Control, Fault, McuPins, McuSensors, Stamp, WheelTelemetry};
use carril_runtime::lines::MemoryLines;
use carril_runtime::{Context, HeapPool, Operator, Setup, StepError, Trigger, Waker};

#[path = "support/link.rs"]
mod link;

use link::header;

/// Link and model on one memory line, stepped as an executor does: by period, by input, and when woken.
struct Run {
    lines: MemoryLines,
    link: Option<McuLink>,
    link_inputs: McuLinkInputs,
    link_outputs: McuLinkOutputs,
    link_woken: Arc<AtomicBool>,
    mcu: SimMcu,
    mcu_inputs: SimMcuInputs,
    mcu_outputs: SimMcuOutputs,
    mcu_woken: Arc<AtomicBool>,
    now: Stamp,
    command: Option<Command>,
    ticks: u64,
    pins: Option<McuPins>,
    telemetry: Vec<Arc<WheelTelemetry>>,
    last_result: Result<(), StepError>,
}

fn woken(flag: &Arc<AtomicBool>) -> Waker {
    let flag = Arc::clone(flag);
    Waker::new(move || flag.store(true, Ordering::Relaxed))
}

impl Run {
    fn new() -> Self {
        let lines = MemoryLines::default();
        let (link_woken, mcu_woken) = (Arc::default(), Arc::default());
        let setup = |waker| Setup { waker, memory_lines: Some(lines.clone()), ..Setup::for_tests("node") };
        let config = McuLinkConfig::carril("sim:mcu", 200);
        Self {
            link: Some(McuLink::new(config, &setup(woken(&link_woken))).expect("a memory line opens")),
            link_inputs: McuLinkInputs::default(),
            link_outputs: McuLinkOutputs::default(),
            mcu: SimMcu::new(SimMcuConfig::default(), &setup(woken(&mcu_woken))).expect("a memory line opens"),
            mcu_inputs: SimMcuInputs::default(),
            mcu_outputs: SimMcuOutputs::default(),
            lines: lines.clone(),
            link_woken,
            mcu_woken,
            now: Stamp::ZERO,
            command: Some(Command { steering_rad: -0.2, speed_m_s: 0.5 }),
            ticks: 0,
            pins: None,
            telemetry: Vec::new(),
            last_result: Ok(()),
        }
    }

    fn step_link(&mut self, trigger: Trigger) {
        let Some(link) = &mut self.link else { return };
        let context = Context::new(self.now, trigger, &HeapPool);
        self.last_result = link.step(&mut self.link_inputs, &mut self.link_outputs, &context);
        self.telemetry.extend(self.link_outputs.telemetry.sent());
    }

    fn step_mcu(&mut self, trigger: Trigger) {
        let sensors = McuSensors {
            encoder_ticks: self.ticks,
            encoder_period_us: Some(3_142),
            battery_v: 8.0,
            estop_pressed: false,
        };
        self.mcu_inputs.sensors.put(sensors, header::<McuSensors>(self.now));
        let context = Context::new(self.now, trigger, &HeapPool);
        self.mcu.step(&mut self.mcu_inputs, &mut self.mcu_outputs, &context).expect("the model does not fail");
        self.pins = self.mcu_outputs.pins.sent().last().map(|pins| **pins).or(self.pins);
    }

    /// Steps every 5 ms; commands come every 20 ms, and wakes are served at the time at which they come.
    fn run_ms(&mut self, ms: u64) {
        for _ in 0..ms / 5 {
            self.now = self.now + Duration::from_millis(5);
            let at_ms = self.now.as_nanos() / 1_000_000;
            self.ticks += u64::from(self.pins.is_some_and(|pins| pins.motor_duty != 0.0)) * 2;
            self.step_mcu(Trigger::Period);
            if at_ms % 50 == 0 {
                self.step_link(Trigger::Period);
            }
            if let Some(command) = self.command.filter(|_| at_ms % 20 == 0) {
                self.link_inputs.command.put(command, header::<Command>(self.now));
                self.step_link(Trigger::Input);
            }
            self.serve_wakes();
        }
    }

    fn serve_wakes(&mut self) {
        for _ in 0..100 {
            let link = self.link_woken.swap(false, Ordering::Relaxed);
            let mcu = self.mcu_woken.swap(false, Ordering::Relaxed);
            if link {
                self.step_link(Trigger::Wake);
            }
            if mcu {
                self.step_mcu(Trigger::Wake);
            }
            if !link && !mcu {
                return;
            }
        }
        panic!("the two ends wake each other for ever");
    }

    fn control(&mut self, control: Control) {
        self.link.as_mut().expect("the link is there").control(control, self.now);
        self.step_link(Trigger::Control);
        self.serve_wakes();
    }

    fn drives(&self) -> bool {
        self.pins.is_some_and(|pins| pins.motor_duty > 0.0 && !pins.brake)
    }

    fn last_telemetry(&self) -> &WheelTelemetry {
        self.telemetry.last().expect("telemetry has come")
    }
}

#[test]
fn drives_steers_and_reports_without_an_error() {
    let mut run = Run::new();
    run.run_ms(2_000);
    assert!(run.drives(), "{:?}", run.pins);
    assert_eq!(run.pins.and_then(|pins| pins.servo_us), Some(812), "-0.2 rad is right of the middle, µs");
    assert!((198..=201).contains(&run.telemetry.len()), "100 Hz for 2 s, got {}", run.telemetry.len());
    let last = run.last_telemetry();
    assert!(last.driving && last.faults.is_empty(), "{last:?}");
    assert_eq!((last.steering_rad, last.battery_v), (-0.2, Some(8.0)), "{last:?}");
    assert!((last.speed_m_s - 0.5).abs() < 0.01, "a tick every 3.142 ms is 0.5 m/s, got {} m/s", last.speed_m_s);
    assert!(run.telemetry.iter().any(|report| report.round_trip_us == Some(0)), "memory takes no time");
    assert!(run.last_result.is_ok(), "{:?}", run.last_result);
}

#[test]
fn two_runs_are_the_same() {
    let record = || {
        let mut run = Run::new();
        run.run_ms(300);
        run.control(Control::EStop);
        run.run_ms(300);
        run.control(Control::Reset);
        run.run_ms(300);
        format!("{:?} {:?}", run.telemetry, run.pins)
    };
    assert_eq!(record(), record(), "virtual time leaves nothing to chance");
}

#[test]
fn a_link_that_dies_silently_stops_the_car_within_its_lease() {
    let mut run = Run::new();
    run.run_ms(500);
    assert!(run.drives(), "{:?}", run.pins);
    // As after SIGKILL: nothing is said, nothing is dropped.
    std::mem::forget(run.link.take());
    run.run_ms(195);
    assert!(run.drives(), "the lease still runs");
    run.run_ms(15);
    assert!(run.pins.is_some_and(|pins| pins.brake && pins.motor_duty == 0.0), "200 ms + 10 ms: {:?}", run.pins);
}

#[test]
fn a_link_that_ends_in_order_stops_the_car_at_once() {
    let mut run = Run::new();
    run.run_ms(500);
    drop(run.link.take());
    run.serve_wakes();
    assert!(run.pins.is_some_and(|pins| pins.brake), "braked by the release: {:?}", run.pins);
}

#[test]
fn a_cut_line_stops_the_car_which_stays_until_reset() {
    let mut run = Run::new();
    run.run_ms(500);
    run.lines.set_cut("mcu", true);
    run.run_ms(1_000);
    assert!(run.pins.is_some_and(|pins| pins.brake), "{:?}", run.pins);
    let error = run.last_result.as_ref().expect_err("the node is faulted for as long as it lasts").to_string();
    assert!(error.contains("`sim:mcu`: the microcontroller has fallen silent"), "{error}");
    run.lines.set_cut("mcu", false);
    run.run_ms(500);
    assert!(run.last_telemetry().faults.contains(Fault::LeaseExpired), "{:?}", run.last_telemetry());
    assert!(!run.drives(), "latched");
    let error = run.last_result.as_ref().expect_err("still faulted").to_string();
    assert!(error.contains("has stopped the car") && error.contains("carril reset"), "{error}");
    run.control(Control::Reset);
    run.run_ms(100);
    assert!(run.drives() && run.last_result.is_ok(), "{:?} {:?}", run.pins, run.last_result);
}

#[test]
fn an_estop_brakes_in_the_same_moment_and_outlives_its_node() {
    let mut run = Run::new();
    run.run_ms(500);
    run.control(Control::EStop);
    assert!(run.pins.is_some_and(|pins| pins.brake), "at the time of the word: {:?}", run.pins);
    let state = run.link.as_ref().expect("the link is there").snapshot();
    let mut successor = Run::new();
    successor.link.as_mut().expect("the link is there").restore(state).expect("the state fits");
    successor.run_ms(500);
    assert!(!successor.drives(), "the successor stays stopped");
    successor.control(Control::Reset);
    successor.run_ms(100);
    assert!(successor.drives(), "until it is reset: {:?}", successor.last_result);
}

#[test]
fn every_wrong_value_of_the_configuration_is_named() {
    let registry = carril_bridge::registry();
    let found = |kind: &str, config: &str| {
        let kind = registry.get(kind).expect("the kind is known");
        let config = serde_json::from_str(config).expect("the test's own JSON");
        let found = kind.check_config(&config, std::path::Path::new("."), false);
        found.iter().map(|finding| format!("{}: {}", finding.path.join("."), finding.message)).collect::<Vec<_>>()
    };
    let none: Vec<String> = Vec::new();
    assert_eq!(found("mcu-link", r#"{"port": "/dev/serial/by-id/usb-car", "lease_ms": 20}"#), none, "all allowed");
    assert_eq!(found("sim-mcu", "null"), none, "the model needs no configuration");
    assert_eq!(found("mcu-link", "{}"), [": missing field `port`"], "the port has no default");
    assert_eq!(
        found("mcu-link", r#"{"port": "sim:../mcu", "lease_ms": 3000, "baud": 0}"#),
        [
            "baud: got 0 baud, allowed is 9600 to 2000000 baud",
            "lease_ms: got 3000 ms, allowed is 20 to 2000 ms",
            "port: got line name `../mcu`, allowed are 1 to 32 letters, digits, `-` and `_`",
        ],
        "every problem in one run"
    );
    assert_eq!(
        found("mcu-link", r#"{"port": "sim:mcu", "lease_ms": -1}"#).len(),
        1,
        "a negative lease is no number of ms"
    );
    assert_eq!(found("sim-mcu", r#"{"line": "mcu", "speed": 1}"#).len(), 1, "unknown fields are refused");
    assert_eq!(found("sim-mcu", r#"{"battery_low_v": -1}"#).len(), 1, "a negative voltage is refused");
}
