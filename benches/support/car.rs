//! The default graph while it drives: launched with the built binary, changed like a user changes it.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::{Change, Receipt, SwapRequest, SwapTerms};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

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
        let runs = tempfile::Builder::new().prefix("cb").tempdir_in("/tmp").expect("a folder");
        let run = Command::new(env!("CARGO_BIN_EXE_carril"))
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["run", "dataflow.yaml", "--for", "30m", "--quiet"])
            .env("CARRIL_RUN_DIR", runs.path())
            .stdout(Stdio::null())
            // What a busy machine does to the car is no row of the table.
            .stderr(Stdio::null())
            .spawn()
            .expect("`carril run` starts");
        let client = connect(runs.path());
        std::thread::sleep(Duration::from_secs(3));
        Self { client, run, runs }
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
