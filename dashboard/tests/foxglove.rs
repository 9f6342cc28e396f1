//! The Foxglove server with a real graph in real processes, and viewers that speak the protocol over a bare WebSocket.

use std::collections::{HashMap, VecDeque};
use std::io::Write;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use carril_dashboard::foxglove::{Options, Server, start};
use carril_messages::{Header, Message as _, Origins, Stamp};
use carril_runtime::client::{Client, find_run};
use carril_runtime::control_plane::{ApplyRequest, LogLevel, Outcome, SwapTerms};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::supervisor::plan::Plan;
use carril_runtime::supervisor::{self, Running, Supervisor};
use foxglove::Decode;
use foxglove::messages::{
    CompressedImage, FrameTransforms, ImageAnnotations, LaserScan, Log, PoseInFrame, SceneUpdate,
};
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::http::HeaderValue;
use tungstenite::{Message, WebSocket};

#[path = "support/operators.rs"]
mod operators;

/// Longer than this nothing takes, even on an overloaded machine.
const HANGS_AFTER: Duration = Duration::from_secs(60);

/// Many times more reports than it takes until a change shows in them.
const MOST_REPORTS: u32 = 50;

const GRAPH: &str = "  world: { operator: world }
  eye: { operator: eye, inputs: { image: world/camera } }
  spare: { operator: world, config: { width: 1280 } }
";

struct Rig {
    running: Running,
    client: Arc<Client>,
    server: Server,
    _dir: tempfile::TempDir,
}

fn graph(nodes: &str) -> Graph {
    let text = format!("robot: car\nnodes:\n{nodes}");
    Graph::parse(text, Path::new("test.yaml"), &operators::registry(), &ReadOptions::default())
        .unwrap_or_else(|problems| panic!("the graph is valid: {problems:?}"))
}

impl Rig {
    fn start(may_control: bool) -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let program = (PathBuf::from(env!("CARGO_BIN_EXE_carril-dashboard-test-host")), vec!["process".to_owned()]);
        let runs_dir = Some(dir.path().to_owned());
        let options = supervisor::Options { program: Some(program), runs_dir, ..supervisor::Options::default() };
        let running = Supervisor::start(&graph(GRAPH), &operators::registry(), &options).expect("the graph starts");
        let client = Client::open(find_run(dir.path(), None).expect("it runs")).expect("it can be reached");
        let client = Arc::new(client);
        let anywhere = "127.0.0.1:0".parse().expect("an address");
        let options = Options { may_control, ..Options::new(anywhere) };
        let server = start(Arc::clone(&client), options).expect("a free port");
        Self { running, client, server, _dir: dir }
    }

    fn viewer(&self) -> Viewer {
        Viewer::connect(&self.server)
    }

    /// The threshold in force, as the graph says.
    fn threshold(&self) -> Value {
        let graph = self.client.graph().expect("the supervisor answers");
        graph.nodes.iter().find(|node| node.name == "eye").expect("it runs").config["threshold"].clone()
    }

    fn end(self) {
        self.server.stop();
        self.running.stop();
        self.running.wait().expect("an orderly end");
    }
}

/// Somebody who looks.
struct Viewer {
    socket: WebSocket<TcpStream>,
    /// Announced channels by topic.
    channels: HashMap<String, Value>,
    next_subscription: u32,
    /// Data that came while something else was waited for.
    held: VecDeque<(u32, u64, Vec<u8>)>,
}

/// What a viewer hears.
enum Heard {
    Text(Value),
    Data { subscription: u32, time: u64, bytes: Vec<u8> },
    Closed,
}

impl Viewer {
    fn connect(server: &Server) -> Self {
        let mut request = server.url().into_client_request().expect("an address");
        request.headers_mut().insert("sec-websocket-protocol", HeaderValue::from_static("foxglove.sdk.v1"));
        let stream = TcpStream::connect(server.address()).expect("it listens");
        stream.set_read_timeout(Some(HANGS_AFTER)).expect("a timeout can be set");
        let (socket, _) = tungstenite::client(request, stream).expect("it speaks the protocol");
        Self { socket, channels: HashMap::new(), next_subscription: 0, held: VecDeque::new() }
    }

    fn say(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).expect("the server is there");
    }

    fn hear(&mut self) -> Heard {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => {
                    let said: Value = serde_json::from_str(text.as_str()).expect("the server speaks JSON");
                    match said["op"].as_str() {
                        Some("advertise") => {
                            for channel in said["channels"].as_array().expect("channels") {
                                let topic = channel["topic"].as_str().expect("a topic").to_owned();
                                self.channels.insert(topic, channel.clone());
                            }
                        }
                        Some("unadvertise") => {
                            let gone = said["channelIds"].as_array().expect("ids").clone();
                            self.channels.retain(|_, channel| !gone.contains(&channel["id"]));
                        }
                        _ => {}
                    }
                    return Heard::Text(said);
                }
                Ok(Message::Binary(bytes)) if bytes.first() == Some(&1) => {
                    let subscription = u32::from_le_bytes(bytes[1..5].try_into().expect("4 bytes"));
                    let time = u64::from_le_bytes(bytes[5..13].try_into().expect("8 bytes"));
                    return Heard::Data { subscription, time, bytes: bytes[13..].to_vec() };
                }
                Ok(Message::Close(_))
                | Err(tungstenite::Error::ConnectionClosed | tungstenite::Error::AlreadyClosed) => {
                    return Heard::Closed;
                }
                Ok(_) => {}
                Err(error) => panic!("the connection fails: {error}"),
            }
        }
    }

    /// Reads until a text message has what is looked for.
    fn until<T>(&mut self, what: &str, mut find: impl FnMut(&Self, &Value) -> Option<T>) -> T {
        loop {
            match self.hear() {
                Heard::Text(said) => {
                    if let Some(found) = find(self, &said) {
                        return found;
                    }
                }
                Heard::Data { subscription, time, bytes } => self.held.push_back((subscription, time, bytes)),
                Heard::Closed => panic!("closed while waiting for {what}"),
            }
        }
    }

    fn wait_for_channel(&mut self, topic: &str) -> u64 {
        while !self.channels.contains_key(topic) {
            self.until(topic, |_, _| Some(()));
        }
        self.channels[topic]["id"].as_u64().expect("an id")
    }

    fn subscribe(&mut self, topic: &str) -> u32 {
        let channel = self.wait_for_channel(topic);
        self.next_subscription += 1;
        let id = self.next_subscription;
        self.say(&json!({ "op": "subscribe", "subscriptions": [{ "id": id, "channelId": channel }] }));
        id
    }

    fn unsubscribe(&mut self, id: u32) {
        self.say(&json!({ "op": "unsubscribe", "subscriptionIds": [id] }));
    }

    /// The next message of a subscription.
    fn next(&mut self, id: u32) -> (u64, Vec<u8>) {
        while let Some((subscription, time, bytes)) = self.held.pop_front() {
            if subscription == id {
                return (time, bytes);
            }
        }
        loop {
            match self.hear() {
                Heard::Data { subscription, time, bytes } if subscription == id => return (time, bytes),
                Heard::Closed => panic!("closed while waiting for data"),
                _ => {}
            }
        }
    }

    /// Waits for a line of the log that fits.
    #[track_caller]
    fn line(&mut self, log: u32, mut fits: impl FnMut(&Log) -> bool) -> (u64, Log) {
        let begun = Instant::now();
        let mut heard = Vec::new();
        while begun.elapsed() < HANGS_AFTER {
            let (time, bytes) = self.next(log);
            let line = Log::decode(&bytes[..]).expect("a line");
            if fits(&line) {
                return (time, line);
            }
            heard.push(line.message);
        }
        panic!("no such line; heard: {heard:?}");
    }

    fn look<T: Decode>(&mut self, topic: &str) -> T {
        let id = self.subscribe(topic);
        let (_, bytes) = self.next(id);
        self.unsubscribe(id);
        T::decode(&bytes[..]).unwrap_or_else(|error| panic!("{topic}: {error}"))
    }

    /// Asks for a parameter, or sets it, and gives the values and the statuses that came with the answer.
    fn parameters(&mut self, question: &Value) -> (Vec<Value>, Vec<String>) {
        self.say(question);
        let (id, mut statuses) = (question["id"].clone(), Vec::new());
        let values = self.until("parameters", |_, said| match said["op"].as_str() {
            Some("parameterValues") if said["id"] == id => said["parameters"].as_array().cloned(),
            Some("status") => {
                statuses.push(said["message"].as_str().expect("a text").to_owned());
                None
            }
            _ => None,
        });
        (values, statuses)
    }

    fn set_threshold(&mut self, id: &str, value: &Value) -> (Vec<Value>, Vec<String>) {
        let parameter = json!({ "name": "eye.threshold", "value": value });
        self.parameters(&json!({ "op": "setParameters", "parameters": [parameter], "id": id }))
    }

    /// What the eye says next that was made with this threshold.
    fn wait_for_threshold(&mut self, id: u32, threshold: u64) {
        loop {
            let (_, bytes) = self.next(id);
            let estimate: Value = serde_json::from_slice(&bytes).expect("JSON");
            if estimate["threshold"] == threshold {
                return;
            }
        }
    }
}

#[test]
fn ports_are_shown_with_the_schemas_that_foxglove_knows() {
    let rig = Rig::start(false);
    let mut viewer = rig.viewer();
    let started = rig.client.file().started.as_nanos() as u64;

    let picture = viewer.subscribe("world/camera");
    let (time, bytes) = viewer.next(picture);
    viewer.unsubscribe(picture);
    let shown = CompressedImage::decode(&bytes[..]).expect("an image");
    let jpeg = image::load_from_memory(&shown.data).expect("any reader can read it");
    assert_eq!((jpeg.width(), jpeg.height(), shown.format.as_str()), (64, 48, "jpeg"), "as the camera took it");
    assert!(time >= started, "its time is the car's: {time} after {started}");
    let stamp = shown.timestamp.expect("it has a time").total_nanos();
    assert!((started..=time).contains(&stamp), "taken at {stamp}, published at {time}");
    let wide: CompressedImage = viewer.look("spare/camera");
    let jpeg = image::load_from_memory(&wide.data).expect("any reader can read it");
    assert_eq!((jpeg.width(), jpeg.height()), (640, 24), "1280 columns are more than a viewer needs");

    let overlay: ImageAnnotations = viewer.look("eye/lane/overlay");
    let far = overlay.circles[0].position.expect("it is somewhere");
    assert_eq!((far.x, far.y), (32.0, 17.5), "30 rows above the bottom row, in the middle");

    let scan: LaserScan = viewer.look("world/scan");
    assert_eq!((scan.frame_id.as_str(), scan.ranges.len(), scan.ranges[0]), ("laser", 4, 0.5), "a return");
    assert!(scan.ranges[1] == f64::INFINITY && scan.ranges[2].is_nan() && scan.ranges[3].is_nan(), "{scan:?}");
    let other: LaserScan = viewer.look("spare/scan");
    assert_eq!(other.frame_id, "spare/scan", "another lidar is elsewhere");

    let pose: PoseInFrame = viewer.look("world/vehicle/pose");
    assert_eq!(pose.frame_id, "map", "on the map");
    let scene: SceneUpdate = viewer.look("world/sectors/scene");
    assert_eq!(scene.entities[0].id, "front", "the sector");

    let frames = viewer.subscribe("tf");
    let mut wanted = vec!["map base_link", "base_link laser", "map spare/vehicle", "base_link spare/scan"];
    while !wanted.is_empty() {
        let (_, bytes) = viewer.next(frames);
        for one in FrameTransforms::decode(&bytes[..]).expect("frames").transforms {
            let name = format!("{} {}", one.parent_frame_id, one.child_frame_id);
            wanted.retain(|wanted| *wanted != name);
        }
    }
    viewer.unsubscribe(frames);

    let json = viewer.subscribe("world/vehicle");
    let (_, bytes) = viewer.next(json);
    let state: Value = serde_json::from_slice(&bytes).expect("JSON");
    assert_eq!(state["speed_m_s"], 0.5, "other types as they are");
    let channel = &viewer.channels["world/vehicle"];
    assert_eq!((&channel["encoding"], &channel["schemaEncoding"]), (&json!("json"), &json!("jsonschema")), "{channel}");
    rig.end();
}

#[test]
fn an_image_that_was_compressed_on_its_way_is_passed_on_as_it_is() {
    let rig = Rig::start(false);
    let image = carril_messages::CompressedImage {
        width: 32,
        height: 24,
        source_width: 64,
        source_height: 48,
        source_encoding: carril_messages::Encoding::Bgr8,
        jpeg: vec![1, 2, 3].into(),
    };
    let encoded = image.encode().expect("it fits");
    let header = Header {
        epoch: 1,
        seq: 0,
        stamp: rig.client.clock().now(),
        origins: Origins::none(),
        message_type: carril_messages::CompressedImage::TYPE,
        meta: encoded.meta,
    };
    let ended = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // As a gateway would, until it was seen: nobody knows when the subscription has come through.
            while !ended.load(Ordering::Relaxed) {
                rig.client.pass_on("world", "still", &header, encoded.payload.clone()).expect("it can be put");
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        let shown: CompressedImage = rig.viewer().look("world/still");
        ended.store(true, Ordering::Relaxed);
        assert_eq!((&shown.data[..], shown.format.as_str()), (&[1, 2, 3][..], "jpeg"), "the file of the gateway");
    });
    rig.end();
}

/// Samples of `spare/camera`, which nobody in the graph reads: what was sent beyond the four other ports, until it stays the same
/// from one report to the next (`still`) or has grown beyond `than`.
fn spare_images(client: &Client, than: i64, still: bool) -> i64 {
    let mut last = None;
    for _ in 0..MOST_REPORTS {
        let status = client.next_status(HANGS_AFTER).expect("the supervisor reports");
        let Some(spare) = status.nodes.iter().find(|node| node.node == "spare" && node.steps > 0) else { continue };
        let images = spare.sent as i64 - 4 * spare.steps as i64;
        if if still { last == Some(images) } else { images > than } {
            return images;
        }
        last = Some(images);
    }
    panic!("after {MOST_REPORTS} reports: {last:?} images, expected {}", if still { "no more" } else { "more" });
}

#[test]
fn a_port_is_subscribed_only_while_somebody_looks() {
    let rig = Rig::start(false);
    assert_eq!(spare_images(&rig.client, 0, true), 0, "nobody looks: no image is made");
    let mut viewer = rig.viewer();
    viewer.wait_for_channel("spare/camera");
    assert_eq!(spare_images(&rig.client, 0, true), 0, "somebody is there, but looks elsewhere");
    let id = viewer.subscribe("spare/camera");
    viewer.next(id);
    let seen = spare_images(&rig.client, 0, false);
    viewer.unsubscribe(id);
    let after = spare_images(&rig.client, 0, true);
    assert!(after >= seen, "no more are made: {after} after {seen}");

    let mut hasty = rig.viewer();
    let id = hasty.subscribe("spare/camera");
    hasty.next(id);
    spare_images(&rig.client, after, false);
    drop(hasty);
    let gone = spare_images(&rig.client, 0, true);
    assert!(gone > after, "a viewer who leaves without a word is noticed: {gone} after {after}");
    rig.end();
}

#[test]
fn who_may_not_control_changes_nothing() {
    let rig = Rig::start(false);
    let mut viewer = rig.viewer();
    let (values, _) =
        viewer.parameters(&json!({ "op": "getParameters", "parameterNames": ["eye.threshold"], "id": "a" }));
    assert_eq!(values, [json!({ "name": "eye.threshold", "type": "float64", "value": 190.0 })], "as configured");
    let (values, _) = viewer.parameters(&json!({ "op": "getParameters", "parameterNames": [], "id": "b" }));
    let names: Vec<&str> = values.iter().filter_map(|one| one["name"].as_str()).collect();
    assert_eq!(names, ["eye.band_px", "eye.threshold", "spare.width", "world.width"], "all of every node");

    let log = viewer.subscribe("log");
    viewer.next(log);
    let (values, statuses) = viewer.set_threshold("c", &json!(100.0));
    assert_eq!(values[0]["value"], 190.0, "the value in force, not the wish");
    assert!(statuses.iter().any(|text| text.contains("`eye.threshold` was not set")), "and why: {statuses:?}");
    assert_eq!(rig.threshold(), 190.0, "the graph is as it was");
    let lane = viewer.subscribe("eye/lane");
    viewer.wait_for_threshold(lane, 190);
    rig.end();
}

#[test]
fn who_may_control_sets_what_the_operator_allows() {
    let rig = Rig::start(true);
    let (mut viewer, mut other) = (rig.viewer(), rig.viewer());
    other.say(&json!({ "op": "subscribeParameterUpdates", "parameterNames": ["eye.threshold"] }));
    let (values, _) =
        other.parameters(&json!({ "op": "getParameters", "parameterNames": ["eye.threshold"], "id": "a" }));
    assert_eq!(values.len(), 1, "the other one is listening");

    let log = viewer.subscribe("log");
    let (values, statuses) = viewer.set_threshold("b", &json!(100));
    assert_eq!((&values[0]["value"], statuses.len()), (&json!(100.0), 0), "it is in force: {statuses:?}");
    assert_eq!(rig.threshold(), 100.0, "in the graph, too");
    other.until("the news", |_, said| (said["parameters"][0]["value"] == 100.0).then_some(()));
    viewer.line(log, |line| line.name == "eye" && line.message == "set done");
    let lane = viewer.subscribe("eye/lane");
    viewer.wait_for_threshold(lane, 100);

    let (values, statuses) = viewer.set_threshold("c", &json!(300));
    assert_eq!(values[0]["value"], 100.0, "what was in force stays");
    assert!(statuses.iter().any(|text| text.contains("255")), "the operator says what it allows: {statuses:?}");
    let (values, statuses) = viewer.set_threshold("d", &json!("loud"));
    assert_eq!((&values[0]["value"], statuses.is_empty()), (&json!(100.0), false), "a word is no number");
    for name in ["eye.treshold", "nobody.threshold", "threshold", ""] {
        let parameter = json!({ "name": name, "value": 3 });
        let question = json!({ "op": "setParameters", "parameters": [parameter], "id": name });
        let (values, statuses) = viewer.parameters(&question);
        assert!(values.is_empty() && !statuses.is_empty(), "`{name}`: {values:?} {statuses:?}");
    }
    assert_eq!(rig.threshold(), 100.0, "nothing of this changed anything");
    rig.end();
}

#[test]
fn decisions_and_lines_of_others_are_in_the_log() {
    let rig = Rig::start(false);
    let mut viewer = rig.viewer();
    let log = viewer.subscribe("log");
    let (mut told, mut up) = (Vec::new(), false);
    viewer.line(log, |line| {
        up |= line.message.starts_with("all processes up");
        told.extend((line.name == "world" && line.message.contains("nearest")).then(|| line.message.clone()));
        up && told.len() >= 3
    });
    assert!(told[0].ends_with(": nearest 0.50 m"), "the state and why: {told:?}");
    assert!(told[1].contains(" -> "), "then the transitions: {told:?}");

    rig.server.log(Stamp::from_nanos(7_000_000_000), LogLevel::Error, "lane", "the camera is gone");
    let (time, line) = viewer.line(log, |line| line.name == "lane");
    assert_eq!((time, line.message.as_str(), line.level), (7_000_000_000, "the camera is gone", 4), "as given");
    rig.end();
}

#[test]
fn channels_and_edges_follow_the_graph() {
    let rig = Rig::start(false);
    let mut viewer = rig.viewer();
    viewer.say(&json!({ "op": "subscribeConnectionGraph" }));
    let published = viewer.until("the graph", |_, said| {
        (said["op"] == "connectionGraphUpdate").then(|| said["publishedTopics"].to_string())
    });
    assert!(published.contains("world/camera") && published.contains("eye/lane"), "{published}");
    let kept = viewer.wait_for_channel("world/camera");
    viewer.wait_for_channel("spare/camera");

    let wanted = graph(&GRAPH.replace("  spare:", "  other:"));
    let request = |agreed| ApplyRequest {
        plan: serde_json::to_value(Plan::new(&wanted, 0)).expect("a plan is JSON"),
        text: wanted.text.clone(),
        terms: SwapTerms { shadow_ms: 0, probation_outputs: 2, stall_ms: 5000, ..SwapTerms::default() },
        agreed,
    };
    let planned = rig.client.apply(&request(None)).expect("the supervisor answers");
    let receipt = rig.client.apply(&request(Some(planned.changes))).expect("the supervisor answers");
    assert_eq!(receipt.outcome, Outcome::Done, "{receipt:?}");
    let mut edges = false;
    while viewer.channels.contains_key("spare/camera") || !viewer.channels.contains_key("other/camera") || !edges {
        edges |= viewer.until("the other graph", |_, said| {
            let news = said["op"] == "connectionGraphUpdate";
            Some(news && said["removedTopics"].to_string().contains("spare/camera"))
        });
    }
    assert_eq!(viewer.wait_for_channel("world/camera"), kept, "what stays keeps its channel");
    let _: CompressedImage = viewer.look("other/camera");
    rig.end();
}

#[test]
fn nonsense_stops_nobody() {
    let rig = Rig::start(true);
    let mut plain = TcpStream::connect(rig.server.address()).expect("it listens");
    plain.write_all(b"GET / HTTP/1.1\r\nHost: car\r\n\r\n").expect("it takes anything");
    let mut noise = TcpStream::connect(rig.server.address()).expect("it listens");
    let mut random = 1_u64;
    let mut byte = move || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (random >> 33) as u8
    };
    let bytes: Vec<u8> = (0..4096).map(|_| byte()).collect();
    // The server may hang up in the midst of it.
    let _ = noise.write_all(&bytes);

    let deep = "[".repeat(100_000);
    let texts = [
        "",
        "null",
        "{}",
        "{\"op\":",
        "{\"op\":\"fly\"}",
        "{\"op\":\"subscribe\"}",
        deep.as_str(),
        "{\"op\":\"subscribe\",\"subscriptions\":[{\"id\":4294967296,\"channelId\":-1}]}",
        "{\"op\":\"subscribe\",\"subscriptions\":[{\"id\":1,\"channelId\":999999}]}",
        "{\"op\":\"setParameters\",\"parameters\":[{\"name\":\"eye.threshold\",\"value\":1e999}],\"id\":\"x\"}",
        "{\"op\":\"setParameters\",\"parameters\":[{\"name\":\"eye.threshold\"}]}",
        "{\"op\":\"setParameters\",\"parameters\":[]}",
        "{\"op\":\"advertise\",\"channels\":[{\"id\":1,\"topic\":\"x\",\"encoding\":\"json\",\"schemaName\":\"\"}]}",
        "{\"op\":\"fetchAsset\",\"uri\":\"file:///etc/hostname\",\"requestId\":1}",
    ];
    for text in texts {
        let mut viewer = rig.viewer();
        viewer.say_raw(Message::text(text));
        let _: LaserScan = viewer.look("world/scan");
    }
    for length in [0, 1, 2, 5, 100] {
        let mut viewer = rig.viewer();
        let bytes: Vec<u8> = (0..length).map(|_| byte()).collect();
        viewer.say_raw(Message::binary(bytes));
        let _: LaserScan = viewer.look("world/scan");
    }
    assert_eq!(rig.threshold(), 190.0, "nothing was set");
    rig.end();
}

impl Viewer {
    fn say_raw(&mut self, message: Message) {
        self.socket.send(message).expect("the server is there");
    }
}

#[test]
fn who_does_not_read_holds_nobody_up() {
    let rig = Rig::start(false);
    let mut asleep = rig.viewer();
    asleep.subscribe("spare/camera");
    asleep.subscribe("world/scan");
    let mut awake = rig.viewer();
    let id = awake.subscribe("spare/camera");
    let times: Vec<u64> = (0..40).map(|_| awake.next(id).0).collect();
    assert!(times.is_sorted(), "newer and newer: {times:?}");
    assert_eq!(rig.server.viewers(), 2, "both are there");
    rig.end();
}

#[test]
fn viewers_hear_the_end_and_the_address_is_free_again() {
    let rig = Rig::start(false);
    let address = rig.server.address();
    let taken = start(Arc::clone(&rig.client), Options::new(address)).err().expect("somebody listens there");
    assert!(taken.to_string().contains(&address.to_string()), "it names the address: {taken}");
    let mut viewer = rig.viewer();
    viewer.wait_for_channel("log");
    let Rig { running, client, server, .. } = rig;
    server.stop();
    while !matches!(viewer.hear(), Heard::Closed) {}
    drop(viewer);
    assert!(TcpStream::connect(address).is_err(), "nobody listens any more");
    drop(client);
    running.stop();
    running.wait().expect("an orderly end");
}

/// The panels of a part of a layout, left to right, top to bottom; those in tabs, too.
fn panels(part: &Value, configs: &Value) -> Vec<String> {
    match part {
        Value::String(id) => {
            let tabs = configs[id]["tabs"].as_array().into_iter().flatten();
            let inside = tabs.flat_map(|tab| panels(&tab["layout"], configs));
            std::iter::once(id.clone()).chain(inside).collect()
        }
        split => [&split["first"], &split["second"]].into_iter().flat_map(|part| panels(part, configs)).collect(),
    }
}

#[test]
fn the_layout_shows_each_of_its_panels_once() {
    let layout: Value = serde_json::from_str(include_str!("../foxglove/carril.json")).expect("a layout is JSON");
    let mut shown = panels(&layout["layout"], &layout["configById"]);
    shown.sort();
    let configured = layout["configById"].as_object().expect("panels by their ids");
    assert_eq!(shown, configured.keys().cloned().collect::<Vec<_>>(), "no panel without place, no place without panel");
    for key in ["globalVariables", "userNodes", "playbackConfig"] {
        assert!(layout[key].is_object(), "`{key}`, as Foxglove exports it");
    }
}
