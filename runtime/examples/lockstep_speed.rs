//! How many steps per second lockstep makes of small operators: `cargo run --release -p carril-runtime --no-default-features
//! --example lockstep_speed`. Prints the cost of the executor around a step, which is what the operators themselves do not use.

#[path = "../tests/support/mod.rs"]
mod support;

use std::path::Path;

use carril_runtime::executor::lockstep::{Lockstep, LockstepOptions};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::messages::Stamp;

fn main() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/dataflows/good/oval.yaml");
    let graph = Graph::read(&path, &support::registry(), &ReadOptions::default())
        .unwrap_or_else(|problems| panic!("{problems}"));
    for _ in 0..5 {
        let mut lockstep = Lockstep::new(&graph, LockstepOptions::default()).expect("the operators can be built");
        lockstep.run_until(Stamp::from_nanos(600_000_000_000)).expect("no operator panics");
        let summary = lockstep.finish();
        let operators_ns: u64 = summary.nodes.iter().map(|node| node.cost_ns).sum();
        let (steps, wall_ns) = (summary.steps as f64, summary.wall_s * 1e9);
        println!(
            "{steps} steps, {:.0} per virtual s, {:.2} M steps/s, x{:.0} real time, {:.0} ns per step, of which operators {:.0} ns",
            steps / summary.virtual_s,
            steps / summary.wall_s * 1e-6,
            summary.real_time_factor,
            wall_ns / steps,
            operators_ns as f64 / steps,
        );
    }
}
