//! What waits for one viewer. It never grows: of each key the newest sample only, at most two images of a key on their way, and answers
//! only as many as their reader takes. Answers go first, then news, then data, then images. A viewer that has a second connection, for the
//! view, gets data and images there. Pure but for a lock and bells.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::extract::ws::Utf8Bytes;
use carril_messages::{CompressedImage, Header, Image, Message, Payload};
use carril_runtime::control_plane::LogLine;
use tokio::sync::Notify;

use super::graph::Sources;
use super::messages::{self, Want};
use super::pacer::Pacer;
use crate::gateway::relay::Pace;

/// So many images of a key may be on their way to a viewer.
const ON_THEIR_WAY: usize = 2;
/// How much smaller an image is made on a slow link: share of its width, and of its quality. Each step has some two thirds of the bytes.
const SMALLER: [(f64, f64); 5] = [(1.0, 1.0), (0.8, 0.95), (0.64, 0.9), (0.5, 0.85), (0.4, 0.8)];
/// Data leave so long before the link has room for an image.
const DATA_BEFORE: Duration = Duration::from_millis(100);
/// An image that has been due for so long goes before data.
const LONG: Duration = Duration::from_millis(300);
/// So many answers may wait; then nothing more is read from the viewer.
const MAX_REPLIES: usize = 256;
/// So many lines of the log may wait; then the oldest goes.
const MAX_LOG: usize = 500;
/// So many receipts may wait.
const MAX_RECEIPTS: usize = 64;

/// A sample of the graph.
pub struct Arrival {
    /// `node/port`
    pub key: String,
    /// Its header.
    pub header: Header,
    /// Its bytes.
    pub payload: Payload,
    sources: Arc<Sources>,
    text: OnceLock<Utf8Bytes>,
}

impl Arrival {
    /// Takes it as it comes.
    pub fn new(key: String, header: Header, payload: Payload, sources: Arc<Sources>) -> Self {
        Self { key, header, payload, sources, text: OnceLock::new() }
    }

    /// Whether it is shown as a picture.
    pub fn is_image(&self) -> bool {
        [Image::TYPE, CompressedImage::TYPE].contains(&self.header.message_type)
    }

    /// The message of it, made once for all viewers.
    fn text(&self) -> Utf8Bytes {
        self.text.get_or_init(|| messages::sample(&self.key, &self.header, &self.payload, &self.sources)).clone()
    }
}

/// An image, ready to be sent.
#[derive(Debug)]
pub struct Frame {
    /// Number of the sample.
    pub seq: u64,
    /// The whole message.
    pub bytes: Bytes,
}

/// News of which the newest counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum News {
    /// What the viewer may do.
    Access,
    /// How the car can be driven by hand.
    Drive,
    /// The graph.
    Graph,
    /// How it does.
    Status,
}

/// What has left the server and what was dropped, all viewers together.
#[derive(Debug, Default)]
pub struct Traffic {
    /// Bytes of messages.
    pub sent_bytes: AtomicU64,
    /// Images that were due and were replaced by newer ones.
    pub dropped_images: AtomicU64,
    /// Other samples that were.
    pub dropped_data: AtomicU64,
}

/// What to do next for a viewer.
#[derive(Debug)]
pub enum Next {
    /// Send this text.
    Text(Utf8Bytes),
    /// Send this image.
    Image(Arc<Frame>),
    /// Have the newest image of this key compressed.
    Press(String),
    /// Nothing before the bell rings, or before this time.
    Wait(Option<Instant>),
    /// Say goodbye with this reason.
    Close(String),
}

/// What waits for one viewer.
pub struct Outbox {
    state: Mutex<State>,
    traffic: Arc<Traffic>,
    /// Rings when there is something to do.
    pub bell: Notify,
    /// Rings when there is something to do for the view, if it is apart.
    pub view_bell: Notify,
    /// Rings when answers were taken.
    pub room: Notify,
}

#[derive(Default)]
struct State {
    replies: VecDeque<Utf8Bytes>,
    news: BTreeMap<News, Utf8Bytes>,
    receipts: VecDeque<Utf8Bytes>,
    log: VecDeque<LogLine>,
    /// The old lines of the log have not come yet: new ones wait for them.
    log_held: bool,
    slots: BTreeMap<String, Slot>,
    /// Data and images have a connection of their own.
    view_apart: bool,
    /// How fast the view leaves, if it is apart.
    pacer: Pacer,
    closing: Option<String>,
}

/// An image that has begun to leave.
struct Sent {
    seq: u64,
    begun: Instant,
    /// All that had left before it, B.
    before: u64,
    /// All that had left when it was out, B. `None`: it is not.
    after: Option<u64>,
}

struct Slot {
    pace: Pace,
    max_hz: f64,
    width: u32,
    quality: u8,
    /// How much smaller images are made than they were asked for, so that they fit the link: a step in [`SMALLER`].
    smaller: usize,
    newest: Option<Arc<Arrival>>,
    /// Images that were sent and not acknowledged, in this order.
    on_their_way: VecDeque<Sent>,
    pressing: bool,
    pressed: Option<Arc<Frame>>,
}

impl Slot {
    fn new(want: &Want) -> Self {
        let mut slot = Self {
            pace: Pace::new(1.0),
            max_hz: f64::NAN,
            width: 0,
            quality: 0,
            smaller: 0,
            newest: None,
            on_their_way: VecDeque::new(),
            pressing: false,
            pressed: None,
        };
        slot.follow(want);
        slot
    }

    fn follow(&mut self, want: &Want) {
        let max_hz = if want.max_hz > 0.0 { want.max_hz.clamp(0.01, 1000.0) } else { 0.01 };
        if self.max_hz.to_bits() != max_hz.to_bits() {
            (self.pace, self.max_hz) = (Pace::new(max_hz), max_hz);
        }
        self.width = want.width.unwrap_or(480).clamp(16, 4096);
        self.quality = want.quality.unwrap_or(70).clamp(1, 100) as u8;
    }

    /// A picture of so many bytes was made where so many are good.
    fn fit(&mut self, bytes: usize, good: usize) {
        if bytes > good && self.smaller + 1 < SMALLER.len() {
            self.smaller += 1;
        } else if bytes * 2 < good {
            // A step back makes it larger by less than that.
            self.smaller = self.smaller.saturating_sub(1);
        }
    }

    fn due(&self, now: Instant) -> bool {
        self.pace.due().is_none_or(|due| now >= due)
    }

    fn has_way(&self) -> bool {
        !self.pressing && self.pressed.is_none() && self.on_their_way.len() < ON_THEIR_WAY
    }
}

impl Outbox {
    /// An empty one. New lines of the log wait in it for the old ones.
    pub fn new(traffic: Arc<Traffic>) -> Self {
        let state = State { log_held: true, ..State::default() };
        let (bell, view_bell, room) = (Notify::new(), Notify::new(), Notify::new());
        Self { state: Mutex::new(state), traffic, bell, view_bell, room }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An answer, before all else.
    pub fn reply(&self, text: Utf8Bytes) {
        self.lock().replies.push_back(text);
        self.bell.notify_one();
    }

    /// Whether more may be read from the viewer.
    pub fn has_room(&self) -> bool {
        self.lock().replies.len() < MAX_REPLIES
    }

    /// News; older ones of the same kind are forgotten.
    pub fn news(&self, news: News, text: Utf8Bytes) {
        self.lock().news.insert(news, text);
        self.bell.notify_one();
    }

    /// How a change came out.
    pub fn receipt(&self, text: Utf8Bytes) {
        let mut state = self.lock();
        push_bounded(&mut state.receipts, text, MAX_RECEIPTS);
        drop(state);
        self.bell.notify_one();
    }

    /// A new line of the log.
    pub fn log(&self, line: LogLine) {
        let mut state = self.lock();
        push_bounded(&mut state.log, line, MAX_LOG);
        drop(state);
        self.bell.notify_one();
    }

    /// The old lines of the log. Those that came meanwhile follow, and none comes twice.
    pub fn old_log(&self, old: Vec<LogLine>) {
        let mut state = self.lock();
        let mut all: VecDeque<LogLine> = VecDeque::new();
        for line in old {
            push_bounded(&mut all, line, MAX_LOG);
        }
        for line in std::mem::take(&mut state.log) {
            if !all.contains(&line) {
                push_bounded(&mut all, line, MAX_LOG);
            }
        }
        (state.log, state.log_held) = (all, false);
        drop(state);
        self.bell.notify_one();
    }

    /// The keys that the viewer wants from now on, and no others.
    pub fn follow(&self, wants: &[Want]) {
        let mut state = self.lock();
        state.slots.retain(|key, _| wants.iter().any(|want| want.key == *key));
        for want in wants {
            match state.slots.get_mut(&want.key) {
                Some(slot) => slot.follow(want),
                None => drop(state.slots.insert(want.key.clone(), Slot::new(want))),
            }
        }
        self.ring_for_view(state);
    }

    /// Data and images go over a connection of their own from now on, or no longer.
    pub fn set_view_apart(&self, apart: bool) {
        let mut state = self.lock();
        state.view_apart = apart;
        state.pacer = Pacer::default();
        for slot in state.slots.values_mut() {
            // What was on its way on the other connection is answered for on none.
            slot.on_their_way.clear();
            slot.smaller = 0;
        }
        drop(state);
        self.bell.notify_one();
        self.view_bell.notify_one();
    }

    fn ring_for_view(&self, state: MutexGuard<'_, State>) {
        let bell = if state.view_apart { &self.view_bell } else { &self.bell };
        drop(state);
        bell.notify_one();
    }

    /// A sample; an older one of its key is forgotten.
    pub fn offer(&self, arrival: &Arc<Arrival>, now: Instant) {
        let mut state = self.lock();
        let Some(slot) = state.slots.get_mut(&arrival.key) else { return };
        let late = slot.due(now);
        if slot.newest.replace(Arc::clone(arrival)).is_some() && late {
            let dropped = if arrival.is_image() { &self.traffic.dropped_images } else { &self.traffic.dropped_data };
            dropped.fetch_add(1, Ordering::Relaxed);
        }
        self.ring_for_view(state);
    }

    /// An image, and all that were sent before it, have arrived.
    pub fn ack(&self, key: &str, seq: u64, now: Instant) {
        let mut state = self.lock();
        let State { slots, pacer, .. } = &mut *state;
        if let Some(slot) = slots.get_mut(key)
            && let Some(at) = slot.on_their_way.iter().position(|sent| sent.seq == seq)
            && let Some(sent) = slot.on_their_way.drain(..=at).next_back()
            && let Some(after) = sent.after
        {
            pacer.arrived(after - sent.before, now.saturating_duration_since(sent.begun));
        }
        self.ring_for_view(state);
    }

    /// The last piece of an image has left on the connection of the view.
    pub fn image_left(&self, seq: u64) {
        let mut state = self.lock();
        let State { slots, pacer, .. } = &mut *state;
        let sent = slots.values_mut().flat_map(|slot| &mut slot.on_their_way);
        for sent in sent.filter(|sent| sent.seq == seq && sent.after.is_none()) {
            sent.after = Some(pacer.left_bytes());
        }
    }

    /// A part of the view leaves now on its own connection.
    pub fn leave(&self, bytes: usize, now: Instant) {
        self.lock().pacer.leave(bytes, now);
    }

    /// A ping that left there before an image was answered after this time.
    pub fn answered(&self, round_trip: Duration) {
        self.lock().pacer.answered(round_trip);
    }

    /// When the next piece of an image may leave there. `None`: at once.
    pub fn next_piece(&self) -> Option<Instant> {
        self.lock().pacer.next_piece()
    }

    /// The newest image of a key, and how it is wanted: for the press, which must answer with [`Self::pressed`].
    pub fn take_image(&self, key: &str) -> Option<(Arc<Arrival>, u32, u8)> {
        let mut state = self.lock();
        let slot = state.slots.get_mut(key)?;
        let (width, quality) = SMALLER[slot.smaller];
        let width = (f64::from(slot.width) * width) as u32;
        let quality = (f64::from(slot.quality) * quality) as u8;
        let taken = slot.newest.take().map(|newest| (newest, width.max(16), quality.max(1)));
        slot.pressing = taken.is_some();
        taken
    }

    /// An image is ready; `None`: it could not be made.
    pub fn pressed(&self, key: &str, frame: Option<Arc<Frame>>) {
        let mut guard = self.lock();
        let state = &mut *guard;
        if let Some(slot) = state.slots.get_mut(key).filter(|slot| slot.pressing) {
            if let Some(frame) = frame.as_ref().filter(|_| state.view_apart) {
                slot.fit(frame.bytes.len(), state.pacer.picture_bytes());
            }
            (slot.pressing, slot.pressed) = (false, frame);
        }
        self.ring_for_view(guard);
    }

    /// Says goodbye, once the answers are out.
    pub fn close(&self, reason: &str) {
        self.lock().closing.get_or_insert_with(|| reason.to_owned());
        self.bell.notify_one();
        self.view_bell.notify_one();
    }

    /// What to do now.
    pub fn next(&self, now: Instant) -> Next {
        let mut state = self.lock();
        if let Some(reply) = state.replies.pop_front() {
            drop(state);
            self.room.notify_one();
            return Next::Text(reply);
        }
        if let Some(reason) = &state.closing {
            return Next::Close(reason.clone());
        }
        if let Some((_, text)) = state.news.pop_first() {
            return Next::Text(text);
        }
        if let Some(text) = state.receipts.pop_front() {
            return Next::Text(text);
        }
        if !state.log_held
            && let Some(line) = state.log.pop_front()
        {
            return Next::Text(messages::log(&line));
        }
        if state.view_apart {
            return Next::Wait(None);
        }
        state.view(now)
    }

    /// What to do now on the connection of the view.
    pub fn next_view(&self, now: Instant) -> Next {
        let mut state = self.lock();
        if state.closing.is_some() { Next::Close(String::new()) } else { state.view(now) }
    }
}

fn push_bounded<T>(queue: &mut VecDeque<T>, item: T, most: usize) {
    if queue.len() >= most {
        queue.pop_front();
    }
    queue.push_back(item);
}

impl Outbox {
    /// The sample of data that is due, if there is one.
    pub fn next_data(&self, now: Instant) -> Option<Utf8Bytes> {
        match self.lock().data(now) {
            Some(Next::Text(text)) => Some(text),
            _ => None,
        }
    }
}

impl State {
    fn view(&mut self, now: Instant) -> Next {
        let image = |state: &mut Self| state.ready(now).or_else(|| state.image(now));
        let first = if self.has_long_been_due(now) { image(self) } else { None };
        first.or_else(|| self.data(now)).or_else(|| image(self)).unwrap_or_else(|| Next::Wait(self.next_due()))
    }

    /// Whether an image has waited so long that data would keep it waiting for ever.
    fn has_long_been_due(&self, now: Instant) -> bool {
        let waits = |slot: &Slot| slot.newest.as_ref().is_some_and(|newest| newest.is_image()) && slot.has_way();
        self.view_apart
            && self.slots.values().any(|slot| waits(slot) && slot.pace.due().is_some_and(|due| due + LONG <= now))
    }

    /// When the link has room for an image, ...
    fn room_for_image(&self) -> Option<Instant> {
        self.pacer.next_image().filter(|_| self.view_apart)
    }

    /// ... and when for data, which are small.
    fn room_for_data(&self) -> Option<Instant> {
        self.room_for_image().and_then(|room| room.checked_sub(DATA_BEFORE))
    }

    /// The sample that has been due for longest.
    fn data(&mut self, now: Instant) -> Option<Next> {
        if self.room_for_data().is_some_and(|room| room > now) {
            return None;
        }
        let fits = |slot: &&mut Slot| slot.newest.as_ref().is_some_and(|newest| !newest.is_image()) && slot.due(now);
        let slot = self.slots.values_mut().filter(fits).min_by_key(|slot| slot.pace.due())?;
        slot.pace.pass(now);
        Some(Next::Text(slot.newest.take()?.text()))
    }

    /// An image that was made.
    fn ready(&mut self, now: Instant) -> Option<Next> {
        let slot = self.slots.values_mut().find(|slot| slot.pressed.is_some())?;
        let frame = slot.pressed.take()?;
        slot.on_their_way.push_back(Sent { seq: frame.seq, begun: now, before: self.pacer.left_bytes(), after: None });
        Some(Next::Image(frame))
    }

    /// The image that has been due for longest.
    fn image(&mut self, now: Instant) -> Option<Next> {
        let room = if self.has_long_been_due(now) { self.room_for_data() } else { self.room_for_image() };
        if room.is_some_and(|room| room > now) {
            return None;
        }
        let fits = |slot: &Slot| slot.newest.as_ref().is_some_and(|newest| newest.is_image()) && slot.has_way();
        let due = self.slots.iter_mut().filter(|(_, slot)| fits(slot) && slot.due(now));
        let (key, slot) = due.min_by_key(|(_, slot)| slot.pace.due())?;
        slot.pace.pass(now);
        slot.pressing = true;
        Some(Next::Press(key.clone()))
    }

    /// When something that waits only for its pace, or for room, may go.
    fn next_due(&self) -> Option<Instant> {
        let (image, data) = (self.room_for_image(), self.room_for_data());
        let may_go = |slot: &Slot| {
            let is_image = slot.newest.as_ref()?.is_image();
            if is_image && !slot.has_way() {
                return None;
            }
            slot.pace.due().max(if is_image { image } else { data })
        };
        self.slots.values().filter_map(may_go).min()
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Command, Encoding, Origins, Stamp};
    use carril_runtime::control_plane::LogLevel;

    use super::*;

    fn want(key: &str, max_hz: f64) -> Want {
        Want { key: key.into(), max_hz, width: None, quality: None }
    }

    fn arrival<T: Message>(key: &str, seq: u64, message: &T) -> Arc<Arrival> {
        let encoded = message.encode().expect("it encodes");
        let header = Header {
            epoch: 1,
            seq,
            stamp: Stamp::from_nanos(seq as i64),
            origins: Origins::none(),
            message_type: T::TYPE,
            meta: encoded.meta,
        };
        Arc::new(Arrival::new(key.into(), header, encoded.payload, Arc::default()))
    }

    fn command(seq: u64) -> Arc<Arrival> {
        arrival("decision/command", seq, &Command::default())
    }

    fn image(seq: u64) -> Arc<Arrival> {
        let grey = Image::packed(1, 1, Encoding::Mono8, Payload::from(vec![7])).expect("it fits");
        arrival("world/camera", seq, &grey)
    }

    fn frame(seq: u64) -> Arc<Frame> {
        Arc::new(Frame { seq, bytes: Bytes::new() })
    }

    fn outbox(wants: &[Want]) -> Outbox {
        let outbox = Outbox::new(Arc::default());
        outbox.old_log(Vec::new());
        outbox.follow(wants);
        outbox
    }

    fn say(outbox: &Outbox, now: Instant) -> String {
        match outbox.next(now) {
            Next::Text(text) => text.to_string(),
            Next::Image(frame) => format!("image {}", frame.seq),
            Next::Press(key) => format!("press {key}"),
            Next::Wait(_) => "wait".into(),
            Next::Close(reason) => format!("close {reason}"),
        }
    }

    #[test]
    fn answers_go_before_news_before_data_before_images() {
        let outbox = outbox(&[want("decision/command", 30.0), want("world/camera", 30.0)]);
        let now = Instant::now();
        outbox.offer(&image(1), now);
        outbox.offer(&command(1), now);
        outbox.news(News::Status, "status".into());
        outbox.news(News::Graph, "graph".into());
        outbox.reply("answer".into());
        assert_eq!(
            (say(&outbox, now), say(&outbox, now), say(&outbox, now)),
            ("answer".into(), "graph".into(), "status".into())
        );
        assert!(say(&outbox, now).contains("decision/command"), "data");
        assert_eq!(say(&outbox, now), "press world/camera", "an image is made last");
        assert!(outbox.take_image("world/camera").is_some(), "the press takes it");
        outbox.pressed("world/camera", Some(frame(1)));
        outbox.reply("later answer".into());
        assert_eq!(
            (say(&outbox, now), say(&outbox, now)),
            ("later answer".into(), "image 1".into()),
            "not even a ready one goes before"
        );
    }

    #[test]
    fn of_each_key_the_newest_goes_at_its_pace() {
        let outbox = outbox(&[want("decision/command", 10.0)]);
        let begun = Instant::now();
        outbox.offer(&command(1), begun);
        assert!(say(&outbox, begun).contains(r#""seq":1"#), "the first at once");
        for seq in 2..6 {
            outbox.offer(&command(seq), begun + Duration::from_millis(seq));
        }
        assert_eq!(outbox.traffic.dropped_data.load(Ordering::Relaxed), 0, "what the pace leaves out is not dropped");
        let Next::Wait(Some(due)) = outbox.next(begun + Duration::from_millis(6)) else { panic!("it is not due") };
        outbox.offer(&command(6), due);
        assert_eq!(outbox.traffic.dropped_data.load(Ordering::Relaxed), 1, "what was due is");
        assert!(say(&outbox, due).contains(r#""seq":6"#), "the newest, when it is due");
        assert_eq!(say(&outbox, due), "wait", "and it alone");
        outbox.offer(&arrival("lane/other", 1, &Command::default()), due);
        assert_eq!(say(&outbox, due), "wait", "nobody asked for that key");
    }

    #[test]
    fn two_images_are_on_their_way_and_an_ack_frees_all_before_it() {
        let outbox = outbox(&[want("world/camera", 1000.0)]);
        let mut now = Instant::now();
        let mut send = |outbox: &Outbox, seq: u64| {
            now += Duration::from_secs(1);
            outbox.offer(&image(seq), now);
            let pressed = matches!(outbox.next(now), Next::Press(_));
            if pressed {
                outbox.take_image("world/camera");
                outbox.pressed("world/camera", Some(frame(seq)));
                assert_eq!(say(outbox, now), format!("image {seq}"));
            }
            pressed
        };
        assert!(send(&outbox, 1) && send(&outbox, 2), "two go");
        assert!(!send(&outbox, 3) && !send(&outbox, 4), "the next wait");
        outbox.ack("world/camera", 7, Instant::now());
        assert!(!send(&outbox, 5), "an ack of what was never sent frees nothing");
        outbox.ack("world/camera", 2, Instant::now());
        assert!(send(&outbox, 6) && send(&outbox, 7) && !send(&outbox, 8), "an ack is for all before it");
        assert_eq!(
            outbox.traffic.dropped_images.load(Ordering::Relaxed),
            3,
            "replaced while there was no way: 3, 4, 5"
        );
        outbox.follow(&[]);
        outbox.follow(&[want("world/camera", 1000.0)]);
        assert!(send(&outbox, 9), "a key that is asked for anew begins anew");
    }

    #[test]
    fn an_image_that_cannot_be_made_blocks_nothing() {
        let outbox = outbox(&[want("world/camera", 1000.0)]);
        let now = Instant::now();
        outbox.offer(&image(1), now);
        assert_eq!(say(&outbox, now), "press world/camera");
        outbox.take_image("world/camera");
        outbox.pressed("world/camera", None);
        outbox.offer(&image(2), now);
        assert_eq!(say(&outbox, now + Duration::from_secs(1)), "press world/camera", "the next is tried");
    }

    #[test]
    fn queues_have_an_end() {
        let outbox = outbox(&[]);
        let line = |at: i64| LogLine {
            stamp: Stamp::from_nanos(at),
            level: LogLevel::Info,
            process: "lane".into(),
            text: format!("line {at}"),
        };
        for at in 0..2000 {
            outbox.log(line(at));
            outbox.receipt("receipt".into());
            outbox.news(News::Status, format!("status {at}").into());
        }
        assert!(outbox.has_room());
        for _ in 0..MAX_REPLIES {
            outbox.reply("answer".into());
        }
        assert!(!outbox.has_room(), "then nothing more is read");
        let all = std::iter::from_fn(|| Some(say(&outbox, Instant::now())).filter(|said| said != "wait"));
        let all: Vec<String> = all.collect();
        assert_eq!(all.len(), MAX_REPLIES + 1 + MAX_RECEIPTS + MAX_LOG, "bounded");
        assert!(all.last().is_some_and(|last| last.contains("line 1999")), "the newest lines stay");
    }

    #[test]
    fn old_lines_come_first_and_none_twice() {
        let outbox = Outbox::new(Arc::default());
        let line = |at: i64| LogLine {
            stamp: Stamp::from_nanos(at),
            level: LogLevel::Info,
            process: "lane".into(),
            text: format!("line {at}"),
        };
        outbox.log(line(3));
        outbox.log(line(4));
        assert_eq!(say(&outbox, Instant::now()), "wait", "new lines wait for the old ones");
        outbox.old_log(vec![line(1), line(2), line(3)]);
        for at in 1..5 {
            assert!(say(&outbox, Instant::now()).contains(&format!("line {at}")), "line {at}");
        }
        assert_eq!(say(&outbox, Instant::now()), "wait", "no line twice");
    }

    #[test]
    fn goodbye_comes_after_the_answers_and_before_the_rest() {
        let outbox = outbox(&[]);
        outbox.news(News::Status, "status".into());
        outbox.reply("answer".into());
        outbox.close("the graph has ended");
        outbox.close("another reason");
        assert_eq!(
            (say(&outbox, Instant::now()), say(&outbox, Instant::now())),
            ("answer".into(), "close the graph has ended".into())
        );
    }
}
