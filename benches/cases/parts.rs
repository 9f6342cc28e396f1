//! The benchmarks that live beside their code: each is a program of its own that prints one JSON object per line.

use std::process::Command;

use crate::support::report::Row;

/// The lane detector beside OpenCV on the whole image.
pub fn lane_detector(emit: &mut dyn FnMut(Row)) {
    run("carril-operators", "lane_detector", emit);
}

/// The frames of the microcontroller link beside bincode.
pub fn codec(emit: &mut dyn FnMut(Row)) {
    run("carril-bridge", "codec", emit);
}

fn run(package: &str, bench: &str, emit: &mut dyn FnMut(Row)) {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let output = Command::new(cargo)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(["bench", "--locked", "--quiet", "-p", package, "--bench", bench, "--", "--json"])
        .output()
        .expect("cargo starts");
    assert!(output.status.success(), "`{bench}`: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("the rows are text");
    for line in text.lines() {
        emit(serde_json::from_str(line).unwrap_or_else(|error| panic!("`{bench}` printed no row: {error}: {line}")));
    }
}
