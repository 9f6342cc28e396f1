//! All benchmarks: `./dev bench [NAMES]`. Each figure stands beside a yardstick measured in the same run, where there is one.
//! Prints a table and writes `target/bench.json` (docs/benchmarks.md).

#[path = "cases/chain.rs"]
mod chain;
#[path = "cases/fan_out.rs"]
mod fan_out;
#[path = "cases/hop.rs"]
mod hop;
#[path = "cases/link.rs"]
mod link;
#[path = "cases/lockstep.rs"]
mod lockstep;
#[path = "cases/parts.rs"]
mod parts;
#[path = "cases/remote.rs"]
mod remote;
#[path = "cases/scale.rs"]
mod scale;
#[path = "cases/shadow.rs"]
mod shadow;
#[path = "cases/start.rs"]
mod start;
mod support;
#[path = "cases/swap.rs"]
mod swap;

use std::collections::BTreeMap;
use std::path::Path;

use support::report::{self, Row};

type Case = fn(&mut dyn FnMut(Row));

fn cases() -> BTreeMap<&'static str, Case> {
    BTreeMap::from([
        ("chain", chain::run as Case),
        ("codec", parts::codec),
        ("dashboards", remote::dashboards),
        ("fan-out", fan_out::run),
        ("hop", hop::run),
        ("lane-detector", parts::lane_detector),
        ("link", link::run),
        ("lockstep", lockstep::run),
        ("outage", remote::outage),
        ("remote", remote::run),
        ("scale", scale::run),
        ("shadow", shadow::run),
        ("start", start::run),
        ("swap", swap::run),
    ])
}

fn main() {
    // `cargo bench` adds `--bench`.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    if arguments.first().is_some_and(|first| first == "role") {
        return play(&arguments[1..]);
    }
    let cases = cases();
    if let Some(unknown) = arguments.iter().find(|name| !cases.contains_key(name.as_str())) {
        let names: Vec<_> = cases.keys().collect();
        eprintln!("error: there is no benchmark `{unknown}`; there are {names:?}");
        std::process::exit(2);
    }
    let mut rows = Vec::new();
    report::print_head();
    for (name, case) in cases {
        if arguments.is_empty() || arguments.iter().any(|wanted| wanted == name) {
            case(&mut |row| {
                report::print_row(&row);
                rows.push(row);
            });
        }
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/bench.json");
    let json = serde_json::to_string_pretty(&rows).expect("rows are JSON");
    std::fs::write(&path, json).unwrap_or_else(|error| eprintln!("error: cannot write `{}`: {error}", path.display()));
}

/// A process of a benchmark: this program in a role.
fn play(arguments: &[String]) {
    match arguments.first().map(String::as_str) {
        Some("plain-source" | "plain-sink" | "plain-relay") => hop::play_plain(arguments),
        Some("remote-tool" | "remote-page" | "pages") => support::viewers::play(arguments),
        Some("nodes") => hop::play_nodes(&arguments[1..]),
        other => panic!("there is no role {other:?}"),
    }
}
