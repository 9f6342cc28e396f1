//! Whatever arrives on an input: random bytes, foreign types, truncated and altered messages. It is refused or read, and the
//! operator goes on.

use std::sync::Arc;

use carril_messages::{
    Command, Encoding, FaultSet, Goal, Header, Image, Lamp, LaneEstimate, LaserScan, LightColour, Message, MessageType,
    Meta, Origins, Payload, Sectors, Stamp, TrafficLight, WheelTelemetry,
};
use carril_runtime::{Context, ErasedOperator, HeapPool, Incoming, OperatorKind, Setup, Trigger};
use proptest::prelude::*;
use serde_json::Value;

/// Every operator that reads something.
fn readers() -> Vec<Arc<OperatorKind>> {
    carril_operators::registry().iter().filter(|kind| !kind.inputs.is_empty()).cloned().collect()
}

fn build(kind: &OperatorKind) -> Box<dyn ErasedOperator> {
    kind.build(Value::Null, &Setup::for_tests("node")).expect("the defaults do")
}

fn header(message_type: MessageType, stamp: i64, meta: &[u8]) -> Header {
    let meta = Meta::try_from(meta).expect("at most 24 bytes");
    let stamp = Stamp::from_nanos(stamp);
    Header { epoch: 1, seq: 0, stamp, origins: Origins::none(), message_type, meta }
}

/// A good message of each type that an operator reads, as bytes.
fn good(message_type: &MessageType) -> (Vec<u8>, Vec<u8>) {
    let encoded = match message_type.name.as_ref() {
        "carril/Image" => {
            let image = Image::packed(8, 8, Encoding::Bgr8, Payload::from(vec![7; 192])).expect("the size fits");
            Message::encode(&image)
        }
        "carril/LaserScan" => {
            let scan = LaserScan {
                angle_min_rad: -3.0,
                angle_increment_rad: 0.1,
                scan_time_s: 0.1,
                range_min_m: 0.1,
                range_max_m: 16.0,
                ranges_m: vec![1.0; 60],
            };
            Message::encode(&scan)
        }
        "carril/LaneEstimate" => Message::encode(&LaneEstimate { lane: None, quality: 0.0, threshold: Some(9) }),
        "carril/Sectors" => Message::encode(&Sectors { sectors: Vec::new() }),
        "carril/TrafficLight" => {
            let lamp = Lamp { colour: LightColour::Red, column_px: 90.0, row_px: 40.0, radius_px: 5.0 };
            let light = TrafficLight { colour: Some(LightColour::Red), lamp: Some(lamp), stop_line_m: Some(0.8) };
            Message::encode(&light)
        }
        "carril/Goal" => Message::encode(&Goal::Cruise { speed_m_s: 0.3 }),
        "carril/Command" => Message::encode(&Command::default()),
        "carril/WheelTelemetry" => Message::encode(&WheelTelemetry {
            ticks: 1,
            tick_period_us: None,
            speed_m_s: 0.3,
            steering_rad: 0.1,
            battery_v: None,
            faults: FaultSet::NONE,
            driving: true,
            last_command_seq: None,
            round_trip_us: None,
            frames_lost: 0,
            frames_damaged: 0,
        }),
        other => panic!("no good message of the new type `{other}`: add one"),
    }
    .expect("a good message encodes");
    (encoded.meta.to_vec(), encoded.payload.to_vec())
}

fn step(operator: &mut dyn ErasedOperator, now: i64) -> usize {
    let now = Stamp::from_nanos(now);
    operator.begin(now, &|_| None);
    // What is refused is reported; this test is about what comes after.
    let _ = operator.step(&Context::new(now, Trigger::Input, &HeapPool));
    let mut sent = 0;
    operator.drain(&mut |_, outgoing| {
        outgoing.message.encode().expect("what an operator sends can be encoded");
        sent += 1;
    });
    sent
}

/// Gives each input a good message; the operator must answer.
fn still_works(kind: &OperatorKind, operator: &mut dyn ErasedOperator) -> bool {
    for (port, spec) in kind.inputs.iter().enumerate() {
        let (meta, payload) = good(&spec.message_type);
        let header = Arc::new(header(spec.message_type.clone(), 0, &meta));
        operator.accept(port, Incoming::Wire(header, Payload::from(payload))).expect("a good message is taken");
    }
    step(operator, 1_000_000) > 0
}

proptest! {
    #[test]
    fn random_bytes_are_refused_or_read(
        bytes in proptest::collection::vec(any::<u8>(), 0..300),
        meta in proptest::collection::vec(any::<u8>(), 0..24),
        stamp: i64,
        now: i64,
    ) {
        for kind in readers() {
            let mut operator = build(&kind);
            for (port, spec) in kind.inputs.iter().enumerate() {
                let header = Arc::new(header(spec.message_type.clone(), stamp, &meta));
                // Refused or read: both are right, a panic is not.
                let _ = operator.accept(port, Incoming::Wire(header, Payload::from(bytes.clone())));
                step(operator.as_mut(), now);
            }
            prop_assert!(still_works(&kind, build(&kind).as_mut()), "a fresh `{}` answers", kind.name);
            prop_assert!(still_works(&kind, operator.as_mut()), "`{}` still answers", kind.name);
        }
    }

    #[test]
    fn altered_messages_are_refused_or_read(position: prop::sample::Index, value: u8, cut: prop::sample::Index) {
        for kind in readers() {
            let mut operator = build(&kind);
            for (port, spec) in kind.inputs.iter().enumerate() {
                let (meta, mut payload) = good(&spec.message_type);
                let index = position.index(payload.len());
                payload[index] = value;
                let truncated = payload[..cut.index(payload.len())].to_vec();
                for bytes in [payload, truncated] {
                    let header = Arc::new(header(spec.message_type.clone(), 0, &meta));
                    // Refused or read: both are right, a panic is not.
                    let _ = operator.accept(port, Incoming::Wire(header, Payload::from(bytes)));
                    step(operator.as_mut(), 500_000);
                }
            }
            prop_assert!(still_works(&kind, operator.as_mut()), "`{}` still answers", kind.name);
        }
    }
}

#[test]
fn foreign_types_and_versions_are_refused_by_name() {
    for kind in readers() {
        let mut operator = build(&kind);
        for (port, spec) in kind.inputs.iter().enumerate() {
            let (meta, payload) = good(&spec.message_type);
            let older = MessageType { version: 0, ..spec.message_type.clone() };
            for message_type in [MessageType::new("other/Thing", 1), older] {
                let name = message_type.to_string();
                let header = Arc::new(header(message_type, 0, &meta));
                let incoming = Incoming::Wire(header, Payload::from(payload.clone()));
                let error = operator.accept(port, incoming).expect_err("refused").to_string();
                let both = error.contains(&name) && error.contains(&spec.message_type.to_string());
                assert!(both, "{}/{}: {error}", kind.name, spec.name);
            }
        }
    }
}

#[test]
fn a_damaged_state_is_refused() {
    for kind in carril_operators::registry().iter().filter(|kind| !kind.inputs.is_empty()) {
        let (version, state) = build(kind).snapshot().expect("a state encodes");
        assert!(build(kind).restore(version, &state).is_ok(), "{}: its own state", kind.name);
        assert!(build(kind).restore(version + 1, &state).is_err(), "{}: another version", kind.name);
        if !state.is_empty() {
            let cut = &state[..state.len() - 1];
            assert!(build(kind).restore(version, cut).is_err(), "{}: a truncated state", kind.name);
        }
    }
}

#[test]
fn every_kind_has_a_schema_with_help() {
    for kind in carril_operators::registry().iter() {
        let schema = kind.config_schema();
        let fields = schema["properties"].as_object().unwrap_or_else(|| panic!("{}: no fields: {schema}", kind.name));
        for (field, schema) in fields {
            assert!(schema["description"].is_string(), "{}: `{field}` has no help text: {schema}", kind.name);
        }
        for port in &kind.inputs {
            assert!(!port.doc.is_empty(), "{}/{} has no help text", kind.name, port.name);
        }
    }
}
