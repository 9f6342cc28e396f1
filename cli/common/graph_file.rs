//! Reads the graph file that a command names, and shows what is wrong with it.

use std::fmt;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use anyhow::Result;
use carril_runtime::Registry;
use carril_runtime::graph::{Graph, Override, Problems, ReadOptions};
use clap::Args;

use super::suggest;

/// Arguments of all commands that read a graph file.
#[derive(Args)]
pub struct GraphArgs {
    /// The graph file
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    #[command(flatten)]
    pub overrides: OverrideArgs,
}

/// `--set`
#[derive(Args)]
pub struct OverrideArgs {
    /// Change one value of a node's configuration, for example lane.threshold=180; may be repeated
    #[arg(long = "set", value_name = "NODE.KEY=VALUE", value_parser = Override::parse)]
    pub overrides: Vec<Override>,
}

/// The command line is wrong: exit code 2.
#[derive(Debug)]
pub struct Usage(pub String);

impl fmt::Display for Usage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Usage {}

/// The graph file has problems, and they have been shown: exit code 1.
#[derive(Debug)]
pub struct Shown;

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the graph file has problems")
    }
}

impl std::error::Error for Shown {}

/// Reads a graph that shall run on the car. Problems and warnings go to standard error.
pub fn read(args: &GraphArgs, registry: &Registry) -> Result<Graph> {
    read_for(args, None, registry)
}

/// The same for another machine that runs nodes of it; `None`: for the car.
pub fn read_for(args: &GraphArgs, machine: Option<&str>, registry: &Registry) -> Result<Graph> {
    must_be_a_file(&args.file)?;
    let (overrides, machine) = (args.overrides.overrides.clone(), machine.map(str::to_owned));
    let options = ReadOptions { overrides, machine, ..ReadOptions::default() };
    let styled = styled(&std::io::stderr());
    match Graph::read(&args.file, registry, &options) {
        Ok(graph) => {
            if !graph.warnings.is_empty() {
                eprint!("{}", render(&graph.warnings, styled));
            }
            Ok(graph)
        }
        Err(problems) => {
            eprint!("{}", render(&problems, styled));
            Err(Shown.into())
        }
    }
}

/// The problems as a text that ends with a line end.
pub fn render(problems: &Problems, styled: bool) -> String {
    format!("{}\n", problems.render(styled).trim_end())
}

/// Whether a stream takes colours.
pub fn styled(stream: &impl IsTerminal) -> bool {
    stream.is_terminal() && std::env::var_os("NO_COLOR").is_none()
}

/// A file that is not there is a wrong command line, not a wrong graph.
pub fn must_be_a_file(path: &Path) -> Result<()> {
    if path.is_file() {
        return Ok(());
    }
    let shown = path.display();
    if path.is_dir() {
        return Err(Usage(format!("`{shown}` is a folder, not a graph file{}", hint(path, path))).into());
    }
    if path.exists() {
        return Err(Usage(format!("`{shown}` is no ordinary file")).into());
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Err(Usage(format!("there is no file `{shown}`{}", hint(path, folder))).into())
}

fn hint(path: &Path, folder: &Path) -> String {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return format!("\nhint: the folder `{}` is not there either", folder.display());
    };
    let is_yaml = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "yaml" || ending == "yml");
    let mut names: Vec<String> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(is_yaml)
        .map(|path| path.strip_prefix("./").unwrap_or(&path).display().to_string())
        .collect();
    names.sort();
    names.truncate(10);
    let otherwise = if names.is_empty() {
        "give the path of a graph file (.yaml)".to_owned()
    } else {
        format!("graph files there: {}", names.join(", "))
    };
    suggest::hint(&path.display().to_string(), names.iter().map(String::as_str), &otherwise)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_file_is_a_wrong_command_line_with_a_suggestion() {
        let dir = tempfile::tempdir().expect("a folder for the test");
        std::fs::write(dir.path().join("dataflow.yaml"), "").expect("a file can be written");
        let error = must_be_a_file(&dir.path().join("datafow.yaml")).expect_err("there is none");
        assert!(error.is::<Usage>(), "exit code 2: {error}");
        assert!(error.to_string().contains("did you mean"), "{error}");
        assert!(must_be_a_file(dir.path()).is_err(), "a folder is no file");
        assert!(must_be_a_file(&dir.path().join("dataflow.yaml")).is_ok(), "the file itself");
    }
}
