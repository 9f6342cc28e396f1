//! Typed ports. `inputs!` and `outputs!` make a struct of them; the runtime reaches them through [`AnyInput`] and
//! [`AnyOutput`] without knowing the types.

use std::any::Any;
use std::collections::VecDeque;
use std::fmt;
use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

use carril_messages::{CodecError, Encoded, Header, Message, MessageType, Origins, Payload, Stamp, Timespan};
use serde::{Deserialize, Serialize};

use crate::intern;

/// A message whose type is known only at run time.
pub trait AnyMessage: fmt::Debug + Send + Sync {
    /// Its type.
    fn message_type(&self) -> MessageType;
    /// Its wire form.
    fn encode(&self) -> Result<Encoded, CodecError>;
    /// [`Message::encode_into`]
    fn encode_into(&self, buffer: &mut Vec<u8>) -> Result<bool, CodecError>;
    /// For a downcast to the type itself.
    fn into_any(self: Arc<Self>) -> Arc<dyn Any + Send + Sync>;
}

impl<T: Message> AnyMessage for T {
    fn message_type(&self) -> MessageType {
        T::TYPE
    }

    fn encode(&self) -> Result<Encoded, CodecError> {
        Message::encode(self)
    }

    fn encode_into(&self, buffer: &mut Vec<u8>) -> Result<bool, CodecError> {
        Message::encode_into(self, buffer)
    }

    fn into_any(self: Arc<Self>) -> Arc<dyn Any + Send + Sync> {
        self
    }
}

/// A sample on its way into a port.
#[derive(Clone, Debug)]
pub enum Incoming {
    /// From a node of the same process: the message itself, shared.
    Local(Arc<Header>, Arc<dyn AnyMessage>),
    /// From another process. Decoded only when the node takes it.
    Wire(Arc<Header>, Payload),
}

impl Incoming {
    /// The header.
    pub fn header(&self) -> &Arc<Header> {
        match self {
            Self::Local(header, _) | Self::Wire(header, _) => header,
        }
    }
}

/// A sample as an operator reads it. Dereferences to the message.
#[derive(Clone, Debug)]
pub struct Sample<T> {
    header: Arc<Header>,
    value: Arc<T>,
}

impl<T> Sample<T> {
    /// Sequence number, stamps, origins.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Age of the oldest exposure that it derives from; without one, age since publication.
    pub fn age(&self, now: Stamp) -> Timespan {
        self.header.age(now)
    }

    /// The message, shared.
    pub fn value(&self) -> &Arc<T> {
        &self.value
    }
}

impl<T> Deref for Sample<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.value
    }
}

/// What an input port is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputSpec {
    /// Name in the graph file.
    #[serde(deserialize_with = "intern::name")]
    pub name: intern::Name,
    /// One line on what it takes.
    pub doc: String,
    /// What it takes.
    pub message_type: MessageType,
    /// A new sample makes the node step.
    pub triggers: bool,
    /// The graph may leave it unconnected.
    pub optional: bool,
    /// Also takes samples put on the port's own key, `carril/<robot>/<node>/<port>`: `carril pub`.
    pub external: bool,
}

impl InputSpec {
    /// A port that triggers and must be connected.
    pub fn new<T: Message>(name: &'static str, doc: &str) -> Self {
        let doc = doc.trim().to_owned();
        Self { name, doc, message_type: T::TYPE, triggers: true, optional: false, external: false }
    }

    /// A new sample does not make the node step; it is read when the node steps anyway.
    #[must_use]
    pub fn hold(mut self) -> Self {
        self.triggers = false;
        self
    }

    /// The graph may leave it unconnected.
    #[must_use]
    pub fn optional(mut self) -> Self {
        self.optional = true;
        self
    }

    /// People may publish to it with `carril pub`; the graph may leave it unconnected.
    #[must_use]
    pub fn external(mut self) -> Self {
        self.external = true;
        self.optional = true;
        self
    }
}

/// What an output port is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputSpec {
    /// Name in the graph file.
    #[serde(deserialize_with = "intern::name")]
    pub name: intern::Name,
    /// One line on what it gives.
    pub doc: String,
    /// What it gives.
    pub message_type: MessageType,
    /// The operator makes it only while somebody reads it: [`Output::wanted`].
    pub on_demand: bool,
}

impl OutputSpec {
    /// A port that is always served.
    pub fn new<T: Message>(name: &'static str, doc: &str) -> Self {
        Self { name, doc: doc.trim().to_owned(), message_type: T::TYPE, on_demand: false }
    }

    /// Made only while somebody reads it.
    #[must_use]
    pub fn on_demand(mut self) -> Self {
        self.on_demand = true;
        self
    }
}

/// An input port of an operator.
#[derive(Debug)]
pub struct Input<T> {
    unread: VecDeque<Sample<T>>,
    last: Option<Sample<T>>,
    /// The one before `last`. Let go after the step: giving its memory back must not delay what the step sends.
    spent: Option<Sample<T>>,
    now: Stamp,
    max_age: Option<Duration>,
    used: Origins,
    stale: u64,
}

impl<T> Default for Input<T> {
    fn default() -> Self {
        let (unread, used) = (VecDeque::new(), Origins::none());
        Self { unread, last: None, spent: None, now: Stamp::ZERO, max_age: None, used, stale: 0 }
    }
}

impl<T: Message> Input<T> {
    /// The oldest sample not read yet; in order, each once. Samples older than the edge's `max_age_ms` are left out.
    pub fn take(&mut self) -> Option<Sample<T>> {
        while let Some(sample) = self.unread.pop_front() {
            self.spent = self.last.replace(sample.clone());
            if self.fresh(&sample) {
                self.used.merge(&sample.header.origins);
                return Some(sample);
            }
            self.stale += 1;
        }
        None
    }

    /// The newest sample, read before or not. `None` before the first, and when it is older than the edge's `max_age_ms`.
    pub fn latest(&mut self) -> Option<Sample<T>> {
        let new = self.unread.pop_back();
        self.unread.clear();
        let is_new = new.is_some();
        if is_new {
            self.spent = std::mem::replace(&mut self.last, new);
        }
        let sample = self.last.clone()?;
        if self.fresh(&sample) {
            self.used.merge(&sample.header.origins);
            return Some(sample);
        }
        self.stale += u64::from(is_new);
        None
    }

    /// Whether a sample has come that was not read yet.
    pub fn has_news(&self) -> bool {
        !self.unread.is_empty()
    }

    fn fresh(&self, sample: &Sample<T>) -> bool {
        self.max_age.is_none_or(|max| sample.age(self.now) <= Timespan::from(max))
    }

    /// Puts a sample in, for tests of an operator on its own.
    pub fn put(&mut self, value: T, header: Header) {
        self.unread.push_back(Sample { header: Arc::new(header), value: Arc::new(value) });
    }
}

/// An input port without its type.
pub trait AnyInput {
    /// Takes a sample in, or says why it is refused.
    fn accept(&mut self, incoming: Incoming) -> Result<(), CodecError>;
    /// Before a step: the time, and the edge's limit.
    fn begin(&mut self, now: Stamp, max_age: Option<Duration>);
    /// After a step: from which exposures the samples came that the step read.
    fn take_used(&mut self) -> Origins;
    /// After a step whose outputs are out: lets go of what it no longer needs.
    fn end(&mut self);
    /// Samples withheld so far because they were too old.
    fn stale(&self) -> u64;
    /// Whether a sample waits.
    fn has_news(&self) -> bool;
    /// What it holds, for the successor of its operator.
    fn held(&self) -> Held;
    /// Takes over the newest sample that a predecessor has read: the one that [`Input::latest`] gives until there is a newer one.
    fn accept_read(&mut self, incoming: Incoming) -> Result<(), CodecError>;
}

/// What an input port holds between two steps.
#[derive(Clone, Debug, Default)]
pub struct Held {
    /// The newest sample that was read.
    pub read: Option<Incoming>,
    /// Samples that wait, the oldest first.
    pub unread: Vec<Incoming>,
}

impl<T: Message> Sample<T> {
    fn read(incoming: Incoming) -> Result<Self, CodecError> {
        match incoming {
            Incoming::Local(header, message) => {
                let value = message.into_any().downcast::<T>().map_err(|_| CodecError::WrongType {
                    got: header.message_type.to_string(),
                    expected: T::TYPE.to_string(),
                })?;
                Ok(Self { header, value })
            }
            Incoming::Wire(header, payload) => {
                header.expect::<T>()?;
                let value = Arc::new(T::decode(&header.meta, &payload)?);
                Ok(Self { header, value })
            }
        }
    }

    fn to_incoming(&self) -> Incoming {
        Incoming::Local(Arc::clone(&self.header), Arc::clone(&self.value) as Arc<dyn AnyMessage>)
    }
}

impl<T: Message> AnyInput for Input<T> {
    fn accept(&mut self, incoming: Incoming) -> Result<(), CodecError> {
        self.unread.push_back(Sample::read(incoming)?);
        Ok(())
    }

    fn accept_read(&mut self, incoming: Incoming) -> Result<(), CodecError> {
        self.last = Some(Sample::read(incoming)?);
        Ok(())
    }

    fn held(&self) -> Held {
        let read = self.last.as_ref().map(Sample::to_incoming);
        Held { read, unread: self.unread.iter().map(Sample::to_incoming).collect() }
    }

    fn begin(&mut self, now: Stamp, max_age: Option<Duration>) {
        self.now = now;
        self.max_age = max_age;
    }

    fn take_used(&mut self) -> Origins {
        std::mem::take(&mut self.used)
    }

    fn end(&mut self) {
        self.spent = None;
    }

    fn stale(&self) -> u64 {
        self.stale
    }

    fn has_news(&self) -> bool {
        !self.unread.is_empty()
    }
}

/// Where an output comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Provenance {
    /// From the samples that the step read.
    Inputs,
    /// From a sensor that captured at this time. The chain of ages begins here.
    Captured(Stamp),
}

/// A message on its way out of a step.
#[derive(Clone, Debug)]
pub struct Outgoing {
    /// The message.
    pub message: Arc<dyn AnyMessage>,
    /// Where it comes from.
    pub provenance: Provenance,
}

/// An output port of an operator.
#[derive(Debug)]
pub struct Output<T> {
    pending: Vec<(Arc<T>, Provenance)>,
    wanted: bool,
}

impl<T> Default for Output<T> {
    fn default() -> Self {
        Self { pending: Vec::new(), wanted: false }
    }
}

impl<T: Message> Output<T> {
    /// Sends at the end of the step. The age is that of the samples read in this step.
    pub fn send(&mut self, value: T) {
        self.pending.push((Arc::new(value), Provenance::Inputs));
    }

    /// Sends what a sensor captured at `captured`, on the car's clock.
    pub fn send_captured(&mut self, value: T, captured: Stamp) {
        self.pending.push((Arc::new(value), Provenance::Captured(captured)));
    }

    /// Whether somebody reads the port. Costly outputs are made only then.
    pub fn wanted(&self) -> bool {
        self.wanted
    }

    /// Says that somebody reads the port; done by executors and tests.
    pub fn set_wanted(&mut self, wanted: bool) {
        self.wanted = wanted;
    }

    /// What was sent, for tests of an operator on its own.
    pub fn sent(&mut self) -> Vec<Arc<T>> {
        self.pending.drain(..).map(|(value, _)| value).collect()
    }
}

/// An output port without its type.
pub trait AnyOutput {
    /// Takes out what the step sent.
    fn drain(&mut self, take: &mut dyn FnMut(Outgoing));
    /// Says whether somebody reads the port.
    fn set_wanted(&mut self, wanted: bool);
}

impl<T: Message> AnyOutput for Output<T> {
    fn drain(&mut self, take: &mut dyn FnMut(Outgoing)) {
        for (message, provenance) in self.pending.drain(..) {
            take(Outgoing { message, provenance });
        }
    }

    fn set_wanted(&mut self, wanted: bool) {
        self.wanted = wanted;
    }
}

/// The input ports of an operator. Made by [`inputs!`](crate::inputs!).
pub trait InputPorts: Default + Send + 'static {
    /// What they are, in order.
    fn specs() -> Vec<InputSpec>;
    /// Calls `visit` with each, in order.
    fn each(&mut self, visit: &mut dyn FnMut(usize, &mut dyn AnyInput));
    /// The port at `index`; `None` beyond the last.
    fn port(&mut self, index: usize) -> Option<&mut dyn AnyInput>;
}

/// The output ports of an operator. Made by [`outputs!`](crate::outputs!).
pub trait OutputPorts: Default + Send + 'static {
    /// What they are, in order.
    fn specs() -> Vec<OutputSpec>;
    /// Calls `visit` with each, in order.
    fn each(&mut self, visit: &mut dyn FnMut(usize, &mut dyn AnyOutput));
}

/// Makes the input ports of an operator. By default a port triggers and must be connected; `hold`, `optional` and `external`
/// ([`InputSpec`]) change that. The doc comment is the port's help text.
///
/// ```
/// use carril_runtime::messages::{Image, LaserScan};
/// carril_runtime::inputs! {
///     /// What the example reads.
///     pub struct ExampleInputs {
///         /// Camera frames.
///         image: Image,
///         /// The last scan, if there is a lidar.
///         scan: LaserScan [hold optional],
///     }
/// }
/// ```
#[macro_export]
macro_rules! inputs {
    ($(#[$meta:meta])* $vis:vis struct $name:ident {
        $($(#[doc = $doc:literal])+ $port:ident: $type:ty $([$($flag:ident)+])?),+ $(,)?
    }) => {
        $(#[$meta])*
        #[derive(Default)]
        $vis struct $name {
            $($(#[doc = $doc])+ pub $port: $crate::Input<$type>),+
        }

        impl $crate::InputPorts for $name {
            fn specs() -> Vec<$crate::InputSpec> {
                vec![$($crate::InputSpec::new::<$type>(stringify!($port), concat!($($doc),+))$($(.$flag())+)?),+]
            }

            fn each(&mut self, visit: &mut dyn FnMut(usize, &mut dyn $crate::AnyInput)) {
                let ports: &mut [&mut dyn $crate::AnyInput] = &mut [$(&mut self.$port),+];
                for (index, port) in ports.iter_mut().enumerate() {
                    visit(index, *port);
                }
            }

            fn port(&mut self, index: usize) -> Option<&mut dyn $crate::AnyInput> {
                let ports: [&mut dyn $crate::AnyInput; _] = [$(&mut self.$port),+];
                ports.into_iter().nth(index)
            }
        }
    };
}

/// Makes the output ports of an operator. `on_demand` ([`OutputSpec`]) marks those that are made only while somebody reads.
#[macro_export]
macro_rules! outputs {
    ($(#[$meta:meta])* $vis:vis struct $name:ident {
        $($(#[doc = $doc:literal])+ $port:ident: $type:ty $([$($flag:ident)+])?),+ $(,)?
    }) => {
        $(#[$meta])*
        #[derive(Default)]
        $vis struct $name {
            $($(#[doc = $doc])+ pub $port: $crate::Output<$type>),+
        }

        impl $crate::OutputPorts for $name {
            fn specs() -> Vec<$crate::OutputSpec> {
                vec![$($crate::OutputSpec::new::<$type>(stringify!($port), concat!($($doc),+))$($(.$flag())+)?),+]
            }

            fn each(&mut self, visit: &mut dyn FnMut(usize, &mut dyn $crate::AnyOutput)) {
                let ports: &mut [&mut dyn $crate::AnyOutput] = &mut [$(&mut self.$port),+];
                for (index, port) in ports.iter_mut().enumerate() {
                    visit(index, *port);
                }
            }
        }
    };
}

/// The inputs of an operator that has none.
#[derive(Default)]
pub struct NoInputs;

impl InputPorts for NoInputs {
    fn specs() -> Vec<InputSpec> {
        Vec::new()
    }

    fn each(&mut self, _visit: &mut dyn FnMut(usize, &mut dyn AnyInput)) {}

    fn port(&mut self, _index: usize) -> Option<&mut dyn AnyInput> {
        None
    }
}

/// The outputs of an operator that has none.
#[derive(Default)]
pub struct NoOutputs;

impl OutputPorts for NoOutputs {
    fn specs() -> Vec<OutputSpec> {
        Vec::new()
    }

    fn each(&mut self, _visit: &mut dyn FnMut(usize, &mut dyn AnyOutput)) {}
}

#[cfg(test)]
mod tests {
    use carril_messages::{Command, Meta, SourceId};

    use super::*;

    fn header(seq: u64, captured_ns: i64) -> Header {
        let origins = Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(captured_ns));
        let stamp = Stamp::from_nanos(captured_ns);
        Header { epoch: 1, seq, stamp, origins, message_type: Command::TYPE, meta: Meta::new() }
    }

    #[test]
    fn reads_in_order_or_only_the_newest() {
        let mut input = Input::<Command>::default();
        for seq in 0..3 {
            input.put(Command::default(), header(seq, 0));
        }
        assert_eq!(input.take().map(|sample| sample.header().seq), Some(0), "the oldest first");
        assert_eq!(input.latest().map(|sample| sample.header().seq), Some(2), "then the newest");
        assert!(!input.has_news(), "nothing is left");
        assert_eq!(input.latest().map(|sample| sample.header().seq), Some(2), "the newest is held");
    }

    #[test]
    fn withholds_what_is_too_old() {
        let mut input = Input::<Command>::default();
        input.begin(Stamp::from_nanos(5_000), Some(Duration::from_micros(1)));
        input.put(Command::default(), header(0, 3_000));
        input.put(Command::default(), header(1, 4_500));
        assert_eq!(input.take().map(|sample| sample.header().seq), Some(1), "the first is 2000 ns old");
        assert_eq!(input.stale(), 1, "and counted");
        input.begin(Stamp::from_nanos(9_000), Some(Duration::from_micros(1)));
        assert!(input.latest().is_none(), "a held sample grows old too");
    }

    #[test]
    fn refuses_a_foreign_type_and_garbage() {
        let mut input = Input::<Command>::default();
        let mut foreign = header(0, 0);
        foreign.message_type = MessageType::new("carril/LaserScan", 1);
        assert!(input.accept(Incoming::Wire(Arc::new(foreign), Payload::default())).is_err(), "foreign type");
        let garbage = Payload::from(vec![1, 2, 3]);
        assert!(input.accept(Incoming::Wire(Arc::new(header(0, 0)), garbage)).is_err(), "garbage");
        assert!(!input.has_news(), "nothing got in");
    }
}
