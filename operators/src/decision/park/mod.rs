//! Parking: looks for a gap in the row beside the lane while the car follows it, measures it, refuses one that is too short, and gets
//! the car into one that is long enough. What it remembers, and what it commands; the FSM's states are in `decision/table.rs`.
//!
//! Within, the row is always on the right: a row on the left is looked at in a mirror.

pub mod config;
mod drive;
mod gap;
mod geometry;
mod locate;
mod plan;
#[cfg(test)]
mod tests;
mod track;
#[cfg(test)]
mod world;

use std::time::Duration;

use carril_messages::{DriveState, Parking, Stamp};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

pub use config::ParkConfig;

use config::Side;
use drive::{Drive, Outcome};
use gap::{Candidate, Row};
use geometry::{Car, Place};
use locate::Locator;
use plan::Kind;

use super::DecisionConfig;
use crate::odometry::Wheels;

/// Poses are kept so long, so that a scan can be put where the car was when it was taken, s.
const HISTORY_S: f64 = 0.6;
/// Gaps are looked for up to this length, m.
const LONGEST_M: f64 = 5.0;
/// For the first look at a gap, scans count from so far behind its rear end, m.
const BEHIND_M: f64 = 0.6;

/// What is known of parking. Survives from step to step and is handed over.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParkMemory {
    goal: Option<Parking>,
    stage: Stage,
    /// Where the car is since it was asked to park, in a frame that begins there; the row on its right.
    odometry: Place,
    history: Vec<(Stamp, Place)>,
    /// When the ways were last carried on.
    moved: Option<Stamp>,
    /// When the wheels were last heard of, and their speed, m/s.
    wheels: Option<(Stamp, f64)>,
    /// When the newest scan was taken.
    scanned: Option<Stamp>,
    news: Option<String>,
}

/// How far it has come.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
enum Stage {
    #[default]
    Off,
    Searches(Box<Searched>),
    Drives(Box<Drive>, String),
    Parked(String),
    Failed(String),
}

/// What the search remembers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Searched {
    row: Row,
    began: Stamp,
    way_m: f64,
    refused: u32,
    /// A scan came that has not been looked at.
    looked: bool,
}

impl From<Parking> for Kind {
    fn from(parking: Parking) -> Self {
        match parking {
            Parking::Parallel => Self::Parallel,
            Parking::Perpendicular => Self::Perpendicular,
        }
    }
}

impl ParkMemory {
    /// With a goal from the configuration.
    pub fn new(config: &ParkConfig) -> Self {
        Self { goal: config.goal, ..Self::default() }
    }

    /// A person wants the car to park. Refused while it parks, and once it has parked.
    pub fn ask(&mut self, parking: Parking) -> Result<(), String> {
        match &self.stage {
            Stage::Drives(..) => return Err("the car is parking; `stop` ends it".into()),
            Stage::Parked(_) => return Err("the car has parked; drive it out by hand".into()),
            Stage::Failed(reason) => return Err(format!("parking ended ({reason}); `stop` and `start` first")),
            Stage::Searches(_) if self.goal == Some(parking) => return Ok(()),
            Stage::Off | Stage::Searches(_) => {}
        }
        self.goal = Some(parking);
        self.stage = Stage::Off;
        Ok(())
    }

    /// A person wants something else. Refused like a wish to park.
    pub fn withdraw(&mut self) -> Result<(), String> {
        if let Some(parking) = self.goal {
            self.ask(parking)?;
            (self.goal, self.stage) = (None, Stage::Off);
        }
        Ok(())
    }

    /// Why a gap is looked for.
    pub fn wanted(&self, config: &ParkConfig) -> Option<String> {
        let side = if config.side == Side::Right { "right" } else { "left" };
        let kind = self.goal?.name();
        matches!(self.stage, Stage::Off | Stage::Searches(_))
            .then(|| format!("a goal: park; looks for a {kind} gap on the {side}"))
    }

    /// Why the search is over although nothing was found or failed.
    pub fn withdrawn(&self) -> Option<String> {
        self.goal.is_none().then(|| "another goal: not to park".into())
    }

    /// The gap that was found, in words.
    pub fn found(&self) -> Option<String> {
        if let Stage::Drives(_, words) = &self.stage { Some(words.clone()) } else { None }
    }

    /// Why it stands without having parked.
    pub fn failed(&self) -> Option<String> {
        if let Stage::Failed(reason) = &self.stage { Some(reason.clone()) } else { None }
    }

    /// How it stands in the gap.
    pub fn parked(&self) -> Option<String> {
        if let Stage::Parked(words) = &self.stage { Some(words.clone()) } else { None }
    }

    /// What there is to say besides transitions: a gap that was refused. Once.
    pub fn news(&mut self) -> Option<String> {
        self.news.take()
    }

    /// Whether scans and wheels are needed.
    pub fn listens(&self) -> bool {
        self.goal.is_some() && matches!(self.stage, Stage::Off | Stage::Searches(_) | Stage::Drives(..))
    }

    /// Whether all its numbers are some.
    pub fn is_finite(&self) -> bool {
        let stage = match &self.stage {
            Stage::Searches(searched) => searched.way_m.is_finite(),
            Stage::Drives(drive, _) => drive.is_finite(),
            Stage::Off | Stage::Parked(_) | Stage::Failed(_) => true,
        };
        stage && self.odometry.is_finite() && self.history.iter().all(|(_, place)| place.is_finite())
    }

    /// The car has gone on as the wheels say.
    pub(crate) fn drive_on(&mut self, wheels: Option<Wheels>, now: Stamp, config: &DecisionConfig) {
        let seconds = self.moved.map_or(0.0, |moved| now.since(moved).as_secs_f64().clamp(0.0, 0.5));
        self.moved = Some(now);
        let Some(wheels) = wheels else { return };
        self.wheels = Some((now, wheels.speed_m_s));
        let motion = wheels.motion(seconds, config.wheelbase_m);
        let end = motion.end();
        let mirror = mirror(&config.park);
        let moved = Place::new(end.x, mirror * end.y, mirror * motion.turn_rad);
        self.odometry = self.odometry.place(moved);
        self.history.retain(|(stamp, _)| now.since(*stamp).as_secs_f64() <= HISTORY_S);
        self.history.push((now, self.odometry));
        match &mut self.stage {
            Stage::Searches(searched) => searched.way_m += motion.way_m.abs(),
            Stage::Drives(drive, _) => drive.locator.moved(moved),
            Stage::Off | Stage::Parked(_) | Stage::Failed(_) => {}
        }
    }

    /// Takes in a scan, taken at `captured`: points in the body frame of then.
    pub fn observe(&mut self, points: &[Vector2<f64>], captured: Stamp, config: &DecisionConfig) {
        self.scanned = Some(captured);
        let mirror = mirror(&config.park);
        let then = self.then(captured);
        let since = self.odometry.place_seen(then);
        let points: Vec<[f64; 2]> = points.iter().map(|point| since.point([point.x, mirror * point.y])).collect();
        match (&mut self.stage, self.goal) {
            (Stage::Searches(searched), Some(goal)) => {
                searched.row.add(self.odometry, &points, &config.park.search(&config.body, goal.into()));
                searched.looked = false;
            }
            (Stage::Drives(drive, _), _) => {
                if let Some(reason) = drive.look(&points, &car(config)) {
                    self.stage = Stage::Failed(reason);
                }
            }
            _ => {}
        }
    }

    /// Where the car was then.
    fn then(&self, then: Stamp) -> Place {
        let after = self.history.iter().position(|(stamp, _)| *stamp >= then);
        match after {
            None => self.odometry,
            Some(0) => self.history[0].1,
            Some(index) => {
                let ((from, a), (to, b)) = (self.history[index - 1], self.history[index]);
                let share = then.since(from).as_secs_f64() / to.since(from).as_secs_f64().max(1e-9);
                let seen = a.place_seen(b);
                a.place(Place::new(share * seen.x_m, share * seen.y_m, share * seen.yaw_rad))
            }
        }
    }

    /// Goes on in a state of the FSM: looks for a gap, or drives into it. Gives speed (m/s) and steering (rad) while it drives the car.
    pub fn go_on(&mut self, state: DriveState, now: Stamp, config: &DecisionConfig) -> Option<(f64, f64)> {
        match state {
            DriveState::ParkSearch => self.search(now, config),
            DriveState::ParkDrive => return Some(self.drive(now, config)),
            DriveState::Idle | DriveState::EStop | DriveState::Manual if !matches!(self.stage, Stage::Off) => {
                // `stop` and all that is above it ends parking, and the wish for it.
                *self = Self { odometry: self.odometry, moved: self.moved, ..Self::default() };
            }
            _ => {}
        }
        None
    }

    fn search(&mut self, now: Stamp, config: &DecisionConfig) {
        let Some(goal) = self.goal else { return };
        if matches!(self.stage, Stage::Off) {
            let began = Searched { row: Row::default(), began: now, way_m: 0.0, refused: 0, looked: true };
            self.stage = Stage::Searches(Box::new(began));
        }
        let silent = self.silent(now, &config.park);
        let Stage::Searches(searched) = &mut self.stage else { return };
        if let Some(reason) = silent {
            self.stage = Stage::Failed(reason);
            return;
        }
        if searched.way_m > config.park.search_m {
            let (way_m, refused) = (searched.way_m, searched.refused);
            let reason = format!("no gap that is long enough in {way_m:.1} m; {refused} were too short");
            self.stage = Stage::Failed(reason);
            return;
        }
        if std::mem::replace(&mut searched.looked, true) {
            return;
        }
        let kind = Kind::from(goal);
        let Some(candidate) = searched.row.find(&config.park.search(&config.body, kind)) else { return };
        searched.row.passed(&candidate);
        let locator = first_look(&searched.row, &candidate, self.odometry);
        match judge(&locator, kind, now, config) {
            Ok((drive, words)) => self.stage = Stage::Drives(Box::new(drive), words),
            Err(refused) => {
                searched.refused += 1;
                self.news = Some(refused);
            }
        }
    }

    fn drive(&mut self, now: Stamp, config: &DecisionConfig) -> (f64, f64) {
        if matches!(self.stage, Stage::Drives(..))
            && let Some(reason) = self.silent(now, &config.park)
        {
            self.stage = Stage::Failed(reason);
        }
        let speed_m_s = self.wheels.map_or(0.0, |(_, speed_m_s)| speed_m_s);
        let Stage::Drives(drive, _) = &mut self.stage else { return (0.0, 0.0) };
        let car = car(config);
        match drive.go_on(speed_m_s, now, &car, &config.park) {
            Outcome::Goes(speed_m_s, curvature_per_m) => {
                return (speed_m_s, mirror(&config.park) * (curvature_per_m * car.wheelbase_m).atan());
            }
            Outcome::Parked(words) => self.stage = Stage::Parked(words),
            Outcome::Failed(reason) => self.stage = Stage::Failed(reason),
        }
        (0.0, 0.0)
    }

    /// Which of the senses that parking needs is silent. At the beginning of the search they have their time.
    fn silent(&self, now: Stamp, config: &ParkConfig) -> Option<String> {
        let began = if let Stage::Searches(searched) = &self.stage { Some(searched.began) } else { None };
        let over = |last: Option<Stamp>, limit_ms: f64| {
            let since = last.max(began);
            since.is_none_or(|stamp| now.since(stamp).to_duration() > Duration::from_secs_f64(limit_ms * 1e-3))
        };
        if over(self.scanned, config.scan_timeout_ms) {
            return Some(format!("no scan for more than {:.0} ms", config.scan_timeout_ms));
        }
        if over(self.wheels.map(|(stamp, _)| stamp), config.wheels_timeout_ms) {
            return Some(format!(
                "no odometry: no news of the wheels for more than {:.0} ms",
                config.wheels_timeout_ms
            ));
        }
        None
    }
}

fn mirror(config: &ParkConfig) -> f64 {
    if config.side == Side::Right { 1.0 } else { -1.0 }
}

fn car(config: &DecisionConfig) -> Car {
    config::car(&config.body, config.wheelbase_m, config.max_steering_deg, config.park.reserve_deg)
}

/// Looks at all that was seen of a gap while the car passed it.
fn first_look(row: &Row, candidate: &Candidate, now_at: Place) -> Locator {
    let near = |at: Place| candidate.row.seen([at.x_m, at.y_m])[0] > -BEHIND_M;
    let mut scans = row.scans().iter().filter(|kept| near(kept.at)).peekable();
    let mut last = scans.peek().map_or(now_at, |kept| kept.at);
    let mut locator = Locator::new(candidate.row.place_seen(last), candidate.length_m);
    for kept in scans {
        locator.moved(last.place_seen(kept.at));
        locator.look(&kept.points.iter().map(|[x, y]| [f64::from(*x), f64::from(*y)]).collect::<Vec<_>>());
        last = kept.at;
    }
    locator.moved(last.place_seen(now_at));
    locator
}

/// The way into a gap, or why there is none.
fn judge(locator: &Locator, kind: Kind, now: Stamp, config: &DecisionConfig) -> Result<(Drive, String), String> {
    let (car, limits) = (car(config), config.park.limits());
    let (at, gap) = (locator.place(), locator.gap());
    let length_m = gap.length_m();
    if let Some(moves) = plan::into_gap(at, &gap, &car, kind, &limits) {
        let reversals = plan::reversals(&moves);
        let words = format!("gap of {length_m:.2} m, a way in with {reversals} changes of direction");
        return Ok((Drive::new(locator.clone(), kind, moves, now), words));
    }
    let beside_m = at.y_m - gap.flank_m();
    let needed_m = plan::needed_m(beside_m, &car, kind, &limits, LONGEST_M);
    Err(if needed_m >= LONGEST_M {
        format!("gap of {length_m:.2} m, but no way in from {beside_m:.2} m beside it; looks on")
    } else if length_m >= needed_m {
        format!("gap of {length_m:.2} m, but its neighbours stand too unevenly; looks on")
    } else {
        format!("gap of {length_m:.2} m, needed are {needed_m:.2} m; looks on")
    })
}
