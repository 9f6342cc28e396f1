//! A camera frame. Its pixels never go through serde and, between processes of one machine, are never copied.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::codec::{self, CodecError};
use crate::message::{Encoded, Message, MessageType, Meta};
use crate::payload::Payload;

/// No frame is larger, B: 4096 x 4096 pixels of 3 bytes, with room for row padding.
pub const MAX_IMAGE_BYTES: usize = 64 << 20;

/// How pixels lie in memory. Rows go from top to bottom.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Encoding {
    /// One byte a pixel, 0 black to 255 white.
    Mono8,
    /// Three bytes a pixel: blue, green, red (OpenCV's order).
    Bgr8,
    /// Three bytes a pixel: red, green, blue.
    Rgb8,
}

impl Encoding {
    /// Bytes of one pixel.
    pub const fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Mono8 => 1,
            Self::Bgr8 | Self::Rgb8 => 3,
        }
    }
}

impl fmt::Display for Encoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Mono8 => "mono8",
            Self::Bgr8 => "bgr8",
            Self::Rgb8 => "rgb8",
        })
    }
}

/// A frame of raw pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    width: u32,
    height: u32,
    stride: u32,
    encoding: Encoding,
    pixels: Payload,
}

#[derive(Serialize, Deserialize)]
struct Layout {
    width: u32,
    height: u32,
    stride: u32,
    encoding: Encoding,
}

impl Image {
    /// A frame of `height` rows of `width` pixels, without padding between rows.
    pub fn packed(width: u32, height: u32, encoding: Encoding, pixels: Payload) -> Result<Self, CodecError> {
        let stride = width.saturating_mul(encoding.bytes_per_pixel() as u32);
        Self::with_stride(width, height, stride, encoding, pixels)
    }

    /// A frame whose rows begin every `stride` bytes. `pixels` has exactly `stride * height` bytes.
    pub fn with_stride(
        width: u32,
        height: u32,
        stride: u32,
        encoding: Encoding,
        pixels: Payload,
    ) -> Result<Self, CodecError> {
        let invalid = |what, got: String, expected: String| Err(CodecError::Invalid { what, got, expected });
        if width == 0 || height == 0 {
            return invalid("image size", format!("{width}x{height}"), "at least 1x1".into());
        }
        let row = u64::from(width) * encoding.bytes_per_pixel() as u64;
        if u64::from(stride) < row {
            return invalid(
                "image stride",
                format!("{stride} B"),
                format!("at least {row} B for {width} {encoding} pixels"),
            );
        }
        let expected = u64::from(stride) * u64::from(height);
        if expected > MAX_IMAGE_BYTES as u64 {
            return invalid("image size", format!("{expected} B"), format!("at most {MAX_IMAGE_BYTES} B"));
        }
        if pixels.len() as u64 != expected {
            let shape = format!("{width}x{height} {encoding} with a stride of {stride} B");
            return invalid("image payload", format!("{} B", pixels.len()), format!("{expected} B for {shape}"));
        }
        Ok(Self { width, height, stride, encoding, pixels })
    }

    /// Pixels in a row.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Bytes from one row to the next.
    pub fn stride(&self) -> u32 {
        self.stride
    }

    /// How pixels lie in memory.
    pub fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// All rows, with their padding.
    pub fn pixels(&self) -> &Payload {
        &self.pixels
    }

    /// The pixels of row `y`, 0 at the top, without padding. Panics when `y >= height`, as slices do.
    pub fn row(&self, y: u32) -> &[u8] {
        let start = y as usize * self.stride as usize;
        &self.pixels[start..start + self.width as usize * self.encoding.bytes_per_pixel()]
    }
}

impl Message for Image {
    const TYPE: MessageType = MessageType::new("carril/Image", 1);

    fn encode(&self) -> Result<Encoded, CodecError> {
        let layout = Layout { width: self.width, height: self.height, stride: self.stride, encoding: self.encoding };
        let bytes = codec::encode(&layout)?;
        let meta = Meta::try_from(&bytes[..]).expect("three integers and a tag have at most 16 bytes");
        Ok(Encoded { meta, payload: self.pixels.clone() })
    }

    fn decode(meta: &[u8], payload: &Payload) -> Result<Self, CodecError> {
        let layout: Layout = codec::decode(meta)?;
        Self::with_stride(layout.width, layout.height, layout.stride, layout.encoding, payload.clone())
    }
}

/// A frame as it leaves the car: scaled down and compressed. The gateway puts it on the key of the frame itself.
#[derive(Clone, Debug, PartialEq)]
pub struct CompressedImage {
    /// Columns, px.
    pub width: u32,
    /// Rows, px.
    pub height: u32,
    /// Columns of the frame that it was made from, px.
    pub source_width: u32,
    /// Rows of that frame, px.
    pub source_height: u32,
    /// How the pixels of that frame lay in memory.
    pub source_encoding: Encoding,
    /// A JPEG file.
    pub jpeg: Payload,
}

#[derive(Serialize, Deserialize)]
struct CompressedLayout {
    size: (u16, u16),
    source_size: (u16, u16),
    source_encoding: Encoding,
}

impl Message for CompressedImage {
    const TYPE: MessageType = MessageType::new("carril/CompressedImage", 1);

    fn encode(&self) -> Result<Encoded, CodecError> {
        let side = |pixels: u32| {
            u16::try_from(pixels).map_err(|_| CodecError::Invalid {
                what: "image size",
                got: format!("{pixels} px"),
                expected: "at most 65535 px a side".into(),
            })
        };
        let layout = CompressedLayout {
            size: (side(self.width)?, side(self.height)?),
            source_size: (side(self.source_width)?, side(self.source_height)?),
            source_encoding: self.source_encoding,
        };
        let bytes = codec::encode(&layout)?;
        let meta = Meta::try_from(&bytes[..]).expect("four small integers and a tag have at most 13 bytes");
        Ok(Encoded { meta, payload: self.jpeg.clone() })
    }

    fn decode(meta: &[u8], payload: &Payload) -> Result<Self, CodecError> {
        let layout: CompressedLayout = codec::decode(meta)?;
        let side = u32::from;
        Ok(Self {
            width: side(layout.size.0),
            height: side(layout.size.1),
            source_width: side(layout.source_size.0),
            source_height: side(layout.source_size.1),
            source_encoding: layout.source_encoding,
            jpeg: payload.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trips_without_copying_pixels() {
        let pixels = Payload::from((0..24).collect::<Vec<u8>>());
        let image = Image::packed(4, 2, Encoding::Bgr8, pixels).expect("4 x 2 x 3 = 24");
        let encoded = image.encode().expect("an image encodes");
        assert_eq!(encoded.payload.as_ptr(), image.pixels().as_ptr(), "no copy on the way out");
        let back = Image::decode(&encoded.meta, &encoded.payload).expect("and decodes");
        assert_eq!(back, image, "same image");
        assert_eq!(back.row(1), (12..24).collect::<Vec<u8>>(), "second row");
        assert_eq!(back.pixels().as_ptr(), image.pixels().as_ptr(), "no copy on the way in");
    }

    #[test]
    fn compressed_images_round_trip() {
        let image = CompressedImage {
            width: 480,
            height: 360,
            source_width: 65_535,
            source_height: 1,
            source_encoding: Encoding::Rgb8,
            jpeg: Payload::from(vec![1, 2, 3]),
        };
        let encoded = image.encode().expect("it fits");
        assert_eq!(CompressedImage::decode(&encoded.meta, &encoded.payload).expect("and back"), image, "the same");
        assert!(CompressedImage { width: 65_536, ..image }.encode().is_err(), "too wide");
        assert!(CompressedImage::decode(&[1], &encoded.payload).is_err(), "damaged");
    }

    #[test]
    fn refuses_sizes_that_do_not_fit() {
        let pixels = || Payload::from(vec![0; 24]);
        assert!(Image::packed(4, 3, Encoding::Bgr8, pixels()).is_err(), "too few bytes");
        assert!(Image::packed(0, 2, Encoding::Bgr8, pixels()).is_err(), "no pixels");
        assert!(Image::with_stride(4, 2, 11, Encoding::Bgr8, pixels()).is_err(), "rows overlap");
        let absurd = Image::packed(u32::MAX, u32::MAX, Encoding::Bgr8, pixels()).expect_err("absurd size");
        assert!(
            absurd.to_string().starts_with("image stride") || absurd.to_string().starts_with("image size"),
            "{absurd}"
        );
    }
}
