//! A car seen from a laptop over an emulated Wi-Fi link, by a tool and by the dashboard: how old the view is, how long answers take beside
//! the camera, how it comes back after an outage, and what all of it costs the car. Then twenty dashboards on this machine.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use carril_runtime::client::find_run;
use wifi_link::{Conditions, LinkError, WifiLink};

use crate::support::ages::Ages;
use crate::support::car::{Car, PROGRAM};
use crate::support::children::Role;
use crate::support::measure::{monotonic_ns, processor_s, quantile};
use crate::support::report::Row;
use crate::support::viewers::{Seen, memory_kb, typical};

/// What each look over the link takes, after a beginning.
const LENGTH: Duration = Duration::from_secs(45);
/// A viewer needs this long to begin.
const SETTLE: Duration = Duration::from_secs(2);
const OUTAGE: Duration = Duration::from_secs(10);
const ROUNDS: usize = 3;
const WINDOW: Duration = Duration::from_secs(8);
/// The promises.
const VIEW_MS: f64 = 500.0;
const ANSWER_MS: f64 = 60.0;
const LIVE_AGAIN_S: f64 = 1.0;
const PAGES: usize = 20;

/// Measures view and answers over the link, and what it costs the car.
pub fn run(emit: &mut dyn FnMut(Row)) {
    let Some((car, laptop)) = launch("remote") else { return };
    for (name, conditions) in [("20 Mbit/s", Conditions::good()), ("2 Mbit/s", Conditions::slow())] {
        laptop.link.set(conditions).expect("a link can be like this");
        for who in [Who::Tool, Who::Page] {
            let mut role = laptop.start(who, SETTLE + LENGTH + SETTLE);
            role.wait_ready();
            let began = monotonic_ns();
            let seen: Seen = role.result();
            report(emit, &format!("{}, {name}", who.name()), &seen, began + ns(SETTLE), began + ns(SETTLE + LENGTH));
        }
    }
    laptop.link.set(Conditions::good()).expect("a link can be like this");
    // Who looks on and who drives alternate, so that what else happens on the machine meets both alike.
    let ages = Ages::listen(&car.client, "actuator", "command");
    compare(emit, "a tool and a page over Wi-Fi", &ages, || {
        [Who::Tool, Who::Page].map(|who| laptop.start(who, SETTLE + WINDOW + SETTLE)).into_iter().collect()
    });
}

/// Measures how the view comes back after an outage.
pub fn outage(emit: &mut dyn FnMut(Row)) {
    let Some((_car, laptop)) = launch("outage") else { return };
    for who in [Who::Tool, Who::Page] {
        let mut times = Vec::new();
        for _ in 0..ROUNDS {
            let mut role = laptop.start(who, SETTLE * 2 + OUTAGE + SETTLE * 3);
            role.wait_ready();
            std::thread::sleep(SETTLE * 2);
            laptop.link.cut();
            std::thread::sleep(OUTAGE);
            laptop.link.restore();
            let restored = monotonic_ns();
            let seen: Seen = role.result();
            let live = seen.live_again_ns(restored, Duration::from_millis(500));
            times.push(live.map_or(f64::INFINITY, |ns| ns as f64 * 1e-9));
        }
        for (label, at) in [("median", 0.5), ("worst", 1.0)] {
            let name =
                format!("{}, after 10 s without a link: live again, {label} of {ROUNDS}, against 1 s", who.name());
            emit(Row::against(name, quantile(&times, at), "s", LIVE_AGAIN_S));
        }
    }
}

/// A car on one end of a link, and the laptop on the other. `None`, and said so: not possible here.
fn launch(case: &str) -> Option<(Car, Laptop)> {
    let link = match WifiLink::new(Conditions::good()) {
        Ok(link) => link,
        Err(LinkError::NotPossible(reason)) => {
            eprintln!("{case}: skipped: {reason}");
            return None;
        }
        Err(error) => panic!("{error}"),
    };
    let (car, key) = Car::launch_reachable(link.car().command(PROGRAM), "  scouting: off\n", "bench");
    let key_file = car.runs().join("bench.key");
    key.write(&key_file).expect("it is writable");
    Some((car, Laptop { link, key_file }))
}

/// Whoever looks on from the laptop.
struct Laptop {
    link: WifiLink,
    key_file: PathBuf,
}

#[derive(Clone, Copy)]
enum Who {
    Tool,
    Page,
}

impl Who {
    fn name(self) -> &'static str {
        match self {
            Self::Tool => "tool over Wi-Fi",
            Self::Page => "page over Wi-Fi",
        }
    }
}

impl Laptop {
    fn start(&self, who: Who, length: Duration) -> Role {
        let car = self.link.car().address();
        let (role, address) = match who {
            Who::Tool => ("remote-tool", format!("tls/{car}:7448")),
            Who::Page => ("remote-page", format!("{car}:8080")),
        };
        let program = std::env::current_exe().expect("this program has a path");
        let length = length.as_secs_f64().to_string();
        Role::start_by(
            self.link.laptop().command(program),
            &[role.into(), address, self.key_file.display().to_string(), length],
        )
    }
}

fn ns(time: Duration) -> u64 {
    time.as_nanos() as u64
}

fn report(emit: &mut dyn FnMut(Row), name: &str, seen: &Seen, from: u64, to: u64) {
    let seconds = (to - from) as f64 * 1e-9;
    let images = seen.images.iter().filter(|(came, _)| (from..to).contains(came)).count();
    emit(Row::alone(format!("{name}: images a second"), images as f64 / seconds, "Hz"));
    let ages = seen.image_ages_ms(from, to);
    emit(Row::against(format!("{name}: age of the view, p99, against 500 ms"), quantile(&ages, 0.99), "ms", VIEW_MS));
    emit(Row::against(format!("{name}: age of the view, worst, against 500 ms"), quantile(&ages, 1.0), "ms", VIEW_MS));
    // A packet that is lost and lost again decides over the 99th percentile of a part; the median part is what is usual.
    let part = (to - from) / ROUNDS as u64;
    let parts: Vec<_> = (0..ROUNDS as u64)
        .map(|at| seen.round_trips_ms(from + at * part, from + (at + 1) * part))
        .map(|took| typical(&took))
        .collect();
    for (at, (label, _)) in parts[0].iter().enumerate() {
        let of_parts: Vec<f64> = parts.iter().map(|part| part[at].1).collect();
        let name = format!("{name}: answers beside video, {label}, median of {ROUNDS}, against 60 ms");
        emit(Row::against(name, quantile(&of_parts, 0.5), "ms", ANSWER_MS));
    }
    let name = format!("{name}: answers beside video, worst");
    emit(Row::alone(name, quantile(&seen.round_trips_ms(from, to), 1.0), "ms"));
}

/// Exposure to steering with viewers and without, by turns.
fn compare(emit: &mut dyn FnMut(Row), who: &str, ages: &Ages, mut look: impl FnMut() -> Vec<Role>) {
    let (mut with, mut without) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        std::thread::sleep(SETTLE);
        without.push(ages.window(WINDOW));
        let mut roles = look();
        roles.iter_mut().for_each(Role::wait_ready);
        std::thread::sleep(SETTLE);
        with.push(ages.window(WINDOW));
        for mut role in roles {
            let _: Seen = role.result();
        }
    }
    let typical = |windows: &[Vec<f64>], of: &dyn Fn(&Vec<f64>) -> f64| {
        let of_each: Vec<f64> = windows.iter().map(of).collect();
        quantile(&of_each, 0.5)
    };
    for (label, at) in [("median", 0.5), ("p99", 0.99)] {
        let of = |window: &Vec<f64>| quantile(window, at);
        let name = format!("exposure to steering beside {who}, {label}, against nobody");
        emit(Row::against(name, typical(&with, &of), "us", typical(&without, &of)));
    }
    let rate = |window: &Vec<f64>| window.len() as f64 / WINDOW.as_secs_f64();
    let name = format!("steering commands a second beside {who}, against nobody");
    emit(Row::against(name, typical(&with, &rate), "Hz", typical(&without, &rate)));
}

/// Measures what many dashboards on this machine cost.
pub fn dashboards(emit: &mut dyn FnMut(Row)) {
    let listen = |socket: std::io::Result<std::net::TcpListener>| socket.and_then(|socket| socket.local_addr());
    let free = || listen(std::net::TcpListener::bind("127.0.0.1:0")).expect("a free port").port();
    let address = SocketAddr::from(([127, 0, 0, 1], free()));
    let remote = format!("  listen: 127.0.0.1:0\n  scouting: off\n  dashboard: {address}\n");
    let (car, _) = Car::launch_reachable(Command::new(PROGRAM), &remote, "bench");
    let ages = Ages::listen(&car.client, "actuator", "command");
    let start = |length: Duration| {
        let words = ["pages".into(), address.to_string(), PAGES.to_string(), length.as_secs_f64().to_string()];
        Role::start(&words)
    };
    let gateway = car.gateway_pid();
    let memory_before = memory_kb(gateway);
    let mut role = start(SETTLE + WINDOW + SETTLE);
    role.wait_ready();
    std::thread::sleep(SETTLE);
    let busy = processor_s(gateway);
    std::thread::sleep(WINDOW);
    let busy = (processor_s(gateway) - busy) / WINDOW.as_secs_f64() * 100.0;
    let seen: Seen = role.result();
    let of = format!("{PAGES} dashboards");
    emit(Row::alone(format!("{of}: processor time of the server"), busy, "% core"));
    let rate = seen.images.len() as f64 / PAGES as f64 / (SETTLE + WINDOW + SETTLE).as_secs_f64();
    emit(Row::alone(format!("{of}: images a second for each"), rate, "Hz"));
    compare(emit, &of, &ages, || vec![start(SETTLE + WINDOW + SETTLE)]);
    let memory = memory_kb(gateway) as f64 / 1024.0;
    emit(Row::against(
        format!("{of}: memory of the server after them, against before"),
        memory,
        "MiB",
        memory_before as f64 / 1024.0,
    ));
    assert!(find_run(car.runs(), None).is_ok(), "the car still runs");
}
