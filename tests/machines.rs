//! A car one of whose nodes runs on another machine: it drives with it, stops without it, and lets nobody else do its work.

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;

use carril_messages::{Command as DriveCommand, Header, LaneEstimate, Message, Origins, Stamp};
use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::machine_key;
use carril_runtime::transport::zenoh::{FarOptions, Identity, ZenohTransport};
use nix::sys::signal::Signal;
use serde_json::Value;
use support::car::{Car, until};
use support::{Outcome, Running, Sandbox, free_ports, project_file};

/// `dataflows/two-machines.yaml` with the patience that a shared test machine needs, and a gateway on loopback.
fn graph(port: u16) -> String {
    let text = std::fs::read_to_string(project_file("dataflows/two-machines.yaml")).expect("a shipped graph");
    let remote = format!("remote:\n  listen: 127.0.0.1:{port}\n  dashboard: off\n  scouting: off\n");
    let changes = [
        ("../tracks/", project_file("tracks/")),
        ("lease_ms: 200", "lease_ms: 1500".into()),
        ("max_age_ms: 400", "max_age_ms: 5000".into()),
        ("lane_timeout_ms: 200", "lane_timeout_ms: 1500, sectors_timeout_ms: 3000".into()),
        ("image: world/camera", "image: { from: world/camera, max_age_ms: 3000 }".into()),
        ("lane: lane/lane", "lane: { from: lane/lane, max_age_ms: 3000 }".into()),
        ("{ command: decision/command }", "{ command: decision/command }\n    config: { timeout_ms: 1500 }".into()),
        ("remote:\n", remote),
    ];
    changes.iter().fold(text, |text, (from, to)| {
        assert!(text.contains(from), "the graph has `{from}`");
        text.replace(from, to)
    })
}

/// A car, and the folders of a laptop.
struct Pair {
    car: Car,
    port: u16,
}

impl Pair {
    fn launch() -> Self {
        let port = free_ports();
        let car = Car::launch_standing(Sandbox::new(), &graph(port));
        until("the gateway is up", || car.run.output().0.contains("reachable"));
        Self { car, port }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.car.sandbox.path().join(name)
    }

    /// A command on the laptop: it sees neither the run nor the keys of the car.
    fn laptop(&self, args: &[&str]) -> Command {
        let mut command = self.car.sandbox.command(args);
        command.env("CARRIL_RUN_DIR", self.path("laptop-runs")).env("CARRIL_CONFIG_DIR", self.path("laptop-config"));
        command
    }

    #[track_caller]
    fn on_laptop(&self, args: &[&str]) -> Outcome {
        Running::start(self.laptop(args)).wait()
    }

    /// The run of a graph on the laptop.
    fn join(&self, file: &Path, more: &[&str]) -> Running {
        let file = file.display().to_string();
        let args = [&["run", &file, "--machine", "laptop", "--json"], more].concat();
        Running::start(self.laptop(&args))
    }

    fn connect(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// A key, which the gateway has taken in.
    fn grant(&self, kind: &str, name: &str) -> String {
        let key = self.path(&format!("{name}.json")).display().to_string();
        self.car.sandbox.carril(&["grant", kind, name, "-o", &key]).expect(0);
        until("the gateway knows the key", || {
            self.who()["granted"].as_array().is_some_and(|names| names.iter().any(|known| known == name))
        });
        key
    }

    /// As the car tells it.
    fn who(&self) -> Value {
        // Until the gateway has said it for the first time, nobody knows.
        serde_json::from_str(&self.car.sandbox.carril(&["who", "--json"]).stdout).unwrap_or_default()
    }

    /// As the car tells it, once.
    fn status(&self) -> Value {
        let top = self.car.sandbox.carril(&["top", "--json", "-n", "1"]).expect(0);
        serde_json::from_str(top.lines().next().unwrap_or_default()).expect("one JSON object")
    }

    fn joined(&self) -> bool {
        self.status()["machines"][0]["joined"] == true
    }

    /// State of `lane`, as the car sees it.
    fn lane(&self) -> String {
        let status = self.status();
        let nodes = status["nodes"].as_array().cloned().unwrap_or_default();
        let lane = nodes.iter().find(|node| node["node"] == "lane").expect("the car knows it");
        lane["state"].as_str().unwrap_or_default().to_owned()
    }

    /// The run on the laptop.
    fn on_the_laptop(&self) -> Client {
        Client::open(find_run(&self.path("laptop-runs"), None).expect("it runs")).expect("it can be reached")
    }

    /// What stands in the log of the car's run.
    fn said(&self, text: &str) -> bool {
        let (stdout, stderr) = self.car.run.output();
        stdout.contains(text) || stderr.contains(text)
    }
}

#[test]
fn a_car_drives_with_a_node_on_a_laptop_stops_when_it_is_gone_and_goes_on_when_it_is_back() {
    let pair = Pair::launch();
    let file = pair.car.graph_file();
    assert!(!pair.joined() && pair.lane() == "away", "the car is up without it: {}", pair.status());
    let refused = pair.car.sandbox.carril(&["set", "lane", "threshold=180"]);
    assert!(refused.report().contains("runs on machine `laptop`: change it there"), "{}", refused.report());
    let applied = pair.path("other.yaml");
    std::fs::write(&applied, graph(pair.port).replace("threshold: 190", "threshold: 180")).expect("writable");
    let refused = pair.car.sandbox.carril(&["apply", &applied.display().to_string(), "--yes"]).report();
    assert!(refused.contains("belongs to machine `laptop`"), "{refused}");
    let no_key = pair.join(&file, &["--connect", &pair.connect()]).wait().expect_error(1);
    assert!(no_key.contains("carril grant --machine laptop"), "{no_key}");

    let key = pair.grant("--machine", "laptop");
    let mut laptop = pair.join(&file, &["--connect", &pair.connect(), "--key", &key]);
    laptop.wait_for_output("it joins", |output| output.contains("\"joined\""));
    pair.car.until_it("drives", "lane-follow");
    until("its health is known", || pair.lane() == "running");
    assert!(pair.joined(), "{}", pair.status());
    let estimates = pair.car.hear("lane/lane", |header, payload| {
        header.expect::<LaneEstimate>().and_then(|()| LaneEstimate::decode(&header.meta, payload)).is_ok()
    });
    estimates.wait_for(5);
    for (header, readable) in estimates.heard() {
        assert!(readable && header.captured.is_some_and(|captured| captured <= header.stamp), "{header:?}");
    }
    drop(estimates);
    // Somebody who watches the laptop's run, and must not keep it alive.
    let there = pair.on_the_laptop();
    let said = |text: &str| there.log().expect("it answers").iter().any(|line| line.text.contains(text));
    pair.car.sandbox.carril(&["estop"]).expect(0);
    until("its nodes hear it", || said("`estop` on the car: heard by lane"));
    pair.car.sandbox.carril(&["reset"]).expect(0);
    pair.car.sandbox.carril(&["start"]).expect(0);
    until("and the other words", || said("`start` on the car: heard by lane"));
    pair.car.until_it("drives again", "lane-follow");
    // There it is a node like any other.
    pair.on_laptop(&["set", "lane", "threshold=185"]).expect(0);
    pair.on_laptop(&["swap", "lane", "--set", "threshold=186", "--shadow", "0ms", "--stall-ms", "3000"]).expect(0);
    pair.car.assert_in_the_lane();

    laptop.signal(Signal::SIGKILL);
    pair.car.until_it("stops", "lane-lost");
    until("the car knows why", || !pair.joined() && pair.lane() == "away");
    assert!(pair.said("\"joined\":false"), "and says it");
    assert_eq!(laptop.wait().code, None, "it was killed");

    // Key and address are remembered.
    let mut laptop = pair.join(&file, &[]);
    laptop.wait_for_output("it joins again", |output| output.contains("\"joined\""));
    pair.car.until_it("drives again", "lane-follow");
    laptop.interrupt().expect(0);
    until("it has left in order", || !pair.joined());
}

#[test]
fn another_graph_is_refused_and_the_difference_named() {
    let pair = Pair::launch();
    let key = pair.grant("--machine", "laptop");
    let other = pair.path("other.yaml");
    std::fs::write(&other, graph(pair.port).replace("threshold: 190", "threshold: 150")).expect("writable");
    let mut laptop = pair.join(&other, &["--connect", &pair.connect(), "--key", &key]);
    laptop.wait_for_output("the refusal", |output| output.contains("`threshold` is 150 here, and 190 on the car"));
    assert!(!pair.joined(), "{}", pair.status());
    laptop.interrupt().expect(0);
}

/// A link of its own with a key.
fn link(port: u16, key: &str) -> (ZenohTransport, String) {
    let key: Value = serde_json::from_slice(&std::fs::read(key).expect("the key")).expect("JSON");
    let text = |name: &str| key[name].as_str().expect("a text").to_owned();
    let identity =
        Identity { authority: text("authority"), certificate: text("certificate"), key: text("private_key") };
    let endpoint = format!("tls/127.0.0.1:{}", port + 1);
    let transport = ZenohTransport::open_far(&FarOptions { endpoint, identity: Some(identity) }).expect("a session");
    until("the link is up", || transport.links() > 0);
    (transport, text("id"))
}

fn sample<T: Message>(message: &T, stamp: Stamp) -> (Vec<u8>, Vec<u8>) {
    let encoded = message.encode().expect("it encodes");
    let (origins, meta) = (Origins::none(), encoded.meta);
    let header = Header { epoch: 1, seq: 1, stamp, origins, message_type: T::TYPE, meta };
    (header.encode().expect("it encodes"), encoded.payload.to_vec())
}

#[test]
fn a_key_runs_the_nodes_of_its_own_machine_and_does_nothing_else() {
    let pair = Pair::launch();
    let file = pair.car.graph_file();
    let (laptop_key, desktop_key) = (pair.grant("--machine", "laptop"), pair.grant("--machine", "desktop"));
    let control_key = pair.grant("--control", "anna");
    for wrong in [&desktop_key, &control_key] {
        let refused = pair.join(&file, &["--connect", &pair.connect(), "--key", wrong]).wait().expect_error(1);
        assert!(refused.contains("needed is that of machine `laptop`"), "{refused}");
    }
    // It reads, and controls nothing.
    let with_key = |args: &[&str]| {
        let connect = pair.connect();
        pair.on_laptop(&[args, &["--connect", &connect, "--key", &laptop_key]].concat())
    };
    assert!(with_key(&["list"]).expect(0).contains("lane/lane"), "a reader");
    for control in
        [&["stop"][..], &["set", "sectors", "mounting_deg=1"], &["swap", "decision", "--shadow", "0ms"], &["who"]]
    {
        let refused = with_key(control).expect_error(1);
        assert!(refused.contains("for the nodes on machine `laptop`"), "{control:?}: {refused}");
    }

    let mut laptop = pair.join(&file, &["--connect", &pair.connect(), "--key", &laptop_key]);
    laptop.wait_for_output("it joins", |output| output.contains("\"joined\""));
    let mut twin = pair.laptop(&["run", &file.display().to_string(), "--machine", "laptop", "--json"]);
    twin.env("CARRIL_RUN_DIR", pair.path("twin-runs"));
    let mut twin = Running::start(twin);
    twin.wait_for_output("there is one already", |output| output.contains("joined already, from another run"));
    twin.interrupt().expect(0);
    pair.car.until_it("drives", "lane-follow");
    // The same keys in the hands of somebody who does not keep to the rules.
    let now = pair.car.client().clock().now();
    let command = sample(&DriveCommand { steering_rad: 0.3, speed_m_s: 1.0 }, now);
    let none = LaneEstimate { lane: None, quality: 0.0, threshold: None };
    let tomorrow = sample(&none, now + std::time::Duration::from_secs(86_400));
    let (machine, id) = link(pair.port, &laptop_key);
    let (other, other_id) = link(pair.port, &desktop_key);
    let of = |id: &str, path: &str| machine_key("car1", id, "laptop", path);
    let own_port = of(&id, "port/lane/lane");
    for (transport, key, (header, bytes), expected) in [
        (&machine, "carril/car1/decision/command".to_owned(), &command, "only its own node may"),
        (&machine, of(&other_id, "port/lane/lane"), &command, "only its own node may"),
        (&machine, own_port.clone(), &command, "the port gives `carril/LaneEstimate`, got `carril/Command v1`"),
        (&machine, own_port.clone(), &tomorrow, "s in the future"),
        (&machine, own_port, &(vec![1, 2, 3], Vec::new()), "refused: put on"),
        (&other, of(&other_id, "port/lane/lane"), &tomorrow, "it is the key of machine `desktop`"),
        (&other, of(&other_id, "fault"), &tomorrow, "it is the key of machine `desktop`"),
        (
            &machine,
            of(&id, "fault"),
            &(Vec::new(), br#"{"node":"bridge","reason":"x"}"#.to_vec()),
            "is not one of machine `laptop`",
        ),
    ] {
        until(expected, || {
            transport.put(&key, Some(header.clone()), bytes.clone()).expect("it is sent");
            pair.said(&key) && pair.said(expected)
        });
    }
    assert!(pair.who()["refused"].as_u64() > Some(5), "they are counted");
    assert_eq!(pair.status()["fault"], Value::Null, "no forged fault has stopped the car");
    machine.close();
    other.close();

    pair.car.sandbox.carril(&["revoke", "laptop"]).expect(0);
    pair.car.until_it("stops without it", "lane-lost");
    laptop.wait_for_output("why", |output| output.contains("the key of `laptop` was revoked"));
    assert!(!pair.joined(), "{}", pair.status());
    laptop.interrupt().expect(0);
}
