//! A graph file between reading and checking: its raw parts with operators and ports looked up as far as they exist. Rules read
//! it and report; only when none reports an error does it become a [`Graph`](super::Graph).

use std::collections::HashMap;
use std::ops::{Range, RangeInclusive};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde_json::Value;

use super::PortRef;
use super::exec::{Binaries, Refusal};
use super::marked::{Marked, Place, Tree};
use super::problem::{MAX_PROBLEMS, Problem, Problems, Severity};
use super::raw::{RawBudget, RawEdge, RawFile, RawInput, RawNode, RawRemote};
use super::source::Source;
use crate::ports::{InputSpec, OutputSpec};
use crate::registry::{OperatorKind, Registry};

/// Allowed values of `period_ms`.
pub(crate) const PERIOD_MS: RangeInclusive<f64> = 0.1..=60_000.0;
/// Allowed values of `deadline_ms`.
pub(crate) const DEADLINE_MS: RangeInclusive<f64> = 0.01..=60_000.0;
/// Allowed values of `latency_ms`.
pub(crate) const LATENCY_MS: RangeInclusive<f64> = 0.0..=10_000.0;
/// Allowed values of `delay_ms`.
pub(crate) const DELAY_MS: RangeInclusive<f64> = 0.01..=60_000.0;
/// Allowed values of `max_age_ms`.
pub(crate) const MAX_AGE_MS: RangeInclusive<f64> = 0.01..=3_600_000.0;

/// Collects problems, with their positions.
pub(crate) struct Report<'a> {
    source: &'a Source,
    /// The calibration file, when it could be read.
    calibration: Option<Source>,
    pub(crate) problems: Problems,
}

impl<'a> Report<'a> {
    pub(crate) fn new(source: &'a Source) -> Self {
        Self { source, calibration: None, problems: Problems::default() }
    }

    /// From now on places may lie in this file.
    pub(crate) fn calibrated_by(&mut self, source: Source) {
        self.calibration = Some(source);
    }

    pub(crate) fn error(&mut self, place: &Place, rule: &'static str, message: String, hint: Option<String>) {
        self.add(Severity::Error, place, rule, message, hint);
    }

    pub(crate) fn warning(&mut self, place: &Place, rule: &'static str, message: String, hint: Option<String>) {
        self.add(Severity::Warning, place, rule, message, hint);
    }

    pub(crate) fn note(&mut self, place: &Place, rule: &'static str, message: String, hint: Option<String>) {
        self.add(Severity::Note, place, rule, message, hint);
    }

    fn add(&mut self, severity: Severity, place: &Place, rule: &'static str, message: String, hint: Option<String>) {
        if self.full() {
            self.problems.leave_out();
            return;
        }
        let mut problem = match place {
            Place::File(span) => in_file(self.source, span, rule, message),
            Place::Calibration(span) => in_file(self.calibration.as_ref().unwrap_or(self.source), span, rule, message),
            Place::Set(text) => Problem::of_file(text, rule, message),
        };
        (problem.severity, problem.hint) = (severity, hint);
        self.problems.push(problem);
    }

    /// Whether further problems would be left out.
    pub(crate) fn full(&self) -> bool {
        self.problems.iter().len() >= MAX_PROBLEMS
    }
}

fn in_file(source: &Source, span: &Range<usize>, rule: &'static str, message: String) -> Problem {
    Problem::of_file(&source.name, rule, message).at(source.excerpt(span))
}

/// What rules look at.
pub(crate) struct Draft<'a> {
    pub(crate) root: &'a Marked,
    pub(crate) robot: Option<&'a str>,
    pub(crate) nodes: Vec<DraftNode<'a>>,
    pub(crate) budgets: Vec<DraftBudget<'a>>,
    pub(crate) remote: Option<&'a RawRemote>,
    pub(crate) registry: &'a Registry,
    pub(crate) base_dir: &'a Path,
    pub(crate) probe_devices: bool,
    /// For which machine the graph is read; `None`: for the car.
    pub(crate) machine: Option<&'a str>,
    by_name: HashMap<&'a str, usize>,
}

/// One node.
pub(crate) struct DraftNode<'a> {
    pub(crate) name: &'a str,
    pub(crate) raw: &'a RawNode,
    pub(crate) body: DraftBody,
    pub(crate) config: Value,
    pub(crate) period: Option<Duration>,
    pub(crate) edges: Vec<DraftEdge<'a>>,
}

/// What runs in a node, if that is known.
#[derive(Clone)]
pub(crate) enum DraftBody {
    Operator(Arc<OperatorKind>),
    Exec(PathBuf, Arc<OperatorKind>),
    /// A binary whose operator cannot be told.
    Refused(Refusal),
    /// The same of a node that another machine runs: it need not be here.
    Away(Refusal),
    Unknown,
}

/// One connected input.
pub(crate) struct DraftEdge<'a> {
    pub(crate) input: &'a str,
    /// What it reads, as written; `None`: reported already, or missing.
    pub(crate) from: Option<&'a str>,
    /// The rest of the edge; `None`: only `node/port` was given.
    pub(crate) raw: Option<&'a RawEdge>,
}

/// One budget, with the path of its place.
pub(crate) struct DraftBudget<'a> {
    pub(crate) raw: &'a RawBudget,
    pub(crate) index: String,
}

/// What a `node/port` names.
pub(crate) enum Target<'a> {
    /// It is no `node/port`.
    Malformed,
    /// There is no such node.
    NoNode(&'a str),
    /// The node has no such port.
    NoPort(&'a DraftNode<'a>),
    /// The node is wrong itself, which is reported elsewhere.
    Unclear,
    /// An output.
    Output(usize, &'a OutputSpec),
}

impl<'a> Draft<'a> {
    pub(crate) fn new(
        root: &'a Marked,
        file: &'a RawFile,
        registry: &'a Registry,
        base_dir: &'a Path,
        (probe_devices, machine): (bool, Option<&'a str>),
    ) -> Self {
        let raw_nodes = file.nodes.as_ref();
        let keys = root.locate(&["nodes"]).value.keys();
        let mut binaries = Binaries::new(base_dir);
        let nodes: Vec<_> = keys
            .filter_map(|name| Some((name, raw_nodes?.get(name)?)))
            .map(|(name, raw)| DraftNode::new(name, raw, machine, registry, &mut binaries))
            .collect();
        let by_name = nodes.iter().enumerate().map(|(index, node)| (node.name, index)).collect();
        let budgets = file.budgets.iter().flatten().enumerate().map(|(index, raw)| {
            let path = root.own_path(&["budgets".to_owned(), index.to_string()]);
            DraftBudget { raw, index: path[1].clone() }
        });
        let budgets = budgets.collect();
        let (robot, remote) = (file.robot.as_deref(), file.remote.as_ref());
        Self { root, robot, nodes, budgets, remote, registry, base_dir, probe_devices, machine, by_name }
    }

    /// Place of the value at `path`; of its key when the value is empty; of what stands there
    /// instead, or of the key above, when there is none.
    pub(crate) fn at(&self, path: &[&str]) -> &Place {
        let located = self.root.locate(path);
        let is_scalar = matches!(located.value.tree, Tree::Scalar(_));
        match (&located.value.place, located.key) {
            (Place::File(_) | Place::Calibration(_), Some(key))
                if located.value.place.is_blank() || (located.depth < path.len() && !is_scalar) =>
            {
                key
            }
            (place, _) => place,
        }
    }

    /// Place of the last key of `path` that exists.
    pub(crate) fn key_at(&self, path: &[&str]) -> &Place {
        let located = self.root.locate(path);
        located.key.unwrap_or(&located.value.place)
    }

    /// Whether the file has something at `path`, be it wrong.
    pub(crate) fn has(&self, path: &[&str]) -> bool {
        self.root.has(path)
    }

    /// The node of that name.
    pub(crate) fn node(&self, name: &str) -> Option<usize> {
        self.by_name.get(name).copied()
    }

    /// What `node/port` names, when an output is meant.
    pub(crate) fn output<'s>(&'s self, text: &'s str) -> Target<'s> {
        let Some((node, port)) = split_port(text) else { return Target::Malformed };
        let Some(index) = self.node(node) else {
            return if self.has(&["nodes", node]) { Target::Unclear } else { Target::NoNode(node) };
        };
        match &self.nodes[index].body {
            DraftBody::Refused(_) | DraftBody::Away(_) | DraftBody::Unknown => Target::Unclear,
            DraftBody::Operator(kind) | DraftBody::Exec(_, kind) => {
                match kind.outputs.iter().find(|spec| spec.name == port) {
                    Some(spec) => Target::Output(index, spec),
                    None => Target::NoPort(&self.nodes[index]),
                }
            }
        }
    }

    /// Index of the node that an edge comes from.
    pub(crate) fn source(&self, edge: &DraftEdge<'_>) -> Option<usize> {
        match self.output(edge.from?) {
            Target::Output(index, _) => Some(index),
            _ => None,
        }
    }

    /// Whether the two ends of an edge are on different machines.
    pub(crate) fn crosses(&self, node: &DraftNode<'_>, edge: &DraftEdge<'_>) -> bool {
        let writer = edge.from.and_then(split_port).and_then(|(writer, _)| self.node(writer));
        writer.is_some_and(|writer| self.nodes[writer].machine() != node.machine())
    }

    /// Every output there is: `world/camera`, ...
    pub(crate) fn all_outputs(&self) -> Vec<String> {
        let of_node = |node: &DraftNode<'_>| {
            let name = node.name.to_owned();
            let outputs = node.kind().map(|kind| kind.outputs.clone()).unwrap_or_default();
            outputs.into_iter().map(move |port| format!("{name}/{}", port.name))
        };
        self.nodes.iter().flat_map(of_node).collect()
    }
}

impl DraftBody {
    fn kind(&self) -> Option<&Arc<OperatorKind>> {
        match self {
            Self::Operator(kind) | Self::Exec(_, kind) => Some(kind),
            Self::Refused(_) | Self::Away(_) | Self::Unknown => None,
        }
    }
}

impl<'a> DraftNode<'a> {
    fn new(
        name: &'a str,
        raw: &'a RawNode,
        machine: Option<&str>,
        registry: &Registry,
        binaries: &mut Binaries<'_>,
    ) -> Self {
        let body = match (&raw.operator, &raw.exec) {
            (Some(kind), None) => registry.get(kind).map_or(DraftBody::Unknown, |k| DraftBody::Operator(Arc::clone(k))),
            (operator, Some(path)) => match binaries.operator(path, operator.as_deref(), name) {
                Ok((path, kind)) => DraftBody::Exec(path, kind),
                Err(refusal) if raw.machine.as_deref() != machine => DraftBody::Away(refusal),
                Err(refusal) => DraftBody::Refused(refusal),
            },
            (None, None) => DraftBody::Unknown,
        };
        let config = raw.config.clone().unwrap_or(Value::Null);
        let own_period = body.kind().and_then(|kind| kind.period(&config));
        let period = millis(raw.period_ms, &PERIOD_MS).or(own_period).filter(|period| !period.is_zero());
        let inputs = raw.inputs.iter().flatten();
        let edges = inputs
            .map(|(input, raw)| match raw {
                RawInput::From(from) => DraftEdge { input, from: Some(from), raw: None },
                RawInput::Edge(edge) => DraftEdge { input, from: edge.from.as_deref(), raw: Some(edge) },
            })
            .collect();
        Self { name, raw, body, config, period, edges }
    }

    pub(crate) fn kind(&self) -> Option<&Arc<OperatorKind>> {
        self.body.kind()
    }

    pub(crate) fn input_spec(&self, input: &str) -> Option<&InputSpec> {
        self.kind()?.inputs.iter().find(|spec| spec.name == input)
    }

    /// The machine that runs it; `None`: the car.
    pub(crate) fn machine(&self) -> Option<&'a str> {
        self.raw.machine.as_deref()
    }

    /// Whether a sample on this edge makes the node step; where that is not known, it is taken to.
    pub(crate) fn triggers(&self, edge: &DraftEdge<'_>) -> bool {
        self.input_spec(edge.input).is_none_or(|spec| spec.triggers)
    }

    pub(crate) fn deadline(&self) -> Option<Duration> {
        millis(self.raw.deadline_ms, &DEADLINE_MS)
    }

    pub(crate) fn latency(&self) -> Duration {
        millis(self.raw.latency_ms, &LATENCY_MS).unwrap_or_default()
    }
}

impl DraftEdge<'_> {
    pub(crate) fn delay(&self) -> Option<Duration> {
        millis(self.raw?.delay_ms, &DELAY_MS)
    }

    pub(crate) fn max_age(&self) -> Option<Duration> {
        millis(self.raw?.max_age_ms, &MAX_AGE_MS)
    }
}

impl DraftBudget<'_> {
    pub(crate) fn max_age(&self) -> Option<Duration> {
        millis(self.raw.max_age_ms, &MAX_AGE_MS)
    }
}

/// `node/port` in two.
pub(crate) fn split_port(text: &str) -> Option<(&str, &str)> {
    let (node, port) = text.split_once('/')?;
    (!node.is_empty() && !port.is_empty() && !port.contains('/')).then_some((node, port))
}

/// `node/port` as a reference.
pub(crate) fn port_ref(text: &str) -> Option<PortRef> {
    split_port(text).map(|(node, port)| PortRef { node: node.to_owned(), port: port.to_owned() })
}

/// Milliseconds as a duration, to the nanosecond. `None`: not given, or out of range, which is reported elsewhere.
pub(crate) fn millis(ms: Option<f64>, range: &RangeInclusive<f64>) -> Option<Duration> {
    ms.filter(|ms| range.contains(ms)).map(|ms| Duration::from_nanos((ms * 1e6).round() as u64))
}

/// A duration as messages show it: `33.3 ms`.
pub(crate) fn show(duration: Duration) -> String {
    let ms = duration.as_secs_f64() * 1e3;
    format!("{} ms", (ms * 1e3).round() / 1e3)
}
