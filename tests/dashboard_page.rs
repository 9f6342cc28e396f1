//! The built page in a real browser, on the real server, with the simulated car behind it: `dashboard/web/tests-live/car.mjs` looks and
//! clicks, and asks here what the car itself says. Needs node, Chromium, and `npm ci` in dashboard/web; else it says so and is skipped.

mod support;

use std::io::{BufRead, BufReader, Write};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use carril_dashboard::server::{self, Options, Server};
use serde_json::{Value, json};
use support::car::{Car, patient_graph, until};
use support::project;
use support::thorough::is_thorough;

const ANY_PORT: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

/// What is missing on this machine, if anything is.
fn missing() -> Option<&'static str> {
    let runs =
        |program: &str| Command::new(program).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    let named = std::env::var_os("CHROMIUM").map(PathBuf::from);
    let known = ["/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"].map(PathBuf::from);
    if !runs("node").is_ok_and(|status| status.success()) {
        return Some("node");
    }
    if !project().join("dashboard/web/node_modules/playwright-core").is_dir() {
        return Some("what `npm ci` in dashboard/web installs");
    }
    let found = named.into_iter().chain(known).any(|path| path.exists());
    (!found).then_some("chromium (CHROMIUM=/path/to/it)")
}

fn serve(car: &Car, options: Options) -> Server {
    server::start(car.client(), options).expect("the server starts")
}

#[test]
fn the_page_shows_and_controls_the_car() {
    if let Some(missing) = missing() {
        eprintln!("skipped: there is no {missing} on this machine");
        return;
    }
    let car = Car::launch(&patient_graph(&[]));
    let mut server = Some(serve(&car, Options::local(ANY_PORT)));
    let address = server.as_ref().map(Server::address).expect("it was started");
    let reader = serve(&car, Options { local_control: false, ..Options::local(ANY_PORT) });

    let mut script = Command::new("node");
    script.arg("tests-live/car.mjs").current_dir(project().join("dashboard/web"));
    script.env("PAGE", format!("http://{address}/")).env("READER", format!("http://{}/", reader.address()));
    script.env("THOROUGH", if is_thorough() { "yes" } else { "" });
    let mut script = script.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("node starts");
    let mut answers = script.stdin.take().expect("its input is piped");
    let questions = BufReader::new(script.stdout.take().expect("its output is piped"));
    let mut done = false;
    for question in questions.lines().map_while(Result::ok) {
        let question: Value = serde_json::from_str(&question).expect("questions are JSON");
        let answer = match question["ask"].as_str().unwrap_or_default() {
            "threshold" => json!({"value": car.sandbox.carril(&["get", "lane", "threshold"]).expect(0).trim()}),
            "state" => json!({"value": car.sample("decision/state")["state"]}),
            "listening" => json!({"keys": server.as_ref().map_or(0, Server::listening_to)}),
            "end the server" => {
                server = None;
                json!({})
            }
            "start the server" => {
                server = Some(serve(&car, Options::local(address)));
                json!({})
            }
            "done" => {
                done = true;
                break;
            }
            other => panic!("`{other}`: what does the script want?"),
        };
        writeln!(answers, "{answer}").expect("the script listens");
    }
    drop(answers);
    let status = script.wait().expect("it can be waited for");
    assert!(done && status.success(), "the script ended with {status}; it says above why");
    if let Some(server) = &server {
        until("nobody looks any more", || server.connected().is_empty());
        until("and nothing is listened to", || server.listening_to() == 0);
    }
    drop((server, reader));
    car.end();
}
