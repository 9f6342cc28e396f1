//! What a value of a drive is drawn from. A draw is a hash of the drive's seed and of what it is for, never of how many draws came
//! before: a variation that is taken away leaves all others as they were.

use std::fmt;

use serde::de::value::MapAccessDeserializer;
use serde::de::{self, Deserialize, Deserializer, MapAccess, Visitor};
use serde::{Deserialize as DeriveDeserialize, Serialize};
use serde_json::Value;
use xxhash_rust::xxh3::xxh3_64_with_seed;

/// So often a normal number is drawn again that lies outside of its limits; then it is the nearer limit.
const MAX_REDRAWS: u32 = 64;

/// What a value is drawn from, as it is written: `{ uniform: [0, 6] }`.
#[derive(Clone, Debug, PartialEq, DeriveDeserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Distribution {
    /// Any number from the first to the second, all alike.
    Uniform([f64; 2]),
    /// A whole number from the first to the second, both included, all alike.
    Integer([i64; 2]),
    /// Numbers around a mean.
    Normal(Normal),
    /// One of these values, all alike.
    OneOf(Vec<Value>),
    /// The track `random:SEED` with a seed of this range, like `1..1000`, both included.
    Random(String),
    /// The track `random-road:SEED` with a seed of this range, like `1..1000`, both included.
    RandomRoad(String),
}

/// Normally distributed numbers within limits.
#[derive(Clone, Debug, PartialEq, DeriveDeserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Normal {
    /// The mean.
    pub mean: f64,
    /// The standard deviation, 0 or more.
    pub sd: f64,
    /// Nothing less is drawn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min: Option<f64>,
    /// Nothing more is drawn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max: Option<f64>,
}

/// A number, or what it is drawn from.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Amount {
    /// The same in every drive.
    Fixed(f64),
    /// Another one in each.
    Drawn(Distribution),
}

/// Seed of drive number `index`, from 0, of a series with the seed `base`: 32 bits, so that people can type it.
pub fn run_seed(base: u64, index: u64) -> u64 {
    xxh3_64_with_seed(&index.to_le_bytes(), base) >> 32
}

/// A number in [0, 1) for one purpose.
fn unit(seed: u64, purpose: &str, draw: u32) -> f64 {
    let mut text = purpose.as_bytes().to_vec();
    text.extend(draw.to_le_bytes());
    (xxh3_64_with_seed(&text, seed) >> 11) as f64 / (1_u64 << 53) as f64
}

/// Six digits: what is drawn can be read, written into a file, and read again.
fn six_digits(number: f64) -> f64 {
    format!("{number:.5e}").parse().unwrap_or(number)
}

impl Distribution {
    /// The value for the drive with this seed. `purpose`: what it is for, `world.camera.noise_grey`.
    pub fn draw(&self, seed: u64, purpose: &str) -> Value {
        match self {
            Self::Uniform([from, to]) => {
                let number = from + (to - from) * unit(seed, purpose, 0);
                six_digits(number).clamp(*from, *to).into()
            }
            Self::Integer([from, to]) => draw_whole(*from, *to, seed, purpose).into(),
            Self::Normal(normal) => normal.draw(seed, purpose).into(),
            Self::OneOf(values) => {
                let index = (unit(seed, purpose, 0) * values.len() as f64) as usize;
                values.get(index).cloned().unwrap_or_default()
            }
            Self::Random(range) => Value::String(format!("random:{}", draw_seed(range, seed, purpose))),
            Self::RandomRoad(range) => Value::String(format!("random-road:{}", draw_seed(range, seed, purpose))),
        }
    }

    /// Values at the ends of what can be drawn: if these are allowed, all are.
    pub fn extremes(&self) -> Vec<Value> {
        match self {
            Self::Uniform(ends) => ends.map(Value::from).to_vec(),
            Self::Integer(ends) => ends.map(Value::from).to_vec(),
            Self::Normal(normal) => {
                [Some(normal.mean), normal.min, normal.max].into_iter().flatten().map(Value::from).collect()
            }
            Self::OneOf(values) => values.clone(),
            Self::Random(range) => vec![Value::String(format!("random:{}", ends(range).map_or(1, |ends| ends.0)))],
            Self::RandomRoad(range) => {
                vec![Value::String(format!("random-road:{}", ends(range).map_or(1, |ends| ends.0)))]
            }
        }
    }

    /// What is wrong with it. `None`: nothing.
    pub fn problem(&self) -> Option<String> {
        match self {
            Self::Uniform([from, to]) => (from > to).then(|| format!("got [{from}, {to}], expected [least, most]")),
            Self::Integer([from, to]) => (from > to).then(|| format!("got [{from}, {to}], expected [least, most]")),
            Self::Normal(normal) => normal.problem(),
            Self::OneOf(values) => values.is_empty().then(|| "got an empty list, expected at least one value".into()),
            Self::Random(range) | Self::RandomRoad(range) => ends(range)
                .is_none()
                .then(|| format!("got `{range}`, expected a range of seeds like `1..1000`, both included")),
        }
    }
}

impl Normal {
    fn draw(&self, seed: u64, purpose: &str) -> f64 {
        let (min, max) = (self.min.unwrap_or(f64::NEG_INFINITY), self.max.unwrap_or(f64::INFINITY));
        let number = |draw: u32| {
            // Box-Muller. `1 - u` keeps the logarithm finite.
            let (u, v) = (unit(seed, purpose, 2 * draw), unit(seed, purpose, 2 * draw + 1));
            self.mean + self.sd * (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
        };
        let within = (0..MAX_REDRAWS).map(number).find(|number| (min..=max).contains(number));
        six_digits(within.unwrap_or_else(|| number(0))).clamp(min, max)
    }

    fn problem(&self) -> Option<String> {
        if self.sd < 0.0 {
            return Some(format!("`sd` is {}, allowed is 0 or more", self.sd));
        }
        let (min, max) = (self.min.unwrap_or(f64::NEG_INFINITY), self.max.unwrap_or(f64::INFINITY));
        let within = min <= self.mean && self.mean <= max;
        (!within).then(|| format!("the mean {} does not lie between `min` and `max`", self.mean))
    }
}

fn draw_whole(from: i64, to: i64, seed: u64, purpose: &str) -> i64 {
    let count = to.abs_diff(from) as f64 + 1.0;
    from.saturating_add_unsigned((unit(seed, purpose, 0) * count) as u64).min(to)
}

/// The ends of `1..1000`.
fn ends(range: &str) -> Option<(i64, i64)> {
    let (from, to) = range.split_once("..")?;
    let (from, to): (i64, i64) = (from.trim().parse().ok()?, to.trim().parse().ok()?);
    (0 <= from && from <= to).then_some((from, to))
}

fn draw_seed(range: &str, seed: u64, purpose: &str) -> i64 {
    let (from, to) = ends(range).unwrap_or((1, 1));
    draw_whole(from, to, seed, purpose)
}

impl Amount {
    /// The number for the drive with this seed.
    pub fn draw(&self, seed: u64, purpose: &str) -> f64 {
        match self {
            Self::Fixed(number) => *number,
            Self::Drawn(distribution) => distribution.draw(seed, purpose).as_f64().unwrap_or_default(),
        }
    }

    /// Whether it differs from drive to drive.
    pub fn varies(&self) -> bool {
        matches!(self, Self::Drawn(_))
    }

    /// What is wrong with it, as a number from `min` to `max`. `None`: nothing.
    pub fn problem(&self, min: f64, max: f64, unit: &str) -> Option<String> {
        let numbers = match self {
            Self::Fixed(number) => vec![Value::from(*number)],
            Self::Drawn(distribution) => match distribution.problem() {
                Some(problem) => return Some(problem),
                None => distribution.extremes(),
            },
        };
        numbers.iter().find_map(|value| match value.as_f64() {
            None => Some(format!("got {value}, expected a number")),
            Some(number) if !(min..=max).contains(&number) => {
                Some(format!("got {number}, allowed is {min} to {max} {unit}"))
            }
            Some(_) => None,
        })
    }
}

impl<'de> Deserialize<'de> for Amount {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AmountVisitor)
    }
}

struct AmountVisitor;

impl<'de> Visitor<'de> for AmountVisitor {
    type Value = Amount;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, or a distribution like `{ uniform: [0, 1] }`")
    }

    fn visit_f64<E: de::Error>(self, number: f64) -> Result<Amount, E> {
        Ok(Amount::Fixed(number))
    }

    fn visit_i64<E: de::Error>(self, number: i64) -> Result<Amount, E> {
        Ok(Amount::Fixed(number as f64))
    }

    fn visit_u64<E: de::Error>(self, number: u64) -> Result<Amount, E> {
        Ok(Amount::Fixed(number as f64))
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Amount, A::Error> {
        Distribution::deserialize(MapAccessDeserializer::new(map)).map(Amount::Drawn)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn read(value: Value) -> Distribution {
        serde_json::from_value(value).expect("a distribution")
    }

    fn numbers(distribution: &Distribution) -> Vec<f64> {
        (0..4000).map(|seed| distribution.draw(seed, "a.b").as_f64().expect("a number")).collect()
    }

    #[test]
    fn a_draw_depends_on_seed_and_purpose_only() {
        let uniform = read(json!({ "uniform": [0, 6] }));
        assert_eq!(uniform.draw(7, "a.b"), uniform.draw(7, "a.b"), "same seed, same purpose");
        assert_ne!(uniform.draw(7, "a.b"), uniform.draw(8, "a.b"), "another seed");
        assert_ne!(uniform.draw(7, "a.b"), uniform.draw(7, "a.c"), "another purpose");
    }

    #[test]
    fn numbers_fill_their_range() {
        let drawn = numbers(&read(json!({ "uniform": [-1, 3] })));
        let mean = drawn.iter().sum::<f64>() / drawn.len() as f64;
        assert!((mean - 1.0).abs() < 0.06, "the mean of -1 to 3 is 1, got {mean}");
        assert!(drawn.iter().all(|number| (-1.0..=3.0).contains(number)), "within the range");
        let whole = numbers(&read(json!({ "integer": [2, 4] })));
        assert!([2.0, 3.0, 4.0].iter().all(|number| whole.contains(number)), "both ends come up");
        assert!(whole.iter().all(|number| (2.0..=4.0).contains(number)), "nothing else");
    }

    #[test]
    fn normal_numbers_have_their_spread_and_keep_their_limits() {
        let drawn = numbers(&read(json!({ "normal": { "mean": 1, "sd": 0.5 } })));
        let mean = drawn.iter().sum::<f64>() / drawn.len() as f64;
        let variance = drawn.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / drawn.len() as f64;
        assert!((mean - 1.0).abs() < 0.03 && (variance.sqrt() - 0.5).abs() < 0.03, "mean {mean}, variance {variance}");
        let cut = numbers(&read(json!({ "normal": { "mean": 1, "sd": 5, "min": 0, "max": 1.5 } })));
        assert!(cut.iter().all(|number| (0.0..=1.5).contains(number)), "within the limits");
    }

    #[test]
    fn tracks_and_choices_come_up() {
        let roads = read(json!({ "random-road": "5..6" }));
        let drawn: Vec<Value> = (0..50).map(|seed| roads.draw(seed, "world.track")).collect();
        assert!(drawn.contains(&json!("random-road:5")) && drawn.contains(&json!("random-road:6")), "{drawn:?}");
        let choice = read(json!({ "one-of": ["a", [1, 2]] }));
        let drawn: Vec<Value> = (0..50).map(|seed| choice.draw(seed, "x.y")).collect();
        assert!(drawn.contains(&json!("a")) && drawn.contains(&json!([1, 2])), "{drawn:?}");
    }

    #[test]
    fn says_what_is_wrong() {
        let why = |value| read(value).problem().expect("it is wrong");
        assert_eq!(why(json!({ "uniform": [3, 1] })), "got [3, 1], expected [least, most]", "turned round");
        assert!(why(json!({ "normal": { "mean": 1, "sd": -1 } })).contains("0 or more"), "a negative spread");
        assert!(why(json!({ "normal": { "mean": 1, "sd": 1, "min": 2 } })).contains("does not lie"), "mean outside");
        assert!(why(json!({ "one-of": [] })).contains("empty list"), "nothing to choose from");
        for range in ["", "7", "9..3", "a..b", "-4..3"] {
            assert!(why(json!({ "random-road": range })).contains("like `1..1000`"), "{range}");
        }
    }

    #[test]
    fn seeds_of_a_series_differ() {
        let seeds: std::collections::HashSet<u64> = (0..1000).map(|index| run_seed(1, index)).collect();
        assert!(seeds.len() >= 999, "hardly two alike, got {}", seeds.len());
        assert_ne!(run_seed(1, 0), run_seed(2, 0), "another series");
    }
}
