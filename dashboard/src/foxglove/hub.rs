//! What all threads of the server share: the way into the graph, the channels that all ports share, and what is known of the graph.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use carril_messages::Stamp;
use carril_runtime::client::Client;
use carril_runtime::control_plane::LogLevel;
use foxglove::messages::{FrameTransforms, Log};
use foxglove::websocket::{AnyClient, ChannelView, GetParametersResponder, Parameter, Status};
use foxglove::{ChannelBuilder, Context, Encode, PartialMetadata, RawChannel, WebSocketServerHandle};

use super::plan::Facts;
use super::show::Frame;
use super::{Options, parameters, show};

/// Topic of the log.
pub const LOG: &str = "log";
/// Topic of the frames.
pub const TRANSFORMS: &str = "tf";
/// So many questions for parameters may wait for one reading of the graph; further ones get what is known.
const MOST_QUESTIONS: usize = 256;

/// What the threads share.
pub struct Hub {
    pub client: Arc<Client>,
    pub options: Options,
    pub context: Arc<Context>,
    pub log: Arc<RawChannel>,
    pub transforms: Arc<RawChannel>,
    /// `None` before the start and after the end.
    pub server: Mutex<Option<WebSocketServerHandle>>,
    pub parameters: Mutex<BTreeMap<String, Parameter>>,
    pub facts: Mutex<Facts>,
    /// Sizes of images and of their pictures, by port.
    frames: Mutex<HashMap<String, Frame>>,
    wants: Mutex<Wants>,
    bell: Condvar,
}

/// What the watching thread is asked for.
#[derive(Default)]
pub struct Wants {
    /// End.
    pub stop: bool,
    /// Somebody came, went, looks or looks away; an image has told its size.
    pub look: bool,
    /// Somebody has just come: the graph may have changed since it was last read.
    pub read: bool,
    /// Names, and who asked.
    pub questions: Vec<(Vec<String>, GetParametersResponder)>,
}

impl Wants {
    fn any(&self) -> bool {
        self.stop || self.look || self.read || !self.questions.is_empty()
    }
}

/// Locks, also what a panicking thread has left: all that is locked here is whole between two statements.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The bytes of a well-known message.
pub fn encoded<T: Encode>(message: &T) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(message.encoded_len().unwrap_or(64));
    // Only a buffer that is full can fail, and a `Vec` grows.
    let _ = message.encode(&mut bytes);
    bytes
}

/// A channel for a well-known message.
pub fn channel<T: Encode>(context: &Arc<Context>, topic: &str) -> Arc<RawChannel> {
    let builder = ChannelBuilder::new(topic).context(context).schema(T::get_schema());
    builder.message_encoding(T::get_message_encoding()).build_raw().expect("the encoding is given")
}

/// Sends a message. Its time is when it was published, on the car's clock.
pub fn send(channel: &RawChannel, bytes: &[u8], stamp: Stamp) {
    if channel.has_sinks() {
        channel.log_with_meta(bytes, PartialMetadata { log_time: Some(show::log_time(stamp)) });
    }
}

impl Hub {
    pub fn new(client: Arc<Client>, options: Options) -> Self {
        let context = Context::new();
        Self {
            log: channel::<Log>(&context, LOG),
            transforms: channel::<FrameTransforms>(&context, TRANSFORMS),
            client,
            options,
            context,
            server: Mutex::default(),
            parameters: Mutex::default(),
            facts: Mutex::default(),
            frames: Mutex::default(),
            wants: Mutex::default(),
            bell: Condvar::new(),
        }
    }

    pub fn now(&self) -> Stamp {
        self.client.clock().now()
    }

    /// Does something with the server, while there is one.
    pub fn with_server<T>(&self, act: impl FnOnce(&WebSocketServerHandle) -> T) -> Option<T> {
        lock(&self.server).as_ref().map(act)
    }

    /// How many look on.
    pub fn viewers(&self) -> usize {
        self.with_server(WebSocketServerHandle::client_count).unwrap_or(0)
    }

    /// Rings for the watching thread.
    pub fn ring(&self, want: impl FnOnce(&mut Wants)) {
        want(&mut lock(&self.wants));
        self.bell.notify_all();
    }

    /// Waits until something is wanted, for `patience` at most, or for ever.
    pub fn wait(&self, patience: Option<Duration>) -> Wants {
        let wants = lock(&self.wants);
        let mut wants = match patience {
            Some(patience) => {
                let waited = self.bell.wait_timeout_while(wants, patience, |wants| !wants.any());
                waited.unwrap_or_else(PoisonError::into_inner).0
            }
            None => self.bell.wait_while(wants, |wants| !wants.any()).unwrap_or_else(PoisonError::into_inner),
        };
        // Who has been told to stop stays so.
        let stop = wants.stop;
        let taken = std::mem::take(&mut *wants);
        wants.stop = stop;
        taken
    }

    /// A line for the log of the viewers.
    pub fn log(&self, stamp: Stamp, level: LogLevel, name: &str, text: &str) {
        if self.log.has_sinks() {
            send(&self.log, &encoded(&show::log(stamp, level, name, text)), stamp);
        }
    }

    /// Something does not work: a status for all viewers, which replaces the last one about the same matter, and a line in the log.
    pub fn complain(&self, about: &str, text: &str) {
        self.with_server(|server| server.publish_status(Status::warning(format!("{about}: {text}")).with_id(about)));
        self.log(self.now(), LogLevel::Warning, about, text);
    }

    /// It works again.
    pub fn forgive(&self, about: &str) {
        self.with_server(|server| server.remove_status(vec![about.to_owned()]));
    }

    /// The size of the images of a port, once one has come.
    pub fn frame(&self, port: &str) -> Option<Frame> {
        lock(&self.frames).get(port).copied()
    }

    /// An image of that size came.
    pub fn saw(&self, port: &str, frame: Frame) {
        if lock(&self.frames).insert(port.to_owned(), frame).is_none() {
            self.ring(|wants| wants.look = true);
        }
    }

    /// The images of a node may have another size now.
    pub fn forget_frames(&self, node: &str) {
        lock(&self.frames).retain(|port, _| port.split('/').next() != Some(node));
    }

    /// Takes over the parameters in force, and tells those who want to know of changes.
    pub fn learn(&self, now: BTreeMap<String, Parameter>) {
        let news = parameters::changed(&lock(&self.parameters), &now);
        *lock(&self.parameters) = now;
        if !news.is_empty() {
            self.with_server(|server| server.publish_parameter_values(news));
        }
    }

    /// The parameters in force, as far as is known.
    pub fn in_force(&self, names: &[String]) -> Vec<Parameter> {
        parameters::named(&lock(&self.parameters), names)
    }

    /// Somebody asks for parameters.
    pub fn question(&self, names: Vec<String>, responder: GetParametersResponder) {
        let mut wants = lock(&self.wants);
        if wants.questions.len() < MOST_QUESTIONS {
            wants.questions.push((names, responder));
            drop(wants);
            self.bell.notify_all();
        } else {
            drop(wants);
            responder.respond(self.in_force(&names));
        }
    }
}

/// Rings when somebody comes, goes, looks or looks away.
pub struct Listener(pub Arc<Hub>);

impl foxglove::websocket::ServerListener for Listener {
    fn on_subscribe(&self, _client: foxglove::websocket::Client, _channel: ChannelView) {
        self.0.ring(|wants| wants.look = true);
    }

    fn on_unsubscribe(&self, _client: foxglove::websocket::Client, _channel: ChannelView) {
        self.0.ring(|wants| wants.look = true);
    }

    fn on_client_connect(&self) {
        self.0.ring(|wants| wants.read = true);
    }

    fn on_client_disconnect(&self) {
        self.0.ring(|wants| wants.look = true);
    }
}

/// Tells a person why something was not done.
pub fn warn(client: &AnyClient, name: &str, reason: &str) {
    client.send_warning(format!("`{name}` was not set: {reason}"));
}

/// The same, and all who read the log.
pub fn refuse(client: &AnyClient, hub: &Hub, name: &str, reason: &str) {
    warn(client, name, reason);
    hub.log(hub.now(), LogLevel::Warning, name, &format!("not set: {reason}"));
}
