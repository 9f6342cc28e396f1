//! The default graph while it drives: launched with the built binary, changed like a user changes it.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use carril_dashboard::access::{Access, KeyFile};
use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::{Change, Receipt, SwapRequest, SwapTerms};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// The program that users run.
pub const PROGRAM: &str = env!("CARGO_BIN_EXE_carril");
/// Folder with its keys, in the folder of its run.
const CONFIG: &str = "config";

/// A car at work. It is stopped when this is dropped.
pub struct Car {
    pub client: Client,
    run: Child,
    runs: tempfile::TempDir,
}

/// What takes the place of `lane`, or runs in its shadow.
#[derive(Clone, Copy)]
pub enum Candidate<'a> {
    /// The same operator with another threshold.
    Threshold(u64),
    /// The detector of carril.
    BuiltIn,
    /// A binary.
    Exec(&'a Path),
}

impl Car {
    /// Launches it, and lets it drive for some seconds.
    pub fn launch() -> Self {
        Self::start(Command::new(PROGRAM), runs(), Path::new("dataflow.yaml"))
    }

    /// Launches it with a section `remote:`, by a command that runs `carril` where it is to drive. `grant`: this name gets a key.
    pub fn launch_reachable(carril: Command, remote: &str, grant: &str) -> (Self, KeyFile) {
        let runs = runs();
        let mut access = Access::open(&runs.path().join(CONFIG), "car1").expect("a folder");
        let key = access.grant(grant).expect("a key");
        let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("dataflow.yaml"));
        let tracks = format!("track: {}/tracks/", env!("CARGO_MANIFEST_DIR"));
        let text = text.expect("the default graph").replace("track: tracks/", &tracks);
        let graph = runs.path().join("reachable.yaml");
        std::fs::write(&graph, format!("{text}\nremote:\n{remote}")).expect("the folder is writable");
        (Self::start(carril, runs, &graph), key)
    }

    fn start(mut carril: Command, runs: tempfile::TempDir, graph: &Path) -> Self {
        let run = carril
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["run", &graph.display().to_string(), "--for", "30m", "--quiet"])
            .env("CARRIL_RUN_DIR", runs.path())
            .env("CARRIL_CONFIG_DIR", runs.path().join(CONFIG))
            .stdout(Stdio::null())
            // What a busy machine does to the car is no row of the table.
            .stderr(Stdio::null())
            .spawn()
            .expect("`carril run` starts");
        let client = connect(runs.path());
        std::thread::sleep(Duration::from_secs(3));
        Self { client, run, runs }
    }

    /// The process of its gateway, `carril gateway`: no process of the graph.
    pub fn gateway_pid(&self) -> u32 {
        let is_gateway = |pid: &u32| {
            let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
            let parent = stat.rsplit_once(')').and_then(|(_, rest)| rest.split_whitespace().nth(1)?.parse().ok());
            parent == Some(self.run.id()) && line.split(|byte| *byte == 0).nth(1) == Some(b"gateway")
        };
        let processes = std::fs::read_dir("/proc").expect("Linux").flatten();
        let mut pids = processes.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
        pids.find(is_gateway).expect("the gateway runs")
    }

    /// The folder of its run.
    pub fn runs(&self) -> &Path {
        self.runs.path()
    }

    /// The process that a node runs in.
    pub fn pid(&self, node: &str) -> u32 {
        let run = find_run(self.runs.path(), None).expect("it runs");
        let process = run.nodes.iter().find(|entry| entry.name == node).map(|entry| entry.process.as_str());
        let entry = run.processes.iter().find(|entry| Some(entry.name.as_str()) == process);
        entry.and_then(|entry| entry.pid).expect("its process is up")
    }

    /// Asks for another version of `lane`.
    pub fn swap_lane(&self, candidate: Candidate<'_>, terms: SwapTerms) -> Receipt {
        let mut request = SwapRequest { node: "lane".into(), terms, ..SwapRequest::default() };
        match candidate {
            Candidate::Threshold(threshold) => drop(request.values.insert("threshold".into(), threshold.into())),
            Candidate::BuiltIn => request.operator = Some("lane-detector".into()),
            Candidate::Exec(path) => request.exec = Some(path.to_owned()),
        }
        self.client.change(&Change::Swap(request)).expect("the supervisor answers")
    }
}

fn runs() -> tempfile::TempDir {
    tempfile::Builder::new().prefix("cb").tempdir_in("/tmp").expect("a folder")
}

impl Drop for Car {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = kill(Pid::from_raw(self.run.id() as i32), Signal::SIGINT);
        let _ = self.run.wait();
    }
}

fn connect(runs: &Path) -> Client {
    let deadline = Instant::now() + Duration::from_secs(20);
    loop {
        match find_run(runs, None) {
            Ok(run) => return Client::open(run).expect("a client"),
            Err(error) => assert!(Instant::now() < deadline, "the run does not come up: {error}"),
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// `my-lane`, an operator in a binary of its own (examples/my-lane); says so and is `None` when it is not built.
pub fn my_lane(case: &str) -> Option<PathBuf> {
    let binary = Path::new(env!("CARGO_BIN_EXE_carril")).with_file_name("my-lane");
    if !binary.exists() {
        eprintln!("{case}: `{}` is not built: cargo build --release --workspace --bins", binary.display());
        return None;
    }
    Some(binary)
}
