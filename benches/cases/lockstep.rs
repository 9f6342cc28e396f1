//! How much faster than real time the default graph runs in lockstep on one core, with the camera and without.

use std::process::Command;

use serde_json::Value;

use crate::support::report::Row;

const ROUNDS: usize = 3;

/// Measures both graphs beside what carril promises.
pub fn run(emit: &mut dyn FnMut(Row)) {
    for (name, file, seconds, promised) in [
        ("with a 640x480 camera at 30 Hz", "dataflow.yaml", "30", 10.0),
        ("without camera", "dataflows/no-camera.yaml", "300", 300.0),
    ] {
        let mut factors: Vec<f64> = (0..ROUNDS).map(|_| factor(file, seconds)).collect();
        factors.sort_by(f64::total_cmp);
        emit(Row::against(format!("lockstep {name}, against the promise"), factors[ROUNDS / 2], "x", promised));
    }
}

fn factor(file: &str, seconds: &str) -> f64 {
    let output = Command::new(env!("CARGO_BIN_EXE_carril"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(["sim", file, "--seconds", seconds, "--json"])
        .output()
        .expect("`carril sim` starts");
    assert!(output.status.success(), "`carril sim {file}`: {}", String::from_utf8_lossy(&output.stderr));
    let summary: Value = serde_json::from_slice(&output.stdout).expect("the summary is JSON");
    summary["real_time_factor"].as_f64().expect("the summary has the factor")
}
