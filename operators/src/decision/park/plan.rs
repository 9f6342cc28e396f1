//! The way into a gap, as arcs: found backwards, from the place in the gap out to where the car drives past. A way out, driven
//! backwards, is a way in.
//!
//! Out of a parallel gap: left ahead and right back in turn until the front passes what stands before the gap, then left, straight on,
//! right, until the car is parallel to the row again. Out of a perpendicular bay: straight ahead, right ahead, and left back until it
//! is parallel.

use std::f64::consts::FRAC_PI_2;

use serde::{Deserialize, Serialize};

use super::geometry::{Car, Gap, Place};

/// Along a way, the car is looked at after each of these, m.
const STEP_M: f64 = 0.01;
/// Ends of moves between the neighbours are found to this, m.
const FINE_M: f64 = 0.0025;
/// A pair of moves that turns the car by less leads nowhere, m of way.
const LEAST_PAIR_M: f64 = 0.008;
/// A shorter move is none, m.
const LEAST_MOVE_M: f64 = 0.004;
/// Steepest the car stands to the row on its way into a parallel gap, degrees.
const STEEPEST_DEG: u32 = 65;

/// A correction has so many moves at most ...
const CORRECTING_MOVES: usize = 4;
/// ... none of them longer than this, m, ...
const LONGEST_CORRECTION_M: f64 = 0.3;
/// ... and each must bring the car so much nearer to its place, m.
const MOVE_COST_M: f64 = 0.001;

/// How the neighbours stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Behind each other, along the lane.
    Parallel,
    /// Beside each other, across the lane.
    Perpendicular,
}

/// One move: an arc, ahead or back.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Move {
    /// Where it begins, row frame.
    pub from: Place,
    /// 1/m, + to the left.
    pub curvature_per_m: f64,
    /// m, below 0 when the car goes back.
    pub way_m: f64,
}

impl Move {
    /// Where it ends.
    pub fn to(&self) -> Place {
        self.from.after(self.way_m, self.curvature_per_m)
    }

    fn back(&self) -> Self {
        Self { from: self.to(), way_m: -self.way_m, ..*self }
    }
}

/// What a plan keeps to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// From the neighbours, m.
    pub margin_m: f64,
    /// Reversals of direction at most.
    pub max_moves: u32,
}

/// Where the car shall stand in a gap, row frame: in the middle of it; parallel, its flank in line with those of the neighbours;
/// perpendicular, its front in line with theirs.
pub fn place_in(gap: &Gap, car: &Car, kind: Kind) -> Place {
    match kind {
        Kind::Parallel => Place::new(gap.middle_m() - car.middle_m(), gap.flank_m() - car.width_m / 2.0, 0.0),
        Kind::Perpendicular => Place::new(gap.middle_m(), gap.flank_m() - car.front_m, FRAC_PI_2),
    }
}

/// The moves into a gap from a place beside the row: the first leads along the row to where the way in begins. `None`: there is no way in.
pub fn into_gap(start: Place, gap: &Gap, car: &Car, kind: Kind, limits: &Limits) -> Option<Vec<Move>> {
    let place = place_in(gap, car, kind);
    if !gap.clears(car, place, limits.margin_m) {
        return None;
    }
    let out = match kind {
        Kind::Parallel => out_of_parallel(place, start, gap, car, limits),
        Kind::Perpendicular => out_of_perpendicular(place, start, gap, car, limits),
    }?;
    let mut moves: Vec<Move> = out.iter().rev().map(Move::back).collect();
    let begin = moves.first()?.from;
    let [ahead_m, _] = start.seen([begin.x_m, begin.y_m]);
    if ahead_m.abs() > LEAST_MOVE_M {
        moves.insert(0, Move { from: begin.after(-ahead_m, 0.0), curvature_per_m: 0.0, way_m: ahead_m });
    }
    Some(moves)
}

/// The shortest gap that has a way in, from a place so far beside the row, m, to half a centimetre; none up to `most_m`: `most_m`.
pub fn needed_m(beside_m: f64, car: &Car, kind: Kind, limits: &Limits, most_m: f64) -> f64 {
    let fits = |length_m: f64| {
        let gap = Gap { from_m: 0.0, to_m: length_m, rear_flank_m: 0.0, front_flank_m: 0.0 };
        into_gap(Place::new(0.0, beside_m, 0.0), &gap, car, kind, limits).is_some()
    };
    let (mut low, mut high) = (0.0, most_m);
    while high - low > 0.005 {
        let middle = f64::midpoint(low, high);
        if fits(middle) { high = middle } else { low = middle }
    }
    high
}

/// How often the direction changes along the moves.
pub fn reversals(moves: &[Move]) -> u32 {
    moves.windows(2).filter(|pair| (pair[0].way_m > 0.0) != (pair[1].way_m > 0.0)).count() as u32
}

/// Straight out when there is room to go back first; else left and right in turn, from where it stands.
fn out_of_parallel(place: Place, start: Place, gap: &Gap, car: &Car, limits: &Limits) -> Option<Vec<Move>> {
    let straight_back = {
        let way_m = -free_m(place, 0.0, -1.0, gap, car, limits.margin_m);
        let mut moves = Vec::new();
        push(&mut moves, place, 0.0, way_m);
        shuffle_out(moves, place.after(way_m, 0.0), start, gap, car, limits)
    };
    let from_place = shuffle_out(Vec::new(), place, start, gap, car, limits);
    let turns = |way: &Option<Vec<Move>>| way.as_ref().map_or(u32::MAX, |moves| reversals(moves));
    if turns(&straight_back) <= turns(&from_place) { straight_back } else { from_place }
}

fn shuffle_out(
    mut moves: Vec<Move>,
    mut at: Place,
    start: Place,
    gap: &Gap,
    car: &Car,
    limits: &Limits,
) -> Option<Vec<Move>> {
    let curvature = car.plan_curvature_per_m;
    // The way out itself ends with one reversal: after it the car drives along the row the other way.
    while reversals(&moves) < limits.max_moves {
        if let Some(way) = sweep_out(at, start, gap, car, limits.margin_m) {
            moves.extend(way);
            return Some(moves);
        }
        let ahead_m = free_m(at, curvature, 1.0, gap, car, limits.margin_m);
        push(&mut moves, at, curvature, ahead_m);
        at = at.after(ahead_m, curvature);
        let back_m = free_m(at, -curvature, -1.0, gap, car, limits.margin_m);
        push(&mut moves, at, -curvature, -back_m);
        at = at.after(-back_m, -curvature);
        if ahead_m + back_m < LEAST_PAIR_M {
            return None;
        }
    }
    None
}

/// Left to some heading, straight on, right to the heading and the side of `start`; the one that needs the least room along the row.
fn sweep_out(at: Place, start: Place, gap: &Gap, car: &Car, margin_m: f64) -> Option<[Move; 3]> {
    let curvature = car.plan_curvature_per_m;
    let mut best: Option<(f64, [Move; 3])> = None;
    for steepest in 1..=STEEPEST_DEG {
        let steepest = f64::from(steepest).to_radians();
        if steepest <= at.yaw_rad || steepest <= start.yaw_rad {
            continue;
        }
        let left = Move { from: at, curvature_per_m: curvature, way_m: (steepest - at.yaw_rad) / curvature };
        if !is_clear(&left, gap, car, margin_m) {
            break;
        }
        let right_m = (steepest - start.yaw_rad) / curvature;
        let rise_m = start.y_m - left.to().y_m - (start.yaw_rad.cos() - steepest.cos()) / curvature;
        if rise_m < 0.0 {
            break;
        }
        let straight = Move { from: left.to(), curvature_per_m: 0.0, way_m: rise_m / steepest.sin() };
        let right = Move { from: straight.to(), curvature_per_m: -curvature, way_m: right_m };
        let end_m = right.to().x_m;
        if best.is_none_or(|(best_m, _)| end_m < best_m)
            && is_clear(&straight, gap, car, margin_m)
            && is_clear(&right, gap, car, margin_m)
        {
            best = Some((end_m, [left, straight, right]));
        }
    }
    best.map(|(_, moves)| moves)
}

/// Straight ahead, right ahead, left back to the side and heading of `start`: with the shortest way straight ahead that is clear.
fn out_of_perpendicular(place: Place, start: Place, gap: &Gap, car: &Car, limits: &Limits) -> Option<Vec<Move>> {
    let curvature = car.plan_curvature_per_m;
    let (steps, radius_m) = (200, 1.0 / curvature);
    (0..=steps).find_map(|step| {
        let straight = Move { from: place, curvature_per_m: 0.0, way_m: FINE_M * 2.0 * f64::from(step) };
        // Right from 90 degrees to `least`, left back to the heading of `start`: the way to the side is given, `least` follows from it.
        let rise_m = start.y_m - straight.to().y_m;
        let cos = f64::midpoint(rise_m / radius_m, start.yaw_rad.cos());
        if !(0.0..=1.0).contains(&cos) {
            return None;
        }
        let least = cos.acos();
        let right = Move { from: straight.to(), curvature_per_m: -curvature, way_m: (FRAC_PI_2 - least) / curvature };
        let left = Move { from: right.to(), curvature_per_m: curvature, way_m: -(least - start.yaw_rad) / curvature };
        let moves = [straight, right, left];
        let clear = moves.iter().all(|way| is_clear(way, gap, car, limits.margin_m));
        (clear && least >= start.yaw_rad)
            .then(|| moves.into_iter().filter(|way| way.way_m.abs() > LEAST_MOVE_M).collect())
    })
}

/// Moves, ahead and back in turn, that end nearer to the place in the gap than where the car stands; none when there are no such.
pub fn correction(at: Place, gap: &Gap, car: &Car, kind: Kind, limits: &Limits) -> Vec<Move> {
    let place = place_in(gap, car, kind);
    let mut best = Found { cost: off(at, place), moves: Vec::new() };
    for direction in [1.0, -1.0] {
        search(at, direction, &mut Vec::new(), &mut best, &Task { place, gap, car, margin_m: limits.margin_m });
    }
    best.moves
}

struct Task<'a> {
    place: Place,
    gap: &'a Gap,
    car: &'a Car,
    margin_m: f64,
}

struct Found {
    cost: f64,
    moves: Vec<Move>,
}

/// How far a car stands from its place: a degree counts as a centimetre, and so does a centimetre to the side as two along the gap.
fn off(at: Place, place: Place) -> f64 {
    let seen = place.place_seen(at);
    0.5 * seen.x_m.abs() + seen.y_m.abs() + 0.01 * seen.yaw_rad.to_degrees().abs()
}

fn search(at: Place, direction: f64, moves: &mut Vec<Move>, best: &mut Found, task: &Task<'_>) {
    if moves.len() == CORRECTING_MOVES {
        return;
    }
    for share in [-1.0, -0.5, 0.0, 0.5, 1.0] {
        let curvature_per_m = share * task.car.plan_curvature_per_m;
        let free_m =
            free_m(at, curvature_per_m, direction, task.gap, task.car, task.margin_m).min(LONGEST_CORRECTION_M);
        // To the end, to a half, and to where it is beside its place.
        let beside_m = task.place.seen([at.x_m, at.y_m])[0] * -direction;
        for way_m in [free_m, 0.5 * free_m, beside_m] {
            if way_m < LEAST_PAIR_M || way_m > free_m {
                continue;
            }
            let way = Move { from: at, curvature_per_m, way_m: direction * way_m };
            moves.push(way);
            let cost = off(way.to(), task.place) + MOVE_COST_M * moves.len() as f64;
            if cost < best.cost {
                *best = Found { cost, moves: moves.clone() };
            }
            search(way.to(), -direction, moves, best, task);
            moves.pop();
        }
    }
}

fn push(moves: &mut Vec<Move>, from: Place, curvature_per_m: f64, way_m: f64) {
    if way_m.abs() > LEAST_MOVE_M {
        moves.push(Move { from, curvature_per_m, way_m });
    }
}

fn is_clear(way: &Move, gap: &Gap, car: &Car, margin_m: f64) -> bool {
    let steps = (way.way_m.abs() / STEP_M).ceil().max(1.0);
    (0..=steps as u32)
        .all(|step| gap.clears(car, way.from.after(way.way_m * f64::from(step) / steps, way.curvature_per_m), margin_m))
}

/// How far the car can go along an arc, `direction` 1 or -1, m.
pub fn free_m(from: Place, curvature_per_m: f64, direction: f64, gap: &Gap, car: &Car, margin_m: f64) -> f64 {
    let clear =
        |step: u32| gap.clears(car, from.after(direction * FINE_M * f64::from(step), curvature_per_m), margin_m);
    let last = (1..=400).take_while(|step| clear(*step)).last().unwrap_or(0);
    FINE_M * f64::from(last)
}

#[cfg(test)]
mod tests {
    use std::cmp::Ordering::{Equal, Greater, Less};

    use super::super::geometry::tests::car;
    use super::*;

    const LIMITS: Limits = Limits { margin_m: 0.015, max_moves: 16 };

    fn gap(length_m: f64) -> Gap {
        Gap { from_m: 0.0, to_m: length_m, rear_flank_m: 0.0, front_flank_m: 0.0 }
    }

    fn parallel(length_m: f64) -> Option<Vec<Move>> {
        into_gap(Place::new(0.3, 0.25, 0.0), &gap(length_m), &car(), Kind::Parallel, &LIMITS)
    }

    /// Each move begins where the one before ends, none touches, and the last ends in the place.
    fn is_sound(moves: &[Move], gap: &Gap, kind: Kind) {
        for pair in moves.windows(2) {
            let (end, begin) = (pair[0].to(), pair[1].from);
            let apart = (end.x_m - begin.x_m).hypot(end.y_m - begin.y_m) + (end.yaw_rad - begin.yaw_rad).abs();
            assert!(apart < 1e-6, "{end:?} is followed by {begin:?}");
        }
        for way in moves {
            for step in 0..=200 {
                let at = way.from.after(way.way_m * f64::from(step) / 200.0, way.curvature_per_m);
                assert!(gap.clears(&car(), at, LIMITS.margin_m - 0.003), "{at:?} of {way:?} is too near");
            }
            assert!(way.curvature_per_m.abs() <= car().plan_curvature_per_m + 1e-9, "{way:?} is too tight");
        }
        let (end, place) = (moves.last().expect("some").to(), place_in(gap, &car(), kind));
        assert!((end.x_m - place.x_m).hypot(end.y_m - place.y_m) < 1e-6, "{end:?} instead of {place:?}");
    }

    #[test]
    fn a_long_gap_is_entered_right_left_and_forward() {
        let moves = parallel(0.80).expect("there is a way");
        is_sound(&moves, &gap(0.80), Kind::Parallel);
        let signs: Vec<_> = moves.iter().map(|way| (way.way_m > 0.0, way.curvature_per_m.partial_cmp(&0.0))).collect();
        let (ahead, back) = (true, false);
        assert_eq!(signs[0], (ahead, Some(Equal)), "past the gap: {moves:?}");
        assert_eq!(signs[1], (back, Some(Less)), "back to the right");
        assert_eq!(signs[signs.len() - 2], (back, Some(Greater)), "back to the left");
        assert_eq!(signs[signs.len() - 1], (ahead, Some(Equal)), "forward to the middle");
        assert_eq!(reversals(&moves), 2, "two changes of direction");
    }

    #[test]
    fn shorter_gaps_take_more_moves_and_too_short_ones_have_no_way() {
        let mut before = 0;
        for length_m in [0.70, 0.60, 0.54, 0.50, 0.47] {
            let moves = parallel(length_m).expect("there is a way");
            is_sound(&moves, &gap(length_m), Kind::Parallel);
            assert!(reversals(&moves) >= before, "{length_m} m takes {} reversals, {before} before", reversals(&moves));
            before = reversals(&moves);
        }
        assert!((6..=LIMITS.max_moves).contains(&before), "{before} reversals");
        assert_eq!(parallel(0.43), None, "8 cm more than the car");
        assert_eq!(parallel(0.30), None, "shorter than the car");
        let few = Limits { max_moves: 3, ..LIMITS };
        let way = into_gap(Place::new(0.3, 0.25, 0.0), &gap(0.50), &car(), Kind::Parallel, &few);
        assert_eq!(way, None, "not with three");
    }

    #[test]
    fn the_needed_length_divides_those_with_a_way_from_those_without() {
        let needed = needed_m(0.25, &car(), Kind::Parallel, &LIMITS, 2.0);
        assert!((0.43..0.48).contains(&needed), "{needed} m");
        assert!(parallel(needed + 0.005).is_some() && parallel(needed - 0.01).is_none(), "around {needed} m");
        let few = Limits { max_moves: 2, ..LIMITS };
        let needed = needed_m(0.25, &car(), Kind::Parallel, &few, 2.0);
        assert!((0.55..0.75).contains(&needed), "with two reversals {needed} m");
    }

    #[test]
    fn a_correction_ends_nearer_to_the_place() {
        for length_m in [0.47, 0.55, 0.70] {
            let gap = gap(length_m);
            let place = place_in(&gap, &car(), Kind::Parallel);
            for (x, y, yaw_deg) in [(0.0, 0.015, 0.0), (0.01, 0.0, 3.0), (-0.01, -0.01, -2.0), (0.0, 0.02, 4.0_f64)] {
                let at = place.place(Place::new(x, y, yaw_deg.to_radians()));
                let limits = Limits { margin_m: 0.01, ..LIMITS };
                let moves = correction(at, &gap, &car(), Kind::Parallel, &limits);
                let end = place.place_seen(moves.last().map_or(at, Move::to));
                let text = format!("from {x} {y} {yaw_deg} in {length_m}: {end:?} by {moves:?}");
                // In a gap of which little is left, four moves do little.
                let least = if length_m < 0.5 { 1.0 } else { 0.7 };
                assert!(off(end, Place::default()) <= least * off(at, place), "{text}");
                assert!(length_m < 0.6 || (end.y_m.abs() < 0.008 && end.yaw_rad.abs() < 0.02), "{text}");
            }
        }
    }

    #[test]
    fn a_perpendicular_bay_is_entered_from_a_swing_to_the_left() {
        for beside_m in [0.2, 0.25, 0.3] {
            let bay = gap(0.36);
            let moves =
                into_gap(Place::new(-0.2, beside_m, 0.02), &bay, &car(), Kind::Perpendicular, &LIMITS).expect("a way");
            is_sound(&moves, &bay, Kind::Perpendicular);
            assert_eq!(reversals(&moves), 1, "ahead, then back: {moves:?}");
        }
        let narrow = into_gap(Place::new(-0.2, 0.25, 0.0), &gap(0.20), &car(), Kind::Perpendicular, &LIMITS);
        assert_eq!(narrow, None, "as wide as the car");
    }
}
