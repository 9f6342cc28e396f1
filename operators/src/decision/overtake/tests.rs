//! The decision node on a straight road with two lanes, step by step: a small world of its own, with boxes that the lidar sees.

use carril_messages::{Command, Control, DriveState, LaneEstimate, LaserScan, WheelTelemetry};
use nalgebra::{Rotation2, Vector2};

use super::OvertakeConfig;
use crate::decision::DecisionConfig;
use crate::decision::tests::{Bench, lane};
use crate::lane_curve::{State, published};
use crate::testing::{at_ms, header};

/// A box: its middle along and to the left of the right lane's middle, its speed.
#[derive(Clone, Copy)]
struct Thing {
    along_m: f64,
    left_m: f64,
    speed_m_s: f64,
}

const BOX: Thing = Thing { along_m: 3.0, left_m: 0.0, speed_m_s: 0.0 };
const LENGTH_M: f64 = 0.35;
const WIDTH_M: f64 = 0.18;

/// The car on its road: x along the right lane's middle, y to its left.
struct Road {
    bench: Bench,
    at: Vector2<f64>,
    yaw_rad: f64,
    command: Command,
    things: Vec<Thing>,
    lidar: bool,
    encoder: bool,
    camera: bool,
    states: Vec<DriveState>,
}

impl Road {
    fn new(things: &[Thing]) -> Self {
        let overtake = OvertakeConfig { enabled: true, ..OvertakeConfig::default() };
        let config = DecisionConfig { overtake, auto_start: true, ..DecisionConfig::default() };
        Self {
            bench: Bench::new(config),
            at: Vector2::zeros(),
            yaw_rad: 0.0,
            command: Command::default(),
            things: things.to_vec(),
            lidar: true,
            encoder: true,
            camera: true,
            states: Vec::new(),
        }
    }

    /// Drives until the condition holds; `false` after `seconds`.
    fn until(&mut self, seconds: f64, holds: impl Fn(&Self) -> bool) -> bool {
        for step in 0..(seconds / 0.033) as u32 {
            self.step(step.is_multiple_of(3));
            if holds(self) {
                return true;
            }
        }
        false
    }

    fn state(&self) -> DriveState {
        self.bench.decision.state()
    }

    fn step(&mut self, scans: bool) {
        let now = at_ms(self.bench.now_ms);
        if self.encoder {
            let telemetry = WheelTelemetry {
                ticks: 0,
                tick_period_us: None,
                speed_m_s: self.command.speed_m_s,
                steering_rad: self.command.steering_rad,
                battery_v: None,
                faults: carril_messages::FaultSet::NONE,
                driving: true,
                last_command_seq: None,
                round_trip_us: None,
                frames_lost: 0,
                frames_damaged: 0,
            };
            self.bench.inputs.wheels.put(telemetry, header::<WheelTelemetry>(now));
        }
        if self.lidar && scans {
            let scan = self.scan();
            self.bench.inputs.scan.put(scan, header::<LaserScan>(now));
        }
        let estimate = self.camera.then(|| self.estimate());
        let blind_ms = if estimate.is_some() { 33.0 } else { 50.0 };
        self.command = self.bench.frame(estimate);
        let (speed, steering) = (f64::from(self.command.speed_m_s), f64::from(self.command.steering_rad));
        let way_m = speed * blind_ms * 1e-3;
        let turn_rad = way_m * steering.tan() / 0.26;
        self.at += Rotation2::new(self.yaw_rad + turn_rad / 2.0) * Vector2::new(way_m, 0.0);
        self.yaw_rad += turn_rad;
        self.things.iter_mut().for_each(|thing| thing.along_m += thing.speed_m_s * blind_ms * 1e-3);
        assert!(!self.touches(), "it touches something at {:?}, {:?}: {}", self.at, self.state(), self.bench.reason());
        if self.states.last() != Some(&self.state()) {
            self.states.push(self.state());
        }
    }

    fn estimate(&self) -> LaneEstimate {
        assert!(self.yaw_rad.abs() < 1.0, "it turns round");
        let mut estimate = lane(0.0, 0.0);
        let ground = published(&State::from([-self.at.y, -self.yaw_rad, 0.0, 0.0, 0.4]));
        let lane = estimate.lane.as_mut().expect("a lane");
        lane.ground = Some(carril_messages::GroundLane { seen_m: 1.2, left_seen: true, right_seen: true, ..ground });
        estimate
    }

    /// Points all along the edges of the boxes.
    fn edges(&self) -> impl Iterator<Item = Vector2<f64>> {
        self.things.iter().flat_map(|thing| {
            let middle = Vector2::new(thing.along_m, thing.left_m);
            (0..=20).flat_map(move |k| {
                let share = f64::from(k) / 20.0 - 0.5;
                [(share, 0.5), (share, -0.5), (0.5, share), (-0.5, share)]
                    .map(|(x, y)| middle + Vector2::new(x * LENGTH_M, y * WIDTH_M))
            })
        })
    }

    fn scan(&self) -> LaserScan {
        let mut ranges_m = vec![f32::INFINITY; 360];
        let into_body = Rotation2::new(-self.yaw_rad);
        for point in self.edges() {
            let seen = into_body * (point - self.at) - Vector2::new(0.18, 0.0);
            let ray = (seen.y.atan2(seen.x).to_degrees() + 180.0).round() as usize % 360;
            ranges_m[ray] = ranges_m[ray].min(seen.norm() as f32);
        }
        LaserScan {
            angle_min_rad: -std::f32::consts::PI,
            angle_increment_rad: std::f32::consts::TAU / 360.0,
            scan_time_s: 0.1,
            range_min_m: 0.05,
            range_max_m: 16.0,
            ranges_m,
        }
    }

    fn touches(&self) -> bool {
        let into_body = Rotation2::new(-self.yaw_rad);
        self.edges().any(|point| {
            let seen = into_body * (point - self.at);
            (-0.05..=0.30).contains(&seen.x) && seen.y.abs() <= 0.095
        })
    }
}

#[test]
fn overtakes_what_stands_and_what_crawls() {
    for speed_m_s in [0.0, 0.15] {
        let mut road = Road::new(&[Thing { speed_m_s, ..BOX }]);
        assert!(road.until(5.0, |road| road.state() == DriveState::OvertakeOut), "{:?}", road.bench.reason());
        let said = if speed_m_s == 0.0 { "it stands" } else { "it goes at 0.1" };
        assert!(road.bench.reason().contains(said), "the reason has its speed: {}", road.bench.reason());
        assert!(road.until(8.0, |road| road.at.y > 0.36), "in the left lane, at {:?}", road.at);
        let past = |road: &Road| road.state() == DriveState::LaneFollow && road.at.x > road.things[0].along_m + 0.5;
        assert!(road.until(20.0, past), "{:?}: {}", road.state(), road.bench.reason());
        assert!(road.at.y.abs() < 0.1, "back in its lane, at {:?}", road.at);
        let expected =
            [DriveState::OvertakeOut, DriveState::OvertakePass, DriveState::OvertakeIn, DriveState::LaneFollow];
        assert!(road.states.ends_with(&expected), "{:?}", road.states);
    }
}

#[test]
fn passes_a_row_of_them_before_it_goes_in() {
    let mut road = Road::new(&[BOX, Thing { along_m: 3.8, ..BOX }, Thing { along_m: 4.9, ..BOX }]);
    assert!(road.until(30.0, |road| road.at.x > 5.6 && road.state() == DriveState::LaneFollow), "{:?}", road.states);
    let outs = road.states.iter().filter(|state| **state == DriveState::OvertakeOut).count();
    assert_eq!(outs, 1, "in one go: {:?}", road.states);
}

#[test]
fn waits_behind_it_while_the_left_lane_is_occupied() {
    let beside = Thing { along_m: 3.2, left_m: 0.4, speed_m_s: 0.0 };
    let mut road = Road::new(&[BOX, beside]);
    assert!(!road.until(20.0, |road| road.at.y.abs() > 0.05), "it stays in its lane");
    assert_eq!(road.state(), DriveState::OvertakeWait, "{}", road.bench.reason());
    assert!(road.bench.reason().contains("the left lane is occupied"), "{}", road.bench.reason());
    let gap_m = BOX.along_m - LENGTH_M / 2.0 - 0.30 - road.at.x;
    assert!((0.6..1.0).contains(&gap_m), "it stands {gap_m} m behind it");
    road.things[1].along_m = 40.0;
    assert!(road.until(20.0, |road| road.at.x > 3.6 && road.state() == DriveState::LaneFollow), "{:?}", road.states);
}

#[test]
fn follows_what_is_nearly_as_fast() {
    let mut road = Road::new(&[Thing { along_m: 1.8, speed_m_s: 0.42, ..BOX }]);
    assert!(!road.until(20.0, |road| road.at.y.abs() > 0.05), "it stays behind: {:?}", road.states);
    let gap_m = road.things[0].along_m - LENGTH_M / 2.0 - 0.30 - road.at.x;
    assert!((0.4..1.5).contains(&gap_m), "{gap_m} m behind it");
}

#[test]
fn backs_up_from_what_stands_too_near() {
    let mut road = Road::new(&[Thing { along_m: 0.30 + 0.45 + LENGTH_M / 2.0, ..BOX }]);
    assert!(road.until(20.0, |road| road.command.speed_m_s < 0.0), "{:?}", road.bench.reason());
    assert!(road.until(30.0, |road| road.at.x > 1.5 && road.state() == DriveState::LaneFollow), "{:?}", road.states);
    // With something behind it, it stays.
    let mut road =
        Road::new(&[Thing { along_m: 0.30 + 0.45 + LENGTH_M / 2.0, ..BOX }, Thing { along_m: -0.45, ..BOX }]);
    assert!(!road.until(20.0, |road| road.command.speed_m_s < 0.0), "it does not back up");
    assert_eq!(road.state(), DriveState::OvertakeWait, "{}", road.bench.reason());
}

/// Stands beside its lane for that reason, and goes on when it is over.
#[track_caller]
fn assert_stands(mut road: Road, word: &str, mend: impl Fn(&mut Road)) {
    assert!(road.until(5.0, |road| road.state() == DriveState::OvertakeStop), "{word}: {:?}", road.states);
    assert!(road.bench.reason().contains(word), "`{word}` in: {}", road.bench.reason());
    let at = road.at;
    road.until(2.0, |_| false);
    assert!((road.at - at).norm() < 0.01 && road.command.speed_m_s == 0.0, "{word}: it stands");
    mend(&mut road);
    let done = road.until(30.0, |road| road.state() == DriveState::LaneFollow && road.at.x > 3.4);
    assert!(done, "{word}: it goes on: {:?}, {}", road.states, road.bench.reason());
}

fn passing() -> Road {
    let mut road = Road::new(&[BOX]);
    assert!(road.until(8.0, |road| road.at.y > 0.25), "on its way out: {:?}", road.states);
    road
}

#[test]
fn a_lidar_that_falls_silent_stops_the_manoeuvre() {
    let mut road = passing();
    road.lidar = false;
    assert_stands(road, "no scan for more than 500 ms", |road| road.lidar = true);
}

#[test]
fn wheels_that_fall_silent_stop_the_manoeuvre() {
    let mut road = passing();
    road.encoder = false;
    assert_stands(road, "no odometry for more than 300 ms", |road| road.encoder = true);
}

#[test]
fn a_lane_that_is_gone_stops_the_manoeuvre() {
    let mut road = passing();
    road.camera = false;
    assert_stands(road, "the lane has not been seen for", |road| road.camera = true);
}

#[test]
fn what_comes_in_its_way_stops_the_manoeuvre() {
    let mut road = passing();
    let ahead = Thing { along_m: road.at.x + 0.30 + LENGTH_M / 2.0 + 0.25, left_m: 0.4, speed_m_s: 0.0 };
    road.things.push(ahead);
    assert_stands(road, "something is in the way", |road| {
        road.things.pop();
    });
}

#[test]
fn stop_and_start_go_on_with_the_manoeuvre() {
    let mut road = passing();
    road.bench.say(Control::Stop);
    road.until(1.0, |_| false);
    assert_eq!((road.state(), road.command.speed_m_s), (DriveState::Idle, 0.0), "it stands");
    road.bench.say(Control::Start);
    assert!(road.until(30.0, |road| road.state() == DriveState::LaneFollow && road.at.x > 3.4), "{:?}", road.states);
    assert!(road.states.contains(&DriveState::OvertakeStop), "it looks first: {:?}", road.states);
}

#[test]
fn a_successor_goes_on_with_the_manoeuvre() {
    let mut road = passing();
    let state = road.bench.decision.memory.clone();
    let config = road.bench.decision.config.clone();
    road.bench.decision = crate::decision::Decision::from_config(config);
    carril_runtime::Operator::restore(&mut road.bench.decision, state.clone()).expect("a valid state");
    assert!(road.until(30.0, |road| road.state() == DriveState::LaneFollow && road.at.x > 3.4), "{:?}", road.states);
    let mut broken = state;
    broken.overtake.way_m = f64::NAN;
    assert!(carril_runtime::Operator::restore(&mut road.bench.decision, broken).is_err(), "no number");
}

#[test]
fn without_its_inputs_it_stops_as_before() {
    let mut road = Road::new(&[BOX]);
    road.encoder = false;
    for _ in 0..400 {
        let gap_m = BOX.along_m - LENGTH_M / 2.0 - 0.18 - road.at.x;
        road.bench.scan(crate::decision::tests::front(gap_m as f32));
        road.step(true);
    }
    assert_eq!(road.state(), DriveState::ObstacleStop, "the front sector is enough for that");
}
