//! From a graph file to a checked [`Graph`]: the steps in their order.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::IgnoredAny;

use super::calibration::{self, CalibrationText};
use super::draft::{DELAY_MS, Draft, DraftBody, DraftNode, MAX_AGE_MS, Report, millis, port_ref};
use super::marked::{Marked, Place, Tree};
use super::overrides::{self, Override};
use super::problem::{Problem, Problems};
use super::raw::RawRemote;
use super::raw::{
    RawBudget, RawEdge, RawFile, RawInput, RawNode, RawOnOverrun, RawOnViolation, RawPolicy, RawQueue, RawRestart,
};
use super::source::{Kind, MAX_FILE_BYTES, Source, read_text, too_large};
use super::{Budget, Edge, Graph, GraphNode, NodeBody, OnOverrun, Restart, RestartPolicy, remote, rules, shape, yaml};
use crate::mailbox::QueuePolicy;
use crate::registry::Registry;

/// Default of `max_age_ms` on an edge from one machine to another: longer than Wi-Fi takes when it works, and short enough that a car at
/// 1 m/s sees half a metre.
const MAX_AGE_BETWEEN_MACHINES: Duration = Duration::from_millis(500);

/// How to read a graph file.
#[derive(Clone, Debug, Default)]
pub struct ReadOptions {
    /// `--set node.key=value`, in their order.
    pub overrides: Vec<Override>,
    /// Folder where relative paths begin. Default: the folder of the file.
    pub base_dir: Option<PathBuf>,
    /// Devices must be there (`carril check --devices`).
    pub probe_devices: bool,
    /// The machine for which the graph is read: what it runs must be here. `None`: the car.
    pub machine: Option<String>,
    /// Read in place of the calibration file that the graph names: what it would be with other values.
    pub calibration: Option<CalibrationText>,
}

impl Graph {
    /// Reads and checks a graph file. `Err` has every problem that was found; warnings are in [`Graph::warnings`].
    pub fn read(path: &Path, registry: &Registry, options: &ReadOptions) -> Result<Self, Problems> {
        match read_text(path, Kind::Graph) {
            Ok(text) => Self::parse(text, path, registry, options),
            Err(problem) => Err(only(*problem)),
        }
    }

    /// Checks the text of a graph file. `path` is what problems show and where relative paths begin; it is not opened, but the
    /// calibration file that the text names is.
    pub fn parse(text: String, path: &Path, registry: &Registry, options: &ReadOptions) -> Result<Self, Problems> {
        let name = path.display().to_string();
        if text.len() > MAX_FILE_BYTES {
            return Err(only(too_large(&name, text.len() as u64, Kind::Graph)));
        }
        let source = Source::new(name, text);
        let mut report = Report::new(&source);
        let parts = check(&source, path, registry, options, &mut report);
        let mut problems = report.problems;
        problems.sort(&source.name);
        match parts {
            Some(graph) if problems.errors() == 0 => Ok(Self { text: source.text, warnings: problems, ..graph }),
            _ => Err(problems),
        }
    }
}

fn only(problem: Problem) -> Problems {
    let mut problems = Problems::default();
    problems.push(problem);
    problems
}

fn check(
    source: &Source,
    path: &Path,
    registry: &Registry,
    options: &ReadOptions,
    report: &mut Report<'_>,
) -> Option<Graph> {
    let mut root = read_root(source, report)?;
    let base_dir = options.base_dir.clone().unwrap_or_else(|| folder_of(path));
    let calibration = calibration::apply(&mut root, &base_dir, options.calibration.as_ref(), report);
    overrides::apply(&mut root, &options.overrides, report);
    let file = read_raw(&mut root, report)?;
    let side = (options.probe_devices, options.machine.as_deref());
    let draft = Draft::new(&root, &file, registry, &base_dir, side);
    rules::check(&draft, report);
    (report.problems.errors() == 0).then(|| Graph { calibration, ..finish(&draft, path) })
}

fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    }
}

fn read_root(source: &Source, report: &mut Report<'_>) -> Option<Marked> {
    read_map(source, "a graph file is a map with `robot` and `nodes`", report)
}

/// The map that a file holds. `what`: the hint where it holds none.
pub(crate) fn read_map(source: &Source, what: &str, report: &mut Report<'_>) -> Option<Marked> {
    let (root, problems) = yaml::read(source);
    for problem in problems {
        report.error(&Place::File(problem.span), problem.rule, problem.message, problem.hint.map(str::to_owned));
    }
    let whole = Place::File(0..0);
    let hint = || Some(what.to_owned());
    match root {
        Some(root) if matches!(root.tree, Tree::Map(_)) => Some(root),
        Some(root) if !root.is_null() => {
            report.error(&root.place, "wrong-type", "the file holds no map".into(), hint());
            None
        }
        _ if report.problems.is_empty() => {
            report.error(&whole, "empty-file", "the file is empty".into(), hint());
            None
        }
        _ => None,
    }
}

/// Node by node: reading again without what was wrong then costs one node, not the file.
fn read_raw(root: &mut Marked, report: &mut Report<'_>) -> Option<RawFile> {
    let mut on_problem = |root: &Marked, problem| report_shape(root, problem, report);
    let top: RawFile<IgnoredAny> = shape::read(root, &[], &mut on_problem)?;
    let mut nodes = BTreeMap::new();
    for name in top.nodes.into_iter().flatten().map(|(name, _)| name) {
        let path = ["nodes", name.as_str()];
        let node = if root.locate(&path).value.is_null() {
            Some(RawNode::default())
        } else {
            shape::read(root, &path, &mut on_problem)
        };
        nodes.extend(node.map(|node| (name, node)));
    }
    // `remote:` with nothing behind it is the defaults, as `nodes` without keys are.
    let empty_remote = root.has(&["remote"]) && root.locate(&["remote"]).value.is_null();
    let remote = if empty_remote { Some(RawRemote::default()) } else { top.remote };
    Some(RawFile { robot: top.robot, calibration: top.calibration, nodes: Some(nodes), budgets: top.budgets, remote })
}

pub(crate) fn report_shape(root: &Marked, problem: shape::ShapeProblem, report: &mut Report<'_>) {
    let located = root.locate(&problem.path);
    let place = match (&located.value.place, located.key) {
        (_, Some(key)) if problem.about_key => key,
        (place, Some(key)) if place.is_blank() => key,
        (place, _) => place,
    };
    let named =
        if problem.about_key { &problem.path[..problem.path.len().saturating_sub(1)] } else { &problem.path[..] };
    let whose = match named {
        [] => String::new(),
        [section] => format!("`{section}`: "),
        [section, node] if section == "nodes" => format!("node `{node}`: "),
        [section, node, rest @ ..] if section == "nodes" => format!("node `{node}`: `{}`: ", rest.join(".")),
        [section, _, rest @ ..] if section == "budgets" && !rest.is_empty() => {
            format!("budget: `{}`: ", rest.join("."))
        }
        [section, ..] if section == "budgets" => "budget: ".into(),
        all => format!("`{}`: ", all.join(".")),
    };
    report.error(place, problem.rule, whose + &problem.message, problem.hint);
}

/// Called only when no rule has reported an error: then everything looked up here exists.
fn finish(draft: &Draft<'_>, path: &Path) -> Graph {
    let mut nodes: Vec<GraphNode> = draft.nodes.iter().filter_map(finish_node).collect();
    share_process_settings(draft, &mut nodes);
    limit_age_between_machines(&mut nodes);
    Graph {
        robot: draft.robot.unwrap_or_default().to_owned(),
        path: path.to_owned(),
        base_dir: draft.base_dir.to_owned(),
        text: String::new(),
        calibration: None,
        nodes,
        budgets: draft.budgets.iter().filter_map(|budget| finish_budget(budget.raw)).collect(),
        remote: draft.remote.and_then(|raw| remote::read(raw).ok()),
        warnings: Problems::default(),
    }
}

fn finish_node(node: &DraftNode<'_>) -> Option<GraphNode> {
    let raw = node.raw;
    let body = match &node.body {
        DraftBody::Operator(kind) => NodeBody::Operator(kind.clone()),
        DraftBody::Exec(path, kind) => NodeBody::Exec { path: path.clone(), kind: kind.clone() },
        DraftBody::Away(_) => NodeBody::Elsewhere,
        DraftBody::Refused(_) | DraftBody::Unknown => return None,
    };
    let inputs = raw.inputs.iter().flatten().filter_map(|(input, raw)| finish_edge(input, raw)).collect();
    Some(GraphNode {
        name: node.name.to_owned(),
        body,
        config: node.config.clone(),
        inputs,
        period: node.period,
        deadline: node.deadline(),
        on_overrun: raw.on_overrun.map_or(OnOverrun::default(), finish_on_overrun),
        restart: raw.restart.map_or(Restart::default(), finish_restart),
        process: raw.process.clone().unwrap_or_else(|| node.name.to_owned()),
        machine: raw.machine.clone(),
        priority: raw.priority.and_then(|priority| u8::try_from(priority).ok()),
        cpus: raw.cpus.iter().flatten().filter_map(|&cpu| usize::try_from(cpu).ok()).collect(),
        lock_memory: raw.lock_memory.unwrap_or(false),
        modelled_latency: node.latency(),
    })
}

/// What is written for one node of a process holds for all of them.
fn share_process_settings(draft: &Draft<'_>, nodes: &mut [GraphNode]) {
    let mut restarts: HashMap<String, Restart> = HashMap::new();
    let mut locked: HashSet<String> = HashSet::new();
    for (node, draft) in nodes.iter().zip(&draft.nodes) {
        if draft.raw.restart.is_some() {
            restarts.insert(node.process.clone(), node.restart);
        }
        if node.lock_memory {
            locked.insert(node.process.clone());
        }
    }
    for node in nodes {
        node.restart = restarts.get(&node.process).copied().unwrap_or_default();
        node.lock_memory = locked.contains(&node.process);
    }
}

/// A link may stall: what waited in it must not be taken for what is.
fn limit_age_between_machines(nodes: &mut [GraphNode]) {
    let machines: HashMap<String, Option<String>> =
        nodes.iter().map(|node| (node.name.clone(), node.machine.clone())).collect();
    for node in nodes {
        for edge in &mut node.inputs {
            if machines.get(&edge.from.node).is_some_and(|writer| *writer != node.machine) {
                edge.max_age = edge.max_age.or(Some(MAX_AGE_BETWEEN_MACHINES));
            }
        }
    }
}

fn finish_edge(input: &str, raw: &RawInput) -> Option<Edge> {
    let plain = RawEdge::default();
    let (from, raw) = match raw {
        RawInput::From(from) => (from.as_str(), &plain),
        RawInput::Edge(edge) => (edge.from.as_deref()?, edge),
    };
    let queue = match raw.queue {
        Some(RawQueue::Capacity(capacity)) => QueuePolicy { capacity: usize::try_from(capacity).ok()? },
        Some(RawQueue::Latest(_)) | None => QueuePolicy::LATEST,
    };
    Some(Edge {
        input: input.to_owned(),
        from: port_ref(from)?,
        queue,
        max_age: millis(raw.max_age_ms, &MAX_AGE_MS),
        reliable: raw.reliable.unwrap_or(false),
        delay: millis(raw.delay_ms, &DELAY_MS),
    })
}

fn finish_on_overrun(raw: RawOnOverrun) -> OnOverrun {
    match raw {
        RawOnOverrun::Warn => OnOverrun::Warn,
        RawOnOverrun::Skip => OnOverrun::Skip,
        RawOnOverrun::Stop => OnOverrun::Stop,
    }
}

fn finish_restart(raw: RawRestart) -> Restart {
    let default = Restart::default();
    let policy = match raw.policy {
        Some(RawPolicy::Never) => RestartPolicy::Never,
        Some(RawPolicy::Always) => RestartPolicy::Always,
        Some(RawPolicy::OnFailure) | None => RestartPolicy::OnFailure,
    };
    Restart {
        policy,
        max: raw.max.and_then(|max| u32::try_from(max).ok()).unwrap_or(default.max),
        window: raw.window_s.map_or(default.window, Duration::from_secs_f64),
    }
}

fn finish_budget(raw: &RawBudget) -> Option<Budget> {
    Some(Budget {
        from: port_ref(raw.from.as_deref()?)?,
        to: port_ref(raw.to.as_deref()?)?,
        max_age: millis(raw.max_age_ms, &MAX_AGE_MS)?,
        stops: raw.on_violation == Some(RawOnViolation::Stop),
    })
}
