//! Recorded input, golden output: a short drive through lane-detector, lidar-sectors, decision and actuator, message by message.
//! After a change that is meant: `INSTA_UPDATE=always cargo test -p carril-operators --test golden`, then review the diff.

use std::fmt::Write;

use carril_messages::{
    Command, Control, Encoding, Header, Image, LaneEstimate, LaserScan, Message, Meta, Origins, Payload, Sectors,
    SourceId, Stamp,
};
use carril_operators::actuator::{Actuator, ActuatorInputs, ActuatorOutputs};
use carril_operators::decision::{Decision, DecisionInputs, DecisionOutputs};
use carril_operators::lane_detector::{LaneDetector, LaneDetectorInputs, LaneDetectorOutputs};
use carril_operators::lidar_sectors::{LidarSectors, LidarSectorsInputs, LidarSectorsOutputs};
use carril_runtime::{Context, HeapPool, Operator, Setup, Trigger};
use serde_json::{Value, json};

fn build<O: Operator>(config: Value) -> O {
    let config = serde_json::from_value(config).expect("a valid configuration");
    O::new(config, &Setup::for_tests("node")).expect("the operator is built")
}

fn header<T: Message>(stamp: Stamp) -> Header {
    let origins = Origins::captured(SourceId::of("world", "sensor"), stamp);
    Header { epoch: 1, seq: 0, stamp, origins, message_type: T::TYPE, meta: Meta::new() }
}

/// What the camera shows at `frame`: a line that sways, and none from frame 30 to 39.
fn image(frame: i64) -> Image {
    let sway = 60.0 * (frame as f64 * 0.2).sin();
    let mut pixels = Vec::with_capacity(160 * 120);
    for y in 0..120 {
        let middle = 80.0 + sway * f64::from(120 - y) / 60.0;
        let line = |x: i32| (f64::from(x) - middle).abs() <= 3.0 && !(30..40).contains(&frame);
        pixels.extend((0..160).map(|x| if line(x) { 230 } else { 40 + (x + y) as u8 % 7 }));
    }
    Image::packed(160, 120, Encoding::Mono8, Payload::from(pixels)).expect("the size fits")
}

/// What the lidar sees at `frame`: something ahead from frame 60 to 69.
fn scan(frame: i64) -> LaserScan {
    let mut ranges_m = vec![f32::INFINITY; 360];
    if (60..70).contains(&frame) {
        ranges_m[175..186].fill(0.42);
    }
    let step = std::f32::consts::PI / 180.0;
    LaserScan {
        angle_min_rad: -std::f32::consts::PI,
        angle_increment_rad: step,
        scan_time_s: 0.1,
        range_min_m: 0.1,
        range_max_m: 16.0,
        ranges_m,
    }
}

/// What a person says at `frame`.
fn word(frame: i64) -> Option<Control> {
    match frame {
        5 | 135 => Some(Control::Start),
        125 => Some(Control::EStop),
        130 => Some(Control::Reset),
        150 => Some(Control::Stop),
        _ => None,
    }
}

fn drive() -> String {
    let mut detector: LaneDetector = build(json!({ "threshold": "otsu" }));
    let mut lidar: LidarSectors = build(json!({}));
    let mut decision: Decision = build(json!({}));
    let mut actuator: Actuator = build(json!({}));
    let (mut detector_in, mut detector_out) = (LaneDetectorInputs::default(), LaneDetectorOutputs::default());
    let (mut lidar_in, mut lidar_out) = (LidarSectorsInputs::default(), LidarSectorsOutputs::default());
    let (mut decision_in, mut decision_out) = (DecisionInputs::default(), DecisionOutputs::default());
    let (mut actuator_in, mut actuator_out) = (ActuatorInputs::default(), ActuatorOutputs::default());
    let mut record = String::new();
    for frame in 0..160 {
        let now = Stamp::from_nanos(frame * 33_000_000);
        let context = Context::new(now, Trigger::Input, &HeapPool);
        if let Some(word) = word(frame) {
            writeln!(record, "{frame:3} -- {word}").expect("a string grows");
            decision.control(word, now);
            actuator.control(word, now);
        }
        detector_in.image.put(image(frame), header::<Image>(now));
        detector.step(&mut detector_in, &mut detector_out, &context).expect("a step");
        for estimate in detector_out.lane.sent() {
            let seen = estimate.lane.map(|lane| format!("{:+.4} rad {:+.2} px", lane.angle_rad, lane.distance_px));
            let seen = seen.unwrap_or_else(|| "no lane".into());
            write!(record, "{frame:3} {seen} q {:.2}", estimate.quality).expect("a string grows");
            decision_in.lane.put(LaneEstimate::clone(&estimate), header::<LaneEstimate>(now));
        }
        if frame % 3 == 0 {
            lidar_in.scan.put(scan(frame), header::<LaserScan>(now));
            lidar.step(&mut lidar_in, &mut lidar_out, &context).expect("a step");
            for sectors in lidar_out.sectors.sent() {
                decision_in.sectors.put(Sectors::clone(&sectors), header::<Sectors>(now));
            }
        }
        decision.step(&mut decision_in, &mut decision_out, &context).expect("a step");
        for command in decision_out.command.sent() {
            actuator_in.command.put(*command, header::<Command>(now));
        }
        let step = actuator.step(&mut actuator_in, &mut actuator_out, &context);
        for command in actuator_out.command.sent() {
            writeln!(record, " -> {:+.4} rad {:.3} m/s", command.steering_rad, command.speed_m_s).expect("it grows");
        }
        for state in decision_out.state.sent() {
            if state.since == now {
                writeln!(record, "{frame:3} == {}: {}", state.state.name(), state.reason).expect("a string grows");
            }
        }
        if let Err(stop) = step {
            writeln!(record, "{frame:3} !! {stop}").expect("a string grows");
        }
    }
    record
}

#[test]
fn a_short_drive_goes_as_recorded() {
    let first = drive();
    assert_eq!(first, drive(), "the same input, the same output");
    insta::assert_snapshot!(first);
}
