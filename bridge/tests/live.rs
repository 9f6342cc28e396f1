//! Link and model over a real pseudo-terminal, in real time. Only states and counts are asserted: how long something takes is
//! the machine's affair, and each wait ends after a minute at the latest.

use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use carril_bridge::codec::{Capabilities, FirmwareVersion, HelloAck, Session, Telemetry};
use carril_bridge::codec::{
    Command as WireCommand, Decoder, Direction, Drive, Frame, Packet, encode, encode_with_version,
};
use carril_bridge::{McuLink, McuLinkConfig, SimMcu, SimMcuConfig, SimMcuInputs, SimMcuOutputs};
use carril_messages::{Command, Control, Fault, FaultSet, McuPins, McuSensors};
use carril_runtime::clock::{Clock, LiveClock};
use carril_runtime::{Context, HeapPool, Operator, Setup, Trigger, Waker};
use nix::fcntl::OFlag;
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
use tempfile::TempDir;

#[path = "support/link.rs"]
mod link;

use link::{Link, header};

const PATIENCE: Duration = Duration::from_secs(60);
/// Commands sent to a device that does not read.
const MANY: u16 = 20_000;
const DRIVE: Command = Command { steering_rad: 0.1, speed_m_s: 0.5 };

struct Mcu {
    operator: SimMcu,
    inputs: SimMcuInputs,
    outputs: SimMcuOutputs,
    ticks: u64,
    pins: Option<McuPins>,
}

/// A live run in one thread: each end is stepped often, and either may be missing.
struct Run {
    folder: TempDir,
    setup: Setup,
    link: Option<Link>,
    mcu: Option<Mcu>,
    command: Option<Command>,
}

impl Run {
    /// The lease is long, so that a busy machine does not let it run out where a test does not want that.
    fn empty() -> Self {
        let folder = tempfile::tempdir().expect("a folder for the run");
        let setup = Setup {
            run_dir: Some(folder.path().to_owned()),
            memory_lines: None,
            clock: Arc::new(LiveClock::anchored_now()),
            ..Setup::for_tests("node")
        };
        Self { folder, setup, link: None, mcu: None, command: Some(DRIVE) }
    }

    fn plug_in_link(&mut self, port: &str, lease_ms: u16) {
        let config = McuLinkConfig::carril(port, lease_ms);
        self.link = Some(Link::new(config, &self.setup));
    }

    fn plug_in_mcu(&mut self) {
        self.mcu = Some(Mcu {
            operator: SimMcu::new(SimMcuConfig::default(), &self.setup).expect("the terminal is made"),
            inputs: SimMcuInputs::default(),
            outputs: SimMcuOutputs::default(),
            ticks: 0,
            pins: None,
        });
    }

    fn driving(lease_ms: u16) -> Self {
        let mut run = Self::empty();
        run.plug_in_mcu();
        run.plug_in_link("sim:mcu", lease_ms);
        run.until("the car drives", Run::drives);
        run
    }

    fn turn(&mut self) {
        let now = self.setup.clock.now();
        if let Some(link) = &mut self.link {
            link.step(self.command, now);
        }
        if let Some(mcu) = &mut self.mcu {
            mcu.ticks += u64::from(mcu.pins.is_some_and(|pins| pins.motor_duty != 0.0));
            let (encoder_ticks, encoder_period_us) = (mcu.ticks, Some(3_000));
            let sensors = McuSensors { encoder_ticks, encoder_period_us, battery_v: 8.0, estop_pressed: false };
            mcu.inputs.sensors.put(sensors, header::<McuSensors>(now));
            let context = Context::new(now, Trigger::Period, &HeapPool);
            mcu.operator.step(&mut mcu.inputs, &mut mcu.outputs, &context).expect("the model does not fail");
            mcu.pins = mcu.outputs.pins.sent().last().map(|pins| **pins);
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

    fn control(&mut self, control: Control) {
        let now = self.setup.clock.now();
        self.link.as_mut().expect("the link is there").operator.control(control, now);
    }

    fn pins(&self) -> Option<McuPins> {
        self.mcu.as_ref()?.pins
    }

    fn drives(&self) -> bool {
        self.pins().is_some_and(|pins| pins.motor_duty > 0.0 && !pins.brake)
    }

    fn brakes(&self) -> bool {
        self.pins().is_some_and(|pins| pins.motor_duty == 0.0 && pins.brake)
    }

    fn error(&self) -> String {
        let last = self.link.as_ref().map(|link| &link.last);
        last.and_then(|result| result.as_ref().err()).map_or_else(String::new, ToString::to_string)
    }

    fn faults(&self) -> FaultSet {
        let last = self.link.as_ref().and_then(|link| link.telemetry.last());
        last.map_or(FaultSet::NONE, |report| report.faults)
    }

    fn terminal(&self) -> PathBuf {
        self.folder.path().join("mcu")
    }
}

#[test]
fn drives_over_a_real_terminal_and_measures_the_round_trip() {
    let mut run = Run::driving(2_000);
    let device = std::fs::metadata(run.terminal()).expect("the name leads to the terminal");
    assert!(device.file_type().is_char_device(), "a real character device");
    run.until("twenty commands were echoed", |run| {
        let link = run.link.as_ref().expect("the link is there");
        link.telemetry.iter().filter(|report| report.round_trip_us.is_some()).count() >= 20
    });
    assert_eq!(run.faults(), FaultSet::NONE, "nothing is wrong");
    let name = run.terminal();
    run.mcu = None;
    assert!(!name.is_symlink(), "the name goes with the model");
}

#[test]
fn a_host_that_falls_silent_stops_the_car_until_reset() {
    let mut run = Run::driving(1_000);
    let frozen = run.link.take();
    run.until("the lease has run out", Run::brakes);
    run.link = frozen;
    run.until("the fault is told", |run| run.faults().contains(Fault::LeaseExpired));
    run.until("the node is faulted", |run| run.error().contains("has stopped the car"));
    run.control(Control::Reset);
    run.until("it drives again", |run| run.drives() && run.error().is_empty());
}

#[test]
fn a_host_that_dies_stops_the_car_and_its_successor_needs_a_reset_only_after_a_fault() {
    let mut run = Run::driving(1_000);
    // As after SIGKILL, as far as a test can: nobody steps it, nothing is said; its port stays open.
    std::mem::forget(run.link.take());
    run.until("the lease has run out", Run::brakes);

    let mut run = Run::driving(2_000);
    run.link = None;
    run.until("the release has stopped it", Run::brakes);
    run.plug_in_link("sim:mcu", 2_000);
    run.until("the next host drives", Run::drives);
    assert_eq!(run.faults(), FaultSet::NONE, "an end in order is no fault");
}

#[test]
fn unplugged_and_back_the_car_waits_for_reset() {
    let mut run = Run::driving(2_000);
    for _ in 0..3 {
        run.mcu = None;
        run.until("the loss is told", |run| run.error().contains("trying again"));
        run.plug_in_mcu();
        run.until("telemetry comes again", |run| run.error().contains("the link was lost while the car drove"));
        assert!(run.brakes(), "but the car does not set off by itself: {:?}", run.pins());
        run.control(Control::Reset);
        run.until("it drives again", |run| run.drives() && run.error().is_empty());
    }
}

#[test]
fn a_stale_name_is_replaced_and_a_missing_device_is_told() {
    let mut run = Run::empty();
    run.plug_in_link("sim:mcu", 2_000);
    run.until("the missing device is told", |run| run.error().contains("cannot open"));
    assert!(run.error().contains("`sim:mcu`"), "{}", run.error());
    std::os::unix::fs::symlink("/dev/pts/does-not-exist", run.terminal()).expect("a stale name");
    run.plug_in_mcu();
    run.until("it drives", Run::drives);
}

/// A device of the test's own, on a pseudo-terminal.
struct Device {
    master: PtyMaster,
    path: String,
    decoder: Decoder,
}

impl Device {
    fn new() -> Self {
        let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK).expect("a terminal");
        grantpt(&master).expect("granted");
        unlockpt(&master).expect("unlocked");
        let path = ptsname_r(&master).expect("it has a name");
        Self { master, path, decoder: Decoder::new(Direction::FromHost) }
    }

    fn write(&self, bytes: &[u8]) {
        // What does not fit is lost, as on a real line.
        let _ = nix::unistd::write(&self.master, bytes);
    }

    fn read(&mut self) -> Vec<Packet> {
        let mut buffer = [0; 4096];
        let len = nix::unistd::read(&self.master, &mut buffer).unwrap_or(0);
        buffer[..len].iter().filter_map(|byte| self.decoder.push(*byte)?.ok()).collect()
    }

    fn ack(&self, session: Session, version: u8) {
        let firmware = FirmwareVersion { major: 9, minor: 0, patch: 0 };
        let ack = HelloAck { session, firmware, capabilities: Capabilities::default(), calibration_crc: 0 };
        let mut bytes = Vec::new();
        encode_with_version(version, &Packet { seq: 0, frame: Frame::HelloAck(ack) }, &mut bytes);
        self.write(&bytes);
    }

    /// Answers hellos until one session is open on both sides.
    fn open_session(&mut self, run: &mut Run) -> Session {
        let started = Instant::now();
        loop {
            assert!(started.elapsed() < PATIENCE, "waited a minute for a command; the link says {:?}", run.error());
            run.turn();
            for packet in self.read() {
                match packet.frame {
                    Frame::Hello(session) => self.ack(session, 1),
                    Frame::Command(WireCommand { session, .. }) => return session,
                    _ => {}
                }
            }
        }
    }
}

#[test]
fn a_device_that_is_silent_noisy_or_of_another_version_is_told_and_then_taken() {
    let mut run = Run::empty();
    let mut device = Device::new();
    run.plug_in_link(&device.path.clone(), 2_000);
    run.until("the silence is told", |run| run.error().contains("does not answer"));
    let mut noise = 1_u32;
    for _ in 0..200 {
        let random = std::iter::repeat_with(|| {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (noise >> 24) as u8
        });
        device.write(&random.take(256).collect::<Vec<u8>>());
        run.turn();
    }
    assert!(run.error().contains("does not answer"), "noise is no answer: {}", run.error());
    device.write(&[0]);
    device.ack(Session(0), 7);
    run.until("the version is told", |run| run.error().contains("protocol version 7, expected 1"));
    let mut telemetry = Vec::new();
    encode(&Packet { seq: 0, frame: Frame::Telemetry(Telemetry::default()) }, &mut telemetry);
    device.write(&telemetry);
    device.open_session(&mut run);
}

#[test]
fn a_device_that_does_not_read_never_blocks_the_host_and_then_gets_the_newest_command() {
    let mut run = Run::empty();
    let mut device = Device::new();
    run.plug_in_link(&device.path.clone(), 2_000);
    device.open_session(&mut run);
    run.command = None;
    let link = run.link.as_mut().expect("the link is there");
    let sent_before = link.operator.counts().commands_sent;
    let clock: Arc<dyn Clock> = Arc::clone(&run.setup.clock);
    for speed_mm_s in 1..=MANY {
        let now = clock.now();
        let command = Command { steering_rad: 0.0, speed_m_s: f32::from(speed_mm_s) / 1_000.0 };
        link.inputs.command.put(command, header::<Command>(now));
        let context = Context::new(now, Trigger::Input, &HeapPool);
        // Errors are the silence of the device, which is as wanted here.
        let _ = link.operator.step(&mut link.inputs, &mut link.outputs, &context);
    }
    let newest = (link.operator.counts().commands_sent - sent_before) as i16;
    let (started, mut speeds) = (Instant::now(), Vec::new());
    while speeds.last() != Some(&newest) {
        assert!(started.elapsed() < PATIENCE, "the newest command never came, the last was {:?}", speeds.last());
        speeds.extend(device.read().into_iter().filter_map(|packet| match packet.frame {
            Frame::Command(WireCommand { drive: Drive::Speed(speed_mm_s), .. }) => Some(speed_mm_s),
            _ => None,
        }));
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(speeds.len() < usize::from(MANY) / 2, "most were overtaken, yet {} arrived", speeds.len());
    assert!(speeds.is_sorted(), "none came after a newer one");
}

#[test]
fn an_open_port_and_every_byte_wake_the_node() {
    let mut run = Run::empty();
    let (device, wakes) = (Device::new(), Arc::new(AtomicU32::new(0)));
    let counter = Arc::clone(&wakes);
    run.setup.waker = Waker::new(move || {
        counter.fetch_add(1, Ordering::AcqRel);
    });
    run.plug_in_link(&device.path.clone(), 2_000);
    let wait_for = |count: u32| {
        let started = Instant::now();
        while wakes.load(Ordering::Acquire) < count {
            assert!(started.elapsed() < PATIENCE, "waited a minute for wake {count}");
            std::thread::sleep(Duration::from_millis(1));
        }
    };
    wait_for(1);
    device.write(&[1]);
    wait_for(2);
    device.write(&[0]);
    wait_for(3);
}

#[test]
fn a_link_without_a_folder_of_a_run_is_refused() {
    let setup = Setup { run_dir: None, memory_lines: None, ..Setup::for_tests("node") };
    let config = McuLinkConfig::carril("sim:mcu", 200);
    let error = McuLink::new(config, &setup).err().expect("there is no place for the line").to_string();
    assert!(error.contains("carril run"), "says what to do: {error}");
    let missing = Path::new("/nonexistent/folder").to_owned();
    let setup = Setup { run_dir: Some(missing), memory_lines: None, ..Setup::for_tests("node") };
    let error = SimMcu::new(SimMcuConfig::default(), &setup).err().expect("there is no such folder").to_string();
    assert!(error.contains("`/nonexistent/folder/mcu`"), "says where: {error}");
}

fn echoes(run: &Run) -> usize {
    let link = run.link.as_ref().expect("the link is there");
    link.telemetry.iter().filter(|report| report.round_trip_us.is_some()).count()
}

/// The old instance goes, then the new one comes and takes over.
fn replace_mcu(run: &mut Run) {
    let Mcu { operator, inputs, outputs, ticks, pins } = run.mcu.take().expect("the chip is there");
    let state = operator.snapshot();
    drop(operator);
    let mut operator = SimMcu::new(SimMcuConfig::default(), &run.setup).expect("the terminal is made");
    operator.restore(state).expect("the state fits");
    run.mcu = Some(Mcu { operator, inputs, outputs, ticks, pins });
}

fn replace_link(run: &mut Run) {
    let Link { operator, inputs, outputs, last, telemetry } = run.link.take().expect("the link is there");
    let state = operator.snapshot();
    drop(operator);
    let config = McuLinkConfig::carril("sim:mcu", 2_000);
    let mut operator = McuLink::new(config, &run.setup).expect("the threads start");
    operator.restore(state).expect("the state fits");
    run.link = Some(Link { operator, inputs, outputs, last, telemetry });
}

#[test]
fn either_end_can_be_replaced_while_the_car_drives_and_the_session_goes_on() {
    let mut run = Run::driving(2_000);
    for (replace, handshakes) in
        [(replace_mcu as fn(&mut Run), 1), (replace_link, 0), (replace_mcu, 0), (replace_link, 0)]
    {
        replace(&mut run);
        let before = echoes(&run);
        run.until("commands arrive again", |run| echoes(run) >= before + 5);
        assert!(run.drives() && run.error().is_empty(), "{:?}: {}", run.pins(), run.error());
        assert_eq!(run.faults(), FaultSet::NONE, "no fault");
        let counts = run.link.as_ref().expect("the link is there").operator.counts();
        assert_eq!(counts.handshakes, handshakes, "in the session that was open: {counts:?}");
    }
}

#[test]
fn a_chip_that_has_forgotten_the_session_stops_the_car_until_reset() {
    let mut run = Run::driving(2_000);
    run.mcu = None;
    run.plug_in_mcu();
    run.until("the link says so", |run| run.error().contains("the link was lost while the car drove"));
    assert!(!run.drives(), "it does not set off by itself");
    run.control(Control::Reset);
    run.until("it drives again", |run| run.drives() && run.error().is_empty());
}

#[test]
fn a_link_that_ends_for_good_still_releases_the_car_after_its_state_was_looked_at() {
    let mut run = Run::driving(2_000);
    let _ = run.link.as_ref().expect("the link is there").operator.snapshot();
    (0..5).for_each(|_| run.turn());
    run.link = None;
    run.until("the release has stopped it", Run::brakes);
    run.plug_in_link("sim:mcu", 2_000);
    run.until("without a fault", |run| run.drives() && run.faults() == FaultSet::NONE);
}

#[test]
fn another_lease_is_taken_over_without_opening_the_port_again() {
    let mut run = Run::driving(2_000);
    let config = |port: &str, lease_ms| McuLinkConfig::carril(port, lease_ms);
    let link = &mut run.link.as_mut().expect("the link is there").operator;
    assert!(link.reconfigure(&config("sim:other", 2_000)).is_none(), "another port must be opened");
    assert!(matches!(link.reconfigure(&config("sim:mcu", 1_000)), Some(Ok(()))), "the lease alone need not");
    let before = echoes(&run);
    run.until("commands go on", |run| echoes(run) >= before + 5);
    let counts = run.link.as_ref().expect("the link is there").operator.counts();
    assert_eq!(counts.handshakes, 1, "in the same session");
}

#[test]
fn a_state_of_version_1_was_the_stops_alone() {
    let stops = carril_bridge::host::Latches { estop: true, link_lost: false };
    let bytes = carril_messages::codec::encode(&stops).expect("it has bytes");
    let state = McuLink::migrate(1, &bytes).expect("version 1 is known");
    assert_eq!((state.host.latches, state.host.session), (stops, None), "the e-stop stays, the session is new");
    let mut run = Run::driving(2_000);
    run.link.as_mut().expect("the link is there").operator.restore(state).expect("the state fits");
    run.until("the car stands", |run| !run.drives());
    assert!(McuLink::migrate(1, &[9]).is_err() && McuLink::migrate(4, &bytes).is_err(), "nothing else is taken");
}
