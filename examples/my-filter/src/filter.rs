//! The operator `my-filter`: smooths lane estimates, and bridges frames without a lane. Pure: estimates and the time in,
//! estimates out; no clock, no thread, no Zenoh.

use carril_runtime::messages::{LaneEstimate, Stamp};
use carril_runtime::{Context, Findings, Operator, OperatorConfig, Setup, SetupError, StateError, StepError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What can be set in the graph file, below `config`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FilterConfig {
    /// Share of the last estimate that goes into the next, 0 (none) to 0.95.
    #[schemars(range(min = 0, max = 0.95), extend("unit" = ""))]
    pub smoothing: f64,
    /// So long the last lane stands in for a missing one, ms, 0 to 1000.
    #[schemars(range(min = 0, max = 1000), extend("unit" = "ms"))]
    pub hold_ms: f64,
}

impl Default for FilterConfig {
    fn default() -> Self {
        Self { smoothing: 0.3, hold_ms: 70.0 }
    }
}

impl OperatorConfig for FilterConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("smoothing", self.smoothing, 0.0, 0.95, "");
        findings.range("hold_ms", self.hold_ms, 0.0, 1000.0, "ms");
    }
}

carril_runtime::inputs! {
    /// What the filter reads.
    pub struct FilterInputs {
        /// Estimates as a detector gives them.
        lane: LaneEstimate,
    }
}

carril_runtime::outputs! {
    /// What the filter gives.
    pub struct FilterOutputs {
        /// One estimate per estimate.
        lane: LaneEstimate,
    }
}

/// What a successor takes over when the node is swapped. Raise `STATE_VERSION` when its fields change.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FilterState {
    /// The last estimate with a lane, smoothed, and when it was given.
    last: Option<(LaneEstimate, Stamp)>,
}

/// Smooths lane estimates.
pub struct Filter {
    config: FilterConfig,
    state: FilterState,
}

impl Operator for Filter {
    const KIND: &'static str = "my-filter";
    const SUMMARY: &'static str = "smooths lane estimates, and bridges frames without a lane";
    const STATE_VERSION: u32 = 1;

    type Config = FilterConfig;
    type Inputs = FilterInputs;
    type Outputs = FilterOutputs;
    type State = FilterState;

    fn new(config: FilterConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { config, state: FilterState::default() })
    }

    fn step(
        &mut self,
        inputs: &mut FilterInputs,
        outputs: &mut FilterOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(estimate) = inputs.lane.take() {
            outputs.lane.send(self.filter(&estimate, context.now()));
        }
        Ok(())
    }

    fn snapshot(&self) -> FilterState {
        self.state.clone()
    }

    fn restore(&mut self, state: FilterState) -> Result<(), StateError> {
        let lane = state.last.as_ref().and_then(|(estimate, _)| estimate.lane);
        if lane.is_some_and(|lane| !lane.angle_rad.is_finite() || !lane.distance_px.is_finite()) {
            return Err(StateError::new(format!("the last lane is no number: {lane:?}")));
        }
        self.state = state;
        Ok(())
    }
}

impl Filter {
    fn filter(&mut self, estimate: &LaneEstimate, now: Stamp) -> LaneEstimate {
        let Some(mut lane) = estimate.lane else { return self.held(estimate, now) };
        if let Some(last) = self.state.last.as_ref().and_then(|(last, _)| last.lane) {
            lane.angle_rad = self.smooth(last.angle_rad, lane.angle_rad);
            lane.distance_px = self.smooth(last.distance_px, lane.distance_px);
            lane.distance_m = match (last.distance_m, lane.distance_m) {
                (Some(last), Some(new)) => Some(self.smooth(last, new)),
                (_, new) => new,
            };
        }
        let smoothed = LaneEstimate { lane: Some(lane), ..estimate.clone() };
        self.state.last = Some((smoothed.clone(), now));
        smoothed
    }

    /// The last lane while it is fresh, at half its quality; else the estimate as it came.
    fn held(&mut self, estimate: &LaneEstimate, now: Stamp) -> LaneEstimate {
        let fresh = |given: Stamp| now.since(given).as_secs_f64() * 1e3 <= self.config.hold_ms;
        match &self.state.last {
            Some((last, given)) if fresh(*given) => LaneEstimate { quality: last.quality / 2.0, ..last.clone() },
            _ => {
                self.state.last = None;
                estimate.clone()
            }
        }
    }

    fn smooth(&self, last: f32, new: f32) -> f32 {
        (self.config.smoothing * f64::from(last) + (1.0 - self.config.smoothing) * f64::from(new)) as f32
    }
}

#[cfg(test)]
mod tests {
    use carril_runtime::messages::{Centroid, Header, Lane, Message, Meta, Origins, SourceId};
    use carril_runtime::{HeapPool, Trigger};

    use super::*;

    fn estimate(distance_px: Option<f32>) -> LaneEstimate {
        let centroid = |ahead_px| Centroid { left_px: 0.0, ahead_px, pixels: 9 };
        let lane = distance_px.map(|distance_px| Lane {
            angle_rad: 0.0,
            distance_px,
            distance_m: None,
            ground: None,
            far: centroid(120.0),
            near: centroid(70.0),
        });
        LaneEstimate { lane, quality: if lane.is_some() { 1.0 } else { 0.0 }, threshold: None }
    }

    /// Feeds one estimate at a time, ms, and gives the answer.
    fn answer(filter: &mut Filter, at_ms: i64, distance_px: Option<f32>) -> Option<f32> {
        let (mut inputs, mut outputs) = (FilterInputs::default(), FilterOutputs::default());
        let stamp = Stamp::from_nanos(at_ms * 1_000_000);
        let origins = Origins::captured(SourceId::of("world", "camera"), stamp);
        let header = Header { epoch: 1, seq: 0, stamp, origins, message_type: LaneEstimate::TYPE, meta: Meta::new() };
        inputs.lane.put(estimate(distance_px), header);
        let context = Context::new(stamp, Trigger::Input, &HeapPool);
        filter.step(&mut inputs, &mut outputs, &context).expect("an estimate is no error");
        let sent = outputs.lane.sent();
        assert_eq!(sent.len(), 1, "one answer per estimate");
        sent[0].lane.map(|lane| lane.distance_px)
    }

    fn filter() -> Filter {
        Filter::new(FilterConfig { smoothing: 0.5, hold_ms: 50.0 }, &Setup::for_tests("filter"))
            .expect("the bounds hold")
    }

    #[test]
    fn follows_slowly_and_bridges_a_short_gap() {
        let mut filter = filter();
        assert_eq!(answer(&mut filter, 0, Some(10.0)), Some(10.0), "the first as it is");
        assert_eq!(answer(&mut filter, 30, Some(20.0)), Some(15.0), "then half way");
        assert_eq!(answer(&mut filter, 60, None), Some(15.0), "held for 50 ms");
        assert_eq!(answer(&mut filter, 90, None), None, "and no longer");
        assert_eq!(answer(&mut filter, 120, Some(40.0)), Some(40.0), "then it begins anew");
    }

    #[test]
    fn a_successor_goes_on_with_the_last_estimate() {
        let mut first = filter();
        answer(&mut first, 0, Some(10.0));
        let mut second = filter();
        second.restore(first.snapshot()).expect("its own state");
        assert_eq!(answer(&mut second, 30, Some(20.0)), Some(15.0), "smoothed with what the first saw");
        let broken = FilterState { last: Some((estimate(Some(f32::NAN)), Stamp::ZERO)) };
        assert!(second.restore(broken).is_err(), "a state that is no number is refused");
    }

    #[test]
    fn every_bound_of_the_configuration_is_checked() {
        let problems = |smoothing, hold_ms| {
            let mut findings = Findings::new(std::path::Path::new("."), false);
            FilterConfig { smoothing, hold_ms }.check(&mut findings);
            findings.into_found().len()
        };
        assert_eq!(problems(0.3, 70.0), 0, "the defaults pass");
        assert_eq!((problems(1.0, 70.0), problems(f64::NAN, 70.0), problems(0.3, -1.0)), (1, 1, 1), "the bounds");
    }
}
