//! Overtaking: what is known of the road, and of the manoeuvre that the car is in. Out of its lane beside what stands or crawls in it,
//! past it in the left lane, and in again; measured in metres of the lane, never in seconds.

mod config;
mod path;
mod road;
#[cfg(test)]
mod tests;

use std::time::Duration;

use carril_messages::{DriveState, GroundLane, LaserScan, Stamp};
use nalgebra::{Rotation2, Vector2};
use serde::{Deserialize, Serialize};

pub use config::OvertakeConfig;
pub use road::Road;

use super::config::DecisionConfig;
use super::own_lane::OwnLane;
use super::pursuit::{self, Going};
use crate::odometry::{Motion, Wheels};
use path::{Beside, Ramp, clearance_along};

/// After a longer pause nothing is known of the way driven meanwhile, s.
const LONGEST_PAUSE_S: f64 = 0.5;
/// Without news of the wheels for so long the car does not know where it is, ms.
const ODOMETRY_TIMEOUT_MS: u64 = 300;
/// The lane is carried on without being seen for this way, m.
const BLIND_M: f64 = 1.0;
/// So many scans in a row say that something is there, or no longer.
const SURE_SCANS: u32 = 2;
/// The speed of what is ahead comes from so many scans, ...
const SPEED_SCANS: usize = 8;
/// ... at least from these.
const SPEED_SCANS_MIN: usize = 4;
/// What jumps by more from scan to scan is another thing, m.
const SAME_THING_M: f64 = 0.3;
/// What is slower stands, m/s.
const STANDS_M_S: f64 = 0.05;
/// Lengths of the change of lanes that are tried.
const CHANGES: u32 = 4;
/// On its way the car looks ahead so far, m, ...
const LOOK_M: f64 = 0.28;
/// ... and drives on while nothing comes nearer than this to where its body will be, m.
const TOUCH_M: f64 = 0.01;
/// It is back in its lane when it is so near to its middle, m.
const BACK_M: f64 = 0.08;
/// How it closes up to what is ahead: speed per distance, 1/s.
const CLOSING_PER_S: f64 = 0.8;
/// Slower than this no car drives evenly, m/s.
const CREEP_M_S: f64 = 0.1;
/// Standing too near to something to get past it, it backs up at this speed, m/s, ...
const BACKING_M_S: f64 = 0.2;
/// ... by at most so much, m, ...
const BACKING_MOST_M: f64 = 1.0;
/// ... and only while so much is free behind it, m.
const BEHIND_FREE_M: f64 = 0.3;
/// The point behind it, on its lane, towards which it steers then, m.
const BACKING_TOWARDS_M: f64 = 0.4;
/// It pulls out only if more than this share of the steering is left beside that for the lane's own curve.
const STEERING_RESERVE: f64 = 0.9;

/// What is known. Survives from step to step and is handed over.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OvertakeMemory {
    own: Option<OwnLane>,
    /// The detector sees the lane beside it at present.
    sees_other: bool,
    /// When the wheels were last heard of.
    wheels: Option<Stamp>,
    moved: Option<Stamp>,
    /// Way of the car since the start, m.
    way_m: f64,
    /// Where the odometry has the car: x, y, m, and yaw, rad, against where it was first heard.
    pose: [f64; 3],
    /// The newest scan that counted.
    scanned: Option<Stamp>,
    road: Road,
    /// Scans in a row with something ahead, and without.
    ahead_scans: u32,
    free_scans: u32,
    /// Scans in a row without anything beside or ahead in its own lane.
    passed_scans: u32,
    /// When (s) and where (x, y, m, in the frame of `pose`) what is ahead was seen.
    sightings: Vec<(f64, [f64; 2])>,
    /// Length of the change of lanes that leads past what is ahead, m, and how near the car comes to something, m.
    plan: Option<(f64, f64)>,
    /// Why there is none: how near the best of them would lead, m.
    best_m: Option<f64>,
    /// Where it began to wait, by `way_m`.
    wait_at_m: f64,
    ramp: Ramp,
    /// What the car would drive into, and after which way, m.
    blocked_m: Option<f64>,
    /// Since when nothing has stopped the manoeuvre.
    free_since: Option<Stamp>,
    /// Where the car left its lane, by `way_m`. `None`: it is in its lane.
    out_at_m: Option<f64>,
}

impl OvertakeMemory {
    /// Carries everything on with the car.
    pub(super) fn drive_on(&mut self, wheels: Option<Wheels>, now: Stamp, config: &DecisionConfig) {
        let seconds = self.moved.map_or(0.0, |moved| now.since(moved).as_secs_f64().clamp(0.0, LONGEST_PAUSE_S));
        self.moved = Some(now);
        let Some(wheels) = wheels else { return };
        self.wheels = Some(now);
        let motion = wheels.motion(seconds, config.wheelbase_m);
        if let Some(own) = &mut self.own {
            own.move_on(motion);
        }
        self.way_m += motion.way_m;
        let [x, y, yaw] = self.pose;
        let moved = Rotation2::new(yaw) * motion.end();
        self.pose = [x + moved.x, y + moved.y, yaw + motion.turn_rad];
        self.ramp.driven_m += motion.way_m.max(0.0);
        let road = &mut self.road;
        road.ahead_at = road.ahead_at.map(|at| motion.seen_after(at.into()).into());
        for distance_m in [&mut road.ahead_m, &mut road.left_m, &mut road.own_m, &mut self.blocked_m] {
            *distance_m = distance_m.map(|distance_m| distance_m - motion.way_m);
        }
        road.behind_m = road.behind_m.map(|behind_m| behind_m + motion.way_m);
    }

    /// Takes in the lane as it was seen `age_s` ago.
    pub(super) fn observe_lane(
        &mut self,
        lane: &GroundLane,
        wheels: Option<Wheels>,
        age_s: f64,
        config: &DecisionConfig,
    ) {
        let motion = wheels.map_or(Motion::default(), |wheels| wheels.motion(age_s, config.wheelbase_m));
        let seen = OwnLane::seen(lane, motion);
        match (&mut self.own, self.out_at_m) {
            (Some(own), Some(_)) => self.sees_other = !own.mend(&seen),
            (own, _) => (*own, self.sees_other) = (Some(seen), false),
        }
    }

    /// Takes in a scan of `age_s` ago.
    pub(super) fn observe_scan(
        &mut self,
        scan: &LaserScan,
        (wheels, steering_rad): (Option<Wheels>, f64),
        (age_s, now): (f64, Stamp),
        config: &DecisionConfig,
    ) {
        self.scanned = Some(now - Duration::from_secs_f64(age_s.max(0.0)));
        let (Some(own), Some(wheels)) = (&self.own, wheels) else { return };
        let motion = wheels.motion(age_s, config.wheelbase_m);
        let points: Vec<Vector2<f64>> =
            config.body.points(scan).into_iter().map(|point| motion.seen_after(point)).collect();
        self.road = Road::of(&points, own, &config.body, &config.overtake);
        let count = |counter: &mut u32, holds: bool| *counter = if holds { counter.saturating_add(1) } else { 0 };
        count(&mut self.ahead_scans, self.road.ahead_m.is_some());
        count(&mut self.free_scans, self.road.ahead_m.is_none_or(|ahead_m| ahead_m > 1.3 * config.overtake.begin_m));
        let in_again_m = config.overtake.change_min_m + config.overtake.wait_m;
        count(&mut self.passed_scans, self.road.own_m.is_none_or(|own_m| own_m > in_again_m));
        self.take_sighting(now);
        let going = Going { speed_m_s: wheels.speed_m_s.max(CREEP_M_S), steering_rad, age_s: 0.0 };
        if self.out_at_m.is_some() {
            self.look_ahead(&points, going, config);
        } else if self.is_near(config) {
            self.make_plan(&points, going, config);
        } else {
            (self.plan, self.best_m) = (None, None);
        }
    }

    /// Whether what is ahead is so near that the car must act.
    fn is_near(&self, config: &DecisionConfig) -> bool {
        self.road.ahead_m.is_some_and(|ahead_m| ahead_m <= config.overtake.begin_m)
    }

    fn take_sighting(&mut self, now: Stamp) {
        let Some(at) = self.road.ahead_at else { return self.sightings.clear() };
        let [x, y, yaw] = self.pose;
        let at = Vector2::new(x, y) + Rotation2::new(yaw) * Vector2::from(at);
        if self.sightings.last().is_some_and(|(_, before)| (at - Vector2::from(*before)).norm() > SAME_THING_M) {
            self.sightings.clear();
        }
        if self.sightings.len() == SPEED_SCANS {
            self.sightings.remove(0);
        }
        self.sightings.push((now.as_secs_f64(), at.into()));
    }

    /// Speed of what is ahead along the lane there, m/s: the slope of the line through its sightings. `None`: not known yet.
    fn speed_ahead_m_s(&self) -> Option<f64> {
        if self.sightings.len() < SPEED_SCANS_MIN {
            return None;
        }
        let count = self.sightings.len() as f64;
        let time_s = self.sightings.iter().map(|seen| seen.0).sum::<f64>() / count;
        let mean = self.sightings.iter().map(|seen| Vector2::from(seen.1)).sum::<Vector2<f64>>() / count;
        let (mut square, mut product) = (0.0, Vector2::zeros());
        for (at_s, at) in &self.sightings {
            square += (at_s - time_s).powi(2);
            product += (Vector2::from(*at) - mean) * (at_s - time_s);
        }
        let direction_rad = self.pose[2] + self.own.as_ref()?.ground().direction_at(self.road.ahead_m?);
        let (sin, cos) = direction_rad.sin_cos();
        (square > 0.0).then(|| (product / square).dot(&Vector2::new(cos, sin)))
    }

    /// Looks for the longest change of lanes that leads past everything.
    fn make_plan(&mut self, points: &[Vector2<f64>], going: Going, config: &DecisionConfig) {
        let Some(own) = &self.own else { return };
        let (overtake, lane) = (&config.overtake, own.ground());
        let least_m = change_m(&lane, config);
        (self.plan, self.best_m) = (None, None);
        for index in 0..=CHANGES {
            let share = f64::from(CHANGES - index) / f64::from(CHANGES);
            let length_m = least_m + share * (overtake.change_max_m - least_m).max(0.0);
            let ramp = Ramp { from_m: own.car_left_m(), to_m: own.width_m(), length_m, driven_m: 0.0 };
            let way_m = self.road.ahead_m.unwrap_or(0.0) + config.body.front_m + config.body.width_m;
            let (clearance_m, _) =
                clearance_along(&Beside { lane: &lane, ramp }, (way_m, going), points, &config.body, config);
            self.best_m = Some(self.best_m.map_or(clearance_m, |best_m| clearance_m.max(best_m)));
            if clearance_m >= overtake.clearance_m {
                self.plan = Some((length_m, clearance_m));
                return;
            }
        }
    }

    fn look_ahead(&mut self, points: &[Vector2<f64>], going: Going, config: &DecisionConfig) {
        let Some(own) = &self.own else { return };
        let (lane, ramp) = (own.ground(), self.ramp);
        let (clearance_m, after_m) =
            clearance_along(&Beside { lane: &lane, ramp }, (LOOK_M, going), points, &config.body, config);
        self.blocked_m = (clearance_m < TOUCH_M).then_some(after_m);
    }

    /// The FSM goes from state to state.
    pub(super) fn enter(&mut self, from: DriveState, to: DriveState, config: &DecisionConfig) {
        let width_m = self.own.as_ref().map_or(0.0, OwnLane::width_m);
        let left_m = self.own.as_ref().map_or(0.0, OwnLane::car_left_m);
        let length_m = self.own.as_ref().map_or(config.overtake.change_max_m, |own| change_m(&own.ground(), config));
        match to {
            DriveState::OvertakeOut => {
                let length_m = self.plan.map_or(length_m, |(length_m, _)| length_m);
                self.ramp = Ramp { from_m: left_m, to_m: width_m, length_m, driven_m: 0.0 };
                self.out_at_m = Some(self.way_m);
                self.passed_scans = 0;
                self.blocked_m = None;
            }
            DriveState::OvertakePass if from != DriveState::OvertakeOut => {
                self.ramp = Ramp { from_m: left_m, to_m: width_m, length_m, driven_m: 0.0 };
                self.blocked_m = None;
            }
            DriveState::OvertakeIn => {
                self.ramp = Ramp { from_m: self.ramp.at(0.0), to_m: 0.0, length_m, driven_m: 0.0 };
            }
            DriveState::OvertakeWait => self.wait_at_m = self.way_m,
            DriveState::LaneFollow | DriveState::Manual => self.forget(),
            _ => {}
        }
    }

    /// The car is in its lane, or somebody else has taken it elsewhere.
    fn forget(&mut self) {
        self.out_at_m = None;
        self.plan = None;
        self.blocked_m = None;
        self.free_since = None;
        self.ramp = Ramp::default();
    }

    /// Keeps the time since nothing stops the manoeuvre.
    pub(super) fn keep_time(&mut self, now: Stamp, hindered: bool) {
        self.free_since = if hindered { None } else { self.free_since.or(Some(now)) };
    }

    /// Whether it has left its lane.
    pub fn is_out(&self) -> bool {
        self.out_at_m.is_some()
    }

    /// Steering along the way beside the lane, rad.
    pub(super) fn steering_rad(&self, going: Going, config: &DecisionConfig) -> Option<f64> {
        let lane = self.own.as_ref()?.ground();
        Some(pursuit::steering_rad(&Beside { lane: &lane, ramp: self.ramp }, going, config))
    }

    /// Speed behind what it cannot overtake yet, m/s.
    pub(super) fn waiting_speed_m_s(&self, cruise_m_s: f64, config: &DecisionConfig) -> f64 {
        let Some(ahead_m) = self.road.ahead_m else { return cruise_m_s };
        if self.backs_up(config) {
            return -BACKING_M_S;
        }
        let theirs_m_s = self.speed_ahead_m_s().unwrap_or(0.0).max(0.0);
        let wanted_m_s = theirs_m_s + CLOSING_PER_S * (ahead_m - config.overtake.wait_m);
        if wanted_m_s < CREEP_M_S { 0.0 } else { wanted_m_s.min(cruise_m_s) }
    }

    /// Whether it stands too near to what stands ahead to get past it, and can get away from it.
    fn backs_up(&self, config: &DecisionConfig) -> bool {
        let stands = self.speed_ahead_m_s().is_some_and(|theirs_m_s| theirs_m_s.abs() < STANDS_M_S);
        let way_free = self.road.behind_m.is_none_or(|behind_m| behind_m > BEHIND_FREE_M);
        let too_near = self.is_near(config) && self.plan.is_none() && self.best_m.is_some();
        stands && too_near && way_free && self.left_is_free(config) && self.way_m > self.wait_at_m - BACKING_MOST_M
    }

    /// Steering of a car that backs up along its lane, rad: towards a point behind it (pure pursuit).
    pub(super) fn backing_steering_rad(&self, config: &DecisionConfig) -> Option<f64> {
        let [x, y] = self.own.as_ref()?.ground().point_at(-BACKING_TOWARDS_M);
        let limit = config.max_steering_deg.to_radians();
        Some((2.0 * y / (x * x + y * y) * config.wheelbase_m).atan().clamp(-limit, limit))
    }

    /// Why it must wait behind what is ahead, or overtake it.
    pub fn nears(&self, config: &DecisionConfig) -> Option<String> {
        let ahead_m = self.road.ahead_m.filter(|_| config.overtake.enabled && self.ahead_scans >= SURE_SCANS)?;
        (self.is_near(config) && self.wheels.is_some()).then(|| format!("something {ahead_m:.2} m ahead in its lane"))
    }

    /// Why it pulls out.
    pub fn pulls_out(&self, cruise_m_s: f64, config: &DecisionConfig) -> Option<String> {
        let near = self.nears(config)?;
        let theirs_m_s = self.speed_ahead_m_s()?;
        let (length_m, clearance_m) = self.plan?;
        let slow = theirs_m_s <= (config.overtake.slower_share * cruise_m_s).max(STANDS_M_S);
        let free = self.left_is_free(config);
        let seen = self.own.as_ref().is_some_and(|own| own.blind_m() == 0.0 || own.blind_m() < BLIND_M / 2.0);
        (slow && free && seen).then(|| {
            let speed = if theirs_m_s.abs() < STANDS_M_S {
                "stands".to_owned()
            } else {
                format!("goes at {theirs_m_s:.2} m/s")
            };
            let beside = if clearance_m.is_finite() { format!("{clearance_m:.2} m beside it") } else { String::new() };
            let left = match self.road.left_m {
                Some(left_m) => format!("free for {left_m:.2} m"),
                None => "free".to_owned(),
            };
            format!("{near}, it {speed}; the left lane is {left}; changes over in {length_m:.2} m, {beside}")
        })
    }

    /// Why it does not pull out yet, for people.
    pub fn waits_because(&self, cruise_m_s: f64, config: &DecisionConfig) -> Option<String> {
        let near = self.nears(config)?;
        // It came near since the last scan: the next one says whether there is a way past it.
        let best_m = self.best_m?;
        let most_m_s = config.overtake.slower_share * cruise_m_s;
        Some(match (self.road.left_m.filter(|_| !self.left_is_free(config)), self.speed_ahead_m_s(), self.plan) {
            (Some(left_m), ..) => format!("{near}; the left lane is occupied at {left_m:.2} m"),
            (None, None, _) => format!("{near}; its speed is not known yet"),
            (None, Some(theirs_m_s), _) if theirs_m_s > most_m_s => {
                format!("{near}, it goes at {theirs_m_s:.2} m/s; overtakes at {most_m_s:.2} m/s or less")
            }
            (None, Some(_), None) => {
                let wanted_m = config.overtake.clearance_m;
                format!("{near}; no way past it: {best_m:.2} m beside it at best, wanted are {wanted_m:.2} m")
            }
            (None, Some(_), Some(_)) => near,
        })
    }

    fn left_is_free(&self, config: &DecisionConfig) -> bool {
        self.road.left_m.is_none_or(|left_m| left_m > config.overtake.free_ahead_m)
    }

    /// Why there is nothing to overtake any more.
    pub fn is_alone(&self, config: &DecisionConfig) -> Option<String> {
        (self.free_scans >= SURE_SCANS).then(|| match self.road.ahead_m {
            Some(ahead_m) => format!("what is ahead is {ahead_m:.2} m away"),
            None => format!("nothing within {:.2} m ahead", 1.3 * config.overtake.begin_m),
        })
    }

    /// Why the car is out of its lane.
    pub fn is_beside(&self) -> Option<String> {
        let left_m = self.own.as_ref()?.car_left_m();
        self.ramp.is_done().then(|| format!("{left_m:.2} m beside the middle of its lane"))
    }

    /// Why it turns back before it is beside what it wanted to overtake.
    pub fn turns_back(&self, config: &DecisionConfig) -> Option<String> {
        let left_m = self.road.left_m.filter(|left_m| *left_m < config.overtake.free_ahead_m / 2.0)?;
        let own_m = self.road.own_m.filter(|own_m| *own_m >= config.overtake.wait_m)?;
        Some(format!("the left lane is occupied at {left_m:.2} m; what is in its lane is still {own_m:.2} m ahead"))
    }

    /// Why it can go in again.
    pub fn has_passed(&self) -> Option<String> {
        (self.passed_scans >= SURE_SCANS).then(|| match self.road.own_m {
            Some(own_m) => format!("past it; the next thing in its lane is {own_m:.2} m ahead"),
            None => "past it; its lane is free".to_owned(),
        })
    }

    /// Why it is in its lane again.
    pub fn is_back(&self) -> Option<String> {
        let left_m = self.own.as_ref()?.car_left_m();
        (self.ramp.is_done() && left_m.abs() <= BACK_M && !self.sees_other)
            .then(|| format!("{left_m:.2} m left of the middle of its lane"))
    }

    /// Why a car that is out of its lane must stand.
    pub fn hindered(&self, now: Stamp, config: &DecisionConfig) -> Option<String> {
        let older =
            |stamp: Option<Stamp>, limit: Duration| stamp.is_none_or(|stamp| now.since(stamp).to_duration() > limit);
        if older(self.scanned, Duration::from_secs_f64(config.sectors_timeout_ms * 1e-3)) {
            return Some(format!("no scan for more than {:.0} ms", config.sectors_timeout_ms));
        }
        if older(self.wheels, Duration::from_millis(ODOMETRY_TIMEOUT_MS)) {
            return Some(format!("no odometry for more than {ODOMETRY_TIMEOUT_MS} ms"));
        }
        let Some(own) = &self.own else { return Some("its lane is not known".to_owned()) };
        if own.blind_m() > BLIND_M {
            return Some(format!("the lane has not been seen for {:.2} m", own.blind_m()));
        }
        if let Some(blocked_m) = self.blocked_m {
            return Some(format!("something is in the way, {:.2} m farther on", blocked_m.max(0.0)));
        }
        let beside_m = self.way_m - self.out_at_m.unwrap_or(self.way_m);
        let most_m = config.overtake.pass_max_m;
        (beside_m > most_m)
            .then(|| format!("{beside_m:.1} m beside its lane and not past it, allowed are {most_m:.1} m"))
    }

    /// Why the manoeuvre can go on.
    pub fn goes_on(&self, now: Stamp, config: &DecisionConfig) -> Option<String> {
        let free_s = now.since(self.free_since?).as_secs_f64();
        (self.is_out() && free_s >= config.clear_s).then(|| format!("nothing in the way for {free_s:.1} s"))
    }

    /// Whether all its numbers are some.
    pub fn is_finite(&self) -> bool {
        let road = [self.road.ahead_m, self.road.left_m, self.road.own_m, self.blocked_m, self.out_at_m, self.best_m];
        road.iter()
            .chain([&self.road.behind_m])
            .flatten()
            .chain([&self.way_m, &self.wait_at_m])
            .all(|number| number.is_finite())
            && self.own.as_ref().is_none_or(OwnLane::is_finite)
            && self.ramp.is_finite()
            && self.sightings.iter().all(|(time_s, [x, y])| [time_s, x, y].iter().all(|number| number.is_finite()))
            && self.pose.iter().chain(self.road.ahead_at.iter().flatten()).all(|number| number.is_finite())
            && self.plan.is_none_or(|(length_m, clearance_m)| length_m.is_finite() && !clearance_m.is_nan())
    }
}

/// The shortest change of lanes that the steering allows beside the lane's own curve, m: the curvature of a ramp is at most
/// `width (pi / length)^2 / 2`.
fn change_m(lane: &GroundLane, config: &DecisionConfig) -> f64 {
    let most_per_m = config.max_steering_deg.to_radians().tan() / config.wheelbase_m;
    let bent_per_m = f64::from(lane.curvature_per_m).abs();
    let left_per_m = (STEERING_RESERVE * most_per_m - bent_per_m).max(0.05 * most_per_m);
    let length_m = std::f64::consts::PI * (f64::from(lane.width_m) / (2.0 * left_per_m)).sqrt();
    length_m.clamp(config.overtake.change_min_m, config.overtake.change_max_m)
}
