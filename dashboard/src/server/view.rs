//! The second connection of a viewer: data and images, at a pace that leaves no queue on the link. What people ask and are answered goes
//! over the first one, and so waits for none of it: neither in a socket, nor for a packet that is sent again, nor in the radio.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::extract::ws::{Message, WebSocket};
use futures_util::{SinkExt, StreamExt};

use super::doors::Peer;
use super::house::{House, Viewer};
use super::messages::FromView;
use super::outbox::{Frame, Next, Outbox};
use super::viewer::{ONE_MESSAGE, Out, SIGN_OF_LIFE};

/// Whoever connects says whose view it is within this time.
const FIRST_WORD: Duration = Duration::from_secs(5);
/// An image leaves in pieces of this size: with TLS, WebSocket and TCP around it one packet, B.
const PIECE: usize = 1300;
/// Timers are no finer than this.
const TICK: Duration = Duration::from_millis(2);

/// Carries the view of a viewer until either has gone.
pub async fn serve(house: Arc<House>, peer: Peer, mut socket: WebSocket) {
    let Ok(Some(Ok(Message::Text(first)))) = tokio::time::timeout(FIRST_WORD, socket.recv()).await else { return };
    let Ok(FromView::View { of }) = serde_json::from_str(&first) else { return };
    let Some(viewer) = house.of_view(&of, &peer) else { return };
    let _apart = Apart::begin(&viewer);
    let (sink, mut stream) = socket.split();
    let begun = Instant::now();
    let heard = async {
        // It says nothing more; what comes are answers to pings, and the end.
        while let Some(Ok(message)) = stream.next().await {
            match message {
                Message::Pong(sent) => {
                    if let Some(sent) =
                        sent.first_chunk().map(|micros| Duration::from_micros(u64::from_le_bytes(*micros)))
                        && let Some(round_trip) = begun.elapsed().checked_sub(sent)
                    {
                        viewer.outbox.answered(round_trip);
                    }
                }
                Message::Close(_) => break,
                _ => {}
            }
        }
    };
    tokio::select! {
        () = write(&house, &viewer.outbox, begun, sink) => {}
        () = heard => {}
    }
}

/// While it lives, the view of a viewer is apart.
struct Apart(Arc<Outbox>);

impl Apart {
    fn begin(viewer: &Viewer) -> Self {
        viewer.outbox.set_view_apart(true);
        Self(Arc::clone(&viewer.outbox))
    }
}

impl Drop for Apart {
    fn drop(&mut self) {
        self.0.set_view_apart(false);
    }
}

/// An image of which a part has left.
struct Leaving {
    frame: Arc<Frame>,
    at: usize,
}

impl Leaving {
    fn piece(&mut self) -> Bytes {
        let end = (self.at + PIECE).min(self.frame.bytes.len());
        let piece = self.frame.bytes.slice(self.at..end);
        self.at = end;
        piece
    }

    fn is_done(&self) -> bool {
        self.at >= self.frame.bytes.len()
    }
}

async fn write(house: &House, outbox: &Arc<Outbox>, begun: Instant, mut sink: Out) {
    let mut alive = tokio::time::interval(SIGN_OF_LIFE);
    let mut leaving: Option<Leaving> = None;
    loop {
        let now = Instant::now();
        // Between two pieces of an image there is time for data.
        let next = match leaving {
            Some(_) => outbox.next_data(now).map_or(Next::Wait(outbox.next_piece()), Next::Text),
            None => outbox.next_view(now),
        };
        let message = match (next, &mut leaving) {
            (Next::Text(text), _) => Message::Text(text),
            (Next::Wait(due), Some(image)) if due.is_none_or(|due| due <= now + TICK) => Message::Binary(image.piece()),
            (Next::Image(frame), _) => {
                leaving = Some(Leaving { frame, at: 0 });
                // Before it, so that it does not wait behind it.
                let micros = begun.elapsed().as_micros() as u64;
                Message::Ping(Bytes::copy_from_slice(&micros.to_le_bytes()))
            }
            (Next::Press(key), _) => {
                house.press.order(outbox, key);
                continue;
            }
            (Next::Close(_), _) => return,
            (Next::Wait(until), _) => {
                let patience = until.map_or(SIGN_OF_LIFE, |until| until.saturating_duration_since(now));
                tokio::select! {
                    () = outbox.view_bell.notified() => continue,
                    () = tokio::time::sleep(patience) => continue,
                    _ = alive.tick() => Message::Ping(Bytes::new()),
                }
            }
        };
        let size = match &message {
            Message::Text(text) => text.len(),
            Message::Binary(bytes) => bytes.len(),
            _ => 0,
        };
        outbox.leave(size, now);
        if !matches!(tokio::time::timeout(ONE_MESSAGE, sink.send(message)).await, Ok(Ok(()))) {
            return;
        }
        house.traffic.sent_bytes.fetch_add(size as u64, Ordering::Relaxed);
        if let Some(image) = leaving.take_if(|image| image.is_done()) {
            outbox.image_left(image.frame.seq);
        }
    }
}
