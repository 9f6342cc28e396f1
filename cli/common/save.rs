//! Writes a camera image to a file.

use std::path::Path;

use anyhow::{Context, Result, bail};
use carril_messages::{CompressedImage, Encoding, Image};
use image::{DynamicImage, GrayImage, ImageFormat, RgbImage};

/// Refuses file names whose ending names no format, before anything is waited for.
pub fn check_name(path: &Path) -> Result<()> {
    format(path).map(drop)
}

fn format(path: &Path) -> Result<ImageFormat> {
    match ImageFormat::from_path(path) {
        Ok(known @ (ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::Pnm)) => Ok(known),
        _ => bail!("`{}` names no image format; let it end in .png, .ppm, .pgm or .jpg", path.display()),
    }
}

/// Writes `image`; the ending of the name decides on the format.
pub fn image(image: &Image, path: &Path) -> Result<()> {
    let format = format(path)?;
    to_dynamic(image).save_with_format(path, format).with_context(|| format!("cannot write `{}`", path.display()))
}

/// Writes a compressed image as it came, or as the format that the ending of the name says.
pub fn compressed(image: &CompressedImage, path: &Path) -> Result<()> {
    let format = format(path)?;
    let failed = || format!("cannot write `{}`", path.display());
    if format == ImageFormat::Jpeg {
        return std::fs::write(path, image.jpeg.bytes()).with_context(failed);
    }
    let decoded = image::load_from_memory(image.jpeg.bytes()).context("the image is damaged")?;
    decoded.save_with_format(path, format).with_context(failed)
}

fn to_dynamic(image: &Image) -> DynamicImage {
    let mut packed = Vec::with_capacity(image.pixels().len());
    for y in 0..image.height() {
        let row = image.row(y);
        match image.encoding() {
            Encoding::Bgr8 => packed.extend(row.chunks_exact(3).flat_map(|pixel| [pixel[2], pixel[1], pixel[0]])),
            _ => packed.extend_from_slice(row),
        }
    }
    let fits = "rows without padding fit the size";
    if image.encoding().bytes_per_pixel() == 1 {
        DynamicImage::ImageLuma8(GrayImage::from_raw(image.width(), image.height(), packed).expect(fits))
    } else {
        DynamicImage::ImageRgb8(RgbImage::from_raw(image.width(), image.height(), packed).expect(fits))
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::Payload;

    use super::*;

    #[test]
    fn blue_stays_blue_and_padding_goes() {
        let dir = tempfile::tempdir().expect("a folder for the test");
        let pixels = vec![255, 0, 0, 9, 0, 0, 255, 9];
        let frame = Image::with_stride(1, 2, 4, Encoding::Bgr8, Payload::from(pixels)).expect("1 x 2, stride 4");
        for name in ["frame.png", "frame.ppm"] {
            let path = dir.path().join(name);
            image(&frame, &path).expect("it can be written");
            let read = image::open(&path).expect("it can be read").to_rgb8();
            assert_eq!((read.get_pixel(0, 0).0, read.get_pixel(0, 1).0), ([0, 0, 255], [255, 0, 0]), "{name}");
        }
    }

    #[test]
    fn refuses_endings_that_name_no_format() {
        for name in ["frame", "frame.txt", "frame.webp"] {
            let error = check_name(Path::new(name)).expect_err("no format of ours").to_string();
            assert!(error.contains(".png"), "says what is allowed: {error}");
        }
    }
}
