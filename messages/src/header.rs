//! The header that every sample carries in the Zenoh attachment: who wrote it, when, in which order, and from which exposures
//! it derives.

use arrayvec::ArrayVec;
use serde::{Deserialize, Serialize};

use crate::codec::{self, CodecError};
use crate::message::{Message, MessageType, Meta};
use crate::time::{Stamp, Timespan};

/// First byte of every header. Raised with each change of the layout.
pub const HEADER_VERSION: u8 = 1;

/// No header is larger, B: the fixed fields, the longest type name, four origins and the metadata.
pub const MAX_HEADER_BYTES: usize = 256;

/// No type name is longer, B.
pub const MAX_TYPE_NAME_BYTES: usize = 64;

/// Identifies a sensor port (`world/camera`) in four bytes: FNV-1a over `node/port`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SourceId(pub u32);

impl SourceId {
    /// The id of a port.
    pub const fn of(node: &str, port: &str) -> Self {
        let mut hash = fnv1a(0x811c_9dc5, node.as_bytes());
        hash = fnv1a(hash, b"/");
        Self(fnv1a(hash, port.as_bytes()))
    }
}

const fn fnv1a(mut hash: u32, bytes: &[u8]) -> u32 {
    let mut index = 0;
    while index < bytes.len() {
        hash = (hash ^ bytes[index] as u32).wrapping_mul(0x0100_0193);
        index += 1;
    }
    hash
}

/// One exposure that a sample derives from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// The sensor port.
    pub source: SourceId,
    /// When the sensor captured, on the car's clock.
    pub stamp: Stamp,
}

/// The exposures that a sample derives from: per sensor the oldest. At most four sensors; the oldest four are kept.
///
/// One stamp per sensor, not one in all, so that a budget "camera to wheel" is not charged with the age of a slow lidar
/// (docs/decisions/0002-origins-per-sensor.md).
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Origins(ArrayVec<Origin, 4>);

impl Origins {
    /// None: the sample derives from no sensor.
    pub fn none() -> Self {
        Self::default()
    }

    /// A fresh exposure.
    pub fn captured(source: SourceId, stamp: Stamp) -> Self {
        let mut origins = Self::default();
        origins.0.push(Origin { source, stamp });
        origins
    }

    /// Takes in the exposures of another sample that went into the same result.
    pub fn merge(&mut self, other: &Self) {
        for origin in &other.0 {
            self.add(*origin);
        }
    }

    fn add(&mut self, origin: Origin) {
        if let Some(own) = self.0.iter_mut().find(|own| own.source == origin.source) {
            own.stamp = own.stamp.min(origin.stamp);
        } else if let Err(full) = self.0.try_push(origin) {
            let newest = self.0.iter_mut().max_by_key(|own| own.stamp).expect("a full list has an element");
            if full.element().stamp < newest.stamp {
                *newest = full.element();
            }
        }
    }

    /// The oldest exposure of all, if the sample derives from any.
    pub fn oldest(&self) -> Option<Stamp> {
        self.0.iter().map(|origin| origin.stamp).min()
    }

    /// The exposure of one sensor, if the sample derives from it.
    pub fn of(&self, source: SourceId) -> Option<Stamp> {
        self.0.iter().find(|origin| origin.source == source).map(|origin| origin.stamp)
    }

    /// The same exposures on another clock, which is `by` ahead.
    pub fn shift(&mut self, by: Timespan) {
        for origin in &mut self.0 {
            origin.stamp = origin.stamp.shifted(by);
        }
    }

    /// All of them.
    pub fn iter(&self) -> impl Iterator<Item = Origin> + '_ {
        self.0.iter().copied()
    }
}

/// What every sample carries beside its payload.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Which life of the writer this is, ns stamp of its start: a restarted writer counts from 0 again under a new epoch.
    pub epoch: u64,
    /// Counts the samples of this port in this epoch from 0. Continues across a hot swap.
    pub seq: u64,
    /// When the sample was published, on the car's clock.
    pub stamp: Stamp,
    /// The exposures that it derives from.
    pub origins: Origins,
    /// What the payload is.
    pub message_type: MessageType,
    /// Facts beside a raw payload. Empty for structured types.
    pub meta: Meta,
}

impl Header {
    /// The bytes for the attachment.
    pub fn encode(&self) -> Result<Vec<u8>, CodecError> {
        let mut bytes = Vec::with_capacity(128);
        bytes.push(HEADER_VERSION);
        codec::encode_into(self, &mut bytes)?;
        Ok(bytes)
    }

    /// Reads an attachment. Never panics, whatever the bytes are.
    pub fn decode(bytes: &[u8]) -> Result<Self, CodecError> {
        let Some((&version, rest)) = bytes.split_first() else {
            return Err(CodecError::Malformed { reason: "the sample has no header".into() });
        };
        if version != HEADER_VERSION {
            return Err(CodecError::HeaderVersion { got: version, expected: HEADER_VERSION });
        }
        if bytes.len() > MAX_HEADER_BYTES {
            return Err(CodecError::TooLarge { got: bytes.len(), limit: MAX_HEADER_BYTES });
        }
        let header: Self = codec::decode(rest)?;
        if header.message_type.name.len() > MAX_TYPE_NAME_BYTES {
            return Err(CodecError::TooLarge { got: header.message_type.name.len(), limit: MAX_TYPE_NAME_BYTES });
        }
        Ok(header)
    }

    /// Whether the sample is a `T`; the error names both types.
    pub fn expect<T: Message>(&self) -> Result<(), CodecError> {
        if self.message_type == T::TYPE {
            return Ok(());
        }
        Err(CodecError::WrongType { got: self.message_type.to_string(), expected: T::TYPE.to_string() })
    }

    /// The same times on another clock, which is `by` ahead.
    pub fn shift(&mut self, by: Timespan) {
        self.stamp = self.stamp.shifted(by);
        self.origins.shift(by);
    }

    /// How old the oldest exposure is at `now`; without an origin, how old the sample itself is.
    pub fn age(&self, now: Stamp) -> Timespan {
        now.since(self.origins.oldest().unwrap_or(self.stamp))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::Command;

    fn header() -> Header {
        Header {
            epoch: 3,
            seq: 41,
            stamp: Stamp::from_nanos(2_000),
            origins: Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(1_000)),
            message_type: Command::TYPE,
            meta: Meta::new(),
        }
    }

    #[test]
    fn round_trips() {
        let bytes = header().encode().expect("a header encodes");
        assert_eq!(Header::decode(&bytes), Ok(header()), "decode undoes encode");
        assert!(bytes.len() <= 64, "a header is small, got {} B", bytes.len());
    }

    #[test]
    fn refuses_every_truncation_and_another_version() {
        let bytes = header().encode().expect("a header encodes");
        for len in 0..bytes.len() {
            assert!(Header::decode(&bytes[..len]).is_err(), "{len} of {} bytes", bytes.len());
        }
        let mut old = bytes;
        old[0] = 0;
        assert_eq!(Header::decode(&old), Err(CodecError::HeaderVersion { got: 0, expected: 1 }), "version 0");
    }

    #[test]
    fn names_both_types_when_they_differ() {
        let error = header().expect::<crate::LaserScan>().expect_err("a command is no scan").to_string();
        assert_eq!(error, "the sample is a `carril/Command v1`, expected `carril/LaserScan v1`", "the message");
    }

    #[test]
    fn another_clock_changes_no_age() {
        let (mut header, now, ahead) = (header(), Stamp::from_nanos(5_000), Timespan::from_nanos(-700));
        let age = header.age(now);
        header.shift(ahead);
        assert_eq!(header.stamp, Stamp::from_nanos(1_300), "publication");
        assert_eq!(header.age(now.shifted(ahead)), age, "exposure");
    }

    #[test]
    fn keeps_the_oldest_exposure_of_each_sensor() {
        let (camera, lidar) = (SourceId::of("world", "camera"), SourceId::of("world", "scan"));
        let mut origins = Origins::captured(camera, Stamp::from_nanos(50));
        origins.merge(&Origins::captured(lidar, Stamp::from_nanos(10)));
        origins.merge(&Origins::captured(camera, Stamp::from_nanos(40)));
        assert_eq!(origins.of(camera), Some(Stamp::from_nanos(40)), "camera");
        assert_eq!(origins.oldest(), Some(Stamp::from_nanos(10)), "all");
    }

    #[test]
    fn a_fifth_sensor_replaces_the_newest() {
        let mut origins = Origins::none();
        for source in 0..5 {
            origins.merge(&Origins::captured(SourceId(source), Stamp::from_nanos(100 - i64::from(source))));
        }
        assert_eq!(origins.iter().count(), 4, "at most four");
        assert_eq!(origins.of(SourceId(0)), None, "the newest exposure went");
        assert_eq!(origins.oldest(), Some(Stamp::from_nanos(96)), "the oldest stayed");
    }

    proptest! {
        #[test]
        fn never_panics_on_random_bytes(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            let _ = Header::decode(&bytes);
        }
    }
}
