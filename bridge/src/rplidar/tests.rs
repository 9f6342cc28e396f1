//! The driver and the device at the two ends of a line in memory: what it sees, and what it does when the device is unwell, silent, gone or
//! says nonsense. And the packets of `vectors/rplidar.txt`.

use std::f32::consts::{PI, TAU};
use std::time::Duration;

use carril_messages::{LaserScan, Stamp};
use carril_runtime::lines::{End, MemoryLine, MemoryLines};
use carril_runtime::{Context, HeapPool, NoInputs, Operator, Setup, Trigger, Waker};

use super::codec::{Decoder, Event, Request};
use super::model::RplidarModel;
use super::{Mode, Rplidar, RplidarConfig, RplidarOutputs};

/// Between two steps of both ends.
const STEP: Duration = Duration::from_millis(10);

struct Bench {
    lines: MemoryLines,
    driver: Rplidar,
    outputs: RplidarOutputs,
    device: RplidarModel,
    line: MemoryLine,
    now: Stamp,
    world: LaserScan,
    scans: Vec<LaserScan>,
    trouble: Vec<String>,
    /// What the device says is changed by this before it gets onto the line.
    harm: fn(&mut Vec<u8>),
}

/// 3 m all around, but for 1 m at 90 degrees to the left, and nothing at all behind.
fn world() -> LaserScan {
    let ranges_m = (0..360).map(|index| match index - 180 {
        80..=100 => 1.0,
        -180..=-160 | 160..=180 => f32::INFINITY,
        _ => 3.0,
    });
    LaserScan {
        angle_min_rad: -PI,
        angle_increment_rad: TAU / 360.0,
        scan_time_s: 0.1,
        range_min_m: 0.05,
        range_max_m: 12.0,
        ranges_m: ranges_m.collect(),
    }
}

impl Bench {
    fn new(mode: Mode, device: RplidarModel) -> Self {
        let lines = MemoryLines::default();
        let setup = Setup { memory_lines: Some(lines.clone()), ..Setup::for_tests("lidar") };
        let config = RplidarConfig { mode, ..RplidarConfig::on("sim:lidar") };
        let driver = Rplidar::new(config, &setup).expect("a line in memory opens");
        let line = lines.open("lidar", End::Device, Waker::new(|| ()));
        Self {
            lines,
            driver,
            outputs: RplidarOutputs::default(),
            device,
            line,
            now: Stamp::ZERO,
            world: world(),
            scans: Vec::new(),
            trouble: Vec::new(),
            harm: |_| (),
        }
    }

    fn run(&mut self, seconds: f64) {
        let steps = (seconds / STEP.as_secs_f64()).round() as u32;
        for _ in 0..steps {
            self.now = self.now + STEP;
            let (mut heard, mut said) = (Vec::new(), Vec::new());
            self.line.read_into(&mut heard);
            self.device.hear(&heard, &mut said);
            self.device.turn(STEP.as_secs_f64(), Some(&self.world), &mut said);
            (self.harm)(&mut said);
            self.line.write(&said);
            let context = Context::new(self.now, Trigger::Period, &HeapPool);
            if let Err(error) = self.driver.step(&mut NoInputs, &mut self.outputs, &context) {
                self.trouble.push(error.to_string());
            }
            self.scans.extend(self.outputs.scan.sent().iter().map(|scan| (**scan).clone()));
        }
    }
}

#[test]
fn sees_what_is_around_it_in_both_modes() {
    for mode in [Mode::Standard, Mode::Express] {
        let mut bench = Bench::new(mode, RplidarModel::default());
        bench.run(2.0);
        assert!((15..=19).contains(&bench.scans.len()), "{mode:?}: ten turns a second: {}", bench.scans.len());
        assert_eq!(bench.trouble, Vec::<String>::new(), "{mode:?}");
        let scan = bench.scans.last().expect("some");
        let at = |bearing_deg: i32| scan.ranges_m[(bearing_deg + 180) as usize];
        assert!((at(90) - 1.0).abs() < 0.002 && (at(-90) - 3.0).abs() < 0.002, "{mode:?}: left and right differ");
        assert!((at(0) - 3.0).abs() < 0.002 && at(-175) == f32::INFINITY, "{mode:?}: ahead and behind");
        assert!((scan.scan_time_s - 0.1).abs() < 0.03, "{mode:?}: {} s", scan.scan_time_s);
    }
}

#[test]
fn a_device_that_has_stopped_itself_is_reset_and_told() {
    let mut bench = Bench::new(Mode::Express, RplidarModel::unwell(2, 0x8001));
    bench.run(0.5);
    assert!(
        bench.trouble.iter().any(|told| told.contains("error 0x8001") && told.contains("reset")),
        "{:?}",
        bench.trouble
    );
    assert_eq!(bench.scans.len(), 0, "it does not scan");
    bench.run(3.0);
    assert!(bench.scans.len() > 5, "after the reset it does");
}

#[test]
fn a_warning_is_told_and_it_scans_on() {
    let mut bench = Bench::new(Mode::Standard, RplidarModel::unwell(1, 7));
    bench.run(1.5);
    assert!(bench.trouble.iter().any(|told| told.contains("warns of itself (code 0x0007)")), "{:?}", bench.trouble);
    assert!(bench.scans.len() > 5, "it scans");
}

#[test]
fn silence_and_a_restart_of_the_device_are_told_and_overcome() {
    let mut bench = Bench::new(Mode::Express, RplidarModel::default());
    bench.run(1.5);
    // Its supply failed: it is there again, and knows nothing of a scan.
    bench.device = RplidarModel::default();
    bench.run(1.2);
    assert!(bench.trouble.iter().any(|told| told.contains("no measurement for 1")), "{:?}", bench.trouble);
    let before = bench.scans.len();
    bench.run(1.5);
    assert!(bench.scans.len() > before + 5, "it scans again");
}

#[test]
fn nobody_there_is_told_once_and_asked_on() {
    let mut bench = Bench::new(Mode::Express, RplidarModel::default());
    bench.lines.set_cut("lidar", true);
    bench.run(8.0);
    let told = bench.trouble.iter().filter(|told| told.contains("nothing answers as an RPLIDAR does")).count();
    assert_eq!(told, 1, "{:?}", bench.trouble);
    bench.lines.set_cut("lidar", false);
    bench.run(3.0);
    assert!(bench.scans.len() > 5, "when it is there it scans");
}

#[test]
fn damaged_bytes_cost_measurements_and_no_lies() {
    let mut bench = Bench::new(Mode::Express, RplidarModel::default());
    // Every 173rd byte has a flipped bit, every 1009th is lost.
    bench.harm = |bytes| {
        for at in (0..bytes.len()).step_by(173).skip(1) {
            bytes[at] ^= 0x10;
        }
        if bytes.len() > 100 {
            bytes.remove(97);
        }
    };
    bench.run(6.0);
    assert!(bench.scans.len() > 20, "{} scans", bench.scans.len());
    for range_m in bench.scans.iter().flat_map(|scan| &scan.ranges_m).filter(|range_m| range_m.is_finite()) {
        assert!(
            (range_m - 3.0).abs() < 0.002 || (range_m - 1.0).abs() < 0.002,
            "a range that nobody sent: {range_m} m"
        );
    }
    assert!(bench.driver.talk.lost() > 0, "and they are counted");
}

#[test]
fn requests_and_answers_are_those_of_the_description() {
    let bytes_of = |hex: &str| -> Vec<u8> {
        hex.split_whitespace().map(|pair| u8::from_str_radix(pair, 16).expect("the vectors are in hex")).collect()
    };
    let lines = include_str!("../../vectors/rplidar.txt").lines();
    let mut seen = 0;
    for line in lines.filter(|line| !line.starts_with('#') && !line.is_empty()) {
        let (bytes, meaning) = line.split_once(" = ").expect("bytes = meaning");
        let bytes = bytes_of(bytes);
        let request = match meaning {
            "stop" => Some(Request::Stop),
            "reset" => Some(Request::Reset),
            "info?" => Some(Request::Info),
            "health?" => Some(Request::Health),
            "scan" => Some(Request::Scan),
            "express scan" => Some(Request::ExpressScan),
            "motor 660" => Some(Request::MotorPwm(660)),
            _ => None,
        };
        if let Some(request) = request {
            assert_eq!(request.encode(), bytes, "{line}");
        } else {
            let mut events = Vec::new();
            Decoder::default().push(&bytes, &mut events);
            let told: Vec<String> = events.iter().map(told).collect();
            assert_eq!(told.join(", "), meaning, "{line}");
            for end in 0..bytes.len() {
                let mut cut = Vec::new();
                Decoder::default().push(&bytes[..end], &mut cut);
                assert!(cut.len() < events.len(), "{line}: cut after {end} bytes");
            }
        }
        seen += 1;
    }
    assert!(seen >= 12, "{seen} vectors");
}

fn told(event: &Event) -> String {
    match event {
        Event::Info(info) => format!("model {:02x} firmware {}.{}", info.model, info.firmware[0], info.firmware[1]),
        Event::Health(health) => format!("{:?} {}", health.status, health.code).to_lowercase(),
        Event::Scanning(answer) => format!("{answer:?}").to_lowercase(),
        Event::Point(point) => {
            let range = point.range_m.map_or("-".to_owned(), |range_m| format!("{range_m:.3} m"));
            format!("{}{:.2} deg {range}", if point.begins { "begins " } else { "" }, point.clockwise_deg)
        }
    }
}
