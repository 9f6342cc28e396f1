//! The serial protocol of SLAMTEC's A series (RPLIDAR A1, A2, A3): requests, response descriptors, measurements. Not yet held against a
//! device; what the layout rests on stands in `vectors/rplidar.txt`. Pure: bytes in, events out; it never gives up, and finds the next packet after
//! whatever came.

use std::fmt::Write as _;

/// Begins every request, and every response.
const SYNC: u8 = 0xA5;
/// Follows [`SYNC`] in a response.
const SYNC_RESPONSE: u8 = 0x5A;
/// A response descriptor, B.
const DESCRIPTOR_LEN: usize = 7;
/// No answer is longer, B.
const MAX_ANSWER: usize = 256;
/// Pairs of measurements in a capsule.
const CABINS: usize = 16;
/// Measurements in a capsule.
pub const CAPSULE_POINTS: usize = 2 * CABINS;
/// Bytes of a capsule.
pub const CAPSULE_LEN: usize = 4 + 5 * CABINS;
/// Bytes of a measurement of a standard scan.
pub const NODE_LEN: usize = 5;

/// What the host asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Stops scanning. No answer.
    Stop,
    /// Starts the device anew. No answer.
    Reset,
    /// Who are you?
    Info,
    /// How are you?
    Health,
    /// Scan, a measurement at a time.
    Scan,
    /// Scan, in capsules.
    ExpressScan,
    /// Speed of the motor, 0 to 1023: for A2 and A3. No answer.
    MotorPwm(u16),
}

/// What the answer to a request is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Model, firmware, hardware, serial number.
    Info,
    /// Status and error code.
    Health,
    /// Measurements.
    Nodes,
    /// Capsules.
    Capsules,
}

/// Who the device is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Info {
    /// Of the model: 0x18 is an A1, 0x2x an A2, 0x3x an A3.
    pub model: u8,
    /// Major and minor.
    pub firmware: [u8; 2],
    /// Revision.
    pub hardware: u8,
    /// As printed on the device, in hexadecimal.
    pub serial: String,
}

/// How it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Health {
    /// What it says of itself.
    pub status: HealthStatus,
    /// What it says of the error; 0: none.
    pub code: u16,
}

/// What the device says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HealthStatus {
    /// All is well.
    Good,
    /// It works, and may not for long.
    Warning,
    /// It has stopped itself; only a reset helps.
    Error,
}

/// One measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// From the device's front, clockwise, degrees, 0 to 360.
    pub clockwise_deg: f32,
    /// m. `None`: nothing came back.
    pub range_m: Option<f32>,
    /// The device says that a rotation begins here.
    pub begins: bool,
}

/// What was understood.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// Who it is.
    Info(Info),
    /// How it is.
    Health(Health),
    /// It begins to send measurements.
    Scanning(Answer),
    /// A measurement.
    Point(Point),
}

impl Request {
    /// The bytes of the request.
    pub fn encode(self) -> Vec<u8> {
        let with_payload = |command: u8, payload: &[u8]| {
            let mut bytes = vec![SYNC, command, payload.len() as u8];
            bytes.extend_from_slice(payload);
            let checksum = bytes.iter().fold(0, |sum, byte| sum ^ byte);
            bytes.push(checksum);
            bytes
        };
        match self {
            Self::Stop => vec![SYNC, 0x25],
            Self::Reset => vec![SYNC, 0x40],
            Self::Info => vec![SYNC, 0x50],
            Self::Health => vec![SYNC, 0x52],
            Self::Scan => vec![SYNC, 0x20],
            Self::ExpressScan => with_payload(0x82, &[0; 5]),
            Self::MotorPwm(pwm) => with_payload(0xF0, &pwm.to_le_bytes()),
        }
    }
}

impl Answer {
    const ALL: [Self; 4] = [Self::Info, Self::Health, Self::Nodes, Self::Capsules];

    /// Data type, length of a packet, and whether packets go on coming.
    const fn shape(self) -> (u8, usize, bool) {
        match self {
            Self::Info => (0x04, 20, false),
            Self::Health => (0x06, 3, false),
            Self::Nodes => (0x81, NODE_LEN, true),
            Self::Capsules => (0x82, CAPSULE_LEN, true),
        }
    }

    /// The response descriptor.
    pub fn descriptor(self) -> [u8; DESCRIPTOR_LEN] {
        let (kind, len, on) = self.shape();
        let word = (len as u32 | u32::from(on) << 30).to_le_bytes();
        [SYNC, SYNC_RESPONSE, word[0], word[1], word[2], word[3], kind]
    }
}

/// Finds packets in a stream of bytes.
#[derive(Clone, Debug, Default)]
pub struct Decoder {
    buffer: Vec<u8>,
    expected: Option<Answer>,
    /// The capsule before: its points are known only with the next one.
    capsule: Option<Capsule>,
    /// Bytes that belonged to nothing.
    lost: u64,
}

impl Decoder {
    /// Forgets what came, for a new conversation.
    pub fn reset(&mut self) {
        let lost = self.lost;
        *self = Self { lost, ..Self::default() };
    }

    /// Bytes that belonged to nothing, since the start.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Takes in bytes; `out` gets what they say.
    pub fn push(&mut self, bytes: &[u8], out: &mut Vec<Event>) {
        self.buffer.extend_from_slice(bytes);
        let mut used = 0;
        while let Some(step) = self.next(used, out) {
            used += step;
        }
        self.buffer.drain(..used);
        // What waits for its end is never longer than an answer.
        let excess = self.buffer.len().saturating_sub(MAX_ANSWER);
        self.lost += excess as u64;
        self.buffer.drain(..excess);
    }

    /// How many bytes from `at` on are done with; `None`: more must come first.
    fn next(&mut self, at: usize, out: &mut Vec<Event>) -> Option<usize> {
        let rest = &self.buffer[at..];
        let Some(answer) = self.expected else { return self.seek(at, out) };
        let (_, len, on) = answer.shape();
        // A device that was asked something else begins with a descriptor, which is no capsule and no measurement.
        if on && rest.len() >= DESCRIPTOR_LEN && known_descriptor(rest).is_some() {
            self.expected = None;
            return self.seek(at, out);
        }
        let packet = rest.get(..len)?.to_vec();
        if !self.read(answer, &packet, out) {
            self.lost += 1;
            return Some(1);
        }
        self.expected = on.then_some(answer);
        Some(len)
    }

    /// Looks for a descriptor.
    fn seek(&mut self, at: usize, out: &mut Vec<Event>) -> Option<usize> {
        let rest = &self.buffer[at..];
        if rest.len() < DESCRIPTOR_LEN {
            return None;
        }
        let Some(answer) = known_descriptor(rest) else {
            self.lost += 1;
            return Some(1);
        };
        self.expected = Some(answer);
        self.capsule = None;
        if matches!(answer, Answer::Nodes | Answer::Capsules) {
            out.push(Event::Scanning(answer));
        }
        Some(DESCRIPTOR_LEN)
    }

    /// `false`: it is no such packet.
    fn read(&mut self, answer: Answer, packet: &[u8], out: &mut Vec<Event>) -> bool {
        match answer {
            Answer::Info => out.push(Event::Info(info(packet))),
            Answer::Health => out.extend(health(packet).map(Event::Health)),
            Answer::Nodes => {
                let Some(point) = node(packet) else { return false };
                out.push(Event::Point(point));
            }
            Answer::Capsules => {
                let Some(capsule) = Capsule::read(packet) else { return false };
                let before = self.capsule.replace(capsule.clone()).filter(|_| !capsule.anew);
                if let Some(before) = before {
                    out.extend(before.points(capsule.start_deg).into_iter().map(Event::Point));
                }
            }
        }
        true
    }
}

fn known_descriptor(bytes: &[u8]) -> Option<Answer> {
    Answer::ALL.into_iter().find(|answer| bytes.starts_with(&answer.descriptor()))
}

fn info(packet: &[u8]) -> Info {
    let serial = packet[4..20].iter().fold(String::new(), |mut serial, byte| {
        // Writing into a string cannot fail.
        let _ = write!(serial, "{byte:02X}");
        serial
    });
    Info { model: packet[0], firmware: [packet[2], packet[1]], hardware: packet[3], serial }
}

fn health(packet: &[u8]) -> Option<Health> {
    let status = match packet[0] {
        0 => HealthStatus::Good,
        1 => HealthStatus::Warning,
        2 => HealthStatus::Error,
        _ => return None,
    };
    Some(Health { status, code: u16::from_le_bytes([packet[1], packet[2]]) })
}

/// A measurement of a standard scan: start flag and its inverse, quality, check bit, angle in 1/64 degree, distance in 1/4 mm.
fn node(packet: &[u8]) -> Option<Point> {
    let (start, inverse) = (packet[0] & 1, packet[0] >> 1 & 1);
    if start == inverse || packet[1] & 1 == 0 {
        return None;
    }
    let angle_q6 = u16::from_le_bytes([packet[1], packet[2]]) >> 1;
    let clockwise_deg = f32::from(angle_q6) / 64.0;
    let distance_q2 = u16::from_le_bytes([packet[3], packet[4]]);
    let range_m = (distance_q2 > 0).then(|| f32::from(distance_q2) / 4000.0);
    (clockwise_deg < 361.0).then_some(Point { clockwise_deg: clockwise_deg % 360.0, range_m, begins: start == 1 })
}

/// 32 measurements.
#[derive(Clone, Debug, PartialEq)]
struct Capsule {
    /// The device has begun anew: the one before says nothing of it.
    anew: bool,
    start_deg: f32,
    /// Distance, mm, and by how much the angle is corrected, 1/8 degree: taken as unsigned, where the description speaks of a sign bit. To
    /// be settled with a device: it matters only for corrections of 4 degrees and more.
    cabins: [(u16, u8); CAPSULE_POINTS],
}

impl Capsule {
    fn read(packet: &[u8]) -> Option<Self> {
        let checksum = packet[0] & 0x0F | packet[1] << 4;
        let sound = packet[0] >> 4 == 0xA
            && packet[1] >> 4 == 0x5
            && packet[2..].iter().fold(0, |sum, byte| sum ^ byte) == checksum;
        if !sound {
            return None;
        }
        let word = u16::from_le_bytes([packet[2], packet[3]]);
        let mut cabins = [(0, 0); CAPSULE_POINTS];
        for (cabin, pair) in packet[4..].chunks_exact(5).zip(cabins.chunks_exact_mut(2)) {
            let words = [u16::from_le_bytes([cabin[0], cabin[1]]), u16::from_le_bytes([cabin[2], cabin[3]])];
            let low = [cabin[4] & 0x0F, cabin[4] >> 4];
            for (index, one) in pair.iter_mut().enumerate() {
                *one = (words[index] >> 2, low[index] | ((words[index] & 3) as u8) << 4);
            }
        }
        Some(Self { anew: word & 0x8000 != 0, start_deg: f32::from(word & 0x7FFF) / 64.0, cabins })
    }

    /// Its measurements lie evenly between its own angle and that of the next one.
    fn points(&self, next_deg: f32) -> Vec<Point> {
        let turn_deg = (next_deg - self.start_deg).rem_euclid(360.0);
        let point = |(index, (distance_mm, correction)): (usize, &(u16, u8))| {
            let raw_deg = self.start_deg + turn_deg * index as f32 / CAPSULE_POINTS as f32;
            let clockwise_deg = (raw_deg - f32::from(*correction) / 8.0).rem_euclid(360.0);
            let range_m = (*distance_mm > 0).then(|| f32::from(*distance_mm) / 1000.0);
            // rem_euclid of a tiny negative angle is 360.
            Point { clockwise_deg: clockwise_deg % 360.0, range_m, begins: false }
        };
        self.cabins.iter().enumerate().map(point).collect()
    }
}

/// A measurement as a device sends it.
pub fn encode_node(point: &Point) -> [u8; NODE_LEN] {
    const QUALITY: u8 = 15;
    let angle_q6 = (point.clockwise_deg * 64.0).round() as u16;
    let angle = (angle_q6 << 1 | 1).to_le_bytes();
    let distance = point.range_m.map_or(0, |range_m| (range_m * 4000.0).round() as u16).to_le_bytes();
    let flags = if point.begins { 0b01 } else { 0b10 };
    [QUALITY << 2 | flags, angle[0], angle[1], distance[0], distance[1]]
}

/// 32 measurements as a device sends them, from `start_deg` on. `anew`: the first ones after a request.
pub fn encode_capsule(start_deg: f32, anew: bool, ranges_m: &[Option<f32>; CAPSULE_POINTS]) -> [u8; CAPSULE_LEN] {
    let mut packet = [0; CAPSULE_LEN];
    let word = (start_deg * 64.0).round() as u16 & 0x7FFF | u16::from(anew) << 15;
    packet[2..4].copy_from_slice(&word.to_le_bytes());
    for (cabin, pair) in packet[4..].chunks_exact_mut(5).zip(ranges_m.chunks_exact(2)) {
        for (index, range_m) in pair.iter().enumerate() {
            let distance_mm = range_m.map_or(0, |range_m| (range_m * 1000.0).round() as u16).min(0x3FFF);
            cabin[index * 2..index * 2 + 2].copy_from_slice(&(distance_mm << 2).to_le_bytes());
        }
    }
    let checksum = packet[2..].iter().fold(0, |sum, byte| sum ^ byte);
    (packet[0], packet[1]) = (0xA0 | checksum & 0x0F, 0x50 | checksum >> 4);
    packet
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn decoded(bytes: &[u8]) -> Vec<Event> {
        let mut out = Vec::new();
        Decoder::default().push(bytes, &mut out);
        out
    }

    fn standard_scan(points: &[Point]) -> Vec<u8> {
        let mut bytes = Answer::Nodes.descriptor().to_vec();
        for point in points {
            bytes.extend(encode_node(point));
        }
        bytes
    }

    #[test]
    fn capsules_are_spread_between_their_angles() {
        let ranges = std::array::from_fn(|index| (index != 3).then_some(1.0 + index as f32 * 0.01));
        let mut bytes = Answer::Capsules.descriptor().to_vec();
        bytes.extend(encode_capsule(350.0, true, &ranges));
        bytes.extend(encode_capsule(6.0, false, &ranges));
        let points: Vec<Point> = decoded(&bytes)
            .into_iter()
            .filter_map(|event| if let Event::Point(point) = event { Some(point) } else { None })
            .collect();
        assert_eq!(points.len(), CAPSULE_POINTS, "those of the first, as the second has come");
        assert!((points[0].clockwise_deg - 350.0).abs() < 0.02 && points[0].range_m == Some(1.0), "{:?}", points[0]);
        assert_eq!(points[3].range_m, None, "nothing came back");
        assert!((points[24].clockwise_deg - 2.0).abs() < 0.02, "over the front: {:?}", points[24]);
    }

    #[test]
    fn a_capsule_whose_checksum_is_wrong_is_passed_over() {
        let ranges = [Some(2.0); CAPSULE_POINTS];
        let mut bytes = Answer::Capsules.descriptor().to_vec();
        for index in 0..4_u8 {
            let mut capsule = encode_capsule(f32::from(index) * 10.0, index == 0, &ranges);
            capsule[20] ^= u8::from(index == 1) << 3;
            bytes.extend(capsule);
        }
        let points = decoded(&bytes).into_iter().filter(|event| matches!(event, Event::Point(_))).count();
        assert_eq!(points, 2 * CAPSULE_POINTS, "0 to 20 degrees and 20 to 30: the damaged one is a gap, not a lie");
    }

    #[test]
    fn garbage_before_and_between_is_passed_over() {
        let health = [&[0xA5, 0x5A, 0x00, 0xFF][..], &Answer::Health.descriptor(), &[2, 0x34, 0x12]].concat();
        let expected = Event::Health(Health { status: HealthStatus::Error, code: 0x1234 });
        assert_eq!(decoded(&health), [expected], "half a descriptor before");
        let points: Vec<Point> = (0..50)
            .map(|index| Point { clockwise_deg: index as f32 * 7.0, range_m: Some(1.0), begins: index == 0 })
            .collect();
        let mut bytes = standard_scan(&points);
        bytes.drain(40..42);
        let found = decoded(&bytes);
        let last = Event::Point(points[49]);
        assert_eq!(found.last(), Some(&last), "two bytes lost: found again");
        assert!(found.len() > 40, "{} of 50", found.len());
    }

    proptest! {
        #[test]
        fn measurements_round_trip(angle_q6 in 0_u16..23_040, distance_q2 in 0_u16.., begins: bool) {
            let range_m = (distance_q2 > 0).then(|| f32::from(distance_q2) / 4000.0);
            let point = Point { clockwise_deg: f32::from(angle_q6) / 64.0, range_m, begins };
            let found = decoded(&standard_scan(&[point]));
            prop_assert_eq!(&found[1..], [Event::Point(point)]);
        }

        #[test]
        fn whatever_comes_in_whatever_pieces_it_goes_on(
            noise in proptest::collection::vec(any::<u8>(), 0..600),
            pieces in proptest::collection::vec(1_usize..90, 1..20),
        ) {
            let mut decoder = Decoder::default();
            let mut out = Vec::new();
            let mut rest = &noise[..];
            for piece in pieces {
                let (now, later) = rest.split_at(piece.min(rest.len()));
                decoder.push(now, &mut out);
                rest = later;
            }
            // The longest packet that garbage can pretend to be must pass first.
            decoder.push(&[0; 2 * CAPSULE_LEN], &mut out);
            out.clear();
            decoder.push(&Answer::Health.descriptor(), &mut out);
            decoder.push(&[1, 7, 0], &mut out);
            let expected = Event::Health(Health { status: HealthStatus::Warning, code: 7 });
            prop_assert!(out.contains(&expected), "{out:?}");
        }
    }
}
