//! Operators that show when and how often they step.

use std::time::Duration;

use carril_runtime::messages::{Control, Stamp, message};
use carril_runtime::{
    Context, NoInputs, NoOutputs, Operator, Registry, Setup, SetupError, StateError, StepError, Waker, inputs, outputs,
    stateless,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Nothing;

pub fn registry() -> Registry {
    Registry::new().with::<Ticker>().with::<Relay>().with::<Pair>().with::<Bomb>().with::<Moody>().with::<Insomniac>()
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Tick {
    pub number: u64,
}

message!(Tick, "test/Tick", 1);

outputs! {
    pub struct TickOutputs {
        /// Numbers.
        ticks: Tick,
    }
}

inputs! {
    pub struct TickInputs {
        /// Numbers.
        given: Tick [external],
    }
}

/// Counts.
pub struct Ticker {
    next: u64,
}

impl Operator for Ticker {
    const KIND: &'static str = "ticker";
    const SUMMARY: &'static str = "Counts";
    type Config = Nothing;
    type Inputs = NoInputs;
    type Outputs = TickOutputs;
    type State = u64;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { next: 0 })
    }

    fn period(_config: &Nothing) -> Option<Duration> {
        Some(Duration::from_millis(10))
    }

    fn step(&mut self, _: &mut NoInputs, outputs: &mut TickOutputs, context: &Context<'_>) -> Result<(), StepError> {
        // Words make it step too, but count nothing.
        if context.trigger() == carril_runtime::Trigger::Period {
            outputs.ticks.send_captured(Tick { number: self.next }, context.now());
            self.next += 1;
        }
        Ok(())
    }

    fn control(&mut self, _control: Control, _now: Stamp) {}

    fn snapshot(&self) -> u64 {
        self.next
    }

    fn restore(&mut self, next: u64) -> Result<(), StateError> {
        self.next = next;
        Ok(())
    }
}

/// Sends on each number.
pub struct Relay;

impl Operator for Relay {
    const KIND: &'static str = "relay";
    const SUMMARY: &'static str = "Sends on";
    type Config = Nothing;
    type Inputs = TickInputs;
    type Outputs = TickOutputs;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, inputs: &mut TickInputs, outputs: &mut TickOutputs, _: &Context<'_>) -> Result<(), StepError> {
        while let Some(tick) = inputs.given.take() {
            outputs.ticks.send(Tick { number: tick.number });
        }
        Ok(())
    }

    stateless!();
}

inputs! {
    pub struct PairInputs {
        /// Numbers.
        left: Tick,
        /// Numbers.
        right: Tick,
    }
}

/// Adds what it has at each step.
pub struct Pair;

impl Operator for Pair {
    const KIND: &'static str = "pair";
    const SUMMARY: &'static str = "Adds";
    type Config = Nothing;
    type Inputs = PairInputs;
    type Outputs = TickOutputs;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, inputs: &mut PairInputs, outputs: &mut TickOutputs, _: &Context<'_>) -> Result<(), StepError> {
        let left = inputs.left.latest().map_or(0, |tick| tick.number);
        let right = inputs.right.latest().map_or(0, |tick| tick.number);
        outputs.ticks.send(Tick { number: left + right });
        Ok(())
    }

    stateless!();
}

/// Panics at number 3.
pub struct Bomb;

impl Operator for Bomb {
    const KIND: &'static str = "bomb";
    const SUMMARY: &'static str = "Panics";
    type Config = Nothing;
    type Inputs = TickInputs;
    type Outputs = NoOutputs;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, inputs: &mut TickInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
        let number = inputs.given.take().map_or(0, |tick| tick.number);
        assert!(number != 3, "tick {number}");
        Ok(())
    }

    stateless!();
}

/// Fails at numbers 3 to 5.
pub struct Moody;

impl Operator for Moody {
    const KIND: &'static str = "moody";
    const SUMMARY: &'static str = "Fails for a while";
    type Config = Nothing;
    type Inputs = TickInputs;
    type Outputs = NoOutputs;

    fn new(_config: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, inputs: &mut TickInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
        match inputs.given.take().map(|tick| tick.number) {
            Some(number @ 3..=5) => Err(StepError::new(format!("tick {number}"))),
            _ => Ok(()),
        }
    }

    stateless!();
}

/// Wakes itself at every step.
pub struct Insomniac {
    waker: Waker,
}

impl Operator for Insomniac {
    const KIND: &'static str = "insomniac";
    const SUMMARY: &'static str = "Never sleeps";
    type Config = Nothing;
    type Inputs = NoInputs;
    type Outputs = NoOutputs;

    fn new(_config: Nothing, setup: &Setup) -> Result<Self, SetupError> {
        setup.waker.wake();
        Ok(Self { waker: setup.waker.clone() })
    }

    fn step(&mut self, _: &mut NoInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
        self.waker.wake();
        Ok(())
    }

    stateless!();
}
