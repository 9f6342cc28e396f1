//! The node that is calibrated: in the running graph, or in a graph file.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use carril_runtime::Registry;
use carril_runtime::graph::{Graph, ReadOptions};
use clap::Args;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::common::graph_file::{self, Shown};
use crate::common::live::Run;
use crate::common::suggest;
use crate::common::way;

/// Which node.
#[derive(Args)]
pub struct TargetArgs {
    /// The node, as `carril list` shows it; may be left out where there is only one
    #[arg(long, value_name = "NODE")]
    node: Option<String>,
    /// Which robot, where several graphs run
    #[arg(long, value_name = "NAME", conflicts_with = "graph")]
    robot: Option<String>,
    /// Take the node from a graph file instead of the running graph
    #[arg(long, value_name = "FILE")]
    graph: Option<PathBuf>,
}

/// The node.
pub struct Target {
    /// Its name.
    pub node: String,
    /// Its operator.
    pub operator: String,
    /// Its configuration, defaults included.
    pub config: Value,
    /// Its graph file.
    pub graph: PathBuf,
    /// The graph that it runs in; `None`: it is only in the file.
    pub run: Option<Run>,
}

impl Target {
    /// The node, of one of these operators, that the arguments mean.
    pub fn find(args: &TargetArgs, kinds: &[&str], registry: &Registry) -> Result<Self> {
        match &args.graph {
            Some(file) => of_file(file, args.node.as_deref(), kinds, registry),
            None => of_run(args, kinds),
        }
    }

    /// Its configuration as a type.
    pub fn config<T: DeserializeOwned>(&self) -> Result<T> {
        let read = serde_json::from_value(self.config.clone());
        read.with_context(|| format!("the configuration of node `{}` cannot be read", self.node))
    }

    /// The output that an input of the node reads, in the running graph.
    pub fn source_of(&self, input: &str) -> Result<String> {
        let node = &self.node;
        let run = self.run.as_ref().context("no graph is running")?;
        let entry = run.file().nodes.iter().find(|entry| entry.name == *node);
        let inputs = entry.map(|entry| &entry.inputs[..]).unwrap_or_default();
        let from = inputs.iter().find(|entry| entry.port == input).and_then(|entry| entry.from.clone());
        from.with_context(|| {
            format!("input `{input}` of node `{node}` reads nothing; name a port with --from NODE/PORT")
        })
    }

    /// Its graph file, read and checked.
    pub fn graph_with(&self, options: &ReadOptions, registry: &Registry) -> Result<Graph> {
        Graph::read(&self.graph, registry, options).map_err(|problems| {
            eprint!("{}", graph_file::render(&problems, graph_file::styled(&std::io::stderr())));
            Shown.into()
        })
    }
}

fn of_run(args: &TargetArgs, kinds: &[&str]) -> Result<Target> {
    let run = Run::connect(&way::Target::of(args.robot.as_deref()))?;
    let live = run.graph()?;
    let nodes = live.nodes.iter().map(|node| {
        let operator = if node.exec.is_some() { "a binary of your own" } else { node.operator.as_str() };
        (node.name.as_str(), operator)
    });
    let (node, operator) = choose(&nodes.collect::<Vec<_>>(), args.node.as_deref(), kinds)?;
    let config = live.nodes.iter().find(|live| live.name == node).map(|live| live.config.clone());
    Ok(Target { node, operator, config: config.unwrap_or_default(), graph: live.graph, run: Some(run) })
}

fn of_file(file: &Path, node: Option<&str>, kinds: &[&str], registry: &Registry) -> Result<Target> {
    graph_file::must_be_a_file(file)?;
    let mut target =
        Target { node: String::new(), operator: String::new(), config: Value::Null, graph: file.to_owned(), run: None };
    let graph = target.graph_with(&ReadOptions::default(), registry)?;
    let nodes = graph.nodes.iter().map(|node| {
        let operator =
            if node.exec().is_some() { "a binary of your own" } else { node.kind().map_or("", |kind| kind.name) };
        (node.name.as_str(), operator)
    });
    (target.node, target.operator) = choose(&nodes.collect::<Vec<_>>(), node, kinds)?;
    let config = graph.node(&target.node).and_then(|node| Some(node.kind()?.effective_config(&node.config)));
    target.config = config.unwrap_or_default();
    Ok(target)
}

/// The node that is meant, and its operator, of nodes with their operators.
fn choose(nodes: &[(&str, &str)], wanted: Option<&str>, kinds: &[&str]) -> Result<(String, String)> {
    let fits = |operator: &str| kinds.contains(&operator);
    let fitting: Vec<(&str, &str)> = nodes.iter().filter(|(_, operator)| fits(operator)).copied().collect();
    let names = || fitting.iter().map(|(name, _)| *name);
    let chosen = |(name, operator): (&str, &str)| Ok((name.to_owned(), operator.to_owned()));
    let kind = kinds.join("` or `");
    let Some(wanted) = wanted else {
        return match &fitting[..] {
            [only] => chosen(*only),
            [] => bail!("the graph has no node with the operator `{kind}`"),
            _ => bail!(
                "the graph has several nodes with the operator `{kind}`: {}; choose one with --node",
                names().collect::<Vec<_>>().join(", ")
            ),
        };
    };
    match nodes.iter().find(|(name, _)| *name == wanted) {
        Some(found) if fits(found.1) => chosen(*found),
        Some((_, operator)) => bail!("node `{wanted}` is {operator}, allowed is a node with the operator `{kind}`"),
        None => {
            let all = names().collect::<Vec<_>>().join(", ");
            let otherwise = format!("nodes with the operator `{kind}` are {all}");
            bail!("there is no node `{wanted}`{}", suggest::hint(wanted, names(), &otherwise));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_only_node_of_a_kind_need_not_be_named() {
        let nodes = [("world", "sim-world"), ("lane", "lane-detector"), ("mine", "a binary of your own")];
        let chosen = |wanted| {
            choose(&nodes, wanted, &["lane-detector"]).map(|(name, _)| name).map_err(|error| error.to_string())
        };
        assert_eq!(chosen(None).as_deref(), Ok("lane"), "the only one");
        assert_eq!(chosen(Some("lane")).as_deref(), Ok("lane"), "by its name");
        assert!(chosen(Some("lnae")).is_err_and(|error| error.contains("did you mean `lane`?")), "misspelt");
        assert!(
            chosen(Some("world")).is_err_and(|error| error.contains("is sim-world, allowed is")),
            "another operator"
        );
        assert!(chosen(Some("mine")).is_err_and(|error| error.contains("a binary of your own")), "not ours");
        let two = [("a", "lane-detector"), ("b", "lane-detector")];
        let error = choose(&two, None, &["lane-detector"]).expect_err("which?").to_string();
        assert!(error.contains("a, b; choose one with --node"), "{error}");
        assert!(choose(&nodes, None, &["lidar-sectors"]).is_err(), "none");
        let either = choose(&nodes, None, &["lane-lines", "lane-detector"]).expect("one of them");
        assert_eq!(either, ("lane".into(), "lane-detector".into()), "whichever is there");
    }
}
