//! Drives the built `carril` as a user does: a folder of runs of its own, standard output and error, exit code. Ends every
//! process that it started, in order, and no other.
//!
//! Waiting has a limit only so that a broken program fails instead of hanging; no test asserts how long something takes.
#![allow(dead_code, reason = "each test file uses a part of it")]

pub mod car;
pub mod chip;
pub mod page;
pub mod thorough;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tempfile::TempDir;

/// Longer than this nothing takes, even on a loaded machine.
pub const HANGS_AFTER: Duration = Duration::from_secs(60);

/// The folder of the project.
pub fn project() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A file of the project, as an argument.
pub fn project_file(path: &str) -> String {
    project().join(path).display().to_string()
}

/// Two ports in a row that are free now.
pub fn free_ports() -> u16 {
    for _ in 0..100 {
        let first = std::net::TcpListener::bind("127.0.0.1:0").expect("loopback has a free port");
        let port = first.local_addr().expect("it is bound").port();
        if port < u16::MAX && std::net::TcpListener::bind(("127.0.0.1", port + 1)).is_ok() {
            return port;
        }
    }
    panic!("no two free ports in a row");
}

/// What a command came to.
#[derive(Debug)]
pub struct Outcome {
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
    /// Exit code; `None`: ended by a signal.
    pub code: Option<i32>,
}

impl Outcome {
    /// Checks the exit code and gives standard output.
    #[track_caller]
    pub fn expect(self, code: i32) -> String {
        assert_eq!(self.code, Some(code), "exit code; stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        self.stdout
    }

    /// Checks that it failed with exit code `code` and gives standard error.
    #[track_caller]
    pub fn expect_error(self, code: i32) -> String {
        assert_eq!(self.code, Some(code), "exit code; stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        self.stderr
    }

    /// Code, standard output and standard error in one text, for a snapshot.
    pub fn report(&self) -> String {
        let code = self.code.map_or_else(|| "none".to_owned(), |code| code.to_string());
        format!("exit code: {code}\n--- stdout ---\n{}--- stderr ---\n{}", self.stdout, self.stderr)
    }
}

/// A folder of runs, where commands see only what was started in it.
pub struct Sandbox {
    dir: TempDir,
}

impl Sandbox {
    /// The built binary.
    pub const PROGRAM: &str = env!("CARGO_BIN_EXE_carril");

    /// An empty one.
    pub fn new() -> Self {
        // Sockets live in there, and their paths are short: not below a long TMPDIR.
        Self { dir: tempfile::Builder::new().prefix("carril").tempdir_in("/tmp").expect("a folder in /tmp") }
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    /// Writes a file into the folder.
    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.dir.path().join(name);
        std::fs::write(&path, content).expect("the folder of the test is writable");
        path
    }

    /// The command, ready to be started from the folder of the project.
    pub fn command(&self, args: &[&str]) -> Command {
        self.prepare(Command::new(Self::PROGRAM), args)
    }

    /// The same, of a command that begins in a special way: on another host, say.
    pub fn prepare(&self, mut command: Command, args: &[&str]) -> Command {
        command.args(args).current_dir(project()).stdin(Stdio::null());
        command.env("CARRIL_RUN_DIR", self.dir.path().join("runs")).env("NO_COLOR", "1").env("COLUMNS", "100");
        // Nothing is looked for in the network, and nothing of the user's is read or changed.
        command.env("CARRIL_SCOUTING", "off").env("CARRIL_CONFIG_DIR", self.dir.path().join("config"));
        command.env_remove("CARRIL_CONNECT");
        command.env_remove("CARRIL_LOG").env_remove("RUST_LOG").env_remove("RUST_BACKTRACE");
        command
    }

    /// Runs a command to its end.
    #[track_caller]
    pub fn carril(&self, args: &[&str]) -> Outcome {
        self.start(args).wait()
    }

    /// Starts a command.
    #[track_caller]
    pub fn start(&self, args: &[&str]) -> Running {
        Running::start(self.command(args))
    }

    /// Launches a graph and waits until every node of it runs.
    #[track_caller]
    pub fn launch(&self, file: &str, args: &[&str]) -> Running {
        let file = if Path::new(file).is_absolute() { file.to_owned() } else { project_file(file) };
        let mut all = vec!["run", file.as_str(), "--json"];
        all.extend(args);
        let mut run = self.start(&all);
        run.wait_for_output("the graph comes up", |output| output.contains("all-ready"));
        run
    }
}

/// A command at work.
pub struct Running {
    child: Child,
    stdout: Reader,
    stderr: Reader,
}

struct Reader {
    text: Arc<Mutex<String>>,
    thread: Option<JoinHandle<()>>,
}

impl Reader {
    fn start(mut stream: impl Read + Send + 'static) -> Self {
        let text = Arc::new(Mutex::new(String::new()));
        let shared = Arc::clone(&text);
        let thread = std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(count) = stream.read(&mut buffer)
                && count > 0
            {
                let text = String::from_utf8_lossy(&buffer[..count]);
                shared.lock().unwrap_or_else(PoisonError::into_inner).push_str(&text);
            }
        });
        Self { text, thread: Some(thread) }
    }

    fn text(&self) -> String {
        self.text.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Everything up to the end of the stream; as much as there is when a grandchild keeps the stream open.
    fn finish(&mut self) -> String {
        let begun = Instant::now();
        while self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
            && begun.elapsed() < Duration::from_secs(5)
        {
            std::thread::sleep(Duration::from_millis(5));
        }
        self.text()
    }
}

impl Running {
    /// Starts a command that was made ready.
    pub fn start(mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the built binary starts");
        let stdout = Reader::start(child.stdout.take().expect("stdout is piped"));
        let stderr = Reader::start(child.stderr.take().expect("stderr is piped"));
        Self { child, stdout, stderr }
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// What it has written so far, standard output and error.
    pub fn output(&self) -> (String, String) {
        (self.stdout.text(), self.stderr.text())
    }

    /// Waits until its standard output satisfies `ready`.
    #[track_caller]
    pub fn wait_for_output(&mut self, what: &str, ready: impl Fn(&str) -> bool) {
        let begun = Instant::now();
        while !ready(&self.stdout.text()) {
            self.must_be_alive(what);
            assert!(begun.elapsed() < HANGS_AFTER, "{what}: never seen in {:?}", self.output());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Fails with what it has said when it has ended.
    #[track_caller]
    pub fn must_be_alive(&mut self, what: &str) {
        let ended = self.child.try_wait().expect("a child can be asked");
        assert!(ended.is_none(), "{what}: it ended early with {ended:?}: {:?}", self.output());
    }

    /// Sends it a signal, as Ctrl-C does.
    pub fn signal(&self, signal: Signal) {
        let _ = kill(Pid::from_raw(self.child.id() as i32), signal);
    }

    /// Presses Ctrl-C and waits for the end.
    #[track_caller]
    pub fn interrupt(self) -> Outcome {
        self.signal(Signal::SIGINT);
        self.wait()
    }

    /// Waits for the end.
    #[track_caller]
    pub fn wait(mut self) -> Outcome {
        let begun = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().expect("a child can be waited for") {
                break status;
            }
            assert!(begun.elapsed() < HANGS_AFTER, "it hangs: {:?}", self.output());
            std::thread::sleep(Duration::from_millis(5));
        };
        Outcome { stdout: self.stdout.finish(), stderr: self.stderr.finish(), code: status.code() }
    }
}

impl Drop for Running {
    /// A test that failed half way: first in order, then for good.
    fn drop(&mut self) {
        if !matches!(self.child.try_wait(), Ok(None)) {
            return;
        }
        self.signal(Signal::SIGINT);
        let begun = Instant::now();
        while matches!(self.child.try_wait(), Ok(None)) && begun.elapsed() < Duration::from_secs(10) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Replaces what differs from machine to machine: the folder of the project.
pub fn neutral(text: &str) -> String {
    text.replace(&project().display().to_string(), "PROJECT")
}

/// A program of the workspace other than `carril`: built beside it, if it is not there yet, with what `carril` is built with.
pub fn program(name: &str) -> PathBuf {
    static BUILT: std::sync::Once = std::sync::Once::new();
    let folder = Path::new(env!("CARGO_BIN_EXE_carril")).parent().expect("a program lies in a folder");
    BUILT.call_once(|| {
        // With a test among the targets dependencies have the features of the tests: else Zenoh would be compiled once more.
        let mut cargo = cargo(&["build", "--workspace", "--bins", "--test", "cli_check", "--locked"]);
        let output = cargo.current_dir(project()).output().expect("cargo starts");
        assert!(output.status.success(), "the workspace builds:\n{}", String::from_utf8_lossy(&output.stderr));
    });
    folder.join(name)
}

/// Cargo, with the registry as it is on this machine, and the target folder and profile of this test.
pub fn cargo(args: &[&str]) -> Command {
    let profile = Path::new(env!("CARGO_BIN_EXE_carril")).parent().expect("a program lies in a folder");
    let target = profile.parent().expect("the folder of the profile lies in the target folder");
    let mut cargo = Command::new(env!("CARGO"));
    // What cargo tells a test of its package would make the build of `ring`, and with it Zenoh's, look out of date: twice, here and outside.
    for (name, _) in std::env::vars_os() {
        if name.to_str().is_some_and(|name| name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_")) {
            cargo.env_remove(name);
        }
    }
    cargo.args(args).args(["--offline", "--quiet"]).env("CARGO_TARGET_DIR", target).stdin(Stdio::null());
    if profile.ends_with("release") {
        cargo.arg("--release");
    }
    cargo
}
