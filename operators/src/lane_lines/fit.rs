//! From ridges to the lane: least squares around a prediction (iterated Kalman update with Cauchy weights), and, where there is no
//! prediction, a vote for every direction and curvature.

use nalgebra::Vector2;

use super::config::{LaneLinesConfig, Which};
use super::ridges::Ridge;
use crate::lane_curve::{CURVATURE, Covariance, Curve, HEADING, OFFSET, RATE, State, WIDTH};

/// Ridges farther from a line than these shares of the lane's width do not count, from iteration to iteration.
const GATES: [f64; 5] = [0.28, 0.20, 0.15, 0.12, 0.12];
/// A ridge this far from its line has half of the weight of one on it (Cauchy), share of the lane's width.
const HALF_WEIGHT: f64 = 0.06;
/// A ridge is wrong by this share of the lane's width, and by this much per metre of distance: the camera pitches.
const NOISE: (f64, f64) = (0.03, 0.025);
/// Usual change of a lane's curvature along it, 1/m² for a lane that is a metre wide. Keeps the far end calm.
const USUAL_RATE: f64 = 0.25;
/// The lane's width differs from the configured one by this share.
const WIDTH_SPREAD: f64 = 0.08;
/// Fewer rows with a line are no lane.
pub(crate) const MIN_ROWS: usize = 4;

/// Headings that are tried: as far as this to both sides, rad, in so many steps.
const HEADINGS: (f64, i32) = (0.8, 10);
/// Curvatures to both sides.
const CURVATURES: i32 = 4;
/// Bins of the vote in a lane's width, and how many widths it covers to both sides.
const BINS_PER_WIDTH: i32 = 16;
const REACH_WIDTHS: i32 = 3;
const BINS: usize = (2 * REACH_WIDTHS * BINS_PER_WIDTH + 1) as usize;
/// The car is this near to the lane's middle when it looks for it anew, lane widths.
const NEAR_WIDTHS: f64 = 0.7;

/// A lane that was found.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fit {
    pub state: State,
    pub covariance: Covariance,
    /// Rows with a ridge on a line of the lane.
    pub rows: usize,
    /// The farthest of them, ahead of the rear axle, m.
    pub seen_m: f64,
    pub left_seen: bool,
    pub right_seen: bool,
    /// Root mean square of the distances of its ridges from its lines, m.
    pub rms_m: f64,
}

/// The line nearest to a ridge, and its distance from it.
fn nearest_line(lines: &[f64], left_m: f64, width_m: f64) -> (usize, f64) {
    let distances = lines.iter().map(|line| left_m - line * width_m).enumerate();
    distances.min_by(|a, b| a.1.abs().total_cmp(&b.1.abs())).expect("a lane has lines")
}

/// Fits the lane to the ridges, beginning at a prediction with its uncertainty. `None`: there is no line where it is expected.
pub(crate) fn fit(
    predicted: &State,
    uncertainty: &Covariance,
    ridges: &[Ridge],
    config: &LaneLinesConfig,
) -> Option<Fit> {
    let known = uncertainty.try_inverse()?;
    let lines = config.lane.lines();
    let usual_rate = USUAL_RATE / (config.lane_width_m * config.lane_width_m);
    let spread_m = WIDTH_SPREAD * config.lane_width_m;
    let sharpest = 1.0 / config.min_radius_m;
    let mut state = *predicted;
    let mut information = known;
    for gate in GATES {
        information = known;
        let mut slope = known * (state - predicted);
        information[(RATE, RATE)] += usual_rate.powi(-2);
        slope[RATE] += state[RATE] * usual_rate.powi(-2);
        information[(WIDTH, WIDTH)] += spread_m.powi(-2);
        slope[WIDTH] += (state[WIDTH] - config.lane_width_m) * spread_m.powi(-2);
        let curve = Curve::new(&state);
        for ridge in ridges {
            let seen = curve.locate(Vector2::new(ridge.ahead_m, ridge.left_m));
            let (line, error_m) = nearest_line(lines, seen.left_m, state[WIDTH]);
            if error_m.abs() > gate * config.lane_width_m {
                continue;
            }
            let noise_m = NOISE.0 * config.lane_width_m + NOISE.1 * ridge.ahead_m.abs();
            let odd = error_m / (HALF_WEIGHT * config.lane_width_m);
            let weight = 1.0 / ((1.0 + odd * odd) * noise_m * noise_m);
            let mut gradient = seen.gradient;
            gradient[WIDTH] = -lines[line];
            information += gradient * gradient.transpose() * weight;
            slope += gradient * (error_m * weight);
        }
        state -= information.cholesky()?.solve(&slope);
        state[CURVATURE] = state[CURVATURE].clamp(-sharpest, sharpest);
        if !state.iter().all(|value| value.is_finite()) {
            return None;
        }
    }
    judge(state, information.try_inverse()?, ridges, config)
}

/// What speaks for a lane.
fn judge(state: State, covariance: Covariance, ridges: &[Ridge], config: &LaneLinesConfig) -> Option<Fit> {
    let mut fit = Fit { state, covariance, rows: 0, seen_m: 0.0, left_seen: false, right_seen: false, rms_m: 0.0 };
    let curve = Curve::new(&state);
    let lines = config.lane.lines();
    let (mut count, mut square, mut last_row) = (0_u32, 0.0, None);
    let mut sides = [0_usize; 2];
    for ridge in ridges {
        let left_m = curve.left_of(Vector2::new(ridge.ahead_m, ridge.left_m));
        let (line, error_m) = nearest_line(lines, left_m, state[WIDTH]);
        if error_m.abs() > GATES[GATES.len() - 1] * config.lane_width_m {
            continue;
        }
        count += 1;
        square += error_m * error_m;
        if config.lane == Which::Follow {
            sides = [sides[0] + 1, sides[1] + 1];
        } else if line < 2 {
            sides[line] += 1;
        }
        if last_row != Some(ridge.row) {
            last_row = Some(ridge.row);
            fit.rows += 1;
        }
        fit.seen_m = fit.seen_m.max(ridge.ahead_m);
    }
    if fit.rows < MIN_ROWS {
        return None;
    }
    fit.rms_m = (square / f64::from(count)).sqrt();
    [fit.left_seen, fit.right_seen] = sides.map(|rows| rows >= MIN_ROWS - 1);
    Some(fit)
}

/// Looks for the lane without a prediction.
pub(crate) fn search(ridges: &[Ridge], config: &LaneLinesConfig) -> Option<Fit> {
    let width = config.lane_width_m;
    let sharpest = 1.0 / config.min_radius_m;
    let mut best: Option<(f64, State)> = None;
    for heading in -HEADINGS.1..=HEADINGS.1 {
        for curvature in -CURVATURES..=CURVATURES {
            let (turned, bent) =
                (f64::from(heading) / f64::from(HEADINGS.1), f64::from(curvature) / f64::from(CURVATURES));
            let state = State::from([0.0, turned * HEADINGS.0, bent * sharpest, 0.0, width]);
            let votes = vote(&Curve::new(&state), ridges, width);
            let (score, offset_m) = best_offset(&votes, config);
            let score = score - ridges.len() as f64 * (0.05 * turned * turned + 0.05 * bent * bent);
            if best.is_none_or(|(best, _)| score > best) {
                best = Some((score, state + State::from([offset_m, 0.0, 0.0, 0.0, 0.0])));
            }
        }
    }
    let (_, state) = best?;
    // Wide: the vote has looked at the same ridges, and shall not count twice.
    let spread = [0.5 * width, 0.5, sharpest, USUAL_RATE / (width * width), WIDTH_SPREAD * width];
    let uncertainty = Covariance::from_diagonal(&State::from(spread.map(|value| value * value)));
    fit(&state, &uncertainty, ridges, config)
}

/// How many ridges lie at which distance from a curve.
fn vote(curve: &Curve, ridges: &[Ridge], width_m: f64) -> [f64; BINS] {
    let mut votes = [0.0; BINS];
    for ridge in ridges {
        let left_m = curve.left_of(Vector2::new(ridge.ahead_m, ridge.left_m));
        let bin = left_m / width_m * f64::from(BINS_PER_WIDTH) + (BINS / 2) as f64;
        // Both neighbours share it.
        if bin >= 0.0 && bin < (BINS - 1) as f64 {
            let (low, share) = (bin as usize, bin.fract());
            votes[low] += 1.0 - share;
            votes[low + 1] += share;
        }
    }
    votes
}

/// The offset of the lane's middle for which most ridges lie on its lines.
fn best_offset(votes: &[f64; BINS], config: &LaneLinesConfig) -> (f64, f64) {
    let total: f64 = votes.iter().sum();
    let at = |bin: i32| usize::try_from(bin).ok().and_then(|bin| votes.get(bin)).copied().unwrap_or(0.0);
    let around = |bin: i32| at(bin) + 0.5 * (at(bin - 1) + at(bin + 1));
    let near = (NEAR_WIDTHS * f64::from(BINS_PER_WIDTH)) as i32;
    let mut best = (f64::NEG_INFINITY, 0.0);
    for offset in -near..=near {
        let middle = (BINS / 2) as i32 + offset;
        let lines = config.lane.lines().iter().enumerate();
        let on_lines: f64 = lines
            .map(|(index, line)| {
                let found = around(middle + (line * f64::from(BINS_PER_WIDTH)).round() as i32);
                if index < 2 { found } else { 0.5 * found }
            })
            .sum();
        let share = f64::from(offset) / f64::from(BINS_PER_WIDTH);
        let score = on_lines - 0.4 * total * share * share;
        if score > best.0 {
            best = (score, share * config.lane_width_m);
        }
    }
    best
}

/// A prediction about which nothing is known for the time `drift`: how far it may be off, per metre of lane width.
pub(crate) fn spread(way_m: f64, by_odometry: bool, config: &LaneLinesConfig) -> Covariance {
    let (aside, turned) = if by_odometry { (0.05, 0.2) } else { (0.3, 1.5) };
    let scale = config.lane_width_m;
    let mut spread = Covariance::zeros();
    for (index, deviation) in [
        (OFFSET, 0.01 * scale + aside * way_m),
        (HEADING, 0.01 + turned * way_m),
        (CURVATURE, 0.05 + 1.5 * way_m),
        (RATE, 0.1 + 4.0 * way_m),
        (WIDTH, 0.005 * scale),
    ] {
        spread[(index, index)] = deviation * deviation;
    }
    spread
}
