//! The decision node as a whole: every state, every transition, and what must hold whatever comes.

use carril_messages::{Centroid, Sector};
use carril_runtime::{AnyInput, InputPorts, Trigger};
use proptest::prelude::*;

use super::*;
use crate::testing::{at_ms, context, header};

/// A decision node with its ports and a time that goes on.
pub(super) struct Bench {
    pub(super) decision: Decision,
    pub(super) inputs: DecisionInputs,
    outputs: DecisionOutputs,
    pub(super) now_ms: i64,
}

pub(super) fn lane(angle_rad: f32, distance_px: f32) -> LaneEstimate {
    let centroid = Centroid { left_px: distance_px, ahead_px: 100.0, pixels: 20 };
    let lane = Lane { angle_rad, distance_px, distance_m: None, ground: None, far: centroid, near: centroid };
    LaneEstimate { lane: Some(lane), quality: 1.0, threshold: Some(190) }
}

fn no_lane() -> LaneEstimate {
    LaneEstimate { lane: None, quality: 0.0, threshold: Some(190) }
}

pub(super) fn front(nearest_m: f32) -> Sectors {
    let sector = Sector {
        name: "front".into(),
        from_rad: -0.5,
        to_rad: 0.5,
        nearest_m: Some(nearest_m),
        nearest_bearing_rad: Some(0.0),
        returns_within: 9,
        occupied: true,
        coverage: 1.0,
    };
    Sectors { sectors: vec![sector] }
}

impl Bench {
    pub(super) fn new(config: DecisionConfig) -> Self {
        let (inputs, outputs) = Default::default();
        Self { decision: Decision::from_config(config), inputs, outputs, now_ms: 0 }
    }

    /// A node that follows a straight lane.
    pub(super) fn driving(config: DecisionConfig) -> Self {
        let mut bench = Self::new(config);
        bench.say(Control::Start);
        for _ in 0..5 {
            bench.frame(Some(lane(0.0, 0.0)));
        }
        assert_eq!(bench.decision.state(), DriveState::LaneFollow, "it follows the lane");
        bench.outputs.state.sent();
        bench
    }

    pub(super) fn say(&mut self, control: Control) {
        self.decision.control(control, at_ms(self.now_ms));
    }

    fn step(&mut self, trigger: Trigger) -> (Command, Result<(), String>) {
        let now = at_ms(self.now_ms);
        self.inputs.each(&mut |_, input| input.begin(now, None));
        let result = self.decision.step(&mut self.inputs, &mut self.outputs, &context(now, trigger));
        let sent = self.outputs.command.sent();
        assert_eq!(sent.len(), 1, "one command per step");
        (*sent[0], result.map_err(|error| error.to_string()))
    }

    /// 33 ms later, with a new estimate; or 50 ms later, without one.
    pub(super) fn frame(&mut self, estimate: Option<LaneEstimate>) -> Command {
        self.now_ms += if estimate.is_some() { 33 } else { 50 };
        let trigger = if estimate.is_some() { Trigger::Input } else { Trigger::Period };
        if let Some(estimate) = estimate {
            self.inputs.lane.put(estimate, header::<LaneEstimate>(at_ms(self.now_ms - 5)));
        }
        self.step(trigger).0
    }

    fn frames(&mut self, count: usize, estimate: &LaneEstimate) -> Command {
        let mut last = Command::default();
        for _ in 0..count {
            last = self.frame(Some(estimate.clone()));
        }
        last
    }

    pub(super) fn scan(&mut self, sectors: Sectors) {
        self.inputs.sectors.put(sectors, header::<Sectors>(at_ms(self.now_ms)));
    }

    pub(super) fn reason(&self) -> &str {
        &self.decision.memory.reason
    }
}

#[test]
fn nothing_moves_before_start() {
    let mut bench = Bench::new(DecisionConfig::default());
    for _ in 0..50 {
        assert_eq!(bench.frame(Some(lane(0.3, 50.0))), Command::default(), "neither wheels nor motor");
    }
    bench.say(Control::Start);
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.5, "and then it drives");
    assert!(bench.reason().contains("lane seen in 51 frames"), "{}", bench.reason());
}

#[test]
fn auto_start_drives_as_soon_as_there_is_a_lane() {
    let mut bench = Bench::new(DecisionConfig { auto_start: true, ..DecisionConfig::default() });
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "one frame is not enough");
    assert_eq!(bench.decision.state(), DriveState::LaneLost, "waits for the lane");
    assert_eq!(bench.frames(2, &lane(0.0, 0.0)).speed_m_s, 0.5, "three are");
}

#[test]
fn steers_by_angle_and_distance_within_the_limit() {
    let mut bench = Bench::driving(DecisionConfig::default());
    let command = bench.frame(Some(lane(0.1, 10.0)));
    assert!((command.steering_rad - 0.14).abs() < 1e-6, "0.9 * 0.1 + 0.005 * 10: {command:?}");
    let command = bench.frame(Some(lane(-1.0, -400.0)));
    assert!((command.steering_rad + 0.349_066).abs() < 1e-5, "20 degrees to the right at most: {command:?}");
    let mut beside = Bench::driving(DecisionConfig { target_distance_px: 40.0, ..DecisionConfig::default() });
    assert_eq!(beside.frame(Some(lane(0.0, 40.0))).steering_rad, 0.0, "the line lies where it shall");
}

#[test]
fn holds_the_steering_for_a_frame_without_a_lane() {
    let mut bench = Bench::driving(DecisionConfig::default());
    let before = bench.frame(Some(lane(0.1, 0.0)));
    assert_eq!(bench.frame(Some(no_lane())), before, "one frame changes nothing");
    assert_eq!(bench.decision.state(), DriveState::LaneFollow, "still on the lane");
}

#[test]
fn coasts_then_stops_when_the_lane_is_lost_and_goes_on_when_it_is_back() {
    let mut bench = Bench::driving(DecisionConfig::default());
    let before = bench.frame(Some(lane(0.1, 0.0)));
    let coasting = bench.frames(2, &no_lane());
    assert_eq!(bench.decision.state(), DriveState::LaneLost, "two frames without a lane");
    assert!(bench.reason().contains("no lane for 2 frames"), "{}", bench.reason());
    assert_eq!(coasting, Command { speed_m_s: 0.25, ..before }, "slower, with the last steering");
    assert_eq!(bench.frames(15, &no_lane()).speed_m_s, 0.25, "for half a second");
    assert_eq!(bench.frames(2, &no_lane()), Command { speed_m_s: 0.0, ..before }, "then it stands, wheels held");
    assert_eq!(bench.frames(2, &lane(0.0, 0.0)).speed_m_s, 0.0, "two good frames are not enough");
    assert_eq!(bench.frames(1, &lane(0.0, 0.0)).speed_m_s, 0.5, "three are");
}

#[test]
fn silence_of_the_detector_is_a_lost_lane() {
    let mut bench = Bench::driving(DecisionConfig::default());
    assert_eq!(bench.frame(None).speed_m_s, 0.5, "50 ms are allowed");
    assert_eq!(bench.frame(None).speed_m_s, 0.5, "100 ms too");
    assert_eq!(bench.frame(None).speed_m_s, 0.25, "155 ms are not");
    assert!(bench.reason().contains("155 ms old, allowed are 150 ms"), "{}", bench.reason());
    for _ in 0..10 {
        bench.frame(None);
    }
    assert_eq!(bench.frame(None).speed_m_s, 0.0, "stands");
}

#[test]
fn an_old_exposure_is_no_lane_however_new_the_message() {
    let mut bench = Bench::driving(DecisionConfig::default());
    bench.now_ms += 400;
    bench.inputs.lane.put(lane(0.0, 0.0), header::<LaneEstimate>(at_ms(bench.now_ms - 200)));
    bench.step(Trigger::Input).1.expect("nothing was refused");
    assert_eq!(bench.decision.state(), DriveState::LaneLost, "200 ms since the exposure");
}

#[test]
fn untrusted_and_damaged_estimates_are_no_lane() {
    let config = DecisionConfig { lane_lost_frames: 1, ..DecisionConfig::default() };
    let poor = LaneEstimate { quality: 0.05, ..lane(0.0, 0.0) };
    for bad in
        [poor, lane(f32::NAN, 0.0), lane(0.0, f32::INFINITY), LaneEstimate { quality: f32::NAN, ..lane(0.0, 0.0) }]
    {
        let mut bench = Bench::driving(config.clone());
        assert!(bench.frame(Some(bad.clone())).is_finite(), "{bad:?}");
        assert_eq!(bench.decision.state(), DriveState::LaneLost, "{bad:?}");
    }
}

#[test]
fn stops_for_an_obstacle_and_goes_on_when_the_way_has_been_clear() {
    let mut bench = Bench::driving(DecisionConfig::default());
    bench.scan(front(0.6));
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.5, "0.6 m is far enough to drive on");
    bench.scan(front(0.45));
    let stopping = bench.frame(Some(lane(0.1, 0.0)));
    assert_eq!((stopping.speed_m_s, bench.decision.state()), (0.0, DriveState::ObstacleStop), "0.45 m is not");
    assert!((stopping.steering_rad - 0.09).abs() < 1e-6, "keeps to the lane while it brakes: {stopping:?}");
    assert!(bench.reason().contains("0.45 m (9 returns), stops at 0.50 m"), "{}", bench.reason());
    for _ in 0..100 {
        bench.scan(front(0.6));
        assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "0.6 m is not far enough to go on");
    }
    for _ in 0..31 {
        bench.scan(front(0.9));
        assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "clear, but not for a second yet");
    }
    bench.scan(front(0.9));
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.5, "clear for a second");
    assert!(bench.reason().contains("front clear for 1.0 s (nearest 0.90 m), lane seen"), "{}", bench.reason());
}

#[test]
fn an_obstacle_that_comes_back_begins_the_wait_anew() {
    let mut bench = Bench::driving(DecisionConfig::default());
    for distance in [0.4, 0.9, 0.4] {
        for _ in 0..20 {
            bench.scan(front(distance));
            bench.frame(Some(lane(0.0, 0.0)));
        }
    }
    for _ in 0..29 {
        bench.scan(front(0.9));
        assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "the 0.66 s before do not count");
    }
}

#[test]
fn without_a_lane_a_clear_way_is_not_enough() {
    let mut bench = Bench::driving(DecisionConfig::default());
    bench.scan(front(0.3));
    bench.frames(3, &no_lane());
    for _ in 0..40 {
        bench.scan(front(2.0));
        assert_eq!(bench.frame(Some(no_lane())).speed_m_s, 0.0, "neither coasts nor drives");
    }
    assert_eq!(bench.decision.state(), DriveState::LaneLost, "waits for the lane");
}

#[test]
fn a_lidar_that_falls_silent_stops_the_car() {
    let mut bench = Bench::driving(DecisionConfig::default());
    bench.scan(front(5.0));
    assert_eq!(bench.frames(15, &lane(0.0, 0.0)).speed_m_s, 0.5, "495 ms are allowed");
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "528 ms are not");
    assert!(bench.reason().contains("no scan for more than 500 ms"), "{}", bench.reason());
}

#[test]
fn a_blind_or_missing_front_sector_stops_the_car() {
    let mut blind = front(5.0);
    blind.sectors[0].coverage = 0.1;
    let mut other = front(5.0);
    other.sectors[0].name = "rear".into();
    for (sectors, reason) in [(blind, "only 10 % of its rays"), (other, "no sector `front`, only `rear`")] {
        let mut bench = Bench::driving(DecisionConfig::default());
        bench.scan(sectors);
        assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "{reason}");
        assert!(bench.reason().contains(reason), "{}", bench.reason());
    }
}

#[test]
fn a_required_lidar_must_have_been_heard() {
    let mut bench = Bench::new(DecisionConfig { require_sectors: true, ..DecisionConfig::default() });
    bench.say(Control::Start);
    assert_eq!(bench.frames(50, &lane(0.0, 0.0)).speed_m_s, 0.0, "no scan, no drive");
    assert!(bench.reason().contains("no scan has come yet"), "{}", bench.reason());
    for _ in 0..31 {
        bench.scan(front(5.0));
        bench.frame(Some(lane(0.0, 0.0)));
    }
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.5, "clear for a second");
}

#[test]
fn stop_is_idle_until_start() {
    let mut bench = Bench::driving(DecisionConfig { auto_start: true, ..DecisionConfig::default() });
    let before = bench.frame(Some(lane(0.1, 0.0)));
    bench.say(Control::Stop);
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))), Command { speed_m_s: 0.0, ..before }, "stops, wheels held");
    assert_eq!(bench.frames(50, &lane(0.0, 0.0)).speed_m_s, 0.0, "even with `auto_start`");
    bench.say(Control::Start);
    assert_eq!(bench.frames(1, &lane(0.0, 0.0)).speed_m_s, 0.5, "until `start`");
}

#[test]
fn the_estop_is_left_only_by_reset() {
    let mut bench = Bench::driving(DecisionConfig { auto_start: true, ..DecisionConfig::default() });
    bench.say(Control::EStop);
    assert_eq!(bench.step(Trigger::Control).0.speed_m_s, 0.0, "at once");
    for control in [Control::Start, Control::Stop, Control::Start] {
        bench.say(control);
        assert_eq!(bench.frames(5, &lane(0.0, 0.0)).speed_m_s, 0.0, "{control} does not help");
        assert_eq!(bench.decision.state(), DriveState::EStop, "{control} does not help");
    }
    bench.say(Control::Reset);
    assert_eq!(bench.frames(50, &lane(0.0, 0.0)).speed_m_s, 0.0, "`reset` does not move it");
    assert_eq!(bench.decision.state(), DriveState::Idle, "it waits");
    bench.say(Control::Start);
    assert_eq!(bench.frames(1, &lane(0.0, 0.0)).speed_m_s, 0.5, "`start` does");
}

#[test]
fn a_goal_sets_the_speed_within_the_maximum() {
    let mut bench = Bench::driving(DecisionConfig::default());
    let mut ask = |speed_m_s: f32| {
        bench.inputs.goal.put(Goal::Cruise { speed_m_s }, header::<Goal>(at_ms(bench.now_ms)));
        bench.now_ms += 33;
        bench.inputs.lane.put(lane(0.0, 0.0), header::<LaneEstimate>(at_ms(bench.now_ms)));
        bench.step(Trigger::Input)
    };
    assert_eq!(ask(0.3).0.speed_m_s, 0.3, "as asked");
    assert_eq!(ask(7.0).0.speed_m_s, 1.0, "at most `max_speed_m_s`");
    for bad in [0.0, -0.2, f32::NAN, f32::INFINITY] {
        let (command, result) = ask(bad);
        assert_eq!(command.speed_m_s, 1.0, "{bad} changes nothing");
        let reason = result.expect_err("it is refused");
        assert!(reason.contains("goal refused") && reason.contains("up to 1"), "{reason}");
    }
}

#[test]
fn says_what_it_does_on_each_transition_and_five_times_a_second() {
    let mut bench = Bench::driving(DecisionConfig::default());
    let mut states = Vec::new();
    for _ in 0..30 {
        bench.frame(Some(lane(0.0, 0.0)));
        states.extend(bench.outputs.state.sent());
    }
    assert!((4..=5).contains(&states.len()), "990 ms without a transition, got {}", states.len());
    bench.say(Control::EStop);
    bench.step(Trigger::Control).1.expect("nothing was refused");
    let states = bench.outputs.state.sent();
    assert_eq!(states.len(), 1, "at once on a transition");
    assert_eq!((states[0].state, states[0].target_speed_m_s), (DriveState::EStop, 0.0), "the new state");
    assert_eq!((states[0].since, states[0].transitions), (at_ms(bench.now_ms), 3), "since now, the third transition");
}

#[test]
fn commands_carry_the_age_of_the_lane_only_while_they_follow_it() {
    let mut bench = Bench::driving(DecisionConfig::default());
    let captured = at_ms(bench.now_ms - 5);
    bench.inputs.lane.take_used();
    bench.frame(None);
    assert_eq!(
        bench.inputs.lane.take_used().oldest(),
        Some(captured),
        "a command between frames is as old as the frame"
    );
    for _ in 0..4 {
        bench.frame(None);
    }
    assert_eq!(bench.decision.state(), DriveState::LaneLost, "it coasts");
    bench.inputs.lane.take_used();
    assert!(bench.frame(None).speed_m_s > 0.0, "still moving");
    assert_eq!(bench.inputs.lane.take_used().oldest(), Some(captured), "coasting follows the old lane");
    for _ in 0..15 {
        bench.frame(None);
    }
    bench.inputs.lane.take_used();
    assert_eq!(bench.frame(None).speed_m_s, 0.0, "stands");
    assert_eq!(
        bench.inputs.lane.take_used().oldest(),
        None,
        "standing follows nothing, so a budget lets the stop pass"
    );
}

#[test]
fn a_successor_goes_on_where_the_predecessor_stopped() {
    let mut old = Bench::driving(DecisionConfig::default());
    old.frame(Some(lane(0.1, 0.0)));
    let mut new = Bench::new(DecisionConfig { cruise_speed_m_s: 0.7, ..DecisionConfig::default() });
    new.now_ms = old.now_ms;
    new.decision.restore(old.decision.snapshot()).expect("a valid state");
    let command = new.frame(Some(lane(0.1, 0.0)));
    assert_eq!(new.decision.state(), DriveState::LaneFollow, "it drives on");
    assert_eq!(command.speed_m_s, 0.7, "by its own configuration");
    let broken = DecisionMemory { steering_rad: f32::NAN, ..old.decision.snapshot() };
    assert!(new.decision.restore(broken).is_err(), "a state that is no number is refused");
}

impl Bench {
    /// The driver's command, given `age_ms` ago, and the step that it triggers.
    fn hand(&mut self, steering_rad: f32, speed_m_s: f32, age_ms: i64) -> Command {
        self.now_ms += 20;
        let given = header::<Command>(at_ms(self.now_ms - age_ms));
        self.inputs.manual.put(Command { steering_rad, speed_m_s }, given);
        self.step(Trigger::Input).0
    }

    /// A step of its own accord, so much later.
    fn later(&mut self, ms: i64) -> Command {
        self.now_ms += ms;
        self.step(Trigger::Period).0
    }
}

#[test]
fn a_person_drives_by_hand_within_the_limits_and_without_start() {
    let mut bench = Bench::new(DecisionConfig::default());
    assert_eq!(bench.hand(0.2, 0.3, 5), Command { steering_rad: 0.2, speed_m_s: 0.3 }, "as they say");
    assert_eq!(bench.decision.state(), DriveState::Manual, "the state says so");
    let fast = bench.hand(2.0, 9.0, 5);
    assert_eq!(fast.speed_m_s, 0.45, "`manual_max_speed_m_s`");
    assert!((fast.steering_rad - 0.349_066).abs() < 1e-5, "`max_steering_deg`: {fast:?}");
    assert_eq!(bench.hand(0.0, -9.0, 5).speed_m_s, -0.45, "backwards, too");
    let mut driving = Bench::driving(DecisionConfig::default());
    assert_eq!(
        driving.hand(-0.1, 0.1, 5),
        Command { steering_rad: -0.1, speed_m_s: 0.1 },
        "they take over from the lane"
    );
}

#[test]
fn without_the_next_command_the_car_stops_and_stays() {
    let mut bench = Bench::driving(DecisionConfig { auto_start: true, ..DecisionConfig::default() });
    bench.hand(0.1, 0.3, 0);
    assert_eq!(bench.later(150).speed_m_s, 0.3, "150 ms old: it counts");
    assert_eq!(bench.later(1).speed_m_s, 0.0, "151 ms: the dead man's switch");
    assert_eq!(bench.decision.state(), DriveState::Idle, "it stands");
    assert!(bench.reason().contains("151 ms old, allowed are 150 ms"), "{}", bench.reason());
    for _ in 0..10 {
        assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "and does not drive off by itself");
    }
    bench.say(Control::Start);
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.5, "until somebody says so");
}

#[test]
fn late_or_senseless_commands_of_a_driver_do_not_count() {
    let mut bench = Bench::new(DecisionConfig::default());
    assert_eq!(bench.hand(0.1, 0.3, 200).speed_m_s, 0.0, "it was given 200 ms ago");
    assert_eq!(bench.decision.state(), DriveState::Idle, "as if it had not come");
    bench.now_ms += 20;
    let given = header::<Command>(at_ms(bench.now_ms));
    bench.inputs.manual.put(Command { steering_rad: f32::NAN, speed_m_s: 0.3 }, given);
    let (command, refused) = bench.step(Trigger::Input);
    assert!(command.speed_m_s == 0.0 && refused.is_err_and(|error| error.contains("finite")), "no number");
    // From the future: it counts from now on, not for longer.
    bench.hand(0.0, 0.3, -5000);
    assert_eq!(bench.later(151).speed_m_s, 0.0, "no longer than any other");
}

#[test]
fn words_are_above_the_driver() {
    let mut bench = Bench::new(DecisionConfig::default());
    bench.hand(0.0, 0.3, 0);
    bench.say(Control::EStop);
    assert_eq!(bench.later(1).speed_m_s, 0.0, "e-stop");
    assert_eq!(bench.hand(0.0, 0.3, 0).speed_m_s, 0.0, "no driving out of it");
    bench.say(Control::Reset);
    assert_eq!(bench.later(1).speed_m_s, 0.0, "what was given before the word counts no more");
    bench.later(1);
    assert_eq!(bench.hand(0.0, 0.3, 0).speed_m_s, 0.3, "what comes after it does");
    bench.say(Control::Stop);
    assert_eq!(bench.later(1).speed_m_s, 0.0, "`stop` ends it");
}

#[derive(Clone, Debug)]
enum Event {
    Frame(LaneEstimate),
    Silence,
    Scan(Sectors),
    Ask(f32),
    Say(Control),
    Hand(f32, f32, i64),
}

fn any_event() -> impl Strategy<Value = Event> {
    let control = prop_oneof![3 => Just(Control::Start), 1 => Just(Control::Stop), 1 => Just(Control::EStop), 2 => Just(Control::Reset)];
    prop_oneof![
        12 => (-1.0..1.0_f32, -300.0..300.0_f32).prop_map(|(angle, distance)| Event::Frame(lane(angle, distance))),
        2 => (any::<f32>(), any::<f32>(), any::<f32>())
            .prop_map(|(angle, distance, quality)| Event::Frame(LaneEstimate { quality, ..lane(angle, distance) })),
        3 => Just(Event::Frame(no_lane())),
        2 => Just(Event::Silence),
        2 => prop_oneof![0.0..3.0_f32, any::<f32>()].prop_map(|nearest| Event::Scan(front(nearest))),
        1 => any::<f32>().prop_map(Event::Ask),
        1 => control.prop_map(Event::Say),
        2 => (any::<f32>(), -2.0..2.0_f32, -10..300_i64).prop_map(|(steering, speed, age)| Event::Hand(steering, speed, age)),
    ]
}

proptest! {
    #[test]
    fn whatever_comes_it_stays_within_its_limits_and_its_words(
        events in proptest::collection::vec(any_event(), 1..400),
        require_sectors: bool,
    ) {
        let mut bench = Bench::new(DecisionConfig { require_sectors, ..DecisionConfig::default() });
        let (mut started, mut estop, mut held_ms) = (false, false, i64::MIN);
        for event in events {
            let mut frame = None;
            match event {
                Event::Frame(estimate) => frame = Some(estimate),
                Event::Silence => {}
                Event::Scan(sectors) => bench.scan(sectors),
                Event::Ask(speed_m_s) => {
                    let header = header::<Goal>(at_ms(bench.now_ms));
                    bench.inputs.goal.put(Goal::Cruise { speed_m_s }, header);
                }
                Event::Say(control) => {
                    bench.say(control);
                    estop = (estop || control == Control::EStop) && control != Control::Reset;
                    started = control == Control::Start && !estop;
                    held_ms = i64::MIN;
                }
                Event::Hand(steering_rad, speed_m_s, age_ms) => {
                    let header = header::<Command>(at_ms(bench.now_ms - age_ms));
                    bench.inputs.manual.put(Command { steering_rad, speed_m_s }, header);
                    held_ms = held_ms.max(bench.now_ms);
                }
            }
            let command = bench.frame(frame);
            prop_assert!(command.is_finite(), "{command:?}");
            prop_assert!(command.steering_rad.abs() <= 0.349_07, "{command:?}");
            let by_hand = bench.decision.state() == DriveState::Manual;
            let allowed = if by_hand { -0.451..=0.451 } else { 0.0..=1.0 };
            prop_assert!(allowed.contains(&command.speed_m_s), "{command:?}");
            prop_assert!(!by_hand || bench.now_ms - held_ms <= 160, "driven by a hand that is gone");
            prop_assert!(started || by_hand || command.speed_m_s == 0.0, "moves without `start`: {command:?}");
            prop_assert!(!estop || bench.decision.state() == DriveState::EStop, "left the e-stop without `reset`");
            let state = bench.decision.state();
            let may_move = matches!(state, DriveState::LaneFollow | DriveState::LaneLost | DriveState::Manual);
            prop_assert!(may_move || command.speed_m_s == 0.0, "moves in {}: {command:?}", state.name());
        }
    }
}
