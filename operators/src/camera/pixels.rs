//! From OpenCV's matrices to images: pixels are written straight into the memory from which they are published.

use carril_messages::{Encoding, Image, PayloadMut};
use opencv::core::{self, Mat, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;
use opencv::videoio::VideoCapture;

/// Memory for pixels.
pub(crate) type Lend<'a> = &'a dyn Fn(usize) -> PayloadMut;

/// Turns frames into images. Keeps memory for those frames that need more than one step.
#[derive(Default)]
pub(crate) struct Converter {
    frame: Mat,
    scaled: Mat,
    /// Size of the last frame of the source, which the next one most likely has too.
    last: Option<(u32, u32)>,
}

impl Converter {
    /// The frame that was grabbed last. When nothing is to be converted, OpenCV writes it into the lent memory itself.
    pub(crate) fn retrieve(
        &mut self,
        capture: &mut VideoCapture,
        encoding: Encoding,
        size: Option<(u32, u32)>,
        lend: Lend<'_>,
    ) -> Result<Image, String> {
        if encoding == Encoding::Bgr8
            && let Some(last) = self.last
            && size.is_none_or(|size| size == last)
        {
            return self.retrieve_straight(capture, last, size, lend);
        }
        let got = capture.retrieve_def(&mut self.frame).map_err(text)?;
        if !got || self.frame.empty() {
            return Err("the frame cannot be decoded".into());
        }
        let frame = std::mem::take(&mut self.frame);
        let image = self.convert(&frame, encoding, size, lend);
        self.frame = frame;
        image
    }

    fn retrieve_straight(
        &mut self,
        capture: &mut VideoCapture,
        (width, height): (u32, u32),
        size: Option<(u32, u32)>,
        lend: Lend<'_>,
    ) -> Result<Image, String> {
        let len = width as usize * height as usize * 3;
        let mut buffer = lend(len);
        let lent = buffer.as_ptr();
        let mut target = Mat::new_rows_cols_with_bytes_mut::<Vec3b>(height as i32, width as i32, &mut buffer[..len])
            .map_err(text)?;
        let got = capture.retrieve_def(&mut target).map_err(text)?;
        if !got || target.empty() {
            return Err("the frame cannot be decoded".into());
        }
        if target.data() == lent {
            drop(target);
            return Image::packed(width, height, Encoding::Bgr8, buffer.freeze()).map_err(text);
        }
        // The size has changed: OpenCV took memory of its own.
        let frame = target.try_clone().map_err(text)?;
        self.convert(&frame, Encoding::Bgr8, size, lend)
    }

    /// A frame of 8 bits and 1 or 3 channels as an image of the encoding and size asked for.
    pub(crate) fn convert(
        &mut self,
        frame: &Mat,
        encoding: Encoding,
        size: Option<(u32, u32)>,
        lend: Lend<'_>,
    ) -> Result<Image, String> {
        let got = (frame.cols() as u32, frame.rows() as u32);
        self.last = Some(got);
        let Some((width, height)) = size.filter(|wanted| *wanted != got) else {
            return write(frame, encoding, lend);
        };
        let wanted = Size::new(width as i32, height as i32);
        let shrinks = width < got.0 && height < got.1;
        let method = if shrinks { imgproc::INTER_AREA } else { imgproc::INTER_LINEAR };
        imgproc::resize(frame, &mut self.scaled, wanted, 0.0, 0.0, method).map_err(text)?;
        write(&self.scaled, encoding, lend)
    }
}

fn write(frame: &Mat, encoding: Encoding, lend: Lend<'_>) -> Result<Image, String> {
    if frame.depth() != core::CV_8U {
        return Err(format!("the frame has OpenCV's depth {}, expected 8 bits a channel", frame.depth()));
    }
    let code = match (frame.channels(), encoding) {
        (1, Encoding::Mono8) | (3, Encoding::Bgr8) => None,
        (1, _) => Some(imgproc::COLOR_GRAY2BGR),
        (3, Encoding::Mono8) => Some(imgproc::COLOR_BGR2GRAY),
        (3, Encoding::Rgb8) => Some(imgproc::COLOR_BGR2RGB),
        (channels, _) => return Err(format!("the frame has {channels} channels, expected 1 or 3")),
    };
    let (rows, cols) = (frame.rows(), frame.cols());
    let len = rows as usize * cols as usize * encoding.bytes_per_pixel();
    let mut buffer = lend(len);
    let lent = buffer.as_ptr();
    let memory = &mut buffer[..len];
    let mut target = match encoding {
        Encoding::Mono8 => Mat::new_rows_cols_with_bytes_mut::<u8>(rows, cols, memory),
        _ => Mat::new_rows_cols_with_bytes_mut::<Vec3b>(rows, cols, memory),
    }
    .map_err(text)?;
    match code {
        Some(code) => imgproc::cvt_color_def(frame, &mut target, code),
        None => frame.copy_to(&mut target),
    }
    .map_err(text)?;
    assert!(target.data() == lent, "OpenCV writes where it is told when size and type are right");
    drop(target);
    Image::packed(cols as u32, rows as u32, encoding, buffer.freeze()).map_err(text)
}

/// What an error says, on one line.
pub(crate) fn text(error: impl std::fmt::Display) -> String {
    error.to_string().replace('\n', " ").trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEND: Lend<'static> = &PayloadMut::heap;

    fn frame() -> Mat {
        let bytes: Vec<u8> = (0..4 * 6 * 3).collect();
        Mat::new_rows_cols_with_bytes::<Vec3b>(4, 6, &bytes).and_then(|mat| mat.try_clone()).expect("whole pixels")
    }

    #[test]
    fn keeps_or_reorders_channels() {
        let mut converter = Converter::default();
        let bgr = converter.convert(&frame(), Encoding::Bgr8, None, LEND).expect("as it is");
        assert_eq!(&bgr.row(0)[..6], [0, 1, 2, 3, 4, 5], "blue, green, red");
        let rgb = converter.convert(&frame(), Encoding::Rgb8, None, LEND).expect("reordered");
        assert_eq!(&rgb.row(0)[..6], [2, 1, 0, 5, 4, 3], "red, green, blue");
        let mono = converter.convert(&frame(), Encoding::Mono8, None, LEND).expect("grey");
        assert_eq!((mono.width(), mono.height(), mono.pixels().len()), (6, 4, 24), "one byte a pixel");
    }

    #[test]
    fn scales_to_the_size_asked_for() {
        let image = Converter::default().convert(&frame(), Encoding::Bgr8, Some((12, 8)), LEND).expect("scaled");
        assert_eq!((image.width(), image.height()), (12, 8), "twice as large");
    }

    #[test]
    fn refuses_frames_that_are_no_picture() {
        let deep = Mat::new_rows_cols_with_default(2, 2, core::CV_16UC1, 0.into()).expect("16 bits");
        let error = Converter::default().convert(&deep, Encoding::Mono8, None, LEND).expect_err("16 bits");
        assert!(error.contains("expected 8 bits"), "{error}");
    }
}
