//! Time per frame of the codec, beside what bincode takes for the same telemetry. Medians of interleaved rounds.
//!
//! `cargo bench -p carril-bridge --bench codec`; with `-- --json` one JSON object per line.

use std::hint::black_box;
use std::time::Instant;

use carril_bridge::codec::{
    Command, Decoder, Direction, Drive, Frame, LastCommand, Packet, Session, Telemetry, encode,
};
use carril_messages::{FaultSet, WheelTelemetry, codec as bincode_codec};

const FRAMES: u32 = 20_000;
const ROUNDS: usize = 25;

/// ns per call.
fn time(mut work: impl FnMut()) -> f64 {
    let started = Instant::now();
    (0..FRAMES).for_each(|_| work());
    started.elapsed().as_nanos() as f64 / f64::from(FRAMES)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn telemetry() -> Packet {
    let frame = Frame::Telemetry(Telemetry {
        session: Some(Session(0x1234)),
        ticks: 123_456,
        tick_period_us: Some(3_142),
        speed_mm_s: 500,
        steering_tenth_mrad: -175,
        battery_mv: Some(7_900),
        driving: true,
        last_command: Some(LastCommand { seq: 2, age_us: 9_985 }),
        chip_time_us: 1_000_000,
        ..Telemetry::default()
    });
    Packet { seq: 100, frame }
}

fn command() -> Packet {
    let session = Session(0x1234);
    let frame =
        Frame::Command(Command { session, steering_tenth_mrad: 3_491, drive: Drive::Speed(500), lease_ms: 200 });
    Packet { seq: 2, frame }
}

fn wire(packet: &Packet) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode(packet, &mut bytes);
    bytes
}

fn encode_once(packet: &Packet, buffer: &mut Vec<u8>) {
    buffer.clear();
    encode(black_box(packet), buffer);
    black_box(&buffer);
}

fn decode_once(bytes: &[u8], decoder: &mut Decoder) {
    for byte in black_box(bytes) {
        if let Some(result) = decoder.push(*byte) {
            black_box(&result);
        }
    }
}

fn main() {
    let (command, telemetry) = (command(), telemetry());
    let (command_wire, telemetry_wire) = (wire(&command), wire(&telemetry));
    let message = WheelTelemetry {
        ticks: 123_456,
        tick_period_us: Some(3_142),
        speed_m_s: 0.5,
        steering_rad: -0.0175,
        battery_v: Some(7.9),
        faults: FaultSet::NONE,
        driving: true,
        last_command_seq: Some(2),
        round_trip_us: None,
        frames_lost: 0,
        frames_damaged: 0,
    };
    let encoded = bincode_codec::encode(&message).expect("telemetry encodes");
    let (mut buffer, mut copy) = (Vec::with_capacity(64), [0; 64]);
    let (mut at_chip, mut at_host) = (Decoder::new(Direction::FromHost), Decoder::new(Direction::FromChip));
    let names = [
        "encode command",
        "encode telemetry",
        "decode command",
        "decode telemetry",
        "copy telemetry",
        "bincode encode WheelTelemetry",
        "bincode decode WheelTelemetry",
    ];
    let mut times = vec![Vec::with_capacity(ROUNDS); names.len()];
    for _ in 0..ROUNDS {
        times[0].push(time(|| encode_once(&command, &mut buffer)));
        times[1].push(time(|| encode_once(&telemetry, &mut buffer)));
        times[2].push(time(|| decode_once(&command_wire, &mut at_chip)));
        times[3].push(time(|| decode_once(&telemetry_wire, &mut at_host)));
        times[4].push(time(|| {
            copy[..telemetry_wire.len()].copy_from_slice(black_box(&telemetry_wire));
            black_box(&copy);
        }));
        times[5].push(time(|| {
            buffer.clear();
            bincode_codec::encode_into(black_box(&message), &mut buffer).expect("telemetry encodes");
        }));
        times[6].push(time(|| {
            black_box(bincode_codec::decode::<WheelTelemetry>(black_box(&encoded)).expect("telemetry decodes"));
        }));
    }
    print(&command_wire, &telemetry_wire, &names.into_iter().zip(times.into_iter().map(median)).collect::<Vec<_>>());
}

fn print(command_wire: &[u8], telemetry_wire: &[u8], medians: &[(&str, f64)]) {
    let median_of = |wanted: &str| medians.iter().find(|(name, _)| *name == wanted).map_or(f64::NAN, |(_, ns)| *ns);
    let json = std::env::args().any(|argument| argument == "--json");
    if !json {
        println!("command {} B, telemetry {} B on the line", command_wire.len(), telemetry_wire.len());
    }
    for (name, value) in medians {
        let direction = if name.contains("decode") { "decode" } else { "encode" };
        let baseline = median_of(&format!("bincode {direction} WheelTelemetry"));
        let ratio = value / baseline;
        if json {
            println!(
                r#"{{"name":"codec: {name}","value":{value:.1},"unit":"ns","baseline":{baseline:.1},"ratio":{ratio:.3}}}"#
            );
        } else {
            println!("{name:32} {value:8.1} ns {baseline:8.1} ns {ratio:7.2}");
        }
    }
}
