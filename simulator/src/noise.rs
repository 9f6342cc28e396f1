//! Seeded randomness for the sensors: a hash of counters, and a table of Gaussian numbers read from seeded places.
//!
//! A draw depends on the seed and on what it is for (frame, row, scan), never on how many draws came before. So an output that
//! nobody reads can be left out without changing any other.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

/// Numbers in a [`GaussianTable`]; a power of two.
const TABLE_LEN: usize = 1 << 16;
/// The longest slice that can be read from a table.
pub const MAX_SLICE: usize = 1 << 14;

/// Mixes words into one, so that every bit of each moves about half of the bits of the result (splitmix64's finaliser).
pub fn mix(words: &[u64]) -> u64 {
    words.iter().fold(0x9E37_79B9_7F4A_7C15, |hash, word| {
        let mut mixed = (hash ^ word).wrapping_add(0x9E37_79B9_7F4A_7C15);
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    })
}

/// A generator for one purpose.
pub fn generator(words: &[u64]) -> Pcg32 {
    Pcg32::seed_from_u64(mix(words))
}

/// A number in [0, 1) for one purpose.
pub fn unit(words: &[u64]) -> f64 {
    (mix(words) >> 11) as f64 / (1_u64 << 53) as f64
}

/// Normally distributed numbers, made once. Slices of it, from places that a hash chooses, are noise at the price of a read.
#[derive(Clone, Debug)]
pub struct GaussianTable<T>(Vec<T>);

impl<T: Copy> GaussianTable<T> {
    /// A table of `convert(x)` for standard normal `x`.
    pub fn new(seed: u64, convert: impl Fn(f64) -> T) -> Self {
        let mut rng = generator(&[seed, 0x006E_6F69_7365]);
        let mut numbers: Vec<T> = Vec::with_capacity(TABLE_LEN + MAX_SLICE);
        while numbers.len() < TABLE_LEN {
            // Box-Muller: two uniform numbers make two normal ones. `1 - u` keeps the logarithm finite.
            let (u, v): (f64, f64) = (rng.random(), rng.random());
            let radius = (-2.0 * (1.0 - u).ln()).sqrt();
            let (sin, cos) = (std::f64::consts::TAU * v).sin_cos();
            numbers.extend([convert(radius * cos), convert(radius * sin)]);
        }
        numbers.extend_from_within(..MAX_SLICE);
        Self(numbers)
    }

    /// `len` numbers for one purpose; `len <= MAX_SLICE`.
    pub fn slice(&self, words: &[u64], len: usize) -> &[T] {
        let start = mix(words) as usize % TABLE_LEN;
        &self.0[start..start + len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_is_normal_and_seeded() {
        let table = GaussianTable::new(7, |x| x);
        let numbers = &table.0[..TABLE_LEN];
        let mean = numbers.iter().sum::<f64>() / TABLE_LEN as f64;
        let variance = numbers.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / TABLE_LEN as f64;
        assert!(mean.abs() < 0.02, "mean {mean}");
        assert!((variance - 1.0).abs() < 0.02, "variance {variance}");
        assert_eq!(table.slice(&[1, 2], 5), GaussianTable::new(7, |x| x).slice(&[1, 2], 5), "same seed, same numbers");
        assert_ne!(table.slice(&[1, 2], 5), GaussianTable::new(8, |x| x).slice(&[1, 2], 5), "another seed");
        assert_ne!(table.slice(&[1, 2], 5), table.slice(&[1, 3], 5), "another purpose");
    }

    #[test]
    fn every_slice_lies_in_the_table() {
        let table = GaussianTable::new(1, |x| x as f32);
        for purpose in 0..2_000 {
            assert_eq!(table.slice(&[purpose], MAX_SLICE).len(), MAX_SLICE, "purpose {purpose}");
        }
    }

    #[test]
    fn unit_numbers_fill_their_interval() {
        let numbers: Vec<f64> = (0..10_000).map(|n| unit(&[3, n])).collect();
        assert!(numbers.iter().all(|x| (0.0..1.0).contains(x)), "in [0, 1)");
        let below = numbers.iter().filter(|x| **x < 0.1).count();
        assert!((800..1200).contains(&below), "a tenth lies below 0.1, got {below} of 10000");
    }
}
