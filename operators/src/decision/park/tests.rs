//! Parking as a whole, in a small world: a car with lags, slipping wheels and a crooked servo beside boxes, by what it measures.

use carril_messages::{DriveState, Parking, Stamp};
use nalgebra::Vector2;

use super::geometry::{Gap, Place, tests::car};
use super::plan::{self, Kind};
use super::world::{Noise, World};
use super::*;

/// A car in its world, and its decision.
#[allow(clippy::struct_excessive_bools)]
struct Drive {
    pub memory: ParkMemory,
    pub config: DecisionConfig,
    pub world: World,
    pub at: Place,
    pub state: DriveState,
    pub said: Vec<String>,
    pub now_ms: i64,
    pub scans: bool,
    pub wheels: bool,
    pub touched: bool,
    pub slip: f64,
    pub crooked_rad: f64,
    pub mirrored: bool,
    noise: Noise,
    speed_m_s: f64,
    steering_rad: f64,
    told: (f64, f64),
}

impl Drive {
    /// 25 cm beside the row's flank.
    pub fn new(world: World, parking: Parking, config: DecisionConfig, seed: u64) -> Self {
        let mut memory = ParkMemory::new(&config.park);
        memory.ask(parking).expect("nothing is in the way of it");
        Self {
            memory,
            config,
            world,
            at: Place::new(-1.5, 0.25, 0.0),
            state: DriveState::ParkSearch,
            said: Vec::new(),
            now_ms: 0,
            scans: true,
            wheels: true,
            touched: false,
            slip: 0.0,
            crooked_rad: 0.0,
            mirrored: false,
            noise: Noise::new(seed),
            speed_m_s: 0.0,
            steering_rad: 0.0,
            told: (0.0, 0.0),
        }
    }

    fn now(&self) -> Stamp {
        Stamp::from_nanos(self.now_ms * 1_000_000)
    }

    /// Goes on until it is in one of the last states, or for so many seconds.
    pub fn run(&mut self, seconds: f64) {
        let end_ms = self.now_ms + (seconds * 1e3) as i64;
        while self.now_ms < end_ms && !matches!(self.state, DriveState::Parked | DriveState::ParkStop) {
            self.step();
        }
    }

    /// A millisecond; scans come 10 times a second, decisions 30 times.
    fn step(&mut self) {
        self.now_ms += 1;
        self.roll(1e-3);
        if self.now_ms % 33 != 0 {
            return;
        }
        let mirror = if self.mirrored { -1.0 } else { 1.0 };
        let wheels = Wheels { speed_m_s: self.speed_m_s, steering_rad: mirror * self.told.1 };
        self.memory.drive_on(self.wheels.then_some(wheels), self.now(), &self.config);
        if self.scans && self.now_ms % 99 == 0 {
            let points: Vec<_> = self
                .world
                .scan(self.at, &mut self.noise)
                .into_iter()
                .filter(|point| !car().covers(*point, 0.0))
                .collect();
            let points: Vec<_> = points.into_iter().map(|[x, y]| Vector2::new(x, mirror * y)).collect();
            self.memory.observe(&points, self.now(), &self.config);
        }
        let steers = self.memory.go_on(self.state, self.now(), &self.config);
        let steers = steers.map(|(speed_m_s, steering_rad)| (speed_m_s, mirror * steering_rad));
        // Along the lane it keeps its heading and its side.
        let lane = (self.config.park.search_speed_m_s, 2.0 * (0.25 - self.at.y_m) - 1.5 * self.at.yaw_rad);
        self.told = steers.unwrap_or(if self.state == DriveState::ParkSearch { lane } else { (0.0, 0.0) });
        self.said.extend(self.memory.news());
        let next = match self.state {
            DriveState::ParkSearch => self.memory.found().map(|words| (DriveState::ParkDrive, words)),
            _ => self.memory.parked().map(|words| (DriveState::Parked, words)),
        };
        let next = next.or_else(|| Some((DriveState::ParkStop, self.memory.failed()?)));
        if let Some((state, words)) = next {
            self.state = state;
            self.said.push(words);
        }
    }

    fn roll(&mut self, dt_s: f64) {
        let limit = 20_f64.to_radians();
        let target = (self.told.1 + self.crooked_rad).clamp(-limit, limit);
        self.steering_rad += (target - self.steering_rad) * (1.0 - (-dt_s / 0.04_f64).exp());
        let lag_s = if self.told.0.abs() < self.speed_m_s.abs() { 0.06 } else { 0.2 };
        self.speed_m_s += (self.told.0 - self.speed_m_s) * (1.0 - (-dt_s / lag_s).exp());
        if self.told.0 == 0.0 && self.speed_m_s.abs() < 0.003 {
            self.speed_m_s = 0.0;
        }
        let way_m = self.speed_m_s * dt_s * (1.0 - self.slip);
        self.at = self.at.after(way_m, self.steering_rad.tan() / 0.26);
        self.touched |= self.world.touches(&car(), self.at);
    }

    pub fn last(&self) -> &str {
        self.said.last().map_or("", String::as_str)
    }
}

/// A row with one gap, its cars a bit uneven; where the car shall stand in it.
fn row(kind: Parking, length_m: f64, draw: &mut Noise) -> (World, Place) {
    let (long, wide) = if kind == Parking::Parallel { (0.35, 0.19) } else { (0.19, 0.35) };
    let uneven = [draw.between(-0.01, 0.01), draw.between(-0.01, 0.01)];
    let mut world = World::default();
    for (index, rear_m) in [-2.0 * long - 0.1, -long, length_m, length_m + long + 0.1].into_iter().enumerate() {
        world.add_box([rear_m + long / 2.0, uneven[index / 2] - wide / 2.0], [long, wide]);
    }
    let gap = Gap { from_m: 0.0, to_m: length_m, rear_flank_m: uneven[0], front_flank_m: uneven[1] };
    (world, plan::place_in(&gap, &car(), Kind::from(kind)))
}

/// Parks in so many random gaps and gives how many were refused.
fn park_in_many(kind: Parking, runs: u64, lengths_m: (f64, f64), seed: u64) -> u64 {
    let (mut draw, mut refused) = (Noise::new(seed), 0);
    for run in 0..runs {
        let length_m = draw.between(lengths_m.0, lengths_m.1);
        let (world, place) = row(kind, length_m, &mut draw);
        let mut drive = Drive::new(world, kind, DecisionConfig::default(), seed.wrapping_add(run));
        drive.slip = draw.between(0.0, 0.06);
        drive.crooked_rad = draw.between(-1.0, 1.0_f64).to_radians();
        drive.at.y_m += draw.between(-0.03, 0.03);
        drive.run(200.0);
        let text = format!("{length_m:.3} m, seed {seed}, run {run}: {:?}", drive.said);
        assert!(!drive.touched, "it touched something: {text}");
        if !drive.said.iter().any(|words| words.contains("a way in")) {
            assert!(drive.said.iter().any(|words| words.contains("needed are")), "it says why not: {text}");
            refused += 1;
            continue;
        }
        let off = place.place_seen(drive.at);
        assert_eq!(drive.state, DriveState::Parked, "{text}");
        assert!(off.x_m.abs() <= 0.03 && off.y_m.abs() <= 0.03, "{off:?}: {text}");
        assert!(off.yaw_rad.to_degrees().abs() <= 3.0, "{off:?}: {text}");
    }
    refused
}

#[test]
fn parks_in_gaps_along_the_lane() {
    let (runs, long_m) = (30, car().front_m + car().rear_m);
    let refused = park_in_many(Parking::Parallel, runs, (1.3 * long_m, 2.0 * long_m), 77);
    assert!(refused <= 3, "{refused} of {runs} were refused");
}

#[test]
fn parks_in_bays_across_the_lane() {
    let refused = park_in_many(Parking::Perpendicular, 20, (0.30, 0.45), 78);
    assert!(refused <= 2, "{refused} of 20 were refused");
}

#[test]
fn parks_on_the_left_as_in_a_mirror() {
    let (world, place) = row(Parking::Parallel, 0.6, &mut Noise::new(1));
    let park = ParkConfig { side: Side::Left, ..ParkConfig::default() };
    let mut drive = Drive::new(world, Parking::Parallel, DecisionConfig { park, ..DecisionConfig::default() }, 5);
    drive.mirrored = true;
    drive.run(120.0);
    let off = place.place_seen(drive.at);
    assert_eq!(drive.state, DriveState::Parked, "{:?}", drive.said);
    assert!(off.x_m.hypot(off.y_m) < 0.03, "{off:?}");
}

#[test]
fn a_gap_that_is_too_short_is_refused_with_the_numbers_and_the_search_goes_on() {
    let (world, _) = row(Parking::Parallel, 0.40, &mut Noise::new(1));
    let park = ParkConfig { search_m: 3.0, ..ParkConfig::default() };
    let mut drive = Drive::new(world, Parking::Parallel, DecisionConfig { park, ..DecisionConfig::default() }, 5);
    drive.run(60.0);
    assert_eq!(drive.said.len(), 2, "refused, then given up: {:?}", drive.said);
    let words = &drive.said[0];
    assert!(words.starts_with("gap of 0.4") || words.starts_with("gap of 0.3"), "{words}");
    assert!(words.contains("needed are 0.4"), "{words}");
    assert_eq!(drive.state, DriveState::ParkStop, "it stands");
    assert!(drive.last().contains("no gap that is long enough in 3.0 m; 1 were too short"), "{}", drive.last());
}

/// On its way back into a gap.
fn backing_in() -> Drive {
    let (world, _) = row(Parking::Parallel, 0.7, &mut Noise::new(1));
    let mut drive = Drive::new(world, Parking::Parallel, DecisionConfig::default(), 5);
    while drive.told.0 >= 0.0 || drive.at.yaw_rad < 0.3 {
        drive.run(0.1);
        assert!(drive.now_ms < 60_000, "it goes back within a minute: {:?}", drive.said);
    }
    drive
}

#[test]
fn a_gap_that_closes_stops_it_before_it_touches() {
    let mut drive = backing_in();
    drive.world.add_box([0.05, -0.10], [0.08, 0.12]);
    drive.run(20.0);
    assert_eq!((drive.state, drive.touched), (DriveState::ParkStop, false), "{:?}", drive.said);
    assert!(drive.last().contains("the gap closes"), "{}", drive.last());
    assert_eq!(drive.told.0, 0.0, "it stands");
}

#[test]
fn silence_of_the_lidar_or_of_the_wheels_stops_it() {
    for (scans, wheels, words) in [(false, true, "no scan for more than 500 ms"), (true, false, "no odometry")] {
        let mut drive = backing_in();
        (drive.scans, drive.wheels) = (scans, wheels);
        let before_ms = drive.now_ms;
        drive.run(20.0);
        assert_eq!(drive.state, DriveState::ParkStop, "{:?}", drive.said);
        assert!(drive.last().contains(words), "{}", drive.last());
        assert!(drive.now_ms - before_ms < 700, "soon: after {} ms", drive.now_ms - before_ms);
        let (world, _) = row(Parking::Parallel, 0.7, &mut Noise::new(1));
        let mut drive = Drive::new(world, Parking::Parallel, DecisionConfig::default(), 5);
        (drive.scans, drive.wheels) = (scans, wheels);
        drive.run(20.0);
        assert!(drive.last().contains(words), "in the search, too: {}", drive.last());
    }
}

#[test]
fn goals_that_contradict_are_refused_and_stop_ends_it() {
    let mut drive = backing_in();
    let refused = drive.memory.ask(Parking::Perpendicular).expect_err("it is parking");
    assert!(refused.contains("`stop` ends it"), "{refused}");
    assert!(drive.memory.withdraw().is_err(), "nor does it cruise");
    drive.memory.go_on(DriveState::Idle, Stamp::from_nanos(0), &drive.config);
    assert_eq!(drive.memory.wanted(&drive.config.park), None, "`stop` ends the wish, too");
    drive.memory.ask(Parking::Parallel).expect("a new one");
    assert!(drive.memory.wanted(&drive.config.park).is_some(), "looks for a gap again");
    drive.memory.withdraw().expect("it only looks for one");
    assert!(drive.memory.withdrawn().is_some(), "follows the lane");
}

#[test]
fn by_the_clock_it_goes_back_twice_and_forward() {
    let (world, _) = row(Parking::Parallel, 0.9, &mut Noise::new(1));
    let park = ParkConfig { mode: config::Mode::Timed, ..ParkConfig::default() };
    let mut drive = Drive::new(world, Parking::Parallel, DecisionConfig { park, ..DecisionConfig::default() }, 5);
    let mut told = Vec::new();
    while drive.state != DriveState::Parked && drive.now_ms < 60_000 {
        drive.run(0.01);
        if drive.state == DriveState::ParkDrive && told.last() != Some(&drive.told) {
            told.push(drive.told);
        }
    }
    let limit = 20_f64.to_radians();
    let recipe = [(-0.12, -limit), (-0.12, limit), (0.12, 0.0)];
    let near = |a: (f64, f64), b: (f64, f64)| (a.0 - b.0).abs() + (a.1 - b.1).abs() < 1e-9;
    let followed = told.windows(3).any(|three| (0..3).all(|i| near(three[i], recipe[i])));
    assert!(followed, "right, left, forward: {told:?}");
    assert!(drive.last().contains("the clock"), "{}", drive.last());
}
