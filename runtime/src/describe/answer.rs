//! The answering side: what a program with operators says when it is asked, by a program or by a person.

use std::fmt::Write as _;
use std::io::{self, Read, Write};
use std::process::ExitCode;

use serde::Serialize;

use super::{CHECK_CONFIG, ConfigAnswer, ConfigQuestion, DESCRIBE};
use crate::registry::{OperatorKind, Registry};

/// Answers if the first argument asks for something: [`DESCRIBE`], [`CHECK_CONFIG`], `--help` or `--version`. `None`: it does not.
pub fn answer(registry: &Registry, arguments: &[String]) -> Option<ExitCode> {
    let result = match arguments.first().map(String::as_str) {
        Some(DESCRIBE) => print_json(&super::of(registry)),
        Some(CHECK_CONFIG) => check_config(registry),
        Some("--help" | "-h" | "help") => print(&help(registry, &program_name())),
        Some("--version" | "-V") => print(&format!("{}, with carril {}\n", program_name(), env!("CARGO_PKG_VERSION"))),
        _ => return None,
    };
    Some(match result {
        Ok(()) => ExitCode::SUCCESS,
        // Whoever asked has gone.
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    })
}

fn check_config(registry: &Registry) -> io::Result<()> {
    let mut text = String::new();
    io::stdin().read_to_string(&mut text)?;
    let question: ConfigQuestion = serde_json::from_str(&text).map_err(|error| {
        let form = r#"{"kind": "my-lane", "config": {}, "base_dir": ".", "probe_devices": false}"#;
        io::Error::other(format!("standard input is no question: {error}; a question is `{form}`"))
    })?;
    let Some(kind) = registry.get(&question.kind) else {
        let known: Vec<_> = registry.iter().map(|kind| format!("`{}`", kind.name)).collect();
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        return Err(io::Error::other(format!("this program has no operator `{}`; it has {known}", question.kind)));
    };
    print_json(&ConfigAnswer::of(kind, &question))
}

fn print_json(document: &impl Serialize) -> io::Result<()> {
    print(&(serde_json::to_string_pretty(document)? + "\n"))
}

fn print(text: &str) -> io::Result<()> {
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    stdout.flush()
}

fn program_name() -> String {
    let path = std::env::args_os().next().map(std::path::PathBuf::from).unwrap_or_default();
    path.file_name().map_or_else(|| "this program".to_owned(), |name| name.to_string_lossy().into_owned())
}

/// What the program is and how to use it.
fn help(registry: &Registry, program: &str) -> String {
    let mut text = format!("{program}: operators for graphs of carril {}\n", env!("CARGO_PKG_VERSION"));
    for kind in registry.iter() {
        let _ = write!(text, "\n{}: {}\n", kind.name, kind.summary);
        let ports = |mut text: String, word: &str, name: &str, message_type: &str, doc: &str| {
            let _ = writeln!(text, "  {word:<3} {name:<12} {message_type:<22} {doc}");
            text
        };
        for port in &kind.inputs {
            text = ports(text, "in", port.name, &port.message_type.name, &port.doc);
        }
        for port in &kind.outputs {
            text = ports(text, "out", port.name, &port.message_type.name, &port.doc);
        }
    }
    if let Some(kind) = registry.iter().next() {
        let _ = write!(
            text,
            "\nIn a graph file:\n\n{}\nthen `carril check FILE` and `carril run FILE`.\n",
            node_yaml(kind, program)
        );
    }
    let _ = write!(
        text,
        "\nArguments:\n  {DESCRIBE}      print what the operators are, as JSON\n  {CHECK_CONFIG}  read {{\"kind\", \"config\", \
         \"base_dir\", \"probe_devices\"}} from standard input, print what is wrong with it as JSON\n  --version\n  --help\n"
    );
    text
}

/// The lines of a graph file for this kind.
fn node_yaml(kind: &OperatorKind, program: &str) -> String {
    let mut text = format!("  {}:\n    exec: ./target/release/{program}\n", kind.name);
    let inputs: Vec<_> =
        kind.inputs.iter().filter(|port| !port.optional).map(|port| format!("{}: NODE/PORT", port.name)).collect();
    if !inputs.is_empty() {
        let _ = writeln!(text, "    inputs: {{ {} }}", inputs.join(", "));
    }
    text
}
