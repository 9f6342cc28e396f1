//! The way into the gap: along the plan, move by move, corrected at the end; ends parked, or standing with a reason.

use carril_messages::Stamp;
use serde::{Deserialize, Serialize};

use super::config::{Mode, ParkConfig, TimedConfig};
use super::geometry::{Car, Place};
use super::locate::Locator;
use super::plan::{self, Kind, Limits, Move};
use super::track;

/// A car that is slower stands, m/s.
const STANDS_M_S: f64 = 0.01;
/// How hard it brakes at the end of a move, m/s².
const BRAKES_M_S2: f64 = 0.15;
/// A neighbour that comes nearer than this share of the plan's margin ends a move early.
const SHARE_OF_MARGIN: f64 = 0.4;
/// Returns this deep within the body on its way are no noise, m, ...
const CLOSED_M: f64 = 0.02;
/// ... when there are so many of them ...
const CLOSED_RETURNS: usize = 3;
/// ... in so many scans in a row.
const CLOSED_SCANS: u32 = 2;
/// ... or so many of them in one.
const CLOSED_AT_ONCE: usize = 8;
/// So far ahead the way is watched, m.
const WATCHED_M: f64 = 0.25;
/// Before a car that stands is judged, so many scans must have been taken.
const JUDGED_SCANS: u32 = 3;

/// What is known and planned on the way into a gap.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Drive {
    pub(super) locator: Locator,
    kind: Kind,
    moves: Vec<Move>,
    index: usize,
    rolling: bool,
    began: Stamp,
    /// Since when it shall stand.
    since: Stamp,
    /// Scans since then.
    scans: u32,
    curvature_per_m: f64,
    /// Since when it drives by the clock.
    clock: Option<Stamp>,
    /// The plan that is driven was made standing beside the gap.
    planned_standing: bool,
    reversals: u32,
    corrections: u32,
    closed: u32,
}

/// Where it has come to.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// It goes on: speed, m/s, and curvature, 1/m, row frame.
    Goes(f64, f64),
    /// It stands in the gap.
    Parked(String),
    /// It stands, for this reason.
    Failed(String),
}

impl Drive {
    /// A car that drives past a gap into which these moves lead.
    pub fn new(locator: Locator, kind: Kind, moves: Vec<Move>, now: Stamp) -> Self {
        Self {
            locator,
            kind,
            reversals: plan::reversals(&moves),
            moves,
            index: 0,
            rolling: true,
            began: now,
            since: now,
            scans: 0,
            curvature_per_m: 0.0,
            clock: None,
            planned_standing: false,
            corrections: 0,
            closed: 0,
        }
    }

    /// Whether all numbers are some.
    pub fn is_finite(&self) -> bool {
        let finite = |way: &Move| way.from.is_finite() && way.way_m.is_finite() && way.curvature_per_m.is_finite();
        self.locator.is_finite() && self.curvature_per_m.is_finite() && self.moves.iter().all(finite)
    }

    /// Takes in a scan, points as seen from where the car is now; why the way is closed, if it is.
    pub fn look(&mut self, points: &[[f64; 2]], car: &Car) -> Option<String> {
        self.locator.look(points);
        self.scans = self.scans.saturating_add(1);
        let closed = self.rolling.then(|| self.in_the_way(points, car)).flatten();
        self.closed = if closed.is_some() { self.closed + 1 } else { 0 };
        let (count, ahead_m) = closed.filter(|(count, _)| self.closed >= CLOSED_SCANS || *count >= CLOSED_AT_ONCE)?;
        Some(format!("the gap closes: {count} returns in the way of the body, {ahead_m:.2} m before it gets there"))
    }

    /// Returns that the body would run into on the way that is left of the move, and the way to the first, m.
    fn in_the_way(&self, points: &[[f64; 2]], car: &Car) -> Option<(usize, f64)> {
        let way = self.moves.get(self.index)?;
        let left_m = track::locate(way, self.locator.place()).left_to_go_m.min(WATCHED_M);
        let steps = (left_m / 0.02).ceil().max(1.0);
        let mut first_m = None;
        let mut hit = vec![false; points.len()];
        for step in 0..=steps as u32 {
            let way_m = left_m * f64::from(step) / steps;
            let at = Place::default().after(way_m * way.way_m.signum(), self.curvature_per_m);
            for (point, hit) in points.iter().zip(&mut hit) {
                if !*hit && car.covers(at.seen(*point), -CLOSED_M) {
                    *hit = true;
                    first_m = first_m.or(Some(way_m));
                }
            }
        }
        let count = hit.into_iter().filter(|hit| *hit).count();
        (count >= CLOSED_RETURNS).then_some((count, first_m?))
    }

    /// What to do now, at a speed of the wheels.
    pub fn go_on(&mut self, speed_m_s: f64, now: Stamp, car: &Car, config: &ParkConfig) -> Outcome {
        let driven_s = now.since(self.began).as_secs_f64();
        if driven_s > config.max_s {
            return Outcome::Failed(format!("not parked after {driven_s:.0} s, allowed are {:.0} s", config.max_s));
        }
        if let Some(since) = self.clock {
            return by_the_clock(now.since(since).as_secs_f64(), car, &config.timed);
        }
        if !self.rolling {
            let stood_s = now.since(self.since).as_secs_f64();
            if speed_m_s.abs() > STANDS_M_S {
                return Outcome::Goes(0.0, self.curvature_per_m);
            }
            if let Some(outcome) = self.stand(stood_s, now, car, config) {
                return outcome;
            }
        }
        self.roll(speed_m_s, now, car, config)
    }

    /// At a stand: what is next. `None`: the next move begins.
    fn stand(&mut self, stood_s: f64, now: Stamp, car: &Car, config: &ParkConfig) -> Option<Outcome> {
        if config.mode == Mode::Timed && self.index > 0 {
            self.clock = Some(now);
            return Some(by_the_clock(0.0, car, &config.timed));
        }
        if !self.planned_standing {
            if self.scans < JUDGED_SCANS {
                return Some(Outcome::Goes(0.0, self.curvature_per_m));
            }
            if let Err(reason) = self.plan_again(car, config) {
                return Some(Outcome::Failed(reason));
            }
        }
        if self.index >= self.moves.len() {
            if self.scans < JUDGED_SCANS {
                return Some(Outcome::Goes(0.0, self.curvature_per_m));
            }
            if let Some(outcome) = self.judge(car, config) {
                return Some(outcome);
            }
        }
        self.curvature_per_m = self.moves[self.index].curvature_per_m;
        self.rolling = stood_s >= config.settle_s;
        (!self.rolling).then_some(Outcome::Goes(0.0, self.curvature_per_m))
    }

    /// Plans from where the car stands, by what is known of the gap now: somewhat nearer to the neighbours, if it must be.
    fn plan_again(&mut self, car: &Car, config: &ParkConfig) -> Result<(), String> {
        let (at, gap) = (self.locator.place(), self.locator.gap());
        let moves = [1.0, 0.8, 0.6].into_iter().find_map(|share| {
            let limits = Limits { margin_m: share * config.margin_m, max_moves: config.max_moves + 2 };
            plan::into_gap(at, &gap, car, self.kind, &limits)
        });
        let Some(moves) = moves else {
            let length_m = gap.length_m();
            return Err(format!("seen from beside it, the gap of {length_m:.2} m has no way in from here"));
        };
        self.reversals = plan::reversals(&moves);
        (self.moves, self.index, self.planned_standing) = (moves, 0, true);
        Ok(())
    }

    /// At the end of the moves: parked, or some more of them.
    fn judge(&mut self, car: &Car, config: &ParkConfig) -> Option<Outcome> {
        let (at, gap) = (self.locator.place(), self.locator.gap());
        let off = plan::place_in(&gap, car, self.kind).place_seen(at);
        let (off_m, turned_deg) = (off.x_m.abs().max(off.y_m.abs()), off.yaw_rad.to_degrees().abs());
        let words = format!(
            "{:.1} cm along and {:.1} cm across from its place, turned by {turned_deg:.1} degrees",
            100.0 * off.x_m,
            100.0 * off.y_m
        );
        if off_m > config.tolerance_m || turned_deg > config.tolerance_deg {
            let limits = Limits { margin_m: 0.6 * config.margin_m, max_moves: config.max_moves };
            let moves = if self.corrections < config.max_corrections {
                plan::correction(at, &gap, car, self.kind, &limits)
            } else {
                Vec::new()
            };
            if !moves.is_empty() {
                self.corrections += 1;
                (self.moves, self.index) = (moves, 0);
                return None;
            }
            if !(off_m <= config.accept_m && turned_deg <= config.accept_deg) {
                return Some(Outcome::Failed(format!("stands {words}, and no move brings it nearer")));
            }
        }
        let (length_m, reversals, corrections) = (gap.length_m(), self.reversals, self.corrections);
        Some(Outcome::Parked(format!(
            "stands {words}, in a gap of {length_m:.2} m, after {reversals} changes of direction and {corrections} corrections"
        )))
    }

    /// On a move.
    fn roll(&mut self, speed_m_s: f64, now: Stamp, car: &Car, config: &ParkConfig) -> Outcome {
        let at = self.locator.place();
        let way = self.moves[self.index];
        let on = track::locate(&way, at);
        let stop_m = speed_m_s.abs() * config.stop_s;
        let direction = way.way_m.signum();
        let margin_m = SHARE_OF_MARGIN * config.margin_m;
        let gap = self.locator.gap();
        let then = at.after(direction * (stop_m + 0.003), self.curvature_per_m);
        let blocked = gap.clears(car, at, margin_m) && !gap.clears(car, then, margin_m);
        if on.left_to_go_m <= stop_m || blocked {
            self.index += 1;
            (self.rolling, self.since, self.scans) = (false, now, 0);
            return Outcome::Goes(0.0, self.curvature_per_m);
        }
        self.curvature_per_m = track::curvature_per_m(&way, &on, config.settle_m, car);
        let most = if self.planned_standing { config.speed_m_s } else { config.search_speed_m_s };
        let braking = (2.0 * BRAKES_M_S2 * (on.left_to_go_m - stop_m)).sqrt();
        Outcome::Goes(direction * braking.clamp(config.creep_m_s, most.max(config.creep_m_s)), self.curvature_per_m)
    }
}

/// The recipe of the seed, so many seconds after it began.
fn by_the_clock(seconds: f64, car: &Car, config: &TimedConfig) -> Outcome {
    let moves = [
        (config.back_in_s, -config.speed_m_s, -car.curvature_per_m),
        (config.back_out_s, -config.speed_m_s, car.curvature_per_m),
        (config.forward_s, config.speed_m_s, 0.0),
    ];
    let mut end_s = 0.0;
    for (lasts_s, speed_m_s, curvature_per_m) in moves {
        end_s += lasts_s;
        if seconds < end_s {
            return Outcome::Goes(speed_m_s, curvature_per_m);
        }
    }
    Outcome::Parked(format!("stands where the clock has brought it, after {end_s:.1} s"))
}
