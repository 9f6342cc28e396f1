//! Which channels a running graph has, and who reads what. Pure: the run in, topics out.

use std::collections::HashMap;

use carril_messages::{DecisionState, Image, LaneEstimate, LaserScan, Message, Sectors, VehicleState, dynamic};
use carril_runtime::control_plane::{LiveNode, NodeEntry};
use foxglove::websocket::ConnectionGraph;
use serde_json::Value;

use super::show::{BODY, LASER};

/// How a port is shown on one channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// foxglove.CompressedImage
    Picture,
    /// foxglove.LaserScan
    Scan,
    /// foxglove.ImageAnnotations
    Overlay,
    /// foxglove.PoseInFrame
    Pose,
    /// foxglove.SceneUpdate
    Scene,
    /// The message as it is, in JSON.
    Json,
    /// foxglove.FrameTransforms, on the channel that all share.
    Transform,
    /// foxglove.Log, on the channel that all share.
    Log,
}

/// A port of the graph that can be shown.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShownPort {
    /// The node.
    pub node: String,
    /// Its output.
    pub port: String,
    /// What it sends: `carril/Image`.
    pub message_type: String,
    /// Topic and form of its channels; the shared ones have no topic of their own.
    pub forms: Vec<(Option<String>, Form)>,
    /// Of an estimate of the lane: the image port that the detector reads. Of a scan and of a vehicle: its frame.
    pub about: Option<String>,
}

impl ShownPort {
    /// `lane/lane`
    pub fn name(&self) -> String {
        format!("{}/{}", self.node, self.port)
    }
}

/// The ports that can be shown. Those with a type that is not ours are left out: nobody can tell what their bytes mean.
pub fn ports(nodes: &[NodeEntry]) -> Vec<ShownPort> {
    let mut found: Vec<ShownPort> = Vec::new();
    for node in nodes {
        for output in &node.outputs {
            if dynamic::find(&output.message_type).is_none() {
                continue;
            }
            let first = !found.iter().any(|port| port.message_type == output.message_type);
            found.push(port(node, &output.port, &output.message_type, first));
        }
    }
    found
}

/// `first`: the first one of its type in the graph has the common name of a frame.
fn port(node: &NodeEntry, port: &str, message_type: &str, first: bool) -> ShownPort {
    let name = format!("{}/{port}", node.name);
    let frame = |common: &str| Some(if first { common.to_owned() } else { name.clone() });
    let own = |form| (Some(name.clone()), form);
    let beside = |what: &str, form| (Some(format!("{name}/{what}")), form);
    let (forms, about) = match message_type {
        of if of == Image::TYPE.name => (vec![own(Form::Picture)], None),
        of if of == LaserScan::TYPE.name => (vec![own(Form::Scan)], frame(LASER)),
        of if of == LaneEstimate::TYPE.name => {
            (vec![own(Form::Json), beside("overlay", Form::Overlay)], image_of(node))
        }
        of if of == Sectors::TYPE.name => (vec![own(Form::Json), beside("scene", Form::Scene)], None),
        of if of == VehicleState::TYPE.name => {
            (vec![own(Form::Json), beside("pose", Form::Pose), (None, Form::Transform)], frame(BODY))
        }
        of if of == DecisionState::TYPE.name => (vec![own(Form::Json), (None, Form::Log)], None),
        _ => (vec![own(Form::Json)], None),
    };
    ShownPort { node: node.name.clone(), port: port.to_owned(), message_type: message_type.to_owned(), forms, about }
}

/// The image that a detector reads; a node that makes images itself, its own first one.
fn image_of(node: &NodeEntry) -> Option<String> {
    let read =
        node.inputs.iter().filter(|input| input.message_type == Image::TYPE.name).find_map(|one| one.from.clone());
    let own = || node.outputs.iter().find(|output| output.message_type == Image::TYPE.name);
    read.or_else(|| own().map(|output| format!("{}/{}", node.name, output.port)))
}

/// Nodes publish ports and read them; an external input is read, and published by nobody.
pub fn connections(nodes: &[NodeEntry]) -> ConnectionGraph {
    let mut graph = ConnectionGraph::new();
    let mut readers: HashMap<String, Vec<&str>> = HashMap::new();
    for node in nodes {
        for output in &node.outputs {
            graph.set_published_topic(format!("{}/{}", node.name, output.port), [node.name.as_str()]);
        }
        for input in &node.inputs {
            let own = input.external.then(|| format!("{}/{}", node.name, input.port));
            for topic in own.into_iter().chain(input.from.clone()) {
                readers.entry(topic).or_default().push(&node.name);
            }
        }
    }
    for (topic, readers) in readers {
        graph.set_subscribed_topic(topic, readers);
    }
    graph
}

/// What the configuration of nodes says about what their ports show.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Facts {
    configs: HashMap<String, Value>,
}

impl Facts {
    /// From the graph as it runs.
    pub fn new(nodes: &[LiveNode]) -> Self {
        Self { configs: nodes.iter().map(|node| (node.name.clone(), node.config.clone())).collect() }
    }

    /// Where a lane detector looks, shares of the height from the top: far, near.
    pub fn rows(&self, node: &str) -> Option<[f64; 2]> {
        let config = self.configs.get(node)?;
        Some([config["row_far"].as_f64()?, config["row_near"].as_f64()?])
    }

    /// Up to where returns count in a sector, m.
    pub fn limit_m(&self, node: &str, sector: &str) -> Option<f64> {
        let sectors = self.configs.get(node)?["sectors"].as_array()?;
        sectors.iter().find(|one| one["name"] == sector)?["limit_m"].as_f64()
    }

    /// Direction of the lidar's x axis in the body frame, rad, + left, as the node that reads the scan has it; else 0.
    pub fn mounting_rad(&self, nodes: &[NodeEntry], scan: &str) -> f64 {
        let reads = |node: &&NodeEntry| node.inputs.iter().any(|input| input.from.as_deref() == Some(scan));
        let mounting = |node: &NodeEntry| self.configs.get(&node.name)?["mounting_deg"].as_f64();
        nodes.iter().filter(reads).find_map(mounting).map_or(0.0, f64::to_radians)
    }
}

#[cfg(test)]
mod tests {
    use carril_runtime::control_plane::{InputEntry, OutputEntry};
    use serde_json::json;

    use super::*;

    fn node(name: &str, inputs: &[(&str, &str, Option<&str>)], outputs: &[(&str, &str)]) -> NodeEntry {
        let input = |(port, of, from): &(&str, &str, Option<&str>)| InputEntry {
            port: (*port).into(),
            message_type: format!("carril/{of}"),
            from: from.map(str::to_owned),
            external: from.is_none(),
        };
        let output = |(port, of): &(&str, &str)| OutputEntry {
            port: (*port).into(),
            message_type: if of.contains('/') { (*of).into() } else { format!("carril/{of}") },
            on_demand: false,
        };
        NodeEntry {
            name: name.into(),
            operator: name.into(),
            exec: None,
            process: name.into(),
            machine: None,
            inputs: inputs.iter().map(input).collect(),
            outputs: outputs.iter().map(output).collect(),
        }
    }

    fn graph() -> Vec<NodeEntry> {
        let world =
            [("camera", "Image"), ("scan", "LaserScan"), ("vehicle", "VehicleState"), ("strange", "acme/Thing")];
        vec![
            node("world", &[], &world),
            node("lane", &[("image", "Image", Some("world/camera"))], &[("lane", "LaneEstimate")]),
            node("sectors", &[("scan", "LaserScan", Some("world/scan"))], &[("sectors", "Sectors")]),
            node("decision", &[("goal", "Goal", None)], &[("command", "Command"), ("state", "DecisionState")]),
            node("odometry", &[], &[("state", "VehicleState")]),
        ]
    }

    #[test]
    fn each_port_has_its_channels() {
        let topics: Vec<String> = ports(&graph())
            .iter()
            .flat_map(|port| {
                port.forms.iter().map(|(topic, form)| format!("{form:?} {}", topic.as_deref().unwrap_or("-")))
            })
            .collect();
        let expected = [
            "Picture world/camera",
            "Scan world/scan",
            "Json world/vehicle",
            "Pose world/vehicle/pose",
            "Transform -",
            "Json lane/lane",
            "Overlay lane/lane/overlay",
            "Json sectors/sectors",
            "Scene sectors/sectors/scene",
            "Json decision/command",
            "Json decision/state",
            "Log -",
            "Json odometry/state",
            "Pose odometry/state/pose",
            "Transform -",
        ];
        assert_eq!(topics, expected, "a type that is not ours has none");
    }

    #[test]
    fn frames_are_unique_and_overlays_know_their_image() {
        let ports = ports(&graph());
        let about = |name: &str| ports.iter().find(|port| port.name() == name).and_then(|port| port.about.as_deref());
        assert_eq!(about("world/scan"), Some("laser"), "the first lidar");
        assert_eq!(about("world/vehicle"), Some("base_link"), "the first vehicle");
        assert_eq!(about("odometry/state"), Some("odometry/state"), "another idea of where the car is");
        assert_eq!(about("lane/lane"), Some("world/camera"), "what the detector reads");
        let flawless = node("world", &[], &[("camera", "Image"), ("lane", "LaneEstimate")]);
        assert_eq!(super::ports(&[flawless])[1].about.as_deref(), Some("world/camera"), "a simulator's own image");
        let blind = node("lane", &[], &[("lane", "LaneEstimate")]);
        assert_eq!(super::ports(&[blind])[0].about, None, "no image anywhere");
    }

    #[test]
    fn edges_are_those_of_the_graph() {
        let text = format!("{:?}", connections(&graph()));
        for expected in [
            r#""world/camera": {"world"}"#,
            r#""world/camera": {"lane"}"#,
            r#""decision/goal": {"decision"}"#,
            r#""world/strange": {"world"}"#,
        ] {
            assert!(text.contains(expected), "{expected} in {text}");
        }
    }

    #[test]
    fn configurations_tell_rows_limits_and_mounting() {
        let live = |name: &str, config: Value| LiveNode {
            name: name.into(),
            operator: name.into(),
            exec: None,
            version: 1,
            config,
            schema: Value::Null,
            fitting: Vec::new(),
        };
        let facts = Facts::new(&[
            live("lane", json!({ "row_far": 0.75, "row_near": 0.85 })),
            live("sectors", json!({ "mounting_deg": 180.0, "sectors": [{ "name": "front", "limit_m": 1.2 }] })),
        ]);
        assert_eq!(facts.rows("lane"), Some([0.75, 0.85]), "as configured");
        assert_eq!(facts.rows("sectors"), None, "it has none");
        assert_eq!(facts.limit_m("sectors", "front"), Some(1.2), "by name");
        assert_eq!(facts.limit_m("sectors", "rear"), None, "unknown");
        assert_eq!(facts.mounting_rad(&graph(), "world/scan"), std::f64::consts::PI, "of who reads it");
        assert_eq!(facts.mounting_rad(&graph(), "other/scan"), 0.0, "nobody says");
    }
}
