//! A car that is driven by hand stands when the hand is gone, whatever took it away: seen on the serial line itself, where the test is the
//! microcontroller. How long it takes is in `./dev bench remote`.

mod support;

use std::net::SocketAddr;
use std::sync::Arc;

use carril_dashboard::access::Access;
use carril_dashboard::server::{self, Options};
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use support::car::{Car, patient_graph, until};
use support::chip::{Chip, on_the_line};
use support::page::{self, Page};
use support::{Running, Sandbox};
use wifi_link::{Conditions, LinkError, WifiLink};

/// A car that drives only by hand: nothing else makes its wheels turn.
fn graph(chip: &Chip) -> String {
    on_the_line(&patient_graph(&[("auto_start: true", "auto_start: false")]), chip)
}

/// Holds the key until the command to drive is on the line, and the motor turns.
#[track_caller]
fn drive(page: &mut Page, chip: &Chip) {
    let mut seq = 0;
    until("it is driven by hand", || {
        seq += 1;
        page.drive(seq, 0.1, 0.3);
        chip.drives() && !chip.told_to_stand()
    });
}

#[track_caller]
fn stands(chip: &Chip, how: &str) {
    until(&format!("0 on the line: {how}"), || chip.told_to_stand());
    until(&format!("the motor does not turn: {how}"), || !chip.drives());
    // It was the host that stopped it: had it fallen silent, the chip would have stopped the motor, too, and said so.
    assert!(chip.now().faults.is_empty(), "{how}: {:?}", chip.now());
}

#[test]
fn it_stands_when_the_tab_is_closed_or_its_process_killed() {
    let chip = Chip::new();
    let car = Car::launch_standing(Sandbox::new(), &graph(&chip));
    let local = SocketAddr::from(([127, 0, 0, 1], 0));
    let server = server::start(car.client(), Options::local(local)).expect("the server starts");
    let mut page = Page::open(server.address());
    page.hear_type("hello");
    drive(&mut page, &chip);
    // The kernel closes the sockets of both alike, without goodbye.
    drop(page);
    stands(&chip, "the tab is closed");
    drop(server);
    car.end();
}

#[test]
fn it_stands_when_the_server_is_killed() {
    let chip = Chip::new();
    let car = Car::launch_standing(Sandbox::new(), &graph(&chip));
    let mut gateway = car.sandbox.start(&[
        "gateway",
        "--listen",
        "127.0.0.1:0",
        "--dashboard",
        "127.0.0.1:0",
        "--scouting",
        "off",
        "--json",
    ]);
    gateway.wait_for_output("the gateway is up", |output| output.contains('\n'));
    let reachable: Value = serde_json::from_str(gateway.output().0.lines().next().expect("a line")).expect("JSON");
    let url = reachable["dashboard"][0].as_str().expect("an address");
    let address = url.trim_start_matches("http://").trim_end_matches('/').parse().expect("of this machine");
    let mut page = Page::open(address);
    page.hear_type("hello");
    drive(&mut page, &chip);
    gateway.signal(Signal::SIGKILL);
    stands(&chip, "the server is killed");
    drop(gateway);
    car.end();
}

#[test]
fn it_stands_when_the_link_is_cut() {
    let link = match WifiLink::new(Conditions::good()) {
        Ok(link) => link,
        Err(LinkError::NotPossible(reason)) => return eprintln!("skipped: {reason}"),
        Err(error) => panic!("{error}"),
    };
    let chip = Chip::new();
    let sandbox = Sandbox::new();
    let key = Access::open(&sandbox.path().join("config"), "car1").and_then(|mut access| access.grant("laptop-1"));
    let key = key.expect("a key");
    let file = sandbox.write("by-hand.yaml", format!("{}\nremote:\n  scouting: off\n", graph(&chip)));
    let run = sandbox.prepare(link.car().command(Sandbox::PROGRAM), &["run", &file.display().to_string()]);
    let run = Running::start(run);
    until("the gateway", || run.output().1.contains("with a key"));
    let address = SocketAddr::from((link.car().address(), 8080));
    let authority = Arc::new(key.identity().authority);
    let mut page = link
        .laptop()
        .inside(|| {
            let login = json!({"name": key.name, "token": key.token});
            let cookie = page::post(address, Some(&authority), "/api/login", &login).cookie();
            Page::try_open(address, Some(&authority), &[("cookie", &cookie)]).expect("it is let in")
        })
        .expect("the laptop is there");
    page.hear_type("hello");
    drive(&mut page, &chip);
    link.cut();
    stands(&chip, "the link is cut");
    drop(page);
    run.interrupt();
}
