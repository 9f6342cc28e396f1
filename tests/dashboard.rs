//! The dashboard's server on a car at work, as pages see it: over the real HTTP, WebSocket and TLS, with the simulated car behind it.

mod support;

use std::collections::HashMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::{Arc, PoisonError, RwLock};

use carril_dashboard::access::Access;
use carril_dashboard::server::{self, Options, Server};
use carril_messages::{Command, Message as _};
use serde_json::{Value, json};
use support::car::{Car, Ears, kill_at_once, patient_graph, processes, until};
use support::page::{self, Page, Polled};
use tokio_tungstenite::tungstenite::Message;

const ANY_PORT: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

fn serve(car: &Car, options: Options) -> Server {
    server::start(car.client(), options).expect("the server starts")
}

#[track_caller]
fn until_configured(page: &mut Page, node: &str, field: &str, value: f64) {
    page.have_heard(&format!("{node}.{field} = {value}"), |message| {
        let nodes = message["nodes"].as_array().filter(|_| message["type"] == "graph");
        nodes.into_iter().flatten().any(|each| each["name"] == node && each["config"][field].as_f64() == Some(value))
    });
}

#[test]
fn a_page_sees_what_the_car_sees_and_the_graph_works_for_nobody_else() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let address = server.address();

    let html = page::get(address, "/", "Accept-Encoding: gzip\r\n");
    assert_eq!(html.status, 200, "{html:?}");
    for header in [
        "content-security-policy: default-src 'self'",
        "frame-ancestors 'none'",
        "nosniff",
        "x-frame-options: deny",
        "content-encoding: gzip",
        "cache-control: no-cache",
    ] {
        assert!(html.head.contains(header), "{header}: {}", html.head);
    }
    assert!(page::get(address, "/app.js", "").body.contains("uPlot"), "the whole program of the page");
    assert_eq!(page::get(address, "/../Cargo.toml", "").status, 404, "and nothing else");
    assert_eq!(page::get(address, "/api/session", "").json()["access"]["level"], "control", "on the car itself");

    let mut page = Page::open(address);
    let Some(Ok(hello)) = page.next() else { panic!("the first message is a text") };
    assert_eq!(
        (&hello["type"], &hello["version"], &hello["robot"]),
        (&"hello".into(), &1.into(), &"car1".into()),
        "{hello}"
    );
    assert_eq!((&hello["access"]["level"], &hello["can_log_in"]), (&"control".into(), &false.into()), "{hello}");
    let graph = page.hear_type("graph");
    let lane =
        graph["nodes"].as_array().expect("nodes").iter().find(|node| node["name"] == "lane").expect("it is there");
    assert_eq!(
        (&lane["operator"], &lane["inputs"][0]["from"]),
        (&"lane-detector".into(), &"world/camera".into()),
        "{lane}"
    );
    assert!(lane["schema"]["properties"]["threshold"].is_object() && lane["config"]["threshold"] == 190.0, "{lane}");
    page.have_heard("old lines of the log", |message| message["type"] == "log" && message["time_ms"].is_f64());
    let status = page.hear_type("status");
    assert_eq!(status["nodes"].as_array().map(Vec::len), Some(7), "{status}");
    assert_eq!(
        (&status["link"]["viewers"], &status["link"]["driver"], &status["fault"]),
        (&1.into(), &Value::Null, &Value::Null)
    );
    assert_eq!(server.listening_to(), 0, "nothing was asked for");
    assert_eq!(server.connected().len(), 1, "{:?}", server.connected());

    page.subscribe(&["lane/lane", "world/camera", "decision/state"]);
    let mut origins: HashMap<String, String> = HashMap::new();
    let (mut paired, mut seen) = (false, 0);
    while !paired {
        match page.next().expect("it goes on") {
            Ok(sample) if sample["key"] == "lane/lane" => {
                assert_eq!(sample["message_type"], "carril/LaneEstimate", "{sample}");
                assert!(sample["value"]["threshold"] == 190 && sample["error"].is_null(), "{sample}");
                origins.insert(sample["origin_ms"].to_string(), "estimate".into());
            }
            Ok(_) => {}
            Err(picture) => {
                seen += 1;
                let header = &picture.header;
                assert_eq!((&header["width"], &header["source_width"]), (&320.into(), &640.into()), "{header}");
                let shown = image::load_from_memory(&picture.jpeg).expect("a JPEG");
                assert_eq!(shown.width(), 320, "as wide as it says");
                paired = origins.contains_key(&header["origin_ms"].to_string());
                page.ack(&picture);
            }
        }
        assert!(seen < 500, "an estimate has the very same origin as its image: {origins:?}");
    }

    // Without an answer two images come and no third.
    page.subscribe(&[]);
    page.subscribe(&["world/camera"]);
    page.see();
    // The first may have been on its way since before.
    let second = page.see();
    page.ask(json!({"type": "control", "word": "start"})).expect("an answer passes images that wait");
    page.hear_type("status");
    page.hear_type("status");
    page.ack(&second);
    assert!(page.see().header["seq"].as_u64() > second.header["seq"].as_u64(), "a newer one");

    let pixel = page.ask(json!({"type": "pixel", "key": "world/camera", "x": 0.5, "y": 0.25})).expect("a pixel");
    assert_eq!(
        (&pixel["x"], &pixel["y"], pixel["hsv"].as_array().map(Vec::len)),
        (&320.into(), &120.into(), Some(3)),
        "{pixel}"
    );
    let nothing = page.ask(json!({"type": "pixel", "key": "lane/lane", "x": 0.5, "y": 0.25})).expect_err("no image");
    assert!(nothing.contains("carril/LaneEstimate"), "{nothing}");

    page.subscribe(&[]);
    until("nothing is listened to while nobody looks", || server.listening_to() == 0);
    drop(page);
    until("the page has gone", || server.connected().is_empty());
    drop(server);
    car.end();
}

#[test]
fn a_second_connection_carries_the_view_and_the_first_takes_it_back() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let address = server.address();
    let mut page = Page::open(address);
    let hello = page.hear_type("hello");
    page.subscribe(&["world/camera", "lane/lane"]);
    page.see();

    for wrong in [json!({"view": "00"}), json!({"view": 3}), json!({})] {
        let mut other = Page::open_view(&wrong, address, None);
        other.until_it_ends();
    }
    let mut view = Page::open_view(&hello, address, None);
    let (mut pictures, mut estimates) = (0, 0);
    while pictures < 5 || estimates < 5 {
        match view.next().expect("it goes on") {
            Ok(sample) => estimates += u32::from(sample["key"] == "lane/lane"),
            Err(picture) => {
                let shown = image::load_from_memory(&picture.jpeg).expect("whole, though it came in pieces");
                assert!(shown.width() <= 320, "{}", picture.header);
                page.ack(&picture);
                pictures += 1;
            }
        }
    }
    // From here on the first connection brings answers and news only.
    page.hear_type("status");
    page.set_patience(std::time::Duration::from_millis(100));
    while let Polled::Came(_) = page.poll() {}
    page.heard.clear();
    page.set_patience(support::HANGS_AFTER);
    page.hear_type("status");
    assert!(page.heard.iter().all(|message| message["type"] != "sample"), "{:?}", page.heard);
    drop(view);
    page.see();
    page.hear_type("sample");
    drop((page, server));
    car.end();
}

#[test]
fn a_page_changes_the_car_and_the_log_says_who() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let mut page = Page::open(server.address());
    page.hear_type("graph");

    let receipt = page.ask(json!({"type": "set", "node": "lane", "values": {"threshold": 180}})).expect("a receipt");
    assert_eq!((&receipt["outcome"], &receipt["what"]), (&"done".into(), &"set".into()), "{receipt}");
    page.have_heard("the receipt", |message| message["type"] == "receipt" && message["receipt"]["node"] == "lane");
    until_configured(&mut page, "lane", "threshold", 180.0);
    assert_eq!(car.sandbox.carril(&["get", "lane", "threshold"]).expect(0).trim(), "180", "in force");
    let refused = page.ask(json!({"type": "set", "node": "lane", "values": {"threshold": 300}})).expect("a receipt");
    assert!(refused["outcome"] == "refused" && refused["reason"].to_string().contains("0 to 255"), "{refused}");

    let restarted = page.ask(json!({"type": "restart", "node": "sectors"})).expect("a receipt");
    assert_eq!(restarted["outcome"], "done", "{restarted}");
    let swapped = page
        .ask(json!({"type": "swap", "node": "lane", "operator": null, "values": {"threshold": 170}, "fresh": false}));
    assert_eq!(swapped.as_ref().expect("a receipt")["outcome"], "done", "{swapped:?}");
    let back = page.ask(json!({"type": "rollback", "node": "lane"})).expect("a receipt");
    assert_eq!(back["outcome"], "done", "{back}");
    let unknown = page.ask(json!({"type": "swap", "node": "lane", "operator": "line-detector"})).expect("a receipt");
    assert_eq!(unknown["outcome"], "refused", "{unknown}");

    page.ask(json!({"type": "pub", "key": "decision/goal", "value": {"cruise": {"speed_m_s": 0.2}}})).expect("a goal");
    for (key, value, says) in [
        ("decision/goal", json!({"cruise": {"speed": 1}}), "speed"),
        ("decision/lane", json!({}), "no input that is open to people"),
        ("@/estop", json!({}), "no input that is open to people"),
    ] {
        let error = page.ask(json!({"type": "pub", "key": key, "value": value})).expect_err(key);
        assert!(error.contains(says), "{key}: {error}");
    }

    let heard = page.ask(json!({"type": "control", "word": "stop"})).expect("it is heard");
    assert!(heard["nodes"].to_string().contains("decision") && heard["errors"] == json!([]), "{heard}");
    car.until_it("stops", "idle");
    page.ask(json!({"type": "control", "word": "estop"})).expect("it is heard");
    car.until_it("is stopped", "e-stop");
    page.ask(json!({"type": "control", "word": "reset"})).expect("it is heard");
    car.until_it("is reset", "idle");
    page.have_heard("the log names it", |message| {
        let text = message["text"].as_str().unwrap_or_default();
        message["process"] == "_dashboard" && text == "somebody at 127.0.0.1: reset"
    });
    let said =
        |text: &str| page.heard.iter().any(|message| message["text"].as_str().is_some_and(|said| said.contains(text)));
    assert!(said("set lane threshold=180") && said("127.0.0.1: estop"), "each change is in the log");
    drop((page, server));
    car.end();
}

#[test]
fn a_page_hears_of_other_limits_what_fits_and_what_flows() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let mut page = Page::open(server.address());
    let hello = page.hear_type("hello");
    let graph = page.hear_type("graph");
    let fitting = |node: &str| {
        let nodes = graph["nodes"].as_array().expect("nodes");
        nodes.iter().find(|each| each["name"] == node).map(|node| node["fitting"].clone()).expect("that node")
    };
    assert_eq!(
        (fitting("mcu"), fitting("lane")),
        (json!(["sim-avr"]), json!(["lane-lines"])),
        "operators with the same ports"
    );
    let refused = page.ask(json!({"type": "swap", "node": "lane", "operator": "decision"})).expect("a receipt");
    assert!(refused["reason"].to_string().contains("does not fit as node `lane`"), "and no others: {refused}");

    let before = hello["drive"]["max_speed_m_s"].as_f64().expect("it can be driven");
    let limit = json!({"manual_max_speed_m_s": before / 2.0});
    let set = page.ask(json!({"type": "set", "node": "decision", "values": limit})).expect("a receipt");
    assert_eq!(set["outcome"], "done", "{set}");
    let terms = page.have_heard("other limits", |message| message["type"] == "drive_terms");
    assert_eq!(terms["drive"]["max_speed_m_s"], before / 2.0, "{terms}");
    let logged = |message: &Value| message["type"] == "log" && message["text"] == "set done";
    page.have_heard("the receipt in words", logged);

    let status = page.hear("what flows", |message| {
        let nodes = message["nodes"].as_array().filter(|_| message["type"] == "status").into_iter().flatten();
        nodes.into_iter().any(|node| node["node"] == "world" && node["outputs"][0]["bytes"].as_u64() > Some(0))
    });
    let camera = &status["nodes"][0]["outputs"][0];
    let (sent, bytes) = (camera["sent"].as_u64().expect("a number"), camera["bytes"].as_u64().expect("a number"));
    assert!(camera["port"] == "camera" && bytes % (640 * 480 * 3) == 0, "whole images: {camera}");
    assert!(bytes <= sent * 640 * 480 * 3, "none that was not sent: {camera}");
    drop((page, server));
    car.end();
}

#[test]
fn a_page_starts_a_node_that_is_down_again() {
    let never = ("    deadline_ms: 1000\n", "    deadline_ms: 1000\n    restart: { policy: never }\n");
    let car = Car::launch(&patient_graph(&[never]));
    let server = serve(&car, Options::local(ANY_PORT));
    let mut page = Page::open(server.address());
    let lane = processes(&car.sandbox).into_iter().find(|(_, name)| name == "lane").expect("it runs").0;
    kill_at_once(lane);
    let in_state = |message: &Value, state: &str| {
        let nodes = message["nodes"].as_array().filter(|_| message["type"] == "status").into_iter().flatten();
        nodes.into_iter().any(|node| node["node"] == "lane" && node["state"] == state)
    };
    page.hear("it is down", |message| in_state(message, "stopped"));
    let set = page.ask(json!({"type": "set", "node": "lane", "values": {"threshold": 180}})).expect("a receipt");
    assert!(set["reason"].to_string().contains("carril restart lane"), "what to do is said: {set}");
    let restarted = page.ask(json!({"type": "restart", "node": "lane"})).expect("a receipt");
    assert_eq!(restarted["outcome"], "done", "{restarted}");
    page.hear("it runs", |message| in_state(message, "running"));
    page.subscribe(&["lane/lane"]);
    page.hear_type("sample");
    drop((page, server));
    car.end();
}

/// A request that comes in drops for ever.
#[test]
fn whoever_never_ends_a_request_is_shown_out() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let address = server.address();
    let mut drops = TcpStream::connect(address).expect("it listens");
    drops.write_all(format!("GET / HTTP/1.1\r\nHost: {address}\r\n").as_bytes()).expect("it reads");
    let mut body = TcpStream::connect(address).expect("it listens");
    let head = format!(
        "POST /api/login HTTP/1.1\r\nHost: {address}\r\nContent-Type: application/json\r\nContent-Length: 4000\r\n\r\n"
    );
    body.write_all(head.as_bytes()).expect("it reads");
    for (name, stream, drop) in [("headers", &mut drops, &b"X-A: b\r\n"[..]), ("a body", &mut body, b" ")] {
        stream.set_read_timeout(Some(std::time::Duration::from_millis(100))).expect("a socket has timeouts");
        let mut answer = Vec::new();
        until(&format!("{name} that never end are given up"), || {
            assert_eq!(page::get(address, "/api/session", "").status, 200, "others are served meanwhile");
            let gone = stream.write_all(drop).is_err();
            let mut more = [0; 1024];
            match stream.read(&mut more) {
                Ok(0) => true,
                Ok(read) => {
                    answer.extend_from_slice(&more[..read]);
                    false
                }
                // Reset: we went on writing to what was closed.
                Err(error) => gone || !matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut),
            }
        });
        let answer = String::from_utf8_lossy(&answer);
        assert!(!answer.contains(" 200 "), "{name}: it gets nothing: {answer}");
    }
    drop(server);
    car.end();
}

/// A server that lets nobody control without a key, and its keys.
fn guarded(car: &Car) -> (Server, Arc<RwLock<Access>>, String) {
    let access = Access::open(&car.sandbox.path().join("config"), "car1").expect("a folder");
    let (identity, _) = access.server_identity(&["localhost".into()], &[]).expect("a certificate");
    let authority = identity.authority.clone();
    let access = Arc::new(RwLock::new(access));
    let options = Options {
        access: Some(Arc::clone(&access)),
        local_control: false,
        certificate: Some(identity),
        ..Options::local(ANY_PORT)
    };
    (serve(car, options), access, authority)
}

#[test]
fn without_a_key_a_page_looks_on_and_stops_and_with_one_it_controls_until_it_is_revoked() {
    let car = Car::launch(&patient_graph(&[]));
    let (server, access, authority) = guarded(&car);
    let address = server.address();
    let locked = |access: &RwLock<Access>| access.read().unwrap_or_else(PoisonError::into_inner).grants().len();
    assert_eq!(locked(&access), 0, "nobody has a key yet");

    let mut reader = Page::open(address);
    let hello = reader.hear_type("hello");
    assert_eq!(
        (&hello["access"]["level"], &hello["can_log_in"], &hello["estop_open"]),
        (&"read".into(), &true.into(), &true.into())
    );
    for question in [
        json!({"type": "control", "word": "start"}),
        json!({"type": "control", "word": "stop"}),
        json!({"type": "control", "word": "reset"}),
        json!({"type": "set", "node": "lane", "values": {"threshold": 1}}),
        json!({"type": "swap", "node": "lane"}),
        json!({"type": "restart", "node": "lane"}),
        json!({"type": "rollback", "node": "lane"}),
        json!({"type": "pub", "key": "decision/goal", "value": {"cruise": {"speed_m_s": 0.2}}}),
    ] {
        let error = reader.ask(question.clone()).expect_err("read only");
        assert!(error.contains("needs control") && error.contains("carril grant"), "{question}: {error}");
    }
    reader.say(&json!({"type": "drive", "seq": 1, "steering_rad": 0, "speed_m_s": 0.1, "seen_ms": hello["time_ms"]}));
    let ack = reader.hear_type("drive_ack");
    assert!(ack["applied"] == false && ack["error"].to_string().contains("needs control"), "{ack}");
    reader.subscribe(&["world/camera"]);
    reader.see();
    reader.ask(json!({"type": "control", "word": "estop"})).expect("the e-stop is open to all");
    car.until_it("is stopped", "e-stop");

    let key = access.write().unwrap_or_else(PoisonError::into_inner).grant("laptop-1").expect("granted");
    let login = json!({"name": "laptop-1", "token": key.token});
    let answer = page::post(address, Some(&authority), "/api/login", &login);
    assert_eq!((answer.status, &answer.json()["access"]["level"]), (200, &"control".into()), "{answer:?}");
    for flag in ["httponly", "samesite=strict", "secure"] {
        assert!(answer.head.contains(flag), "{flag}: {}", answer.head);
    }
    assert!(!answer.body.contains(&key.token), "the token does not come back");
    let cookie = answer.cookie();
    let mut holder = Page::try_open(address, Some(&authority), &[("cookie", &cookie)]).expect("over TLS");
    assert_eq!(
        holder.hear_type("hello")["access"],
        json!({"level": "control", "name": "laptop-1", "why": "a granted key"})
    );
    holder.ask(json!({"type": "control", "word": "reset"})).expect("with a key");
    car.until_it("is reset", "idle");
    holder.have_heard("the log", |message| message["text"] == "laptop-1: reset");
    assert!(server.connected().iter().any(|each| each.name.as_deref() == Some("laptop-1")), "{:?}", server.connected());

    access.write().unwrap_or_else(PoisonError::into_inner).revoke("laptop-1").expect("revoked");
    let error = holder.ask(json!({"type": "control", "word": "start"})).expect_err("at once");
    assert!(error.contains("was revoked"), "{error}");
    let told = holder.have_heard("the page is told", |message| message["type"] == "access");
    assert_eq!(told["access"]["level"], "read", "{told}");
    assert_eq!(page::post(address, Some(&authority), "/api/login", &login).status, 401, "it opens nothing any more");

    let wrong = json!({"name": "laptop-1", "token": "guess"});
    let answers: Vec<u16> = (0..6).map(|_| page::post(address, None, "/api/login", &wrong).status).collect();
    assert_eq!(
        answers,
        [401, 401, 401, 401, 429, 429],
        "after five wrong ones, the revoked one among them, guessing ends"
    );
    drop((reader, holder, server));
    car.end();
}

#[test]
fn strangers_and_garbage_change_nothing() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let address = server.address();
    let own = format!("http://{address}");
    for (headers, status) in [
        (vec![("origin", "http://evil.example")], 403),
        (vec![("origin", "null")], 403),
        (vec![("host", "evil.example")], 403),
        (vec![("host", "evil.example"), ("origin", "http://evil.example")], 403),
    ] {
        assert_eq!(Page::try_open(address, None, &headers).err(), Some(status), "{headers:?}");
    }
    assert_eq!(page::get(address, "/", "Origin: http://evil.example\r\n").status, 403, "not even the page");
    drop(Page::try_open(address, None, &[("origin", &own)]).expect("its own page"));
    assert_eq!(
        page::post(address, None, "/api/login", &json!({"name": "a", "token": "b"})).status,
        403,
        "no log-in here"
    );

    let mut page = Page::open(address);
    for garbage in ["", "{", "\u{0}", r#"{"type":"dance"}"#, r#"{"type":"set","id":1}"#, "[[[[[[[["] {
        page.say_raw(Message::text(garbage));
        assert!(page.hear_type("refused")["error"].is_string(), "`{garbage}`");
    }
    page.say_raw(Message::binary(vec![0; 100]));
    page.hear_type("refused");
    page.ask(json!({"type": "control", "word": "start"})).expect("it is still served");
    for _ in 7..20 {
        page.say_raw(Message::text("garbage"));
    }
    assert!(page.hear_type("bye")["reason"].to_string().contains("cannot be read"), "after 20");
    page.until_it_ends();

    let mut large = Page::open(address);
    large.say_raw(Message::text(format!("{{\"type\":\"ping\",\"id\":1,\"x\":\"{}\"}}", "x".repeat(70_000))));
    large.until_it_ends();

    for bytes in [&b"\x16\x03\x01garbage"[..], b"\x00", b"GET / HTTP/9.9\r\n\r\n", &[0xff; 5000]] {
        let mut stream = TcpStream::connect(address).expect("it listens");
        let _ = stream.write_all(bytes);
        let _ = stream.shutdown(std::net::Shutdown::Write);
        let _ = stream.read_to_end(&mut Vec::new());
    }

    until("those have gone", || server.connected().is_empty());
    let mut pages: Vec<Page> = (0..64).map(|_| Page::open(address)).collect();
    until("all are in", || server.connected().len() == 64);
    assert_eq!(Page::try_open(address, None, &[]).err(), Some(503), "the 65th has no place");
    for page in &mut pages {
        page.subscribe(&["world/camera", "lane/lane"]);
    }
    for page in &mut pages {
        page.see();
    }
    assert_eq!(server.listening_to(), 2, "each port once for all of them");
    drop(pages);
    until("places are free again", || server.connected().is_empty());
    Page::open(address).hear_type("status");
    car.assert_in_the_lane();
    drop(server);
    car.end();
}

#[test]
fn pages_are_told_why_the_server_ends() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let mut pages: Vec<Page> = (0..40).map(|_| Page::open(server.address())).collect();
    for page in &mut pages {
        page.hear_type("graph");
    }
    let ending = std::thread::spawn(move || server.close("the graph has ended"));
    for page in &mut pages {
        assert_eq!(page.hear_type("bye")["reason"], "the graph has ended", "every one of them");
        page.until_it_ends();
    }
    ending.join().expect("it ends");
    car.end();
}

/// Commands on a port.
fn hear_commands(car: &Car, port: &str) -> Ears<Command> {
    car.hear(port, |header, payload| Command::decode(&header.meta, payload).expect("a command"))
}

/// Drives again and again, as a held key does, until something has happened.
#[track_caller]
fn drive_until(page: &mut Page, what: &str, seq: &mut u64, mut reached: impl FnMut() -> bool) {
    until(what, || {
        *seq += 1;
        page.drive(*seq, 0.1, 0.3);
        reached()
    });
}

#[test]
fn a_car_that_is_driven_by_hand_stops_when_the_page_goes_or_falls_silent() {
    let car = Car::launch(&patient_graph(&[]));
    let server = serve(&car, Options::local(ANY_PORT));
    let (asked, done) = (hear_commands(&car, "decision/manual"), hear_commands(&car, "actuator/command"));
    let moves = || done.last().is_some_and(|command| command.speed_m_s > 0.1 && command.steering_rad > 0.05);
    let told_to_stop = || asked.last() == Some(Command::default());

    let mut page = Page::open(server.address());
    let hello = page.hear_type("hello");
    let drive = &hello["drive"];
    assert_eq!(
        (&drive["node"], &drive["port"], &drive["lease_ms"]),
        (&"decision".into(), &"manual".into(), &300.into()),
        "{hello}"
    );
    let mut seq = 0;
    drive_until(&mut page, "it is driven by hand", &mut seq, || {
        moves() && asked.last() == Some(Command { steering_rad: 0.1, speed_m_s: 0.3 })
    });

    let limit = drive["max_speed_m_s"].as_f64().expect("a limit");
    for (steering, speed, says) in [(0.0, limit * 1.1, "allowed is up to"), (1.0, 0.1, "allowed is up to")] {
        let ack = page.drive(0, steering, speed);
        assert!(ack["applied"] == false && ack["error"].to_string().contains(says), "{ack}");
    }
    page.say(
        &json!({"type": "drive", "seq": 1_000_000, "steering_rad": null, "speed_m_s": 0.1, "seen_ms": page.seen_ms}),
    );
    assert_eq!(page.hear("no number", |value| value["seq"] == 1_000_000)["error"], "not a number");
    page.say(&json!({"type": "drive", "seq": 1_000_001, "steering_rad": 0, "speed_m_s": 0.1, "seen_ms": page.seen_ms - 1000.0}));
    let old = page.hear("too old", |value| value["seq"] == 1_000_001);
    assert!(old["applied"] == false && old["error"].to_string().contains("too old: "), "{old}");

    let mut other = Page::open(server.address());
    let greeting = other.hear_type("hello");
    assert!(greeting["time_ms"].is_f64(), "{greeting}");
    let mut refused = Value::Null;
    drive_until(&mut page, "another is refused", &mut seq, || {
        refused = other.drive(1, 0.0, 0.1);
        refused["error"].to_string().contains("somebody at 127.0.0.1 drives")
    });
    let mut answer = Ok(Value::Null);
    drive_until(&mut page, "who is named", &mut seq, || {
        answer = other.ask(json!({"type": "set", "node": "lane", "values": {"threshold": 185}}));
        answer.is_err()
    });
    assert!(answer.as_ref().is_err_and(|error| error.contains("drives by hand")), "{answer:?}");
    drive_until(&mut page, "it moves", &mut seq, moves);
    // As a closed lid does: no goodbye.
    drop(page);
    until("the car was told to stop", told_to_stop);
    until("it stands", || done.last().is_some_and(|command| command.speed_m_s == 0.0));
    let freed = other.have_heard("the wheel is free", |message| {
        message["text"].as_str().is_some_and(|text| text.contains("drives no more"))
    });
    assert_eq!(freed["process"], "_dashboard", "{freed}");

    drive_until(&mut other, "the other drives", &mut seq, moves);
    until("silence has stopped it, too", told_to_stop);
    until("it stands", || done.last().is_some_and(|command| command.speed_m_s == 0.0));
    let status =
        other.hear("nobody drives", |message| message["type"] == "status" && message["link"]["driver"].is_null());
    assert_eq!(status["link"]["viewers"], 1, "{status}");

    drive_until(&mut other, "it is driven once more", &mut seq, moves);
    other.say(&json!({"type": "drive_end"}));
    until("letting go stops it", told_to_stop);
    drop((other, asked, done));
    drop(server);
    car.end();
}
