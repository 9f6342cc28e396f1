//! From bytes to JSON and back for every type of ours, chosen by the name in the header: for `echo`, `pub` and viewers.

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::codec::CodecError;
use crate::message::{Encoded, Message, MessageType};
use crate::payload::Payload;
use crate::{
    Command, CompressedImage, Control, DecisionState, Goal, Header, Health, Image, LaneEstimate, LaserScan, McuPins,
    McuSensors, Sectors, TrackProgress, TrafficLight, VehicleState, WheelTelemetry,
};

/// One type that can be shown and written without knowing it at compile time.
#[derive(Clone)]
pub struct DynamicType {
    /// Name and version.
    pub message_type: MessageType,
    /// To JSON. Infinite and NaN numbers become `null`, as JSON has none.
    pub to_json: fn(&[u8], &Payload) -> Result<Value, CodecError>,
    /// From JSON; `None` for types that JSON cannot carry (images).
    pub from_json: Option<fn(Value) -> Result<Encoded, CodecError>>,
    /// JSON Schema of the JSON form.
    pub schema: fn() -> Value,
}

/// Every type of ours.
pub fn types() -> Vec<DynamicType> {
    vec![
        image(),
        compressed_image(),
        structured::<LaserScan>(),
        structured::<Sectors>(),
        structured::<LaneEstimate>(),
        structured::<TrafficLight>(),
        structured::<Command>(),
        structured::<Goal>(),
        structured::<Control>(),
        structured::<WheelTelemetry>(),
        structured::<VehicleState>(),
        structured::<TrackProgress>(),
        structured::<DecisionState>(),
        structured::<Health>(),
        structured::<McuPins>(),
        structured::<McuSensors>(),
    ]
}

/// The type of that name.
pub fn find(name: &str) -> Option<DynamicType> {
    types().into_iter().find(|known| known.message_type.name == name)
}

/// Shows a sample as JSON, whatever type of ours it has.
pub fn to_json(header: &Header, payload: &Payload) -> Result<Value, CodecError> {
    let known = find(&header.message_type.name).ok_or_else(|| CodecError::WrongType {
        got: header.message_type.to_string(),
        expected: "one of carril's own types".into(),
    })?;
    if known.message_type != header.message_type {
        let expected = known.message_type.to_string();
        return Err(CodecError::WrongType { got: header.message_type.to_string(), expected });
    }
    (known.to_json)(&header.meta, payload)
}

fn structured<T: Message + Serialize + DeserializeOwned + schemars::JsonSchema>() -> DynamicType {
    DynamicType {
        message_type: T::TYPE,
        to_json: |meta, payload| json_of(&T::decode(meta, payload)?),
        from_json: Some(|value| {
            let expected = || format!("{} as JSON", T::TYPE.name);
            let value: T = serde_json::from_value(value).map_err(|error| CodecError::Invalid {
                what: "JSON",
                got: error.to_string(),
                expected: expected(),
            })?;
            value.encode()
        }),
        schema: || schemars::schema_for!(T).to_value(),
    }
}

fn json_of<T: Serialize>(value: &T) -> Result<Value, CodecError> {
    serde_json::to_value(value).map_err(|error| CodecError::Malformed { reason: error.to_string() })
}

fn image() -> DynamicType {
    DynamicType {
        message_type: Image::TYPE,
        to_json: |meta, payload| {
            let image = Image::decode(meta, payload)?;
            Ok(json!({
                "width": image.width(), "height": image.height(), "stride": image.stride(),
                "encoding": image.encoding().to_string(), "bytes": image.pixels().len(),
            }))
        },
        from_json: None,
        schema: || json!({ "type": "object", "description": "size and encoding; the pixels are not shown" }),
    }
}

fn compressed_image() -> DynamicType {
    DynamicType {
        message_type: CompressedImage::TYPE,
        to_json: |meta, payload| {
            let image = CompressedImage::decode(meta, payload)?;
            Ok(json!({
                "width": image.width, "height": image.height, "source_width": image.source_width,
                "source_height": image.source_height, "source_encoding": image.source_encoding.to_string(),
                "format": "jpeg", "bytes": image.jpeg.len(),
            }))
        },
        from_json: None,
        schema: || json!({ "type": "object", "description": "sizes and encoding; the pixels are not shown" }),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{Lane, Meta, Origins, Stamp};

    fn header(message_type: MessageType) -> Header {
        Header { epoch: 0, seq: 0, stamp: Stamp::ZERO, origins: Origins::none(), message_type, meta: Meta::new() }
    }

    #[test]
    fn names_are_unique_and_short_enough() {
        let mut names: Vec<_> = types().into_iter().map(|known| known.message_type.name).collect();
        let count = names.len();
        assert!(names.iter().all(|name| name.len() <= crate::header::MAX_TYPE_NAME_BYTES), "{names:?}");
        names.sort();
        names.dedup();
        assert_eq!(names.len(), count, "two types share a name");
    }

    #[test]
    fn json_goes_both_ways() {
        let goal = find("carril/Goal").expect("the goal is known");
        let json = json!({ "cruise": { "speed_m_s": 0.5 } });
        let encoded = goal.from_json.expect("a goal is structured")(json.clone()).expect("valid JSON");
        assert_eq!((goal.to_json)(&[], &encoded.payload), Ok(json), "there and back");
    }

    #[test]
    fn refuses_an_old_version_by_name() {
        let old = header(MessageType::new("carril/Command", 0));
        let error = to_json(&old, &Payload::default()).expect_err("version 0 is not ours");
        assert_eq!(error.to_string(), "the sample is a `carril/Command v0`, expected `carril/Command v1`", "message");
    }

    #[test]
    fn no_lane_is_null() {
        let none = LaneEstimate { lane: None::<Lane>, quality: 0.0, threshold: None };
        let encoded = none.encode().expect("it encodes");
        let json = to_json(&header(LaneEstimate::TYPE), &encoded.payload).expect("it decodes");
        assert_eq!(json["lane"], Value::Null, "no data is a value");
    }

    proptest! {
        #[test]
        fn no_type_panics_on_random_bytes(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            for known in types() {
                let meta = &bytes[..bytes.len().min(24)];
                let _ = (known.to_json)(meta, &Payload::from(bytes.clone()));
            }
        }
    }
}
