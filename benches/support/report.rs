//! Rows of results: a table for people, JSON for machines.

use serde::{Deserialize, Serialize};

/// One measured figure beside its yardstick from the same run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Row {
    /// What was measured.
    pub name: String,
    /// The figure.
    pub value: f64,
    /// Its unit.
    pub unit: String,
    /// The yardstick, in the same unit; `None` where there is none.
    pub baseline: Option<f64>,
    /// `value / baseline`.
    pub ratio: Option<f64>,
}

impl Row {
    /// A figure with its yardstick.
    pub fn against(name: impl Into<String>, value: f64, unit: &str, baseline: f64) -> Self {
        Self { name: name.into(), value, unit: unit.into(), baseline: Some(baseline), ratio: Some(value / baseline) }
    }

    /// A figure that stands alone.
    pub fn alone(name: impl Into<String>, value: f64, unit: &str) -> Self {
        Self { name: name.into(), value, unit: unit.into(), baseline: None, ratio: None }
    }
}

/// Prints the head of the table.
pub fn print_head() {
    println!("{:<68} {:>12} {:<8} {:>12} {:>7}", "name", "value", "unit", "baseline", "ratio");
}

/// Prints a row of the table.
pub fn print_row(row: &Row) {
    let number = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.2}"));
    let (value, baseline, ratio) = (number(Some(row.value)), number(row.baseline), number(row.ratio));
    println!("{:<68} {value:>12} {:<8} {baseline:>12} {ratio:>7}", row.name, row.unit);
}
