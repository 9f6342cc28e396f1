//! `carril new operator NAME`: a crate with an operator of the user's own, ready to be built. What it writes are the examples of
//! `examples/`, under another name: so every template is compiled, linted and tested with carril itself.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand, ValueEnum};

use crate::common::graph_file::Usage;
use crate::common::output;

/// Arguments of `carril new`.
#[derive(Args)]
pub struct NewArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Write a crate with an operator of your own
    Operator(OperatorArgs),
}

/// Arguments of `carril new operator`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril new operator my-lane                       images in, lane estimates out
  carril new operator smooth --template filter      lane estimates in and out
  carril new operator my-lane --path ../my-lane --runtime-path ./runtime")]
struct OperatorArgs {
    /// Name of the operator, of its crate and binary: a-z, 0-9 and single `-`, beginning with a letter
    #[arg(value_name = "NAME")]
    name: String,
    /// What to begin with
    #[arg(long, value_enum, default_value_t = Template::Detector)]
    template: Template,
    /// Folder to make; NAME when left out
    #[arg(long, value_name = "DIR")]
    path: Option<PathBuf>,
    /// Folder of the crate `carril-runtime`; looked for above the new folder when left out, else taken from the repository
    #[arg(long, value_name = "DIR")]
    runtime_path: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Template {
    /// Finds the lane in images: may take the place of `lane-detector`
    Detector,
    /// Smooths lane estimates
    Filter,
}

/// One template: an example and what its README says of it.
struct Example {
    name: &'static str,
    summary: &'static str,
    module: &'static str,
    main: &'static str,
    operator: &'static str,
    input: &'static str,
    from: &'static str,
    config: &'static str,
}

const DETECTOR: Example = Example {
    name: "my-lane",
    summary: "camera images in, lane estimates out",
    module: "detector",
    main: include_str!("../../examples/my-lane/src/main.rs"),
    operator: include_str!("../../examples/my-lane/src/detector.rs"),
    input: "image",
    from: "world/camera",
    config: "level: 0.7",
};

const FILTER: Example = Example {
    name: "my-filter",
    summary: "lane estimates in, smoothed lane estimates out",
    module: "filter",
    main: include_str!("../../examples/my-filter/src/main.rs"),
    operator: include_str!("../../examples/my-filter/src/filter.rs"),
    input: "lane",
    from: "detector/lane",
    config: "smoothing: 0.3",
};

const README: &str = include_str!("../templates/operator.md");
const REPOSITORY: &str = env!("CARGO_PKG_REPOSITORY");
/// What `check_name` of carril allows for a kind of operator.
const MAX_NAME: usize = 48;
/// Names that Rust or cargo keep for themselves, among those that have the right form.
const RESERVED: [&str; 58] = [
    "abstract",
    "alloc",
    "as",
    "async",
    "await",
    "become",
    "box",
    "break",
    "build",
    "carril",
    "const",
    "continue",
    "core",
    "crate",
    "deps",
    "do",
    "dyn",
    "else",
    "enum",
    "examples",
    "extern",
    "final",
    "fn",
    "for",
    "gen",
    "if",
    "impl",
    "in",
    "incremental",
    "let",
    "loop",
    "macro",
    "match",
    "mod",
    "move",
    "mut",
    "override",
    "priv",
    "proc-macro",
    "pub",
    "ref",
    "return",
    "self",
    "static",
    "std",
    "struct",
    "super",
    "test",
    "trait",
    "try",
    "type",
    "typeof",
    "unsafe",
    "unsized",
    "use",
    "virtual",
    "where",
    "yield",
];

/// Runs it.
pub fn run(args: &NewArgs) -> Result<()> {
    let What::Operator(args) = &args.what;
    if let Err(reason) = check_name(&args.name) {
        let allowed = format!("allowed are up to {MAX_NAME} of a-z, 0-9 and single `-`, beginning with a letter");
        return Err(Usage(format!("`{}` {reason}; {allowed}\nhint: for example `my-lane`", args.name)).into());
    }
    let folder = args.path.clone().unwrap_or_else(|| PathBuf::from(&args.name));
    let runtime = Runtime::find(args.runtime_path.as_deref(), &folder)?;
    let example = match args.template {
        Template::Detector => &DETECTOR,
        Template::Filter => &FILTER,
    };
    let files = files(&args.name, example, &runtime)?;
    write(&folder, &files)?;
    output::text(next_steps(&args.name, &folder, example, &files))
}

fn check_name(name: &str) -> Result<(), &'static str> {
    let ok = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    if name.is_empty() || !name.chars().all(ok) {
        return Err("is no name of an operator");
    }
    if !name.starts_with(|c: char| c.is_ascii_lowercase()) {
        return Err("does not begin with a letter");
    }
    if name.ends_with('-') || name.contains("--") {
        return Err("has a `-` without something on both sides");
    }
    if name.len() > MAX_NAME {
        return Err("is too long");
    }
    if RESERVED.contains(&name) || name.starts_with("carril-") {
        return Err("is a name that Rust, cargo or carril itself uses");
    }
    Ok(())
}

/// Where `carril-runtime` comes from.
enum Runtime {
    /// A folder, and the `Cargo.lock` beside it.
    Folder(PathBuf, Option<PathBuf>),
    Repository,
}

impl Runtime {
    fn find(given: Option<&Path>, folder: &Path) -> Result<Self> {
        if let Some(given) = given {
            if !is_runtime(given) {
                let hint = "give the folder `runtime` of a checkout of carril";
                return Err(
                    Usage(format!("`{}` is not the crate `carril-runtime`\nhint: {hint}", given.display())).into()
                );
            }
            return Self::at(given);
        }
        let folder = std::path::absolute(folder).with_context(|| format!("`{}`", folder.display()))?;
        match folder.ancestors().map(|above| above.join("runtime")).find(|runtime| is_runtime(runtime)) {
            Some(runtime) => Self::at(&runtime),
            None => Ok(Self::Repository),
        }
    }

    fn at(folder: &Path) -> Result<Self> {
        let folder = fs::canonicalize(folder).with_context(|| format!("`{}`", folder.display()))?;
        let lock = folder.parent().map(|above| above.join("Cargo.lock")).filter(|lock| lock.is_file());
        Ok(Self::Folder(folder, lock))
    }

    /// What stands behind `carril-runtime =`.
    fn dependency(&self) -> String {
        match self {
            // A JSON string is a TOML string too.
            Self::Folder(folder, _) => format!("{{ path = {} }}", serde_json::json!(folder)),
            Self::Repository => format!("{{ git = \"{REPOSITORY}\" }}"),
        }
    }
}

fn is_runtime(folder: &Path) -> bool {
    fs::read_to_string(folder.join("Cargo.toml")).is_ok_and(|text| text.contains("name = \"carril-runtime\""))
}

/// Paths below the new folder, with their content.
fn files(name: &str, example: &Example, runtime: &Runtime) -> Result<Vec<(String, String)>> {
    let renamed = |text: &str| text.replace(example.name, name);
    let fill = [
        ("NAME", name),
        ("REPOSITORY", REPOSITORY),
        ("SUMMARY", example.summary),
        ("MODULE", example.module),
        ("INPUT", example.input),
        ("FROM", example.from),
        ("CONFIG", example.config),
    ];
    let readme = fill.iter().fold(README.to_owned(), |text, (mark, value)| text.replace(mark, value));
    let mut files = vec![
        ("Cargo.toml".to_owned(), manifest(name, example, runtime)),
        (".gitignore".to_owned(), "/target\n".to_owned()),
        ("README.md".to_owned(), readme),
        ("src/main.rs".to_owned(), renamed(example.main)),
        (format!("src/{}.rs", example.module), renamed(example.operator)),
    ];
    if let Runtime::Folder(_, Some(lock)) = runtime {
        // The versions that this carril was tested with.
        let lock = fs::read_to_string(lock).with_context(|| format!("`{}`", lock.display()))?;
        files.push(("Cargo.lock".to_owned(), lock));
    }
    Ok(files)
}

fn manifest(name: &str, example: &Example, runtime: &Runtime) -> String {
    let (version, dependency) = (env!("CARGO_PKG_RUST_VERSION"), runtime.dependency());
    format!(
        "[package]
name = \"{name}\"
description = \"An operator for carril: {}\"
version = \"0.1.0\"
edition = \"2024\"
rust-version = \"{version}\"
publish = false

[dependencies]
carril-runtime = {dependency}
# What the derives of the configuration and the state name.
schemars = \"1.2\"
serde = {{ version = \"1\", features = [\"derive\"] }}

# On its own, wherever the folder lies.
[workspace]
",
        example.summary
    )
}

/// Writes everything, or nothing where something is in the way.
fn write(folder: &Path, files: &[(String, String)]) -> Result<()> {
    let shown = folder.display();
    if let Some(above) = folder.parent().filter(|above| !above.as_os_str().is_empty()) {
        fs::create_dir_all(above).with_context(|| format!("`{}` cannot be made", above.display()))?;
    }
    match fs::create_dir(folder) {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            bail!("`{shown}` is there already, and nothing in it is overwritten\nhint: choose another NAME or `--path`")
        }
        made => made.with_context(|| format!("`{shown}` cannot be made"))?,
    }
    fs::create_dir(folder.join("src")).with_context(|| format!("`{shown}/src` cannot be made"))?;
    for (path, content) in files {
        let path = folder.join(path);
        fs::write(&path, content).with_context(|| format!("`{}` cannot be written", path.display()))?;
    }
    Ok(())
}

fn next_steps(name: &str, folder: &Path, example: &Example, files: &[(String, String)]) -> String {
    let dir = folder.display();
    // An `exec:` begins at the folder of the graph file, and without a `/` people take it for a command.
    let dot = if folder.is_absolute() || folder.starts_with("..") { "" } else { "./" };
    let binary = format!("{dot}{dir}/target/release/{name}");
    let written: Vec<&str> = files.iter().map(|(path, _)| path.as_str()).collect();
    format!(
        "wrote {dir}: {}

Build it; the first time takes some minutes, most of them for Zenoh:
  cargo build --release --manifest-path {dir}/Cargo.toml

Use it in a graph file of this folder, and see that it fits:
  lane:
    exec: {binary}
    inputs: {{ {}: {} }}

  carril check dataflow.yaml

Swap it in while the car drives, and look at what it says:
  carril swap lane --exec {binary}
  carril echo lane/lane
",
        written.join(", "),
        example.input,
        example.from
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_that_cargo_and_a_graph_take() {
        for good in ["my-lane", "lane2", "a", "lane-3-d"] {
            assert_eq!(check_name(good), Ok(()), "{good}");
        }
        let long = "x".repeat(49);
        for bad in
            ["", "My-lane", "2lane", "-lane", "lane-", "a--b", "my_lane", "a/b", "..", "fn", "test", "carril-x", &long]
        {
            assert!(check_name(bad).is_err(), "{bad}");
        }
        assert!(RESERVED.is_sorted(), "easy to look up");
    }

    #[test]
    fn templates_carry_nothing_of_the_example_they_come_from() {
        for example in [&DETECTOR, &FILTER] {
            let files = files("new-name", example, &Runtime::Repository).expect("nothing is read");
            for (path, content) in &files {
                assert!(!content.contains(example.name), "{path} still names `{}`", example.name);
                assert!(!content.contains("workspace = true"), "{path} needs no workspace of ours");
            }
            let readme = &files.iter().find(|(path, _)| path == "README.md").expect("it is written").1;
            let words = ["NAME", "REPOSITORY", "SUMMARY", "MODULE", "INPUT", "FROM", "CONFIG"];
            assert!(!words.iter().any(|word| readme.contains(word)), "all is filled in:\n{readme}");
            assert!(files[0].1.contains(&format!("git = \"{REPOSITORY}\"")), "the published form:\n{}", files[0].1);
        }
    }
}
