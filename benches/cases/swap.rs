//! A node of the default graph replaced while it drives: how long the request takes, and how long its outputs pause.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::{Change, Outcome, Receipt, SwapRequest, SwapTerms};
use serde_json::{Map, Value, json};

use crate::support::report::Row;

const ROUNDS: usize = 15;
/// Between two frames of the default camera, ms.
const CAMERA_PERIOD_MS: f64 = 1000.0 / 30.0;
/// What a swap of the configuration may take, ms.
const CONFIG_GOAL_MS: f64 = 50.0;
/// What a swap of a binary may take, ms.
const BINARY_GOAL_MS: f64 = 500.0;

/// Measures swaps of `lane`.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let runs = tempfile::Builder::new().prefix("cb").tempdir_in("/tmp").expect("a folder");
    let mut child = launch(runs.path());
    let client = connect(runs.path());
    // The first laps of the histograms.
    std::thread::sleep(Duration::from_secs(2));
    let configs: Vec<Receipt> = (0..ROUNDS).map(|round| swap(&client, None, 180 + round)).collect();
    report(emit, "swap of a configuration", &configs, CONFIG_GOAL_MS);
    let binary = Path::new(env!("CARGO_BIN_EXE_carril")).with_file_name("my-lane");
    if binary.exists() {
        let mut binaries = Vec::new();
        for _ in 0..ROUNDS / 3 {
            binaries.push(swap(&client, Some(&binary), 0));
            swap(&client, None, 0);
        }
        report(emit, "swap of a binary", &binaries, BINARY_GOAL_MS);
    } else {
        eprintln!("swap: `{}` is not built; the swap of a binary is left out", binary.display());
    }
    drop(client);
    // It may have ended already.
    let _ = child.kill();
    child.wait().expect("the run ends");
}

fn launch(runs: &Path) -> Child {
    Command::new(env!("CARGO_BIN_EXE_carril"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(["run", "dataflow.yaml", "--for", "120s", "--quiet"])
        .env("CARRIL_RUN_DIR", runs)
        .stdout(Stdio::null())
        .spawn()
        .expect("`carril run` starts")
}

fn connect(runs: &Path) -> Client {
    let deadline = Instant::now() + Duration::from_secs(8);
    loop {
        match find_run(runs, None) {
            Ok(run) => return Client::open(run).expect("a client"),
            Err(error) => assert!(Instant::now() < deadline, "the run does not come up: {error}"),
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Another threshold; or a binary, and without one after it the built-in detector again.
fn swap(client: &Client, exec: Option<&Path>, threshold: usize) -> Receipt {
    let values = match (exec, threshold) {
        (Some(_), _) => Map::new(),
        (None, 0) => values(json!({ "threshold": 190 })),
        (None, threshold) => values(json!({ "threshold": threshold })),
    };
    let operator = (exec.is_none() && threshold == 0).then(|| "lane-detector".to_owned());
    let terms = SwapTerms { shadow_ms: 200, probation_outputs: 5, fresh: true, stall_ms: 2000, ..SwapTerms::default() };
    let request = SwapRequest { node: "lane".into(), operator, exec: exec.map(Path::to_owned), values, terms };
    let receipt = client.change(&Change::Swap(request)).expect("the supervisor answers");
    assert_eq!(receipt.outcome, Outcome::Done, "{receipt:?}");
    receipt
}

fn values(values: Value) -> Map<String, Value> {
    match values {
        Value::Object(values) => values,
        other => panic!("{other} is no object"),
    }
}

fn report(emit: &mut dyn FnMut(Row), what: &str, receipts: &[Receipt], goal_ms: f64) {
    let sorted = |pick: fn(&Receipt) -> Option<f64>| {
        let mut values: Vec<f64> = receipts.iter().filter_map(pick).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let took = sorted(|receipt| receipt.took_ms);
    let gaps = sorted(|receipt| receipt.gap_ms);
    if let (Some(median), Some(median_gap), Some(longest)) =
        (took.get(took.len() / 2), gaps.get(gaps.len() / 2), gaps.last())
    {
        emit(Row::against(
            format!("{what}, request to take-over without shadow, median, against the goal"),
            *median,
            "ms",
            goal_ms,
        ));
        emit(Row::against(
            format!("{what}, longest pause, median, against a camera period"),
            *median_gap,
            "ms",
            CAMERA_PERIOD_MS,
        ));
        emit(Row::against(
            format!("{what}, longest pause, worst, against a camera period"),
            *longest,
            "ms",
            CAMERA_PERIOD_MS,
        ));
    }
    let lost: u64 = receipts.iter().map(|receipt| receipt.lost + receipt.duplicated).sum();
    emit(Row::alone(format!("{what}, samples lost or duplicated in {} swaps", receipts.len()), lost as f64, ""));
}
