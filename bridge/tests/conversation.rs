//! Host and microcontroller in conversation, both without a port: every byte passes through a line that the test bends.

use std::collections::VecDeque;
use std::time::Duration;

use carril_bridge::codec::{Frame, FrameKind, Packet, Session, Telemetry, encode_with_version};
use carril_bridge::host::{CommandError, Effects, Host, Note};
use carril_bridge::mcu_model::McuModel;
use carril_messages::{Command, Control, Fault, FaultSet, McuPins, McuSensors, Stamp, WheelTelemetry};
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const STEP_US: u64 = 1_000;
const LEASE_MS: u16 = 200;
const DRIVE: Command = Command { steering_rad: 0.1, speed_m_s: 0.5 };

type Bend = Box<dyn FnMut(Vec<u8>, &mut Pcg64Mcg) -> Vec<u8>>;

/// Two ends, a line with a delay, and a wheel that turns while the motor does.
struct Talk {
    host: Host,
    chip: Option<McuModel>,
    now_us: u64,
    chip_started_us: u64,
    delay_us: u64,
    to_chip: VecDeque<(u64, Vec<u8>)>,
    to_host: VecDeque<(u64, Vec<u8>)>,
    bend: Bend,
    rng: Pcg64Mcg,
    command: Option<Command>,
    sensors: McuSensors,
    pins: Option<McuPins>,
    telemetry: Vec<WheelTelemetry>,
    /// When the last report was made, by the host's word.
    stamped: Stamp,
    notes: Vec<Note>,
}

/// Takes out what has been on the way for long enough.
fn arrived(line: &mut VecDeque<(u64, Vec<u8>)>, now_us: u64) -> Vec<Vec<u8>> {
    let count = line.iter().take_while(|(due, _)| *due <= now_us).count();
    line.drain(..count).map(|(_, bytes)| bytes).collect()
}

impl Talk {
    fn new() -> Self {
        let mut talk = Self {
            host: Host::new("test", LEASE_MS, 1, Stamp::ZERO),
            chip: Some(McuModel::new(6.4)),
            now_us: 0,
            chip_started_us: 0,
            delay_us: 0,
            to_chip: VecDeque::new(),
            to_host: VecDeque::new(),
            bend: Box::new(|bytes, _| bytes),
            rng: Pcg64Mcg::seed_from_u64(7),
            command: None,
            sensors: McuSensors { encoder_ticks: 0, encoder_period_us: None, battery_v: 8.0, estop_pressed: false },
            pins: None,
            telemetry: Vec::new(),
            stamped: Stamp::ZERO,
            notes: Vec::new(),
        };
        let mut effects = Effects::default();
        talk.host.opened(Stamp::ZERO, &mut effects);
        talk.carry_out(effects);
        talk
    }

    fn driving() -> Self {
        let mut talk = Self::new();
        talk.command = Some(DRIVE);
        talk.run_ms(100);
        assert!(talk.drives(), "the car drives: {:?}, {:?}", talk.pins, talk.problem());
        talk
    }

    fn now(&self) -> Stamp {
        Stamp::from_nanos(self.now_us as i64 * 1_000)
    }

    fn carry_out(&mut self, mut effects: Effects) {
        let bytes = [effects.urgent, effects.command.unwrap_or_default()].concat();
        if !bytes.is_empty() {
            let bent = (self.bend)(bytes, &mut self.rng);
            self.to_chip.push_back((self.now_us + self.delay_us, bent));
        }
        for (stamp, telemetry) in effects.telemetry.drain(..) {
            self.stamped = stamp;
            self.telemetry.push(telemetry);
        }
        self.notes.append(&mut effects.notes);
    }

    fn control(&mut self, control: Control) {
        let mut effects = Effects::default();
        self.host.control(control, self.now(), &mut effects);
        self.carry_out(effects);
    }

    fn run_ms(&mut self, ms: u64) {
        for _ in 0..ms * 1_000 / STEP_US {
            self.now_us += STEP_US;
            self.step_chip();
            self.step_host();
        }
    }

    fn step_chip(&mut self) {
        let Some(chip) = &mut self.chip else { return };
        let (chip_us, mut reply) = (self.now_us - self.chip_started_us, Vec::new());
        for bytes in arrived(&mut self.to_chip, self.now_us) {
            chip.receive(chip_us, &bytes, &mut reply);
        }
        let pins = chip.step(chip_us, Some(&self.sensors), &mut reply);
        if pins.motor_duty != 0.0 && self.now_us.is_multiple_of(3 * STEP_US) {
            self.sensors.encoder_ticks += 1;
            self.sensors.encoder_period_us = Some(3_000);
        }
        self.pins = Some(pins);
        if !reply.is_empty() {
            let bent = (self.bend)(reply, &mut self.rng);
            self.to_host.push_back((self.now_us + self.delay_us, bent));
        }
    }

    fn step_host(&mut self) {
        let (now, mut effects) = (self.now(), Effects::default());
        for bytes in arrived(&mut self.to_host, self.now_us) {
            self.host.receive(now, &bytes, &mut effects);
        }
        self.host.tick(now, &mut effects);
        if let Some(command) = self.command.filter(|_| self.now_us.is_multiple_of(20 * STEP_US)) {
            self.host.command(&command, now, now, &mut effects).expect("fresh and finite");
        }
        self.carry_out(effects);
    }

    /// Takes the chip's power away, and gives it back.
    fn restart_chip(&mut self) {
        self.chip = Some(McuModel::new(6.4));
        self.chip_started_us = self.now_us;
    }

    fn drives(&self) -> bool {
        self.chip.as_ref().is_some_and(McuModel::driving) && self.pins.is_some_and(|pins| pins.motor_duty > 0.0)
    }

    fn brakes(&self) -> bool {
        self.pins.is_some_and(|pins| pins.brake && pins.motor_duty == 0.0)
    }

    fn problem(&self) -> Option<String> {
        self.host.problem(self.now())
    }

    fn says(&self, text: &str) -> bool {
        self.problem().is_some_and(|problem| problem.contains(text))
    }
}

#[test]
fn measures_the_line_there_and_back_without_the_chips_own_waiting() {
    let mut talk = Talk::new();
    talk.delay_us = 3_000;
    talk.command = Some(DRIVE);
    talk.run_ms(1_000);
    let round_trips: Vec<u32> = talk.telemetry.iter().filter_map(|telemetry| telemetry.round_trip_us).collect();
    assert!(round_trips.len() > 30, "one for each command, got {}", round_trips.len());
    assert!(round_trips.iter().all(|us| *us == 6_000), "3 ms there, 3 ms back: {round_trips:?}");
    assert_eq!((talk.host.counts().lost, talk.host.damaged()), (0, 0), "a clean line loses nothing");
}

#[test]
fn a_host_without_news_repeats_nothing_and_the_wheels_notice() {
    let mut talk = Talk::driving();
    talk.command = None;
    let sent = talk.host.counts().commands_sent;
    talk.run_ms(u64::from(LEASE_MS) + 10);
    assert!(talk.brakes(), "the lease has run out: {:?}", talk.pins);
    assert_eq!(talk.host.counts().commands_sent, sent, "no command was repeated");
    talk.run_ms(20);
    assert!(talk.says("carril reset"), "the fault is named: {:?}", talk.problem());
    let came = Note::Faults { came: FaultSet::NONE.with(Fault::LeaseExpired), went: FaultSet::NONE };
    assert_eq!(talk.notes.iter().filter(|note| **note == came).count(), 1, "and told once: {:?}", talk.notes);

    talk.command = Some(DRIVE);
    talk.run_ms(1_000);
    assert!(talk.brakes() && talk.host.is_up(), "a fresh handshake alone does not drive");
    talk.control(Control::Reset);
    talk.run_ms(100);
    assert!(talk.drives(), "after `reset` it drives: {:?}", talk.problem());
    assert_eq!(talk.problem(), None, "and all is well");
}

#[test]
fn an_estop_holds_until_reset_even_when_its_first_frame_is_lost() {
    let mut talk = Talk::driving();
    talk.bend = Box::new(|_, _| Vec::new());
    talk.control(Control::EStop);
    talk.bend = Box::new(|bytes, _| bytes);
    talk.run_ms(30);
    let faults = talk.chip.as_ref().expect("the chip is there").faults();
    assert_eq!(faults, FaultSet::NONE.with(Fault::EstopByHost), "it was repeated until the chip had it");
    talk.run_ms(1_000);
    assert!(talk.brakes() && talk.host.is_up(), "commands go on with speed 0 and move nothing");
    assert_eq!(talk.host.faults(), FaultSet::NONE.with(Fault::EstopByHost), "the lease is not the reason");
    talk.restart_chip();
    talk.run_ms(1_000);
    assert!(talk.brakes(), "a chip that forgot its e-stop is told again");
    assert!(talk.says("e-stop by the host"), "{:?}", talk.problem());
    talk.control(Control::Reset);
    talk.run_ms(100);
    assert!(talk.drives(), "`reset` ends it: {:?}", talk.problem());
}

#[test]
fn a_reset_that_cannot_clear_says_so_and_clears_no_later_fault() {
    let mut talk = Talk::driving();
    talk.sensors.estop_pressed = true;
    talk.run_ms(50);
    talk.control(Control::Reset);
    talk.run_ms(1_200);
    let pressed = FaultSet::NONE.with(Fault::EstopPressed);
    assert!(talk.notes.contains(&Note::ResetFailed(Some(pressed))), "the button is still down: {:?}", talk.notes);
    talk.sensors.estop_pressed = false;
    talk.run_ms(1_000);
    assert!(talk.brakes(), "the old reset does not clear it when the button goes up");
    talk.control(Control::Reset);
    talk.run_ms(100);
    assert!(talk.drives(), "a new one does: {:?}", talk.problem());
}

#[test]
fn a_reset_that_was_lost_on_the_line_does_not_clear_the_next_fault() {
    let mut talk = Talk::driving();
    talk.command = None;
    talk.run_ms(300);
    // A frame begins with a zero, its stuffing code and the version; then comes its kind.
    let is_fault_clear = |bytes: &[u8]| bytes.get(3) == Some(&(FrameKind::FaultClear as u8));
    talk.bend = Box::new(move |bytes, _| if is_fault_clear(&bytes) { Vec::new() } else { bytes });
    talk.control(Control::Reset);
    talk.run_ms(20);
    assert!(talk.host.faults().contains(Fault::LeaseExpired), "the clear was lost: {:?}", talk.host.faults());
    talk.sensors.estop_pressed = true;
    talk.run_ms(20);
    talk.sensors.estop_pressed = false;
    talk.bend = Box::new(|bytes, _| bytes);
    talk.run_ms(1_500);
    assert!(talk.host.is_up(), "the link is up again");
    let both = FaultSet::NONE.with(Fault::LeaseExpired).with(Fault::EstopPressed);
    assert_eq!(talk.host.faults(), both, "the button was pressed after the reset: it holds");
}

#[test]
fn a_reset_without_a_link_is_forgotten_not_kept() {
    let mut talk = Talk::driving();
    talk.command = None;
    talk.run_ms(300);
    talk.host.closed(talk.now(), "unplugged".to_owned());
    talk.control(Control::Reset);
    talk.run_ms(1_100);
    assert!(talk.notes.contains(&Note::ResetFailed(None)), "the person is told: {:?}", talk.notes);
    let mut effects = Effects::default();
    talk.host.opened(talk.now(), &mut effects);
    talk.carry_out(effects);
    talk.run_ms(500);
    assert!(talk.host.is_up(), "{:?}", talk.problem());
    assert_eq!(talk.host.faults(), FaultSet::NONE.with(Fault::LeaseExpired), "nothing was cleared behind their back");
}

#[test]
fn a_chip_that_restarts_while_driving_is_greeted_but_does_not_set_off_before_reset() {
    let mut talk = Talk::driving();
    talk.restart_chip();
    talk.run_ms(500);
    assert!(talk.notes.contains(&Note::Restarted), "noticed: {:?}", talk.notes);
    assert!(talk.host.is_up() && talk.brakes(), "the link is back, the car stands");
    assert!(talk.says("the link was lost while the car drove"), "{:?}", talk.problem());
    talk.control(Control::Reset);
    talk.run_ms(100);
    assert!(talk.drives(), "after `reset` it drives: {:?}", talk.problem());
}

#[test]
fn silence_is_named_and_ends_with_a_new_handshake() {
    let mut talk = Talk::driving();
    talk.chip = None;
    talk.run_ms(700);
    assert!(!talk.host.is_up() && talk.says("has fallen silent"), "{:?}", talk.problem());
    let withheld = talk.host.counts().commands_withheld;
    talk.run_ms(100);
    assert!(talk.host.counts().commands_withheld > withheld, "no commands go into the void");
    talk.restart_chip();
    talk.to_chip.clear();
    talk.run_ms(300);
    assert!(talk.host.is_up(), "back without anybody's help: {:?}", talk.problem());
}

#[test]
fn a_pause_of_the_host_itself_is_no_silence_of_the_chip() {
    let mut talk = Talk::driving();
    talk.now_us += 600_000;
    talk.step_host();
    talk.run_ms(50);
    assert!(!talk.notes.contains(&Note::Silent), "the chip had no part in it: {:?}", talk.notes);
}

#[test]
fn a_link_that_never_comes_up_is_an_error_only_after_its_grace() {
    let mut talk = Talk::new();
    talk.chip = None;
    talk.run_ms(900);
    assert_eq!(talk.problem(), None, "programs and chips take time to start");
    talk.run_ms(200);
    assert!(talk.says("does not answer") && talk.says("baud rate"), "{:?}", talk.problem());
}

#[test]
fn another_version_is_refused_with_both_numbers_until_the_chip_is_flashed() {
    let mut talk = Talk::new();
    talk.chip = None;
    talk.run_ms(10);
    let mut foreign = Vec::new();
    encode_with_version(2, &Packet { seq: 0, frame: Frame::EStop }, &mut foreign);
    encode_with_version(2, &Packet { seq: 0, frame: Frame::Telemetry(Telemetry::default()) }, &mut foreign);
    talk.to_host.push_back((0, foreign));
    talk.command = Some(DRIVE);
    talk.run_ms(100);
    assert!(talk.says("protocol version 2, expected 1"), "{:?}", talk.problem());
    assert_eq!(talk.host.counts().commands_sent, 0, "nothing is commanded");
    talk.to_chip.clear();
    talk.run_ms(3_000);
    assert_eq!(talk.to_chip.len(), 3, "it tries slowly: once a second");
    talk.restart_chip();
    talk.to_chip.clear();
    talk.run_ms(100);
    assert!(talk.drives(), "the right firmware is taken at once: {:?}", talk.problem());
}

#[test]
fn refuses_commands_that_are_no_numbers_or_too_old() {
    let mut talk = Talk::driving();
    let (now, mut effects) = (talk.now(), Effects::default());
    let nan = Command { speed_m_s: f32::NAN, ..DRIVE };
    let error = talk.host.command(&nan, now, now, &mut effects).expect_err("NaN is no speed");
    assert!(matches!(error, CommandError::NotFinite { .. }), "{error}");
    let old = now - Duration::from_millis(200);
    let error = talk.host.command(&DRIVE, old, now, &mut effects).expect_err("its lease is over");
    assert_eq!(error, CommandError::TooOld { age_ms: 200, lease_ms: LEASE_MS }, "{error}");
    assert_eq!(effects.command, None, "neither went out");
    talk.command = None;
    talk.host.command(&DRIVE, now - Duration::from_millis(150), now, &mut effects).expect("50 ms are left");
    talk.carry_out(effects);
    talk.run_ms(60);
    assert!(talk.brakes(), "an aged command has only the rest of its lease");
}

#[test]
fn the_newest_of_several_commands_goes_out() {
    let mut talk = Talk::driving();
    let (now, mut effects) = (talk.now(), Effects::default());
    for steering_rad in [0.0, -0.1, -0.2] {
        talk.host.command(&Command { steering_rad, ..DRIVE }, now, now, &mut effects).expect("fresh and finite");
    }
    talk.command = None;
    talk.carry_out(effects);
    talk.run_ms(20);
    let last = talk.telemetry.last().expect("telemetry has come");
    assert_eq!(last.steering_rad, -0.2, "the newest");
}

/// Flips, cuts, inserts and drops at random.
fn noise(mut bytes: Vec<u8>, rng: &mut Pcg64Mcg) -> Vec<u8> {
    match rng.random_range(0..8) {
        0 => {
            let bit = rng.random_range(0..bytes.len() * 8);
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        1 => bytes.truncate(rng.random_range(0..bytes.len())),
        2 => bytes.insert(rng.random_range(0..=bytes.len()), rng.random()),
        3 => drop(bytes.remove(rng.random_range(0..bytes.len()))),
        _ => {}
    }
    bytes
}

#[test]
fn on_a_noisy_line_the_car_does_what_it_was_told_or_stops() {
    let mut talk = Talk::driving();
    talk.bend = Box::new(noise);
    let servo_us = talk.pins.expect("it drives").servo_us;
    for _ in 0..60_000 {
        talk.run_ms(1);
        let pins = talk.pins.expect("it drives");
        assert_eq!(pins.servo_us, servo_us, "no damaged frame moved the servo");
        assert!(pins.motor_duty >= 0.0, "nor drove backward: {pins:?}");
    }
    assert!(talk.host.counts().lost > 500 && talk.host.damaged() > 500, "half of all frames are damaged");
    talk.bend = Box::new(|bytes, _| bytes);
    talk.control(Control::Reset);
    talk.run_ms(200);
    assert!(talk.drives(), "a clean line drives: {:?}", talk.problem());
}

#[test]
fn random_bytes_in_both_directions_move_nothing_and_break_nothing() {
    let mut talk = Talk::new();
    talk.command = Some(DRIVE);
    talk.bend = Box::new(|bytes, rng| {
        let mut random = vec![0; bytes.len() * 2];
        rng.fill_bytes(&mut random);
        random
    });
    for _ in 0..20_000 {
        talk.run_ms(1);
        assert!(talk.brakes(), "nothing moves");
    }
    assert!(talk.says("does not answer"), "{:?}", talk.problem());
    talk.bend = Box::new(|bytes, _| bytes);
    talk.run_ms(300);
    assert!(talk.drives(), "as soon as the line is clean: {:?}", talk.problem());
}

#[test]
fn a_release_stops_in_order() {
    let mut talk = Talk::driving();
    let mut effects = Effects::default();
    talk.host.release(&mut effects);
    talk.carry_out(effects);
    talk.command = None;
    talk.run_ms(5);
    assert!(talk.brakes(), "at once");
    let chip = talk.chip.as_ref().expect("the chip is there");
    assert_eq!(chip.faults(), FaultSet::NONE, "without a fault");
}

#[test]
fn each_handshake_has_another_session() {
    let mut talk = Talk::new();
    let mut seen: Vec<Session> = Vec::new();
    for _ in 0..100 {
        talk.control(Control::Reset);
        talk.run_ms(2);
        let ups = talk.notes.drain(..).filter_map(|note| match note {
            Note::Up(ack) => Some(ack.session),
            _ => None,
        });
        seen.extend(ups);
    }
    assert!(seen.len() >= 100, "each reset is a handshake, got {}", seen.len());
    assert!(seen.windows(2).all(|pair| pair[0] != pair[1]), "never twice the same in a row");
}

#[test]
fn a_report_carries_the_time_at_which_the_chip_made_it() {
    let mut talk = Talk::driving();
    talk.delay_us = 8_000;
    talk.run_ms(1_000);
    let late_us = talk.now().since(talk.stamped).to_duration().as_micros();
    // Reports come every 10 ms: the last one was made 8 to 18 ms ago, and arrived not even 10 ms ago.
    assert!((8_000..=18_000).contains(&late_us), "{late_us} us");
    let made_us = talk.stamped.as_nanos() / 1_000;
    assert_eq!(made_us % 10_000, 0, "on the chip's own beat, whatever the way took: {made_us} us");
    assert!(talk.host.chip_clock().is_some(), "the chip has said that it tells its time");
}

#[test]
fn a_car_without_an_encoder_is_told_a_duty() {
    let mut talk = Talk::new();
    talk.host.set_full_duty_m_s(Some(2.0));
    talk.command = Some(DRIVE);
    talk.run_ms(100);
    let duty = talk.pins.expect("the chip runs").motor_duty;
    assert!((duty - 0.25).abs() < 1e-6, "a quarter of full speed, whatever the wheel does: {duty}");
    talk.command = Some(Command { speed_m_s: -9.0, ..DRIVE });
    talk.run_ms(100);
    assert_eq!(talk.pins.expect("the chip runs").motor_duty, -1.0, "no more than all of it");
    talk.control(Control::EStop);
    talk.run_ms(20);
    assert_eq!(talk.pins.expect("the chip runs").motor_duty, 0.0, "an e-stop stops it too");
}

#[test]
fn lost_and_damaged_frames_are_told() {
    let mut talk = Talk::driving();
    assert_eq!(talk.telemetry.last().map(|last| (last.frames_lost, last.frames_damaged)), Some((0, 0)), "a clean line");
    talk.bend = Box::new(|mut bytes, rng| {
        if rng.random_bool(0.2) {
            let at = rng.random_range(1..bytes.len() - 1);
            bytes[at] ^= 0x40;
        }
        bytes
    });
    talk.run_ms(500);
    talk.bend = Box::new(|bytes, _| bytes);
    talk.run_ms(50);
    let last = talk.telemetry.last().expect("reports come");
    assert!(last.frames_lost > 0 && last.frames_damaged > last.frames_lost, "both ends count: {last:?}");
}
