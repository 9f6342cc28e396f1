//! Why a program does not say what its operators are.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use thiserror::Error;

/// Why a program does not say what its operators are.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DescribeError {
    /// There is no such file.
    #[error("`{}` does not exist", path.display())]
    Missing {
        /// The program.
        path: PathBuf,
    },
    /// It is a folder or the like.
    #[error("`{}` is no file", path.display())]
    NoFile {
        /// The program.
        path: PathBuf,
    },
    /// It may not be executed.
    #[error("`{}` is not executable (`chmod +x` makes it so)", path.display())]
    NotExecutable {
        /// The program.
        path: PathBuf,
    },
    /// It was built for another machine, or is no program at all.
    #[error("`{}` is no program for this machine ({machine})", path.display())]
    OtherMachine {
        /// The program.
        path: PathBuf,
        /// What this machine is.
        machine: &'static str,
    },
    /// It cannot be started for another reason.
    #[error("`{}` cannot be started: {reason}", path.display())]
    Start {
        /// The program.
        path: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// It failed.
    #[error("`{} {argument}` failed ({how}){}", path.display(), quoted(said))]
    Failed {
        /// The program.
        path: PathBuf,
        /// What it was asked.
        argument: &'static str,
        /// Its exit code or signal.
        how: String,
        /// The last line on its standard error; may be empty.
        said: String,
    },
    /// It does not end.
    #[error("`{} {argument}` gave no answer within {} s and was ended", path.display(), limit.as_secs_f64())]
    Hangs {
        /// The program.
        path: PathBuf,
        /// What it was asked.
        argument: &'static str,
        /// How long it had.
        limit: Duration,
    },
    /// It writes without end.
    #[error("`{} {argument}` wrote more than {limit} bytes and was ended", path.display())]
    TooMuch {
        /// The program.
        path: PathBuf,
        /// What it was asked.
        argument: &'static str,
        /// How much it may write.
        limit: u64,
    },
    /// What it wrote is no answer.
    #[error("`{} {argument}` wrote no answer: {reason}", path.display())]
    Garbage {
        /// The program.
        path: PathBuf,
        /// What it was asked.
        argument: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// It was built with a carril whose answers are of another format.
    #[error("`{}` answers in format {got}, this carril reads format {expected}", path.display())]
    OtherFormat {
        /// The program.
        path: PathBuf,
        /// Its format.
        got: u64,
        /// Ours.
        expected: u32,
    },
}

fn quoted(said: &str) -> String {
    if said.is_empty() { String::new() } else { format!(": {said}") }
}

impl DescribeError {
    /// What to do.
    pub fn hint(&self) -> String {
        match self {
            Self::Missing { .. } | Self::NoFile { .. } | Self::NotExecutable { .. } => {
                "build it first (`cargo build --release`); the path begins at the folder of the graph file".into()
            }
            Self::OtherMachine { machine, .. } => {
                format!(
                    "build it on this machine, or for it: `cargo build --release --target {machine}-unknown-linux-gnu`"
                )
            }
            Self::Start { .. } => "try it by hand: `PROGRAM --help`".into(),
            Self::Failed { path, argument, .. } | Self::Hangs { path, argument, .. } => {
                format!("try `{} {argument}` by hand; {MAIN}", shell(path))
            }
            Self::TooMuch { .. } | Self::Garbage { .. } => {
                format!("nothing else may be written to standard output; {MAIN}")
            }
            Self::OtherFormat { .. } => "build it anew with the `carril-runtime` of this version of carril".into(),
        }
    }

    /// Whether there is no program at all, rather than one that gives no answer.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Missing { .. } | Self::NoFile { .. } | Self::NotExecutable { .. })
    }
}

const MAIN: &str = "its `main` must begin with `carril_runtime::process::main_from_arguments`";

fn shell(path: &Path) -> String {
    let path = path.display().to_string();
    if path.contains(char::is_whitespace) { format!("'{path}'") } else { path }
}
