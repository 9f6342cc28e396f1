//! Floor pictures: looked at when a graph is checked, decoded and made smaller when a world is built.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use image::{ColorType, ImageDecoder, ImageReader, Limits};

/// No side of a picture is longer, px.
const MAX_SIDE_PX: u32 = 16_384;
/// No picture has more pixels; decoding takes up to 4 B for each.
const MAX_PIXELS: u64 = 64_000_000;

/// A picture, reduced; rows from the bottom up, so that y points north.
#[derive(Clone, Debug, PartialEq)]
pub struct Reduced {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// One plane of grey, or three: blue, green, red.
    pub planes: Vec<Vec<u8>>,
}

fn open(path: &Path) -> Result<impl ImageDecoder, String> {
    let shown = path.display();
    let file = File::open(path).map_err(|error| format!("cannot read `{shown}`: {error}"))?;
    let reader = ImageReader::new(BufReader::new(file))
        .with_guessed_format()
        .map_err(|error| format!("cannot read `{shown}`: {error}"))?;
    let mut decoder = reader.into_decoder().map_err(|error| format!("`{shown}` is no PNG or JPEG picture: {error}"))?;
    let (width, height) = decoder.dimensions();
    let pixels = u64::from(width) * u64::from(height);
    if width.min(height) < 2 || width.max(height) > MAX_SIDE_PX || pixels > MAX_PIXELS {
        let allowed = format!("2 to {MAX_SIDE_PX} px a side and {} million pixels", MAX_PIXELS / 1_000_000);
        return Err(format!("`{shown}` has {width}x{height} px, allowed are {allowed}"));
    }
    let mut limits = Limits::default();
    limits.max_alloc = Some(8 * MAX_PIXELS);
    decoder.set_limits(limits).map_err(|error| format!("`{shown}`: {error}"))?;
    Ok(decoder)
}

/// Whether there is a picture of a sensible size; reads only its head.
pub fn probe(path: &Path) -> Result<(), String> {
    open(path).map(drop)
}

/// Decodes a picture and reduces it to at most `max_width` x `max_height` by averaging. Transparent parts are black.
pub fn load(path: &Path, max_width: usize, max_height: usize) -> Result<Reduced, String> {
    let decoder = open(path)?;
    let (width, height) = (decoder.dimensions().0 as usize, decoder.dimensions().1 as usize);
    let colour = decoder.color_type();
    let bytes = usize::try_from(decoder.total_bytes()).map_err(|_| "the picture does not fit in memory".to_owned())?;
    let mut pixels = vec![0; bytes];
    decoder.read_image(&mut pixels).map_err(|error| format!("`{}` is damaged: {error}", path.display()))?;
    let size = (width.min(max_width.max(1)), height.min(max_height.max(1)));
    reduce(&pixels, (width, height), size, colour).ok_or_else(|| {
        format!("`{}` has {colour:?} pixels, allowed are 8 or 16 bits of grey or colour", path.display())
    })
}

/// How to read a pixel: bytes per channel, channels, whether the last is alpha.
fn layout(colour: ColorType) -> Option<(usize, usize, bool)> {
    Some(match colour {
        ColorType::L8 => (1, 1, false),
        ColorType::La8 => (1, 2, true),
        ColorType::Rgb8 => (1, 3, false),
        ColorType::Rgba8 => (1, 4, true),
        ColorType::L16 => (2, 1, false),
        ColorType::La16 => (2, 2, true),
        ColorType::Rgb16 => (2, 3, false),
        ColorType::Rgba16 => (2, 4, true),
        _ => return None,
    })
}

/// The colour of one pixel as blue, green, red over black.
fn bgr(pixel: &[u8], depth: usize, channels: usize, alpha: bool) -> [u32; 3] {
    // Native byte order: the high byte of a 16-bit channel is the last on little-endian machines.
    let high = if cfg!(target_endian = "little") { depth - 1 } else { 0 };
    let channel = |index: usize| u32::from(pixel[index * depth + high]);
    let colours = if channels >= 3 { [channel(2), channel(1), channel(0)] } else { [channel(0); 3] };
    if alpha { colours.map(|colour| colour * channel(channels - 1) / 255) } else { colours }
}

fn reduce(pixels: &[u8], from: (usize, usize), to: (usize, usize), colour: ColorType) -> Option<Reduced> {
    let (depth, channels, alpha) = layout(colour)?;
    let mut planes = [(); 3].map(|()| Vec::with_capacity(to.0 * to.1));
    let mut sums = vec![[0_u32; 4]; to.0];
    let column_of: Vec<usize> = (0..from.0).map(|x| x * to.0 / from.0).collect();
    let mut is_grey = true;
    let rows = pixels.chunks_exact(from.0 * depth * channels);
    for (y, row) in rows.enumerate().rev() {
        for (pixel, column) in row.chunks_exact(depth * channels).zip(&column_of) {
            let [b, g, r] = bgr(pixel, depth, channels, alpha);
            let sum = &mut sums[*column];
            *sum = [sum[0] + b, sum[1] + g, sum[2] + r, sum[3] + 1];
        }
        let ends_row = y == 0 || (y - 1) * to.1 / from.1 != y * to.1 / from.1;
        if ends_row {
            for sum in &mut sums {
                let mean = [0, 1, 2].map(|plane| (sum[plane] / sum[3].max(1)) as u8);
                is_grey &= mean[0].abs_diff(mean[1]) <= 3 && mean[2].abs_diff(mean[1]) <= 3;
                planes.iter_mut().zip(mean).for_each(|(plane, value)| plane.push(value));
                *sum = [0; 4];
            }
        }
    }
    let [b, g, r] = planes;
    let planes = if is_grey { vec![g] } else { vec![b, g, r] };
    Some(Reduced { width: to.0, height: to.1, planes })
}

#[cfg(test)]
mod tests {
    use image::{GrayImage, Luma, Rgb, RgbImage, Rgba, RgbaImage};

    use super::*;

    #[test]
    fn averages_and_turns_rows_upside_down() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("floor.png");
        GrayImage::from_fn(6, 4, |x, y| Luma([(x / 2 * 10 + y / 2 * 100) as u8])).save(&path).expect("saved");
        let reduced = load(&path, 3, 2).expect("a picture");
        assert_eq!((reduced.width, reduced.height), (3, 2), "size");
        assert_eq!(reduced.planes, [[100, 110, 120, 0, 10, 20]], "one plane, bottom row first");
        let same = load(&path, 100, 100).expect("a picture");
        assert_eq!((same.width, same.height), (6, 4), "never larger than the file");
    }

    #[test]
    fn keeps_colour_and_blends_alpha() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("floor.png");
        RgbImage::from_pixel(4, 4, Rgb([10, 20, 200])).save(&path).expect("saved");
        assert_eq!(load(&path, 2, 2).expect("a picture").planes, [[200; 4], [20; 4], [10; 4]], "blue, green, red");
        RgbaImage::from_pixel(4, 4, Rgba([200, 200, 200, 51])).save(&path).expect("saved");
        assert_eq!(load(&path, 2, 2).expect("a picture").planes, [[40; 4]], "a fifth of 200 over black");
    }

    #[test]
    fn a_truncated_picture_is_an_error() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("floor.png");
        GrayImage::from_fn(16, 16, |x, y| Luma([(x * y) as u8])).save(&path).expect("saved");
        let bytes = std::fs::read(&path).expect("read");
        for len in 0..bytes.len() - 12 {
            std::fs::write(&path, &bytes[..len]).expect("written");
            assert!(load(&path, 8, 8).is_err(), "{len} of {} bytes", bytes.len());
        }
    }
}
