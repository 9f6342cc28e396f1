//! The conversations and frames in `bridge/vectors/rosserial.txt` and `packetserial.txt`, to the byte: the host sends just what
//! is written down there, when it is written down there, and understands what the car says.

use std::collections::VecDeque;

use carril_bridge::host::Effects;
use carril_bridge::stock::packetserial::{self, Frame, Side};
use carril_bridge::stock::rosserial;
use carril_bridge::stock::{LogLevel, StockConfig, StockHost, StockNote, StockProtocol};
use carril_messages::{Command, Control, Stamp, WheelTelemetry};

const ROSSERIAL: &str = include_str!("../vectors/rosserial.txt");
const PACKETSERIAL: &str = include_str!("../vectors/packetserial.txt");
const BEGIN_NS: i64 = 1_700_000_000_000_000_000;
const LEASE_MS: u16 = 200;

fn lines(text: &'static str) -> impl Iterator<Item = (usize, &'static str)> {
    let numbered = text.lines().enumerate().map(|(at, line)| (at + 1, line));
    numbered.filter(|(_, line)| !line.starts_with('#') && !line.is_empty())
}

fn bytes_of(hex: &str) -> Vec<u8> {
    let digits = (0..hex.len()).step_by(2).map(|at| &hex[at..at + 2]);
    digits.map(|pair| u8::from_str_radix(pair, 16).expect("the vectors are in hex")).collect()
}

/// The host of one conversation, and what it has done that no line has asked for yet.
struct Script {
    host: StockHost,
    now: Stamp,
    sent: Vec<u8>,
    telemetry: VecDeque<WheelTelemetry>,
    notes: Vec<StockNote>,
}

impl Script {
    fn new(protocol: StockProtocol) -> Self {
        let now = Stamp::from_nanos(BEGIN_NS);
        let host = StockHost::new("test", protocol, LEASE_MS, StockConfig::default(), now);
        Self { host, now, sent: Vec::new(), telemetry: VecDeque::new(), notes: Vec::new() }
    }

    fn act(&mut self, verb: &str, rest: &str) {
        let (now, mut effects) = (self.now, Effects::default());
        match verb {
            "open" => self.host.opened(now, &mut effects),
            "close" => self.host.closed(now, "the device is gone".into()),
            "<" => self.host.receive(now, &bytes_of(rest), &mut effects),
            "at" => {
                let ms: i64 = rest.parse().expect("a time in ms");
                self.now = Stamp::from_nanos(BEGIN_NS + ms * 1_000_000);
                self.host.tick(self.now, &mut effects);
            }
            "command" => {
                let (steering, speed) = rest.split_once(' ').expect("two numbers");
                let number = |text: &str| text.parse().expect("a number");
                let command = Command { steering_rad: number(steering), speed_m_s: number(speed) };
                self.host.command(&command, now, now, &mut effects).expect("it is fresh");
            }
            "estop" => self.host.control(Control::EStop, now, &mut effects),
            "reset" => self.host.control(Control::Reset, now, &mut effects),
            "release" => self.host.release(now, &mut effects),
            _ => panic!("`{verb}` is no word of the vectors"),
        }
        self.sent.extend(effects.urgent);
        self.sent.extend(effects.command.unwrap_or_default());
        self.telemetry.extend(effects.telemetry.into_iter().map(|(_, telemetry)| telemetry));
        self.notes.extend(effects.stock_notes);
    }

    fn expect_telemetry(&mut self, place: &str, rest: &str) {
        let report = self.telemetry.pop_front().unwrap_or_else(|| panic!("{place}: no report came"));
        let battery = report.battery_v.map_or("-".into(), |volts| volts.to_string());
        let rounded = |value: f32| (f64::from(value) * 1e4).round() / 1e4;
        let got = format!(
            "ticks={} speed_m_s={} steering_rad={} battery_v={battery} driving={}",
            report.ticks,
            rounded(report.speed_m_s),
            rounded(report.steering_rad),
            u8::from(report.driving)
        );
        assert_eq!(got, rest, "{place}");
    }

    fn expect_log(&mut self, place: &str, rest: &str) {
        let texts = self.notes.drain(..).filter_map(|note| match note {
            StockNote::Log(LogLevel::Info, text) => Some(format!("info {text}")),
            StockNote::Log(LogLevel::Warn, text) => Some(format!("warn {text}")),
            _ => None,
        });
        assert_eq!(texts.collect::<Vec<_>>(), [rest], "{place}");
    }
}

fn run(file: &str, text: &'static str) {
    let (mut script, mut conversations): (Option<Script>, _) = (None, 0);
    for (line, content) in lines(text) {
        let (verb, rest) = content.split_once(' ').unwrap_or((content, ""));
        let place = format!("{file}:{line}");
        if verb == "frame" || verb == "packet" {
            continue;
        }
        if let Some(Script { sent, .. }) = &script
            && verb != ">"
        {
            assert_eq!(sent, &[] as &[u8], "{place}: the host has sent something that is not written down");
        }
        match (verb, &mut script) {
            ("car", _) => {
                let rosserial = rest == "rosserial";
                script =
                    Some(Script::new(if rosserial { StockProtocol::Rosserial } else { StockProtocol::PacketSerial }));
                conversations += 1;
            }
            (_, None) => panic!("{place}: no car yet"),
            (">", Some(script)) => {
                let hex: Vec<String> = std::mem::take(&mut script.sent).iter().map(|b| format!("{b:02x}")).collect();
                assert_eq!(hex.concat(), rest, "{place}");
            }
            ("telemetry", Some(script)) => script.expect_telemetry(&place, rest),
            ("log", Some(script)) => script.expect_log(&place, rest),
            (_, Some(script)) => script.act(verb, rest),
        }
    }
    assert!(conversations > 0, "{file}: there is a conversation");
    assert_eq!(script.map(|script| script.sent), Some(Vec::new()), "{file}: and nothing behind its end");
}

#[test]
fn the_host_speaks_rosserial_to_the_byte() {
    run("rosserial.txt", ROSSERIAL);
}

#[test]
fn the_host_speaks_with_v4_to_the_byte() {
    run("packetserial.txt", PACKETSERIAL);
}

#[test]
fn every_packet_of_rosserial_decodes_and_encodes() {
    let mut packets = 0;
    for (line, content) in lines(ROSSERIAL) {
        let Some(rest) = content.strip_prefix("packet ") else { continue };
        let parts: Vec<&str> = rest.split(' ').collect();
        let (wire, topic) = (bytes_of(parts[0]), parts[1].parse().expect("a number"));
        let payload = if parts[2] == "-" { Vec::new() } else { bytes_of(parts[2]) };
        let mut encoded = Vec::new();
        rosserial::encode(topic, &payload, &mut encoded);
        assert_eq!(encoded, wire, "rosserial.txt:{line}: encoded");
        let mut decoded = Vec::new();
        let mut decoder = rosserial::Decoder::default();
        for byte in &wire {
            decoder.receive(&[*byte], &mut decoded);
        }
        assert_eq!(decoded, [rosserial::Packet { topic, payload }], "rosserial.txt:{line}: decoded, byte by byte");
        packets += 1;
    }
    assert!(packets >= 8, "{packets} packets were found");
}

fn frame_of(kind: &str, fields: &str) -> Frame {
    let number = || fields.parse::<i32>().expect("a whole number");
    let float = || fields.parse().expect("a number");
    let log = |level| Frame::Log { level, text: fields.to_owned() };
    match kind {
        "debug" => log(0),
        "info" => log(1),
        "warn" => log(2),
        "error" => log(3),
        "speed_command" => Frame::SpeedCommand(number() as i16),
        "steering_command" => Frame::SteeringCommand(number() as u8),
        "led_command" => Frame::LedCommand(fields.to_owned()),
        "steering_feedback" => Frame::SteeringFeedback(number() as u16),
        "ticks" => Frame::Ticks(number() as u8),
        "speed" => Frame::Speed(float()),
        "voltage" => Frame::Voltage(float()),
        "attitude" => {
            let parts: Vec<f32> = fields.split(' ').map(|part| part.parse().expect("a number")).collect();
            Frame::Attitude { yaw: parts[0], pitch: parts[1], roll: parts[2] }
        }
        _ => panic!("`{kind}` is no kind"),
    }
}

#[test]
fn every_frame_of_v4_decodes_and_encodes() {
    let mut frames = 0;
    for (line, content) in lines(PACKETSERIAL) {
        let Some(rest) = content.strip_prefix("frame ") else { continue };
        let (rest, side) = match rest.strip_suffix(" from=host") {
            Some(rest) => (rest, Side::FromHost),
            None => (rest, Side::FromDevice),
        };
        let mut parts = rest.splitn(3, ' ');
        let wire = bytes_of(parts.next().expect("bytes"));
        let frame = frame_of(parts.next().expect("a kind"), parts.next().unwrap_or(""));
        let mut encoded = Vec::new();
        packetserial::encode(&frame, &mut encoded);
        assert_eq!(encoded, wire, "packetserial.txt:{line}: encoded");
        let mut decoder = packetserial::Decoder::new(side);
        let decoded: Vec<_> = wire.iter().filter_map(|byte| decoder.push(*byte)).collect();
        assert_eq!(decoded, [Ok(frame)], "packetserial.txt:{line}: decoded");
        frames += 1;
    }
    assert!(frames >= 19, "{frames} frames were found");
}
