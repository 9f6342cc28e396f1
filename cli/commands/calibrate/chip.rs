//! The calibration that lives in a microcontroller: shows it, changes it, keeps it in a file and brings it back.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use carril_bridge::calibration::{Calibration, NO_PIN, Param, Spec};
use carril_bridge::workbench::Workbench;
use carril_runtime::Registry;
use carril_runtime::graph::calibration::{CalibrationFile, Record, Subject};
use carril_runtime::graph::{Graph, ReadOptions};
use clap::Args;
use serde_json::{Map, Value, json};

use super::dialogue;
use super::keep::command_line;
use crate::common::graph_file::{self, Usage};
use crate::common::output;

/// Where the stable names of serial ports are.
const BY_ID: &str = "/dev/serial/by-id";
const DEFAULT_BAUD: u32 = 500_000;

/// Which microcontroller.
#[derive(Args)]
pub struct ChipArgs {
    /// Its serial port, best below /dev/serial/by-id; no graph may be running on it
    #[arg(long, value_name = "PATH", conflicts_with = "graph")]
    port: Option<PathBuf>,
    /// Speed of the line, baud [default: that of the graph, or 500000]
    #[arg(long, value_name = "BAUD", value_parser = clap::value_parser!(u32).range(9_600..=2_000_000))]
    baud: Option<u32>,
    /// The graph file whose `mcu-link` node names port and speed
    #[arg(long, value_name = "FILE")]
    graph: Option<PathBuf>,
    /// Calibration file that gets a record of when and how [default: the one that the graph names]
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
}

impl ChipArgs {
    /// Speaks to it.
    pub fn open(&self, registry: &Registry) -> Result<Workbench> {
        let (port, baud) = self.port_and_baud(registry)?;
        Ok(Workbench::open(&port, self.baud.unwrap_or(baud))?)
    }

    fn record_file(&self, registry: &Registry) -> Result<Option<PathBuf>> {
        match (&self.record, &self.graph) {
            (Some(file), _) => Ok(Some(file.clone())),
            (None, Some(graph)) => Ok(read(graph, registry)?.calibration),
            (None, None) => Ok(None),
        }
    }

    fn port_and_baud(&self, registry: &Registry) -> Result<(PathBuf, u32)> {
        if let Some(port) = &self.port {
            return Ok((port.clone(), DEFAULT_BAUD));
        }
        let Some(file) = &self.graph else {
            let hint = match ports() {
                ports if ports.is_empty() => format!("nothing is below {BY_ID}: is it plugged in?"),
                ports => format!("there are:\n  {}", ports.join("\n  ")),
            };
            return Err(Usage(format!("say which microcontroller: --port PATH or --graph FILE; {hint}")).into());
        };
        let graph = read(file, registry)?;
        let links: Vec<_> =
            graph.nodes.iter().filter(|node| node.kind().is_some_and(|kind| kind.name == "mcu-link")).collect();
        let [link] = links[..] else {
            bail!("`{}` has {} nodes of kind `mcu-link`, expected one; use --port", file.display(), links.len());
        };
        let port = link.config["port"].as_str().unwrap_or_default().to_owned();
        if port.starts_with("sim:") {
            bail!("`{}`: node `{}` has the simulated line `{port}`; use --port", file.display(), link.name);
        }
        let baud = link.config["baud"].as_u64().and_then(|baud| u32::try_from(baud).ok()).unwrap_or(DEFAULT_BAUD);
        // As the node itself finds it: from the folder of the graph.
        let folder = file.parent().unwrap_or(Path::new(""));
        Ok((folder.join(port), baud))
    }
}

fn read(file: &Path, registry: &Registry) -> Result<Graph> {
    graph_file::must_be_a_file(file)?;
    Graph::read(file, registry, &ReadOptions::default()).map_err(|problems| {
        eprint!("{}", graph_file::render(&problems, false));
        anyhow!(graph_file::Shown)
    })
}

fn ports() -> Vec<String> {
    let entries = std::fs::read_dir(BY_ID).into_iter().flatten();
    let mut ports: Vec<String> = entries.flatten().map(|entry| entry.path().display().to_string()).collect();
    ports.sort();
    ports
}

/// Arguments of `carril calibrate show`.
#[derive(Args)]
pub struct ShowArgs {
    #[command(flatten)]
    chip: ChipArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn show(args: &ShowArgs, registry: &Registry) -> Result<()> {
    let mut bench = args.chip.open(registry)?;
    let calibration = bench.read()?;
    let stored = bench.is_stored()?;
    let firmware = bench.hello().map(|hello| hello.firmware.to_string()).unwrap_or_default();
    if args.json {
        return output::json(&json!({ "firmware": firmware, "stored": stored, "parameters": values(&calibration) }));
    }
    output::line(format_args!(
        "firmware {firmware}, calibration {:04x}, {}",
        calibration.crc(),
        if stored { "stored in the chip" } else { "not stored: it ends with the next restart" }
    ))?;
    output::text(table(&calibration))?;
    for problem in calibration.problems() {
        output::line(format_args!("problem: {problem}"))?;
    }
    Ok(())
}

fn table(calibration: &Calibration) -> String {
    let rows: Vec<Vec<String>> = Param::ALL
        .into_iter()
        .map(|param| {
            let Spec { name, unit, default, .. } = *param.spec();
            let unit = if unit == "-" { String::new() } else { unit.to_owned() };
            let changed = if calibration.get(param) == default { String::new() } else { default.to_string() };
            vec![name.to_owned(), shown(param, calibration.get(param)), unit, changed, param.allowed()]
        })
        .collect();
    output::table(&["parameter", ">value", "unit", ">default", "allowed"], &rows)
}

fn shown(param: Param, value: i32) -> String {
    if value == NO_PIN && param.allowed().contains("none") { "none".to_owned() } else { value.to_string() }
}

fn values(calibration: &Calibration) -> Map<String, Value> {
    Param::ALL.into_iter().map(|param| (param.spec().name.to_owned(), json!(calibration.get(param)))).collect()
}

/// Arguments of `carril calibrate set`.
#[derive(Args)]
#[command(after_help = "Pins count from the next start of the microcontroller.

Examples:
  carril calibrate set --port /dev/serial/by-id/... battery_low_mv=6800 lease_ramp_ms=100
  carril calibrate set --graph dataflows/hardware.yaml motor_forward_level=0")]
pub struct SetArgs {
    #[command(flatten)]
    chip: ChipArgs,
    /// Parameters and their values
    #[arg(value_name = "NAME=VALUE", required = true, value_parser = assignment)]
    values: Vec<(Param, i32)>,
    /// Do not ask
    #[arg(long)]
    yes: bool,
}

fn assignment(text: &str) -> Result<(Param, i32), String> {
    let (name, value) = text.split_once('=').ok_or_else(|| format!("got `{text}`, expected NAME=VALUE"))?;
    let param = Param::of(name.trim()).ok_or_else(|| {
        let names: Vec<&str> = Param::ALL.into_iter().map(|param| param.spec().name).collect();
        format!("there is no parameter `{name}`; there are: {}", names.join(", "))
    })?;
    let refused = || format!("{name}: got `{value}`, allowed is {}", param.allowed());
    let value = value.trim().parse().map_err(|_| refused())?;
    if param.allows(value) { Ok((param, value)) } else { Err(refused()) }
}

/// Runs it.
pub fn set(args: &SetArgs, registry: &Registry) -> Result<()> {
    let mut bench = args.chip.open(registry)?;
    let before = bench.read()?;
    let mut wanted = before;
    for (param, value) in &args.values {
        wanted.set(*param, *value).map_err(|status| anyhow!("{}: {}", param.spec().name, status.text()))?;
    }
    let kept = Kept { chip: &args.chip, subject: Subject::Chip, figures: Map::new(), yes: args.yes };
    store(&mut bench, (&before, &wanted), kept, registry)
}

/// How a calibration is kept.
pub struct Kept<'a> {
    /// Where its record goes.
    pub chip: &'a ChipArgs,
    /// What was calibrated.
    pub subject: Subject,
    /// What the values rest on, besides the values.
    pub figures: Map<String, Value>,
    /// Without asking.
    pub yes: bool,
}

/// Shows what changes, asks, stores it in the chip, and writes a record of it where there is a file for it.
pub fn store(
    bench: &mut Workbench,
    (before, wanted): (&Calibration, &Calibration),
    kept: Kept<'_>,
    registry: &Registry,
) -> Result<()> {
    let problems = wanted.problems();
    if !problems.is_empty() {
        bail!("this does not go together: {}; nothing was stored", problems.join("; "));
    }
    for param in Param::ALL.into_iter().filter(|param| before.get(*param) != wanted.get(*param)) {
        let (from, to) = (shown(param, before.get(param)), shown(param, wanted.get(param)));
        output::line(format_args!("{}: {from} -> {to}", param.spec().name))?;
    }
    let file = kept.chip.record_file(registry)?;
    if !kept.yes && !dialogue::confirm("Store this in the microcontroller?")? {
        bail!("nothing was stored");
    }
    bench.store(wanted)?;
    output::line(format_args!("stored, calibration {:04x}", wanted.crc()))?;
    let Some(file) = file else { return Ok(()) };
    let mut figures = kept.figures;
    figures.extend(values(wanted).into_iter().filter(|(name, value)| values(before).get(name) != Some(value)));
    figures.insert("calibration".to_owned(), format!("{:04x}", wanted.crc()).into());
    let record = Record::now(kept.subject, command_line(), figures);
    CalibrationFile::prepare(&file, "", &Map::new(), &record)?.save()?;
    output::line(format_args!("a record of it is in `{}`", file.display()))
}

/// Arguments of `carril calibrate backup`.
#[derive(Args)]
pub struct BackupArgs {
    #[command(flatten)]
    chip: ChipArgs,
    /// The file, JSON
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

/// Runs it.
pub fn backup(args: &BackupArgs, registry: &Registry) -> Result<()> {
    let calibration = args.chip.open(registry)?.read()?;
    let text = serde_json::to_string_pretty(&json!({ "parameters": values(&calibration) }))? + "\n";
    std::fs::write(&args.file, text).with_context(|| format!("cannot write `{}`", args.file.display()))?;
    output::line(format_args!("calibration {:04x} is in {}", calibration.crc(), args.file.display()))
}

/// Arguments of `carril calibrate restore`.
#[derive(Args)]
pub struct RestoreArgs {
    #[command(flatten)]
    chip: ChipArgs,
    /// A file that `carril calibrate backup` or `show --json` wrote
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Do not ask
    #[arg(long)]
    yes: bool,
}

/// Runs it.
pub fn restore(args: &RestoreArgs, registry: &Registry) -> Result<()> {
    let shown = args.file.display();
    let text = std::fs::read_to_string(&args.file).with_context(|| format!("cannot read `{shown}`"))?;
    let wanted = read_backup(&text).with_context(|| format!("`{shown}`"))?;
    let mut bench = args.chip.open(registry)?;
    let before = bench.read()?;
    let kept = Kept { chip: &args.chip, subject: Subject::Chip, figures: Map::new(), yes: args.yes };
    store(&mut bench, (&before, &wanted), kept, registry)
}

/// Every parameter must be there: what a file does not say would be left to chance.
fn read_backup(text: &str) -> Result<Calibration> {
    let file: Value = serde_json::from_str(text)?;
    let entries = file["parameters"].as_object().context("it has no `parameters`")?;
    let mut calibration = Calibration::default();
    for (name, value) in entries {
        let param = Param::of(name).with_context(|| format!("there is no parameter `{name}`"))?;
        let number = value.as_i64().and_then(|value| i32::try_from(value).ok());
        let allowed = number.filter(|value| param.allows(*value));
        let number = allowed.with_context(|| format!("{name}: got {value}, allowed is {}", param.allowed()))?;
        calibration.set(param, number).map_err(|status| anyhow!("{name}: {}", status.text()))?;
    }
    let missing: Vec<&str> =
        Param::ALL.into_iter().map(|param| param.spec().name).filter(|name| !entries.contains_key(*name)).collect();
    if !missing.is_empty() {
        bail!("it lacks {}", missing.join(", "));
    }
    Ok(calibration)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_backup_comes_back_and_a_damaged_one_is_named() {
        let mut calibration = Calibration::default();
        calibration.set(Param::ServoLeftUs, 1_500).expect("a pulse");
        let text = json!({ "parameters": values(&calibration) }).to_string();
        assert_eq!(read_backup(&text).expect("it is whole"), calibration, "there and back");
        let cases = [
            ("", "EOF"),
            ("{}", "no `parameters`"),
            (r#"{"parameters": {"servo_pin": 9}}"#, "it lacks servo_right_us"),
            (r#"{"parameters": {"servo_pim": 9}}"#, "no parameter `servo_pim`"),
            (r#"{"parameters": {"servo_pin": 99}}"#, "got 99, allowed is 2 to 19"),
            (r#"{"parameters": {"servo_pin": 9.5}}"#, "got 9.5"),
            (r#"{"parameters": {"servo_pin": 1e99}}"#, "allowed is 2 to 19"),
        ];
        for (text, said) in cases {
            let error = format!("{:#}", read_backup(text).expect_err("refused"));
            assert!(error.contains(said), "{text}: {error}");
        }
    }

    #[test]
    fn assignments_are_checked_before_anything_is_asked() {
        assert_eq!(assignment("lease_ramp_ms=100"), Ok((Param::LeaseRampMs, 100)), "one that is allowed");
        for (text, said) in [
            ("lease_ramp_ms", "expected NAME=VALUE"),
            ("lease_ramp=1", "there is no parameter `lease_ramp`"),
            ("lease_ramp_ms=2000", "got `2000`, allowed is 0 to 1000 ms"),
            ("motor_pwm_pin=4", "allowed is 3, 5, 6 or 11"),
            ("motor_pwm_pin=x", "got `x`"),
        ] {
            let error = assignment(text).expect_err("refused");
            assert!(error.contains(said), "{text}: {error}");
        }
    }
}
