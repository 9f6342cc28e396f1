//! Damage on the line from cars with stock firmware: every cut, every flipped bit, absurd lengths, and random damage. rosserial
//! has eight bits of checksum and v4 has none, so that some damage passes for a number; none of it may move the car, stop the
//! host from hearing what comes next, or give the graph a number that no car has.

use carril_bridge::host::Effects;
use carril_bridge::stock::packetserial::{self, DecodeError, Frame, Side};
use carril_bridge::stock::rosserial::{self, Packet};
use carril_bridge::stock::{StockConfig, StockHost, StockNote, StockProtocol};
use carril_messages::{Command, Stamp, WheelTelemetry};
use proptest::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

#[path = "support/stock_cars.rs"]
mod stock_cars;
#[path = "../../tests/support/thorough.rs"]
mod thorough;

use stock_cars::{Car, PacketCar, RosserialCar, packet, stuffed};

const LEASE_MS: u16 = 2_000;

fn packets(bytes: &[u8]) -> Vec<Packet> {
    let mut packets = Vec::new();
    rosserial::Decoder::default().receive(bytes, &mut packets);
    packets
}

fn frames(bytes: &[u8]) -> Vec<Result<Frame, DecodeError>> {
    let mut decoder = packetserial::Decoder::new(Side::FromDevice);
    bytes.iter().filter_map(|byte| decoder.push(*byte)).collect()
}

/// Packets as cars send them, of all kinds.
fn rosserial_packets() -> Vec<Vec<u8>> {
    let topics = [RosserialCar::one_tenth(), RosserialCar::v3()].map(|car| car.topics);
    let mut all: Vec<Vec<u8>> = topics.iter().flatten().map(stock_cars::Topic::packet).collect();
    let twist: Vec<u8> = [12.5, 0.0, 0.0, 0.0, 0.0, 0.0].into_iter().flat_map(f64::to_le_bytes).collect();
    all.extend([
        packet(125, &twist),
        packet(126, &[7, 0]),
        packet(10, &[0; 8]),
        packet(7, &[2, 2, 0, 0, 0, b'o', b'k']),
    ]);
    all.push(packet(126, &[0xFF, 0xFE, 0x00, 0x00, 0xFF]));
    all
}

fn v4_frames() -> Vec<Vec<u8>> {
    let float = |kind: u8, value: f32| stuffed(&[&[kind][..], &value.to_le_bytes()].concat());
    let attitude: Vec<u8> = [1.5_f32, -0.25, 3.0].into_iter().flat_map(f32::to_le_bytes).collect();
    let attitude = stuffed(&[&[10][..], &attitude].concat());
    let text = stuffed(b"\x02gyro drifts\0");
    vec![float(9, 12.5), float(11, 14.8), attitude, stuffed(&[8, 7]), stuffed(&[8, 0]), stuffed(&[7, 0x59, 1]), text]
}

fn flipped(bytes: &[u8], bit: usize) -> Vec<u8> {
    let mut damaged = bytes.to_vec();
    damaged[bit / 8] ^= 1 << (bit % 8);
    damaged
}

/// So much that a packet which has swallowed the next ones ends.
fn enough_good() -> Vec<u8> {
    packet(300, &[1, 2, 3]).repeat(60)
}

#[test]
fn every_flipped_bit_of_a_rosserial_packet_is_refused_and_what_follows_is_heard() {
    let good = Packet { topic: 300, payload: vec![1, 2, 3] };
    for whole in rosserial_packets() {
        assert_eq!(packets(&whole).len(), 1, "intact, it is one packet: {whole:?}");
        for bit in 0..whole.len() * 8 {
            let taken = packets(&[flipped(&whole, bit), enough_good()].concat());
            let wrong: Vec<&Packet> = taken.iter().filter(|taken| **taken != good).collect();
            assert!(wrong.is_empty(), "bit {bit} of {whole:?}: {wrong:?}");
            assert_eq!(taken.len(), 60, "bit {bit} of {whole:?}: all that follows is found");
        }
    }
}

/// A packet that was cut takes what follows for its own; where the sum happens to fit, it passes and the two packets that it has
/// taken are lost. That is one cut in 256, and all that this protocol can promise.
#[test]
fn every_cut_of_a_rosserial_packet_is_refused_but_for_one_in_256_and_what_follows_is_heard() {
    let good = Packet { topic: 300, payload: vec![1, 2, 3] };
    let (mut cuts, mut passed) = (0, 0);
    for whole in rosserial_packets() {
        let pieces = (0..whole.len()).map(|len| &whole[..len]).chain((1..whole.len()).map(|from| &whole[from..]));
        for piece in pieces {
            let taken = packets(&[piece, &enough_good()].concat());
            let wrong = taken.iter().filter(|taken| **taken != good).count();
            (cuts, passed) = (cuts + 1, passed + wrong);
            let lost = 60 - (taken.len() - wrong);
            // A packet has 11 bytes, and the longest has 100.
            assert!(if wrong == 0 { lost == 0 } else { lost <= 10 }, "{piece:?}: {lost} of what follows are lost");
        }
    }
    assert!(cuts > 1_500 && passed * 100 < cuts, "{passed} of {cuts} passed");
}

#[test]
fn every_absurd_length_is_refused_at_once() {
    for len in 0..=u16::MAX {
        let length = len.to_le_bytes();
        let header = [&[0xFF, 0xFE][..], &length, &[stock_cars::sum(&length)]].concat();
        let mut decoder = rosserial::Decoder::default();
        decoder.receive(&header, &mut Vec::new());
        let refused = decoder.damage().header == 1;
        assert_eq!(refused, usize::from(len) > rosserial::MAX_PAYLOAD_BYTES, "{len} bytes");
    }
}

#[test]
fn every_flipped_bit_of_a_v4_frame_is_refused_or_a_number_of_its_kind() {
    let behind = [stuffed(&[8, 99]), stuffed(&[7, 1, 1])].concat();
    for whole in v4_frames() {
        let frame = frames(&whole).remove(0).expect("intact");
        for bit in 0..whole.len() * 8 {
            let taken = frames(&[flipped(&whole, bit), behind.clone()].concat());
            assert_eq!(taken.last(), Some(&Ok(Frame::SteeringFeedback(257))), "bit {bit} of {whole:?}: back in step");
            for got in taken.iter().flatten() {
                let to_device = [Frame::SpeedCommand(0), Frame::SteeringCommand(0), Frame::LedCommand(String::new())];
                let kind = std::mem::discriminant(got);
                assert!(
                    !to_device.iter().any(|to| std::mem::discriminant(to) == kind),
                    "bit {bit} of {frame:?}: {got:?}"
                );
            }
        }
        for len in 0..whole.len() - 1 {
            let taken = frames(&[whole[..len].to_vec(), vec![0], behind.clone()].concat());
            assert!(taken.ends_with(&[Ok(Frame::Ticks(99)), Ok(Frame::SteeringFeedback(257))]), "{len} of {whole:?}");
        }
    }
}

#[test]
fn every_float_of_v4_that_is_no_number_is_refused() {
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let bytes = value.to_le_bytes();
        for kind in [9, 11] {
            let taken = frames(&stuffed(&[&[kind][..], &bytes].concat()));
            assert_eq!(taken, [Err(DecodeError::NotFinite(kind))], "{value} in a frame of type {kind}");
        }
        for place in 0..3 {
            let fields: Vec<u8> = (0..3).flat_map(|at| if at == place { bytes } else { 1_f32.to_le_bytes() }).collect();
            let taken = frames(&stuffed(&[&[10][..], &fields].concat()));
            assert_eq!(taken, [Err(DecodeError::NotFinite(10))], "{value} in place {place}");
        }
    }
}

/// A host that drives a car, whose line from the car is damaged.
struct Drive<C: Car> {
    host: StockHost,
    car: C,
    now_us: u64,
    telemetry: Vec<WheelTelemetry>,
    notes: Vec<StockNote>,
    /// Orders for the motor that are neither the command nor stop.
    wrong_orders: u32,
    rounds: u32,
    rounds_driven: u32,
}

impl<C: Car> Drive<C> {
    fn new(protocol: StockProtocol, car: C) -> Self {
        let host = StockHost::new("test", protocol, LEASE_MS, StockConfig::default(), Stamp::ZERO);
        let mut drive = Self {
            host,
            car,
            now_us: 0,
            telemetry: Vec::new(),
            notes: Vec::new(),
            wrong_orders: 0,
            rounds: 0,
            rounds_driven: 0,
        };
        let mut effects = Effects::default();
        drive.host.opened(Stamp::ZERO, &mut effects);
        drive.carry_out(effects);
        (0..20).for_each(|_| drive.round(|bytes| bytes));
        assert_eq!(drive.car.power(), 510, "it drives");
        drive
    }

    fn carry_out(&mut self, effects: Effects) {
        let bytes = [effects.urgent, effects.command.unwrap_or_default()].concat();
        self.car.receive(self.now_us, &bytes);
        self.telemetry.extend(effects.telemetry.into_iter().map(|(_, telemetry)| telemetry));
        self.notes.extend(effects.stock_notes);
        self.wrong_orders += u32::from(![0, 510].contains(&self.car.power()));
    }

    /// 10 ms, with a command, and what the car says bent.
    fn round(&mut self, mut bend: impl FnMut(Vec<u8>) -> Vec<u8>) {
        self.now_us += 10_000;
        let said = bend(self.car.step(self.now_us));
        let (now, mut effects) = (Stamp::from_nanos(self.now_us as i64 * 1_000), Effects::default());
        self.host.receive(now, &said, &mut effects);
        self.host.tick(now, &mut effects);
        let command = Command { steering_rad: 0.1, speed_m_s: 1.0 };
        self.host.command(&command, now, now, &mut effects).expect("fresh and finite");
        self.carry_out(effects);
        self.rounds += 1;
        self.rounds_driven += u32::from(self.car.power() == 510);
    }

    fn assert_harmless(&mut self, what: &str) {
        assert_eq!(self.wrong_orders, 0, "{what}: the car was told nothing else than the command, or stop");
        assert_eq!(self.car.complaints(), [] as [String; 0], "{what}: and nothing that it does not know");
        for report in &self.telemetry {
            let plausible =
                report.speed_m_s.abs() <= 50.0 && report.battery_v.is_none_or(|v| (0.0..=100.0).contains(&v));
            assert!(plausible && report.steering_rad.is_finite(), "{what}: {report:?}");
        }
    }
}

/// Damages bytes in one of seven ways.
fn damage(bytes: &mut Vec<u8>, rng: &mut impl Rng) {
    if bytes.is_empty() {
        return;
    }
    let (way, len) = (rng.random_range(0..7), bytes.len());
    let mut flip = |times: u32| {
        for _ in 0..times {
            let bit = rng.random_range(0..len * 8);
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
    };
    match way {
        0 => flip(1),
        1 => flip(2),
        2 => flip(8),
        3 => bytes.truncate(rng.random_range(0..len)),
        4 => drop(bytes.drain(..rng.random_range(0..len))),
        5 => (0..rng.random_range(1..8)).for_each(|_| bytes.insert(rng.random_range(0..=bytes.len()), rng.random())),
        _ => bytes.retain(|byte| *byte != 0),
    }
}

fn random_damage<C: Car>(protocol: StockProtocol, car: C) -> Drive<C> {
    let rounds: u32 = thorough::count(20_000, 500_000);
    let mut rng = Pcg64Mcg::seed_from_u64(0xCA44);
    let mut drive = Drive::new(protocol, car);
    for round in 0..rounds {
        drive.round(|mut bytes| {
            damage(&mut bytes, &mut rng);
            bytes
        });
        // Lest the memory of the test grows, and now and then a person helps.
        if round % 1_000 == 999 {
            drive.assert_harmless("random damage");
            drive.telemetry.clear();
            drive.notes.clear();
            let now = Stamp::from_nanos(drive.now_us as i64 * 1_000);
            let mut effects = Effects::default();
            drive.host.control(carril_messages::Control::Reset, now, &mut effects);
            drive.carry_out(effects);
        }
    }
    drive
}

fn recovers<C: Car>(mut drive: Drive<C>) {
    let now = Stamp::from_nanos(drive.now_us as i64 * 1_000);
    // What is refused is asked again after a second.
    (0..300).for_each(|_| drive.round(|bytes| bytes));
    let mut effects = Effects::default();
    drive.host.control(carril_messages::Control::Reset, now, &mut effects);
    drive.carry_out(effects);
    let reports = drive.telemetry.len();
    (0..100).for_each(|_| drive.round(|bytes| bytes));
    drive.assert_harmless("afterwards");
    assert_eq!(drive.car.power(), 510, "it drives again: {:?}", drive.host.problem(now));
    assert!(drive.telemetry.len() - reports >= 99, "and every report is heard");
    assert!(drive.host.damaged() > 1_000, "the damage was seen: {}", drive.host.damaged());
    let (driven, all) = (drive.rounds_driven, drive.rounds);
    assert!(driven > all / 4, "it drove for {driven} of {all} rounds, so that there was something to go wrong");
}

#[test]
fn random_damage_of_rosserial_never_moves_the_car() {
    recovers(random_damage(StockProtocol::Rosserial, RosserialCar::one_tenth()));
    recovers(random_damage(StockProtocol::Rosserial, RosserialCar::v3()));
}

#[test]
fn random_damage_of_v4_never_moves_the_car() {
    recovers(random_damage(StockProtocol::PacketSerial, PacketCar::default()));
}

/// How much of such damage an eight-bit sum lets pass: about one packet in 256 of those that are not merely cut.
#[test]
fn few_damaged_packets_pass_the_checksum_of_rosserial() {
    let rounds: u32 = thorough::count(100_000, 1_000_000);
    let mut rng = Pcg64Mcg::seed_from_u64(11);
    let (all, mut passed, mut lost) = (rosserial_packets(), 0_u32, 0_u32);
    let good = Packet { topic: 300, payload: vec![1, 2, 3] };
    for _ in 0..rounds {
        let sent = &all[rng.random_range(0..all.len())];
        let mut bytes = sent.clone();
        damage(&mut bytes, &mut rng);
        bytes.extend(packet(300, &[1, 2, 3]));
        // A length that was damaged may ask for more.
        bytes.extend([0; rosserial::MAX_PAYLOAD_BYTES]);
        let taken = packets(&bytes);
        let original = packets(sent);
        passed += taken.iter().filter(|taken| **taken != good && **taken != original[0]).count() as u32;
        lost += u32::from(!taken.contains(&good));
    }
    assert!(passed * 100 < rounds, "{passed} of {rounds} passed");
    assert!(lost <= passed, "the whole packet behind the damage gets through, unless it was taken for a part: {lost}");
}

proptest! {
    #[test]
    fn random_bytes_never_panic_and_never_stop_a_host(bytes in proptest::collection::vec(any::<u8>(), 0..2_000)) {
        let mut drive = Drive::new(StockProtocol::Rosserial, RosserialCar::v3());
        drive.round(|said| [&bytes[..], &said].concat());
        drive.assert_harmless("random bytes");
        let mut drive = Drive::new(StockProtocol::PacketSerial, PacketCar::default());
        drive.round(|said| [&bytes[..], &said].concat());
        drive.assert_harmless("random bytes");
    }

    #[test]
    fn random_payloads_under_a_right_checksum_never_panic_and_never_move_the_car(
        topic in prop_oneof![0_u16..12, 95_u16..135, any::<u16>()],
        payload in proptest::collection::vec(any::<u8>(), 0..120),
    ) {
        let mut drive = Drive::new(StockProtocol::Rosserial, RosserialCar::v3());
        drive.round(|said| [packet(topic, &payload), said].concat());
        drive.assert_harmless("a random payload");
    }

    #[test]
    fn random_frames_under_a_right_stuffing_never_panic_and_never_move_the_car(
        kind in 0_u8..20,
        fields in proptest::collection::vec(any::<u8>(), 0..60),
    ) {
        let mut drive = Drive::new(StockProtocol::PacketSerial, PacketCar::default());
        drive.round(|said| [stuffed(&[&[kind][..], &fields].concat()), said].concat());
        drive.assert_harmless("a random frame");
    }
}
