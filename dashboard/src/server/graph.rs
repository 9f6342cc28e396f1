//! The graph as the page is told of it, and what it says about driving by hand. Pure.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::Utf8Bytes;
use carril_messages::{Command, Message, SourceId, car};
use carril_runtime::control_plane::{LiveGraph, NodeEntry, RunFile};
use serde_json::{Value, json};

/// Operator that takes commands of people.
const DRIVER: &str = "decision";
/// Its input for them.
const MANUAL: &str = "manual";
/// Without new commands the car stops within this time, where the node does not tell its `manual_timeout_ms`, ms.
const LEASE_MS: f64 = 300.0;

/// How the car can be driven by hand.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// The node that takes the commands.
    pub node: String,
    /// Its input.
    pub port: String,
    /// Not faster, m/s, to either side.
    pub max_speed_m_s: f64,
    /// Not farther, rad, to either side.
    pub max_steering_rad: f64,
    /// A command holds for so long.
    pub lease: Duration,
}

/// Names of the ports that exposures come from.
pub type Sources = HashMap<SourceId, String>;

/// The graph at one moment.
#[derive(Clone, Debug)]
pub struct GraphNow {
    /// Processes and ports.
    pub run: RunFile,
    /// How it can be driven by hand, if it can.
    pub drive: Option<Drive>,
    /// Ports by the numbers that exposures carry.
    pub sources: Arc<Sources>,
    /// The message of it.
    pub text: Utf8Bytes,
}

impl GraphNow {
    /// What the supervisor says, put together.
    pub fn of(run: RunFile, live: &LiveGraph) -> Self {
        let nodes: Vec<Value> = run.nodes.iter().map(|node| {
            let now = live.nodes.iter().find(|now| now.name == node.name);
            json!({
                "name": node.name, "operator": now.map_or(&node.operator, |now| &now.operator),
                "exec": now.map_or(&node.exec, |now| &now.exec), "process": node.process,
                "version": now.map_or(1, |now| now.version), "fitting": now.map_or(&[][..], |now| &now.fitting), "inputs": node.inputs, "outputs": node.outputs,
                "config": now.map_or(&Value::Null, |now| &now.config), "schema": now.map_or(&Value::Null, |now| &now.schema),
            })
        }).collect();
        let drive = run.nodes.iter().find_map(|node| {
            let now = live.nodes.iter().find(|now| now.name == node.name)?;
            (now.operator == DRIVER).then(|| drive_of(node, &now.config))?
        });
        let text = json!({ "type": "graph", "nodes": nodes }).to_string().into();
        let outputs = run.nodes.iter().flat_map(|node| node.outputs.iter().map(|output| (&node.name, &output.port)));
        let sources = outputs.map(|(node, port)| (SourceId::of(node, port), format!("{node}/{port}"))).collect();
        Self { run, drive, sources: Arc::new(sources), text }
    }
}

fn drive_of(node: &NodeEntry, config: &Value) -> Option<Drive> {
    let fits = |port: &str, message_type: &str| port == MANUAL && message_type == Command::TYPE.name;
    let input = node.inputs.iter().find(|input| input.external && fits(&input.port, &input.message_type))?;
    let number = |field: &str| config[field].as_f64().filter(|value| value.is_finite() && *value > 0.0);
    // A limit of 0 means that people may not drive.
    let max_speed_m_s = number("manual_max_speed_m_s")?;
    let max_steering_rad = number("max_steering_deg").map_or(car::STEERING_LIMIT_RAD, f64::to_radians);
    // The time in which the decision node stops the car, and once more for braking.
    let lease_ms = number("manual_timeout_ms").map_or(LEASE_MS, |timeout_ms| (2.0 * timeout_ms).clamp(20.0, 5000.0));
    let lease = Duration::from_secs_f64(lease_ms / 1e3);
    Some(Drive { node: node.name.clone(), port: input.port.clone(), max_speed_m_s, max_steering_rad, lease })
}

#[cfg(test)]
mod tests {
    use carril_messages::Stamp;
    use carril_runtime::control_plane::{InputEntry, LiveNode};

    use super::*;

    fn graph(port: &str, external: bool, config: Value) -> GraphNow {
        let input = InputEntry { port: port.into(), message_type: "carril/Command".into(), from: None, external };
        let node = NodeEntry {
            name: "brain".into(),
            operator: "decision".into(),
            exec: None,
            process: "brain".into(),
            machine: None,
            inputs: vec![input],
            outputs: Vec::new(),
        };
        let run = RunFile {
            robot: "car1".into(),
            pid: 1,
            graph: "dataflow.yaml".into(),
            started: Stamp::ZERO,
            clock_zero: Stamp::ZERO,
            endpoint: String::new(),
            machine: None,
            processes: Vec::new(),
            nodes: vec![node],
        };
        let live = LiveNode {
            name: "brain".into(),
            operator: "decision".into(),
            exec: None,
            version: 3,
            config,
            schema: Value::Null,
            fitting: vec!["rule-of-thumb".into()],
        };
        GraphNow::of(run, &LiveGraph { graph: "dataflow.yaml".into(), nodes: vec![live] })
    }

    #[test]
    fn people_drive_only_where_the_graph_lets_them() {
        let config = json!({"manual_max_speed_m_s": 0.5, "max_steering_deg": 10.0, "manual_timeout_ms": 125});
        let drive = graph("manual", true, config.clone()).drive.expect("it can be driven");
        assert_eq!((drive.node.as_str(), drive.port.as_str()), ("brain", "manual"), "where");
        assert_eq!((drive.max_speed_m_s, drive.lease.as_millis()), (0.5, 250), "limits");
        assert!((drive.max_steering_rad - 0.174_532_9).abs() < 1e-6, "{}", drive.max_steering_rad);
        assert_eq!(graph("manual", false, config.clone()).drive, None, "the input is not open to people");
        assert_eq!(graph("goal", true, config).drive, None, "another input");
        assert_eq!(graph("manual", true, json!({"manual_max_speed_m_s": 0.0})).drive, None, "a limit of 0");
        assert_eq!(graph("manual", true, json!({})).drive, None, "no limit");
    }

    #[test]
    fn the_message_has_ports_and_configuration() {
        let text: Value = serde_json::from_str(&graph("manual", true, json!({"a": 1})).text).expect("JSON");
        let node = &text["nodes"][0];
        assert_eq!(
            (&node["version"], &node["config"]["a"], &node["inputs"][0]["external"], &node["fitting"]),
            (&3.into(), &1.into(), &true.into(), &json!(["rule-of-thumb"]))
        );
    }
}
