//! The hot loops: a row of pixels to grey values or to a colour mask, and the count of marking pixels in a row. Bit for bit
//! the same numbers as OpenCV's `cvtColor`. Written so that the compiler vectorises them: no branch, no overflow check, no bound.

use carril_messages::Encoding;

use super::config::HsvRange;

/// Weights of blue, green and red, in 1/32768: ITU-R BT.601, as in OpenCV's `color_rgb.simd.hpp`.
const GREY_WEIGHTS: [u32; 3] = [3735, 19235, 9798];

/// Grey values of a row. `out` is as long as the row has pixels.
pub(crate) fn grey_row(encoding: Encoding, row: &[u8], out: &mut [u8]) {
    let [blue, green, red] = GREY_WEIGHTS;
    match encoding {
        Encoding::Mono8 => out.copy_from_slice(row),
        Encoding::Rgb8 => weigh(row, out, [red, green, blue]),
        // `Encoding` may grow; every three-byte encoding that we know of is handled above or here.
        _ => weigh(row, out, [blue, green, red]),
    }
}

fn weigh(row: &[u8], out: &mut [u8], [first, second, third]: [u32; 3]) {
    for (pixel, grey) in row.chunks_exact(3).zip(out) {
        // At most 255 * 32768 + 16384: far from overflow.
        let sum = u32::from(pixel[0])
            .wrapping_mul(first)
            .wrapping_add(u32::from(pixel[1]).wrapping_mul(second))
            .wrapping_add(u32::from(pixel[2]).wrapping_mul(third));
        *grey = (sum.wrapping_add(1 << 14) >> 15) as u8;
    }
}

/// 1 where the pixel's colour lies in `range`, else 0. `out` is as long as the row has pixels.
pub(crate) fn hsv_mask_row(encoding: Encoding, row: &[u8], range: &HsvRange, out: &mut [u8]) {
    match encoding {
        Encoding::Mono8 => {
            for (grey, mask) in row.iter().zip(out) {
                *mask = u8::from(range.contains(hsv(*grey, *grey, *grey)));
            }
        }
        Encoding::Rgb8 => {
            for (pixel, mask) in row.chunks_exact(3).zip(out) {
                *mask = u8::from(range.contains(hsv(pixel[2], pixel[1], pixel[0])));
            }
        }
        _ => {
            for (pixel, mask) in row.chunks_exact(3).zip(out) {
                *mask = u8::from(range.contains(hsv(pixel[0], pixel[1], pixel[2])));
            }
        }
    }
}

impl HsvRange {
    /// Whether a colour lies in the range.
    pub(crate) fn contains(&self, [h, s, v]: [i32; 3]) -> bool {
        let [from, to] = self.h;
        let hue = if from <= to { from <= h && h <= to } else { h >= from || h <= to };
        hue && self.s[0] <= s && s <= self.s[1] && self.v[0] <= v && v <= self.v[1]
    }
}

/// `round(numerator * 4096 / value)`, as OpenCV rounds: half to even.
const fn reciprocals(numerator: i64, factor: i64) -> [i32; 256] {
    let mut table = [0; 256];
    let mut value = 1;
    while value < 256 {
        let (dividend, divisor) = (numerator << 12, factor * value as i64);
        let (whole, rest) = (dividend / divisor, dividend % divisor);
        let up = 2 * rest > divisor || (2 * rest == divisor && whole % 2 == 1);
        table[value] = (whole + up as i64) as i32;
        value += 1;
    }
    table
}

static SATURATION: [i32; 256] = reciprocals(255, 1);
static HUE: [i32; 256] = reciprocals(180, 6);

/// A colour in OpenCV's 8-bit HSV: hue 0 to 179, saturation and value 0 to 255. After `RGB2HSV_b` in `color_hsv.simd.hpp`.
pub(crate) fn hsv(blue: u8, green: u8, red: u8) -> [i32; 3] {
    let (b, g, r) = (i32::from(blue), i32::from(green), i32::from(red));
    let value = b.max(g).max(r);
    let difference = value - b.min(g).min(r);
    let saturation = (difference * SATURATION[value as usize & 255] + (1 << 11)) >> 12;
    let sixths = if value == r {
        g - b
    } else if value == g {
        b - r + 2 * difference
    } else {
        r - g + 4 * difference
    };
    let hue = (sixths * HUE[difference as usize & 255] + (1 << 11)) >> 12;
    [if hue < 0 { hue + 180 } else { hue }, saturation, value]
}

/// How many values of a row are marking, and the sum of their columns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Marked {
    pub count: u64,
    pub column_sum: u64,
}

/// Counts the values for which `is_marking` holds.
pub(crate) fn count_marked(row: &[u8], is_marking: impl Fn(u8) -> bool) -> Marked {
    const CHUNK: usize = 256;
    let mut marked = Marked::default();
    for (index, chunk) in row.chunks(CHUNK).enumerate() {
        // 16-bit sums keep eight lanes busy and cannot overflow: 0 + 1 + ... + 255 = 32640.
        let (mut count, mut local_sum, mut column) = (0_u16, 0_u16, 0_u16);
        for &value in chunk {
            let mask = u16::from(is_marking(value));
            count = count.wrapping_add(mask);
            local_sum = local_sum.wrapping_add(mask.wrapping_mul(column));
            column = column.wrapping_add(1);
        }
        marked.count += u64::from(count);
        marked.column_sum += (index * CHUNK) as u64 * u64::from(count) + u64::from(local_sum);
    }
    marked
}

#[cfg(test)]
mod tests {
    use opencv::core::{Mat, MatTraitConst, MatTraitConstManual, Vec3b};
    use opencv::imgproc;
    use proptest::prelude::*;

    use super::*;

    fn by_opencv(bytes: &[u8], code: i32) -> Vec<u8> {
        let source = Mat::new_rows_cols_with_bytes::<Vec3b>(1, (bytes.len() / 3) as i32, bytes).expect("whole pixels");
        let mut converted = Mat::default();
        imgproc::cvt_color_def(&source, &mut converted, code).expect("a supported conversion");
        assert!(converted.is_continuous(), "one row");
        converted.data_bytes().expect("continuous").to_vec()
    }

    /// Every colour whose components are multiples of 3: 636 056 of them.
    fn many_colours() -> Vec<u8> {
        let steps = || (0..=255_u8).step_by(3);
        steps().flat_map(|b| steps().flat_map(move |g| steps().flat_map(move |r| [b, g, r]))).collect()
    }

    #[test]
    fn grey_is_opencvs_to_the_bit() {
        let colours = many_colours();
        for (encoding, code) in [(Encoding::Bgr8, imgproc::COLOR_BGR2GRAY), (Encoding::Rgb8, imgproc::COLOR_RGB2GRAY)] {
            let mut ours = vec![0; colours.len() / 3];
            grey_row(encoding, &colours, &mut ours);
            assert!(ours == by_opencv(&colours, code), "{encoding}: all grey values are equal");
        }
    }

    #[test]
    fn hsv_is_opencvs_to_the_bit() {
        let colours = many_colours();
        let theirs = by_opencv(&colours, imgproc::COLOR_BGR2HSV);
        for (pixel, expected) in colours.chunks_exact(3).zip(theirs.chunks_exact(3)) {
            let ours = hsv(pixel[0], pixel[1], pixel[2]);
            assert_eq!(ours, [expected[0], expected[1], expected[2]].map(i32::from), "bgr {pixel:?}");
        }
    }

    #[test]
    fn a_hue_range_runs_through_red() {
        let red = HsvRange { h: [170, 10], s: [100, 255], v: [50, 255] };
        assert!(red.contains(hsv(0, 0, 255)), "pure red has hue 0");
        assert!(red.contains(hsv(20, 0, 255)), "a bluish red has hue 178");
        assert!(!red.contains(hsv(255, 0, 0)), "blue is no red");
    }

    proptest! {
        #[test]
        fn counts_like_the_plain_loop(row in proptest::collection::vec(any::<u8>(), 0..1500), threshold: u8) {
            let columns: Vec<u64> = (0..row.len()).filter(|x| row[*x] > threshold).map(|x| x as u64).collect();
            let expected = Marked { count: columns.len() as u64, column_sum: columns.iter().sum() };
            prop_assert_eq!(count_marked(&row, |grey| grey > threshold), expected);
        }
    }
}
