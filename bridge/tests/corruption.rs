//! A hundred thousand damaged frames, a million when thorough: none may pass for a frame that was not sent, and the next whole frame always gets through.

use carril_bridge::codec::{
    CalibrationStatus, Command, Decoder, Direction, Drive, FULL_DUTY, Frame, LastCommand, Packet, Parameter,
    ParameterWrite, Session, Telemetry, encode,
};
use carril_messages::FaultSet;
use proptest::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

#[path = "../../tests/support/thorough.rs"]
mod thorough;

fn random_reports(rng: &mut impl Rng) -> Frame {
    if rng.random_bool(0.1) {
        let (index, value) = (rng.random(), rng.random());
        return Frame::Parameter(Parameter { index, status: CalibrationStatus::Done, value });
    }
    Frame::Telemetry(Telemetry {
        session: rng.random_bool(0.5).then(|| Session(rng.random())),
        ticks: rng.random_range(0..100_000),
        tick_period_us: rng.random_bool(0.5).then(|| rng.random_range(0..100_000)),
        speed_mm_s: rng.random_range(-2_000..2_000),
        steering_tenth_mrad: rng.random_range(-3_500..3_500),
        battery_mv: rng.random_bool(0.9).then(|| rng.random_range(6_000..8_400)),
        faults: FaultSet(rng.random_range(0..4)),
        driving: rng.random(),
        last_command: rng.random_bool(0.9).then(|| LastCommand { seq: rng.random(), age_us: rng.random() }),
        chip_time_us: rng.random(),
        damaged_frames: 0,
    })
}

fn random_words(rng: &mut impl Rng) -> Frame {
    let session = Session(rng.random());
    if rng.random_bool(0.1) {
        return Frame::ParameterWrite(ParameterWrite { session, index: rng.random(), value: rng.random() });
    }
    let drive = if rng.random() {
        Drive::Speed(rng.random_range(-2_000..2_000))
    } else {
        Drive::Duty(rng.random_range(-FULL_DUTY..=FULL_DUTY))
    };
    let steering_tenth_mrad = rng.random_range(-3_500..3_500);
    Frame::Command(Command { session, steering_tenth_mrad, drive, lease_ms: rng.random_range(20..=2_000) })
}

/// Damages the bytes of a frame in one of six ways.
fn damage(bytes: &mut Vec<u8>, rng: &mut impl Rng) {
    let flip = |bytes: &mut Vec<u8>, rng: &mut dyn FnMut(usize) -> usize| {
        let bit = rng(bytes.len() * 8);
        bytes[bit / 8] ^= 1 << (bit % 8);
    };
    match rng.random_range(0..6) {
        0 => flip(bytes, &mut |end| rng.random_range(0..end)),
        1 => (0..2).for_each(|_| flip(bytes, &mut |end| rng.random_range(0..end))),
        2 => bytes.truncate(rng.random_range(0..bytes.len())),
        3 => drop(bytes.remove(rng.random_range(0..bytes.len()))),
        4 => (0..rng.random_range(1..8)).for_each(|_| bytes.insert(rng.random_range(0..=bytes.len()), rng.random())),
        _ => bytes.retain(|byte| *byte != 0),
    }
}

fn run(direction: Direction, random_frame: impl Fn(&mut Pcg64Mcg) -> Frame) {
    let rounds: u32 = thorough::count(50_000, 500_000);
    let mut rng = Pcg64Mcg::seed_from_u64(0xCA44);
    let mut decoder = Decoder::new(direction);
    let (mut bytes, mut wrong, mut good_lost) = (Vec::new(), Vec::new(), 0);
    for round in 0..rounds {
        let sent: [Packet; 3] = std::array::from_fn(|_| Packet { seq: rng.random(), frame: random_frame(&mut rng) });
        bytes.clear();
        encode(&sent[0], &mut bytes);
        let mut damaged = Vec::new();
        encode(&sent[1], &mut damaged);
        damage(&mut damaged, &mut rng);
        bytes.append(&mut damaged);
        encode(&sent[2], &mut bytes);
        let taken: Vec<Packet> = bytes.iter().filter_map(|byte| decoder.push(*byte)?.ok()).collect();
        wrong.extend(taken.iter().filter(|packet| !sent.contains(packet)).map(|packet| (round, *packet)));
        good_lost += u32::from(taken.last() != Some(&sent[2]));
    }
    assert_eq!(wrong, [], "no frame may be taken that was not sent");
    assert_eq!(good_lost, 0, "the whole frame behind the damage always gets through");
    assert!(decoder.damage().total() > u64::from(rounds) / 2, "the damage was seen: {:?}", decoder.damage());
}

#[test]
fn no_damaged_command_is_taken_wrong() {
    run(Direction::FromHost, random_words);
}

#[test]
fn no_damaged_telemetry_is_taken_wrong() {
    run(Direction::FromChip, random_reports);
}

proptest! {
    #[test]
    fn every_command_survives_the_line_in_pieces(
        seq in any::<u16>(), session in any::<u16>(), steering_tenth_mrad in any::<i16>(), speed_mm_s in any::<i16>(),
        lease_ms in 1_u16..=2_000,
    ) {
        let session = Session(session);
        let frame = Frame::Command(Command { session, steering_tenth_mrad, drive: Drive::Speed(speed_mm_s), lease_ms });
        let mut bytes = Vec::new();
        encode(&Packet { seq, frame }, &mut bytes);
        let mut decoder = Decoder::new(Direction::FromHost);
        let taken: Vec<_> = bytes.iter().filter_map(|byte| decoder.push(*byte)).collect();
        prop_assert_eq!(taken, vec![Ok(Packet { seq, frame })]);
    }

    #[test]
    fn random_bytes_never_panic_and_never_stop_the_decoder(bytes in proptest::collection::vec(any::<u8>(), 0..2_000)) {
        let mut decoder = Decoder::new(Direction::FromHost);
        for byte in bytes {
            let _ = decoder.push(byte);
        }
        let mut good = Vec::new();
        encode(&Packet { seq: 1, frame: Frame::EStop }, &mut good);
        let last = good.iter().filter_map(|byte| decoder.push(*byte)).last();
        prop_assert_eq!(last, Some(Ok(Packet { seq: 1, frame: Frame::EStop })));
    }
}
