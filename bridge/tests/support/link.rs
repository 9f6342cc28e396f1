//! The operator `mcu-link` as the tests run it: without an executor, stepped by hand.
#![allow(dead_code, reason = "each test program uses a part of it")]

use std::sync::Arc;

use carril_bridge::{McuLink, McuLinkConfig, McuLinkInputs, McuLinkOutputs};
use carril_messages::{Command, Header, Message, Meta, Origins, Stamp, WheelTelemetry};
use carril_runtime::{Context, HeapPool, Operator, Setup, StepError, Trigger};

/// A header as any sample of that type has it.
pub fn header<T: Message>(stamp: Stamp) -> Header {
    Header { epoch: 1, seq: 0, stamp, origins: Origins::none(), message_type: T::TYPE, meta: Meta::new() }
}

/// The operator with its ports.
pub struct Link {
    pub operator: McuLink,
    pub inputs: McuLinkInputs,
    pub outputs: McuLinkOutputs,
    /// What its last step said.
    pub last: Result<(), StepError>,
    /// All that it has told.
    pub telemetry: Vec<Arc<WheelTelemetry>>,
}

impl Link {
    /// A new one.
    pub fn new(config: McuLinkConfig, setup: &Setup) -> Self {
        Self {
            operator: McuLink::new(config, setup).expect("the threads start"),
            inputs: McuLinkInputs::default(),
            outputs: McuLinkOutputs::default(),
            last: Ok(()),
            telemetry: Vec::new(),
        }
    }

    /// A step, with a new command if there is one.
    pub fn step(&mut self, command: Option<Command>, now: Stamp) {
        if let Some(command) = command {
            self.inputs.command.put(command, header::<Command>(now));
        }
        let context = Context::new(now, Trigger::Wake, &HeapPool);
        self.last = self.operator.step(&mut self.inputs, &mut self.outputs, &context);
        self.telemetry.extend(self.outputs.telemetry.sent());
    }
}
