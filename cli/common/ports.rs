//! Finds the port that a person names in a running graph, or says what they may have meant. Pure.

use anyhow::{Result, bail};
use carril_messages::{Key, SourceId};
use carril_runtime::control_plane::{InputEntry, NodeEntry, RunFile};

use super::statistics::Sensors;
use super::suggest;

/// A port that samples travel from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Port {
    /// Its key.
    pub key: Key,
    /// `carril/Image`
    pub message_type: String,
    /// Made only while somebody reads it.
    pub on_demand: bool,
    /// An input that `carril pub` feeds, not an output.
    pub external_input: bool,
}

impl Port {
    /// `world/camera`
    pub fn name(&self) -> String {
        format!("{}/{}", self.key.node, self.key.port)
    }
}

/// Every port that can be listened to: outputs, and the inputs that `carril pub` may feed.
pub fn readable(run: &RunFile) -> Vec<Port> {
    let mut ports = Vec::new();
    for node in &run.nodes {
        let port = |name: &str, message_type: &str, on_demand, external_input| Port {
            key: Key::new(&run.robot, &node.name, name),
            message_type: message_type.to_owned(),
            on_demand,
            external_input,
        };
        ports.extend(node.outputs.iter().map(|o| port(&o.port, &o.message_type, o.on_demand, false)));
        let external = node.inputs.iter().filter(|input| input.external);
        ports.extend(external.map(|i| port(&i.port, &i.message_type, false, true)));
    }
    ports
}

/// The port that `name` (`node/port`) means, to listen to.
pub fn to_read(run: &RunFile, name: &str) -> Result<Port> {
    let ports = readable(run);
    if let Some(port) = ports.iter().find(|port| port.name() == name) {
        return Ok(port.clone());
    }
    if let Some((_, input)) = find_input(run, name) {
        match &input.from {
            Some(from) => bail!("`{name}` is an input; it reads `{from}`\nhint: listen to `{from}`"),
            None => bail!("`{name}` is an input that nothing feeds\nhint: {}", list(&ports)),
        }
    }
    if let Some(node) = run.nodes.iter().find(|node| node.name == name) {
        let own: Vec<Port> = ports.into_iter().filter(|port| port.key.node == node.name).collect();
        bail!("`{name}` is a node; name one of its ports\nhint: {}", list(&own));
    }
    let names: Vec<String> = ports.iter().map(Port::name).collect();
    let hint = suggest::hint(name, names.iter().map(String::as_str), "");
    bail!("nothing in the running graph `{}` has a port `{name}`; {}{hint}", run.robot, list(&ports));
}

fn list(ports: &[Port]) -> String {
    if ports.is_empty() {
        return "there are no ports to listen to".to_owned();
    }
    let names: Vec<String> = ports.iter().map(Port::name).collect();
    format!("ports are {}", names.join(", "))
}

/// The input port that `name` means, to publish to: only those that are external.
pub fn to_write<'a>(run: &'a RunFile, name: &str) -> Result<(&'a NodeEntry, &'a InputEntry)> {
    let external: Vec<String> = inputs(run)
        .filter(|(_, input)| input.external)
        .map(|(node, input)| format!("{}/{}", node.name, input.port))
        .collect();
    let allowed = match &external[..] {
        [] => "no port of this graph may be published to".to_owned(),
        names => format!("ports that may be published to are {}", names.join(", ")),
    };
    if let Some((node, input)) = find_input(run, name) {
        if input.external {
            return Ok((node, input));
        }
        let writer = match &input.from {
            Some(from) => format!("`{from}` writes it"),
            None => "it takes samples from an output of the graph only".to_owned(),
        };
        bail!("`{name}` cannot be published to: {writer}\nhint: {allowed}");
    }
    let is_output = |node: &NodeEntry| node.outputs.iter().any(|port| format!("{}/{}", node.name, port.port) == name);
    if let Some(node) = run.nodes.iter().find(|node| is_output(node)) {
        let (node, operator) = (&node.name, &node.operator);
        bail!("`{name}` cannot be published to: node `{node}` ({operator}) writes it\nhint: {allowed}");
    }
    let hint = suggest::hint(name, external.iter().map(String::as_str), "");
    bail!("nothing in the running graph `{}` has an input `{name}`; {allowed}{hint}", run.robot);
}

fn inputs(run: &RunFile) -> impl Iterator<Item = (&NodeEntry, &InputEntry)> {
    run.nodes.iter().flat_map(|node| node.inputs.iter().map(move |input| (node, input)))
}

fn find_input<'a>(run: &'a RunFile, name: &str) -> Option<(&'a NodeEntry, &'a InputEntry)> {
    inputs(run).find(|(node, input)| format!("{}/{}", node.name, input.port) == name)
}

/// The node of that name.
pub fn node<'a>(run: &'a RunFile, name: &str) -> Result<&'a NodeEntry> {
    if let Some(node) = run.nodes.iter().find(|node| node.name == name) {
        return Ok(node);
    }
    let names: Vec<&str> = run.nodes.iter().map(|node| node.name.as_str()).collect();
    let hint = suggest::hint(name, names.iter().copied(), "");
    bail!("the running graph `{}` has no node `{name}`; nodes are {}{hint}", run.robot, names.join(", "));
}

/// Who reads an output: `lane/image, decision/obstacle`.
pub fn readers(run: &RunFile, name: &str) -> Vec<String> {
    let reads = |input: &InputEntry| input.from.as_deref() == Some(name);
    inputs(run).filter(|(_, i)| reads(i)).map(|(node, input)| format!("{}/{}", node.name, input.port)).collect()
}

/// The names of all outputs by the ids under which headers mention them.
pub fn sensors(run: &RunFile) -> Sensors {
    let outputs = run.nodes.iter().flat_map(|node| node.outputs.iter().map(move |port| (&node.name, &port.port)));
    outputs.map(|(node, port)| (SourceId::of(node, port), format!("{node}/{port}"))).collect()
}

/// A run to test with.
#[cfg(test)]
pub fn example_run() -> RunFile {
    serde_json::from_value(serde_json::json!({
        "robot": "car1", "pid": 1, "graph": "dataflow.yaml", "started": 0, "clock_zero": 0, "endpoint": "unixsock-stream//s",
        "processes": [ { "name": "decision", "endpoint": "unixsock-stream//d", "connect": [], "pid": 4711 } ],
        "nodes": [
            { "name": "world", "operator": "sim-world", "process": "world", "inputs": [], "outputs": [
                { "port": "camera", "message_type": "carril/Image", "on_demand": false },
                { "port": "scan", "message_type": "carril/LaserScan", "on_demand": false } ] },
            { "name": "decision", "operator": "decision", "process": "decision",
              "inputs": [
                { "port": "image", "message_type": "carril/Image", "from": "world/camera", "external": false },
                { "port": "goal", "message_type": "carril/Goal", "from": null, "external": true } ],
              "outputs": [ { "port": "command", "message_type": "carril/Command", "on_demand": false } ] },
        ],
    }))
    .expect("the example is a run file")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message<T: std::fmt::Debug>(result: Result<T>) -> String {
        result.expect_err("it must be refused").to_string()
    }

    #[test]
    fn finds_outputs_and_external_inputs() {
        let run = example_run();
        let camera = to_read(&run, "world/camera").expect("an output");
        assert_eq!(camera.key.to_string(), "carril/car1/world/camera", "its key");
        assert!(to_read(&run, "decision/goal").expect("an external input").external_input, "fed by `carril pub`");
    }

    #[test]
    fn a_mistyped_port_gets_a_suggestion_and_the_list() {
        let expected = "nothing in the running graph `car1` has a port `world/camrea`; ports are world/camera, world/scan, \
                        decision/command, decision/goal\nhint: did you mean `world/camera`?";
        assert_eq!(message(to_read(&example_run(), "world/camrea")), expected, "message");
    }

    #[test]
    fn an_input_points_to_what_it_reads_and_a_node_to_its_ports() {
        let run = example_run();
        let input = "`decision/image` is an input; it reads `world/camera`\nhint: listen to `world/camera`";
        assert_eq!(message(to_read(&run, "decision/image")), input, "input");
        let node = "`world` is a node; name one of its ports\nhint: ports are world/camera, world/scan";
        assert_eq!(message(to_read(&run, "world")), node, "node");
    }

    #[test]
    fn only_external_ports_may_be_written() {
        let run = example_run();
        assert!(to_write(&run, "decision/goal").is_ok(), "external");
        let input = message(to_write(&run, "decision/image"));
        assert!(input.contains("`world/camera` writes it"), "says who writes it: {input}");
        let output = message(to_write(&run, "decision/command"));
        assert!(output.contains("node `decision` (decision) writes it"), "says who writes it: {output}");
        let wrong = message(to_write(&run, "decision/gaol"));
        assert!(wrong.ends_with("did you mean `decision/goal`?"), "suggests: {wrong}");
    }

    #[test]
    fn readers_are_inputs_that_read_the_port() {
        assert_eq!(readers(&example_run(), "world/camera"), ["decision/image"], "one reader");
    }
}
