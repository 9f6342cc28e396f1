//! The decision node at a traffic light.

use carril_messages::{Control, DriveState, LightColour, TrafficLight};

use super::tests::{Bench, front, lane};
use super::{DecisionConfig, LightConfig};
use crate::testing::{at_ms, header};

const RED: Option<LightColour> = Some(LightColour::Red);
const GREEN: Option<LightColour> = Some(LightColour::Green);

impl Bench {
    /// A word about the light, of an image of now; the line ahead of the rear axle, m.
    fn light(&mut self, colour: Option<LightColour>, stop_line_m: Option<f32>) {
        let header = header::<TrafficLight>(at_ms(self.now_ms));
        self.inputs.light.put(TrafficLight { colour, lamp: None, stop_line_m }, header);
    }

    /// A frame on a straight lane, and the speed that follows.
    fn speed(&mut self, colour: Option<LightColour>, stop_line_m: Option<f32>) -> f32 {
        self.light(colour, stop_line_m);
        self.frame(Some(lane(0.0, 0.0))).speed_m_s
    }

    /// Drives towards a red light whose line lies so far before the front; where it stands then, and the highest speed on the way.
    fn approach(&mut self, mut to_line_m: f32, colour: Option<LightColour>) -> f32 {
        for _ in 0..600 {
            // The camera sees the line up to 1 m before the front, and down to the bumper.
            let seen = (0.0..1.0).contains(&to_line_m).then_some(to_line_m + 0.30);
            let speed = self.speed(colour, seen);
            to_line_m -= speed * 0.033;
        }
        to_line_m
    }
}

#[test]
fn stops_before_the_line_at_red_and_goes_on_at_green() {
    let light = LightConfig { approach_speed_m_s: 0.25, ..LightConfig::default() };
    let mut bench = Bench::driving(DecisionConfig { light, ..DecisionConfig::default() });
    let stands_m = bench.approach(2.0, RED);
    assert!((0.10..=0.17).contains(&stands_m), "it stands {stands_m} m before the line");
    assert_eq!(bench.decision.state(), DriveState::LightStop, "and says why");
    assert!(bench.reason().contains("red"), "{}", bench.reason());
    assert_eq!(bench.speed(GREEN, Some(0.45)), 0.5, "green");
    assert!(bench.reason().contains("green"), "{}", bench.reason());
}

#[test]
fn without_a_line_it_stops_where_it_sees_the_red_light() {
    let mut bench = Bench::driving(DecisionConfig::default());
    assert_eq!(bench.speed(None, None), 0.5, "no light");
    assert_eq!(bench.speed(GREEN, None), 0.5, "green");
    assert_eq!(bench.speed(RED, None), 0.0, "red");
}

#[test]
fn a_light_that_turns_red_behind_the_front_is_passed() {
    let mut bench = Bench::driving(DecisionConfig::default());
    bench.speed(GREEN, Some(0.31));
    for _ in 0..20 {
        assert_eq!(bench.speed(RED, None), 0.5, "its front has crossed the line");
    }
    for _ in 0..60 {
        bench.speed(None, None);
    }
    assert_eq!(bench.speed(RED, None), 0.0, "the next light, a metre on");
}

#[test]
fn a_light_that_is_gone_lets_go_only_after_a_while() {
    let mut bench = Bench::driving(DecisionConfig::default());
    bench.speed(RED, None);
    let frames = 10_000 / 33;
    for frame in 0..frames {
        assert_eq!(bench.speed(None, None), 0.0, "frame {frame}: it may be hidden");
    }
    bench.speed(None, None);
    assert_eq!(bench.speed(None, None), 0.5, "`gone_s`");
    assert!(bench.reason().contains("no light in view for 10"), "{}", bench.reason());
}

#[test]
fn silence_of_the_node_stops_the_car_once_it_was_heard() {
    let mut bench = Bench::driving(DecisionConfig::default());
    for _ in 0..30 {
        assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.5, "there may be no such node");
    }
    bench.speed(None, None);
    for _ in 0..20 {
        bench.frame(Some(lane(0.0, 0.0)));
    }
    assert_eq!(bench.decision.state(), DriveState::LightStop, "660 ms of silence");
    assert!(bench.reason().contains("no word of it for more than 500 ms"), "{}", bench.reason());
    assert_eq!(bench.frame(Some(lane(0.0, 0.0))).speed_m_s, 0.0, "it stands");
    assert_eq!(bench.speed(None, None), 0.5, "heard again, and no light is in view");
}

#[test]
fn obstacles_and_words_are_above_the_light() {
    let mut bench = Bench::driving(DecisionConfig::default());
    bench.speed(RED, None);
    bench.scan(front(0.3));
    bench.speed(RED, None);
    assert_eq!(bench.decision.state(), DriveState::ObstacleStop, "collision before light");
    bench.say(Control::EStop);
    bench.speed(GREEN, None);
    assert_eq!(bench.decision.state(), DriveState::EStop, "the e-stop before all");
}

#[test]
fn a_successor_knows_the_way_to_the_line() {
    use carril_runtime::Operator as _;
    let mut old = Bench::driving(DecisionConfig::default());
    old.speed(RED, Some(0.60));
    let mut new = Bench::new(DecisionConfig::default());
    new.now_ms = old.now_ms;
    new.decision.restore(old.decision.snapshot()).expect("a valid state");
    assert_eq!(new.decision.snapshot().light, old.decision.snapshot().light, "handed over");
    assert_eq!(new.decision.state(), DriveState::LightStop, "it goes on braking");
}
