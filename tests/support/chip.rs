//! The far end of a serial line, held by the test: a pseudo-terminal with the model of the microcontroller behind it, which outlives
//! every process of a run.

use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use carril_bridge::codec::{Command, Decoder, Direction, Drive, Frame};
use carril_bridge::mcu_model::McuModel;
use carril_messages::{FaultSet, McuPins, McuSensors, car};
use nix::fcntl::{OFlag, open};
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sys::stat::Mode;
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};

/// What the chip does at its pins.
#[derive(Clone, Copy, Debug)]
pub struct AtPins {
    /// Servo, motor, brake.
    pub pins: McuPins,
    /// What is wrong.
    pub faults: FaultSet,
}

/// The chip, in real time.
pub struct Chip {
    port: String,
    now: Arc<Mutex<AtPins>>,
    told: Arc<Mutex<Vec<(Instant, Command)>>>,
    stop: Arc<AtomicBool>,
    turned: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
    // Without anybody at this end the other one reads errors.
    _near_end: OwnedFd,
}

impl Chip {
    /// Powers it up.
    pub fn new() -> Self {
        let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC | OFlag::O_NONBLOCK);
        let master = master.expect("a terminal");
        grantpt(&master).expect("granted");
        unlockpt(&master).expect("unlocked");
        let port = ptsname_r(&master).expect("it has a name");
        let mut settings = tcgetattr(&master).expect("it has settings");
        cfmakeraw(&mut settings);
        tcsetattr(&master, SetArg::TCSANOW, &settings).expect("it takes settings");
        let near_end = open(port.as_str(), OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC, Mode::empty());
        let pins = McuPins { servo_us: None, motor_duty: 0.0, brake: true };
        let now = Arc::new(Mutex::new(AtPins { pins, faults: FaultSet::NONE }));
        let stop = Arc::new(AtomicBool::new(false));
        let turned = Arc::new(AtomicU64::new(0));
        let told: Arc<Mutex<Vec<(Instant, Command)>>> = Arc::default();
        let (shared, stopped, by_hand) = (Arc::clone(&now), Arc::clone(&stop), Arc::clone(&turned));
        let line = Arc::clone(&told);
        let thread = std::thread::spawn(move || live(&master, &shared, &line, &stopped, &by_hand));
        Self { port, now, told, stop, turned, thread: Some(thread), _near_end: near_end.expect("it can be opened") }
    }

    /// The port to open.
    pub fn port(&self) -> &str {
        &self.port
    }

    /// What it does now.
    pub fn now(&self) -> AtPins {
        *self.now.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The commands that came over the line, as they were on it, and when.
    pub fn told(&self) -> Vec<(Instant, Command)> {
        self.told.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The last command on the line was to stand.
    pub fn told_to_stand(&self) -> bool {
        let told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        told.last().is_some_and(|(_, command)| matches!(command.drive, Drive::Speed(0) | Drive::Duty(0)))
    }

    /// Somebody turns the wheel by hand, by so many ticks.
    pub fn turn(&self, ticks: u64) {
        self.turned.fetch_add(ticks, Ordering::Relaxed);
    }

    /// The motor turns.
    pub fn drives(&self) -> bool {
        let AtPins { pins, .. } = self.now();
        pins.motor_duty > 0.0 && !pins.brake
    }

    /// The motor brakes.
    pub fn brakes(&self) -> bool {
        let AtPins { pins, .. } = self.now();
        pins.motor_duty == 0.0 && pins.brake
    }
}

impl Drop for Chip {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // It has told already why it panicked.
            let _ = thread.join();
        }
    }
}

/// A graph like the default one with this chip at the end of its line instead of a simulated one. The simulated car stands, as nobody
/// tells it what the motor does.
pub fn on_the_line(graph: &str, chip: &Chip) -> String {
    let text = graph.replace("sim:mcu", chip.port());
    let without_mcu = text.find("  mcu:").zip(text.find("budgets:"));
    let (from, to) = without_mcu.expect("the default graph has a node `mcu`, and then budgets");
    let pins = "    inputs:\n      pins: { from: mcu/pins, delay_ms: 5 }";
    let world = text.find(pins).expect("the default graph closes the loop");
    let rest = world + text[world + pins.len()..].find('\n').expect("the line ends") + pins.len() + 1;
    format!("{}{}{}", &text[..world], &text[rest..from], &text[to..])
}

/// The chip's loop. The wheel turns while the motor does.
fn live(
    master: &PtyMaster,
    now: &Mutex<AtPins>,
    told: &Mutex<Vec<(Instant, Command)>>,
    stop: &AtomicBool,
    turned: &AtomicU64,
) {
    let mut line = Decoder::new(Direction::FromHost);
    let (began, mut model) = (Instant::now(), McuModel::new(car::BATTERY_LOW_V as f32));
    let (mut sensors, mut buffer) = (
        McuSensors { encoder_ticks: 0, encoder_period_us: Some(3_000), battery_v: 8.0, estop_pressed: false },
        [0; 4096],
    );
    while !stop.load(Ordering::Relaxed) {
        let (now_us, mut reply) = (began.elapsed().as_micros() as u64, Vec::new());
        let len = nix::unistd::read(master, &mut buffer).unwrap_or(0);
        for packet in buffer[..len].iter().filter_map(|byte| line.push(*byte)) {
            if let Ok(packet) = packet
                && let Frame::Command(command) = packet.frame
            {
                told.lock().unwrap_or_else(PoisonError::into_inner).push((Instant::now(), command));
            }
        }
        model.receive(now_us, &buffer[..len], &mut reply);
        let pins = model.step(now_us, Some(&sensors), &mut reply);
        sensors.encoder_ticks += u64::from(pins.motor_duty != 0.0) + turned.swap(0, Ordering::Relaxed);
        // What does not fit is lost, as on a real line.
        let _ = nix::unistd::write(master, &reply);
        *now.lock().unwrap_or_else(PoisonError::into_inner) = AtPins { pins, faults: model.faults() };
        std::thread::sleep(Duration::from_millis(2));
    }
}
