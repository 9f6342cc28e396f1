//! The operator `mcu-link` with stock firmware over a real pseudo-terminal, in real time. Only states and counts are asserted: how
//! long something takes is the machine's affair, and each wait ends after a minute at the latest.

use std::fs::File;
use std::sync::Arc;
use std::time::{Duration, Instant};

use carril_bridge::stock::StockConfig;
use carril_bridge::{LinkState, McuLink, McuLinkConfig, Protocol};
use carril_messages::{Command, Control, Fault, WheelTelemetry};
use carril_runtime::clock::LiveClock;
use carril_runtime::{Operator, Setup};
use nix::fcntl::OFlag;
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};

#[path = "support/link.rs"]
mod link;
#[path = "support/stock_cars.rs"]
mod stock_cars;

use link::Link;
use stock_cars::{Car, PacketCar, RosserialCar};

const PATIENCE: Duration = Duration::from_secs(60);
const DRIVE: Command = Command { steering_rad: 0.1, speed_m_s: 1.0 };
/// So long that a busy machine does not let it run out where a test does not want that.
const LEASE_MS: u16 = 2_000;
const SILENT_AFTER_MS: u32 = 10_000;

/// A car at the end of a pseudo-terminal, and the link, in one thread.
struct Run {
    setup: Setup,
    started: Instant,
    master: PtyMaster,
    /// Keeps the terminal raw while no link has it open; else it would say to the car what the car has said.
    _other_end: File,
    car: Box<dyn Car>,
    config: McuLinkConfig,
    link: Option<Link>,
    command: Option<Command>,
}

impl Run {
    fn new(protocol: Protocol, car: Box<dyn Car>, silent_after_ms: u32) -> Self {
        let (master, other_end, port) = terminal();
        let clock = Arc::new(LiveClock::anchored_now());
        let setup = Setup { memory_lines: None, clock, ..Setup::for_tests("node") };
        let stock = Some(StockConfig { silent_after_ms, ..StockConfig::default() });
        let config = McuLinkConfig { protocol, stock, ..McuLinkConfig::carril(&port, LEASE_MS) };
        let mut run = Self {
            setup,
            started: Instant::now(),
            master,
            _other_end: other_end,
            car,
            config,
            link: None,
            command: Some(DRIVE),
        };
        run.plug_in(None);
        run
    }

    fn driving(protocol: Protocol, car: Box<dyn Car>) -> Self {
        let mut run = Self::new(protocol, car, SILENT_AFTER_MS);
        run.until_it_drives();
        run
    }

    /// A machine that is too busy may lose the car meanwhile, or let its lease run out: then a person helps.
    fn until_it_drives(&mut self) {
        let started = Instant::now();
        while self.car.power() != 510 || !self.error().is_empty() {
            assert!(started.elapsed() < PATIENCE, "waited a minute until it drives; the link says {:?}", self.error());
            if self.error().contains("`carril reset`") {
                self.control(Control::Reset);
            }
            self.turn();
        }
    }

    fn plug_in(&mut self, state: Option<LinkState>) {
        let mut link = Link::new(self.config.clone(), &self.setup);
        if let Some(state) = state {
            link.operator.restore(state).expect("the state fits");
        }
        self.link = Some(link);
    }

    fn turn(&mut self) {
        let now_us = self.started.elapsed().as_micros() as u64;
        let mut buffer = [0; 4096];
        let len = nix::unistd::read(&self.master, &mut buffer).unwrap_or(0);
        self.car.receive(now_us, &buffer[..len]);
        let said = self.car.step(now_us);
        // What does not fit is lost, as on a real line.
        let _ = nix::unistd::write(&self.master, &said);
        if let Some(link) = &mut self.link {
            let now = self.setup.clock.now();
            link.step(self.command, now);
        }
        std::thread::sleep(Duration::from_millis(2));
    }

    fn until(&mut self, what: &str, mut reached: impl FnMut(&Run) -> bool) {
        let started = Instant::now();
        while !reached(self) {
            assert!(started.elapsed() < PATIENCE, "waited a minute until {what}; the link says {:?}", self.error());
            self.turn();
        }
    }

    fn error(&self) -> String {
        let last = self.link.as_ref().map(|link| &link.last);
        last.and_then(|result| result.as_ref().err()).map_or_else(String::new, ToString::to_string)
    }

    fn control(&mut self, control: Control) {
        let now = self.setup.clock.now();
        self.link.as_mut().expect("the link is there").operator.control(control, now);
    }

    fn reports(&self) -> usize {
        self.link.as_ref().map_or(0, |link| link.telemetry.len())
    }

    fn last(&self) -> Option<&WheelTelemetry> {
        self.link.as_ref()?.telemetry.last().map(|report| &**report)
    }
}

fn terminal() -> (PtyMaster, File, String) {
    let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK).expect("a terminal");
    grantpt(&master).expect("granted");
    unlockpt(&master).expect("unlocked");
    let path = ptsname_r(&master).expect("it has a name");
    let other_end = File::options().read(true).write(true).open(&path).expect("it opens");
    let mut settings = tcgetattr(&other_end).expect("it has settings");
    cfmakeraw(&mut settings);
    tcsetattr(&other_end, SetArg::TCSANOW, &settings).expect("it takes them");
    (master, other_end, path)
}

fn cars() -> [(Protocol, Box<dyn Car>); 3] {
    [
        (Protocol::Rosserial, Box::new(RosserialCar::one_tenth())),
        (Protocol::Rosserial, Box::new(RosserialCar::v3())),
        (Protocol::PacketSerial, Box::new(PacketCar::default())),
    ]
}

#[test]
fn every_car_is_driven_by_the_operator_and_stopped_when_it_ends() {
    for (protocol, car) in cars() {
        let mut run = Run::driving(protocol, car);
        run.until("it reports that it drives", |run| {
            run.last().is_some_and(|last| last.speed_m_s > 0.5 && last.driving)
        });
        assert_eq!(run.error(), "", "nothing is wrong");
        let orders = run.car.orders();
        drop(run.link.take());
        run.until("the end has stopped it", |run| run.car.power() == 0);
        assert!(run.car.orders() >= orders + 3, "said more than once");
        run.plug_in(None);
        run.until_it_drives();
        assert_eq!(run.car.complaints(), [] as [String; 0], "it understood all that it got");
    }
}

#[test]
fn a_graph_that_falls_silent_stops_every_car_until_reset() {
    for (protocol, car) in cars() {
        let mut run = Run::driving(protocol, car);
        run.command = None;
        run.until("the lease has run out", |run| run.car.power() == 0);
        run.until("the fault is told", |run| run.last().is_some_and(|last| last.faults.contains(Fault::LeaseExpired)));
        run.command = Some(DRIVE);
        run.until("the node is faulted", |run| run.error().contains("the lease of the last command ran out"));
        let reports = run.reports();
        run.until("time has passed", |run| run.reports() >= reports + 20);
        assert_eq!(run.car.power(), 0, "it stays stopped");
        run.control(Control::Reset);
        run.until_it_drives();
    }
}

#[test]
fn an_estop_stops_every_car_and_outlives_its_link() {
    for (protocol, car) in cars() {
        let mut run = Run::driving(protocol, car);
        run.control(Control::EStop);
        run.until("it stands", |run| run.car.power() == 0);
        let link = run.link.take().expect("the link is there");
        let state = link.operator.snapshot();
        drop(link);
        run.plug_in(Some(state));
        run.until("the successor hears the car", |run| run.reports() >= 20);
        assert_eq!(run.car.power(), 0, "and keeps it stopped: {}", run.error());
        assert!(run.error().contains("e-stop"), "and says why: {}", run.error());
        run.control(Control::Reset);
        run.until_it_drives();
    }
}

#[test]
fn a_link_that_is_replaced_while_the_car_drives_stops_it_for_the_gap_and_latches_nothing() {
    for (protocol, car) in cars() {
        let mut run = Run::driving(protocol, car);
        let link = run.link.take().expect("the link is there");
        let state = link.operator.snapshot();
        drop(link);
        run.until("nobody watches over it: it stands", |run| run.car.power() == 0);
        run.plug_in(Some(state));
        run.until("the successor drives", |run| run.car.power() == 510 && run.error().is_empty());
    }
}

#[test]
fn a_car_that_resets_or_is_unplugged_waits_for_a_person() {
    for (protocol, car) in cars() {
        // Shorter than the start of the car, or nobody would notice.
        let mut run = Run::new(protocol, car, 1_000);
        run.until_it_drives();
        let now_us = run.started.elapsed().as_micros() as u64;
        run.car.reset(now_us);
        run.until("it is missed", |run| run.error().contains("has fallen silent"));
        run.until("it is back", |run| run.error().contains("the link was lost while the car drove"));
        assert_eq!(run.car.power(), 0, "it does not set off by itself");
        run.control(Control::Reset);
        run.until_it_drives();
        run.master = terminal().0;
        run.until("the end of the terminal is told", |run| run.error().contains("trying again"));
    }
}

#[test]
fn another_lease_and_other_meanings_are_taken_over_without_opening_the_port_again() {
    for (protocol, car) in cars() {
        let mut run = Run::driving(protocol, car);
        let stock =
            Some(StockConfig { full_speed_m_s: 4.0, silent_after_ms: SILENT_AFTER_MS, ..StockConfig::default() });
        let config = McuLinkConfig { stock, lease_ms: 1_900, ..run.config.clone() };
        let link = &mut run.link.as_mut().expect("the link is there").operator;
        let other = McuLinkConfig { protocol: Protocol::Carril, ..config.clone() };
        assert!(link.reconfigure(&other).is_none(), "another protocol needs another conversation");
        let baud = McuLinkConfig { baud: Some(57_600), ..config.clone() };
        assert!(link.reconfigure(&baud).is_none(), "another baud rate must be opened");
        assert!(matches!(link.reconfigure(&config), Some(Ok(()))), "the rest need not");
        run.until("a quarter of the power", |run| run.car.power() == 255);
        let handshakes = run.link.as_ref().map(|link| link.operator.counts().handshakes);
        assert_eq!(handshakes, Some(1), "in the same conversation");
    }
}

#[test]
fn stops_go_over_from_one_protocol_to_another() {
    let mut run = Run::driving(Protocol::PacketSerial, Box::new(PacketCar::default()));
    run.command = None;
    run.until("the lease has run out", |run| run.car.power() == 0);
    run.turn();
    let state = run.link.as_ref().expect("the link is there").operator.snapshot();
    let config = McuLinkConfig::carril(&run.config.port, LEASE_MS);
    let mut ours = McuLink::new(config, &run.setup).expect("the threads start");
    ours.restore(state).expect("the state fits");
    assert!(ours.snapshot().host.latches.link_lost, "a lease that ran out is a stop of ours");

    let mut run = Run::new(Protocol::Rosserial, Box::new(RosserialCar::v3()), SILENT_AFTER_MS);
    let state = ours.snapshot();
    run.link.as_mut().expect("the link is there").operator.restore(state).expect("the state fits");
    run.until("it is up", |run| run.reports() >= 20);
    assert!(run.car.power() == 0 && run.error().contains("carril reset"), "and back: {}", run.error());
}

#[test]
fn every_wrong_value_of_the_configuration_is_named() {
    let registry = carril_bridge::registry();
    let found = |config: &str| {
        let kind = registry.get("mcu-link").expect("the kind is known");
        let config = serde_json::from_str(config).expect("the test's own JSON");
        let found = kind.check_config(&config, std::path::Path::new("."), false);
        found.iter().map(|finding| format!("{}: {}", finding.path.join("."), finding.message)).collect::<Vec<_>>()
    };
    let none: [String; 0] = [];
    assert_eq!(found(r#"{"port": "/dev/ttyUSB0", "protocol": "rosserial"}"#), none, "all by default");
    assert_eq!(found(r#"{"port": "/dev/ttyUSB0", "protocol": "packetserial", "stock": {}}"#), none, "also so");
    let wrong = found(
        r#"{"port": "/dev/ttyUSB0", "protocol": "rosserial", "stock": {"full_speed_m_s": 0, "steering_limit_deg": 60,
            "wheel_diameter_m": 60, "encoder_turns_per_wheel_turn": -1, "period_count_s": 0, "send_hz": 5, "silent_after_ms": 1}}"#,
    );
    assert_eq!(
        wrong,
        [
            "stock.full_speed_m_s: got 0 m/s, allowed is 0.1 to 20 m/s",
            "stock.steering_limit_deg: got 60 deg, allowed is 1 to 45 deg",
            "stock.wheel_diameter_m: got 60 m, allowed is 0.01 to 1 m",
            "stock.encoder_turns_per_wheel_turn: got -1, allowed is 0.01 to 100",
            "stock.period_count_s: got 0 s, allowed is 0.000001 to 1 s",
            "stock.send_hz: got 5 Hz, allowed is 20 to 100 Hz",
            "stock.silent_after_ms: got 1 ms, allowed is 100 to 10000 ms",
        ],
        "every problem in one run"
    );
    let carril = found(r#"{"port": "/dev/ttyUSB0", "stock": {}}"#);
    assert!(carril[0].starts_with("stock: got a section for stock firmware with `protocol: carril`"), "{carril:?}");
    let simulated = found(r#"{"port": "sim:mcu", "protocol": "rosserial"}"#);
    assert!(simulated[0].contains("a `sim-mcu` speaks carril's protocol"), "{simulated:?}");
    assert_eq!(found(r#"{"port": "/dev/ttyUSB0", "protocol": "ros"}"#).len(), 1, "other protocols are refused");
    assert_eq!(
        found(r#"{"port": "/dev/ttyUSB0", "protocol": "rosserial", "stock": {"speed": 1}}"#).len(),
        1,
        "unknown"
    );
    let period = |protocol| McuLink::period(&McuLinkConfig { protocol, ..McuLinkConfig::carril("/dev/ttyUSB0", 200) });
    assert_eq!(period(Protocol::Rosserial), Some(Duration::from_millis(20)), "as often as it repeats");
}
