//! The link of a machine that runs nodes of a car's graph. On the one side it is a tool of the run on this machine, on the other a tool of
//! the car far away: it puts what its nodes read in the place of the nodes on the car, and sends what they give to the gateway.
//!
//! The two runs have clocks of their own. Times are translated on the way, so that an age is the same on both sides; sequence numbers
//! and lives of writers stay as they are, so that nothing counts twice when a link comes back.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use carril_messages::{Control, Header, Image, Message, Timespan};
use carril_runtime::client::{Client, ClientError};
use carril_runtime::clock::Clock;
use carril_runtime::control_plane::{LogLevel, RunFile, Status};
use carril_runtime::graph::remote::RemoteRates;
use carril_runtime::machines::{Join, SILENCE, nodes_of};
use carril_runtime::transport::zenoh::{FarPublisher, StandIn};
use carril_runtime::transport::{Guard, TransportError};
use serde::{Deserialize, Serialize};

use super::{Carrier, Sample, packed, unpacked};
use crate::gateway::relay::Pace;

/// Whether the car reads an output is looked up this often.
const LOOK: Duration = Duration::from_millis(50);
/// The car hears this often that the machine is there.
const SAY_AGAIN: Duration = SILENCE.checked_div(4).expect("four is not zero");
/// A car that has not answered for longer is gone; samples go on until then, as the link may come back.
const CAR_SILENCE: Duration = Duration::from_secs(3);
/// Between two tries to join.
const TRY_AGAIN: Duration = Duration::from_millis(500);

/// As whom it speaks in the log.
const LINK: &str = "link";

/// What becomes of a link.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum News {
    /// The machine has joined.
    Joined,
    /// It has not, or no more; it tries again.
    Apart {
        /// Why.
        why: String,
    },
}

/// Which machine joins, and how much it sends.
#[derive(Clone, Debug)]
pub struct Options {
    /// Its name in the graph.
    pub machine: String,
    /// How images go out.
    pub rates: RemoteRates,
}

/// Joins, and joins again whenever the car is back, until it is told to stop or the run on this machine has ended. `connect`: the way to
/// the car, with the key of this machine. `tell` hears what is new.
pub fn keep(
    near: &Arc<Client>,
    options: &Options,
    connect: &dyn Fn() -> Result<Client, String>,
    stop: &AtomicBool,
    tell: &dyn Fn(&News),
) {
    let mut told = None;
    let mut tell_news = |news: News| {
        if told.as_ref() != Some(&news) {
            tell(&news);
            told = Some(news);
        }
    };
    let over = || stop.load(Ordering::Relaxed) || !near.supervisor_is_alive() || !near.is_linked();
    while !over() {
        let ended = connect().and_then(|far| serve(near, &Arc::new(far), options, &over, &mut tell_news));
        if let Err(why) = ended {
            tell_news(News::Apart { why });
        }
        let again = Instant::now() + TRY_AGAIN;
        while !over() && Instant::now() < again {
            std::thread::sleep(LOOK);
        }
    }
}

/// Joins the car and carries samples until it is over (`Ok`), or the car is gone or refuses (`Err`).
fn serve(
    near: &Arc<Client>,
    far: &Arc<Client>,
    options: &Options,
    over: &dyn Fn() -> bool,
    tell: &mut dyn FnMut(News),
) -> Result<(), String> {
    let run = near.run().map_err(|error| error.to_string())?;
    let graph = near.graph().map_err(|error| error.to_string())?;
    let join = Join::of(&options.machine, &run, &graph);
    let joined = far.join(&options.machine, &join).map_err(|error| why_not(far, error))?;
    let clocks = Clocks { near: Arc::clone(near.clock()), far: Arc::clone(far.clock()) };
    let traffic = Traffic { near, far, options, run: &run, clocks: &clocks };
    let _inlets = traffic.inlets(&join).map_err(|error| error.to_string())?;
    let mut outlets = traffic.outlets().map_err(|error| error.to_string())?;
    let _news = traffic.news().map_err(|error| error.to_string())?;
    let _words = traffic.words().map_err(|error| error.to_string())?;
    tell(News::Joined);
    let (mut said, mut heard) = (Instant::now(), Instant::now());
    while !over() {
        for outlet in &mut outlets {
            outlet.follow_readers(&traffic).map_err(|error| error.to_string())?;
        }
        if said.elapsed() >= SAY_AGAIN {
            said = Instant::now();
            match far.join(&options.machine, &join) {
                Ok(now) if now == joined => heard = Instant::now(),
                Ok(_) => return Err("the car was started anew".into()),
                Err(refused @ ClientError::Answer { .. }) => return Err(why_not(far, refused)),
                Err(_) if heard.elapsed() < CAR_SILENCE => {}
                Err(silent) => return Err(why_not(far, silent)),
            }
        }
        std::thread::sleep(LOOK);
    }
    Ok(())
}

/// A question that the rules of the car refuse gets no answer at all: then what the key may do says more.
fn why_not(far: &Client, error: ClientError) -> String {
    match error {
        ClientError::Answer { reason, .. } => reason,
        ClientError::Transport(TransportError::NoAnswer { .. }) if far.supervisor_is_alive() => {
            format!("the car does not answer; {}", far.access().why)
        }
        other => other.to_string(),
    }
}

/// The clocks of both sides.
#[derive(Clone)]
struct Clocks {
    near: Arc<dyn Clock>,
    far: Arc<dyn Clock>,
}

impl Clocks {
    /// How far the car's clock is ahead of ours.
    fn ahead(&self) -> Timespan {
        self.far.now().since(self.near.now())
    }

    fn to_near(&self, header: &mut Header) {
        header.shift(Timespan::from_nanos(-self.ahead().as_nanos()));
    }

    fn to_far(&self, header: &mut Header) {
        header.shift(self.ahead());
    }
}

struct Traffic<'a> {
    near: &'a Arc<Client>,
    far: &'a Arc<Client>,
    options: &'a Options,
    run: &'a RunFile,
    clocks: &'a Clocks,
}

impl Traffic<'_> {
    /// What its nodes read from elsewhere: outputs, and what people put on their open inputs.
    fn inlets(&self, join: &Join) -> Result<Vec<(Guard, Carrier)>, ClientError> {
        let outputs = join.reads.keys().filter_map(|output| output.split_once('/'));
        let open = join.nodes.iter().flat_map(|node| {
            let external = node.inputs.iter().filter(|input| input.external);
            external.map(|input| (node.name.as_str(), input.port.as_str()))
        });
        outputs.chain(open).map(|(node, port)| self.inlet(node, port)).collect()
    }

    fn inlet(&self, node: &str, port: &str) -> Result<(Guard, Carrier), ClientError> {
        let stand_in: StandIn = self.near.stand_in(node, port)?;
        let (clocks, name) = (self.clocks.clone(), format!("{node}/{port}"));
        let carrier = Carrier::start(move |sample| {
            let put = unpacked(sample).and_then(|(mut header, payload)| {
                clocks.to_near(&mut header);
                stand_in.put(&header, payload).map_err(|error| error.to_string())
            });
            if let Err(error) = put {
                tracing::debug!("passing on `{name}`: {error}");
            }
        });
        let slot = carrier.slot();
        let guard = self.far.subscribe(node, port, move |header, payload, _| slot.put((header, payload)))?;
        Ok((guard, carrier))
    }

    fn outlets(&self) -> Result<Vec<Outlet>, ClientError> {
        let ports = nodes_of(&self.options.machine, self.run)
            .flat_map(|node| node.outputs.iter().map(move |output| (node.name.as_str(), output)));
        let outlet = |(node, output): (&str, &carril_runtime::control_plane::OutputEntry)| {
            let is_image = output.message_type == Image::TYPE.name;
            let path = format!("port/{node}/{}", output.port);
            Ok(Outlet {
                node: node.to_owned(),
                port: output.port.clone(),
                is_image,
                publisher: Arc::new(self.far.machine_outlet(&self.options.machine, &path, !is_image)?),
                tap: None,
            })
        };
        ports.map(outlet).collect()
    }

    /// What is said to the nodes of the car is said to those of this machine, too: in order, and on a thread that may wait for their answers.
    fn words(&self) -> Result<Guard, ClientError> {
        let (sender, words) = channel();
        let near = Arc::clone(self.near);
        std::thread::spawn(move || words.iter().for_each(|word| pass_on(&near, word)));
        self.far.watch_words(move |word| {
            // It ends with the watch.
            let _ = sender.send(word);
        })
    }

    /// How its nodes do, and that one of them stops the car.
    fn news(&self) -> Result<Vec<Guard>, ClientError> {
        let machine = &self.options.machine;
        let (status, fault) =
            (self.far.machine_outlet(machine, "status", true)?, self.far.machine_outlet(machine, "fault", true)?);
        let clocks = self.clocks.clone();
        Ok(vec![
            self.near.watch_status(move |told| tell(&status, serde_json::to_vec(&healths(told, clocks.ahead()))))?,
            self.near.watch_faults(move |report| tell(&fault, serde_json::to_vec(&report)))?,
        ])
    }
}

fn pass_on(near: &Client, word: Control) {
    let (level, text) = match near.control(word) {
        Ok(answers) => {
            let mut heard: Vec<String> = answers.into_iter().flatten().flat_map(|reply| reply.nodes).collect();
            heard.sort();
            (LogLevel::Info, format!("`{word}` on the car: heard by {}", heard.join(", ")))
        }
        Err(error) => (LogLevel::Error, format!("`{word}` on the car was not heard here: {error}")),
    };
    if let Err(error) = near.say(level, LINK, text) {
        tracing::debug!("{error}");
    }
}

/// The nodes of a status, in the times of a clock that is `ahead`.
fn healths(status: Status, ahead: Timespan) -> Vec<carril_messages::Health> {
    let mut nodes = status.nodes;
    for health in &mut nodes {
        health.since = health.since.shifted(ahead);
        health.stamp = health.stamp.shifted(ahead);
        // It means nothing on another machine.
        health.pid = None;
    }
    nodes
}

fn tell(publisher: &FarPublisher, bytes: Result<Vec<u8>, serde_json::Error>) {
    if let Ok(bytes) = bytes
        && let Err(error) = publisher.put(None, bytes)
    {
        tracing::debug!("{error}");
    }
}

/// An output of a node of this machine.
struct Outlet {
    node: String,
    port: String,
    is_image: bool,
    publisher: Arc<FarPublisher>,
    tap: Option<(Guard, Carrier)>,
}

impl Outlet {
    /// Listens to the output while the car reads it.
    fn follow_readers(&mut self, traffic: &Traffic<'_>) -> Result<(), ClientError> {
        match (self.publisher.wanted(), self.tap.is_some()) {
            (true, false) => self.tap = Some(self.open(traffic)?),
            (false, true) => self.tap = None,
            _ => {}
        }
        Ok(())
    }

    fn open(&self, traffic: &Traffic<'_>) -> Result<(Guard, Carrier), ClientError> {
        let (publisher, clocks) = (Arc::clone(&self.publisher), traffic.clocks.clone());
        let RemoteRates { image_hz, image_width, image_quality, .. } = traffic.options.rates;
        let (name, is_image) = (format!("{}/{}", self.node, self.port), self.is_image);
        let mut pace = Pace::new(image_hz);
        let carrier = Carrier::start(move |sample: Sample| {
            if is_image && !pace.pass(Instant::now()) {
                return;
            }
            let put = packed(sample, image_width, image_quality).and_then(|(mut header, payload)| {
                clocks.to_far(&mut header);
                let header = header.encode().map_err(|error| error.to_string())?;
                publisher.put(Some(&header), payload.to_vec()).map_err(|error| error.to_string())
            });
            if let Err(error) = put {
                tracing::debug!("passing on `{name}`: {error}");
            }
        });
        let slot = carrier.slot();
        let hear = move |header, payload, _| slot.put((header, payload));
        let guard = traffic.near.subscribe(&self.node, &self.port, hear)?;
        Ok((guard, carrier))
    }
}
