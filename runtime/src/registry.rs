//! Operators by name, with their types erased: what the graph checker and the executors work with.

use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use carril_messages::{CodecError, Control, Origins, Stamp, codec};
use serde_json::Value;

use crate::config::{Finding, Findings, OperatorConfig};
use crate::describe::OperatorDescription;
use crate::intern::intern;
use crate::operator::{Context, Operator, SetupError, StateError, StepError};
use crate::ports::{Held, Incoming, InputPorts, InputSpec, Outgoing, OutputPorts, OutputSpec};
use crate::setup::Setup;

/// An operator whose types are known only at run time, with its ports.
pub trait ErasedOperator: Send {
    /// Puts a sample into an input port.
    fn accept(&mut self, port: usize, incoming: Incoming) -> Result<(), CodecError>;
    /// Tells an input port the time and its limit, before a step.
    fn begin(&mut self, now: Stamp, max_age: &dyn Fn(usize) -> Option<Duration>);
    /// Runs a step.
    fn step(&mut self, context: &Context<'_>) -> Result<(), StepError>;
    /// The exposures that the last step read from.
    fn take_used(&mut self) -> Origins;
    /// Takes out what was sent, with the index of the port.
    fn drain(&mut self, take: &mut dyn FnMut(usize, Outgoing));
    /// After a step whose outputs are out: the input ports let go of what they no longer need.
    fn end(&mut self) {}
    /// Samples withheld because they were too old, per input.
    fn stale(&mut self, port: usize) -> u64;
    /// Says which outputs are read by somebody.
    fn set_wanted(&mut self, wanted: &dyn Fn(usize) -> bool);
    /// Passes on a word from a person.
    fn control(&mut self, control: Control, now: Stamp);
    /// The state as bytes, with its version.
    fn snapshot(&self) -> Result<(u32, Vec<u8>), CodecError>;
    /// Takes over the state of a predecessor.
    fn restore(&mut self, version: u32, state: &[u8]) -> Result<(), StateError>;
    /// What the input ports hold, by index.
    fn held(&mut self) -> Vec<Held>;
    /// Takes over what the input ports of a predecessor held; what it held itself is gone.
    fn take_held(&mut self, held: Vec<Held>) -> Result<(), CodecError>;
    /// [`Operator::reconfigure`]
    fn reconfigure(&mut self, config: &Value) -> Option<Result<(), SetupError>>;
}

struct Host<O: Operator> {
    operator: O,
    inputs: O::Inputs,
    outputs: O::Outputs,
}

impl<O: Operator> ErasedOperator for Host<O> {
    fn accept(&mut self, port: usize, incoming: Incoming) -> Result<(), CodecError> {
        match self.inputs.port(port) {
            Some(input) => input.accept(incoming),
            None => Ok(()),
        }
    }

    fn begin(&mut self, now: Stamp, max_age: &dyn Fn(usize) -> Option<Duration>) {
        self.inputs.each(&mut |index, input| input.begin(now, max_age(index)));
    }

    fn step(&mut self, context: &Context<'_>) -> Result<(), StepError> {
        self.operator.step(&mut self.inputs, &mut self.outputs, context)
    }

    fn take_used(&mut self) -> Origins {
        let mut used = Origins::none();
        self.inputs.each(&mut |_, input| used.merge(&input.take_used()));
        used
    }

    fn end(&mut self) {
        self.inputs.each(&mut |_, input| input.end());
    }

    fn drain(&mut self, take: &mut dyn FnMut(usize, Outgoing)) {
        self.outputs.each(&mut |index, output| output.drain(&mut |outgoing| take(index, outgoing)));
    }

    fn stale(&mut self, port: usize) -> u64 {
        self.inputs.port(port).map_or(0, |input| input.stale())
    }

    fn set_wanted(&mut self, wanted: &dyn Fn(usize) -> bool) {
        self.outputs.each(&mut |index, output| output.set_wanted(wanted(index)));
    }

    fn control(&mut self, control: Control, now: Stamp) {
        self.operator.control(control, now);
    }

    fn snapshot(&self) -> Result<(u32, Vec<u8>), CodecError> {
        Ok((O::STATE_VERSION, codec::encode(&self.operator.snapshot())?))
    }

    fn restore(&mut self, version: u32, state: &[u8]) -> Result<(), StateError> {
        let state = if version == O::STATE_VERSION {
            codec::decode(state).map_err(StateError::new)?
        } else {
            O::migrate(version, state)?
        };
        self.operator.restore(state)
    }

    fn held(&mut self) -> Vec<Held> {
        let mut held = Vec::new();
        self.inputs.each(&mut |_, input| held.push(input.held()));
        held
    }

    fn take_held(&mut self, held: Vec<Held>) -> Result<(), CodecError> {
        self.inputs = O::Inputs::default();
        for (port, held) in held.into_iter().enumerate() {
            let Some(input) = self.inputs.port(port) else { continue };
            if let Some(read) = held.read {
                input.accept_read(read)?;
            }
            for incoming in held.unread {
                input.accept(incoming)?;
            }
        }
        Ok(())
    }

    fn reconfigure(&mut self, config: &Value) -> Option<Result<(), SetupError>> {
        match read_config::<O>(config.clone()) {
            Ok(config) => self.operator.reconfigure(&config),
            Err(finding) => Some(Err(SetupError::new(finding.message))),
        }
    }
}

/// Stands in the place of an operator that is gone, or not yet there.
struct Vacant;

/// An operator that does nothing and has nothing.
pub(crate) fn vacant() -> Box<dyn ErasedOperator> {
    Box::new(Vacant)
}

impl ErasedOperator for Vacant {
    fn accept(&mut self, _port: usize, _incoming: Incoming) -> Result<(), CodecError> {
        Ok(())
    }

    fn begin(&mut self, _now: Stamp, _max_age: &dyn Fn(usize) -> Option<Duration>) {}

    fn step(&mut self, _context: &Context<'_>) -> Result<(), StepError> {
        Ok(())
    }

    fn take_used(&mut self) -> Origins {
        Origins::none()
    }

    fn drain(&mut self, _take: &mut dyn FnMut(usize, Outgoing)) {}

    fn stale(&mut self, _port: usize) -> u64 {
        0
    }

    fn set_wanted(&mut self, _wanted: &dyn Fn(usize) -> bool) {}

    fn control(&mut self, _control: Control, _now: Stamp) {}

    fn snapshot(&self) -> Result<(u32, Vec<u8>), CodecError> {
        Ok((0, Vec::new()))
    }

    fn restore(&mut self, _version: u32, _state: &[u8]) -> Result<(), StateError> {
        Ok(())
    }

    fn held(&mut self) -> Vec<Held> {
        Vec::new()
    }

    fn take_held(&mut self, _held: Vec<Held>) -> Result<(), CodecError> {
        Ok(())
    }

    fn reconfigure(&mut self, _config: &Value) -> Option<Result<(), SetupError>> {
        None
    }
}

/// One kind of operator: what the checker must know about it, and how to build it.
#[derive(Clone)]
pub struct OperatorKind {
    /// Name in the graph file.
    pub name: &'static str,
    /// One line on what it does.
    pub summary: &'static str,
    /// Input ports, in order.
    pub inputs: Vec<InputSpec>,
    /// Output ports, in order.
    pub outputs: Vec<OutputSpec>,
    /// Whose state its state is: kinds with the same name here take over from each other.
    pub state_name: &'static str,
    /// Version of its state.
    pub state_version: u32,
    /// [`Operator::STAYS_ON_CAR`]
    pub stays_on_car: bool,
    behaviour: Arc<dyn Behaviour>,
}

/// What a kind does, besides what it says of itself.
pub(crate) trait Behaviour: Send + Sync {
    /// [`OperatorKind::config_schema`]
    fn config_schema(&self) -> Value;
    /// [`OperatorKind::check_config`]
    fn check_config(&self, config: &Value, base_dir: &Path, probe_devices: bool) -> Vec<Finding>;
    /// [`OperatorKind::check_shape`]
    fn check_shape(&self, config: &Value) -> Option<Finding>;
    /// [`OperatorKind::period`]
    fn period(&self, config: &Value) -> Option<Duration>;
    /// [`OperatorKind::exclusive`]
    fn exclusive(&self, config: &Value) -> bool;
    /// [`OperatorKind::effective_config`]
    fn effective_config(&self, config: &Value) -> Value;
    /// [`OperatorKind::build`]
    fn build(&self, config: Value, setup: &Setup) -> Result<Box<dyn ErasedOperator>, SetupError>;
}

/// An operator of this program.
struct Typed<O>(PhantomData<fn() -> O>);

impl<O: Operator> Behaviour for Typed<O> {
    fn config_schema(&self) -> Value {
        schemars::schema_for!(O::Config).to_value()
    }

    fn check_config(&self, config: &Value, base_dir: &Path, probe_devices: bool) -> Vec<Finding> {
        match read_config::<O>(config.clone()) {
            Ok(config) => {
                let mut findings = Findings::new(base_dir, probe_devices);
                config.check(&mut findings);
                findings.into_found()
            }
            Err(finding) => vec![finding],
        }
    }

    fn check_shape(&self, config: &Value) -> Option<Finding> {
        read_config::<O>(config.clone()).err()
    }

    fn period(&self, config: &Value) -> Option<Duration> {
        read_config::<O>(config.clone()).ok().and_then(|config| O::period(&config))
    }

    fn exclusive(&self, config: &Value) -> bool {
        read_config::<O>(config.clone()).is_ok_and(|config| O::exclusive(&config))
    }

    fn effective_config(&self, config: &Value) -> Value {
        match read_config::<O>(config.clone()).map(serde_json::to_value) {
            Ok(Ok(effective)) => effective,
            _ => config.clone(),
        }
    }

    fn build(&self, config: Value, setup: &Setup) -> Result<Box<dyn ErasedOperator>, SetupError> {
        let config = read_config::<O>(config).map_err(|finding| SetupError::new(finding.message))?;
        let operator = O::new(config, setup)?;
        Ok(Box::new(Host { operator, inputs: O::Inputs::default(), outputs: O::Outputs::default() }))
    }
}

impl OperatorKind {
    /// The kind of an operator type.
    pub fn of<O: Operator>() -> Self {
        Self {
            name: O::KIND,
            summary: O::SUMMARY,
            inputs: O::Inputs::specs(),
            outputs: O::Outputs::specs(),
            state_name: O::STATE_NAME,
            state_version: O::STATE_VERSION,
            stays_on_car: O::STAYS_ON_CAR,
            behaviour: Arc::new(Typed::<O>(PhantomData)),
        }
    }

    /// A kind whose operator is in another program: what that said, and what asks it.
    pub(crate) fn described(operator: &OperatorDescription, behaviour: Arc<dyn Behaviour>) -> Self {
        Self {
            name: intern(&operator.name),
            summary: intern(&operator.summary),
            inputs: operator.inputs.clone(),
            outputs: operator.outputs.clone(),
            state_name: intern(if operator.state_name.is_empty() { &operator.name } else { &operator.state_name }),
            state_version: operator.state_version,
            stays_on_car: operator.stays_on_car,
            behaviour,
        }
    }

    /// JSON Schema of its configuration.
    pub fn config_schema(&self) -> Value {
        self.behaviour.config_schema()
    }

    /// Everything wrong with a configuration. When it does not even have the right shape, the first such finding comes
    /// alone, with the path at which it was found.
    pub fn check_config(&self, config: &Value, base_dir: &Path, probe_devices: bool) -> Vec<Finding> {
        self.behaviour.check_config(config, base_dir, probe_devices)
    }

    /// The first key or value of the wrong shape, as serde puts it; `None`: the shape is right, and `check_config` can look at
    /// the values.
    pub fn check_shape(&self, config: &Value) -> Option<Finding> {
        self.behaviour.check_shape(config)
    }

    /// How often the operator steps of its own accord with this configuration.
    pub fn period(&self, config: &Value) -> Option<Duration> {
        self.behaviour.period(config)
    }

    /// Whether an instance with this configuration holds something that no second one can have at the same time.
    pub fn exclusive(&self, config: &Value) -> bool {
        self.behaviour.exclusive(config)
    }

    /// The configuration with the defaults filled in. One of the wrong shape comes back as it is.
    pub fn effective_config(&self, config: &Value) -> Value {
        self.behaviour.effective_config(config)
    }

    /// Builds an instance.
    pub fn build(&self, config: Value, setup: &Setup) -> Result<Box<dyn ErasedOperator>, SetupError> {
        self.behaviour.build(config, setup)
    }

    /// Index of an input port.
    pub fn input(&self, name: &str) -> Option<usize> {
        self.inputs.iter().position(|port| port.name == name)
    }

    /// Index of an output port.
    pub fn output(&self, name: &str) -> Option<usize> {
        self.outputs.iter().position(|port| port.name == name)
    }
}

fn read_config<O: Operator>(config: Value) -> Result<O::Config, Finding> {
    let config = if config.is_null() { Value::Object(serde_json::Map::new()) } else { config };
    serde_path_to_error::deserialize(config).map_err(|error| {
        let path = crate::graph::path_segments(error.path());
        Finding { path, message: error.into_inner().to_string(), hint: None, missing_file: false }
    })
}

/// All kinds of operators that a program knows.
#[derive(Clone, Default)]
pub struct Registry(BTreeMap<&'static str, Arc<OperatorKind>>);

impl Registry {
    /// Knows nothing.
    pub fn new() -> Self {
        Self::default()
    }

    /// With one more kind. A kind of the same name is replaced.
    #[must_use]
    pub fn with<O: Operator>(mut self) -> Self {
        self.0.insert(O::KIND, Arc::new(OperatorKind::of::<O>()));
        self
    }

    /// With all kinds of another registry.
    #[must_use]
    pub fn and(mut self, other: Self) -> Self {
        self.0.extend(other.0);
        self
    }

    /// The kind of that name.
    pub fn get(&self, kind: &str) -> Option<&Arc<OperatorKind>> {
        self.0.get(kind)
    }

    /// All kinds, by name.
    pub fn iter(&self) -> impl Iterator<Item = &Arc<OperatorKind>> {
        self.0.values()
    }
}
