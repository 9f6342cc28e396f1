//! `carril echo NODE/PORT`: shows samples as text or JSON.

use std::io::IsTerminal;
use std::path::PathBuf;

use anyhow::{Result, bail};
use carril_messages::{CompressedImage, Image, LaserScan, Message, Stamp, dynamic};
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use crate::common::live::Run;
use crate::common::ports::{self, Port};
use crate::common::watch::{self, Arrival, Viewer, WatchArgs};
use crate::common::{output, plot, save, text};

/// Arguments of `carril echo`.
#[derive(Args)]
#[command(after_help = "Ends with the statistics of what it saw, also on Ctrl-C.

Examples:
  carril echo lane/lane                       until Ctrl-C
  carril echo world/camera -n 1 --save frame.png
  carril echo world/scan --plot               what the lidar sees, from above
  carril echo decision/state --json --for 10s | jq -r .value.reason")]
pub struct EchoArgs {
    /// The port, as `carril list` shows it
    #[arg(value_name = "NODE/PORT")]
    port: String,
    /// Write one image to FILE (.png, .ppm, .pgm, .jpg) and end
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Draw scans as a picture from above, the newest in the place of the one before
    #[arg(long, conflicts_with_all = ["save", "json"])]
    plot: bool,
    #[command(flatten)]
    watch: WatchArgs,
}

/// Runs it.
pub fn run(mut args: EchoArgs) -> Result<()> {
    if let Some(path) = &args.save {
        save::check_name(path)?;
        args.watch.count = Some(1);
    }
    let run = Run::connect(&args.watch.target)?;
    let port = ports::to_read(run.file(), &args.port)?;
    if args.save.is_some() && port.message_type != Image::TYPE.name {
        let (name, message_type) = (&args.port, &port.message_type);
        bail!("`--save` writes images, and `{name}` carries `{message_type}`\nhint: carril echo {name} --json > FILE");
    }
    if args.plot && port.message_type != LaserScan::TYPE.name {
        let (name, message_type) = (&args.port, &port.message_type);
        bail!("`--plot` draws scans (`{}`), and `{name}` carries `{message_type}`", LaserScan::TYPE.name);
    }
    let mut echo = Echo { json: args.watch.json, plot: args.plot, save: args.save.take(), started: run.file().started };
    watch::watch(&run, &[port], &args.watch, &mut echo)
}

struct Echo {
    json: bool,
    plot: bool,
    save: Option<PathBuf>,
    started: Stamp,
}

impl Viewer for Echo {
    const SAMPLES: bool = true;

    fn sample(&mut self, port: &Port, arrival: &Arrival) -> Result<()> {
        if self.plot {
            return draw(arrival);
        }
        output::line(if self.json { as_json(port, arrival)? } else { as_text(arrival, self.started) })?;
        if let Some(path) = self.save.take() {
            if arrival.header.message_type == CompressedImage::TYPE {
                let image = CompressedImage::decode(&arrival.header.meta, &arrival.payload)?;
                save::compressed(&image, &path)?;
            } else {
                let image = Image::decode(&arrival.header.meta, &arrival.payload)?;
                save::image(&image, &path)?;
            }
            eprintln!("saved `{}`", path.display());
        }
        Ok(())
    }
}

/// A scan as a picture. On a terminal it takes the place of the one before.
fn draw(arrival: &Arrival) -> Result<()> {
    let header = &arrival.header;
    let scan = LaserScan::decode(&header.meta, &arrival.payload)?;
    let (to_top, age) = (std::io::stdout().is_terminal(), header.age(arrival.arrived).as_millis_f64());
    let begin = if to_top { "\x1b[H\x1b[J" } else { "" };
    output::line(format_args!("{begin}{}\n#{}  age {age:.1} ms", plot::scan(&scan), header.seq))
}

/// `#412  12.345 s  age 3.4 ms  lane at angle 3.2° left, ...`; further lines are indented. The time is that of the exposure, or
/// else of the publication, since the start of the run.
fn as_text(arrival: &Arrival, started: Stamp) -> String {
    let header = &arrival.header;
    let age = header.age(arrival.arrived).as_millis_f64();
    let at = header.origins.oldest().unwrap_or(header.stamp).since(started).as_secs_f64();
    let shown = text::of(header, &arrival.payload).unwrap_or_else(|error| format!("not readable: {error}"));
    let shown =
        if shown.contains('\n') { format!("\n  {}", shown.replace('\n', "\n  ")) } else { format!("  {shown}") };
    format!("#{}  {at:.3} s  age {age:.1} ms{shown}", header.seq)
}

/// A sample as JSON.
#[derive(Serialize)]
struct Line<'a> {
    port: String,
    #[serde(rename = "type")]
    message_type: String,
    epoch: u64,
    seq: u64,
    stamp_ns: i64,
    /// `null`: derives from no sensor.
    captured_ns: Option<i64>,
    age_ms: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    value: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<&'a str>,
}

fn as_json(port: &Port, arrival: &Arrival) -> Result<String> {
    let header = &arrival.header;
    let (value, error) = match dynamic::to_json(header, &arrival.payload) {
        Ok(value) => (Some(value), None),
        Err(error) => (None, Some(error.to_string())),
    };
    let line = Line {
        port: port.name(),
        message_type: header.message_type.to_string(),
        epoch: header.epoch,
        seq: header.seq,
        stamp_ns: header.stamp.as_nanos(),
        captured_ns: header.origins.oldest().map(Stamp::as_nanos),
        age_ms: header.age(arrival.arrived).as_millis_f64(),
        value,
        error: error.as_deref(),
    };
    Ok(serde_json::to_string(&line)?)
}

#[cfg(test)]
mod tests {
    use carril_messages::{Command, Header, Key, MessageType, Meta, Origins, Payload, SourceId};

    use super::*;

    fn arrival(message_type: MessageType, payload: Payload) -> Arrival {
        let origins = Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(1_000_000_000));
        let stamp = Stamp::from_nanos(1_002_000_000);
        let header = Header { epoch: 7, seq: 3, stamp, origins, message_type, meta: Meta::new() };
        Arrival { port: 0, header, payload, arrived: Stamp::from_nanos(1_004_000_000) }
    }

    fn port() -> Port {
        let key = Key::new("car1", "decision", "command");
        Port { key, message_type: "carril/Command".into(), on_demand: false, external_input: false }
    }

    #[test]
    fn shows_number_exposure_and_age() {
        let encoded = Command { steering_rad: 0.1, speed_m_s: 0.5 }.encode().expect("it encodes");
        let arrival = arrival(Command::TYPE, encoded.payload);
        let expected = "#3  0.500 s  age 4.0 ms  steering 5.7° left, speed 0.50 m/s";
        assert_eq!(as_text(&arrival, Stamp::from_nanos(500_000_000)), expected, "text");
        let json: serde_json::Value =
            serde_json::from_str(&as_json(&port(), &arrival).expect("JSON")).expect("a line of JSON");
        assert_eq!((&json["seq"], &json["age_ms"], &json["value"]["speed_m_s"]), (&3.into(), &4.0.into(), &0.5.into()));
    }

    #[test]
    fn garbage_is_told_and_no_panic() {
        let arrival = arrival(Command::TYPE, Payload::from(vec![1]));
        assert!(
            as_text(&arrival, Stamp::from_nanos(500_000_000))
                .contains("not readable: the bytes are not a valid message"),
            "text"
        );
        let json: serde_json::Value =
            serde_json::from_str(&as_json(&port(), &arrival).expect("JSON")).expect("a line of JSON");
        assert!(json["error"].is_string() && json["value"].is_null(), "JSON: {json}");
    }
}
