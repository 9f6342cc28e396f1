//! One viewer: what it says is read by one task, what waits for it is written by another, so that neither waits for the other.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};

use super::house::{House, Viewer, lock};
use super::hub::Port;
use super::messages::{self, FromPage, Want};
use super::outbox::{News, Next, Outbox};
use super::requests;

/// Requests of a viewer that are answered at a time.
pub const ASKING: usize = 16;
/// So many messages that cannot be read end a connection.
const UNREADABLE: u32 = 20;
/// A viewer is asked for a sign of life this often ...
pub const SIGN_OF_LIFE: Duration = Duration::from_secs(5);
/// ... and is gone when none comes for so long.
const SILENCE: Duration = Duration::from_secs(15);
/// One message is out within this time, or the link is dead.
pub const ONE_MESSAGE: Duration = Duration::from_secs(10);
/// The graph is known within this time, or the page begins without.
const FIRST_GRAPH: Duration = Duration::from_secs(3);

/// Serves a viewer until it has gone.
pub async fn serve(house: Arc<House>, viewer: Arc<Viewer>, socket: WebSocket) {
    // Until the goodbye is out: the server waits for that when it ends.
    let _serving = house.serving();
    let leave = Leave(Arc::clone(&house), Arc::clone(&viewer));
    let (sink, stream) = socket.split();
    greet(&house, &viewer).await;
    let mut writer = tokio::spawn(write(Arc::clone(&house), Arc::clone(&viewer), sink));
    let reader = Reader { house, viewer, ports: BTreeMap::new(), unreadable: 0 };
    let outbox = Arc::clone(&reader.viewer.outbox);
    tokio::select! {
        reason = reader.run(stream) => {
            // At once: nothing that it does counts from here on.
            drop(leave);
            outbox.close(&reason);
            let _ = tokio::time::timeout(ONE_MESSAGE, &mut writer).await;
        }
        _ = &mut writer => {}
    }
    writer.abort();
}

/// Whatever happens, whoever has gone does not drive and has no place.
struct Leave(Arc<House>, Arc<Viewer>);

impl Drop for Leave {
    fn drop(&mut self) {
        self.0.leave(&self.1);
    }
}

async fn greet(house: &Arc<House>, viewer: &Arc<Viewer>) {
    let mut graph = house.graph.subscribe();
    // The graph is not looked at while nobody is there, and then must be first.
    let known = tokio::time::timeout(FIRST_GRAPH, graph.wait_for(Option::is_some)).await;
    let known = known.ok().and_then(Result::ok).and_then(|graph| graph.clone());
    let access = lock(&viewer.told).clone();
    let reads = house.may_read(&access);
    let (can_log_in, estop_open) = (house.can_log_in(&viewer.peer), house.options.estop_for_all);
    let (file, now) = (house.client.file(), house.client.clock().now());
    let drive = known.as_ref().and_then(|graph| graph.drive.as_ref()).filter(|_| reads);
    viewer.outbox.reply(messages::hello(file, drive, &access, can_log_in, estop_open, viewer.view.as_deref(), now));
    if !reads {
        return viewer.outbox.old_log(Vec::new());
    }
    if let Some(graph) = known {
        viewer.outbox.news(News::Graph, graph.text.clone());
    }
    let (house, outbox) = (Arc::clone(house), Arc::clone(&viewer.outbox));
    tokio::spawn(async move {
        let Ok(_place) = house.limits.looks.acquire().await else { return };
        let client = Arc::clone(&house.client);
        let old = tokio::task::spawn_blocking(move || client.log()).await;
        outbox.old_log(old.ok().and_then(Result::ok).unwrap_or_default());
    });
}

struct Reader {
    house: Arc<House>,
    viewer: Arc<Viewer>,
    /// Ports that it looks at.
    ports: BTreeMap<String, Arc<Port>>,
    unreadable: u32,
}

impl Reader {
    /// Reads until it is over. Why, if it was not the viewer who ended it.
    async fn run(mut self, mut stream: SplitStream<WebSocket>) -> String {
        let mut end = self.house.end.subscribe();
        loop {
            let said = tokio::select! {
                said = self.next(&mut stream) => said,
                ended = end.wait_for(Option::is_some) => {
                    return ended.ok().and_then(|reason| reason.clone()).unwrap_or_default();
                }
            };
            match said {
                Ok(Message::Text(text)) => match messages::read(&text) {
                    Ok(message) => self.hear(message).await,
                    Err(error) => self.refuse(&error),
                },
                Ok(Message::Binary(_)) => self.refuse("messages are text"),
                Ok(Message::Ping(_) | Message::Pong(_)) => {}
                Ok(Message::Close(_)) => return String::new(),
                Err(reason) => return reason,
            }
            if self.unreadable >= UNREADABLE {
                return format!("{UNREADABLE} messages that cannot be read");
            }
        }
    }

    async fn next(&self, stream: &mut SplitStream<WebSocket>) -> Result<Message, String> {
        // Whoever does not take the answers is not heard.
        while !self.viewer.outbox.has_room() {
            self.viewer.outbox.room.notified().await;
        }
        match tokio::time::timeout(SILENCE, stream.next()).await {
            Ok(Some(Ok(message))) => Ok(message),
            Ok(Some(Err(error))) => Err(error.to_string()),
            Ok(None) => Err(String::new()),
            Err(_) => Err("no sign of life".into()),
        }
    }

    fn refuse(&mut self, error: &str) {
        self.unreadable += 1;
        self.viewer.outbox.reply(messages::refused(error));
    }

    async fn hear(&mut self, message: FromPage) {
        let outbox = &self.viewer.outbox;
        match message {
            FromPage::Subscribe { keys } => self.follow(keys).await,
            FromPage::Ack { key, seq } => outbox.ack(&key, seq, Instant::now()),
            FromPage::Ping { id } => outbox.reply(messages::pong(id, self.house.client.clock().now())),
            FromPage::Drive { seq, steering_rad, speed_m_s, seen_ms } => {
                let driven = requests::drive(&self.house, &self.viewer, steering_rad, speed_m_s, seen_ms);
                let now = self.house.client.clock().now();
                outbox.reply(messages::drive_ack(seq, now, driven.err().as_deref()));
            }
            FromPage::DriveEnd => self.house.wheel.let_go(self.viewer.id),
            FromPage::Pixel { id, .. }
            | FromPage::Control { id, .. }
            | FromPage::Set { id, .. }
            | FromPage::Swap { id, .. }
            | FromPage::Rollback { id, .. }
            | FromPage::Restart { id, .. }
            | FromPage::Pub { id, .. } => self.ask(id, message),
        }
    }

    /// Aside: a change takes seconds, and a word must not wait for it.
    fn ask(&self, id: u64, request: FromPage) {
        let (house, viewer) = (Arc::clone(&self.house), Arc::clone(&self.viewer));
        let is_stop = matches!(request, FromPage::Control { word: messages::Word::Estop | messages::Word::Stop, .. });
        let place = Arc::clone(&viewer.asking).try_acquire_owned().ok();
        if place.is_none() && !is_stop {
            let error = format!("{ASKING} requests are being answered already; try again");
            return viewer.outbox.reply(messages::reply(id, Err(error)));
        }
        tokio::spawn(async move {
            let answer = requests::answer(&house, &viewer, request).await;
            viewer.outbox.reply(messages::reply(id, answer));
            drop(place);
        });
    }

    /// What it wants to see from now on.
    async fn follow(&mut self, mut wants: Vec<Want>) {
        if !self.house.may_read(&lock(&self.viewer.told)) {
            wants.clear();
        }
        let outbox = &self.viewer.outbox;
        self.ports.retain(|key, port| {
            let wanted = wants.iter().any(|want| want.key == *key);
            if !wanted {
                port.part_from(outbox);
            }
            wanted
        });
        outbox.follow(&wants);
        let new = wants.into_iter().map(|want| want.key).filter(|key| !self.ports.contains_key(key));
        let (house, new) = (Arc::clone(&self.house), new.collect::<Vec<_>>());
        if new.is_empty() {
            return;
        }
        let Ok(_place) = self.house.limits.looks.acquire().await else { return };
        let listen = move || new.into_iter().map(|key| (house.hub.listen(&key), key)).collect::<Vec<_>>();
        for (port, key) in tokio::task::spawn_blocking(listen).await.unwrap_or_default() {
            match port {
                Ok(port) => {
                    port.pass_to(outbox);
                    self.ports.insert(key, port);
                }
                Err(error) => outbox.reply(messages::refused(&error)),
            }
        }
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        for port in self.ports.values() {
            port.part_from(&self.viewer.outbox);
        }
    }
}

/// Where messages to a viewer go.
pub type Out = SplitSink<WebSocket, Message>;

/// Writes what waits, until there is nothing more to say or nobody to say it to.
async fn write(house: Arc<House>, viewer: Arc<Viewer>, mut sink: Out) {
    let outbox: &Arc<Outbox> = &viewer.outbox;
    let mut alive = tokio::time::interval(SIGN_OF_LIFE);
    loop {
        let message = match outbox.next(Instant::now()) {
            Next::Text(text) => Message::Text(text),
            Next::Image(frame) => Message::Binary(frame.bytes.clone()),
            Next::Press(key) => {
                house.press.order(outbox, key);
                continue;
            }
            Next::Close(reason) => return say_goodbye(&mut sink, &reason).await,
            Next::Wait(until) => {
                let due = until.map_or(SIGN_OF_LIFE, |until| until.saturating_duration_since(Instant::now()));
                tokio::select! {
                    () = outbox.bell.notified() => continue,
                    () = tokio::time::sleep(due) => continue,
                    _ = alive.tick() => Message::Ping(Bytes::new()),
                }
            }
        };
        let size = match &message {
            Message::Text(text) => text.len(),
            Message::Binary(bytes) => bytes.len(),
            _ => 0,
        };
        match tokio::time::timeout(ONE_MESSAGE, sink.send(message)).await {
            Ok(Ok(())) => drop(house.traffic.sent_bytes.fetch_add(size as u64, Ordering::Relaxed)),
            _ => return,
        }
    }
}

async fn say_goodbye(sink: &mut Out, reason: &str) {
    let goodbye = async {
        if reason.is_empty() {
            return sink.close().await;
        }
        sink.feed(Message::Text(messages::bye(reason))).await?;
        // A reason in a close frame has at most 123 bytes; all of it stands in the message before.
        let frame = CloseFrame { code: close_code::POLICY, reason: "".into() };
        sink.send(Message::Close(Some(frame))).await
    };
    let _ = tokio::time::timeout(ONE_MESSAGE, goodbye).await;
}
