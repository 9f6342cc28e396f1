//! carril's side of the benchmarks: a source of frames and a recording sink, as operators, and a process that runs nodes.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use carril_runtime::clock::LiveClock;
use carril_runtime::executor::live::{Environment, Executor};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::messages::{Command, Encoding, Image};
use carril_runtime::transport::zenoh::{self, ZenohOptions, ZenohTransport};
use carril_runtime::{
    Context, Findings, NoInputs, NoOutputs, Operator, OperatorConfig, Registry, Setup, SetupError, StepError, inputs,
    outputs, stateless,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::measure::{self, Recorder};

/// Settings of the source.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SourceConfig {
    width: u32,
    height: u32,
    colour: bool,
    period_ms: u64,
}

impl OperatorConfig for SourceConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("period_ms", self.period_ms as f64, 1.0, 1000.0, "ms");
    }
}

outputs! {
    /// What the source gives.
    pub struct SourceOutputs {
        /// A frame whose first eight bytes are the time of its making.
        image: Image,
    }
}

/// Makes frames whose first eight bytes are the time of their making.
pub struct Source(SourceConfig);

impl Operator for Source {
    const KIND: &'static str = "bench-source";
    const SUMMARY: &'static str = "makes frames that carry the time of their making";
    type Config = SourceConfig;
    type Inputs = NoInputs;
    type Outputs = SourceOutputs;

    fn new(config: SourceConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self(config))
    }

    fn period(config: &SourceConfig) -> Option<Duration> {
        Some(Duration::from_millis(config.period_ms))
    }

    fn step(&mut self, _: &mut NoInputs, out: &mut SourceOutputs, context: &Context<'_>) -> Result<(), StepError> {
        let encoding = if self.0.colour { Encoding::Bgr8 } else { Encoding::Mono8 };
        let size = self.0.width as usize * self.0.height as usize * encoding.bytes_per_pixel();
        let mut pixels = context.buffer(size);
        pixels[..8].copy_from_slice(&measure::monotonic_ns().to_le_bytes());
        let image = Image::packed(self.0.width, self.0.height, encoding, pixels.freeze()).map_err(StepError::new)?;
        out.image.send_captured(image, context.now());
        Ok(())
    }

    stateless!();
}

/// Settings of the sinks.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SinkConfig {
    count: usize,
}

impl OperatorConfig for SinkConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("count", self.count as f64, 1.0, 1e7, "");
    }
}

inputs! {
    /// What the sink reads.
    pub struct SinkInputs {
        /// Frames of the source.
        image: Image,
    }
}

/// Prints how long frames took from their making to its step.
pub struct Sink(Recorder);

impl Operator for Sink {
    const KIND: &'static str = "bench-sink";
    const SUMMARY: &'static str = "records how long frames took";
    type Config = SinkConfig;
    type Inputs = SinkInputs;
    type Outputs = NoOutputs;

    fn new(config: SinkConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self(Recorder::new(config.count)))
    }

    fn step(&mut self, inputs: &mut SinkInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
        while let Some(image) = inputs.image.take() {
            let sent_ns = u64::from_le_bytes(image.pixels()[..8].try_into().expect("eight bytes"));
            if let Some(series) = self.0.record(sent_ns) {
                series.print();
            }
        }
        Ok(())
    }

    stateless!();
}

/// Sends each frame on as it is.
pub struct Relay;

/// Nothing to choose.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Nothing {}

impl OperatorConfig for Nothing {
    fn check(&self, _: &mut Findings<'_>) {}
}

impl Operator for Relay {
    const KIND: &'static str = "bench-relay";
    const SUMMARY: &'static str = "sends frames on";
    type Config = Nothing;
    type Inputs = SinkInputs;
    type Outputs = SourceOutputs;

    fn new(_: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self)
    }

    fn step(&mut self, inputs: &mut SinkInputs, out: &mut SourceOutputs, _: &Context<'_>) -> Result<(), StepError> {
        if let Some(image) = inputs.image.take() {
            out.image.send(Image::clone(image.value()));
        }
        Ok(())
    }

    stateless!();
}

/// Prints when it got its first frame.
pub struct Arrival {
    told: bool,
}

impl Operator for Arrival {
    const KIND: &'static str = "bench-arrival";
    const SUMMARY: &'static str = "says when it got its first frame";
    type Config = Nothing;
    type Inputs = SinkInputs;
    type Outputs = NoOutputs;

    fn new(_: Nothing, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { told: false })
    }

    fn step(&mut self, inputs: &mut SinkInputs, _: &mut NoOutputs, _: &Context<'_>) -> Result<(), StepError> {
        if inputs.image.take().is_some() && !std::mem::replace(&mut self.told, true) {
            println!("{}", measure::monotonic_ns());
        }
        Ok(())
    }

    stateless!();
}

inputs! {
    /// What the command sink reads.
    pub struct CommandSinkInputs {
        /// Commands that derive from a camera.
        command: Command,
    }
}

/// Prints how long it took from exposure to each command that derives from a frame that no command derived from before.
pub struct CommandSink {
    recorder: Recorder,
    newest_exposure: Option<carril_runtime::messages::Stamp>,
}

impl Operator for CommandSink {
    const KIND: &'static str = "bench-command-sink";
    const SUMMARY: &'static str = "records how long it took from frame to command";
    type Config = SinkConfig;
    type Inputs = CommandSinkInputs;
    type Outputs = NoOutputs;

    fn new(config: SinkConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self { recorder: Recorder::new(config.count), newest_exposure: None })
    }

    fn step(
        &mut self,
        inputs: &mut CommandSinkInputs,
        _: &mut NoOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        while let Some(command) = inputs.command.take() {
            let exposure = command.header().origins.oldest();
            if exposure.is_none() || exposure <= self.newest_exposure {
                continue;
            }
            self.newest_exposure = exposure;
            let age_ns = command.age(context.now()).as_nanos().max(0) as u64;
            if let Some(series) = self.recorder.record(measure::monotonic_ns() - age_ns) {
                series.print();
            }
        }
        Ok(())
    }

    stateless!();
}

/// carril's operators and those of the benchmarks.
pub fn registry() -> Registry {
    carril_operators::registry().with::<Source>().with::<Sink>().with::<CommandSink>().with::<Relay>().with::<Arrival>()
}

/// The nodes of one process of a graph whose sockets lie in `dir`.
pub struct Process {
    _executor: Executor,
    _transport: ZenohTransport,
}

impl Process {
    /// Starts them. The process listens at `<dir>/<process>.sock` and connects to `connect`.
    pub fn start(dir: &Path, graph: &str, process: &str, connect: &[String]) -> Self {
        let path = dir.join("bench.yaml");
        let graph = Graph::parse(graph.to_owned(), &path, &registry(), &ReadOptions::default())
            .unwrap_or_else(|problems| panic!("the graph of a benchmark is valid: {problems}"));
        let transport = ZenohTransport::open(ZenohOptions {
            listen: Some(socket(dir, process)),
            connect: connect.iter().map(|name| socket(dir, name)).collect(),
            epoch: 1,
            ..ZenohOptions::default()
        })
        .expect("a session");
        let clock = Arc::new(LiveClock::with_anchor(
            Duration::from_nanos(measure::monotonic_ns()),
            carril_runtime::messages::Stamp::ZERO,
        ));
        let environment =
            Environment { transport: Arc::new(transport.clone()), clock, run_dir: Some(dir.to_owned()), seed: 1 };
        let (executor, _events) = Executor::start(&graph, process, &environment).expect("the nodes start");
        Self { _executor: executor, _transport: transport }
    }
}

/// The endpoint of a process.
pub fn socket(dir: &Path, process: &str) -> String {
    zenoh::endpoint(&dir.join(format!("{process}.sock")))
}
