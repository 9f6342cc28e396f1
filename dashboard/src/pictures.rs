//! Camera images for people far away: scaled down, compressed as JPEG, made only when somebody looks. And the colour of one pixel.

use std::borrow::Cow;

use carril_messages::{CompressedImage, Encoding, Image, Payload};
use opencv::core::{Mat, MatTraitConst, MatTraitConstManual, Size, Vec3b, Vector, VectorToVec};
use opencv::{imgcodecs, imgproc};
use serde::Serialize;

/// OpenCV could not do it.
#[derive(Debug, thiserror::Error)]
#[error("the image cannot be converted: {0}")]
pub struct PictureError(#[from] opencv::Error);

/// A picture ready to be sent.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Columns, px.
    pub width: u32,
    /// Rows, px.
    pub height: u32,
    /// The JPEG file.
    pub jpeg: Vec<u8>,
}

/// What a pixel of the raw image holds, in the terms of thresholds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Colour {
    /// Column, px from the left.
    pub x: u32,
    /// Row, px from the top.
    pub y: u32,
    /// Brightness, 0 to 255, as the lane detector computes it.
    pub grey: u8,
    /// Red, green, blue, 0 to 255.
    pub rgb: [u8; 3],
    /// Hue 0 to 179, saturation and value 0 to 255, as OpenCV has them.
    pub hsv: [u8; 3],
}

/// As JPEG, at most `max_width` px wide (never enlarged), with a quality of 1 to 100.
pub fn compress(image: &Image, max_width: u32, quality: u8) -> Result<Picture, PictureError> {
    let mut shown = blue_first(image)?;
    let max_width = max_width.max(1);
    if image.width() > max_width {
        let height = (u64::from(image.height()) * u64::from(max_width) / u64::from(image.width())).max(1);
        let mut scaled = Mat::default();
        let size = Size::new(max_width as i32, height as i32);
        imgproc::resize(&shown, &mut scaled, size, 0.0, 0.0, imgproc::INTER_AREA)?;
        shown = scaled;
    }
    let settings = Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, i32::from(quality.clamp(1, 100))]);
    let mut jpeg = Vector::new();
    imgcodecs::imencode(".jpg", &shown, &mut jpeg, &settings)?;
    Ok(Picture { width: shown.cols() as u32, height: shown.rows() as u32, jpeg: jpeg.to_vec() })
}

/// An image as it leaves the car, with what it was made from.
pub fn compressed(image: &Image, max_width: u32, quality: u8) -> Result<CompressedImage, PictureError> {
    let picture = compress(image, max_width, quality)?;
    Ok(CompressedImage {
        width: picture.width,
        height: picture.height,
        source_width: image.width(),
        source_height: image.height(),
        source_encoding: image.encoding(),
        jpeg: Payload::from(picture.jpeg),
    })
}

/// The other way: an image of the size and the encoding that it was made from. Refuses what would be larger than `max_bytes`, before room
/// is made for it: the picture may come from somebody else.
pub fn restore(picture: &CompressedImage, max_bytes: usize) -> Result<Image, PictureError> {
    let refused = |reason: String| PictureError::from(opencv::Error::new(opencv::core::StsBadArg, reason));
    let (width, height) = (picture.source_width, picture.source_height);
    let fits =
        |(width, height): (u32, u32)| width as usize * height as usize * 3 <= max_bytes && width > 0 && height > 0;
    let inside = jpeg_size(&picture.jpeg).ok_or_else(|| refused("it is no JPEG file".into()))?;
    if !fits((width, height)) || !fits(inside) {
        return Err(refused(format!("{width}x{height} px, made from {inside:?}: an image has at most {max_bytes} B")));
    }
    let grey = picture.source_encoding.bytes_per_pixel() == 1;
    let mode = if grey { imgcodecs::IMREAD_GRAYSCALE } else { imgcodecs::IMREAD_COLOR };
    let mut pixels = imgcodecs::imdecode(&Vector::<u8>::from_slice(&picture.jpeg), mode)?;
    let size = Size::new(width as i32, height as i32);
    if pixels.size()? != size {
        let mut scaled = Mat::default();
        imgproc::resize(&pixels, &mut scaled, size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        pixels = scaled;
    }
    if picture.source_encoding == Encoding::Rgb8 {
        let mut turned = Mat::default();
        imgproc::cvt_color_def(&pixels, &mut turned, imgproc::COLOR_BGR2RGB)?;
        pixels = turned;
    }
    let image = Image::packed(width, height, picture.source_encoding, pixels.data_bytes()?.to_vec().into());
    image.map_err(|error| refused(error.to_string()))
}

/// Columns and rows of a JPEG file, from its frame header (ITU-T T.81, B.2.2).
fn jpeg_size(file: &[u8]) -> Option<(u32, u32)> {
    let mut rest = file.strip_prefix(&[0xff, 0xd8])?;
    loop {
        let [0xff, marker, high, low, after @ ..] = rest else { return None };
        let segment = after.get(..usize::from(u16::from_be_bytes([*high, *low])).checked_sub(2)?)?;
        // SOF0 to SOF15; DHT, JPG and DAC lie between them.
        if matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc) {
            let side = |at: usize| Some(u32::from(u16::from_be_bytes([*segment.get(at)?, *segment.get(at + 1)?])));
            return Some((side(3)?, side(1)?));
        }
        rest = &after[segment.len()..];
    }
}

/// The pixel at a share of the width from the left and of the height from the top, 0 to 1. Others are those at the edge.
pub fn colour_at(image: &Image, x: f64, y: f64) -> Result<Colour, PictureError> {
    let at = |share: f64, size: u32| ((share.clamp(0.0, 1.0) * f64::from(size)) as u32).min(size - 1);
    let (x, y) = (at(x, image.width()), at(y, image.height()));
    let bytes = image.encoding().bytes_per_pixel();
    let pixel = &image.row(y)[x as usize * bytes..][..bytes];
    let [blue, green, red] = match (image.encoding(), pixel) {
        (Encoding::Rgb8, &[red, green, blue]) | (_, &[blue, green, red]) => [blue, green, red],
        (_, grey) => [grey[0]; 3],
    };
    let dot = Mat::from_slice(&[Vec3b::from([blue, green, red])])?.try_clone()?;
    let (mut grey, mut hsv) = (Mat::default(), Mat::default());
    imgproc::cvt_color_def(&dot, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    imgproc::cvt_color_def(&dot, &mut hsv, imgproc::COLOR_BGR2HSV)?;
    let hsv = *hsv.at::<Vec3b>(0)?;
    Ok(Colour { x, y, grey: *grey.at::<u8>(0)?, rgb: [red, green, blue], hsv: hsv.0 })
}

/// An image as OpenCV has it: one grey channel, or blue, green, red.
fn blue_first(image: &Image) -> Result<Mat, PictureError> {
    let (height, width) = (image.height() as i32, image.width() as i32);
    let bytes = packed(image);
    if image.encoding().bytes_per_pixel() == 1 {
        return Ok(Mat::new_rows_cols_with_bytes::<u8>(height, width, &bytes)?.try_clone()?);
    }
    let pixels = Mat::new_rows_cols_with_bytes::<Vec3b>(height, width, &bytes)?;
    if image.encoding() != Encoding::Rgb8 {
        return Ok(pixels.try_clone()?);
    }
    let mut turned = Mat::default();
    imgproc::cvt_color_def(&pixels, &mut turned, imgproc::COLOR_RGB2BGR)?;
    Ok(turned)
}

/// Rows without padding between them: where they lie, if there is none.
fn packed(image: &Image) -> Cow<'_, [u8]> {
    let row_bytes = image.width() as usize * image.encoding().bytes_per_pixel();
    if image.stride() as usize == row_bytes {
        return Cow::Borrowed(image.pixels());
    }
    Cow::Owned((0..image.height()).flat_map(|y| image.row(y).iter().copied()).collect())
}

/// The pixels of a JPEG file, blue first, or one grey channel.
pub fn decompress(jpeg: &[u8]) -> Result<Image, PictureError> {
    let file = Vector::<u8>::from_slice(jpeg);
    let pixels = imgcodecs::imdecode(&file, imgcodecs::IMREAD_UNCHANGED)?;
    let encoding = if pixels.channels() == 1 { Encoding::Mono8 } else { Encoding::Bgr8 };
    let bytes = pixels.data_bytes()?.to_vec();
    let image = Image::packed(pixels.cols() as u32, pixels.rows() as u32, encoding, bytes.into());
    image.map_err(|error| opencv::Error::new(opencv::core::StsBadArg, error.to_string()).into())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Left half red, right half blue, with padding after each row.
    fn halves(encoding: Encoding) -> Image {
        let (red, blue) =
            if encoding == Encoding::Rgb8 { ([200, 0, 0], [0, 0, 100]) } else { ([0, 0, 200], [100, 0, 0]) };
        let row = [red.repeat(32), blue.repeat(32), vec![9; 5]].concat();
        Image::with_stride(64, 48, 64 * 3 + 5, encoding, Payload::from(row.repeat(48))).expect("it fits")
    }

    #[test]
    fn pictures_are_scaled_and_keep_their_colours() {
        for encoding in [Encoding::Rgb8, Encoding::Bgr8] {
            let picture = compress(&halves(encoding), 32, 90).expect("it can be compressed");
            assert_eq!((picture.width, picture.height), (32, 24), "half as wide, same shape");
            let decoded = image::load_from_memory(&picture.jpeg).expect("any reader can read it").to_rgb8();
            let (left, right) = (decoded.get_pixel(4, 12).0, decoded.get_pixel(28, 12).0);
            assert!(left[0] > 150 && left[2] < 60, "{encoding}: the left is red, got {left:?}");
            assert!(right[2] > 60 && right[0] < 60, "{encoding}: the right is blue, got {right:?}");
            let own = decompress(&picture.jpeg).expect("ours can, too");
            assert_eq!((own.width(), own.height(), own.encoding()), (32, 24, Encoding::Bgr8), "same picture");
        }
    }

    #[test]
    fn a_picture_that_would_become_too_large_is_refused_whatever_it_says_of_itself() {
        let mut picture = compressed(&halves(Encoding::Bgr8), 32, 90).expect("it can be compressed");
        assert_eq!(jpeg_size(&picture.jpeg), Some((32, 24)), "as the file has it");
        let room = 64 * 48 * 3;
        assert!(restore(&picture, room).is_ok(), "it fits");
        assert!(restore(&picture, room - 1).is_err(), "the image would not");
        picture.source_width = 0;
        assert!(restore(&picture, room).is_err(), "no columns");
        picture.source_width = 8;
        picture.source_height = 8;
        assert!(restore(&picture, 8 * 8 * 3).is_err(), "the file has more pixels than that");
        for len in 0..picture.jpeg.len().min(700) {
            picture.jpeg = Payload::from(picture.jpeg[..picture.jpeg.len() - 1].to_vec());
            let _ = restore(&picture, room);
            assert!(jpeg_size(&picture.jpeg).is_none_or(|size| size == (32, 24)), "cut at {len}: never a wrong size");
        }
    }

    #[test]
    fn small_images_are_not_enlarged_and_grey_stays_grey() {
        let grey = Image::packed(2, 1, Encoding::Mono8, Payload::from(vec![0, 255])).expect("it fits");
        let picture = compress(&grey, 480, 70).expect("it can be compressed");
        assert_eq!((picture.width, picture.height), (2, 1), "as it was");
        assert_eq!(decompress(&picture.jpeg).expect("it is a JPEG").encoding(), Encoding::Mono8, "one channel");
        assert!(decompress(b"no JPEG at all").is_err(), "other bytes are refused");
        assert!(decompress(b"").is_err(), "none, too");
    }

    #[test]
    fn a_pixel_shows_the_numbers_of_thresholds() {
        for encoding in [Encoding::Rgb8, Encoding::Bgr8] {
            let image = halves(encoding);
            let red = colour_at(&image, 0.1, 0.5).expect("inside");
            assert_eq!((red.x, red.y, red.rgb), (6, 24, [200, 0, 0]), "{encoding}");
            assert_eq!((red.grey, red.hsv), (60, [0, 255, 200]), "{encoding}: 0.299 * 200; pure red");
            assert_eq!(colour_at(&image, 2.0, f64::NAN).expect("the edge").x, 63, "beyond the edge is the edge");
        }
    }
}
