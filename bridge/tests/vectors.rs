//! The golden frames in `bridge/vectors/`: each decodes to its values, each value encodes to its bytes, and every truncation
//! and every flipped bit of each is refused.

use std::collections::BTreeMap;

use carril_bridge::codec::{
    CalibrationState, CalibrationStatus, CalibrationStore, Capabilities, Command, DamageCounts, DecodeError, Decoder,
    Direction, Drive, FirmwareVersion, Frame, FrameKind, HelloAck, LastCommand, Packet, Parameter, ParameterWrite,
    Session, Telemetry, TimeSyncAck, encode,
};
use carril_messages::FaultSet;

const FRAMES: &str = include_str!("../vectors/frames.txt");
const DAMAGED: &str = include_str!("../vectors/damaged.txt");

fn lines(text: &'static str) -> impl Iterator<Item = &'static str> {
    text.lines().filter(|line| !line.starts_with('#') && !line.is_empty())
}

fn bytes_of(hex: &str) -> Vec<u8> {
    let digits = (0..hex.len()).step_by(2).map(|at| &hex[at..at + 2]);
    digits.map(|pair| u8::from_str_radix(pair, 16).expect("the vectors are in hex")).collect()
}

fn decode(direction: Direction, bytes: &[u8]) -> Vec<Result<Packet, DecodeError>> {
    let mut decoder = Decoder::new(direction);
    bytes.iter().filter_map(|byte| decoder.push(*byte)).collect()
}

fn direction_of(frame: &Frame) -> Direction {
    if frame.kind().is_from_chip() { Direction::FromChip } else { Direction::FromHost }
}

/// The fields of one line.
struct Fields(BTreeMap<&'static str, &'static str>);

impl Fields {
    fn maybe<T: std::str::FromStr>(&self, name: &str) -> Option<T> {
        let text = self.0.get(name).unwrap_or_else(|| panic!("the line has no field `{name}`"));
        let number = || text.parse().unwrap_or_else(|_| panic!("`{name}={text}` is out of its type's range"));
        (*text != "-").then(number)
    }

    fn get<T: std::str::FromStr>(&self, name: &str) -> T {
        self.maybe(name).unwrap_or_else(|| panic!("`{name}` must have a value"))
    }

    fn session(&self) -> Session {
        Session(self.get("session"))
    }

    fn telemetry(&self) -> Telemetry {
        let last_seq: Option<u16> = self.maybe("last_seq");
        Telemetry {
            session: self.maybe("session").map(Session),
            ticks: self.get("ticks"),
            tick_period_us: self.maybe("tick_period_us"),
            speed_mm_s: self.get("speed_mm_s"),
            steering_tenth_mrad: self.get("steering_tenth_mrad"),
            battery_mv: self.maybe("battery_mv"),
            faults: FaultSet(self.get("faults")),
            driving: self.get::<u8>("driving") == 1,
            last_command: last_seq.map(|seq| LastCommand { seq, age_us: self.get("last_age_us") }),
            chip_time_us: self.get("chip_time_us"),
            damaged_frames: self.get("damaged_frames"),
        }
    }

    fn hello_ack(&self) -> HelloAck {
        let version: String = self.get("firmware");
        let parts: Vec<u8> = version.split('.').map(|part| part.parse().expect("major.minor.patch")).collect();
        HelloAck {
            session: self.session(),
            firmware: FirmwareVersion { major: parts[0], minor: parts[1], patch: parts[2] },
            capabilities: Capabilities(self.get("capabilities")),
            calibration_crc: self.get("calibration_crc"),
        }
    }

    fn status(&self) -> CalibrationStatus {
        let number: u8 = self.get("status");
        let known = CalibrationStatus::ALL.into_iter().find(|status| *status as u8 == number);
        known.expect("a known status")
    }

    fn packet(&self, kind: &str) -> Packet {
        let frame = match kind {
            "hello" => Frame::Hello(self.session()),
            "command" => Frame::Command(Command {
                session: self.session(),
                steering_tenth_mrad: self.get("steering_tenth_mrad"),
                drive: if self.0.contains_key("duty") {
                    Drive::Duty(self.get("duty"))
                } else {
                    Drive::Speed(self.get("speed_mm_s"))
                },
                lease_ms: self.get("lease_ms"),
            }),
            "estop" => Frame::EStop,
            "fault_clear" => Frame::FaultClear(self.session()),
            "release" => Frame::Release(self.session()),
            "hello_ack" => Frame::HelloAck(self.hello_ack()),
            "telemetry" => Frame::Telemetry(self.telemetry()),
            "time_sync" => Frame::TimeSync(self.get("token")),
            "time_sync_ack" => Frame::TimeSyncAck(TimeSyncAck {
                token: self.get("token"),
                received_us: self.get("received_us"),
                sent_us: self.get("sent_us"),
            }),
            "parameter_read" => Frame::ParameterRead(self.get("index")),
            "parameter_write" => Frame::ParameterWrite(ParameterWrite {
                session: self.session(),
                index: self.get("index"),
                value: self.get("value"),
            }),
            "calibration_store" => {
                Frame::CalibrationStore(CalibrationStore { session: self.session(), crc: self.get("crc") })
            }
            "calibration_defaults" => Frame::CalibrationDefaults(self.session()),
            "calibration_query" => Frame::CalibrationQuery,
            "parameter" => Frame::Parameter(Parameter {
                index: self.get("index"),
                status: self.status(),
                value: self.get("value"),
            }),
            "calibration" => Frame::Calibration(CalibrationState {
                status: self.status(),
                count: self.get("count"),
                crc_in_force: self.get("crc_in_force"),
                crc_stored: self.get("crc_stored"),
            }),
            other => panic!("`{other}` is no kind of frame"),
        };
        Packet { seq: self.get("seq"), frame }
    }
}

/// Every golden frame with its bytes.
fn vectors() -> Vec<(Vec<u8>, Packet)> {
    let read = |line: &'static str| {
        let mut parts = line.split(' ');
        let (hex, kind) = (parts.next().expect("bytes"), parts.next().expect("a kind"));
        let fields = Fields(parts.map(|field| field.split_once('=').expect("name=value")).collect());
        (bytes_of(hex), fields.packet(kind))
    };
    lines(FRAMES).map(read).collect()
}

#[test]
fn every_vector_decodes_to_its_values_and_encodes_to_its_bytes() {
    let vectors = vectors();
    for kind in FrameKind::ALL {
        assert!(vectors.iter().any(|(_, packet)| packet.frame.kind() == kind), "the file has no {kind:?}");
    }
    for (bytes, packet) in vectors {
        assert_eq!(decode(direction_of(&packet.frame), &bytes), [Ok(packet)], "the values of {bytes:02x?}");
        let mut encoded = Vec::new();
        encode(&packet, &mut encoded);
        assert_eq!(encoded, bytes, "the bytes of {packet:?}");
    }
}

#[test]
fn every_damaged_vector_is_refused_and_counted_as_its_kind() {
    for line in lines(DAMAGED) {
        let [hex, direction, counter] = line.split(' ').collect::<Vec<_>>()[..] else { panic!("three fields: {line}") };
        let direction = if direction == "host" { Direction::FromHost } else { Direction::FromChip };
        let mut decoder = Decoder::new(direction);
        let results: Vec<_> = bytes_of(hex).iter().filter_map(|byte| decoder.push(*byte)).collect();
        let damage = decoder.damage();
        let DamageCounts { too_long, stuffing, checksum, version, kind, fields } = damage;
        let named = [
            ("too_long", too_long),
            ("stuffing", stuffing),
            ("checksum", checksum),
            ("version", version),
            ("kind", kind),
            ("fields", fields),
        ];
        assert!(matches!(results[..], [Err(_)]), "one refusal for {line}, got {results:?}");
        assert!(named.contains(&(counter, 1)) && damage.total() == 1, "{line} was counted as {damage:?}");
    }
}

#[test]
fn every_truncation_of_every_vector_is_refused() {
    for (bytes, packet) in vectors() {
        for len in 0..bytes.len() {
            let mut cut = bytes[..len].to_vec();
            let direction = direction_of(&packet.frame);
            assert!(decode(direction, &cut).iter().all(Result::is_err), "{len} bytes of {packet:?}");
            // The cut, and then the beginning of the next frame: only the whole frame without its last zero may pass.
            cut.push(0);
            let taken = decode(direction, &cut).iter().any(Result::is_ok);
            assert_eq!(taken, len == bytes.len() - 1, "{len} bytes of {packet:?} and a zero");
        }
    }
}

#[test]
fn every_flipped_bit_and_pair_of_bits_of_every_vector_is_refused() {
    for (bytes, packet) in vectors() {
        let direction = direction_of(&packet.frame);
        let bits = bytes.len() * 8;
        for first in 0..bits {
            for second in first..bits {
                let mut flipped = bytes.clone();
                flipped[first / 8] ^= 1 << (first % 8);
                if second != first {
                    flipped[second / 8] ^= 1 << (second % 8);
                }
                // A damaged leading zero costs nothing when the frame behind it is whole; anything else must be refused.
                let wrong = decode(direction, &flipped).into_iter().flatten().find(|got| *got != packet);
                assert_eq!(wrong, None, "bits {first} and {second} of {packet:?}");
                if first == second && first >= 8 {
                    let results = decode(direction, &flipped);
                    assert!(results.iter().all(Result::is_err), "bit {first} of {packet:?} gave {results:?}");
                }
            }
        }
    }
}
