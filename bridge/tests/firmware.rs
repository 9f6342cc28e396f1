//! The firmware as it is flashed, on a simulated ATmega328P, in the chip's own time: what its pins do, and when. Built by
//! `./dev firmware` into `target/firmware`; without it these tests say that they are skipped, and when thorough they fail.

use std::path::PathBuf;

use carril_bridge::calibration::{Calibration, Param};
use carril_bridge::chip_program::{CYCLES_PER_US, ChipEvent, ChipInputs, ChipProgram, EEPROM_BYTES, Happened};
use carril_bridge::codec::{
    CalibrationStatus, CalibrationStore, Command, Decoder, Direction, Drive, Frame, Packet, ParameterWrite, Session,
    Telemetry, encode,
};
use carril_messages::{Fault, FaultSet};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

#[path = "../../tests/support/thorough.rs"]
mod thorough;

const SESSION: Session = Session(0x1234);
const LEASE_MS: u16 = 200;
/// From the end of a lease to the motor's PWM off, at most.
const BRAKES_WITHIN_US: u64 = 10_000;
/// The longest pass of the main loop.
const LONGEST_PASS_US: u64 = 1_000;

fn built(name: &str) -> Option<PathBuf> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../target/firmware").join(name);
    if path.is_file() {
        return Some(path);
    }
    assert!(!thorough::is_thorough(), "there is no `{}`; `./dev firmware` builds it", path.display());
    println!("skipped: there is no `{}`; `./dev firmware` builds it", path.display());
    None
}

/// The chip with a host that says what the test wants.
struct Bench {
    chip: ChipProgram,
    inputs: ChipInputs,
    now_us: u64,
    seq: u16,
    decoder: Decoder,
    events: Vec<ChipEvent>,
    frames: Vec<(u64, Frame)>,
    edges: u32,
    longest_pass_us: u64,
}

impl Bench {
    /// `None`: it is not built.
    fn new() -> Option<Self> {
        let (program, elf) = (built("simulated-chip")?, built("firmware.elf")?);
        let chip = ChipProgram::start(&program, Some(&elf)).expect("it starts");
        let mut bench = Self {
            chip,
            inputs: ChipInputs::default(),
            now_us: 0,
            seq: 0,
            decoder: Decoder::new(Direction::FromChip),
            events: Vec::new(),
            frames: Vec::new(),
            edges: 0,
            longest_pass_us: 0,
        };
        bench.run_ms(100);
        Some(bench)
    }

    /// With a car that drives at 0.5 m/s.
    fn driving() -> Option<Self> {
        let mut bench = Self::new()?;
        bench.greet(SESSION);
        bench.drive_for_ms(200);
        assert!(bench.duty() > 0 && bench.telemetry().driving, "it drives: {:?}", bench.telemetry());
        Some(bench)
    }

    fn greet(&mut self, session: Session) {
        self.say(Frame::Hello(session));
        self.run_ms(20);
        let answered = |frame: &Frame| matches!(frame, Frame::HelloAck(ack) if ack.session == session);
        assert!(self.frames.iter().any(|(_, frame)| answered(frame)), "the chip answers");
    }

    /// A command every 10 ms, and a wheel that turns as fast as it is told.
    fn drive_for_ms(&mut self, ms: u32) {
        self.inputs.encoder_edges_per_s = 318.0;
        for _ in 0..ms / 10 {
            self.say(command(SESSION, LEASE_MS));
            self.run_ms(10);
        }
    }

    fn bytes_of(&mut self, frame: Frame) -> Vec<u8> {
        let mut bytes = Vec::new();
        encode(&Packet { seq: self.seq, frame }, &mut bytes);
        self.seq = self.seq.wrapping_add(1);
        bytes
    }

    /// The bytes go out while the next time passes.
    fn say(&mut self, frame: Frame) {
        let bytes = self.bytes_of(frame);
        self.run_us(1_000, &bytes);
    }

    fn run_ms(&mut self, ms: u32) {
        self.run_us(ms * 1_000, &[]);
    }

    fn run_us(&mut self, us: u32, bytes: &[u8]) {
        let stretch = self.chip.advance(us, self.inputs, bytes).expect("the chip runs");
        self.now_us = stretch.end_cycles / CYCLES_PER_US;
        self.edges = stretch.edges;
        for event in stretch.events {
            match event.what {
                Happened::Sent(byte) => {
                    if let Some(Ok(packet)) = self.decoder.push(byte) {
                        self.frames.push((event.cycles / CYCLES_PER_US, packet.frame));
                    }
                }
                Happened::LongestPass(cycles) => {
                    self.longest_pass_us = self.longest_pass_us.max(u64::from(cycles) / CYCLES_PER_US);
                }
                Happened::Crashed => panic!("the firmware has crashed"),
                _ => self.events.push(event),
            }
        }
    }

    fn telemetry(&self) -> Telemetry {
        let last = self.frames.iter().rev().find_map(|(_, frame)| match frame {
            Frame::Telemetry(telemetry) => Some(*telemetry),
            _ => None,
        });
        last.expect("telemetry has come")
    }

    fn faults(&self) -> FaultSet {
        self.telemetry().faults
    }

    fn duty(&self) -> u8 {
        let last = self.events.iter().rev().find_map(|event| match event.what {
            Happened::MotorDuty(duty) => Some(duty),
            _ => None,
        });
        last.unwrap_or(0)
    }

    /// When the motor went off for good.
    fn braked_at_us(&self) -> Option<u64> {
        let last = self.events.iter().rev().find_map(|event| match event.what {
            Happened::MotorDuty(duty) => Some((event.cycles / CYCLES_PER_US, duty)),
            _ => None,
        });
        last.filter(|(_, duty)| *duty == 0).map(|(at, _)| at)
    }

    fn pulses_us(&self) -> Vec<(u64, u64)> {
        let pulse = |event: &ChipEvent| match event.what {
            Happened::ServoPulse(width) => Some((event.cycles / CYCLES_PER_US, u64::from(width) / CYCLES_PER_US)),
            _ => None,
        };
        self.events.iter().filter_map(pulse).collect()
    }

    fn restarts(&self) -> usize {
        self.events.iter().filter(|event| event.what == Happened::WatchdogReset).count()
    }

    /// The last answer to a question for the calibration.
    fn status(&self) -> CalibrationStatus {
        let last = self.frames.iter().rev().find_map(|(_, frame)| match frame {
            Frame::Parameter(parameter) => Some(parameter.status),
            Frame::Calibration(state) => Some(state.status),
            _ => None,
        });
        last.expect("it was asked")
    }
}

fn command(session: Session, lease_ms: u16) -> Frame {
    Frame::Command(Command { session, steering_tenth_mrad: 500, drive: Drive::Speed(500), lease_ms })
}

/// The host falls silent in some way after a last command; the motor must be off within the lease and 10 ms.
#[track_caller]
fn brakes_in_time(how: &str, falls_silent: impl Fn(&mut Bench)) {
    let Some(mut bench) = Bench::driving() else { return };
    let bytes = bench.bytes_of(command(SESSION, LEASE_MS));
    let last_byte_us = bench.now_us + bytes.len() as u64 * 20;
    bench.run_us(1_000, &bytes);
    falls_silent(&mut bench);
    bench.run_ms(100);
    let braked_us = bench.braked_at_us().unwrap_or_else(|| panic!("{how}: it never brakes"));
    let late_us = braked_us.saturating_sub(last_byte_us + u64::from(LEASE_MS) * 1_000);
    assert!(late_us <= BRAKES_WITHIN_US, "{how}: {late_us} us late");
    assert!(braked_us + 1_000 > last_byte_us + u64::from(LEASE_MS) * 1_000, "{how}: and not before the lease is over");
    assert!(bench.faults().contains(Fault::LeaseExpired), "{how}: latched: {:?}", bench.faults());
    // A command alone does not wake it up again.
    bench.say(command(SESSION, LEASE_MS));
    bench.run_ms(20);
    assert_eq!(bench.duty(), 0, "{how}: it stays off");
    println!("{how}: motor off {late_us} us after the end of the lease");
}

#[test]
fn the_motor_is_off_in_time_whatever_becomes_of_the_host() {
    brakes_in_time("host killed", |bench| bench.run_ms(250));
    brakes_in_time("cable pulled in the middle of a frame", |bench| {
        let bytes = bench.bytes_of(command(SESSION, LEASE_MS));
        bench.run_us(250_000, &bytes[..bytes.len() / 2]);
    });
    brakes_in_time("garbage at the full speed of the line", |bench| {
        let mut rng = Pcg64Mcg::seed_from_u64(7);
        for _ in 0..250 {
            let garbage: Vec<u8> = (0..50).map(|_| rng.random()).collect();
            bench.run_us(1_000, &garbage);
        }
    });
    brakes_in_time("frozen host that repeats what is in its buffer", |bench| {
        let stale = bench.bytes_of(Frame::Hello(SESSION));
        (0..250).for_each(|_| bench.run_us(1_000, &stale));
    });
}

#[test]
fn a_lease_as_short_as_it_may_be_and_as_long_is_kept_to() {
    for lease_ms in [1, 20, 2_000] {
        let Some(mut bench) = Bench::driving() else { return };
        let bytes = bench.bytes_of(command(SESSION, lease_ms));
        let end_us = bench.now_us + bytes.len() as u64 * 20 + u64::from(lease_ms) * 1_000;
        bench.run_us(1_000, &bytes);
        bench.run_ms(u32::from(lease_ms) + 50);
        let braked_us = bench.braked_at_us().expect("it brakes");
        let late_us = braked_us.saturating_sub(end_us);
        assert!(late_us <= BRAKES_WITHIN_US, "lease of {lease_ms} ms: {late_us} us late");
    }
}

#[test]
fn the_steering_follows_within_one_servo_period() {
    let Some(mut bench) = Bench::driving() else { return };
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let mut slowest_us = 0;
    for round in 0..60 {
        let steering_tenth_mrad = if round % 2 == 0 { 3_491 } else { -3_491 };
        // At any place in the servo's period.
        bench.run_us(rng.random_range(1_000..20_000), &[]);
        let drive = Drive::Speed(500);
        let bytes =
            bench.bytes_of(Frame::Command(Command { session: SESSION, steering_tenth_mrad, drive, lease_ms: 2_000 }));
        let taken_us = bench.now_us + bytes.len() as u64 * 20;
        bench.run_us(40_000, &bytes);
        let wanted_us: u64 = if steering_tenth_mrad > 0 { 1_465 } else { 635 };
        let begun =
            bench.pulses_us().into_iter().find(|(end, width)| *end > taken_us && width.abs_diff(wanted_us) <= 2);
        let (end_us, width_us) = begun.expect("the servo is told");
        slowest_us = slowest_us.max((end_us - width_us).saturating_sub(taken_us));
    }
    println!("from a steering command to the pulse that has it: {slowest_us} us at most");
    assert!(slowest_us <= 20_000, "{slowest_us} us, allowed are 20000");
}

#[test]
fn twenty_thousand_edges_a_second_are_counted_beside_a_full_line() {
    let Some(mut bench) = Bench::driving() else { return };
    bench.inputs.encoder_edges_per_s = 0.0;
    bench.run_ms(30);
    let (before, edges_before) = (bench.telemetry().ticks, bench.edges);
    bench.inputs.encoder_edges_per_s = 20_000.0;
    for _ in 0..50 {
        // Close to the 500 B that the line carries in 10 ms.
        let mut bytes = Vec::new();
        for _ in 0..27 {
            bytes.extend(bench.bytes_of(command(SESSION, LEASE_MS)));
        }
        bench.run_us(10_000, &bytes);
    }
    bench.inputs.encoder_edges_per_s = 0.0;
    bench.run_ms(50);
    let (counted, given) = (bench.telemetry().ticks.wrapping_sub(before), bench.edges - edges_before);
    assert_eq!(counted, given, "every edge");
    assert!(given >= 9_990, "half a second of them: {given}");
    println!("{given} edges counted; longest pass of the main loop {} us", bench.longest_pass_us);
    assert!(bench.longest_pass_us <= LONGEST_PASS_US, "{} us", bench.longest_pass_us);
}

#[test]
fn a_program_that_hangs_is_ended_by_the_watchdog_and_must_be_greeted_anew() {
    let Some(mut bench) = Bench::driving() else { return };
    bench.chip.hang().expect("it hangs");
    let hung_us = bench.now_us;
    bench.run_ms(150);
    assert_eq!(bench.restarts(), 1, "the watchdog bites once");
    let off_us = bench.braked_at_us().expect("the motor is off") - hung_us;
    println!("watchdog: motor off {off_us} us after the program hangs");
    assert!(off_us <= 100_000, "{off_us} us");
    assert!(bench.faults().contains(Fault::WatchdogReset), "it says so: {:?}", bench.faults());
    bench.say(command(SESSION, LEASE_MS));
    bench.run_ms(20);
    assert_eq!(bench.duty(), 0, "the old session is over");
    bench.greet(Session(2));
    bench.say(Frame::FaultClear(Session(2)));
    bench.say(command(Session(2), LEASE_MS));
    bench.run_ms(20);
    assert!(bench.duty() > 0, "greeted, cleared, commanded: it drives");
}

#[test]
fn the_button_and_the_word_stop_at_once() {
    let Some(mut bench) = Bench::driving() else { return };
    bench.inputs.estop_pressed = true;
    let pressed_us = bench.now_us;
    bench.run_ms(20);
    let off_us = bench.braked_at_us().expect("it brakes") - pressed_us;
    println!("e-stop button: motor off after {off_us} us");
    assert!(off_us <= 2_000 && bench.faults().contains(Fault::EstopPressed), "{off_us} us, {:?}", bench.faults());
    let Some(mut bench) = Bench::driving() else { return };
    let (bytes, said_us) = (bench.bytes_of(Frame::EStop), bench.now_us);
    bench.run_us(20_000, &bytes);
    let off_us = bench.braked_at_us().expect("it brakes") - said_us;
    assert!(off_us <= 3_000 && bench.faults().contains(Fault::EstopByHost), "{off_us} us, {:?}", bench.faults());
}

#[test]
fn a_calibration_outlasts_a_loss_of_power_and_a_damaged_one_is_noticed() {
    let Some(mut bench) = Bench::new() else { return };
    assert!(bench.faults().is_empty(), "never stored is no fault: {:?}", bench.faults());
    bench.greet(SESSION);
    let mut wanted = Calibration::default();
    for (param, value) in [(Param::ServoCenterUs, 1_000), (Param::BatteryLowMv, 6_800)] {
        wanted.set(param, value).expect("allowed");
        bench.say(Frame::ParameterWrite(ParameterWrite { session: SESSION, index: param as u8, value }));
        bench.run_ms(5);
        assert_eq!(bench.status(), CalibrationStatus::Done, "{param:?}");
    }
    bench.say(Frame::CalibrationStore(CalibrationStore { session: SESSION, crc: wanted.crc() }));
    bench.run_ms(600);
    assert_eq!(bench.status(), CalibrationStatus::Done, "stored");
    bench.chip.power_cycle().expect("off and on");
    bench.run_ms(100);
    bench.frames.clear();
    bench.greet(Session(9));
    let told = bench.frames.iter().find_map(|(_, frame)| match frame {
        Frame::HelloAck(ack) => Some(ack.calibration_crc),
        _ => None,
    });
    assert_eq!(told, Some(wanted.crc()), "the same values");
    bench.say(Frame::Command(Command {
        session: Session(9),
        steering_tenth_mrad: 0,
        drive: Drive::Duty(0),
        lease_ms: 200,
    }));
    bench.run_ms(50);
    let width_us = bench.pulses_us().last().map_or(0, |(_, width)| *width);
    assert!(width_us.abs_diff(1_000) <= 2, "and in force: {width_us} us");
    let mut eeprom: [u8; EEPROM_BYTES] = bench.chip.eeprom().expect("it can be read");
    eeprom[10] ^= 4;
    bench.chip.set_eeprom(&eeprom).expect("it can be written");
    bench.chip.power_cycle().expect("off and on");
    bench.run_ms(100);
    assert_eq!(bench.faults(), FaultSet::NONE.with(Fault::CalibrationInvalid), "one bit is noticed, and told");
}

#[test]
fn telemetry_comes_a_hundred_times_a_second_with_or_without_a_host() {
    let Some(mut bench) = Bench::new() else { return };
    bench.frames.clear();
    bench.run_ms(1_000);
    let times: Vec<u64> = bench.frames.iter().map(|(at, _)| *at).collect();
    assert!((99..=101).contains(&times.len()), "{} frames in a second", times.len());
    assert!(times.windows(2).all(|pair| pair[1] - pair[0] < 12_000), "evenly: {times:?}");
    assert!(bench.pulses_us().is_empty() && bench.duty() == 0, "and nothing moves");
}
