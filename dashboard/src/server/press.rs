//! Compresses images, on a thread of its own. The same image is compressed once for all viewers that want it alike.

use std::collections::HashMap;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Weak};

use axum::body::Bytes;
use carril_messages::{CompressedImage, Header, Image, Message};
use serde_json::json;

use super::messages::ms;
use super::outbox::{Arrival, Frame, Outbox};
use crate::pictures;

/// So many pictures are kept: one for each key and way of wanting it.
const KEPT: usize = 64;

/// Where images are ordered.
#[derive(Clone)]
pub struct Press(Sender<(Weak<Outbox>, String)>);

impl Press {
    /// Starts its thread, which ends with the last of its handles.
    pub fn start() -> std::io::Result<Self> {
        let (orders, work) = channel();
        std::thread::Builder::new().name("pictures".into()).spawn(move || run(&work))?;
        Ok(Self(orders))
    }

    /// Orders the newest image of a key for a viewer.
    pub fn order(&self, outbox: &Arc<Outbox>, key: String) {
        // A press that is gone has no viewers.
        let _ = self.0.send((Arc::downgrade(outbox), key));
    }
}

fn run(work: &Receiver<(Weak<Outbox>, String)>) {
    let mut cache = Cache::default();
    while let Ok((outbox, key)) = work.recv() {
        let Some(outbox) = outbox.upgrade() else { continue };
        let frame = outbox.take_image(&key).and_then(|(arrival, width, quality)| {
            let made = cache.get(&arrival, width, quality, || picture(&arrival, width, quality));
            made.inspect_err(|reason| tracing::debug!("image of `{key}`: {reason}")).ok()
        });
        outbox.pressed(&key, frame);
    }
}

/// Number and life of a sample.
type Number = (u64, u64);

/// The newest picture of each key and way of wanting it.
#[derive(Default)]
struct Cache(HashMap<(String, u32, u8), (Number, Arc<Frame>)>);

impl Cache {
    fn get(
        &mut self,
        arrival: &Arrival,
        width: u32,
        quality: u8,
        make: impl FnOnce() -> Result<Frame, String>,
    ) -> Result<Arc<Frame>, String> {
        let number = (arrival.header.epoch, arrival.header.seq);
        let wanted = (arrival.key.clone(), width, quality);
        if let Some((known, frame)) = self.0.get(&wanted)
            && *known == number
        {
            return Ok(Arc::clone(frame));
        }
        if self.0.len() >= KEPT {
            self.0.clear();
        }
        let frame = Arc::new(make()?);
        self.0.insert(wanted, (number, Arc::clone(&frame)));
        Ok(frame)
    }
}

fn picture(arrival: &Arrival, width: u32, quality: u8) -> Result<Frame, String> {
    let header = &arrival.header;
    let text = |error: &dyn std::fmt::Display| error.to_string();
    if header.message_type == CompressedImage::TYPE {
        // The car has compressed it for the way to here.
        let image = CompressedImage::decode(&header.meta, &arrival.payload).map_err(|error| text(&error))?;
        let source = (image.source_width, image.source_height, image.source_encoding);
        return Ok(frame(arrival, (image.width, image.height), source, &image.jpeg));
    }
    let image = Image::decode(&header.meta, &arrival.payload).map_err(|error| text(&error))?;
    let picture = pictures::compress(&image, width, quality).map_err(|error| text(&error))?;
    let source = (image.width(), image.height(), image.encoding());
    Ok(frame(arrival, (picture.width, picture.height), source, &picture.jpeg))
}

/// The whole message: length of its header, header, JPEG.
fn frame(
    arrival: &Arrival,
    (width, height): (u32, u32),
    (source_width, source_height, encoding): (u32, u32, carril_messages::Encoding),
    jpeg: &[u8],
) -> Frame {
    let Header { seq, stamp, ref origins, .. } = arrival.header;
    let header = json!({
        "key": arrival.key, "seq": seq, "time_ms": ms(stamp), "origin_ms": origins.oldest().map(ms),
        "width": width, "height": height, "source_width": source_width, "source_height": source_height,
        "source_encoding": encoding.to_string(), "bytes": jpeg.len(),
    });
    let header = header.to_string().into_bytes();
    let mut bytes = Vec::with_capacity(4 + header.len() + jpeg.len());
    bytes.extend_from_slice(&(header.len() as u32).to_le_bytes());
    bytes.extend_from_slice(&header);
    bytes.extend_from_slice(jpeg);
    Frame { seq, bytes: Bytes::from(bytes) }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Encoding, Origins, Payload, SourceId, Stamp};

    use super::super::graph::Sources;

    use super::*;

    fn arrival(epoch: u64, seq: u64) -> Arrival {
        let image = Image::packed(64, 48, Encoding::Bgr8, Payload::from(vec![9; 64 * 48 * 3])).expect("it fits");
        let encoded = image.encode().expect("it encodes");
        let captured = Stamp::from_nanos(1_795_656_000_123_456_789);
        let header = Header {
            epoch,
            seq,
            stamp: captured,
            origins: Origins::captured(SourceId::of("world", "camera"), captured),
            message_type: Image::TYPE,
            meta: encoded.meta,
        };
        Arrival::new("world/camera".into(), header, encoded.payload, Arc::default())
    }

    #[test]
    fn viewers_that_want_it_alike_share_one_picture() {
        let mut cache = Cache::default();
        let mut made = 0;
        let mut get = |epoch, seq, width| {
            let arrival = arrival(epoch, seq);
            cache.get(&arrival, width, 70, || {
                made += 1;
                picture(&arrival, width, 70)
            })
        };
        let first = get(1, 1, 32).expect("made");
        assert!(Arc::ptr_eq(&first, &get(1, 1, 32).expect("kept")), "the very same bytes");
        get(1, 1, 16).expect("another width");
        get(1, 2, 32).expect("another image");
        get(2, 2, 32).expect("the same number after a restart");
        assert_eq!(made, 4, "compressed");
    }

    #[test]
    fn a_frame_says_what_it_is() {
        let frame = picture(&arrival(1, 5), 32, 70).expect("made");
        let (length, rest) = frame.bytes.split_first_chunk::<4>().expect("a length");
        let (header, jpeg) = rest.split_at(u32::from_le_bytes(*length) as usize);
        let header: serde_json::Value = serde_json::from_slice(header).expect("JSON");
        assert_eq!((&header["width"], &header["source_width"], &header["seq"]), (&32.into(), &64.into(), &5.into()));
        let shown = pictures::decompress(jpeg).expect("a JPEG");
        assert_eq!((shown.width(), shown.height()), (32, 24), "scaled");
        // An estimate from this image says when it was captured, too: the page pairs them by this number.
        let lane = super::super::messages::sample(
            "lane/lane",
            &arrival(1, 5).header,
            &Payload::default(),
            &Sources::default(),
        );
        let lane: serde_json::Value = serde_json::from_str(&lane).expect("JSON");
        assert_eq!(lane["origin_ms"], header["origin_ms"], "the very same number");
    }
}
