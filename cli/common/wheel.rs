//! Where the chain from sensor to wheel ends, and how old exposures are there. Pure.

use std::collections::HashSet;
use std::fmt;

use carril_messages::{Command, Header, Message, Percentiles, SourceId, Stamp};
use carril_runtime::graph::{Graph, GraphNode, PortRef};
use hdrhistogram::Histogram;

/// The end of the chain from sensor to wheel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WheelPath {
    /// The node that hands commands to the wheels: the bridge.
    pub wheel: String,
    /// The port that carries commands to it.
    pub command: PortRef,
    /// The sensor whose exposures count: that of the budget which ends at the wheel, else the camera. `None`: the oldest of all.
    pub sensor: Option<PortRef>,
}

impl fmt::Display for WheelPath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.sensor {
            Some(sensor) => write!(f, "{sensor} to {}", self.wheel),
            None => write!(f, "oldest exposure to {}", self.wheel),
        }
    }
}

/// The node that takes commands and gives none; in a graph without one, the last command that nobody takes.
pub fn path(graph: &Graph) -> Option<WheelPath> {
    let (wheel, command) = end_of_commands(graph)?;
    let budget = graph.budgets.iter().find(|budget| budget.to.node == wheel || budget.to == command);
    let camera = || {
        let image = |node: &GraphNode| Some(port_of_type(node, "carril/Image")?);
        graph.nodes.iter().filter(|node| !reads_images(node)).find_map(image)
    };
    let sensor = budget.map(|budget| budget.from.clone()).or_else(camera);
    Some(WheelPath { wheel, command, sensor })
}

fn end_of_commands(graph: &Graph) -> Option<(String, PortRef)> {
    let gives = |node: &GraphNode| port_of_type(node, &Command::TYPE.name);
    let takes = |node: &GraphNode| {
        let kind = node.kind()?;
        let is_command =
            |name: &str| kind.input(name).is_some_and(|port| kind.inputs[port].message_type == Command::TYPE);
        node.inputs.iter().find(|edge| is_command(&edge.input)).map(|edge| edge.from.clone())
    };
    let end = graph.nodes.iter().filter(|node| gives(node).is_none());
    if let Some((node, command)) = end.filter_map(|node| Some((node.name.clone(), takes(node)?))).next() {
        return Some((node, command));
    }
    let read: HashSet<&PortRef> =
        graph.nodes.iter().flat_map(|node| node.inputs.iter().map(|edge| &edge.from)).collect();
    let last = graph.nodes.iter().filter_map(gives).find(|port| !read.contains(port))?;
    Some((last.node.clone(), last))
}

fn port_of_type(node: &GraphNode, message_type: &str) -> Option<PortRef> {
    let port = node.kind()?.outputs.iter().find(|port| port.message_type.name == message_type && !port.on_demand)?;
    Some(PortRef { node: node.name.clone(), port: port.name.to_owned() })
}

fn reads_images(node: &GraphNode) -> bool {
    node.kind().is_some_and(|kind| kind.inputs.iter().any(|port| port.message_type.name == "carril/Image"))
}

/// Ages of exposures where the commands arrive.
pub struct AgeMeter {
    sensor: Option<SourceId>,
    window: Histogram<u64>,
    total: Histogram<u64>,
}

impl AgeMeter {
    /// Of the sensor that counts on this path.
    pub fn new(path: &WheelPath) -> Self {
        let sensor = path.sensor.as_ref().map(|port| SourceId::of(&port.node, &port.port));
        Self { sensor, window: histogram(), total: histogram() }
    }

    /// A command has come at `arrived`. One that derives from no exposure of the sensor changes nothing.
    pub fn record(&mut self, header: &Header, arrived: Stamp) {
        let captured = match self.sensor {
            Some(sensor) => header.origins.of(sensor),
            None => header.origins.oldest(),
        };
        let Some(captured) = captured else { return };
        let nanos = arrived.since(captured).as_nanos().max(0) as u64;
        self.window.saturating_record(nanos);
        self.total.saturating_record(nanos);
    }

    /// Ages since the last call, ms.
    pub fn take_window(&mut self) -> Option<Percentiles> {
        let percentiles = percentiles(&self.window);
        self.window.reset();
        percentiles
    }

    /// Ages since the start, ms.
    pub fn total(&self) -> Option<Percentiles> {
        percentiles(&self.total)
    }
}

fn histogram() -> Histogram<u64> {
    Histogram::new_with_bounds(1, 3_600_000_000_000, 3).expect("the bounds are valid")
}

fn percentiles(histogram: &Histogram<u64>) -> Option<Percentiles> {
    let ms = |nanos: u64| nanos as f64 * 1e-6;
    (!histogram.is_empty()).then(|| Percentiles {
        p50: ms(histogram.value_at_quantile(0.5)),
        p99: ms(histogram.value_at_quantile(0.99)),
        max: ms(histogram.max()),
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use carril_messages::{Meta, Origins};
    use carril_runtime::graph::ReadOptions;

    use super::*;
    use crate::common::registry;

    fn shipped(name: &str) -> Graph {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(name);
        Graph::read(&path, &registry::built_in(), &ReadOptions::default()).expect("what ships is clean")
    }

    fn port(node: &str, port: &str) -> PortRef {
        PortRef { node: node.into(), port: port.into() }
    }

    #[test]
    fn the_chain_of_the_default_graph_ends_at_the_bridge() {
        let (command, sensor) = (port("actuator", "command"), Some(port("world", "camera")));
        let expected = WheelPath { wheel: "bridge".into(), command, sensor };
        assert_eq!(path(&shipped("dataflow.yaml")), Some(expected), "from the camera, as the budget says");
    }

    #[test]
    fn without_a_bridge_the_last_command_counts() {
        let text = "robot: car1\nnodes:\n  actuator:\n    operator: actuator\n    inputs: { command: decision/command }\n  \
                    decision:\n    operator: decision\n    inputs: { lane: lane/lane }\n  lane:\n    operator: lane-detector\n    \
                    inputs: { image: camera/image }\n  camera:\n    operator: camera\n    config: { source: /dev/video0 }\n";
        let options = ReadOptions::default();
        let graph =
            Graph::parse(text.into(), Path::new("t.yaml"), &registry::built_in(), &options).expect("a clean graph");
        let found = path(&graph).expect("there are commands");
        assert_eq!((found.wheel.as_str(), found.command), ("actuator", port("actuator", "command")), "nobody takes it");
        assert_eq!(found.sensor, Some(port("camera", "image")), "the camera, not the detector's debug view");
    }

    #[test]
    fn only_exposures_of_the_sensor_count() {
        let path =
            WheelPath { wheel: "bridge".into(), command: port("a", "command"), sensor: Some(port("world", "camera")) };
        let mut meter = AgeMeter::new(&path);
        let mut origins = Origins::captured(SourceId::of("world", "scan"), Stamp::ZERO);
        let header = |origins: &Origins| {
            let (stamp, meta, origins) = (Stamp::ZERO, Meta::new(), origins.clone());
            Header { epoch: 0, seq: 0, stamp, origins, message_type: Command::TYPE, meta }
        };
        meter.record(&header(&origins), Stamp::from_nanos(90_000_000));
        assert_eq!(meter.take_window(), None, "a slow lidar is not charged to the camera");
        origins.merge(&Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(80_000_000)));
        meter.record(&header(&origins), Stamp::from_nanos(90_000_000));
        let age = meter.take_window().expect("one age");
        assert!((age.p50 - 10.0).abs() < 0.1, "10 ms after the exposure: {age:?}");
        assert_eq!(meter.take_window(), None, "a new window is empty");
        assert!(meter.total().is_some(), "the total is not");
    }
}
