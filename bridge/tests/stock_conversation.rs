//! The host in conversation with cars that carry stock firmware, without a port: every byte passes through a line that the test
//! bends. Each behaviour is asked of all three cars.

use std::collections::VecDeque;
use std::time::Duration;

use carril_bridge::host::{CommandError, Effects};
use carril_bridge::stock::{LogLevel, StockConfig, StockHost, StockNote, StockProtocol, TickMeaning, WheelFigure};
use carril_messages::{Command, Control, Fault, FaultSet, Stamp, WheelTelemetry};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

#[path = "support/stock_cars.rs"]
mod stock_cars;

use stock_cars::{Car, FLOAT32, INT16, PacketCar, RosserialCar, TWIST, UINT8, UINT16, packet, publishes, subscribes};

const LEASE_MS: u16 = 200;
/// The host looks at its clock so often, ms; in between when bytes come.
const PERIOD_MS: u64 = 20;
const DRIVE: Command = Command { steering_rad: 0.174_532_93, speed_m_s: 1.0 };

/// A car of the test, reached as what it is.
enum AnyCar {
    Rosserial(RosserialCar),
    Packet(PacketCar),
}

impl AnyCar {
    fn as_car(&mut self) -> &mut dyn Car {
        match self {
            Self::Rosserial(car) => car,
            Self::Packet(car) => car,
        }
    }

    fn protocol(&self) -> StockProtocol {
        match self {
            Self::Rosserial(_) => StockProtocol::Rosserial,
            Self::Packet(_) => StockProtocol::PacketSerial,
        }
    }

    fn say(&mut self, level: u8, text: &'static str) {
        match self {
            Self::Rosserial(car) => car.texts.push((level, text)),
            Self::Packet(car) => car.texts.push((level, text)),
        }
    }
}

fn cars() -> [(&'static str, AnyCar); 3] {
    [
        ("the 1:10 car", AnyCar::Rosserial(RosserialCar::one_tenth())),
        ("v3", AnyCar::Rosserial(RosserialCar::v3())),
        ("v4", AnyCar::Packet(PacketCar::default())),
    ]
}

type Bend = Box<dyn FnMut(Vec<u8>) -> Vec<u8>>;

/// Both ends, and a line that takes a millisecond.
struct Talk {
    host: StockHost,
    car: AnyCar,
    now_us: u64,
    to_car: VecDeque<Vec<u8>>,
    to_host: VecDeque<Vec<u8>>,
    bend_to_car: Bend,
    bend_to_host: Bend,
    command: Option<Command>,
    telemetry: Vec<WheelTelemetry>,
    notes: Vec<StockNote>,
}

impl Talk {
    fn with(car: AnyCar, config: StockConfig) -> Self {
        let host = StockHost::new("test", car.protocol(), LEASE_MS, config, Stamp::ZERO);
        let mut talk = Self {
            host,
            car,
            now_us: 0,
            to_car: VecDeque::new(),
            to_host: VecDeque::new(),
            bend_to_car: Box::new(|bytes| bytes),
            bend_to_host: Box::new(|bytes| bytes),
            command: None,
            telemetry: Vec::new(),
            notes: Vec::new(),
        };
        talk.open();
        talk
    }

    fn driving(car: AnyCar) -> Self {
        let mut talk = Self::with(car, StockConfig::default());
        talk.command = Some(DRIVE);
        talk.run_ms(300);
        assert!(talk.drives(), "the car drives: {:?}", talk.problem());
        talk
    }

    fn now(&self) -> Stamp {
        Stamp::from_nanos(self.now_us as i64 * 1_000)
    }

    fn carry_out(&mut self, mut effects: Effects) {
        let bytes = [effects.urgent, effects.command.unwrap_or_default()].concat();
        if !bytes.is_empty() {
            let bent = (self.bend_to_car)(bytes);
            self.to_car.push_back(bent);
        }
        self.telemetry.extend(effects.telemetry.drain(..).map(|(_, telemetry)| telemetry));
        self.notes.append(&mut effects.stock_notes);
    }

    fn open(&mut self) {
        let mut effects = Effects::default();
        self.host.opened(self.now(), &mut effects);
        self.carry_out(effects);
    }

    fn control(&mut self, control: Control) {
        let mut effects = Effects::default();
        self.host.control(control, self.now(), &mut effects);
        self.carry_out(effects);
    }

    fn run_ms(&mut self, ms: u64) {
        for _ in 0..ms {
            self.now_us += 1_000;
            let now_us = self.now_us;
            for bytes in std::mem::take(&mut self.to_car) {
                self.car.as_car().receive(now_us, &bytes);
            }
            let said = self.car.as_car().step(now_us);
            self.step_host();
            if !said.is_empty() {
                let bent = (self.bend_to_host)(said);
                self.to_host.push_back(bent);
            }
        }
    }

    fn step_host(&mut self) {
        let (now, mut effects) = (self.now(), Effects::default());
        let came: Vec<Vec<u8>> = self.to_host.drain(..).collect();
        for bytes in &came {
            self.host.receive(now, bytes, &mut effects);
        }
        if !came.is_empty() || self.now_us.is_multiple_of(PERIOD_MS * 1_000) {
            self.host.tick(now, &mut effects);
        }
        if let Some(command) = self.command.filter(|_| self.now_us.is_multiple_of(30_000)) {
            self.host.command(&command, now, now, &mut effects).expect("fresh and finite");
        }
        self.carry_out(effects);
    }

    fn drives(&mut self) -> bool {
        self.car.as_car().power() != 0
    }

    fn problem(&self) -> String {
        self.host.problem(self.now()).unwrap_or_default()
    }

    fn last(&self) -> &WheelTelemetry {
        self.telemetry.last().expect("telemetry has come")
    }

    fn assert_understood(&mut self, name: &str) {
        assert_eq!(self.car.as_car().complaints(), [] as [String; 0], "{name}: understood all that it got");
    }

    /// After a reset by a person, as after any stop, fresh commands drive.
    fn assert_drives_after_reset(&mut self, name: &str) {
        self.control(Control::Reset);
        self.run_ms(100);
        assert!(self.drives() && self.problem().is_empty(), "{name}: drives after a reset: {}", self.problem());
    }
}

#[test]
fn every_car_drives_steers_and_reports() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.run_ms(1_000);
        assert_eq!(talk.problem(), "", "{name}: nothing is wrong");
        assert_eq!(talk.car.as_car().power(), 510, "{name}: half of the full speed");
        let steering = talk.car.as_car().steering().expect("it was steered");
        assert!((steering - 0.5).abs() < 0.01, "{name}: 10 of 20 degrees to the left, is {steering}");
        let last = talk.last().clone();
        assert!((last.speed_m_s - 0.9).abs() < 0.01, "{name}: 30 rad/s at 3 cm, is {} m/s", last.speed_m_s);
        assert!((last.steering_rad - DRIVE.steering_rad).abs() < 1e-6 && last.driving, "{name}: {last:?}");
        assert_eq!(last.faults, FaultSet::NONE, "{name}: no fault");
        let told = talk.car.as_car().ticks_told();
        assert!(told > 500 && last.ticks.abs_diff(told) <= 60, "{name}: {} ticks of {told}", last.ticks);
        assert!(talk.telemetry.len() > 100, "{name}: a hundred reports a second, were {}", talk.telemetry.len());
        let battery = matches!(talk.car, AnyCar::Packet(_)).then_some(14.8);
        assert_eq!(last.battery_v, battery, "{name}: as far as it is measured");
        talk.command = Some(Command { steering_rad: -0.174_532_93, speed_m_s: -1.0 });
        talk.run_ms(500);
        let steering = talk.car.as_car().steering().expect("it was steered");
        assert_eq!((talk.car.as_car().power(), (steering * 10.0).round()), (-510, -5.0), "{name}: back, to the right");
        assert!(talk.last().speed_m_s < -0.8, "{name}: backwards, {:?}", talk.last());
        talk.assert_understood(name);
    }
}

#[test]
fn the_newest_command_is_repeated_while_its_lease_runs_and_then_comes_stop() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.command = None;
        let orders = talk.car.as_car().orders();
        talk.run_ms(150);
        let repeated = talk.car.as_car().orders() - orders;
        assert!(talk.drives() && (6..=10).contains(&repeated), "{name}: 50 Hz, were {repeated} in 150 ms");
        talk.run_ms(80);
        assert!(!talk.drives(), "{name}: 200 ms of lease, 20 ms to notice, 1 ms on the line");
        let steering = talk.car.as_car().steering().expect("it was steered");
        assert!((steering - 0.5).abs() < 0.01, "{name}: the servo holds its angle, is {steering}");
        assert!(talk.notes.contains(&StockNote::LeaseExpired), "{name}: told");
        talk.command = Some(DRIVE);
        talk.run_ms(300);
        assert!(!talk.drives(), "{name}: new commands alone are not enough");
        assert_eq!(talk.last().faults, FaultSet::NONE.with(Fault::LeaseExpired), "{name}: latched, as in our firmware");
        let problem = talk.problem();
        assert!(problem.contains("the lease of the last command ran out") && problem.contains("reset"), "{problem}");
        talk.assert_drives_after_reset(name);
        talk.assert_understood(name);
    }
}

#[test]
fn a_command_that_comes_when_the_lease_is_over_revives_nothing() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.command = None;
        // Nobody has looked at the clock meanwhile.
        talk.now_us += 400_000;
        let (now, mut effects) = (talk.now(), Effects::default());
        talk.host.command(&DRIVE, now, now, &mut effects).expect("fresh and finite");
        talk.carry_out(effects);
        talk.run_ms(20);
        assert!(!talk.drives() && talk.host.faults().contains(Fault::LeaseExpired), "{name}");
    }
}

#[test]
fn a_reset_does_not_bring_back_the_command_before_it() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.command = None;
        talk.control(Control::Reset);
        talk.run_ms(20);
        assert!(!talk.drives() && talk.problem().is_empty(), "{name}: stands, and nothing is latched");
        talk.command = Some(DRIVE);
        talk.run_ms(100);
        assert!(talk.drives(), "{name}: a fresh command drives");
    }
}

#[test]
fn an_estop_stops_at_once_and_again_and_again() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.control(Control::EStop);
        talk.run_ms(1);
        assert!(!talk.drives(), "{name}: with the next byte");
        for _ in 0..10 {
            talk.car.as_car().set_power(900);
            talk.run_ms(50);
            assert!(!talk.drives(), "{name}: damage on the line does not set it going for long");
        }
        assert_eq!(talk.last().faults, FaultSet::NONE.with(Fault::EstopByHost), "{name}: told");
        assert!(talk.problem().contains("e-stop"), "{name}: {}", talk.problem());
        talk.control(Control::Start);
        talk.run_ms(100);
        assert!(!talk.drives(), "{name}: start is no reset");
        talk.assert_drives_after_reset(name);
    }
}

#[test]
fn an_older_command_that_still_waits_does_not_follow_a_stop() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        let (now, mut waiting, mut stop) = (talk.now(), Effects::default(), Effects::default());
        talk.host.command(&Command { speed_m_s: 0.0, ..DRIVE }, now, now, &mut Effects::default()).expect("fresh");
        talk.host.command(&DRIVE, now, now, &mut waiting).expect("fresh");
        talk.now_us += 20_000;
        talk.host.tick(talk.now(), &mut waiting);
        talk.host.control(Control::EStop, talk.now(), &mut stop);
        // The line is slow: a command waits in its place while the stop comes, and goes out behind what is urgent.
        let slot = stop.command.or(waiting.command).expect("something waits");
        let now_us = talk.now_us;
        talk.car.as_car().receive(now_us, &[stop.urgent, slot].concat());
        assert!(!talk.drives(), "{name}: the last word is stop");
    }
}

#[test]
fn the_way_out_tells_the_car_to_stop_and_survives_lost_frames() {
    for (name, car) in cars() {
        for kept in 0..3 {
            let mut talk = Talk::driving(match &car {
                AnyCar::Rosserial(car) => AnyCar::Rosserial(RosserialCar::new(car.topics.clone(), false)),
                AnyCar::Packet(_) => AnyCar::Packet(PacketCar::default()),
            });
            let mut effects = Effects::default();
            talk.host.release(talk.now(), &mut effects);
            let each = effects.urgent.len() / 3;
            let frame = effects.urgent[kept * each..(kept + 1) * each].to_vec();
            talk.car.as_car().receive(talk.now_us, &frame);
            assert!(!talk.drives(), "{name}: each of three stops is enough");
        }
    }
}

#[test]
fn a_car_that_resets_is_asked_anew_and_waits_for_a_person() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        let now_us = talk.now_us;
        talk.car.as_car().reset(now_us);
        talk.run_ms(1_000);
        assert!(talk.notes.contains(&StockNote::Silent), "{name}: noticed");
        assert!(talk.problem().contains("has fallen silent"), "{name}: {}", talk.problem());
        talk.run_ms(1_500);
        assert!(talk.host.is_up(), "{name}: up again");
        assert!(!talk.drives(), "{name}: but it does not set off by itself");
        let problem = talk.problem();
        assert!(problem.contains("the link was lost while the car drove, and is back"), "{name}: {problem}");
        talk.assert_drives_after_reset(name);
        let up = talk.notes.iter().filter(|note| matches!(note, StockNote::Up(_))).count();
        assert_eq!(up, 2, "{name}: told each time: {:?}", talk.notes);
        talk.assert_understood(name);
    }
}

#[test]
fn a_car_that_stands_when_it_resets_needs_no_person() {
    for (name, car) in cars() {
        let mut talk = Talk::with(car, StockConfig::default());
        talk.run_ms(100);
        let now_us = talk.now_us;
        talk.car.as_car().reset(now_us);
        talk.run_ms(2_500);
        assert_eq!(talk.problem(), "", "{name}");
        talk.command = Some(DRIVE);
        talk.run_ms(100);
        assert!(talk.drives(), "{name}: nothing was lost");
    }
}

#[test]
fn topics_that_nobody_asked_for_are_a_restart() {
    for car in [RosserialCar::one_tenth(), RosserialCar::v3()] {
        let topics: Vec<u8> = car.topics.iter().flat_map(stock_cars::Topic::packet).collect();
        let mut talk = Talk::driving(AnyCar::Rosserial(car));
        talk.run_ms(3_000);
        let mut effects = Effects::default();
        talk.host.receive(talk.now(), &topics, &mut effects);
        talk.carry_out(effects);
        talk.run_ms(300);
        let restarts = talk.notes.iter().filter(|note| **note == StockNote::Restarted).count();
        assert_eq!(restarts, 1, "told once: {:?}", talk.notes);
        assert!(talk.host.is_up() && !talk.drives(), "asked anew, and stopped: {}", talk.problem());
        assert!(talk.problem().contains("the link was lost while the car drove"), "{}", talk.problem());
    }
}

#[test]
fn a_port_that_is_lost_stops_the_car_as_soon_as_it_is_back() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.host.closed(talk.now(), "the device is gone".into());
        talk.to_host.clear();
        talk.to_car.clear();
        assert!(talk.problem().contains("the device is gone; trying again"), "{name}: {}", talk.problem());
        // The car has not noticed, and drives on: stock firmware has no lease.
        assert!(talk.drives(), "{name}");
        talk.open();
        talk.run_ms(2);
        assert!(!talk.drives(), "{name}: the first word is stop, before anything is known");
        talk.run_ms(300);
        assert!(talk.problem().contains("the link was lost while the car drove"), "{name}: {}", talk.problem());
        talk.assert_drives_after_reset(name);
    }
}

#[test]
fn garbage_from_the_car_is_passed_over() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let reports = talk.telemetry.len();
        talk.bend_to_host = Box::new(move |bytes| {
            let mut noise: Vec<u8> = (0..rng.random_range(0..40)).map(|_| rng.random_range(0..=255)).collect();
            if rng.random_bool(0.2) {
                // The beginning of a packet that never comes.
                let len = rng.random_range(0..=255);
                noise.extend([0xFF, 0xFE, len, 0, 255 - len]);
            }
            // A zero ends what came before it, as on every line that has been quiet.
            [&noise[..], &[0], &bytes].concat()
        });
        talk.run_ms(2_000);
        assert!(talk.drives() && talk.problem().is_empty(), "{name}: {}", talk.problem());
        let (reports, damaged) = (talk.telemetry.len() - reports, talk.host.damaged());
        assert!(reports >= 180 && damaged > 0, "{name}: {reports} of 200 reports, {damaged} damaged");
        talk.assert_understood(name);
    }
}

#[test]
fn noise_alone_is_no_car() {
    for (name, car) in cars() {
        let mut talk = Talk::with(car, StockConfig::default());
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        talk.bend_to_host = Box::new(move |bytes| bytes.iter().map(|_| rng.random_range(0..=255)).collect());
        talk.bend_to_car = Box::new(|_| Vec::new());
        talk.command = Some(DRIVE);
        talk.run_ms(6_000);
        assert!(talk.problem().contains("does not answer"), "{name}: {}", talk.problem());
        assert!(talk.telemetry.is_empty() && !talk.drives(), "{name}: nothing came of it");
        assert!(talk.host.counts().commands_withheld > 100, "{name}: commands were withheld");
    }
}

#[test]
fn a_host_that_comes_to_a_car_in_the_middle_of_its_reports_understands_it() {
    for (name, car) in cars() {
        let mut first = Talk::driving(car);
        let mut effects = Effects::default();
        first.host.release(first.now(), &mut effects);
        first.carry_out(effects);
        first.run_ms(5);
        let Talk { car, now_us, .. } = first;
        let mut talk = Talk::with(car, StockConfig::default());
        talk.now_us = now_us;
        talk.open();
        // The first report has lost its beginning.
        let mut cut = true;
        talk.bend_to_host = Box::new(move |bytes| bytes[usize::from(std::mem::take(&mut cut)) * 5..].to_vec());
        talk.command = Some(DRIVE);
        talk.run_ms(1_200);
        assert!(talk.drives() && !talk.telemetry.is_empty(), "{name}: {}", talk.problem());
        talk.assert_understood(name);
    }
}

#[test]
fn a_successor_keeps_the_stops_and_the_count_of_ticks() {
    for stop in [Control::EStop, Control::Stop] {
        for (name, car) in cars() {
            let mut talk = Talk::driving(car);
            talk.run_ms(500);
            if stop == Control::EStop {
                talk.control(Control::EStop);
            } else {
                talk.command = None;
            }
            talk.run_ms(300);
            let (latches, state, ticks) = (talk.host.latches(), talk.host.state(), talk.last().ticks);
            assert!(latches.estop || state.lease_expired, "{name}: something is latched");
            let bytes = carril_messages::codec::encode(&state).expect("it has bytes");
            let state = carril_messages::codec::decode(&bytes).expect("they are those of a state");
            talk.host = StockHost::new("test", talk.car.protocol(), LEASE_MS, StockConfig::default(), talk.now());
            talk.host.restore(latches, state);
            assert!(!talk.problem().is_empty(), "{name}: it says so before the port is open");
            talk.open();
            talk.command = Some(DRIVE);
            talk.run_ms(500);
            assert!(!talk.drives(), "{name}: the successor stays stopped: {}", talk.problem());
            assert!(talk.last().ticks >= ticks, "{name}: {} ticks, were {ticks}", talk.last().ticks);
            talk.assert_drives_after_reset(name);
        }
    }
}

#[test]
fn commands_that_come_too_fast_collapse_to_the_newest() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.command = None;
        let orders = talk.car.as_car().orders();
        for speed in 1..=1_000_u16 {
            let (now, mut effects) = (talk.now(), Effects::default());
            let command = Command { speed_m_s: f32::from(speed) / 510.0, ..DRIVE };
            talk.host.command(&command, now, now, &mut effects).expect("fresh and finite");
            talk.carry_out(effects);
            talk.run_ms(1);
        }
        let sent = talk.car.as_car().orders() - orders;
        assert!((90..=110).contains(&sent), "{name}: twice the rate at most, were {sent} in a second");
        talk.run_ms(25);
        assert_eq!(talk.car.as_car().power(), 1_000, "{name}: the newest one is in force");
        talk.run_ms(300);
        assert!(!talk.drives(), "{name}: until its lease is over");
    }
}

#[test]
fn a_command_that_is_no_command_or_too_old_is_not_sent() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        let (now, mut effects) = (talk.now(), Effects::default());
        for speed_m_s in [f32::NAN, f32::INFINITY] {
            let error = talk.host.command(&Command { steering_rad: 0.0, speed_m_s }, now, now, &mut effects);
            assert!(matches!(error, Err(CommandError::NotFinite { .. })), "{name}: {error:?}");
        }
        let made = Stamp::from_nanos(now.as_nanos() - 200_000_000);
        let error = talk.host.command(&DRIVE, made, now, &mut effects);
        assert_eq!(error, Err(CommandError::TooOld { age_ms: 200, lease_ms: LEASE_MS }), "{name}");
        assert!(effects.command.is_none() && effects.urgent.is_empty(), "{name}: nothing went out");
        // The age counts: a command of 150 ms has 50 ms left.
        let mut talk = Talk::driving(match talk.car {
            AnyCar::Rosserial(car) => AnyCar::Rosserial(RosserialCar::new(car.topics, false)),
            AnyCar::Packet(_) => AnyCar::Packet(PacketCar::default()),
        });
        talk.command = None;
        let (now, mut effects) = (talk.now(), Effects::default());
        let made = Stamp::from_nanos(now.as_nanos() - 150_000_000);
        talk.host.command(&DRIVE, made, now, &mut effects).expect("still in its lease");
        talk.carry_out(effects);
        talk.run_ms(75);
        assert!(!talk.drives(), "{name}: 50 ms and a look at the clock later");
        talk.control(Control::Reset);
        let (now, mut effects) = (talk.now(), Effects::default());
        let made = Stamp::from_nanos(now.as_nanos() + 3_600_000_000_000);
        talk.host.command(&DRIVE, made, now, &mut effects).expect("a clock that is ahead is no age");
        talk.carry_out(effects);
        talk.run_ms(225);
        assert!(!talk.drives(), "{name}: and no lease of an hour");
    }
}

#[test]
fn texts_of_the_car_pass_at_their_level() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        for level in 0..=3 {
            talk.car.say(level, "battery: 14.8 V");
        }
        talk.run_ms(20);
        let levels = talk.notes.iter().filter_map(|note| match note {
            StockNote::Log(level, text) if text == "battery: 14.8 V" => Some(*level),
            _ => None,
        });
        let levels: Vec<LogLevel> = levels.collect();
        assert_eq!(levels, [LogLevel::Debug, LogLevel::Info, LogLevel::Warn, LogLevel::Error], "{name}");
    }
}

#[test]
fn a_car_that_asks_for_the_time_is_told() {
    let mut talk = Talk::driving(AnyCar::Rosserial(RosserialCar::v3()));
    talk.run_ms(20_000);
    assert!(talk.host.is_up() && talk.drives(), "it would give up after 11 s without an answer: {}", talk.problem());
    let AnyCar::Rosserial(car) = &talk.car else { unreachable!("it is a rosserial car") };
    let (seconds, nanos) = car.clock.expect("it was told");
    assert!((15..=20).contains(&seconds) && nanos < 1_000_000_000, "on the car's clock: {seconds} s, {nanos} ns");
}

fn refused(topics: Vec<stock_cars::Topic>) -> Talk {
    let mut talk = Talk::with(AnyCar::Rosserial(RosserialCar::new(topics, false)), StockConfig::default());
    talk.command = Some(DRIVE);
    talk.run_ms(6_000);
    assert!(!talk.drives() && !talk.host.is_up(), "it is not driven: {}", talk.problem());
    talk
}

#[test]
fn a_car_with_other_types_is_refused_with_what_it_has_and_what_is_allowed() {
    let talk = refused(vec![subscribes(0, "steering", UINT16), subscribes(1, "speed", INT16)]);
    let problem = talk.problem();
    for part in [
        "subscribes `steering` as std_msgs/UInt16 (md5 1df79edf208b629fe6b81923a544552d)",
        "allowed is std_msgs/Float32 (md5 73fcbf46b49191e672908e50842a83d4) or std_msgs/UInt8",
        "flash",
    ] {
        assert!(problem.contains(part), "`{part}` is missing: {problem}");
    }
    let told = talk.notes.iter().filter(|note| matches!(note, StockNote::Refused(_))).count();
    assert_eq!(told, 1, "told once, and it goes on asking: {:?}", talk.notes);

    let forged = (FLOAT32.0, "0123456789abcdef0123456789abcdef");
    let talk = refused(vec![subscribes(0, "steering", forged), subscribes(1, "speed", INT16)]);
    let problem = talk.problem();
    assert!(problem.contains("std_msgs/Float32 (md5 0123456789abcdef0123456789abcdef), allowed is"), "{problem}");
    let talk = refused(vec![subscribes(0, "steering", forged), subscribes(1, "speed", forged)]);
    assert!(talk.problem().contains("(md5 0123456789abcdef0123456789abcdef)"), "{}", talk.problem());
    let told = talk.notes.iter().filter(|note| matches!(note, StockNote::Refused(_))).count();
    assert_eq!(told, 1, "also when two topics are wrong: {:?}", talk.notes);

    let talk = refused(vec![subscribes(0, "speed", INT16), publishes(0, "twist", TWIST)]);
    assert!(talk.problem().contains("subscribes no `steering`"), "{}", talk.problem());

    let mut small = subscribes(0, "steering", FLOAT32);
    small.buffer = 3;
    let talk = refused(vec![small, subscribes(1, "speed", INT16)]);
    assert!(talk.problem().contains("a buffer of 3 bytes for `steering`, needed are 4"), "{}", talk.problem());

    let mut reserved = subscribes(0, "speed", INT16);
    reserved.id = 7;
    let talk = refused(vec![reserved, subscribes(1, "steering", FLOAT32)]);
    assert!(talk.problem().contains("`speed` as topic 7, allowed is 100 and more"), "{}", talk.problem());

    let mut twice = subscribes(0, "speed", INT16);
    twice.id = 101;
    let talk = refused(vec![subscribes(1, "steering", FLOAT32), twice]);
    assert!(talk.problem().contains("number 101"), "{}", talk.problem());
}

#[test]
fn a_car_that_is_flashed_anew_is_taken() {
    let mut talk = refused(vec![subscribes(0, "steering", UINT16), subscribes(1, "speed", INT16)]);
    let AnyCar::Rosserial(car) = &mut talk.car else { unreachable!("it is a rosserial car") };
    car.topics = vec![subscribes(4, "/steering", UINT8), subscribes(9, "speed", INT16), publishes(0, "twist", TWIST)];
    talk.run_ms(2_000);
    assert!(talk.drives() && talk.problem().is_empty(), "{}", talk.problem());
}

#[test]
fn topics_that_are_not_known_or_of_other_types_do_not_keep_a_car_from_driving() {
    let mut car = RosserialCar::one_tenth();
    car.topics.push(publishes(7, "odometry", ("nav_msgs/Odometry", "cd5e73d190d741a2f92e81eda573aca7")));
    car.topics.push(publishes(8, "voltage", UINT16));
    car.topics.push(subscribes(7, "wipers", UINT8));
    let mut talk = Talk::driving(AnyCar::Rosserial(car));
    let strange: Vec<u8> = [132, 133, 999].into_iter().flat_map(|id| packet(id, &[1, 2, 3])).collect();
    talk.bend_to_host = Box::new(move |bytes| [&strange[..], &bytes].concat());
    talk.run_ms(3_000);
    assert!(talk.drives() && talk.problem().is_empty(), "{}", talk.problem());
    assert_eq!(talk.last().battery_v, None, "what is no voltage is not read");
    let refused = talk.notes.iter().filter_map(|note| match note {
        StockNote::TopicRefused(why) => Some(why.as_str()),
        _ => None,
    });
    let refused: Vec<&str> = refused.collect();
    assert!(refused[0].contains("publishes `voltage` as std_msgs/UInt16"), "told: {refused:?}");
}

#[test]
fn a_topic_whose_telling_was_lost_is_asked_for_again() {
    let car = RosserialCar::one_tenth();
    let lost = car.topics[1].packet();
    let mut talk = Talk::with(AnyCar::Rosserial(car), StockConfig::default());
    let mut once = true;
    talk.bend_to_host = Box::new(move |bytes| {
        let at = bytes.windows(lost.len()).position(|window| window == lost);
        match at.filter(|_| std::mem::take(&mut once)) {
            Some(at) => [&bytes[..at], &bytes[at + lost.len()..]].concat(),
            None => bytes,
        }
    });
    talk.command = Some(DRIVE);
    talk.run_ms(3_000);
    assert!(talk.drives() && talk.last().ticks > 0, "its ticks are counted: {:?}", talk.last());
    assert_eq!(talk.problem(), "", "and it was not stopped for it");
}

#[test]
fn firmware_of_the_next_generation_is_refused_and_not_driven() {
    let mut car = PacketCar::default();
    car.autominy = true;
    let mut talk = Talk::with(AnyCar::Packet(car), StockConfig::default());
    talk.command = Some(DRIVE);
    talk.run_ms(6_000);
    let problem = talk.problem();
    assert!(problem.contains("AutoMiny") && problem.contains("22 bytes"), "what it is: {problem}");
    assert!(!talk.drives() && talk.car.as_car().steering().is_none(), "its steering means something else");
    let AnyCar::Packet(car) = &mut talk.car else { unreachable!("it is a v4") };
    car.autominy = false;
    talk.run_ms(500);
    assert!(talk.drives() && talk.problem().is_empty(), "flashed anew, it is taken: {}", talk.problem());
}

#[test]
fn ticks_go_on_over_the_wrap_of_their_counter() {
    for (name, car, bits) in [
        ("16 bits", AnyCar::Rosserial(RosserialCar::one_tenth()), 16_u32),
        ("8 bits", AnyCar::Packet(PacketCar::default()), 8),
    ] {
        let config = StockConfig { ticks: Some(TickMeaning::Counter), ..StockConfig::default() };
        let mut talk = Talk::with(car, config);
        talk.run_ms(300);
        let base = talk.telemetry.last().map_or(0, |last| last.ticks);
        let (mut effects, now) = (Effects::default(), talk.now());
        let full = u32::MAX >> (32 - bits);
        for counter in [full - 9, full, 4, 4, 20] {
            let bytes = match &talk.car {
                AnyCar::Rosserial(_) => packet(126, &(counter as u16).to_le_bytes()),
                AnyCar::Packet(_) => stock_cars::stuffed(&[8, counter as u8]),
            };
            talk.host.receive(now, &bytes, &mut effects);
        }
        let counts: Vec<u32> = effects.telemetry.iter().map(|(_, telemetry)| telemetry.ticks - base).collect();
        let begun = counts[0];
        let counts: Vec<u32> = counts.iter().map(|count| count - begun).collect();
        assert_eq!(counts, [0, 9, 14, 14, 30], "{name}: never back");
    }
}

#[test]
fn a_wheel_figure_that_no_car_has_is_passed_over() {
    let mut talk = Talk::driving(AnyCar::Rosserial(RosserialCar::one_tenth()));
    talk.run_ms(500);
    let (now, mut effects, damaged) = (talk.now(), Effects::default(), talk.host.damaged());
    for x in [f64::NAN, f64::INFINITY, 1e300, -1e30] {
        let twist: Vec<u8> = [x, 0.0, 0.0, 0.0, 0.0, 0.0].into_iter().flat_map(f64::to_le_bytes).collect();
        talk.host.receive(now, &packet(125, &twist), &mut effects);
        talk.host.receive(now, &packet(126, &[1, 0]), &mut effects);
    }
    assert_eq!(talk.host.damaged() - damaged, 4, "each is counted");
    assert!(
        effects.telemetry.iter().all(|(_, report)| (report.speed_m_s - 0.9).abs() < 0.01),
        "the last good one stays"
    );
    let mut talk = Talk::driving(AnyCar::Packet(PacketCar::default()));
    let (now, mut effects, damaged) = (talk.now(), Effects::default(), talk.host.damaged());
    for value in [f32::NAN, f32::NEG_INFINITY, 1e30] {
        for kind in [9, 11] {
            let frame = stock_cars::stuffed(&[&[kind][..], &value.to_le_bytes()].concat());
            talk.host.receive(now, &frame, &mut effects);
        }
    }
    assert_eq!(talk.host.damaged() - damaged, 6, "each is counted");
}

#[test]
fn a_car_that_tells_the_period_of_its_wheel_has_a_speed() {
    let config = StockConfig { wheel_figure: WheelFigure::Period, ..StockConfig::default() };
    let mut talk = Talk::with(AnyCar::Rosserial(RosserialCar::one_tenth()), config);
    talk.run_ms(300);
    assert_eq!(talk.last().speed_m_s, 0.0, "0 counts: it stands");
    talk.command = Some(DRIVE);
    talk.run_ms(300);
    let speed_m_s = talk.last().speed_m_s;
    assert!((speed_m_s - 1.047).abs() < 0.001, "30 counts of 6 ms for a turn of 18.8 cm, is {speed_m_s} m/s");
}

#[test]
fn a_car_without_a_wheel_figure_drives_and_tells_nothing() {
    let topics = vec![subscribes(0, "steering", UINT8), subscribes(1, "speed", INT16)];
    let mut talk = Talk::driving(AnyCar::Rosserial(RosserialCar::new(topics, false)));
    talk.run_ms(10_000);
    assert!(talk.drives() && talk.problem().is_empty(), "its time requests say that it lives: {}", talk.problem());
    assert!(talk.telemetry.is_empty(), "no number is made up");
    talk.bend_to_host = Box::new(|_| Vec::new());
    talk.run_ms(8_000);
    assert!(talk.problem().contains("has fallen silent"), "and their end, that it does not: {}", talk.problem());
}

#[test]
fn the_warning_names_the_weakness_and_what_to_do() {
    let talk = Talk::with(AnyCar::Packet(PacketCar::default()), StockConfig::default());
    let warning = talk.host.warning();
    for part in ["`test`", "packetserial", "no lease", "killed", "keeps its last command", "flash"] {
        assert!(warning.contains(part), "`{part}` is missing: {warning}");
    }
}

#[test]
fn another_lease_and_other_meanings_count_from_the_next_command() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        talk.host.set(1_000, StockConfig { full_speed_m_s: 4.0, ..StockConfig::default() });
        talk.run_ms(100);
        assert_eq!(talk.car.as_car().power(), 255, "{name}: a quarter");
        talk.command = None;
        talk.run_ms(900);
        assert!(talk.drives(), "{name}: the longer lease runs");
        talk.run_ms(150);
        assert!(!talk.drives(), "{name}: and ends");
    }
}

/// Nobody may rely on the time of a step: the period only says how often the host is asked at least.
#[test]
fn a_host_that_is_asked_more_often_repeats_no_more_often() {
    for (name, car) in cars() {
        let mut talk = Talk::driving(car);
        let orders = talk.car.as_car().orders();
        talk.command = None;
        talk.host.set(2_000, StockConfig::default());
        talk.command = Some(DRIVE);
        talk.run_ms(30);
        talk.command = None;
        for _ in 0..1_000 {
            let (now, mut effects) = (talk.now(), Effects::default());
            talk.host.tick(now, &mut effects);
            talk.carry_out(effects);
            talk.run_ms(1);
        }
        let sent = talk.car.as_car().orders() - orders;
        assert!((50..=72).contains(&sent), "{name}: about 50 Hz, were {sent} in a second");
        let period = Duration::from_millis(PERIOD_MS);
        assert!(period < Duration::from_millis(LEASE_MS.into()), "a look at the clock is shorter than a lease");
    }
}
