//! A car as it is seen from another machine: reached through its gateway, looked at without a key, controlled with one.

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use carril_messages::{Command as DriveCommand, Message};
use serde_json::Value;
use support::{HANGS_AFTER, Outcome, Running, Sandbox, free_ports, project_file};
use zenoh::Wait;

/// A running car with a gateway, and the folders of another machine.
struct Remote {
    sandbox: Sandbox,
    run: Option<Running>,
    port: u16,
}

impl Remote {
    fn start(settings: &str) -> Self {
        let sandbox = Sandbox::new();
        let port = free_ports();
        let graph = std::fs::read_to_string(project_file("dataflow.yaml")).expect("the default graph");
        let graph = graph.replace("tracks/", &project_file("tracks/"));
        let remote = format!("\nremote:\n  listen: 127.0.0.1:{port}\n  dashboard: off\n  scouting: off\n{settings}");
        let file = sandbox.write("remote.yaml", graph + &remote);
        let run = sandbox.start(&["run", &file.display().to_string()]);
        let remote = Self { sandbox, run: Some(run), port };
        remote.until("the gateway", || remote.log().contains("with a key"));
        remote
    }

    fn until(&self, what: &str, mut holds: impl FnMut() -> bool) {
        let deadline = Instant::now() + HANGS_AFTER;
        while !holds() {
            assert!(Instant::now() < deadline, "waited in vain for {what}; the run said:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// A command on another machine: it sees neither the folder of the run nor the keys of the car.
    fn laptop(&self, machine: &str, args: &[&str]) -> Command {
        let mut command = self.sandbox.command(args);
        command.env("CARRIL_RUN_DIR", self.sandbox.path().join("elsewhere"));
        command.env("CARRIL_CONFIG_DIR", self.sandbox.path().join(machine));
        command.env("CARRIL_CONNECT", format!("127.0.0.1:{}", self.port));
        command
    }

    #[track_caller]
    fn on_laptop(&self, machine: &str, args: &[&str]) -> Outcome {
        Running::start(self.laptop(machine, args)).wait()
    }

    /// Grants a key on the car, and waits until the gateway has taken it in.
    fn grant(&self, name: &str) -> PathBuf {
        let key = self.sandbox.path().join(format!("{name}.json"));
        self.sandbox.carril(&["grant", "--control", name, "-o", &key.display().to_string()]).expect(0);
        self.until("the grant", || {
            self.who()["granted"].as_array().is_some_and(|names| names.iter().any(|n| n == name))
        });
        key
    }

    /// As the car tells it.
    fn who(&self) -> Value {
        // Until the gateway has said it for the first time, nobody knows.
        serde_json::from_str(&self.sandbox.carril(&["who", "--json"]).stdout).unwrap_or_default()
    }

    fn log(&self) -> String {
        self.run.as_ref().map(|run| run.output().1).unwrap_or_default()
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        if let Some(run) = self.run.take() {
            run.interrupt();
        }
    }
}

/// The pieces of Python in the documentation, which end with waiting for a key: joined, they wait once.
fn documented_python(address: &str) -> String {
    let page = std::fs::read_to_string(project_file("docs/remote.md")).expect("it is there");
    let pieces = page.split("```python\n").skip(1).filter_map(|rest| rest.split_once("```")).map(|(piece, _)| piece);
    let script: String = pieces.map(|piece| piece.replace("input()\n", "")).collect();
    assert!(script.contains("tcp/car.local:7447"), "the address that a reader puts in: {script}");
    script.replace("car.local:7447", address) + "input()\n"
}

#[test]
fn the_python_of_the_documentation_reads_the_car() {
    let Some(python) = std::env::var_os("CARRIL_PYTHON") else {
        eprintln!("skipped: `./dev test --thorough` brings a Python with eclipse-zenoh (CARRIL_PYTHON)");
        return;
    };
    let car = Remote::start("");
    let mut command = Command::new(python);
    command.args(["-u", "-c", &documented_python(&format!("127.0.0.1:{}", car.port))]).current_dir(car.sandbox.path());
    // `input()` waits for as long as there is somebody who could type.
    command.stdin(std::process::Stdio::piped());
    let reader = Running::start(command);
    let frame = car.sandbox.path().join("frame.jpg");
    car.until("a frame and a lane in Python", || {
        let jpeg = std::fs::read(&frame).is_ok_and(|bytes| bytes.starts_with(&[0xff, 0xd8, 0xff]));
        jpeg && reader.output().0.contains("'angle_rad': ")
    });
    reader.signal(nix::sys::signal::Signal::SIGKILL);
    assert_eq!(reader.wait().code, None, "it waited for a key until it was killed");
}

/// Every way to control a car. The last is what it changes.
const CONTROLS: [&[&str]; 8] = [
    &["start"],
    &["stop"],
    &["reset"],
    &["set", "lane", "threshold=185"],
    &["swap", "lane", "--set", "threshold=186", "--shadow", "0ms"],
    &["rollback", "lane"],
    &["pub", "decision/goal", r#"{"cruise": {"speed_m_s": 0.4}}"#],
    &["who"],
];

#[test]
fn whoever_has_no_key_may_look_and_stop_the_car_and_no_more() {
    let car = Remote::start("");
    let list = car.on_laptop("laptop", &["list"]).expect(0);
    assert!(list.contains("lane/lane") && list.contains("carril/LaneEstimate"), "{list}");
    let echo = car.on_laptop("laptop", &["echo", "lane/lane", "-n", "3", "--json"]).expect(0);
    assert_eq!(echo.lines().filter(|line| line.contains("quality")).count(), 3, "{echo}");
    let png = car.sandbox.path().join("frame.png").display().to_string();
    let image = car.on_laptop("laptop", &["echo", "world/camera", "--save", &png]).expect(0);
    assert!(image.contains("jpeg") && image.contains("of 640x480 bgr8"), "compressed on the car: {image}");
    assert_eq!(std::fs::read(&png).expect("it was saved")[1..4], *b"PNG", "as the ending says");
    for look in
        [&["hz", "lane/lane", "-n", "5"][..], &["params", "lane"], &["info", "lane"], &["get", "lane", "threshold"]]
    {
        car.on_laptop("laptop", look).expect(0);
    }
    for control in CONTROLS {
        let refused = car.on_laptop("laptop", control).expect_error(1);
        assert!(refused.contains("needs a key") && refused.contains("carril grant"), "{control:?}: {refused}");
    }
    let stopped = car.on_laptop("laptop", &["estop"]).expect(0);
    assert!(stopped.contains("confirmed by 7 nodes"), "{stopped}");
    car.until("who said it, in the log", || car.log().contains("somebody without a key: estop"));
}

#[test]
fn a_key_controls_until_it_is_revoked_and_another_cars_key_never_does() {
    let car = Remote::start("");
    let key = car.grant("laptop-1");
    let named = |args: &[&str], key: &Path| {
        let key = key.display().to_string();
        let all: Vec<&str> = args.iter().copied().chain(["--key", &key]).collect();
        car.on_laptop("with-key", &all)
    };
    for control in CONTROLS {
        named(control, &key).expect(0);
    }
    // It was remembered: from now on it is not named any more.
    assert!(
        car.on_laptop("with-key", &["get", "lane", "threshold"]).expect(0).contains("185"),
        "set, swap and rollback"
    );
    car.on_laptop("with-key", &["set", "lane", "threshold=184"]).expect(0);
    car.until("who did what, in the log", || car.log().contains("laptop-1: set lane threshold=184"));

    // Of a car with the same name and other keys: no link comes about at all.
    let other = car.sandbox.path().join("other.json");
    let mut grant = car.sandbox.command(&["grant", "--control", "laptop-1", "--robot", "car1", "-o"]);
    grant.arg(&other).env("CARRIL_CONFIG_DIR", car.sandbox.path().join("other-car"));
    Running::start(grant).wait().expect(0);
    let wrong = named(&["set", "lane", "threshold=100"], &other).expect_error(1);
    assert!(wrong.contains("no car answers at `tls/"), "{wrong}");

    car.sandbox.carril(&["revoke", "laptop-1"]).expect(0);
    car.until("the end of the key", || car.who()["granted"].as_array().is_some_and(Vec::is_empty));
    for control in CONTROLS {
        let refused = named(control, &key).expect_error(1);
        assert!(refused.contains("`laptop-1` was revoked"), "{control:?}: {refused}");
    }
    // A new key of the same name does not make the old one valid again.
    let first = car.sandbox.path().join("first.json");
    std::fs::rename(&key, &first).expect("the folder is the test's");
    let second = car.grant("laptop-1");
    named(&["set", "lane", "threshold=101"], &first).expect_error(1);
    named(&["set", "lane", "threshold=187"], &second).expect(0);
    assert!(
        car.on_laptop("laptop", &["get", "lane", "threshold"]).expect(0).contains("187"),
        "only valid keys changed it"
    );
}

fn session(port: u16) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (name, value) in [
        ("scouting/multicast/enabled", "false".to_owned()),
        ("connect/endpoints", format!("[\"tcp/127.0.0.1:{port}\"]")),
        ("listen/endpoints", "[]".to_owned()),
    ] {
        config.insert_json5(name, &value).expect("a setting of Zenoh");
    }
    zenoh::open(config).wait().expect("a session")
}

#[test]
fn any_zenoh_client_reads_and_none_can_put() {
    let car = Remote::start("");
    let session = session(car.port);
    let (sender, heard) = channel();
    let data = session.declare_subscriber("carril/car1/@/json/decision/command").callback(move |sample| {
        // The test may have ended.
        let _ = sender.send(sample.payload().to_bytes().into_owned());
    });
    let _data = data.wait().expect("a subscriber");
    let json: Value = serde_json::from_slice(&heard.recv_timeout(HANGS_AFTER).expect("a command")).expect("JSON");
    assert!(json["value"]["speed_m_s"].is_number() && json["type"] == "carril/Command v1", "{json}");

    // As the real commands look, on the key of the real commands, and on the question that changes the graph.
    let command = DriveCommand { steering_rad: 0.3, speed_m_s: 1.0 }.encode().expect("it encodes");
    let key = "carril/car1/decision/command";
    car.until("the refusal", || {
        session.put(key, command.payload.to_vec()).wait().expect("it is sent");
        car.log().contains("refused: tcp/127.0.0.1")
    });
    let log = car.log();
    assert!(log.contains("put on `carril/car1/decision/command`; only its own node may"), "it says what: {log}");
    assert!(car.who()["refused"].as_u64() > Some(0), "it is counted");
    for question in ["carril/car1/@/change", "carril/car1/@/as/laptop-1-abcdef/change", "carril/car1/@/control/*"] {
        let replies = session.get(question).payload("{}").timeout(Duration::from_secs(1)).wait().expect("it is asked");
        let answers = replies.into_iter().filter(|reply| reply.result().is_ok()).count();
        assert_eq!(answers, 0, "`{question}`: nobody answers");
    }
}

#[test]
fn a_graph_may_keep_readers_out_and_the_estop_to_itself() {
    let car = Remote::start("  read: granted\n");
    let nobody = car.on_laptop("laptop", &["list"]).expect_error(1);
    assert!(nobody.contains("no car answers"), "{nobody}");
    let key = car.grant("laptop-1").display().to_string();
    assert!(car.on_laptop("laptop", &["list", "--key", &key]).expect(0).contains("lane/lane"), "with a key");
    drop(car);
    let car = Remote::start("  estop: granted\n");
    let refused = car.on_laptop("laptop", &["estop"]).expect_error(1);
    assert!(refused.contains("estop"), "{refused}");
    let key = car.grant("laptop-1").display().to_string();
    car.on_laptop("laptop", &["estop", "--key", &key]).expect(0);
}

#[test]
fn the_doctor_tells_what_works_and_what_does_not() {
    let car = Remote::start("");
    let report = car.on_laptop("laptop", &["doctor"]).expect(0);
    for part in ["ok    port (readers)", "ok    session", "ok    round trip", "note  key"] {
        assert!(report.contains(part), "`{part}`:\n{report}");
    }
    let mut command = car.laptop("laptop", &["doctor", "--json"]);
    command.env("CARRIL_CONNECT", format!("127.0.0.1:{}", free_ports()));
    let report = Running::start(command).wait().expect(1);
    let findings: Vec<Value> = serde_json::from_str(&report).expect("JSON");
    let failed =
        |what: &str| findings.iter().any(|f| f["what"] == what && f["outcome"] == "fails" && f["hint"].is_string());
    assert!(failed("port (readers)") && failed("port (keys)"), "{report}");
}
