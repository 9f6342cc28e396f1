//! The actuator as a whole: limits, stops and their ends, and what must hold whatever comes.

use carril_runtime::Trigger;
use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::testing::{at_ms, context, header, problems};

/// An actuator with its ports and a time that goes on.
struct Bench {
    actuator: Actuator,
    inputs: ActuatorInputs,
    outputs: ActuatorOutputs,
    now_ms: i64,
}

impl Bench {
    fn new(config: ActuatorConfig) -> Self {
        let (inputs, outputs) = Default::default();
        Self { actuator: Actuator::from_config(config), inputs, outputs, now_ms: 0 }
    }

    /// One period later, with or without a new command.
    fn tick(&mut self, command: Option<(f32, f32)>) -> (Command, Result<(), String>) {
        self.now_ms += 20;
        let now = at_ms(self.now_ms);
        if let Some((steering_rad, speed_m_s)) = command {
            self.inputs.command.put(Command { steering_rad, speed_m_s }, header::<Command>(now));
        }
        let step = self.actuator.step(&mut self.inputs, &mut self.outputs, &context(now, Trigger::Period));
        let sent = self.outputs.command.sent();
        assert_eq!(sent.len(), 1, "one command per step");
        (*sent[0], step.map_err(|error| error.to_string()))
    }

    fn ticks(&mut self, count: usize, command: Option<(f32, f32)>) -> Command {
        let mut last = Command::default();
        for _ in 0..count {
            last = self.tick(command).0;
        }
        last
    }

    fn say(&mut self, control: Control) {
        self.actuator.control(control, at_ms(self.now_ms));
    }
}

fn driving(config: ActuatorConfig) -> Bench {
    let mut bench = Bench::new(config);
    assert_eq!(bench.ticks(60, Some((0.1, 0.5))), Command { steering_rad: 0.1, speed_m_s: 0.5 }, "it drives");
    bench
}

#[test]
fn stands_and_waits_before_the_first_command() {
    let mut bench = Bench::new(ActuatorConfig::default());
    for _ in 0..100 {
        assert_eq!(bench.tick(None), (Command::default(), Ok(())), "silence at the start is no fault");
    }
}

#[test]
fn clamps_to_the_cars_limits() {
    let mut bench = Bench::new(ActuatorConfig::default());
    let far = bench.ticks(100, Some((2.0, 9.0)));
    assert!((far.steering_rad - 0.349_066).abs() < 1e-5, "20 degrees to the left: {far:?}");
    assert_eq!(far.speed_m_s, 1.0, "the largest speed");
    let back = bench.ticks(100, Some((-2.0, -9.0)));
    assert!((back.steering_rad + 0.349_066).abs() < 1e-5, "20 degrees to the right: {back:?}");
    assert_eq!(back.speed_m_s, -0.5, "the largest speed backwards");
    let mut forward_only = Bench::new(ActuatorConfig { max_reverse_m_s: 0.0, ..ActuatorConfig::default() });
    let stands = forward_only.ticks(100, Some((0.0, -1.0))).speed_m_s;
    assert!(stands == 0.0 && stands.is_sign_positive(), "never backwards, got {stands}");
}

#[test]
fn slews_steering_speed_and_braking_each_at_its_rate() {
    let mut bench = Bench::new(ActuatorConfig::default());
    bench.ticks(5, Some((0.0, 0.0)));
    let first = bench.tick(Some((0.3, 1.0))).0;
    assert!((first.steering_rad - 0.16).abs() < 1e-6, "8 rad/s for 20 ms: {first:?}");
    assert!((first.speed_m_s - 0.03).abs() < 1e-6, "1.5 m/s² for 20 ms: {first:?}");
    bench.ticks(100, Some((0.3, 1.0)));
    let braking = bench.tick(Some((0.3, 0.0))).0;
    assert!((braking.speed_m_s - 0.94).abs() < 1e-6, "3 m/s² for 20 ms: {braking:?}");
    let mut last = braking.speed_m_s;
    let mut stood = false;
    for _ in 0..60 {
        let speed = bench.tick(Some((0.3, -0.5))).0.speed_m_s;
        stood |= speed == 0.0;
        assert!(speed <= last, "steadily down: {speed} after {last}");
        last = speed;
    }
    assert!(stood, "backwards only by way of standing");
    assert_eq!(last, -0.5, "and then backwards");
}

#[test]
fn does_not_jump_after_a_pause() {
    let mut bench = Bench::new(ActuatorConfig { timeout_ms: 2000.0, ..ActuatorConfig::default() });
    bench.ticks(5, Some((0.0, 0.0)));
    bench.now_ms += 1000;
    let speed = bench.tick(Some((0.0, 1.0))).0.speed_m_s;
    assert!(speed <= 0.15 + 1e-6, "at most a tenth of a second of acceleration, got {speed}");
}

#[test]
fn stops_when_commands_are_stale_and_recovers_when_they_flow() {
    let mut bench = driving(ActuatorConfig::default());
    assert_eq!(bench.ticks(10, None).speed_m_s, 0.5, "200 ms of silence are allowed");
    let (first, result) = bench.tick(None);
    assert!(first.speed_m_s < 0.5 && first.steering_rad == 0.1, "brakes, wheels held: {first:?}");
    let reason = result.expect_err("the stop has a name");
    assert!(reason.contains("`command-stale`") && reason.contains("200 ms"), "{reason}");
    assert_eq!(bench.ticks(20, None), Command { steering_rad: 0.1, speed_m_s: 0.0 }, "stands");
    assert_eq!(bench.ticks(25, Some((0.1, 0.5))).speed_m_s, 0.0, "one command after a gap is not enough");
    assert!(bench.ticks(5, Some((0.1, 0.5))).speed_m_s > 0.0, "500 ms without a gap are");
    assert_eq!(bench.actuator.stop(), None, "the stop has ended");
}

#[test]
fn a_gap_while_recovering_begins_anew() {
    let mut bench = driving(ActuatorConfig::default());
    bench.ticks(20, None);
    bench.ticks(20, Some((0.0, 0.5)));
    bench.ticks(12, None);
    assert_eq!(bench.ticks(24, Some((0.0, 0.5))).speed_m_s, 0.0, "the 400 ms before the gap do not count");
}

#[test]
fn a_latched_stale_stop_needs_reset_and_start() {
    let mut bench = driving(ActuatorConfig { latch_stale: true, ..ActuatorConfig::default() });
    bench.ticks(20, None);
    assert_eq!(bench.ticks(100, Some((0.0, 0.5))).speed_m_s, 0.0, "latched, however well they flow");
    bench.say(Control::Start);
    assert_eq!(bench.ticks(50, Some((0.0, 0.5))).speed_m_s, 0.0, "`start` alone does not help");
    bench.say(Control::Reset);
    assert_eq!(bench.ticks(50, Some((0.0, 0.5))).speed_m_s, 0.0, "`reset` alone does not move it");
    bench.say(Control::Start);
    assert!(bench.ticks(5, Some((0.0, 0.5))).speed_m_s > 0.0, "`reset` and `start` do");
}

#[test]
fn an_estop_is_immediate_and_latched() {
    let mut bench = driving(ActuatorConfig::default());
    bench.say(Control::EStop);
    let (command, result) = bench.tick(Some((0.3, 0.5)));
    assert_eq!(command, Command { steering_rad: 0.1, speed_m_s: 0.0 }, "0 at once, wheels held");
    assert!(result.expect_err("the stop has a name").contains("`e-stop`"), "named");
    bench.say(Control::Start);
    bench.say(Control::Stop);
    bench.say(Control::Start);
    assert_eq!(bench.ticks(100, Some((0.0, 0.5))).speed_m_s, 0.0, "latched");
    bench.say(Control::Reset);
    assert_eq!(bench.ticks(100, Some((0.0, 0.5))).speed_m_s, 0.0, "`reset` alone does not move it");
    bench.say(Control::Start);
    assert_eq!(bench.ticks(100, Some((0.0, 0.5))).speed_m_s, 0.5, "`start` does");
}

#[test]
fn stop_holds_the_car_until_start_even_against_commands() {
    let mut bench = driving(ActuatorConfig::default());
    bench.say(Control::Stop);
    let first = bench.tick(Some((0.1, 0.5))).0.speed_m_s;
    assert!(first > 0.0 && first < 0.5, "slows down in order, got {first}");
    assert_eq!(bench.ticks(100, Some((0.1, 0.5))).speed_m_s, 0.0, "and stands");
    bench.say(Control::Start);
    assert_eq!(bench.ticks(100, Some((0.1, 0.5))).speed_m_s, 0.5, "until `start`");
}

#[test]
fn refuses_what_is_no_number_as_if_it_had_never_come() {
    let mut bench = driving(ActuatorConfig::default());
    for bad in [(f32::NAN, 0.5), (0.1, f32::INFINITY), (f32::NEG_INFINITY, f32::NAN)] {
        let (command, result) = bench.tick(Some(bad));
        assert_eq!(command, Command { steering_rad: 0.1, speed_m_s: 0.5 }, "the last valid command holds");
        assert!(result.expect_err("refused").contains("must be finite"), "{bad:?}");
    }
    assert_eq!(bench.ticks(40, Some((f32::NAN, f32::NAN))).speed_m_s, 0.0, "and then it is stale");
}

#[test]
fn a_stamp_from_the_future_keeps_nothing_fresh() {
    let mut bench = Bench::new(ActuatorConfig::default());
    bench.inputs.command.put(Command { steering_rad: 0.0, speed_m_s: 0.5 }, header::<Command>(at_ms(1_000_000)));
    bench.ticks(8, None);
    assert_eq!(bench.ticks(60, None).speed_m_s, 0.0, "it counts from when it came");
    assert_eq!(bench.actuator.stop(), Some(Stop::CommandStale), "by name");
}

#[test]
fn a_successor_goes_on_where_the_predecessor_stopped() {
    let mut old = driving(ActuatorConfig::default());
    old.say(Control::EStop);
    let mut new = Bench::new(ActuatorConfig::default());
    new.now_ms = old.now_ms;
    new.actuator.restore(old.actuator.snapshot()).expect("a valid state");
    assert_eq!(new.tick(Some((0.0, 0.5))).0.speed_m_s, 0.0, "the e-stop is handed over");
    let broken = ActuatorState { sent: Command { steering_rad: f32::NAN, speed_m_s: 0.0 }, ..old.actuator.snapshot() };
    assert!(new.actuator.restore(broken).is_err(), "a state that is no number is refused");
}

#[test]
fn every_bound_is_checked() {
    for (config, field) in [
        (json!({"max_steering_deg": 0}), "max_steering_deg"),
        (json!({"max_steering_deg": 61}), "max_steering_deg"),
        (json!({"max_speed_m_s": 0}), "max_speed_m_s"),
        (json!({"max_speed_m_s": 21}), "max_speed_m_s"),
        (json!({"max_reverse_m_s": -0.1}), "max_reverse_m_s"),
        (json!({"max_reverse_m_s": 21}), "max_reverse_m_s"),
        (json!({"steering_rate_rad_s": 0}), "steering_rate_rad_s"),
        (json!({"steering_rate_rad_s": 101}), "steering_rate_rad_s"),
        (json!({"acceleration_m_s2": 0}), "acceleration_m_s2"),
        (json!({"acceleration_m_s2": 51}), "acceleration_m_s2"),
        (json!({"deceleration_m_s2": 0}), "deceleration_m_s2"),
        (json!({"deceleration_m_s2": 51}), "deceleration_m_s2"),
        (json!({"timeout_ms": 19}), "timeout_ms"),
        (json!({"timeout_ms": 2001}), "timeout_ms"),
        (json!({"recover_ms": -1}), "recover_ms"),
        (json!({"recover_ms": 10001}), "recover_ms"),
    ] {
        let found = problems::<Actuator>(&config);
        assert!(found.len() == 1 && found[0].starts_with(&format!("{field}: got ")), "{config}: {found:?}");
    }
    assert_eq!(problems::<Actuator>(&json!({})), Vec::<String>::new(), "the defaults pass");
}

#[test]
fn nan_is_refused_everywhere() {
    let nan = f64::NAN;
    let config = ActuatorConfig {
        max_steering_deg: nan,
        max_speed_m_s: nan,
        max_reverse_m_s: nan,
        steering_rate_rad_s: nan,
        acceleration_m_s2: nan,
        deceleration_m_s2: nan,
        timeout_ms: nan,
        recover_ms: nan,
        latch_stale: false,
    };
    assert_eq!(crate::testing::fields_found(&config).len(), 8, "every number");
}

#[derive(Clone, Debug)]
enum Event {
    Command(f32, f32),
    Silence,
    Say(Control),
}

fn any_event() -> impl Strategy<Value = Event> {
    prop_oneof![
        6 => (any::<f32>(), any::<f32>()).prop_map(|(steering, speed)| Event::Command(steering, speed)),
        6 => (-0.5..0.5_f32, -1.0..2.0_f32).prop_map(|(steering, speed)| Event::Command(steering, speed)),
        4 => Just(Event::Silence),
        1 => prop_oneof![
            Just(Control::Start), Just(Control::Stop), Just(Control::EStop), Just(Control::Reset)
        ].prop_map(Event::Say),
    ]
}

proptest! {
    #[test]
    fn always_finite_within_limits_and_slow_enough(events in proptest::collection::vec(any_event(), 1..300)) {
        let mut bench = Bench::new(ActuatorConfig::default());
        let (mut last, mut estop) = (Command::default(), false);
        for event in events {
            let command = match event {
                Event::Command(steering, speed) => bench.tick(Some((steering, speed))).0,
                Event::Silence => bench.tick(None).0,
                Event::Say(control) => {
                    bench.say(control);
                    estop = (estop || control == Control::EStop) && control != Control::Reset;
                    bench.tick(None).0
                }
            };
            prop_assert!(command.is_finite(), "{command:?}");
            prop_assert!(command.steering_rad.abs() <= 0.349_07, "{command:?}");
            prop_assert!((-0.5..=1.0).contains(&command.speed_m_s), "{command:?}");
            prop_assert!(!estop || command.speed_m_s == 0.0, "moves under e-stop: {command:?}");
            prop_assert!((command.steering_rad - last.steering_rad).abs() <= 0.16 + 1e-5, "{last:?} to {command:?}");
            prop_assert!(command.speed_m_s.abs() - last.speed_m_s.abs() <= 0.03 + 1e-5, "{last:?} to {command:?}");
            last = command;
        }
    }
}
