//! Otsu's method: the threshold that divides grey values into the two classes whose means differ most, weighed by their sizes.
//!
//! N. Otsu, "A threshold selection method from gray-level histograms", IEEE Trans. SMC 9(1), 1979, eq. 18.

/// A histogram divided in two.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Split {
    /// Values up to it are the dark class.
    pub threshold: u8,
    /// Mean of the bright class minus mean of the dark class; 0 when all values are equal.
    pub contrast: f64,
}

/// Divides values. Where many thresholds do equally well (nothing lies between the classes), it takes the middle one.
pub(crate) fn split(values: &[u8]) -> Split {
    let histogram = histogram(values);
    let total = values.len() as f64;
    let total_sum: f64 = histogram.iter().enumerate().map(|(value, count)| value as f64 * f64::from(*count)).sum();
    let (mut best, mut first, mut last, mut contrast) = (0.0, 0, 0, 0.0);
    let (mut dark, mut dark_sum) = (0.0, 0.0);
    for (value, count) in histogram.iter().enumerate() {
        dark += f64::from(*count);
        dark_sum += value as f64 * f64::from(*count);
        let bright = total - dark;
        if dark == 0.0 || bright == 0.0 {
            continue;
        }
        let difference = (total_sum - dark_sum) / bright - dark_sum / dark;
        let between = dark * bright * difference * difference;
        if between > best {
            (best, first, last, contrast) = (between, value, value, difference);
        } else if between == best && value == last + 1 {
            last = value;
        }
    }
    Split { threshold: usize::midpoint(first, last) as u8, contrast }
}

/// Four tables in turn, so that equal neighbours (most of a floor) do not wait for each other's increment.
fn histogram(values: &[u8]) -> [u32; 256] {
    let mut tables = [[0_u32; 256]; 4];
    let mut fours = values.chunks_exact(4);
    for four in &mut fours {
        for (table, value) in tables.iter_mut().zip(four) {
            let count = &mut table[usize::from(*value)];
            *count = count.wrapping_add(1);
        }
    }
    for value in fours.remainder() {
        tables[0][usize::from(*value)] += 1;
    }
    std::array::from_fn(|value| tables.iter().map(|table| table[value]).sum())
}

#[cfg(test)]
mod tests {
    use opencv::core::{Mat, Vector};
    use opencv::imgproc;
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn takes_the_middle_between_two_peaks() {
        let values = [vec![50; 900], vec![200; 100]].concat();
        assert_eq!(split(&values), Split { threshold: 124, contrast: 150.0 }, "50 to 199 do equally well");
    }

    #[test]
    fn equal_values_have_no_contrast() {
        assert_eq!(split(&[80; 100]), Split { threshold: 0, contrast: 0.0 }, "one class only");
        assert_eq!(split(&[]), Split { threshold: 0, contrast: 0.0 }, "no class at all");
    }

    proptest! {
        #[test]
        fn divides_like_opencv(values in proptest::collection::vec(any::<u8>(), 2..400)) {
            let source: Vector<u8> = values.iter().copied().collect();
            let mut binary = Mat::default();
            let kind = imgproc::THRESH_BINARY | imgproc::THRESH_OTSU;
            let theirs = imgproc::threshold(&source, &mut binary, 0.0, 255.0, kind).expect("a valid image") as u8;
            let bright = |threshold: u8| values.iter().filter(|value| **value > threshold).count();
            prop_assert_eq!(bright(split(&values).threshold), bright(theirs), "theirs is {}", theirs);
        }
    }
}
