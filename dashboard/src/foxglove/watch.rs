//! Follows the running graph and those who look: opens and closes channels as ports come and go, and subscribes a port only while one of
//! its channels has a viewer. While nobody is connected it sleeps.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use carril_messages::{
    CompressedImage, DecisionState, Header, Image, LaneEstimate, LaserScan, Message, Payload, Sectors, VehicleState,
    dynamic,
};
use carril_runtime::control_plane::{LogLine, NodeEntry, RunFile};
use carril_runtime::transport::Guard;
use foxglove::messages::{ImageAnnotations, PoseInFrame, SceneUpdate};
use foxglove::websocket::ConnectionGraph;
use foxglove::{ChannelBuilder, RawChannel, Schema};

use super::feed::Feed;
use super::hub::{Hub, LOG, Wants, channel, encoded, lock, send};
use super::plan::{self, Facts, Form, ShownPort};
use super::show::{self, Frame};
use super::{json, parameters};
use crate::pictures;

/// How often the graph is read while somebody is connected.
const READ_EVERY: Duration = Duration::from_secs(1);
/// Each announcement is a message that must not be dropped, and the queue of such messages is short.
const BETWEEN_ANNOUNCEMENTS: Duration = Duration::from_millis(2);
/// A port whose samples cannot be shown is complained about so often.
const BETWEEN_COMPLAINTS: Duration = Duration::from_secs(10);

/// So many old lines are shown to who begins to read the log; more would push each other out of the viewer's queue.
const LAST_LINES: usize = 20;

/// What the thread keeps.
pub struct Watch {
    hub: Arc<Hub>,
    nodes: Vec<NodeEntry>,
    ports: Vec<Open>,
    /// Frames of the lidars, and how they are mounted.
    lasers: Vec<(String, f64)>,
    /// Which life of a node it was when the graph was last read.
    lives: HashMap<String, (Option<u32>, u32)>,
    read: Option<Instant>,
    /// The run's log, while somebody reads it.
    log: Option<Guard>,
    silent: bool,
}

/// A port with its channels.
struct Open {
    port: ShownPort,
    channels: Vec<(Form, Arc<RawChannel>)>,
    feed: Option<Feed>,
}

impl Watch {
    /// With the channels of the graph as it was when the client connected.
    pub fn new(hub: Arc<Hub>) -> Self {
        let mut watch = Self {
            nodes: Vec::new(),
            ports: Vec::new(),
            lasers: Vec::new(),
            lives: HashMap::new(),
            read: None,
            log: None,
            silent: false,
            hub,
        };
        let run = watch.hub.client.file().clone();
        watch.follow(&run, None);
        watch
    }

    /// Who publishes and reads what.
    pub fn connections(&self) -> ConnectionGraph {
        plan::connections(&self.nodes)
    }

    /// Until it is told to stop.
    pub fn run(mut self) {
        loop {
            let connected = self.hub.viewers() > 0;
            let wants = self.hub.wait(connected.then_some(READ_EVERY));
            if wants.stop {
                return;
            }
            self.turn(wants);
        }
    }

    fn turn(&mut self, wants: Wants) {
        let connected = self.hub.viewers() > 0;
        let old = self.read.is_none_or(|read| read.elapsed() >= READ_EVERY);
        // Who looks sees the first picture before the graph is asked, which may take a while.
        self.follow_viewers();
        if (connected && old) || wants.read {
            self.read_graph();
            self.follow_viewers();
            self.tell();
        }
        for (names, responder) in wants.questions {
            responder.respond(self.hub.in_force(&names));
        }
    }

    fn read_graph(&mut self) {
        let client = &self.hub.client;
        match client.run().and_then(|run| Ok((run, client.graph()?))) {
            Ok((run, graph)) => {
                if std::mem::take(&mut self.silent) {
                    self.hub.forgive("graph");
                }
                let facts = Facts::new(&graph.nodes);
                let versions = graph.nodes.iter().map(|node| (node.name.clone(), node.version)).collect();
                self.hub.learn(parameters::of_graph(&graph.nodes));
                *lock(&self.hub.facts) = facts;
                self.follow(&run, Some(&versions));
            }
            Err(error) => {
                if !std::mem::replace(&mut self.silent, true) {
                    self.hub.complain("graph", &error.to_string());
                }
            }
        }
        self.read = Some(Instant::now());
    }

    /// The graph is this from now on: channels of ports that are gone or have changed are closed, those of new ones opened.
    fn follow(&mut self, run: &RunFile, versions: Option<&HashMap<String, u32>>) {
        self.follow_lives(run, versions);
        let facts = lock(&self.hub.facts).clone();
        let ports = plan::ports(&run.nodes);
        self.lasers = ports
            .iter()
            .filter(|port| port.message_type == LaserScan::TYPE.name)
            .filter_map(|port| Some((port.about.clone()?, facts.mounting_rad(&run.nodes, &port.name()))))
            .collect();
        if self.nodes == run.nodes {
            return;
        }
        self.nodes.clone_from(&run.nodes);
        let pause = if self.hub.viewers() > 0 { BETWEEN_ANNOUNCEMENTS } else { Duration::ZERO };
        let mut known = std::mem::take(&mut self.ports);
        for gone in known.extract_if(.., |open| !ports.contains(&open.port)) {
            for (_, channel) in gone.channels.iter().filter(|(form, _)| !is_shared(*form)) {
                channel.close();
                std::thread::sleep(pause);
            }
        }
        for port in ports {
            let at = known.iter().position(|open| open.port == port);
            self.ports.push(at.map_or_else(
                || {
                    std::thread::sleep(pause);
                    Open::new(&self.hub, port)
                },
                |at| known.swap_remove(at),
            ));
        }
        let connections = self.connections();
        self.hub.with_server(|server| server.publish_connection_graph(connections));
    }

    /// After a restart or a change, the images of a node may have another size.
    fn follow_lives(&mut self, run: &RunFile, versions: Option<&HashMap<String, u32>>) {
        let pid = |process: &str| run.processes.iter().find(|one| one.name == process).and_then(|one| one.pid);
        let mut lives = HashMap::new();
        for node in &run.nodes {
            let version = versions.and_then(|versions| versions.get(&node.name)).copied().unwrap_or(1);
            let life = (pid(&node.process), version);
            if self.lives.get(&node.name) != Some(&life) {
                self.hub.forget_frames(&node.name);
            }
            lives.insert(node.name.clone(), life);
        }
        self.lives = lives;
    }

    /// Subscribes what is looked at, and nothing else.
    fn follow_viewers(&mut self) {
        let wanted: Vec<bool> =
            self.ports.iter().map(|open| open.is_looked_at() || self.is_measured(&open.port)).collect();
        for (open, wanted) in self.ports.iter_mut().zip(wanted) {
            if !wanted {
                open.feed = None;
            } else if open.feed.is_none() {
                open.subscribe(&self.hub);
            }
        }
        if !self.hub.log.has_sinks() {
            self.log = None;
        } else if self.log.is_none() {
            self.follow_log();
        }
    }

    /// The last lines, and each new one.
    fn follow_log(&mut self) {
        let tell = |hub: &Hub, line: &LogLine| hub.log(line.stamp, line.level, &line.process, &line.text);
        let hub = Arc::clone(&self.hub);
        match self.hub.client.watch_log(move |line| tell(&hub, &line)) {
            Ok(guard) => self.log = Some(guard),
            Err(error) => return self.hub.complain(LOG, &error.to_string()),
        }
        match self.hub.client.log() {
            Ok(lines) => {
                let first = lines.len().saturating_sub(LAST_LINES);
                lines[first..].iter().for_each(|line| tell(&self.hub, line));
            }
            Err(error) => self.hub.complain(LOG, &error.to_string()),
        }
    }

    /// Whether an overlay waits for the size of these images: one is enough to tell it.
    fn is_measured(&self, port: &ShownPort) -> bool {
        let name = port.name();
        let waits = |open: &Open| open.port.about.as_deref() == Some(&name) && open.has_viewer(Form::Overlay);
        port.message_type == Image::TYPE.name && self.hub.frame(&name).is_none() && self.ports.iter().any(waits)
    }

    /// Once a second: what does not come from a port.
    fn tell(&mut self) {
        let now = self.hub.now();
        if self.hub.transforms.has_sinks() && !self.lasers.is_empty() {
            send(&self.hub.transforms, &encoded(&show::lasers_on_body(&self.lasers, now)), now);
        }
    }
}

fn is_shared(form: Form) -> bool {
    matches!(form, Form::Transform | Form::Log)
}

impl Open {
    fn new(hub: &Hub, port: ShownPort) -> Self {
        let open = |(topic, form): &(Option<String>, Form)| {
            let topic = topic.as_deref().unwrap_or_default();
            let context = &hub.context;
            let channel = match form {
                Form::Picture => channel::<foxglove::messages::CompressedImage>(context, topic),
                Form::Scan => channel::<foxglove::messages::LaserScan>(context, topic),
                Form::Overlay => channel::<ImageAnnotations>(context, topic),
                Form::Pose => channel::<PoseInFrame>(context, topic),
                Form::Scene => channel::<SceneUpdate>(context, topic),
                Form::Json => json_channel(hub, topic, &port.message_type),
                Form::Transform => Arc::clone(&hub.transforms),
                Form::Log => Arc::clone(&hub.log),
            };
            (*form, channel)
        };
        let channels = port.forms.iter().map(open).collect();
        Self { port, channels, feed: None }
    }

    fn is_looked_at(&self) -> bool {
        self.channels.iter().any(|(_, channel)| channel.has_sinks())
    }

    fn has_viewer(&self, form: Form) -> bool {
        self.channels.iter().any(|(own, channel)| *own == form && channel.has_sinks())
    }

    fn subscribe(&mut self, hub: &Arc<Hub>) {
        let options = &hub.options;
        let rate_hz = match &*self.port.message_type {
            of if of == Image::TYPE.name => options.image_hz,
            of if of == LaserScan::TYPE.name => options.scan_hz,
            _ => options.other_hz,
        };
        let mut screen = Screen {
            hub: Arc::clone(hub),
            port: self.port.clone(),
            name: self.port.name(),
            channels: self.channels.clone(),
            state: None,
            complained: None,
        };
        let show = move |header: &Header, payload: &Payload| screen.show(header, payload);
        match Feed::open(&hub.client, (&self.port.node, &self.port.port), pause(rate_hz), show) {
            Ok(feed) => self.feed = Some(feed),
            Err(error) => hub.complain(&self.port.name(), &error.to_string()),
        }
    }
}

/// Between two samples; a rate that is none is one a second.
fn pause(rate_hz: f64) -> Duration {
    let rate_hz = if rate_hz > 0.0 { rate_hz } else { 1.0 };
    Duration::from_secs_f64((1.0 / rate_hz).clamp(0.001, 3600.0))
}

fn json_channel(hub: &Hub, topic: &str, message_type: &str) -> Arc<RawChannel> {
    let schema = dynamic::find(message_type).map(|known| {
        let text = json::message_schema(&(known.schema)()).to_string();
        Schema::new(message_type, "jsonschema", text.into_bytes())
    });
    let builder = ChannelBuilder::new(topic).context(&hub.context).schema(schema);
    builder.message_encoding("json").build_raw().expect("the encoding is given")
}

/// Shows the samples of one port.
struct Screen {
    hub: Arc<Hub>,
    port: ShownPort,
    name: String,
    channels: Vec<(Form, Arc<RawChannel>)>,
    /// Of a decision node: the last that was seen.
    state: Option<DecisionState>,
    complained: Option<Instant>,
}

impl Screen {
    fn show(&mut self, header: &Header, payload: &Payload) {
        if self.port.message_type == Image::TYPE.name {
            // From afar, images come compressed.
            let frame = if header.message_type == CompressedImage::TYPE {
                read::<CompressedImage>(header, payload).map(|image| {
                    Frame::shown_as((image.source_width, image.source_height), (image.width, image.height))
                })
            } else {
                let max_width = self.hub.options.image_max_width;
                read::<Image>(header, payload).map(|image| Frame::new((image.width(), image.height()), max_width))
            };
            if let Ok(frame) = frame {
                self.hub.saw(&self.name, frame);
            }
        }
        for (form, channel) in self.channels.clone() {
            if !channel.has_sinks() {
                continue;
            }
            match self.form(form, header, payload) {
                Ok(Some(bytes)) => send(&channel, &bytes, header.stamp),
                Ok(None) => {}
                Err(error) => self.complain(&error),
            }
        }
    }

    /// The bytes for a channel. `None`: there is nothing to show.
    fn form(&mut self, form: Form, header: &Header, payload: &Payload) -> Result<Option<Vec<u8>>, String> {
        let origin = show::origin(header);
        let about = self.port.about.as_deref().unwrap_or_default();
        let options = &self.hub.options;
        Ok(match form {
            Form::Picture if header.message_type == CompressedImage::TYPE => {
                let image = read::<CompressedImage>(header, payload)?;
                Some(encoded(&show::picture(image.jpeg.bytes().clone(), &self.name, origin)))
            }
            Form::Picture => {
                let image = read::<Image>(header, payload)?;
                let picture = pictures::compress(&image, options.image_max_width, options.image_quality);
                let picture = picture.map_err(|error| error.to_string())?;
                Some(encoded(&show::picture(picture.jpeg.into(), &self.name, origin)))
            }
            Form::Scan => show::scan(&read::<LaserScan>(header, payload)?, about, origin).map(|scan| encoded(&scan)),
            Form::Overlay => {
                let Some(frame) = self.hub.frame(about) else { return Ok(None) };
                let rows = lock(&self.hub.facts).rows(&self.port.node);
                Some(encoded(&show::overlay(&read::<LaneEstimate>(header, payload)?, frame, rows, origin)))
            }
            Form::Pose => show::pose(&read::<VehicleState>(header, payload)?, origin).map(|pose| encoded(&pose)),
            Form::Transform => {
                let state = read::<VehicleState>(header, payload)?;
                show::body_on_map(&state, about, origin).map(|transforms| encoded(&transforms))
            }
            Form::Scene => {
                let facts = lock(&self.hub.facts).clone();
                let limit = |sector: &str| facts.limit_m(&self.port.node, sector);
                Some(encoded(&show::sectors(&read::<Sectors>(header, payload)?, limit, origin)))
            }
            Form::Json => {
                let message = dynamic::to_json(header, payload).map_err(|error| error.to_string())?;
                Some(json::object(message).to_string().into_bytes())
            }
            Form::Log => {
                let state = read::<DecisionState>(header, payload)?;
                if let Some((level, text)) = show::transition(self.state.as_ref(), &state) {
                    self.hub.log(header.stamp, level, &self.port.node, &text);
                }
                self.state = Some(state);
                None
            }
        })
    }

    /// Now and then, not for each sample.
    fn complain(&mut self, error: &str) {
        if self.complained.is_none_or(|last| last.elapsed() >= BETWEEN_COMPLAINTS) {
            self.hub.complain(&self.name, error);
            self.complained = Some(Instant::now());
        }
    }
}

fn read<T: Message>(header: &Header, payload: &Payload) -> Result<T, String> {
    header.expect::<T>().and_then(|()| T::decode(&header.meta, payload)).map_err(|error| error.to_string())
}
