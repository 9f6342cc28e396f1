//! The serial link while the default graph drives: what the node `bridge` costs, and how long a command takes to the chip and back.

use std::io::{Read, Write};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_runtime::messages::{Message, WheelTelemetry};

use crate::support::car::Car;
use crate::support::measure::{processor_s, quantile};
use crate::support::report::Row;

const TIME: Duration = Duration::from_secs(20);
/// What the link may cost of a core.
const GOAL_PERCENT: f64 = 3.0;
/// Bytes of a command on the line, and of a report.
const COMMAND_BYTES: usize = 18;
const REPORT_BYTES: usize = 39;
const BARE_ROUNDS: usize = 1_000;

/// Measures the node `bridge` of the default graph.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let car = Car::launch();
    let pid = car.pid("bridge");
    let heard: Arc<Mutex<Vec<WheelTelemetry>>> = Arc::default();
    let hears = Arc::clone(&heard);
    let guard = car.client.subscribe("bridge", "telemetry", move |header, payload, _| {
        if let Ok(report) = WheelTelemetry::decode(&header.meta, &payload) {
            hears.lock().unwrap_or_else(PoisonError::into_inner).push(report);
        }
    });
    let guard = guard.expect("a subscription");
    let (began, busy_s) = (Instant::now(), processor_s(pid));
    std::thread::sleep(TIME);
    let (elapsed_s, busy_s) = (began.elapsed().as_secs_f64(), processor_s(pid) - busy_s);
    drop(guard);
    let reports = heard.lock().unwrap_or_else(PoisonError::into_inner);
    let round_trips: Vec<f64> = reports.iter().filter_map(|report| report.round_trip_us).map(f64::from).collect();
    let bare = bare_round_trips_us();
    emit(Row::against(
        "serial link: processor time of its node, against the goal",
        busy_s / elapsed_s * 100.0,
        "% core",
        GOAL_PERCENT,
    ));
    emit(Row::alone("serial link: reports a second", reports.len() as f64 / elapsed_s, "Hz"));
    emit(Row::alone("serial link: commands echoed a second", round_trips.len() as f64 / elapsed_s, "Hz"));
    for (label, at) in [("median", 0.5), ("p99", 0.99)] {
        let name = format!("serial link: command to report, {label}, against as many bytes over a bare terminal");
        emit(Row::against(name, quantile(&round_trips, at), "us", quantile(&bare, at)));
    }
}

/// As many bytes there and back over a pseudo-terminal between two threads that wait for nothing else, µs.
fn bare_round_trips_us() -> Vec<f64> {
    let nix::pty::OpenptyResult { master, slave } = nix::pty::openpty(None, None).expect("a terminal");
    let mut raw = nix::sys::termios::tcgetattr(&slave).expect("it has settings");
    nix::sys::termios::cfmakeraw(&mut raw);
    nix::sys::termios::tcsetattr(&slave, nix::sys::termios::SetArg::TCSANOW, &raw).expect("it takes settings");
    let (mut near, mut far) = (std::fs::File::from(master), std::fs::File::from(slave));
    let echo = std::thread::spawn(move || {
        let mut command = [0; COMMAND_BYTES];
        while far.read_exact(&mut command).is_ok() && command[0] == 1 {
            far.write_all(&[1; REPORT_BYTES]).expect("it is read");
        }
    });
    let times = (0..BARE_ROUNDS).map(|_| {
        std::thread::sleep(Duration::from_millis(5));
        let (began, mut report) = (Instant::now(), [0; REPORT_BYTES]);
        near.write_all(&[1; COMMAND_BYTES]).and_then(|()| near.read_exact(&mut report)).expect("it echoes");
        began.elapsed().as_secs_f64() * 1e6
    });
    let times = times.collect();
    near.write_all(&[0; COMMAND_BYTES]).expect("it is read");
    echo.join().expect("the echo ends");
    times
}
