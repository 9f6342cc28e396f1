//! The values of one drive, and what they make of the graph.

use std::time::Duration;

use serde::Serialize;
use serde_json::{Map, Value};

use super::Scenario;
use crate::graph::{Graph, Override, Problems, ReadOptions};
use crate::registry::Registry;

/// What was drawn for one drive.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Drawn {
    /// `node.key` and its value.
    pub values: Map<String, Value>,
    /// Nodes and how long their steps take, ms.
    #[serde(skip_serializing_if = "Map::is_empty")]
    pub latency_ms: Map<String, Value>,
}

impl Scenario {
    /// The values of the drive with this seed.
    pub fn draw(&self, seed: u64) -> Drawn {
        let values = self.vary.iter().map(|(key, from)| (key.clone(), from.draw(seed, key))).collect();
        let latency = |(node, ms): &(String, super::Amount)| {
            (node.clone(), Value::from(ms.draw(seed, &format!("latency.{node}"))))
        };
        Drawn { values, latency_ms: self.latency.iter().map(latency).collect() }
    }

    /// The seed of noise in the drive with this seed.
    pub fn noise_seed(&self, seed: u64) -> u64 {
        self.seed.unwrap_or(seed)
    }

    /// The graph of a drive.
    pub fn graph_of(&self, drawn: &Drawn, registry: &Registry) -> Result<Graph, Problems> {
        let mut overrides: Vec<Override> = self.set.iter().map(|(key, value)| override_of(key, value)).collect();
        overrides.extend(drawn.values.iter().map(|(key, value)| override_of(key, value)));
        let mut graph = Graph::read(&self.graph, registry, &ReadOptions { overrides, ..ReadOptions::default() })?;
        for node in &mut graph.nodes {
            if let Some(ms) = drawn.latency_ms.get(&node.name).and_then(Value::as_f64) {
                node.modelled_latency = Duration::try_from_secs_f64(ms * 1e-3).unwrap_or_default();
            }
        }
        Ok(graph)
    }
}

/// `--set key=value`. The key has been checked: it has a node and a path below.
pub(super) fn override_of(key: &str, value: &Value) -> Override {
    let mut parts = key.split('.').map(str::to_owned);
    let node = parts.next().unwrap_or_default();
    Override { node, key: parts.collect(), value: value.to_string() }
}
