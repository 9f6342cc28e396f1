//! What a machine says when it joins a car to run some of its nodes, and whether its graph is the car's. Pure.
//!
//! Compared is what both sides must mean the same by: the nodes of that machine, and the ports that they read. What else differs, the
//! speed of a node on the car, say, is no affair of the machine.

use std::collections::BTreeMap;

use carril_messages::Stamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::control_plane::{LiveGraph, NodeEntry, RunFile};
use crate::parameters::{parameters, shown};

/// A machine must say again that it is there within this time; and it says so a few times in it.
pub const SILENCE: std::time::Duration = std::time::Duration::from_millis(1500);

/// A machine joins, or says that it is still there.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Join {
    /// When its run began, by its own clock: two runs with the same key are told apart.
    pub started: Stamp,
    /// Its nodes, as its graph has them.
    pub nodes: Vec<NodeEntry>,
    /// The outputs of other machines that they read: `world/camera` to `carril/Image`. An empty type: it is not known there.
    pub reads: BTreeMap<String, String>,
    /// The configuration of each of its nodes with the defaults filled in, as long as nobody has changed it there.
    pub configs: BTreeMap<String, Value>,
}

/// The answer: it has joined.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Joined {
    /// When the car's run began. Another one: the car was started anew.
    pub started: Stamp,
}

impl Join {
    /// What machine `machine` says, which runs this. `graph`: the same, with every configuration.
    pub fn of(machine: &str, run: &RunFile, graph: &LiveGraph) -> Self {
        let nodes: Vec<NodeEntry> = nodes_of(machine, run).cloned().collect();
        let read = nodes.iter().flat_map(|node| node.inputs.iter().filter_map(|input| input.from.as_deref()));
        let from_elsewhere = read.filter(|output| writer(run, output).is_some_and(|node| !is_on(node, machine)));
        let reads =
            from_elsewhere.map(|output| (output.to_owned(), type_of(run, output).unwrap_or_default())).collect();
        let as_written = graph.nodes.iter().filter(|node| node.version == 1);
        let own = as_written.filter(|node| nodes.iter().any(|own| own.name == node.name));
        let configs = own.map(|node| (node.name.clone(), node.config.clone())).collect();
        Self { started: run.started, nodes, reads, configs }
    }

    /// What differs from the graph of the car, in words; nothing: it may join as `machine`.
    pub fn differences(&self, machine: &str, run: &RunFile, graph: &LiveGraph) -> Vec<String> {
        let mut found = Vec::new();
        let expected: Vec<&NodeEntry> = nodes_of(machine, run).collect();
        if expected.is_empty() {
            return vec![format!("the car's graph places no node on machine `{machine}`")];
        }
        for node in &self.nodes {
            if !expected.iter().any(|other| other.name == node.name) {
                let place = run.nodes.iter().find(|other| other.name == node.name);
                found.push(match place {
                    None => format!("the car's graph has no node `{}`", node.name),
                    Some(NodeEntry { machine: Some(other), .. }) => {
                        format!("the car's graph places node `{}` on machine `{other}`", node.name)
                    }
                    Some(_) => format!("node `{}` runs on the car itself", node.name),
                });
            }
        }
        for node in expected {
            match self.nodes.iter().find(|own| own.name == node.name) {
                None => found.push(format!("node `{}` is missing here", node.name)),
                Some(own) => {
                    compare(own, node, &mut found);
                    self.compare_config(&node.name, graph, &mut found);
                }
            }
        }
        for (output, own_type) in &self.reads {
            let there = type_of(run, output).unwrap_or_default();
            if !own_type.is_empty() && !there.is_empty() && *own_type != there {
                found.push(format!("`{output}` gives `{own_type}` here, and `{there}` on the car"));
            }
        }
        found
    }

    fn compare_config(&self, node: &str, graph: &LiveGraph, found: &mut Vec<String>) {
        let known = graph.nodes.iter().find(|known| known.name == node && !known.operator.is_empty());
        let (Some(own), Some(there)) = (self.configs.get(node), known) else { return };
        let values = |config: &Value| -> BTreeMap<String, String> {
            let all = parameters(&Value::Null, config).into_iter();
            all.map(|parameter| (parameter.path, shown(&parameter.value))).collect()
        };
        let (own, there) = (values(own), values(&there.config));
        let paths: std::collections::BTreeSet<&String> = own.keys().chain(there.keys()).collect();
        for path in paths {
            let (here, on_car) = (own.get(path), there.get(path));
            if here != on_car {
                let text = |value: Option<&String>| value.map_or("nothing", String::as_str).to_owned();
                found.push(format!("node `{node}`: `{path}` is {} here, and {} on the car", text(here), text(on_car)));
            }
        }
    }
}

fn is_on(node: &NodeEntry, machine: &str) -> bool {
    node.machine.as_deref() == Some(machine)
}

/// The nodes that a machine runs.
pub fn nodes_of<'a>(machine: &'a str, run: &'a RunFile) -> impl Iterator<Item = &'a NodeEntry> {
    run.nodes.iter().filter(move |node| is_on(node, machine))
}

fn writer<'a>(run: &'a RunFile, output: &str) -> Option<&'a NodeEntry> {
    let (node, _) = output.split_once('/')?;
    run.nodes.iter().find(|known| known.name == node)
}

fn type_of(run: &RunFile, output: &str) -> Option<String> {
    let (_, port) = output.split_once('/')?;
    let output = writer(run, output)?.outputs.iter().find(|known| known.port == port)?;
    Some(output.message_type.clone())
}

/// One of the sides may know a binary of the user's own only by its edges: what it does not know it does not contradict.
fn compare(own: &NodeEntry, there: &NodeEntry, found: &mut Vec<String>) {
    let name = &own.name;
    let both_known = !own.operator.is_empty() && !there.operator.is_empty();
    if both_known && own.operator != there.operator {
        found.push(format!("node `{name}` is a `{}` here, and a `{}` on the car", own.operator, there.operator));
        return;
    }
    let reads = |node: &NodeEntry| -> BTreeMap<String, String> {
        let connected = node.inputs.iter().filter_map(|input| Some((input.port.clone(), input.from.clone()?)));
        connected.collect()
    };
    let (here, on_car) = (reads(own), reads(there));
    for (port, from) in &here {
        match on_car.get(port) {
            Some(other) if other != from => {
                found.push(format!("node `{name}`: input `{port}` reads `{from}` here, and `{other}` on the car"));
            }
            None if both_known => found.push(format!("node `{name}`: input `{port}` is not connected on the car")),
            _ => {}
        }
    }
    for port in on_car.keys().filter(|port| both_known && !here.contains_key(*port)) {
        found.push(format!("node `{name}`: input `{port}` is not connected here"));
    }
    for output in &own.outputs {
        let other = there.outputs.iter().find(|other| other.port == output.port);
        if let Some(other) = other.filter(|other| other.message_type != output.message_type) {
            let (here, on_car) = (&output.message_type, &other.message_type);
            found.push(format!("`{name}/{}` gives `{here}` here, and `{on_car}` on the car", output.port));
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn run() -> RunFile {
        serde_json::from_value(json!({
            "robot": "car1", "pid": 1, "graph": "g.yaml", "started": 0, "clock_zero": 0, "endpoint": "", "processes": [],
            "nodes": [
                { "name": "world", "operator": "sim-world", "process": "world", "inputs": [],
                  "outputs": [{ "port": "camera", "message_type": "carril/Image", "on_demand": false }] },
                { "name": "lane", "operator": "lane-detector", "process": "lane", "machine": "laptop",
                  "inputs": [{ "port": "image", "message_type": "carril/Image", "from": "world/camera", "external": false }],
                  "outputs": [{ "port": "lane", "message_type": "carril/LaneEstimate", "on_demand": false }] },
            ],
        }))
        .expect("a run file")
    }

    fn graph(threshold: u8, version: u32) -> LiveGraph {
        serde_json::from_value(json!({ "graph": "g.yaml", "nodes": [
            { "name": "world", "operator": "sim-world", "version": 1, "config": { "seed": threshold }, "schema": null },
            { "name": "lane", "operator": "lane-detector", "version": version, "config": { "threshold": threshold }, "schema": null },
        ]}))
        .expect("a live graph")
    }

    #[test]
    fn the_same_graph_joins_and_each_difference_is_named() {
        let join = Join::of("laptop", &run(), &graph(190, 1));
        assert_eq!(join.reads["world/camera"], "carril/Image", "what comes from the car");
        let with = |change: &dyn Fn(&mut RunFile)| {
            let mut car = run();
            change(&mut car);
            join.differences("laptop", &car, &graph(190, 1)).join("; ")
        };
        assert_eq!(with(&|_| {}), "", "the same");
        assert_eq!(with(&|car| car.nodes[0].operator = "camera".into()), "", "what runs on the car is its own affair");
        for (change, expected) in [
            (
                &(|car: &mut RunFile| car.nodes[1].machine = None) as &dyn Fn(&mut RunFile),
                "places no node on machine `laptop`",
            ),
            (&|car| car.nodes[1].operator = "my-lane".into(), "is a `lane-detector` here, and a `my-lane` on the car"),
            (
                &|car| car.nodes[1].inputs[0].from = Some("cam/image".into()),
                "reads `world/camera` here, and `cam/image`",
            ),
            (&|car| car.nodes[1].inputs[0].from = None, "input `image` is not connected on the car"),
            (
                &|car| car.nodes[1].outputs[0].message_type = "carril/Goal".into(),
                "`lane/lane` gives `carril/LaneEstimate` here",
            ),
            (
                &|car| car.nodes[0].outputs[0].message_type = "carril/Goal".into(),
                "`world/camera` gives `carril/Image` here",
            ),
            (&|car| car.nodes[1].name = "lane-2".into(), "has no node `lane`; node `lane-2` is missing here"),
        ] {
            let found = with(change);
            assert!(found.contains(expected), "`{expected}`: {found}");
        }
    }

    #[test]
    fn another_configuration_of_its_own_nodes_is_a_difference_until_somebody_changes_it_there() {
        let join = Join::of("laptop", &run(), &graph(180, 1));
        let expected = "node `lane`: `threshold` is 180 here, and 190 on the car";
        assert_eq!(join.differences("laptop", &run(), &graph(190, 1)), [expected], "files differ");
        let changed = Join::of("laptop", &run(), &graph(180, 2));
        assert!(changed.differences("laptop", &run(), &graph(190, 1)).is_empty(), "`carril set` there is allowed");
    }

    #[test]
    fn a_binary_that_the_car_does_not_have_is_known_by_its_edges() {
        let join = Join::of("laptop", &run(), &graph(190, 1));
        let mut car = run();
        car.nodes[1].operator = String::new();
        car.nodes[1].inputs.clear();
        assert!(join.differences("laptop", &car, &graph(190, 1)).is_empty(), "nothing contradicts");
        car.nodes[1].outputs[0].message_type = "carril/Goal".into();
        assert_eq!(join.differences("laptop", &car, &graph(190, 1)).len(), 1, "its readers know the type");
    }
}
