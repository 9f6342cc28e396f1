//! `carril calibrate` with a microcontroller at the other end of a terminal: servo, encoder, single parameters, a backup and back.

mod support;

use std::io::{Read, Write};
use std::process::{Child, ChildStdin, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde_json::Value;
use support::chip::Chip;
use support::{HANGS_AFTER, Sandbox};

/// A command that asks, and a person who answers.
struct Talk {
    child: Child,
    input: Option<ChildStdin>,
    output: Arc<Mutex<String>>,
    /// How much of the output was heard.
    heard: usize,
}

impl Talk {
    fn start(sandbox: &Sandbox, args: &[&str]) -> Self {
        let mut command = sandbox.command(args);
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("it starts");
        let (input, output) = (child.stdin.take(), Arc::new(Mutex::new(String::new())));
        let mut streams: Vec<Box<dyn Read + Send>> = Vec::new();
        streams.extend(child.stdout.take().map(|stream| Box::new(stream) as Box<dyn Read + Send>));
        streams.extend(child.stderr.take().map(|stream| Box::new(stream) as Box<dyn Read + Send>));
        for mut stream in streams {
            let output = Arc::clone(&output);
            std::thread::spawn(move || {
                let mut buffer = [0; 512];
                while let Ok(len @ 1..) = stream.read(&mut buffer) {
                    let text = String::from_utf8_lossy(&buffer[..len]).into_owned();
                    output.lock().unwrap_or_else(PoisonError::into_inner).push_str(&text);
                }
            });
        }
        Self { child, input, output, heard: 0 }
    }

    fn text(&self) -> String {
        self.output.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits for words that were not heard yet.
    #[track_caller]
    fn hears(&mut self, words: &str) {
        let began = Instant::now();
        loop {
            let text = self.text();
            if let Some(at) = text[self.heard..].find(words) {
                self.heard += at + words.len();
                return;
            }
            assert!(began.elapsed() < HANGS_AFTER, "`{words}` never came in:\n{text}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn says(&mut self, line: &str) {
        let input = self.input.as_mut().expect("it still listens");
        writeln!(input, "{line}").expect("it still listens");
    }

    #[track_caller]
    fn ends(mut self, code: i32) -> String {
        drop(self.input.take());
        let status = self.child.wait().expect("it ends");
        let began = Instant::now();
        // The threads that read may be a little behind.
        while Arc::strong_count(&self.output) > 1 && began.elapsed() < HANGS_AFTER {
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(status.code(), Some(code), "{}", self.text());
        self.text()
    }
}

fn shown(sandbox: &Sandbox, chip: &Chip) -> Value {
    let text = sandbox.carril(&["calibrate", "show", "--port", chip.port(), "--json"]).expect(0);
    serde_json::from_str(&text).expect("JSON")
}

#[test]
fn the_servo_is_moved_to_its_stops_and_they_are_stored() {
    let (sandbox, chip) = (Sandbox::new(), Chip::new());
    let mut talk = Talk::start(&sandbox, &["calibrate", "servo", "--port", chip.port()]);
    talk.hears("centre: 1050 us >");
    assert_eq!(chip.now().pins.servo_us, Some(1_050), "the servo is where the question says");
    talk.says("--");
    talk.hears("centre: 1000 us >");
    assert_eq!(chip.now().pins.servo_us, Some(1_000), "and it has moved");
    talk.says("sideways");
    talk.hears("got `sideways`, allowed are");
    talk.says("");
    talk.hears("right stop: 635 us >");
    talk.says("700");
    talk.hears("right stop: 700 us >");
    talk.says("");
    talk.hears("left stop: 1465 us >");
    talk.says("-");
    talk.hears("left stop: 1455 us >");
    assert!(chip.now().pins.motor_duty == 0.0 && chip.now().faults.is_empty(), "the motor is off: {:?}", chip.now());
    talk.says("");
    talk.hears("degrees [20.0]:");
    talk.says("90");
    talk.hears("allowed is a number from 1 to 45");
    talk.says("22");
    talk.hears("[y/N]");
    talk.says("y");
    let text = talk.ends(0);
    assert!(text.contains("servo_right_us: 635 -> 700") && text.contains("stored, calibration"), "{text}");
    let after = shown(&sandbox, &chip);
    let value = |name: &str| after["parameters"][name].as_i64();
    let found = [value("servo_right_us"), value("servo_center_us"), value("servo_left_us")];
    assert_eq!(found, [Some(700), Some(1_000), Some(1_455)], "{after}");
    assert_eq!((value("steering_limit_tenth_mrad"), &after["stored"]), (Some(3_840), &Value::Bool(true)), "22 degrees");
}

#[test]
fn whoever_gives_up_leaves_the_calibration_as_it_was() {
    let (sandbox, chip) = (Sandbox::new(), Chip::new());
    let before = shown(&sandbox, &chip);
    let mut talk = Talk::start(&sandbox, &["calibrate", "servo", "--port", chip.port()]);
    talk.hears("centre: 1050 us >");
    talk.says("++");
    talk.hears("centre: 1100 us >");
    let text = talk.ends(1);
    assert!(text.contains("nothing was stored"), "{text}");
    assert_eq!(shown(&sandbox, &chip), before, "not even for this run of the chip");
    let args =
        ["calibrate", "servo", "--port", chip.port(), "--right-us", "700", "--center-us", "650", "--left-us", "1400"];
    let refused = sandbox.carril(&[&args[..], &["--yes"]].concat()).expect_error(1);
    assert!(refused.contains("the centre must lie between the two stops"), "{refused}");
    assert_eq!(shown(&sandbox, &chip), before, "what does not go together is not stored");
}

#[test]
fn the_encoder_is_measured_by_hand_by_the_motor_and_from_runs_of_before() {
    let (sandbox, chip) = (Sandbox::new(), Chip::new());
    let args = ["calibrate", "encoder", "--port", chip.port(), "--distance-m", "2", "--runs", "3"];
    let mut talk = Talk::start(&sandbox, &args);
    for (run, ticks) in [1_273, 1_274, 1_400].into_iter().enumerate() {
        talk.hears("at its start, then press Enter.");
        talk.says("");
        talk.hears("Push the car 2 m straight ahead, then press Enter.");
        chip.turn(ticks);
        // The chip looks at its wheel every 2 ms, and reports every 10.
        std::thread::sleep(Duration::from_millis(50));
        talk.says("");
        talk.hears(&format!("run {} of 3: {ticks} ticks", run + 1));
    }
    talk.hears("[y/N]");
    talk.says("y");
    let text = talk.ends(0);
    assert!(text.contains("left out") && text.contains("stored, calibration"), "{text}");
    let tick_nm = shown(&sandbox, &chip)["parameters"]["encoder_tick_nm"].as_f64().expect("a number");
    let expected_nm = 2e9 / 1_273.5;
    assert!((tick_nm - expected_nm).abs() < 1e-3 * expected_nm, "{tick_nm} nm a tick, expected {expected_nm}");

    let args = ["calibrate", "encoder", "--port", chip.port(), "--duty", "0.3", "--seconds", "0.5", "--runs", "1"];
    let mut talk = Talk::start(&sandbox, &args);
    talk.hears("Enter starts.");
    talk.says("");
    talk.hears("How many turns were it?");
    assert!(chip.brakes(), "the motor is off again: {:?}", chip.now());
    talk.says("1");
    talk.hears("[y/N]");
    talk.says("n");
    assert!(talk.ends(1).contains("nothing was stored"), "no is no");

    let records = sandbox.path().join("car1.calibration.yaml").display().to_string();
    let runs = ["--run", "2:1273", "--run", "2:1275", "--run", "4:2547", "--yes", "--record", &records];
    let args = [&["calibrate", "encoder", "--port", chip.port()][..], &runs].concat();
    let text = sandbox.carril(&args).expect(0);
    assert!(text.contains("off by mm") && text.contains("a tick is 1.5703 mm of road"), "{text}");
    let record = std::fs::read_to_string(&records).expect("the record is written");
    for part in ["when: ", "what: encoder", "--run 2:1273", "encoder_tick_nm: 1570269", "ticks: 2547"] {
        assert!(record.contains(part), "`{part}` in the record:\n{record}");
    }
}

#[test]
fn parameters_are_set_kept_in_a_file_and_brought_back() {
    let (sandbox, chip) = (Sandbox::new(), Chip::new());
    let port = ["--port", chip.port()];
    let file = sandbox.path().join("car1.json").display().to_string();
    let carril = |args: &[&str]| sandbox.carril(&[&["calibrate"][..], args, &port].concat());
    carril(&["backup", &file]).expect(0);
    let text = carril(&["set", "battery_low_mv=6800", "lease_ramp_ms=100", "--yes"]).expect(0);
    assert!(text.contains("battery_low_mv: 6400 -> 6800") && text.contains("lease_ramp_ms: 0 -> 100"), "{text}");
    assert_eq!(shown(&sandbox, &chip)["parameters"]["battery_low_mv"], 6_800, "in force and stored");
    let table = carril(&["show"]).expect(0);
    assert!(table.contains("battery_low_mv") && table.contains("0 to 60000 mV") && table.contains("stored"), "{table}");
    carril(&["restore", &file, "--yes"]).expect(0);
    assert_eq!(shown(&sandbox, &chip)["parameters"]["battery_low_mv"], 6_400, "as it was");
    let clash = carril(&["set", "estop_pin=9", "--yes"]).expect_error(1);
    assert!(clash.contains("servo_pin and estop_pin: both have pin 9"), "{clash}");
    let unknown = carril(&["set", "servo=9"]).expect_error(2);
    assert!(unknown.contains("there is no parameter `servo`"), "{unknown}");
    sandbox.write("broken.json", "{\"parameters\": {}}");
    let broken = sandbox.path().join("broken.json").display().to_string();
    let error = carril(&["restore", &broken, "--yes"]).expect_error(1);
    assert!(error.contains("it lacks servo_pin"), "{error}");
}

#[test]
fn a_port_that_is_none_and_a_chip_that_is_silent_are_named() {
    let sandbox = Sandbox::new();
    let error = sandbox.carril(&["calibrate", "show", "--port", "/dev/nothing-here"]).expect_error(1);
    assert!(error.contains("`/dev/nothing-here`") && error.contains("is it plugged in"), "{error}");
    let error = sandbox.carril(&["calibrate", "show"]).expect_error(2);
    assert!(error.contains("--port PATH or --graph FILE"), "{error}");
    let error = sandbox.carril(&["calibrate", "show", "--graph", "dataflow.yaml"]).expect_error(1);
    assert!(error.contains("the simulated line `sim:mcu`"), "{error}");
    let error = sandbox.carril(&["calibrate", "show", "--graph", "dataflows/hardware.yaml"]).expect_error(1);
    assert!(error.contains("/dev/ttyUSB0"), "{error}");
}
