//! The packets of rosserial, second version of its protocol (wiki.ros.org/rosserial/Overview/Protocol): bytes in, packets out,
//! and back. Pure: no port, no clock. It knows nothing of topics; no input makes it panic, and it holds one packet's bytes.
//!
//! ```text
//! FF FE | length u16 | 255 - sum(length) | topic u16 | payload ... | 255 - sum(topic, payload)
//! ```
//!
//! Integers are little endian, sums are modulo 256: eight bits of checksum find any one flipped bit, but one in 256 of longer
//! damage passes. Whoever reads a payload checks its length and its numbers again.

/// Longest payload that is taken, bytes: the buffers of rosserial's client library have 512 at most.
pub const MAX_PAYLOAD_BYTES: usize = 512;

/// The first byte of a packet.
const SYNC: u8 = 0xFF;
/// The second one: this version of the protocol, spoken since ROS Hydro.
const VERSION: u8 = 0xFE;
/// All before the payload.
const HEADER_BYTES: usize = 7;
/// Header, payload of no length, checksum.
const EMPTY_BYTES: usize = HEADER_BYTES + 1;

/// What travels between two checksums.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet {
    /// Below 100: the protocol's own, see [`system`].
    pub topic: u16,
    /// A serialized ROS message.
    pub payload: Vec<u8>,
}

/// Topics of the protocol itself (rosserial_msgs/TopicInfo).
pub mod system {
    /// To the device, empty: tell your topics. From it: a topic that it publishes.
    pub const PUBLISHER: u16 = 0;
    /// From the device: a topic that it subscribes.
    pub const SUBSCRIBER: u16 = 1;
    /// From the device: text for people.
    pub const LOG: u16 = 7;
    /// From the device: what time is it? To it: the answer.
    pub const TIME: u16 = 10;
    /// Topics of the device's own begin here.
    pub const FIRST_OWN: u16 = 100;
}

/// What a decoder has refused.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DamageCounts {
    /// Bytes that belong to no packet.
    pub skipped_bytes: u64,
    /// Headers whose checksum is wrong, or whose length no packet has.
    pub header: u64,
    /// Packets whose checksum is wrong.
    pub checksum: u64,
}

impl DamageCounts {
    /// Damaged packets, as far as they can be told from noise.
    pub const fn packets(&self) -> u64 {
        self.header + self.checksum
    }
}

/// Finds packets in a stream of bytes, in pieces of any size. What looked like a packet and was none is searched again from its
/// second byte, so that a packet which a damaged length has swallowed is not lost.
#[derive(Clone, Debug, Default)]
pub struct Decoder {
    waiting: Vec<u8>,
    damage: DamageCounts,
}

/// What the beginning of the bytes is.
enum Beginning {
    Incomplete,
    Noise,
    BadHeader,
    BadChecksum,
    Packet(Packet),
}

impl Decoder {
    /// Takes bytes and appends the packets that they complete.
    pub fn receive(&mut self, bytes: &[u8], packets: &mut Vec<Packet>) {
        // In pieces, so that the memory stays that of a packet whatever comes.
        for piece in bytes.chunks(MAX_PAYLOAD_BYTES) {
            self.waiting.extend_from_slice(piece);
            self.take_packets(packets);
        }
    }

    fn take_packets(&mut self, packets: &mut Vec<Packet>) {
        let mut at = 0;
        loop {
            at += match beginning(&self.waiting[at..]) {
                Beginning::Incomplete => break,
                Beginning::Packet(packet) => {
                    let len = EMPTY_BYTES + packet.payload.len();
                    packets.push(packet);
                    len
                }
                noise => self.skip_one(&noise),
            };
        }
        self.waiting.drain(..at);
    }

    fn skip_one(&mut self, noise: &Beginning) -> usize {
        self.damage.skipped_bytes += 1;
        self.damage.header += u64::from(matches!(noise, Beginning::BadHeader));
        self.damage.checksum += u64::from(matches!(noise, Beginning::BadChecksum));
        1
    }

    /// Forgets a packet that has begun: the line was closed and opened.
    pub fn restart(&mut self) {
        self.waiting.clear();
    }

    /// What was refused since the start.
    pub fn damage(&self) -> DamageCounts {
        self.damage
    }
}

fn beginning(bytes: &[u8]) -> Beginning {
    let expected = [SYNC, VERSION];
    if bytes.iter().zip(expected).any(|(got, expected)| *got != expected) {
        return Beginning::Noise;
    }
    let [_, _, low, high, length_sum, ..] = *bytes else { return Beginning::Incomplete };
    let len = usize::from(u16::from_le_bytes([low, high]));
    if checksum([low, high]) != length_sum || len > MAX_PAYLOAD_BYTES {
        return Beginning::BadHeader;
    }
    let Some(packet) = bytes.get(..EMPTY_BYTES + len) else { return Beginning::Incomplete };
    let (summed, sum) = (&packet[HEADER_BYTES - 2..HEADER_BYTES + len], packet[HEADER_BYTES + len]);
    if checksum(summed.iter().copied()) != sum {
        return Beginning::BadChecksum;
    }
    let topic = u16::from_le_bytes([summed[0], summed[1]]);
    Beginning::Packet(Packet { topic, payload: summed[2..].to_vec() })
}

/// Appends a packet.
///
/// # Panics
/// When the payload is longer than [`MAX_PAYLOAD_BYTES`]: no message that goes to a car is.
pub fn encode(topic: u16, payload: &[u8], wire: &mut Vec<u8>) {
    assert!(payload.len() <= MAX_PAYLOAD_BYTES, "a payload of {} bytes", payload.len());
    let length = (payload.len() as u16).to_le_bytes();
    let topic = topic.to_le_bytes();
    wire.extend_from_slice(&[SYNC, VERSION, length[0], length[1], checksum(length), topic[0], topic[1]]);
    wire.extend_from_slice(payload);
    wire.push(checksum(topic.into_iter().chain(payload.iter().copied())));
}

fn checksum(bytes: impl IntoIterator<Item = u8>) -> u8 {
    255 - bytes.into_iter().fold(0, u8::wrapping_add)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> Vec<Packet> {
        let mut packets = Vec::new();
        Decoder::default().receive(bytes, &mut packets);
        packets
    }

    #[test]
    fn the_request_for_topics_is_that_of_the_description() {
        let mut wire = Vec::new();
        encode(system::PUBLISHER, &[], &mut wire);
        assert_eq!(wire, [0xFF, 0xFE, 0x00, 0x00, 0xFF, 0x00, 0x00, 0xFF], "as the wiki has it");
        assert_eq!(decoded(&wire), [Packet { topic: 0, payload: Vec::new() }], "and back");
    }

    #[test]
    fn a_packet_that_a_false_beginning_has_swallowed_is_found_again() {
        let mut wire = vec![0xFF, 0xFE, 20, 0, 255 - 20, 0xFF];
        for topic in 100..105 {
            encode(topic, &[1, 2], &mut wire);
        }
        let topics: Vec<u16> = decoded(&wire).iter().map(|packet| packet.topic).collect();
        assert_eq!(topics, [100, 101, 102, 103, 104], "also those inside of what looked like a packet");
    }

    #[test]
    fn a_length_that_no_packet_has_is_refused_at_once() {
        let mut decoder = Decoder::default();
        let mut packets = Vec::new();
        decoder.receive(&[0xFF, 0xFE, 0xFF, 0xFF, 255 - 254], &mut packets);
        assert_eq!((decoder.damage().header, decoder.waiting.len()), (1, 0), "65535 bytes are not waited for");
        let floods = vec![0xFF; 100_000];
        decoder.receive(&floods, &mut packets);
        assert!(decoder.waiting.len() < EMPTY_BYTES && packets.is_empty(), "nor does noise pile up");
    }
}
