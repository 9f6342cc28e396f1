//! From `carril run` to the first steering command that derives from a frame, with the built binary and the default graph.

use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use carril_runtime::client::{Client, find_run};
use carril_runtime::messages::Stamp;

use crate::support::measure;
use crate::support::report::Row;

const ROUNDS: usize = 5;
/// What a five-node roslaunch takes until its first message, measured on this kind of machine, s.
const ROSLAUNCH_S: f64 = 1.6;

/// Measures a few starts.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let mut times: Vec<f64> = (0..ROUNDS).map(|_| start_s()).collect();
    times.sort_by(f64::total_cmp);
    emit(Row::against(
        "`carril run` to the first steering command, median, against roslaunch",
        times[ROUNDS / 2],
        "s",
        ROSLAUNCH_S,
    ));
}

fn start_s() -> f64 {
    let runs = tempfile::Builder::new().prefix("cb").tempdir_in("/tmp").expect("a folder");
    let begun_ns = measure::monotonic_ns();
    let mut child = Command::new(env!("CARGO_BIN_EXE_carril"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(["run", "dataflow.yaml", "--for", "8s", "--quiet"])
        .env("CARRIL_RUN_DIR", runs.path())
        .stdout(Stdio::null())
        .spawn()
        .expect("`carril run` starts");
    let deadline = Instant::now() + Duration::from_secs(8);
    let run = loop {
        match find_run(runs.path(), None) {
            Ok(run) => break run,
            Err(error) => assert!(Instant::now() < deadline, "the run does not come up: {error}"),
        }
        std::thread::sleep(Duration::from_millis(2));
    };
    let zero = run.clock_zero;
    let client = Client::open(run).expect("a client");
    let (first, heard) = mpsc::channel();
    let _guard = client
        .subscribe("actuator", "command", move |header, _, _| {
            if header.origins.oldest().is_some() {
                // Only the first is waited for.
                let _ = first.send(header.stamp);
            }
        })
        .expect("a subscription");
    let stamp: Stamp = heard.recv_timeout(Duration::from_secs(8)).expect("a steering command within eight seconds");
    drop(client);
    child.wait().expect("the run ends");
    (stamp.since(zero).as_nanos() as f64 - begun_ns as f64) * 1e-9
}
