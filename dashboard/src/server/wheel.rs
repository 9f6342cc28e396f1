//! Driving by hand. One person has the wheel; of their commands the newest is published, on a thread of its own, and never an old one.
//! Whoever says nothing for the length of the lease, lets go or is gone has let the car stop: one command with speed 0.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use carril_messages::{Command, Message};
use carril_runtime::client::{Client, ExternalPublisher};

use super::graph::Drive;

/// A stop that could not be published is tried again so often.
const STOP_TRIES: u32 = 3;

/// Who says something of it, and to whom: the log of the run.
pub type Say = Arc<dyn Fn(&str, &str) + Send + Sync>;

/// Why a command was not taken.
fn refuse(drive: &Drive, steering_rad: Option<f64>, speed_m_s: Option<f64>) -> Result<Command, String> {
    let (Some(steering_rad), Some(speed_m_s)) = (steering_rad, speed_m_s) else { return Err("not a number".into()) };
    // A slider's end may lie a rounding beyond the limit.
    let within = |value: f64, limit: f64| value.abs() <= limit * 1.000_001;
    if !within(speed_m_s, drive.max_speed_m_s) {
        return Err(format!("speed {speed_m_s} m/s, allowed is up to {} m/s to either side", drive.max_speed_m_s));
    }
    if !within(steering_rad, drive.max_steering_rad) {
        return Err(format!(
            "steering {steering_rad} rad, allowed is up to {:.3} rad to either side",
            drive.max_steering_rad
        ));
    }
    Ok(Command { steering_rad: steering_rad as f32, speed_m_s: speed_m_s as f32 })
}

/// A command of a person as it may go to the car: within limits, and made by somebody who saw how the car was a moment ago.
pub fn check(
    drive: &Drive,
    steering_rad: Option<f64>,
    speed_m_s: Option<f64>,
    seen_ms: f64,
    now_ms: f64,
) -> Result<Command, String> {
    let command = refuse(drive, steering_rad, speed_m_s)?;
    let (age_ms, lease_ms) = (now_ms - seen_ms, drive.lease.as_secs_f64() * 1e3);
    if age_ms <= lease_ms && age_ms >= -lease_ms {
        return Ok(command);
    }
    if age_ms < 0.0 {
        return Err("it was seen in the future: the clock is another one".into());
    }
    Err(format!("too old: {age_ms:.0} ms"))
}

/// Who has the wheel, and what is to be published.
#[derive(Default)]
struct State {
    driver: Option<Driver>,
    next: Option<(Drive, Command)>,
    /// Why the last command did not get out.
    problem: Option<String>,
    ended: bool,
}

struct Driver {
    viewer: u64,
    name: String,
    drive: Drive,
    until: Instant,
}

impl State {
    fn take(&mut self, viewer: u64, name: &str, drive: &Drive, command: Command, now: Instant) -> Result<bool, String> {
        if let Some(driver) = self.driver.as_ref().filter(|driver| driver.viewer != viewer) {
            return Err(format!("{} drives", driver.name));
        }
        let is_new = self.driver.is_none();
        let (name, until) = (name.to_owned(), now + drive.lease);
        self.driver = Some(Driver { viewer, name, drive: drive.clone(), until });
        self.next = Some((drive.clone(), command));
        match self.problem.take() {
            Some(problem) => Err(problem),
            None => Ok(is_new),
        }
    }

    /// The driver lets go: the car stops. Gives the name.
    fn let_go(&mut self, fits: impl FnOnce(&Driver) -> bool) -> Option<String> {
        let driver = self.driver.take_if(|driver| fits(driver))?;
        self.next = Some((driver.drive, Command::default()));
        Some(driver.name)
    }
}

struct Shared {
    state: Mutex<State>,
    news: Condvar,
    say: Say,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The wheel.
pub struct Wheel {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Wheel {
    /// Nobody has it yet.
    pub fn start(client: Arc<Client>, say: Say) -> std::io::Result<Self> {
        let shared = Arc::new(Shared { state: Mutex::default(), news: Condvar::new(), say });
        let own = Arc::clone(&shared);
        let thread = std::thread::Builder::new().name("wheel".into()).spawn(move || run(&own, &client))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// A command of a viewer, for this moment.
    pub fn turn(&self, viewer: u64, name: &str, drive: &Drive, command: Command) -> Result<(), String> {
        let is_new = self.shared.lock().take(viewer, name, drive, command, Instant::now());
        self.shared.news.notify_one();
        if is_new? {
            (self.shared.say)(name, "drives by hand");
        }
        Ok(())
    }

    /// A viewer lets go, if it is the one who drives.
    pub fn let_go(&self, viewer: u64) {
        let name = self.shared.lock().let_go(|driver| driver.viewer == viewer);
        self.shared.news.notify_one();
        if let Some(name) = name {
            (self.shared.say)(&name, "drives no more");
        }
    }

    /// Name of the one who drives.
    pub fn driver(&self) -> Option<String> {
        self.shared.lock().driver.as_ref().map(|driver| driver.name.clone())
    }

    /// Name of the one who drives, unless it is this viewer.
    pub fn another_driver(&self, viewer: u64) -> Option<String> {
        self.shared.lock().driver.as_ref().filter(|driver| driver.viewer != viewer).map(|driver| driver.name.clone())
    }
}

impl Drop for Wheel {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        state.let_go(|_| true);
        state.ended = true;
        drop(state);
        self.shared.news.notify_one();
        if let Some(thread) = self.thread.take() {
            // If it panicked, it has said so; the lease in the car stops it.
            let _ = thread.join();
        }
    }
}

fn run(shared: &Shared, client: &Client) {
    let mut publisher: Option<(String, ExternalPublisher)> = None;
    while let Some((drive, command)) = next(shared) {
        let tries = if command == Command::default() { STOP_TRIES } else { 1 };
        for _ in 0..tries {
            let put = put(client, &mut publisher, &drive, command);
            let failed = put.is_err();
            shared.lock().problem = put.err();
            if !failed {
                break;
            }
            publisher = None;
        }
    }
}

/// What to publish next. `None`: the wheel is gone.
fn next(shared: &Shared) -> Option<(Drive, Command)> {
    let mut state = shared.lock();
    loop {
        if let Some(next) = state.next.take() {
            return Some(next);
        }
        if state.ended {
            return None;
        }
        let now = Instant::now();
        if let Some(name) = state.let_go(|driver| now >= driver.until) {
            drop(state);
            (shared.say)(&name, "drives no more: nothing came for the length of the lease");
            state = shared.lock();
            continue;
        }
        let patience = state.driver.as_ref().map_or(Duration::from_secs(3600), |driver| driver.until - now);
        state = shared.news.wait_timeout(state, patience).unwrap_or_else(PoisonError::into_inner).0;
    }
}

fn put(
    client: &Client,
    publisher: &mut Option<(String, ExternalPublisher)>,
    drive: &Drive,
    command: Command,
) -> Result<(), String> {
    let port = format!("{}/{}", drive.node, drive.port);
    if publisher.as_ref().is_none_or(|(known, _)| *known != port) {
        *publisher = Some((port, client.publisher(&drive.node, &drive.port, Command::TYPE)));
    }
    let Some((_, publisher)) = publisher else { return Ok(()) };
    let encoded = command.encode().map_err(|error| error.to_string())?;
    publisher.put(encoded).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive() -> Drive {
        Drive {
            node: "decision".into(),
            port: "manual".into(),
            max_speed_m_s: 0.5,
            max_steering_rad: 0.349,
            lease: Duration::from_millis(300),
        }
    }

    #[test]
    fn commands_beyond_limits_or_of_the_past_are_refused() {
        let check = |steering, speed, seen| check(&drive(), steering, speed, seen, 10_000.0);
        assert_eq!(
            check(Some(0.349), Some(-0.5), 9_900.0),
            Ok(Command { steering_rad: 0.349, speed_m_s: -0.5 }),
            "at the limits"
        );
        for (steering, speed, seen, why) in [
            (Some(0.4), Some(0.1), 9_900.0, "steering 0.4 rad"),
            (Some(0.1), Some(0.6), 9_900.0, "speed 0.6 m/s"),
            (Some(0.1), None, 9_900.0, "not a number"),
            (Some(f64::NAN), Some(0.1), 9_900.0, "steering NaN"),
            (Some(0.1), Some(f64::INFINITY), 9_900.0, "speed inf"),
            (Some(0.1), Some(0.1), 9_699.0, "too old: 301 ms"),
            (Some(0.1), Some(0.1), 0.0, "too old: 10000 ms"),
            (Some(0.1), Some(0.1), 11_000.0, "future"),
            (Some(0.1), Some(0.1), f64::NAN, "too old: NaN ms"),
        ] {
            let error = check(steering, speed, seen).expect_err(why);
            assert!(error.contains(why), "{why}: {error}");
        }
    }

    #[test]
    fn one_has_the_wheel_until_they_let_go_and_then_the_car_stops() {
        let (mut state, now) = (State::default(), Instant::now());
        let go = Command { steering_rad: 0.0, speed_m_s: 0.3 };
        assert_eq!(state.take(1, "ana", &drive(), go, now), Ok(true), "free");
        assert_eq!(state.take(2, "ben", &drive(), go, now), Err("ana drives".into()), "taken");
        assert_eq!(state.take(1, "ana", &drive(), go, now), Ok(false), "still theirs");
        assert_eq!(state.let_go(|driver| driver.viewer == 2), None, "another cannot let go");
        assert_eq!(state.next.as_ref().map(|(_, command)| *command), Some(go), "it goes on");
        assert_eq!(state.let_go(|driver| driver.viewer == 1).as_deref(), Some("ana"), "let go");
        assert_eq!(state.next.as_ref().map(|(_, command)| *command), Some(Command::default()), "it stops");
        assert_eq!(state.take(2, "ben", &drive(), go, now), Ok(true), "free again");
        let expired = now + drive().lease;
        assert_eq!(state.let_go(|driver| expired >= driver.until).as_deref(), Some("ben"), "silence is letting go");
    }
}
