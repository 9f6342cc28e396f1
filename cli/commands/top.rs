//! `carril top`: every node of a running graph, live. In a terminal a screen of its own; into a pipe a table a second.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use carril_runtime::control_plane::Status;
use clap::Args;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyModifiers};
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::Line;
use ratatui::widgets::{Cell, Paragraph, Row, Table};
use ratatui::{DefaultTerminal, Frame};
use serde_json::json;

use crate::common::live::Run;
use crate::common::report::Report;
use crate::common::usage::{Meter, Usage};
use crate::common::way::Target;
use crate::common::{interrupt, nodes, output, time};

/// `/proc` counts processor time in steps of 10 ms: over a shorter time a share says nothing.
const SHORTEST_LOOK: Duration = Duration::from_millis(500);

/// Arguments of `carril top`.
#[derive(Args)]
#[command(
    after_help = "Keys: q or Ctrl-C ends. Columns: STEP is the time a step takes, LATENCY from the publication of the \
        triggering sample to the end of the step, AGE from exposure to the end of the step, LOST what never arrived, \
        DROPPED what a newer sample pushed out or what was too old.

Examples:
  carril top
  carril top -n 1                one table, then end
  carril top --json --for 10s    one JSON object a second"
)]
pub struct TopArgs {
    /// End after this time, for example 30s or 2m
    #[arg(long = "for", value_name = "DURATION", value_parser = time::parse)]
    duration: Option<Duration>,
    /// End after N tables, one a second
    #[arg(short = 'n', long = "count", value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// One JSON object a second
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// Runs it.
pub fn run(args: &TopArgs) -> Result<()> {
    let run = Run::connect(&args.target)?;
    if args.json || args.count.is_some() || !std::io::stdout().is_terminal() {
        return tables(&run, args);
    }
    let mut terminal = ratatui::try_init().context("cannot take over the terminal; try `carril top -n 1`")?;
    let result = screen(&run, args, &mut terminal);
    ratatui::restore();
    result
}

fn tables(run: &Run, args: &TopArgs) -> Result<()> {
    let stopped = stopped_by_signal()?;
    let end = args.duration.map(|duration| Instant::now() + duration);
    let over = || stopped.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end);
    let (mut meter, looked) = (first_look(run), Instant::now());
    let mut shown = 0;
    while !over() && args.count.is_none_or(|count| shown < count) {
        let Some(status) = run.next_status(Duration::from_millis(200)) else {
            still_there(run)?;
            continue;
        };
        if shown == 0 && looked.elapsed() < SHORTEST_LOOK {
            continue;
        }
        let usages = usages(&status, &mut meter);
        if args.json {
            output::json_line(&as_json(&status, &usages))?;
        } else {
            output::text(as_text(run, &status, &usages))?;
        }
        shown += 1;
    }
    Ok(())
}

fn still_there(run: &Run) -> Result<()> {
    anyhow::ensure!(run.is_alive(), "the graph of robot `{}` has ended", run.file().robot);
    Ok(())
}

fn stopped_by_signal() -> Result<Arc<AtomicBool>> {
    let stopped = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&stopped);
    interrupt::on_interrupt(move || stop.store(true, Ordering::Relaxed))?;
    Ok(stopped)
}

/// A share of processor time needs two looks; the first is taken before the first status comes.
fn first_look(run: &Run) -> Meter {
    let mut meter = Meter::default();
    for pid in run.file().processes.iter().filter_map(|process| process.pid) {
        meter.look(pid);
    }
    meter
}

fn usages(status: &Status, meter: &mut Meter) -> Vec<Option<Usage>> {
    let mut seen = std::collections::HashMap::new();
    let mut look = |pid: u32| *seen.entry(pid).or_insert_with(|| meter.look(pid));
    status.nodes.iter().map(|node| node.pid.and_then(&mut look)).collect()
}

fn as_json(status: &Status, usages: &[Option<Usage>]) -> serde_json::Value {
    let with_usage = |(node, usage): (&carril_messages::Health, &Option<Usage>)| {
        let mut node = serde_json::to_value(node).unwrap_or_default();
        node["cpu_percent"] = usage.and_then(|usage| usage.cpu_percent).into();
        node["memory_b"] = usage.map(|usage| usage.memory_b).into();
        node
    };
    let nodes: Vec<_> = status.nodes.iter().zip(usages).map(with_usage).collect();
    json!({ "uptime_s": status.uptime_s, "fault": status.fault, "nodes": nodes, "machines": status.machines })
}

fn columns() -> Vec<&'static str> {
    nodes::COLUMNS.into_iter().chain(nodes::USAGE_COLUMNS).collect()
}

fn rows(status: &Status, usages: &[Option<Usage>]) -> Vec<Vec<String>> {
    let row = |(node, usage)| nodes::row(node).into_iter().chain(nodes::usage_row(node, usage)).collect();
    status.nodes.iter().zip(usages.iter().copied()).map(row).collect()
}

fn title(run: &Run, status: &Status) -> String {
    let file = run.file();
    let count = output::counted(status.nodes.len() as u64, "node");
    format!("{}  {}  {count}  up {}", file.robot, file.graph.display(), time::clock(status.uptime_s))
}

fn trouble(status: &Status) -> Vec<String> {
    let fault = status.fault.iter().map(|fault| format!("STOPPED by {}: {}", fault.node, fault.reason));
    fault.chain(status.machines.iter().map(nodes::elsewhere)).chain(nodes::complaints(&status.nodes)).collect()
}

fn as_text(run: &Run, status: &Status, usages: &[Option<Usage>]) -> Report {
    let mut report = Report::default();
    report.line(title(run, status));
    report.text(&output::table(&columns(), &rows(status, usages)));
    for line in trouble(status) {
        report.line(line);
    }
    report.line("");
    report
}

fn screen(run: &Run, args: &TopArgs, terminal: &mut DefaultTerminal) -> Result<()> {
    let end = args.duration.map(|duration| Instant::now() + duration);
    let mut meter = first_look(run);
    let mut status = Status::default();
    let mut usage = Vec::new();
    let stopped = stopped_by_signal()?;
    while !stopped.load(Ordering::Relaxed) && end.is_none_or(|end| Instant::now() < end) {
        still_there(run)?;
        if let Some(next) = run.last_status()
            && next.uptime_s != status.uptime_s
        {
            status = next;
            usage = usages(&status, &mut meter);
        }
        terminal.draw(|frame| draw(frame, &title(run, &status), &status, &usage)).context("cannot draw")?;
        if event::poll(Duration::from_millis(200)).context("cannot read the keyboard")? && wants_to_end()? {
            break;
        }
    }
    Ok(())
}

fn wants_to_end() -> Result<bool> {
    let Event::Key(key) = event::read().context("cannot read the keyboard")? else { return Ok(false) };
    let interrupt = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
    Ok(interrupt || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc))
}

fn draw(frame: &mut Frame, title: &str, status: &Status, usages: &[Option<Usage>]) {
    let trouble: Vec<Line> = trouble(status).into_iter().map(Line::from).collect();
    let rows = rows(status, usages);
    let heights = [
        Constraint::Length(1),
        Constraint::Min(2),
        Constraint::Length(trouble.len().min(8) as u16),
        Constraint::Length(1),
    ];
    let [head, body, foot, keys] = Layout::vertical(heights).areas(frame.area());
    frame.render_widget(Line::styled(title, Modifier::BOLD), head);
    frame.render_widget(table(&rows), body);
    frame.render_widget(Paragraph::new(trouble).style(Color::Red), foot);
    frame.render_widget(Line::styled("q ends", Modifier::DIM), keys);
}

fn table(rows: &[Vec<String>]) -> Table<'_> {
    let columns = columns();
    let right = |index: usize| columns[index].starts_with('>');
    let name = |index: usize| columns[index].trim_start_matches('>');
    let width = |index: usize| {
        let cells = rows.iter().map(|row| row[index].chars().count());
        Constraint::Length(cells.max().unwrap_or(0).max(name(index).len()) as u16)
    };
    let line = |index: usize, text: String| {
        let line = Line::from(text);
        Cell::from(if right(index) { line.right_aligned() } else { line })
    };
    let header = Row::new((0..columns.len()).map(|index| line(index, name(index).to_owned())));
    let body = rows.iter().map(|row| {
        let style = if row[1] == "running" { Style::new() } else { Style::new().fg(Color::Red) };
        Row::new(row.iter().enumerate().map(|(index, text)| line(index, text.clone()))).style(style)
    });
    Table::new(body, (0..columns.len()).map(width)).header(header.style(Modifier::REVERSED)).column_spacing(2)
}

#[cfg(test)]
mod tests {
    use carril_messages::{Health, NodeState};
    use carril_runtime::control_plane::{FaultReport, MachineStatus};
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    use super::*;

    #[test]
    fn the_screen_has_nodes_and_trouble() {
        let node = |name: &str, state| Health { node: name.into(), state, ..Health::default() };
        let status = Status {
            uptime_s: 61.0,
            nodes: vec![node("world", NodeState::Running), node("lane", NodeState::GaveUp)],
            fault: Some(FaultReport { node: "bridge".into(), reason: "too old".into() }),
            machines: vec![MachineStatus {
                machine: "laptop".into(),
                joined: false,
                since: carril_messages::Stamp::ZERO,
                nodes: vec!["lane".into()],
            }],
        };
        let mut terminal = Terminal::new(TestBackend::new(150, 10)).expect("a terminal in memory");
        terminal.draw(|frame| draw(frame, "car1", &status, &[None, None])).expect("it draws");
        let screen = terminal.backend().to_string();
        let away = "elsewhere: laptop (not joined): lane";
        for text in ["car1", "NODE", "world", "gave up", "STOPPED by bridge: too old", away, "q ends"] {
            assert!(screen.contains(text), "`{text}` is missing:\n{screen}");
        }
    }

    #[test]
    fn a_tiny_terminal_is_no_panic() {
        let mut terminal = Terminal::new(TestBackend::new(3, 2)).expect("a terminal in memory");
        terminal.draw(|frame| draw(frame, "car1", &Status::default(), &[])).expect("it draws");
    }
}
