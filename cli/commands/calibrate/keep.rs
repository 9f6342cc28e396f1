//! Keeps what a calibration found: values and a record, in the calibration file that the graph names.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use carril_runtime::Registry;
use carril_runtime::graph::ReadOptions;
use carril_runtime::graph::calibration::{CalibrationFile, Record, Subject};
use carril_runtime::parameters::shown;
use clap::Args;
use serde_json::{Map, Value};

use super::dialogue;
use super::target::Target;
use crate::common::output;

/// Where results go.
#[derive(Args)]
pub struct KeepArgs {
    /// Save without asking
    #[arg(long, visible_alias = "yes", short_alias = 'y')]
    save: bool,
    /// Calibration file to write instead of the one that the graph names
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// The figures as JSON; asks nothing
    #[arg(long)]
    pub json: bool,
}

/// What was found.
pub struct Found {
    /// What was calibrated.
    pub subject: Subject,
    /// The values by their paths below the node's configuration.
    pub values: Map<String, Value>,
    /// What it rests on.
    pub figures: Map<String, Value>,
}

/// Asks, and saves. The file, if it was saved.
pub fn keep(found: &Found, target: &Target, args: &KeepArgs, registry: &Registry) -> Result<Option<PathBuf>> {
    let named = target.graph_with(&ReadOptions::default(), registry)?.calibration;
    let Some(file) = args.file.clone().or_else(|| named.clone()) else {
        return no_file(&target.graph, args);
    };
    if args.json && !args.save {
        return Ok(None);
    }
    let told = |join: char| {
        let values = found.values.iter().map(|(path, value)| format!("{path}{join}{}", shown(value)));
        values.collect::<Vec<_>>()
    };
    let named_values = told(' ').iter().map(|value| format!("{}.{value}", target.node)).collect::<Vec<_>>().join(", ");
    if !args.save && !dialogue::confirm(&format!("Save {named_values} in `{}`?", short(&file).display()))? {
        output::line("nothing was saved")?;
        return Ok(None);
    }
    let record = Record::now(found.subject, command_line(), found.figures.clone());
    let prepared = CalibrationFile::prepare(&file, &target.node, &found.values, &record)?;
    let options = ReadOptions { calibration: Some(prepared.text()), ..ReadOptions::default() };
    target.graph_with(&options, registry)?;
    prepared.save()?;
    if !args.json {
        output::line(format_args!("saved {named_values} in `{}`; in force at the next start", short(&file).display()))?;
        if target.run.is_some() {
            output::line(format_args!("to have it now: carril set {} {}", target.node, told('=').join(" ")))?;
        }
        if named.is_none_or(|named| !same_file(&named, &file)) {
            output::line(how_to_name(&target.graph, &file))?;
        }
    }
    Ok(Some(file))
}

/// Without a file nothing can be saved, which is an error only for who wants to.
fn no_file(graph: &Path, args: &KeepArgs) -> Result<Option<PathBuf>> {
    let how = how_to_name(graph, Path::new("car1.calibration.yaml"));
    if args.save {
        bail!(
            "nothing was saved: `{}` names no calibration file\nhint: {how}; or give --file FILE",
            short(graph).display()
        );
    }
    if !args.json {
        output::line(format_args!("to save it, {how}; or give --file FILE"))?;
    }
    Ok(None)
}

/// How the graph comes to take a file.
fn how_to_name(graph: &Path, file: &Path) -> String {
    let folder = graph.parent().unwrap_or(Path::new(""));
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let shown = if file.is_absolute() || file.parent() != Some(Path::new("")) {
        absolute(file).strip_prefix(absolute(folder)).map_or_else(|_| absolute(file), Path::to_owned)
    } else {
        file.to_owned()
    };
    format!("add `calibration: {}` at the top level of `{}`", shown.display(), short(graph).display())
}

/// From the working directory, where it lies below it.
fn short(path: &Path) -> &Path {
    std::env::current_dir().ok().and_then(|here| path.strip_prefix(here).ok()).unwrap_or(path)
}

fn same_file(a: &Path, b: &Path) -> bool {
    let real = |path: &Path| std::fs::canonicalize(path).or_else(|_| std::path::absolute(path)).ok();
    real(a) == real(b)
}

/// As it was typed, for the record.
pub fn command_line() -> String {
    let quoted = |arg: String| if arg.contains(char::is_whitespace) { format!("'{arg}'") } else { arg };
    let args: Vec<String> = std::env::args().skip(1).map(quoted).collect();
    format!("carril {}", args.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hint_names_the_file_as_the_graph_sees_it() {
        let how = |graph: &str, file: &str| how_to_name(Path::new(graph), Path::new(file));
        assert!(how("dataflow.yaml", "car1.yaml").starts_with("add `calibration: car1.yaml` at"), "beside it");
        assert!(how("/cars/a/graph.yaml", "/cars/a/x/car1.yaml").contains("`calibration: x/car1.yaml`"), "below it");
        assert!(how("/cars/a/graph.yaml", "/etc/car1.yaml").contains("`calibration: /etc/car1.yaml`"), "elsewhere");
    }
}
