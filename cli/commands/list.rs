//! `carril list`: the ports of a running graph. `carril info NODE`: everything about one node.

use anyhow::Result;
use carril_messages::{Health, Percentiles};
use carril_runtime::control_plane::{InputEntry, NodeEntry, OutputEntry, RunFile};
use clap::Args;
use serde_json::json;

use crate::common::live::Run;
use crate::common::report::Report;
use crate::common::way::Target;
use crate::common::{drive, nodes, output, ports, time};

/// Arguments of `carril list`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril list
  carril list --json | jq -r '.nodes[].name'")]
pub struct ListArgs {
    /// The whole description of the run as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// Arguments of `carril info`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril info lane
  carril info lane --json | jq .health.step_us")]
pub struct InfoArgs {
    /// The node, as `carril list` shows it
    #[arg(value_name = "NODE")]
    node: String,
    /// JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// Runs `carril list`.
pub fn list(args: &ListArgs) -> Result<()> {
    let run = Run::connect(&args.target)?;
    if args.json {
        return output::json(run.file());
    }
    output::text(list_text(run.file()))
}

fn list_text(run: &RunFile) -> String {
    let mut rows = Vec::new();
    for port in ports::readable(run) {
        let readers = ports::readers(run, &port.name());
        let note = match (port.external_input, port.on_demand) {
            (true, _) => "input, for `carril pub`",
            (false, true) => "made while somebody reads it",
            (false, false) => "",
        };
        let readers = if readers.is_empty() { "-".to_owned() } else { readers.join(", ") };
        rows.push(vec![port.name(), port.message_type.clone(), process(run, &port.key.node), readers, note.to_owned()]);
    }
    let nodes = output::counted(run.nodes.len() as u64, "node");
    let processes = output::counted(run.processes.len() as u64, "process");
    let head = format!("{}  {}  {nodes} in {processes}\n\n", run.robot, run.graph.display());
    head + &output::table(&["PORT", "TYPE", "PROCESS", "READ BY", ""], &rows)
}

/// `vision (4711)`, or `vision (DOWN)`; `on laptop`: another machine runs it
fn process(run: &RunFile, node: &str) -> String {
    let Some(node) = run.nodes.iter().find(|entry| entry.name == node) else { return "-".to_owned() };
    if node.machine != run.machine {
        return format!("on {}", node.machine.as_deref().unwrap_or("the car"));
    }
    let pid = run.processes.iter().find(|process| process.name == node.process).and_then(|process| process.pid);
    pid.map_or_else(|| format!("{} (DOWN)", node.process), |pid| format!("{} ({pid})", node.process))
}

/// Runs `carril info`.
pub fn info(args: &InfoArgs) -> Result<()> {
    let run = Run::connect(&args.target)?;
    let node = ports::node(run.file(), &args.node)?;
    let status = run.status();
    let health = status.nodes.iter().find(|health| health.node == node.name);
    if args.json {
        return output::json(&json!({ "node": node, "health": health }));
    }
    output::text(info_text(run.file(), node, health))
}

fn info_text(run: &RunFile, node: &NodeEntry, health: Option<&Health>) -> Report {
    let mut report = Report::default();
    let binary = node.exec.as_ref().map(|path| format!(" of {}", path.display())).unwrap_or_default();
    let place = process(run, &node.name);
    let place = if node.machine == run.machine { format!("in process {place}") } else { place };
    report.line(format_args!("{}: {}{binary} {place}", node.name, node.operator));
    let input = |input: &InputEntry| {
        let from = match (&input.from, input.external) {
            (Some(from), _) => format!("reads {from}"),
            (None, true) => "open for `carril pub`".to_owned(),
            (None, false) => "not connected".to_owned(),
        };
        vec![input.port.clone(), input.message_type.clone(), from, input_counts(health, &input.port)]
    };
    report.line("\ninputs");
    report.text(&output::rows(&node.inputs.iter().map(input).collect::<Vec<_>>()));
    let output = |port: &OutputEntry| {
        let readers = ports::readers(run, &format!("{}/{}", node.name, port.port));
        let readers = if readers.is_empty() { "nobody".to_owned() } else { readers.join(", ") };
        let note = if port.on_demand { ", made while somebody reads it" } else { "" };
        let connected = format!("read by {readers}{note}");
        vec![port.port.clone(), port.message_type.clone(), connected, output_counts(health, &port.port)]
    };
    report.line("\noutputs");
    report.text(&output::rows(&node.outputs.iter().map(output).collect::<Vec<_>>()));
    report.line("");
    match health {
        Some(health) => tell_health(&mut report, health),
        None => report.line("no health report yet"),
    }
    report
}

fn input_counts(health: Option<&Health>, port: &str) -> String {
    let input = health.and_then(|health| health.inputs.iter().find(|input| input.port == port));
    input.map_or_else(String::new, |input| {
        let (received, dropped, lost) = (input.received, input.dropped, input.lost);
        let (stale, refused) = (input.stale, input.refused);
        format!("{received} received, {dropped} dropped, {lost} lost, {stale} too old, {refused} refused")
    })
}

fn output_counts(health: Option<&Health>, port: &str) -> String {
    let counted = health.and_then(|health| health.outputs.iter().find(|output| output.port == port));
    counted.map_or_else(String::new, |counted| {
        let left = if counted.bytes > 0 { output::bytes(counted.bytes as f64) } else { "nothing".to_owned() };
        format!("{} sent, {left} to other processes", counted.sent)
    })
}

fn tell_health(report: &mut Report, health: &Health) {
    let triple = |p: Percentiles, unit_s: f64| {
        let [p50, p99, max] = [p.p50, p.p99, p.max].map(|value| time::span(value * unit_s));
        format!("p50 {p50}, p99 {p99}, max {max}")
    };
    let restarts = output::counted(u64::from(health.restarts), "restart");
    // Of a process that is down the supervisor tells the state, not the node.
    let since = health.pid.map(|_| format!(" for {}", time::span(health.stamp.since(health.since).as_secs_f64())));
    report.fact("state", format_args!("{}{}, {restarts}", drive::state_name(health.state), since.unwrap_or_default()));
    report.fact("steps", format_args!("{} ({:.1} Hz), {} samples sent", health.steps, health.rate_hz, health.sent));
    report.fact("step time", triple(health.step_us, 1e-6));
    if let Some(latency) = health.latency_us {
        report.fact("latency", triple(latency, 1e-6) + " (publication of the trigger to end of step)");
    }
    if let Some(age) = health.age_ms {
        report.fact("age", triple(age, 1e-3) + " (oldest exposure to end of step)");
    }
    let (overruns, missed, errors) = (health.overruns, health.missed_periods, health.errors);
    report.fact("trouble", format_args!("{overruns} overruns, {missed} missed periods, {errors} errors"));
    for complaint in nodes::complaints(std::slice::from_ref(health)) {
        report.line(complaint);
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{NodeState, OutputHealth, Stamp};

    use super::*;

    #[test]
    fn the_list_has_every_port_with_its_readers() {
        let run = ports::example_run();
        let expected = "\
car1  dataflow.yaml  2 nodes in 1 process

PORT              TYPE              PROCESS          READ BY
world/camera      carril/Image      world (DOWN)     decision/image
world/scan        carril/LaserScan  world (DOWN)     -
decision/command  carril/Command    decision (4711)  -
decision/goal     carril/Goal       decision (4711)  -               input, for `carril pub`
";
        assert_eq!(list_text(&run), expected, "the table");
        let mut run = run;
        run.nodes[0].machine = Some("laptop".into());
        let listed = list_text(&run);
        assert!(listed.contains("world/scan        carril/LaserScan  on laptop"), "another machine's: {listed}");
    }

    #[test]
    fn info_tells_connections_and_health() {
        let run = ports::example_run();
        let (state, since, stamp) =
            (NodeState::Running, Stamp::from_nanos(500_000_000), Stamp::from_nanos(3_000_000_000));
        let at_work = Health { pid: Some(4711), state, since, stamp, ..Health::default() };
        let outputs = vec![OutputHealth { port: "command".into(), sent: 1234, bytes: 12_340 }];
        let health = Health { node: "decision".into(), steps: 9, rate_hz: 30.0, outputs, ..at_work };
        let text = info_text(&run, &run.nodes[1], Some(&health)).to_string();
        for part in [
            "decision: decision in process decision (4711)",
            "reads world/camera",
            "open for `carril pub`",
            "1234 sent, 12.3 kB to other processes",
            "9 (30.0 Hz)",
            "running for 2.5 s, 0 restarts",
        ] {
            assert!(text.contains(part), "`{part}` is missing:\n{text}");
        }
    }
}
