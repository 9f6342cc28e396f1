//! The core of the firmware beside the model in Rust: after any conversation both must say and do the same. The core runs on this
//! machine (`target/firmware/chip-on-host`, built by `./dev firmware`).

use std::path::{Path, PathBuf};

use carril_bridge::calibration::Param;
use carril_bridge::chip_program::{CYCLES_PER_US, ChipInputs, ChipProgram, Happened, Stretch};
use carril_bridge::codec::{
    CalibrationStore, Command, Decoder, Direction, Drive, FULL_DUTY, Frame, Packet, ParameterWrite, Session, Telemetry,
    encode,
};
use carril_bridge::mcu_model::McuModel;
use carril_messages::{FaultSet, McuPins, McuSensors};
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

#[path = "../../tests/support/thorough.rs"]
mod thorough;

/// Between two looks at both.
const LOOK_MS: u64 = 20;
/// The model steps like this.
const STEP_MS: u64 = 5;
/// Two controllers, one in integers and one in floating point, one with edges and one with a count, agree to so much of full duty.
const DUTY_TOLERANCE: f32 = 0.06;
const LIMIT_V: f32 = 6.4;

fn program() -> Option<PathBuf> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../target/firmware/chip-on-host");
    if path.is_file() {
        return Some(path);
    }
    assert!(!thorough::is_thorough(), "there is no `{}`; `./dev firmware` builds it", path.display());
    println!("skipped: there is no `{}`; `./dev firmware` builds it", path.display());
    None
}

/// What one of the two says and does.
#[derive(Debug, Default)]
struct Side {
    /// Frames other than telemetry, since the last look.
    answers: Vec<Frame>,
    telemetry: Telemetry,
    pins: Option<McuPins>,
    decoder: Option<Decoder>,
}

impl Side {
    fn hear(&mut self, bytes: &[u8]) {
        let decoder = self.decoder.get_or_insert_with(|| Decoder::new(Direction::FromChip));
        for byte in bytes {
            match decoder.push(*byte) {
                Some(Ok(Packet { frame: Frame::Telemetry(telemetry), .. })) => self.telemetry = telemetry,
                Some(Ok(Packet { frame, .. })) => self.answers.push(without_identity(frame)),
                Some(Err(error)) => panic!("a damaged frame from a chip: {error}"),
                None => {}
            }
        }
    }
}

/// Versions differ, times do, and whoever stores at once has another word for what is stored until the other has.
fn without_identity(frame: Frame) -> Frame {
    match frame {
        Frame::HelloAck(mut ack) => {
            ack.firmware = carril_bridge::mcu_model::FIRMWARE;
            Frame::HelloAck(ack)
        }
        Frame::TimeSyncAck(mut ack) => {
            (ack.received_us, ack.sent_us) = (0, 0);
            Frame::TimeSyncAck(ack)
        }
        frame => frame,
    }
}

struct Both {
    chip: ChipProgram,
    model: McuModel,
    inputs: ChipInputs,
    now_ms: u64,
    edges: u32,
    forward: bool,
    firmware: Side,
    rust: Side,
    seq: u16,
    log: Vec<String>,
}

impl Both {
    fn new(program: &Path) -> Self {
        Self {
            chip: ChipProgram::start(program, None).expect("it starts"),
            model: McuModel::new(LIMIT_V),
            inputs: ChipInputs::default(),
            now_ms: 0,
            edges: 0,
            forward: true,
            firmware: Side::default(),
            rust: Side::default(),
            seq: 0,
            log: Vec::new(),
        }
    }

    fn say(&mut self, frame: Frame) {
        self.log.push(format!("{} ms: {frame:?}", self.now_ms));
        let mut bytes = Vec::new();
        encode(&Packet { seq: self.seq, frame }, &mut bytes);
        self.seq = self.seq.wrapping_add(1);
        self.bytes(&bytes);
    }

    fn bytes(&mut self, bytes: &[u8]) {
        let mut reply = Vec::new();
        self.model.receive(self.now_ms * 1_000, bytes, &mut reply);
        self.rust.hear(&reply);
        let stretch = self.chip.advance(0, self.inputs, bytes).expect("it runs");
        self.follow(&stretch);
    }

    fn follow(&mut self, stretch: &Stretch) {
        self.firmware.hear(&stretch.sent());
        self.edges = stretch.edges;
        let mut pins = self.firmware.pins.unwrap_or(McuPins { servo_us: None, motor_duty: 0.0, brake: true });
        for event in &stretch.events {
            match event.what {
                Happened::MotorDuty(duty) => pins.motor_duty = f32::from(duty) / 255.0,
                Happened::Direction(level) => self.forward = level,
                Happened::ServoPulse(width) => pins.servo_us = Some((u64::from(width) / CYCLES_PER_US) as u16),
                _ => {}
            }
        }
        pins.motor_duty = if self.forward { pins.motor_duty.abs() } else { -pins.motor_duty.abs() };
        pins.brake = pins.motor_duty == 0.0;
        self.firmware.pins = Some(pins);
    }

    fn run(&mut self) {
        for _ in 0..LOOK_MS / STEP_MS {
            let stretch = self.chip.advance(STEP_MS as u32 * 1_000, self.inputs, &[]).expect("it runs");
            self.follow(&stretch);
            self.now_ms += STEP_MS;
            let rate = self.inputs.encoder_edges_per_s;
            let sensors = McuSensors {
                encoder_ticks: u64::from(self.edges),
                encoder_period_us: (rate > 0.0).then(|| (1e6 / rate) as u32),
                battery_v: f32::from(self.inputs.battery_mv) / 1_000.0,
                estop_pressed: self.inputs.estop_pressed,
            };
            let mut reply = Vec::new();
            self.rust.pins = Some(self.model.step(self.now_ms * 1_000, Some(&sensors), &mut reply));
            self.rust.hear(&reply);
        }
    }

    /// What they do not agree on.
    fn differences(&self) -> Vec<String> {
        let (a, b) = (&self.firmware.telemetry, &self.rust.telemetry);
        let mut found = Vec::new();
        let mut compare = |name: &str, a: &dyn std::fmt::Debug, b: &dyn std::fmt::Debug| {
            let (a, b) = (format!("{a:?}"), format!("{b:?}"));
            if a != b {
                found.push(format!("{name}: the firmware has {a}, the model {b}"));
            }
        };
        compare("session", &a.session, &b.session);
        compare("faults", &FaultSet(a.faults.0), &FaultSet(b.faults.0));
        compare("driving", &a.driving, &b.driving);
        compare("steering", &a.steering_tenth_mrad, &b.steering_tenth_mrad);
        compare("last command", &a.last_command.map(|last| last.seq), &b.last_command.map(|last| last.seq));
        compare("damaged frames", &a.damaged_frames, &b.damaged_frames);
        compare("answers", &self.firmware.answers, &self.rust.answers);
        if let (Some(a), Some(b)) = (self.firmware.pins, self.rust.pins) {
            compare("servo", &a.servo_us.is_some(), &b.servo_us.is_some());
            if let (Some(a), Some(b)) = (a.servo_us, b.servo_us)
                && a.abs_diff(b) > 1
            {
                found.push(format!("servo: the firmware has {a} us, the model {b}"));
            }
            if (a.motor_duty - b.motor_duty).abs() > DUTY_TOLERANCE || (a.motor_duty == 0.0) != (b.motor_duty == 0.0) {
                found.push(format!("duty: the firmware has {}, the model {}", a.motor_duty, b.motor_duty));
            }
        }
        found
    }

    fn look(&mut self, seed: u64) {
        self.run();
        if !self.differences().is_empty() {
            // One of them may have seen a limit a step earlier.
            self.run();
        }
        let found = self.differences();
        let log = self.log[self.log.len().saturating_sub(12)..].join("\n  ");
        assert!(found.is_empty(), "seed {seed}, at {} ms:\n{}\nafter\n  {log}", self.now_ms, found.join("\n"));
        self.firmware.answers.clear();
        self.rust.answers.clear();
    }
}

fn random_step(both: &mut Both, rng: &mut impl Rng) {
    let session = Session(rng.random_range(1..4));
    let open = both.rust.telemetry.session.filter(|_| rng.random_bool(0.85)).unwrap_or(session);
    match rng.random_range(0..20) {
        0..3 => both.say(Frame::Hello(session)),
        3..11 => {
            let steering_tenth_mrad = rng.random_range(-4_000..=4_000);
            let drive = if rng.random_bool(0.6) {
                Drive::Speed([0, 3, 300, 500, -400, 3_000].choose(rng).copied().unwrap_or(0))
            } else {
                Drive::Duty([0, 100, 510, -510, FULL_DUTY].choose(rng).copied().unwrap_or(0))
            };
            let lease_ms = [7, 52, 203, 1_994].choose(rng).copied().unwrap_or(203);
            both.say(Frame::Command(Command { session: open, steering_tenth_mrad, drive, lease_ms }));
        }
        11 => both.say(Frame::EStop),
        12..15 => both.say(Frame::FaultClear(open)),
        15 => both.say(Frame::Release(open)),
        16 => {
            both.inputs.encoder_edges_per_s = [0.0, 0.0, 200.0, 318.0, 600.0].choose(rng).copied().unwrap_or(0.0);
            both.log.push(format!("{} ms: {:?}", both.now_ms, both.inputs));
        }
        17 => {
            both.inputs.estop_pressed = rng.random_bool(0.2);
            both.inputs.battery_mv = if rng.random_bool(0.15) { 5_000 } else { 8_000 };
            both.log.push(format!("{} ms: {:?}", both.now_ms, both.inputs));
        }
        18 => {
            let param = Param::ALL[[1, 2, 3, 4, 9, 16, 18].choose(rng).copied().unwrap_or(1)];
            let spec = param.spec();
            let value = rng.random_range(spec.min - 5..=spec.max.min(spec.default * 2 + 50));
            both.say(Frame::ParameterWrite(ParameterWrite { session: open, index: param as u8, value }));
        }
        _ => match rng.random_range(0..6) {
            0 => both.say(Frame::ParameterRead(rng.random_range(0..30))),
            1 => both.say(Frame::CalibrationQuery),
            2 => both.say(Frame::CalibrationDefaults(open)),
            3 => both.say(Frame::CalibrationStore(CalibrationStore { session: open, crc: 0 })),
            4 => both.say(Frame::TimeSync(rng.random())),
            _ => {
                both.log.push(format!("{} ms: garbage", both.now_ms));
                both.bytes(&[0, 9, 9, 9, 0]);
            }
        },
    }
}

#[test]
fn both_say_and_do_the_same_in_any_conversation() {
    let Some(program) = program() else { return };
    let (conversations, steps) = (thorough::count(20, 200), 250);
    for seed in 0..conversations {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut both = Both::new(&program);
        both.look(seed);
        for _ in 0..steps {
            random_step(&mut both, &mut rng);
            both.look(seed);
        }
    }
}
