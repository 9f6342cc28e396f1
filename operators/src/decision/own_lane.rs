//! The lane that is the car's own, also while it drives beside it: carried on by odometry, mended by what the detector sees.

use carril_messages::GroundLane;
use serde::{Deserialize, Serialize};

use crate::lane_curve::{self, Covariance, OFFSET, State};
use crate::odometry::Motion;

/// A lane that the detector sees farther away from the own one than this share of its width is the one beside it.
const OTHER_LANE: f64 = 0.6;

/// The car's own lane, in the body frame of now.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OwnLane {
    state: [f64; 5],
    /// How far ahead it was seen, m.
    seen_m: f64,
    /// Way since it was last seen, m.
    blind_m: f64,
}

impl OwnLane {
    /// As the detector gave it. `motion`: of the car since the exposure.
    pub(crate) fn seen(lane: &GroundLane, motion: Motion) -> Self {
        let state = lane_curve::state_of(lane);
        let mut own = Self { state: state.into(), seen_m: f64::from(lane.seen_m), blind_m: 0.0 };
        own.move_on(motion);
        own.blind_m = 0.0;
        own
    }

    /// The car has moved.
    pub(crate) fn move_on(&mut self, motion: Motion) {
        let (state, _) = lane_curve::moved(&State::from(self.state), &Covariance::identity(), motion);
        self.state = state.into();
        self.blind_m += motion.way_m.abs();
    }

    /// The detector sees a lane (in the body frame of now): this one, or the one beside it. Whether it was this one.
    pub(crate) fn mend(&mut self, seen: &Self) -> bool {
        let (own, mut state) = (State::from(self.state), State::from(seen.state));
        let aside_m = state[OFFSET] - own[OFFSET];
        let other = aside_m.abs() > OTHER_LANE * seen.width_m();
        if other {
            let lanes = (aside_m / seen.width_m()).round();
            state = lane_curve::beside(&state, -lanes * seen.width_m());
        }
        *self = Self { state: state.into(), ..*seen };
        !other
    }

    /// As a lane on the floor.
    pub fn ground(&self) -> GroundLane {
        GroundLane { seen_m: self.seen_m as f32, ..lane_curve::published(&State::from(self.state)) }
    }

    /// Between the middles of its lines, m.
    pub fn width_m(&self) -> f64 {
        self.state[lane_curve::WIDTH]
    }

    /// The car to the left of its middle, m.
    pub fn car_left_m(&self) -> f64 {
        -self.state[OFFSET]
    }

    /// Way since it was last seen, m.
    pub fn blind_m(&self) -> f64 {
        self.blind_m
    }

    /// Whether every number of it is one.
    pub fn is_finite(&self) -> bool {
        self.state.iter().chain([&self.seen_m, &self.blind_m]).all(|number| number.is_finite())
    }

    pub(crate) fn state(&self) -> State {
        State::from(self.state)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lane(offset_m: f32) -> GroundLane {
        lane_curve::published(&State::from([f64::from(offset_m), 0.1, 0.5, 0.0, 0.4]))
    }

    #[test]
    fn the_lane_beside_is_not_taken_for_its_own() {
        let mut own = OwnLane::seen(&lane(-0.38), Motion::default());
        assert!(own.mend(&OwnLane::seen(&lane(-0.36), Motion::default())), "this one");
        assert!((own.car_left_m() - 0.36).abs() < 1e-6, "its own, seen better: {own:?}");
        assert!(!own.mend(&OwnLane::seen(&lane(0.03), Motion::default())), "the other one");
        assert!((own.car_left_m() - 0.37).abs() < 1e-6, "the left lane was seen: {own:?}");
        let curvature = f64::from(own.ground().curvature_per_m);
        assert!((curvature - 0.5 / 1.2).abs() < 1e-3, "0.4 m farther from the middle of the circle: {curvature} 1/m");
    }

    #[test]
    fn blind_driving_is_counted_until_it_is_seen_again() {
        let mut own = OwnLane::seen(&lane(0.0), Motion::default());
        for _ in 0..10 {
            own.move_on(Motion { way_m: 0.02, turn_rad: 0.0 });
        }
        assert!((own.blind_m() - 0.2).abs() < 1e-9, "{own:?}");
        own.mend(&OwnLane::seen(&lane(0.0), Motion { way_m: 0.02, turn_rad: 0.0 }));
        assert_eq!(own.blind_m(), 0.0, "seen");
    }
}
