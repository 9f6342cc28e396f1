//! Those who look at a car from afar, as processes of their own: a tool with a key, and pages of the dashboard. They note when each sample
//! came and when it was captured, on the clock that all processes of this machine share, and how long answers took.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_dashboard::access::KeyFile;
use carril_runtime::client::Client;
use carril_runtime::messages::{Header, Message as _, Stamp};
use carril_runtime::transport::zenoh::FarOptions;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::measure::{monotonic_ns, quantile};
use super::page::{self, Page, Polled};

/// What a driver's hands ask for, and how often.
const PRESSED_EVERY: Duration = Duration::from_millis(20);
/// A lone request has nothing after it that would reveal that it was lost.
const LONE_EVERY: Duration = Duration::from_millis(250);

/// What one of them saw and asked. Times are those of `CLOCK_MONOTONIC`, ns.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Seen {
    /// Arrival and capture of each image.
    pub images: Vec<(u64, u64)>,
    /// Arrival and capture of each other sample.
    pub data: Vec<(u64, u64)>,
    /// When each question was asked, and when its answer came.
    pub answers: Vec<(u64, u64)>,
    /// Memory of the process at the end, kB.
    pub memory_kb: u64,
}

impl Seen {
    /// How old the newest image was at each moment between two times, ms: looked at every 5 ms.
    pub fn image_ages_ms(&self, from_ns: u64, to_ns: u64) -> Vec<f64> {
        let moments = (from_ns..to_ns).step_by(5_000_000);
        moments.filter_map(|now| self.newest_before(now).map(|captured| ms(now.saturating_sub(captured)))).collect()
    }

    fn newest_before(&self, now: u64) -> Option<u64> {
        self.images.iter().filter(|(came, _)| *came <= now).map(|(_, captured)| *captured).max()
    }

    /// When an image came after this time that was no older than `fresh`; ns after it.
    pub fn live_again_ns(&self, after_ns: u64, fresh: Duration) -> Option<u64> {
        let fresh = fresh.as_nanos() as u64;
        let live = self.images.iter().filter(|(came, captured)| *came > after_ns && came - captured <= fresh);
        live.map(|(came, _)| came - after_ns).min()
    }

    /// How long answers took to questions that were asked between two times, ms.
    pub fn round_trips_ms(&self, from_ns: u64, to_ns: u64) -> Vec<f64> {
        let asked = self.answers.iter().filter(|(asked, _)| (from_ns..to_ns).contains(asked));
        asked.map(|(asked, came)| ms(came - asked)).collect()
    }
}

fn ms(ns: u64) -> f64 {
    ns as f64 * 1e-6
}

/// Plays `remote-tool ENDPOINT KEY SECONDS`, `remote-page ADDRESS KEY SECONDS` or `pages ADDRESS COUNT SECONDS`.
pub fn play(arguments: &[String]) {
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let seconds = |text: &str| Duration::from_secs_f64(text.parse().expect("seconds"));
    let mut seen = match words[..] {
        ["remote-tool", endpoint, key, length] => tool(endpoint, &read_key(key), seconds(length)),
        ["remote-page", address, key, length] => {
            let address = address.parse().expect("an address");
            a_page(address, &read_key(key), seconds(length))
        }
        ["pages", address, count, length] => {
            let address = address.parse().expect("an address");
            pages(address, count.parse().expect("a number"), seconds(length))
        }
        _ => panic!("no viewer is played so: {words:?}"),
    };
    seen.memory_kb = memory_kb(std::process::id());
    println!("{}", serde_json::to_string(&seen).expect("it is JSON"));
}

fn read_key(path: &str) -> KeyFile {
    KeyFile::read(Path::new(path)).expect("a key")
}

/// Resident memory of a process, kB.
pub fn memory_kb(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

/// `carril echo` of the camera and more, and now and then `carril pub`.
fn tool(endpoint: &str, key: &KeyFile, length: Duration) -> Seen {
    let options = FarOptions { endpoint: endpoint.to_owned(), identity: Some(key.identity()) };
    let client = Client::open_far(&options, Some(&key.id), None, Duration::from_secs(20)).expect("the car answers");
    let zero = client.file().clock_zero;
    let seen: Arc<Mutex<Seen>> = Arc::default();
    let mut guards = Vec::new();
    for (node, port) in
        [("world", "camera"), ("lane", "lane"), ("world", "scan"), ("decision", "state"), ("bridge", "telemetry")]
    {
        let (into, is_image) = (Arc::clone(&seen), port == "camera");
        let hear = move |header: Header, _, _| {
            let captured = header.origins.oldest().unwrap_or(header.stamp);
            let came = (monotonic_ns(), on_the_clock(captured, zero));
            let mut seen = into.lock().unwrap_or_else(PoisonError::into_inner);
            if is_image { seen.images.push(came) } else { seen.data.push(came) }
        };
        guards.push(client.subscribe(node, port, hear).expect("a subscription"));
    }
    // Who changes something does it from another terminal: with a link of its own.
    let other = Client::open_far(&options, Some(&key.id), None, Duration::from_secs(20)).expect("the car answers");
    println!("ready");
    let mut goal = other.publisher("decision", "goal", carril_runtime::messages::Goal::TYPE);
    let begun = Instant::now();
    while begun.elapsed() < length {
        std::thread::sleep(LONE_EVERY);
        let asked = monotonic_ns();
        let message = carril_runtime::messages::Goal::Cruise { speed_m_s: 0.5 }.encode().expect("it encodes");
        // In an outage there is no answer.
        if goal.put(message).is_ok() {
            let answer = (asked, monotonic_ns());
            seen.lock().unwrap_or_else(PoisonError::into_inner).answers.push(answer);
        }
    }
    drop(guards);
    std::mem::take(&mut *seen.lock().unwrap_or_else(PoisonError::into_inner))
}

fn on_the_clock(stamp: Stamp, zero: Stamp) -> u64 {
    stamp.since(zero).as_nanos() as u64
}

/// What the page asks to see when it is open.
fn look_at(page: &mut Page) {
    let image = json!({"key": "world/camera", "max_hz": 30, "width": 480, "quality": 70});
    let data = ["lane/lane", "sectors/sectors", "decision/state", "actuator/command", "bridge/telemetry", "world/scan"];
    let data = data.iter().map(|key| json!({"key": key, "max_hz": 30}));
    let keys: Vec<_> = std::iter::once(image).chain(data).collect();
    page.say(&json!({"type": "subscribe", "keys": keys}));
}

/// A page whose user drives: it asks as often as a held key does, and is answered before all else. As the page in the browser does, it
/// has a second connection for its view, and another pair is tried when nothing was heard for a while.
fn a_page(address: SocketAddr, key: &KeyFile, length: Duration) -> Seen {
    let authority = key.identity().authority;
    let login = json!({"name": key.name, "token": key.token});
    let answer = page::post(address, Some(&authority), "/api/login", &login);
    assert_eq!(answer.status, 200, "{answer:?}");
    let cookie = answer.cookie();
    let open = || Connected::open(address, &authority, &cookie);
    let mut connected = open();
    println!("ready");
    let mut notes = Notes::default();
    let (begun, mut next) = (Instant::now(), Instant::now());
    let mut others: Vec<std::sync::mpsc::Receiver<Connected>> = Vec::new();
    let (mut heard, mut tried) = (Instant::now(), Instant::now());
    std::thread::scope(|scope| {
        while begun.elapsed() < length {
            if Instant::now() >= next {
                next += PRESSED_EVERY;
                connected.page.say(&json!({"type": "ping", "id": notes.asked.len()}));
                notes.asked.push(monotonic_ns());
            }
            if connected.poll(&mut notes) {
                heard = Instant::now();
                others.clear();
            }
            if heard.elapsed() > SILENCE && tried.elapsed() > TRY_AGAIN {
                tried = Instant::now();
                let (sender, receiver) = std::sync::mpsc::channel();
                others.push(receiver);
                // Those that come too late find nobody who waits for them.
                scope.spawn(move || drop(sender.send(open())));
            }
            if let Some(other) = others.iter().find_map(|other| other.try_recv().ok()) {
                connected = other;
                (heard, next) = (Instant::now(), Instant::now());
                others.clear();
            }
        }
    });
    notes.into_seen()
}

/// As the page has it.
const SILENCE: Duration = Duration::from_millis(2500);
const TRY_AGAIN: Duration = Duration::from_millis(500);

/// The two connections of a page.
struct Connected {
    page: Page,
    view: Page,
}

impl Connected {
    fn open(address: SocketAddr, authority: &str, cookie: &str) -> Self {
        let mut page = Page::try_open(address, Some(authority), &[("cookie", cookie)]).expect("it is let in");
        let hello = page.hear_type("hello");
        let mut view = Page::open_view(&hello, address, Some(authority));
        page.set_patience(Duration::from_millis(1));
        view.set_patience(Duration::from_millis(1));
        look_at(&mut page);
        Self { page, view }
    }

    /// Whether anything was heard.
    fn poll(&mut self, notes: &mut Notes) -> bool {
        let mut heard = false;
        for at_view in [false, true] {
            let came = if at_view { self.view.poll() } else { self.page.poll() };
            let Polled::Came(came) = came else { continue };
            heard = true;
            match came {
                Ok(text) => notes.text(&text),
                Err(picture) => {
                    self.page.ack(&picture);
                    notes.images.extend(picture.header["origin_ms"].as_f64().map(|at| (monotonic_ns(), at)));
                }
            }
        }
        self.page.heard.clear();
        self.view.heard.clear();
        heard
    }
}

/// What a page has seen, on two clocks: the car's begins somewhere else than the machine's. Their difference comes from the answers.
#[derive(Default)]
struct Notes {
    seen: Seen,
    images: Vec<(u64, f64)>,
    data: Vec<(u64, f64)>,
    asked: Vec<u64>,
    /// By the quickest answer: how long it took, ns; car's clock less the machine's, ms.
    offset: Option<(u64, f64)>,
}

impl Notes {
    fn text(&mut self, text: &serde_json::Value) {
        let now = monotonic_ns();
        match text["type"].as_str() {
            Some("pong") => {
                let at = text["id"].as_u64().map_or(0, |id| self.asked[id as usize]);
                self.seen.answers.push((at, now));
                let (took, time_ms) = (now - at, text["time_ms"].as_f64().unwrap_or(0.0));
                if self.offset.is_none_or(|(least, _)| took < least) {
                    self.offset = Some((took, time_ms - ms(at + took / 2)));
                }
            }
            Some("sample") => self.data.extend(text["origin_ms"].as_f64().map(|captured| (now, captured))),
            _ => {}
        }
    }

    fn into_seen(mut self) -> Seen {
        let offset_ms = self.offset.map_or(f64::NAN, |(_, offset_ms)| offset_ms);
        let captured = |(came, time_ms): &(u64, f64)| (*came, ((time_ms - offset_ms).max(0.0) * 1e6) as u64);
        self.seen.images = self.images.iter().map(captured).collect();
        self.seen.data = self.data.iter().map(captured).collect();
        self.seen
    }
}

/// Many pages on this machine, which do no more than they must.
fn pages(address: SocketAddr, count: usize, length: Duration) -> Seen {
    println!("ready");
    let watch = || {
        let mut page = Page::open(address);
        let hello = page.hear_type("hello");
        let mut view = Page::open_view(&hello, address, None);
        look_at(&mut page);
        let (begun, mut images) = (Instant::now(), Vec::new());
        while begun.elapsed() < length {
            match view.next() {
                Some(Err(picture)) => {
                    page.ack(&picture);
                    images.push((monotonic_ns(), 0));
                }
                Some(Ok(_)) => view.heard.clear(),
                None => break,
            }
        }
        images
    };
    let images = std::thread::scope(|scope| {
        let watching: Vec<_> = (0..count).map(|_| scope.spawn(watch)).collect();
        watching.into_iter().flat_map(|page| page.join().expect("a page does not panic")).collect()
    });
    Seen { images, ..Seen::default() }
}

/// Median and 99th percentile.
pub fn typical(values: &[f64]) -> [(&'static str, f64); 2] {
    [("median", quantile(values, 0.5)), ("p99", quantile(values, 0.99))]
}
