//! The asking side: runs a program with one argument, within limits, and reads its answer.

use std::collections::HashSet;
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use carril_messages::key::check_name;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::{CHECK_CONFIG, ConfigAnswer, ConfigQuestion, DESCRIBE, DescribeError, Description, FORMAT};

/// A program has this long to answer.
pub const PATIENCE: Duration = Duration::from_secs(5);
/// No answer is longer, B.
pub const MAX_OUTPUT_BYTES: u64 = 1 << 20;
/// So much of standard error is kept, B.
const MAX_ERROR_BYTES: u64 = 64 << 10;
/// No line of it is shown longer, characters.
const MAX_SAID: usize = 200;
/// How often the end of a program is looked for.
const LOOK: Duration = Duration::from_millis(2);
/// `Exec format error` in errno(3); the library has no name for it.
const ENOEXEC: i32 = 8;

/// Asks a program what its operators are. Runs it with [`DESCRIBE`].
pub fn ask(path: &Path) -> Result<Description, DescribeError> {
    let asked = Asked { path, argument: DESCRIBE, patience: PATIENCE };
    let description: Description = asked.read(&asked.run(&[])?)?;
    asked.check_names(&description)?;
    Ok(description)
}

/// Asks a program about a configuration. Runs it with [`CHECK_CONFIG`].
pub fn ask_config(path: &Path, question: &ConfigQuestion) -> Result<ConfigAnswer, DescribeError> {
    let asked = Asked { path, argument: CHECK_CONFIG, patience: PATIENCE };
    let question = serde_json::to_vec(question).map_err(|error| asked.garbage(&error))?;
    asked.read(&asked.run(&question)?)
}

/// A question to a program.
struct Asked<'a> {
    path: &'a Path,
    argument: &'static str,
    patience: Duration,
}

impl Asked<'_> {
    /// Runs the program and gives what it wrote.
    fn run(&self, input: &[u8]) -> Result<Vec<u8>, DescribeError> {
        self.must_be_executable()?;
        let until = Instant::now() + self.patience;
        let mut child = self.spawn(until)?;
        let answer = self.attend(&mut child, input, until);
        if answer.is_err() {
            // It may have ended by itself meanwhile.
            let _ = child.kill();
            let _ = child.wait();
        }
        answer
    }

    fn must_be_executable(&self) -> Result<(), DescribeError> {
        let path = self.path.to_owned();
        match std::fs::metadata(self.path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Err(DescribeError::Missing { path }),
            Err(reason) => Err(DescribeError::Start { path, reason }),
            Ok(metadata) if !metadata.is_file() => Err(DescribeError::NoFile { path }),
            Ok(metadata) if metadata.permissions().mode() & 0o111 == 0 => Err(DescribeError::NotExecutable { path }),
            Ok(_) => Ok(()),
        }
    }

    fn spawn(&self, until: Instant) -> Result<Child, DescribeError> {
        let mut command = Command::new(self.path);
        command.arg(self.argument).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        loop {
            let path = || self.path.to_owned();
            match command.spawn() {
                Ok(child) => return Ok(child),
                // Its build is just writing it.
                Err(error) if error.kind() == ErrorKind::ExecutableFileBusy && Instant::now() < until => {
                    std::thread::sleep(LOOK);
                }
                Err(error) if error.raw_os_error() == Some(ENOEXEC) => {
                    return Err(DescribeError::OtherMachine { path: path(), machine: std::env::consts::ARCH });
                }
                Err(error) if error.kind() == ErrorKind::NotFound => {
                    let reason = io::Error::new(error.kind(), "the interpreter or loader that it needs does not exist");
                    return Err(DescribeError::Start { path: path(), reason });
                }
                Err(reason) => return Err(DescribeError::Start { path: path(), reason }),
            }
        }
    }

    fn attend(&self, child: &mut Child, input: &[u8], until: Instant) -> Result<Vec<u8>, DescribeError> {
        let hangs = || DescribeError::Hangs { path: self.path.into(), argument: self.argument, limit: self.patience };
        feed(child, input);
        let output = collect(child.stdout.take(), MAX_OUTPUT_BYTES + 1);
        let said = collect(child.stderr.take(), MAX_ERROR_BYTES);
        let output = output.recv_timeout(left(until)).map_err(|_| hangs())?;
        if output.len() as u64 > MAX_OUTPUT_BYTES {
            let (path, argument, limit) = (self.path.into(), self.argument, MAX_OUTPUT_BYTES);
            return Err(DescribeError::TooMuch { path, argument, limit });
        }
        let status = wait(child, until).ok_or_else(hangs)?;
        if status.success() {
            return Ok(output);
        }
        let said = said.recv_timeout(left(until)).unwrap_or_default();
        let (path, argument, how) = (self.path.into(), self.argument, status.to_string());
        Err(DescribeError::Failed { path, argument, how, said: last_line(&said) })
    }

    /// Reads an answer. The format comes first: what else a document of another format has is not known.
    fn read<T: DeserializeOwned>(&self, output: &[u8]) -> Result<T, DescribeError> {
        if output.trim_ascii().is_empty() {
            return Err(self.garbage(&"it is empty"));
        }
        let value: Value = serde_json::from_slice(output).map_err(|error| {
            let begin: String = String::from_utf8_lossy(output).trim_start().chars().take(40).collect();
            self.garbage(&format_args!("{error}; it begins with {begin:?}"))
        })?;
        match value["format"].as_u64() {
            Some(got) if got == u64::from(FORMAT) => {
                serde_path_to_error::deserialize(value).map_err(|error| self.garbage(&error))
            }
            Some(got) => Err(DescribeError::OtherFormat { path: self.path.into(), got, expected: FORMAT }),
            None => Err(self.garbage(&"it has no `format`")),
        }
    }

    fn garbage(&self, reason: &impl ToString) -> DescribeError {
        let (path, argument) = (self.path.into(), self.argument);
        DescribeError::Garbage { path, argument, reason: reason.to_string() }
    }

    /// What the compiler and the registry see to in an operator of this program.
    fn check_names(&self, description: &Description) -> Result<(), DescribeError> {
        if description.operators.is_empty() {
            return Err(self.garbage(&"it has no operators"));
        }
        let mut kinds = HashSet::new();
        for operator in &description.operators {
            if !kinds.insert(&operator.name) {
                return Err(self.garbage(&format_args!("it has two operators `{}`", operator.name)));
            }
            check_name(&operator.name).map_err(|error| self.garbage(&format_args!("operator {error}")))?;
            let inputs = operator.inputs.iter().map(|port| port.name);
            for port in inputs.chain(operator.outputs.iter().map(|port| port.name)) {
                check_name(port)
                    .map_err(|error| self.garbage(&format_args!("operator `{}`: port {error}", operator.name)))?;
            }
        }
        Ok(())
    }
}

/// Writes the question; a program that does not read it says so in its answer, or in none.
fn feed(child: &mut Child, input: &[u8]) {
    let Some(mut stdin) = child.stdin.take() else { return };
    let input = input.to_owned();
    std::thread::spawn(move || drop(stdin.write_all(&input)));
}

/// Reads up to `limit` bytes, on a thread of its own: a program that fills one pipe must not block on the other.
fn collect(stream: Option<impl Read + Send + 'static>, limit: u64) -> Receiver<Vec<u8>> {
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        // What was read before an error is all that there is.
        let _ = stream.map(|stream| stream.take(limit).read_to_end(&mut bytes));
        // Nobody may be waiting any more.
        let _ = sender.send(bytes);
    });
    receiver
}

fn left(until: Instant) -> Duration {
    until.saturating_duration_since(Instant::now())
}

fn wait(child: &mut Child, until: Instant) -> Option<ExitStatus> {
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return Some(status),
            Ok(None) if Instant::now() < until => std::thread::sleep(LOOK),
            Ok(None) | Err(_) => return None,
        }
    }
}

fn last_line(said: &[u8]) -> String {
    let said = String::from_utf8_lossy(said);
    // Rust adds a note on backtraces to what a panic says.
    let line = said.lines().rfind(|line| !line.trim().is_empty() && !line.starts_with("note: "));
    line.unwrap_or_default().trim().chars().take(MAX_SAID).collect()
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn script(folder: &tempfile::TempDir, body: &str) -> PathBuf {
        let path = folder.path().join("program");
        std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).expect("writable");
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).expect("ours");
        path
    }

    fn refused(body: &str) -> DescribeError {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = script(&folder, body);
        let asked = Asked { path: &path, argument: DESCRIBE, patience: PATIENCE };
        let result = asked.run(&[]).and_then(|output| {
            let description: Description = asked.read(&output)?;
            asked.check_names(&description)
        });
        result.expect_err("it is no description")
    }

    fn operator(name: &str) -> String {
        format!(
            r#"{{"name":"{name}","summary":"s","inputs":[],"outputs":[],"state_name":"{name}","state_version":1,"config_schema":{{}},"has_defaults":true}}"#
        )
    }

    fn document(operators: &[String]) -> String {
        format!(r#"{{"format":{FORMAT},"carril":"0.1.0","operators":[{}]}}"#, operators.join(","))
    }

    #[test]
    fn reads_a_description() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = script(&folder, &format!("echo '{}'", document(&[operator("one")])));
        let description = ask(&path).expect("a description");
        assert_eq!(description.operators[0].name, "one", "{description:?}");
    }

    #[test]
    fn says_what_stands_in_the_place_of_a_program() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let missing = ask(&folder.path().join("nothing")).expect_err("no file");
        assert!(matches!(missing, DescribeError::Missing { .. }) && missing.is_missing(), "{missing}");
        assert!(missing.hint().contains("cargo build"), "{}", missing.hint());
        assert!(matches!(ask(folder.path()), Err(DescribeError::NoFile { .. })), "a folder");
        let text = folder.path().join("text");
        std::fs::write(&text, "hello").expect("writable");
        assert!(matches!(ask(&text), Err(DescribeError::NotExecutable { .. })), "a text");
    }

    #[test]
    fn a_program_for_another_machine_is_told_from_a_missing_one() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = script(&folder, "");
        // An ELF header whose machine (bytes 18 and 19) is none that exists.
        let mut header = b"\x7fELF\x02\x01\x01".to_vec();
        header.resize(64, 0);
        (header[16], header[18], header[19]) = (2, 0xfe, 0xfe);
        std::fs::write(&path, header).expect("writable");
        let error = ask(&path).expect_err("another machine");
        assert!(matches!(error, DescribeError::OtherMachine { .. }), "{error}");
        std::fs::write(&path, "#!/no/such/interpreter\n").expect("writable");
        let error = ask(&path).expect_err("no interpreter").to_string();
        assert!(error.contains("interpreter or loader"), "{error}");
    }

    #[test]
    fn a_program_that_fails_is_quoted() {
        let error = refused("echo first >&2; echo 'no camera' >&2; exit 3").to_string();
        assert!(error.ends_with("program --describe` failed (exit status: 3): no camera"), "{error}");
        let error = refused("kill -SEGV $$").to_string();
        assert!(error.contains("SIGSEGV"), "{error}");
    }

    #[test]
    fn garbage_is_no_description() {
        for (body, says) in [
            ("", "it is empty"),
            ("echo hello", "it begins with \"hello"),
            ("echo '{}'", "no `format`"),
            ("echo '{\"format\": 1}'", "missing field"),
            ("printf '\\377\\376'", "it begins with"),
        ] {
            let error = refused(body);
            assert!(matches!(error, DescribeError::Garbage { .. }), "{body}: {error}");
            assert!(error.to_string().contains(says), "{body}: {error}");
        }
    }

    #[test]
    fn names_that_cannot_be_are_refused() {
        for (operators, says) in [
            (vec![], "no operators"),
            (vec![operator("one"), operator("one")], "two operators `one`"),
            (vec![operator("One")], "no valid name"),
            (
                vec![operator("one").replace(
                    r#""outputs":[]"#,
                    r#""outputs":[{"name":"a/b","doc":"","message_type":{"name":"x","version":1},"on_demand":false}]"#,
                )],
                "port `a/b` is no valid name",
            ),
        ] {
            let error = refused(&format!("echo '{}'", document(&operators))).to_string();
            assert!(error.contains(says), "{error}");
        }
    }

    #[test]
    fn another_format_is_named_before_anything_else_is_read() {
        let error = refused("echo '{\"format\": 7, \"everything\": \"else\"}'");
        assert!(matches!(error, DescribeError::OtherFormat { got: 7, expected: FORMAT, .. }), "{error}");
    }

    #[test]
    fn a_program_that_hangs_or_writes_without_end_is_ended() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let pid_file = folder.path().join("pid");
        for (body, says) in [("exec sleep 600", "no answer within 0.2 s"), ("exec 1>&-; exec sleep 600", "0.2 s")] {
            let path = script(&folder, &format!("echo $$ > {}\n{body}", pid_file.display()));
            let asked = Asked { path: &path, argument: DESCRIBE, patience: Duration::from_millis(200) };
            let error = asked.run(&[]).expect_err("it sleeps").to_string();
            assert!(error.contains(says), "{error}");
            let pid = std::fs::read_to_string(&pid_file).unwrap_or_default();
            assert!(!pid.is_empty() && !Path::new("/proc").join(pid.trim()).exists(), "process {pid} is gone");
        }
        let error = refused("while :; do echo aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa; done");
        assert!(matches!(error, DescribeError::TooMuch { .. }), "{error}");
    }
}
