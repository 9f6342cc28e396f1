//! A car and a laptop with an emulated Wi-Fi link between them: two network namespaces, packets that are late and lost, outages. Skipped,
//! with a message, where that is not possible (not root, no TUN devices).
//!
//! No test asserts how long something takes; `./dev bench` measures that.

mod support;

use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;
use support::{HANGS_AFTER, Running, Sandbox, project_file};
use wifi_link::{Conditions, LinkError, WifiLink};

/// Device of the link on both hosts.
const DEVICE: &str = "wifi0";

struct Track {
    sandbox: Sandbox,
    link: WifiLink,
    run: Option<Running>,
}

impl Track {
    /// A car that drives, with a gateway, and a laptop. `None`: not possible here.
    fn new(conditions: Conditions) -> Option<Self> {
        let link = match WifiLink::new(conditions) {
            Ok(link) => link,
            Err(LinkError::NotPossible(reason)) => {
                eprintln!("skipped: {reason}");
                return None;
            }
            Err(error) => panic!("{error}"),
        };
        let sandbox = Sandbox::new();
        let graph = support::car::patient_graph(&[]).replace("tracks/", &project_file("tracks/"));
        let remote = format!("\nremote:\n  scouting: {DEVICE}\n  foxglove: 8765\n");
        let file = sandbox.write("remote.yaml", graph + &remote);
        let command = sandbox.prepare(link.car().command(Sandbox::PROGRAM), &["run", &file.display().to_string()]);
        let track = Self { run: Some(Running::start(command)), sandbox, link };
        track.until("the gateway", || track.log().contains("with a key"));
        Some(track)
    }

    fn log(&self) -> String {
        self.run.as_ref().map(|run| run.output().1).unwrap_or_default()
    }

    #[track_caller]
    fn until(&self, what: &str, mut holds: impl FnMut() -> bool) {
        let deadline = Instant::now() + HANGS_AFTER;
        while !holds() {
            assert!(Instant::now() < deadline, "waited in vain for {what}; the run said:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// A command on the laptop, which has none of the car's files.
    fn laptop(&self, args: &[&str]) -> Command {
        let mut command = self.sandbox.prepare(self.link.laptop().command(Sandbox::PROGRAM), args);
        command.env("CARRIL_RUN_DIR", self.sandbox.path().join("elsewhere"));
        command.env("CARRIL_CONFIG_DIR", self.sandbox.path().join("laptop"));
        command.env("CARRIL_SCOUTING", DEVICE);
        command
    }
}

impl Drop for Track {
    fn drop(&mut self) {
        if let Some(run) = self.run.take() {
            run.interrupt();
        }
    }
}

#[test]
fn a_car_is_found_by_scouting_and_shows_nothing_but_its_servers() {
    let Some(track) = Track::new(Conditions::good()) else { return };
    let list = Running::start(track.laptop(&["list"])).wait().expect(0);
    assert!(list.contains("lane/lane"), "found without a name: {list}");
    let doctor = Running::start(track.laptop(&["doctor"])).wait().expect(0);
    assert!(doctor.contains("ok    scouting") && doctor.contains("ok    session"), "{doctor}");

    // Whatever listens on the car, as its own kernel says.
    let listens = track.link.car().command("ss").args(["-Hltn"]).output().expect("`ss` is there");
    let listens = String::from_utf8_lossy(&listens.stdout).into_owned();
    let mut ports: Vec<u16> = listens
        .lines()
        .filter_map(|line| line.split_whitespace().nth(3))
        .filter(|address| !address.starts_with("127.") && !address.starts_with("[::1]"))
        .filter_map(|address| address.rsplit(':').next()?.parse().ok())
        .collect();
    ports.sort_unstable();
    assert_eq!(ports, [7447, 7448, 8080, 8765], "gateway, keys, dashboard, Foxglove:\n{listens}");
}

/// Samples of `echo --json`: sequence number, and when it was published on the car's clock, ns.
fn samples(output: &str) -> Vec<(u64, i64)> {
    let lines = output.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    lines.filter_map(|line| Some((line["seq"].as_u64()?, line["stamp_ns"].as_i64()?))).collect()
}

#[test]
fn after_an_outage_the_view_is_live_again_and_has_not_caught_up_on_anything() {
    let Some(track) = Track::new(Conditions::slow()) else { return };
    // On a slow link, with the camera beside it.
    let camera = Running::start(track.laptop(&["echo", "world/camera", "--json"]));
    let state = Running::start(track.laptop(&["echo", "decision/state", "--json"]));
    let seen = || samples(&state.output().0);
    track.until("samples", || seen().len() > 10 && !samples(&camera.output().0).is_empty());
    track.link.cut();
    // Longer than a link lives that hears nothing.
    std::thread::sleep(Duration::from_secs(5));
    let before = seen();
    let (last_seq, last_stamp) = *before.last().expect("there were samples");
    track.link.restore();
    track.until("samples after the outage", || seen().len() > before.len() + 5);
    let after = seen().split_off(before.len());
    assert!(after.windows(2).all(|pair| pair[0].0 < pair[1].0), "never backwards: {after:?}");
    // 5 a second were published during the outage. Those that had left just before it may still come; what came later is not made up for.
    let made_up =
        after.iter().filter(|(seq, stamp)| *seq <= last_seq + 20 && *stamp < last_stamp + 4_000_000_000).count();
    assert!(made_up <= 3, "{made_up} samples of the outage came after it: {after:?}");
    for tool in [camera, state] {
        let ended = tool.interrupt();
        assert_eq!(ended.code, Some(0), "tools outlive an outage: {}", ended.stderr);
    }
}
