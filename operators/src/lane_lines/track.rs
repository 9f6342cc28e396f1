//! The lane from frame to frame: predicted by odometry, corrected by what is seen, carried on over gaps, given up when it is gone.

use std::time::Duration;

use carril_messages::{GroundLane, Stamp};
use serde::{Deserialize, Serialize};

use super::config::LaneLinesConfig;
use super::fit::{self, Fit};
use super::ridges::Ridge;
use crate::lane_curve::{self, Covariance, State};
use crate::odometry::Wheels;

/// After a longer pause nothing is known any more.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);
/// Speed that is reckoned with where there is no odometry, m/s: how far the lane may have moved in view.
const UNKNOWN_SPEED_M_S: f64 = 1.0;
/// So often the lane is searched anew although it is known, frames.
const SEARCH_EVERY: u32 = 2;
/// A lane elsewhere is taken when it was the better one so often in a row, ...
const DOUBTS: u32 = 2;
/// ... with so many times the rows.
const BETTER: f64 = 1.3;
/// With lines in this share of the rows a lane is trusted fully.
const FULL_TRUST_ROWS: f64 = 0.4;
/// Ridges that are this far from their lines, root mean square, as a share of the lane's width, halve the trust.
const HALF_TRUST_RMS: f64 = 0.1;
/// At the end of a bridge the trust has fallen to this share.
const BRIDGE_TRUST: f64 = 0.3;

/// The lane as it was in the newest frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Track {
    state: [f64; 5],
    covariance: [[f64; 5]; 5],
    /// As it is given: smoothed.
    shown: [f64; 5],
    captured: Stamp,
    /// From the last frame in which a line was seen.
    trust: f64,
    seen: Option<Seen>,
    /// Since a line was seen.
    bridged_m: f64,
    bridged_s: f64,
    frames: u32,
    doubts: u32,
}

/// What was seen of it in the newest frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Seen {
    ahead_m: f64,
    left: bool,
    right: bool,
    rows: usize,
}

/// A frame's ridges, and how many rows were searched.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frame<'a> {
    pub ridges: &'a [Ridge],
    pub rows: usize,
    pub captured: Stamp,
}

impl Track {
    /// Goes on to the next frame; `None` when there is no lane.
    pub fn next(
        before: Option<Self>,
        frame: Frame<'_>,
        wheels: Option<Wheels>,
        config: &LaneLinesConfig,
    ) -> Option<Self> {
        let before = before.filter(|track| {
            let pause = frame.captured.since(track.captured);
            pause.as_nanos() >= 0 && pause.to_duration() <= LONGEST_PAUSE
        });
        match before {
            Some(track) => track.go_on(frame, wheels, config),
            None => fit::search(frame.ridges, config).map(|fit| Self::begin(&fit, frame, config)),
        }
    }

    fn begin(fit: &Fit, frame: Frame<'_>, config: &LaneLinesConfig) -> Self {
        Self {
            state: fit.state.into(),
            covariance: fit.covariance.into(),
            shown: fit.state.into(),
            captured: frame.captured,
            trust: trust(fit, frame.rows, config),
            seen: Some(Seen::of(fit)),
            bridged_m: 0.0,
            bridged_s: 0.0,
            frames: 0,
            doubts: 0,
        }
    }

    fn go_on(mut self, frame: Frame<'_>, wheels: Option<Wheels>, config: &LaneLinesConfig) -> Option<Self> {
        let seconds = frame.captured.since(self.captured).as_secs_f64();
        self.captured = frame.captured;
        self.frames = self.frames.wrapping_add(1);
        let predicted = self.predict(seconds, wheels, config);
        match fit::fit(&predicted, &Covariance::from(self.covariance), frame.ridges, config) {
            Some(fit) => self.take(&fit, frame, seconds, config),
            None => self.bridge(seconds, wheels),
        }
        if self.seen.is_none() || self.frames.is_multiple_of(SEARCH_EVERY) || self.doubts > 0 {
            self.doubt(frame, config);
        }
        let over = match wheels {
            Some(_) => self.bridged_m > config.bridge_m,
            None => self.bridged_s > config.bridge_s,
        };
        (!over).then_some(self)
    }

    /// Moves the lane as the car has moved.
    fn predict(&mut self, seconds: f64, wheels: Option<Wheels>, config: &LaneLinesConfig) -> State {
        let motion = wheels.map(|wheels| wheels.motion(seconds, config.wheelbase_m));
        let known = Covariance::from(self.covariance);
        let (state, covariance) = lane_curve::moved(&State::from(self.state), &known, motion.unwrap_or_default());
        let (shown, _) = lane_curve::moved(&State::from(self.shown), &known, motion.unwrap_or_default());
        let way_m = motion.map_or(UNKNOWN_SPEED_M_S * seconds, |motion| motion.way_m.abs());
        self.covariance = (covariance + fit::spread(way_m, motion.is_some(), config)).into();
        (self.state, self.shown) = (state.into(), shown.into());
        state
    }

    fn take(&mut self, fit: &Fit, frame: Frame<'_>, seconds: f64, config: &LaneLinesConfig) {
        let share = if config.smoothing_s > 0.0 { 1.0 - (-seconds / config.smoothing_s).exp() } else { 1.0 };
        let shown = State::from(self.shown);
        self.shown = (shown + (fit.state - shown) * share).into();
        self.state = fit.state.into();
        self.covariance = fit.covariance.into();
        self.trust = trust(fit, frame.rows, config);
        self.seen = Some(Seen::of(fit));
        (self.bridged_m, self.bridged_s) = (0.0, 0.0);
    }

    fn bridge(&mut self, seconds: f64, wheels: Option<Wheels>) {
        self.seen = None;
        self.bridged_s += seconds;
        self.bridged_m += wheels.map_or(0.0, |wheels| wheels.speed_m_s.abs() * seconds);
    }

    /// Looks whether the lane lies elsewhere.
    fn doubt(&mut self, frame: Frame<'_>, config: &LaneLinesConfig) {
        let rows = self.seen.map_or(0, |seen| seen.rows);
        let found = fit::search(frame.ridges, config);
        match found.filter(|fit| fit.rows as f64 > BETTER * rows as f64) {
            Some(fit) if self.doubts + 1 >= DOUBTS => *self = Self::begin(&fit, frame, config),
            Some(_) => self.doubts += 1,
            None => self.doubts = 0,
        }
    }

    /// The lane as it is given.
    pub fn ground(&self) -> GroundLane {
        let seen = self.seen;
        GroundLane {
            seen_m: seen.map_or(0.0, |seen| seen.ahead_m) as f32,
            left_seen: seen.is_some_and(|seen| seen.left),
            right_seen: seen.is_some_and(|seen| seen.right),
            bridged_m: self.bridged_m as f32,
            ..lane_curve::published(&State::from(self.shown))
        }
    }

    /// How much it is to be trusted, 0 to 1.
    pub fn quality(&self, config: &LaneLinesConfig) -> f64 {
        let by_way = if config.bridge_m > 0.0 { self.bridged_m / config.bridge_m } else { 0.0 };
        let by_time = if config.bridge_s > 0.0 { self.bridged_s / config.bridge_s } else { 0.0 };
        let gone = if self.bridged_m > 0.0 { by_way } else { by_time };
        self.trust * (1.0 - (1.0 - BRIDGE_TRUST) * gone.min(1.0))
    }

    /// Whether a successor can go on with it.
    pub fn is_finite(&self) -> bool {
        let numbers = self.state.iter().chain(&self.shown).chain(self.covariance.iter().flatten());
        numbers.chain([&self.trust, &self.bridged_m, &self.bridged_s]).all(|number| number.is_finite())
    }
}

impl Seen {
    fn of(fit: &Fit) -> Self {
        Self { ahead_m: fit.seen_m, left: fit.left_seen, right: fit.right_seen, rows: fit.rows }
    }
}

fn trust(fit: &Fit, rows: usize, config: &LaneLinesConfig) -> f64 {
    let share = fit.rows as f64 / (FULL_TRUST_ROWS * rows.max(1) as f64);
    let odd = fit.rms_m / (HALF_TRUST_RMS * config.lane_width_m);
    share.min(1.0) / (1.0 + odd * odd)
}
