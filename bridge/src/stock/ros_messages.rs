//! The ROS messages that cars exchange over rosserial: names, MD5 sums, and the bytes of each. A payload that is too short, too
//! long, or holds a number that is none gives `None`: the checksum of a packet lets some damage pass.

use std::fmt;

/// A type of message, as std_msgs and geometry_msgs define it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MessageKind {
    /// One f32.
    Float32,
    /// One u8.
    UInt8,
    /// One i16.
    Int16,
    /// One u16.
    UInt16,
    /// Text.
    String,
    /// Six f64: linear x, y, z, angular x, y, z.
    Twist,
}

impl MessageKind {
    /// Its full name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Float32 => "std_msgs/Float32",
            Self::UInt8 => "std_msgs/UInt8",
            Self::Int16 => "std_msgs/Int16",
            Self::UInt16 => "std_msgs/UInt16",
            Self::String => "std_msgs/String",
            Self::Twist => "geometry_msgs/Twist",
        }
    }

    /// So many bytes each message has, or has at least.
    pub const fn fixed_bytes(self) -> i32 {
        match self {
            Self::Float32 | Self::String => 4,
            Self::UInt8 => 1,
            Self::Int16 | Self::UInt16 => 2,
            Self::Twist => 48,
        }
    }

    /// The MD5 sum of its definition, as ROS computes it: `float32 data` and so on.
    pub const fn md5(self) -> &'static str {
        match self {
            Self::Float32 => "73fcbf46b49191e672908e50842a83d4",
            Self::UInt8 => "7c8164229e7d2c17eb95e9231617fdee",
            Self::Int16 => "8524586e34fbd7cb1c08c5f5f1ca0e57",
            Self::UInt16 => "1df79edf208b629fe6b81923a544552d",
            Self::String => "992ce8a1687cec8c8bd883ec73ca41d1",
            Self::Twist => "9f195f881246fdfa2798d1d3eebca84a",
        }
    }
}

impl fmt::Display for MessageKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (md5 {})", self.name(), self.md5())
    }
}

/// A topic, as the device tells of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicInfo {
    /// Number of its packets.
    pub id: u16,
    /// `steering`, also when the device says `/steering`.
    pub name: String,
    /// `std_msgs/Float32`
    pub message_type: String,
    /// MD5 sum of the type's definition.
    pub md5: String,
    /// So many bytes fit into the device's buffer for it.
    pub buffer_bytes: i32,
}

impl TopicInfo {
    /// From the payload of a packet.
    pub fn read(payload: &[u8]) -> Option<Self> {
        let mut rest = Rest(payload);
        let info = Self {
            id: u16::from_le_bytes(rest.array()?),
            name: rest.string()?.trim_start_matches('/').to_owned(),
            message_type: rest.string()?,
            md5: rest.string()?,
            buffer_bytes: i32::from_le_bytes(rest.array()?),
        };
        rest.end(info)
    }
}

/// Text for people, with the level that rosserial_msgs/Log gives it: 0 debug, 1 info, 2 warn, 3 error, 4 fatal.
pub fn read_log(payload: &[u8]) -> Option<(u8, String)> {
    let mut rest = Rest(payload);
    let [level] = rest.array()?;
    let text = rest.string()?;
    rest.end((level, text))
}

/// std_msgs/UInt16
pub fn read_u16(payload: &[u8]) -> Option<u16> {
    Some(u16::from_le_bytes(payload.try_into().ok()?))
}

/// std_msgs/Float32. `None` when it is not finite.
pub fn read_f32(payload: &[u8]) -> Option<f32> {
    Some(f32::from_le_bytes(payload.try_into().ok()?)).filter(|value| value.is_finite())
}

/// linear.x of a geometry_msgs/Twist. `None` when one of the six is not finite.
pub fn read_twist_x(payload: &[u8]) -> Option<f64> {
    let mut rest = Rest(payload);
    let mut numbers = [0.0; 6];
    for number in &mut numbers {
        *number = f64::from_le_bytes(rest.array()?);
    }
    rest.end(numbers[0]).filter(|_| numbers.iter().all(|number| number.is_finite()))
}

/// What has not been read yet.
struct Rest<'a>(&'a [u8]);

impl Rest<'_> {
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (array, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*array)
    }

    /// Bytes that are no text in UTF-8 are replaced.
    fn string(&mut self) -> Option<String> {
        let len = usize::try_from(u32::from_le_bytes(self.array()?)).ok()?;
        let (text, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(String::from_utf8_lossy(text).into_owned())
    }

    fn end<T>(&self, value: T) -> Option<T> {
        self.0.is_empty().then_some(value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn absurd_lengths_of_texts_are_refused() {
        assert_eq!(read_log(&[1, 2, 0, 0, 0, b'o', b'k']), Some((1, "ok".into())), "as it should be");
        for payload in
            [&[1, 3, 0, 0, 0, b'o', b'k'][..], &[1, 0xFF, 0xFF, 0xFF, 0xFF, b'o'], &[1, 1, 0, 0, 0, 2, 3], &[1]]
        {
            assert_eq!(read_log(payload), None, "{payload:?}");
        }
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        let twist = |x: f64, last: f64| [x, 0.0, 0.0, 0.0, 0.0, last].map(f64::to_le_bytes).concat();
        assert_eq!(read_twist_x(&twist(-3.5, 0.0)), Some(-3.5), "linear.x");
        assert_eq!(read_twist_x(&twist(f64::NAN, 0.0)), None, "not a number");
        assert_eq!(read_twist_x(&twist(1.0, f64::INFINITY)), None, "nor any of the others");
        assert_eq!(read_twist_x(&twist(1.0, 0.0)[1..]), None, "too short");
        assert_eq!(read_f32(&f32::NAN.to_le_bytes()), None, "not a number");
        assert_eq!(read_u16(&[1, 2, 3]), None, "too long");
    }
}
