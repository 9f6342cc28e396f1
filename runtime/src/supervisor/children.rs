//! One child process: started, listened to, waited for, and sent signals.

use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::Sender;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::sync::broadcast;

use super::monitor::Message;
use super::{Event, RunError};
use crate::transport::zenoh;

/// No line of a child is passed on longer, B.
const MAX_LINE_BYTES: u64 = 8 << 10;

/// What to start.
pub(super) struct Start<'a> {
    pub process: &'a str,
    pub program: &'a Path,
    pub arguments: &'a [String],
    pub run_dir: &'a Path,
    /// Which start of this process it is: tells the end of this child from that of an earlier one.
    pub generation: u32,
}

/// Starts a child. Its lines become events, its end a message.
pub(super) fn start(
    start: &Start<'_>,
    messages: &Sender<Message>,
    events: &broadcast::Sender<Event>,
) -> Result<u32, RunError> {
    let mut command = Command::new(start.program);
    command.args(start.arguments).arg("--run-dir").arg(start.run_dir).args(["--name", start.process]);
    // A group of its own: Ctrl-C in the terminal is for the supervisor alone, which stops the car first.
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).process_group(0);
    // What the user has set stays.
    if std::env::var_os(zenoh::THREADS.0).is_none() {
        command.env(zenoh::THREADS.0, zenoh::THREADS.1);
    }
    die_with_supervisor(&mut command);
    let mut child = spawn(&mut command).map_err(|reason| RunError::Spawn {
        process: start.process.to_owned(),
        program: start.program.to_owned(),
        reason,
    })?;
    let pid = child.id();
    if let Some(output) = child.stdout.take() {
        pass_on(start.process, output, events.clone());
    }
    if let Some(output) = child.stderr.take() {
        pass_on(start.process, output, events.clone());
    }
    wait(start.process.to_owned(), start.generation, child, messages.clone());
    Ok(pid)
}

/// Also a binary of the user's own that hangs before it comes to carril ends with its supervisor, however that ends. Processes of
/// ours ask once more whether it is still there: it may have died before this.
#[allow(unsafe_code, reason = "nothing safe runs between fork and exec; prctl is a system call and touches no memory")]
fn die_with_supervisor(command: &mut Command) {
    // SAFETY: only a system call is made, which is async-signal-safe.
    unsafe {
        command.pre_exec(|| nix::sys::prctl::set_pdeathsig(Signal::SIGKILL).map_err(std::io::Error::from));
    }
}

/// A program that was written just now counts as busy while any child that was forked meanwhile has not begun its own program.
fn spawn(command: &mut Command) -> std::io::Result<Child> {
    let mut tries_left = 50;
    loop {
        match command.spawn() {
            Err(error) if error.kind() == std::io::ErrorKind::ExecutableFileBusy && tries_left > 0 => {
                tries_left -= 1;
                std::thread::sleep(std::time::Duration::from_millis(10));
            }
            spawned => return spawned,
        }
    }
}

fn pass_on(process: &str, output: impl Read + Send + 'static, events: broadcast::Sender<Event>) {
    let process = process.to_owned();
    std::thread::spawn(move || {
        let mut reader = BufReader::new(output);
        loop {
            let mut line = Vec::new();
            match (&mut reader).take(MAX_LINE_BYTES).read_until(b'\n', &mut line) {
                Ok(0) | Err(_) => return,
                Ok(_) => {
                    let text = String::from_utf8_lossy(&line).trim_end().to_owned();
                    // Nobody may be listening.
                    let _ = events.send(Event::Line { process: process.clone(), text });
                }
            }
        }
    });
}

fn wait(process: String, generation: u32, mut child: Child, messages: Sender<Message>) {
    std::thread::spawn(move || {
        let status = child.wait();
        // The monitor may have given up on this child.
        let _ = messages.send(Message::Exited { process, generation, status: status.ok() });
    });
}

/// Sends a signal to a child that has not been waited for.
pub(super) fn signal(pid: u32, signal: Signal) {
    if let Ok(pid) = i32::try_from(pid)
        && let Err(error) = kill(Pid::from_raw(pid), signal)
    {
        tracing::debug!("{signal} to process {pid}: {error}");
    }
}

/// How a child ended, for people.
pub(super) fn describe(status: Option<ExitStatus>) -> String {
    match status.map(|status| (status.code(), status.signal())) {
        Some((Some(0), _)) => "ended".into(),
        Some((Some(code), _)) => format!("ended with exit code {code}"),
        Some((None, Some(number))) => {
            let name = Signal::try_from(number).map_or_else(|_| format!("signal {number}"), |s| s.to_string());
            format!("killed by {name}")
        }
        _ => "ended, nobody knows how".into(),
    }
}
