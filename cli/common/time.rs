//! Time on the command line: spans as people write them, and spans as people read them.

use std::time::Duration;

/// Reads `30s`, `2m`, `500ms` or `1h 30m`, for clap.
pub fn parse(text: &str) -> Result<Duration, String> {
    let allowed = "write a number and a unit, for example 500ms, 30s or 2m";
    match humantime::parse_duration(text) {
        Ok(duration) if duration > Duration::ZERO => Ok(duration),
        Ok(_) => Err(format!("the span must be longer than zero; {allowed}")),
        Err(_) => Err(allowed.to_owned()),
    }
}

/// Reads a span that may be zero; a plain number is in seconds. For clap.
pub fn parse_span(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| (0.0..=1e6).contains(seconds));
    match seconds {
        Some(seconds) => Ok(Duration::from_secs_f64(seconds)),
        None => humantime::parse_duration(text).map_err(|_| "write a span, for example 0, 300ms, 10 or 2m".to_owned()),
    }
}

/// Reads a rate in Hz, for clap.
pub fn parse_rate(text: &str) -> Result<f64, String> {
    let rate: f64 = text.parse().map_err(|_| "write a number of messages per second, for example 10".to_owned())?;
    if (0.001..=10_000.0).contains(&rate) { Ok(rate) } else { Err("allowed is 0.001 to 10000 Hz".to_owned()) }
}

/// A span in the unit that suits it: `850 µs`, `12.3 ms`, `4.2 s`, `3 min 20 s`, `2 h 5 min`.
pub fn span(seconds: f64) -> String {
    let magnitude = seconds.abs();
    if magnitude < 1e-3 {
        format!("{:.0} µs", seconds * 1e6)
    } else if magnitude < 1.0 {
        format!("{:.1} ms", seconds * 1e3)
    } else if magnitude < 120.0 {
        format!("{seconds:.1} s")
    } else if magnitude < 7200.0 {
        format!("{:.0} min {:.0} s", (seconds / 60.0).trunc(), (seconds % 60.0).trunc())
    } else {
        format!("{:.0} h {:.0} min", (seconds / 3600.0).trunc(), (seconds % 3600.0 / 60.0).trunc())
    }
}

/// Time since the start, as on a stop watch: `1:15`, `2:03:09`.
pub fn clock(seconds: f64) -> String {
    let seconds = seconds.max(0.0) as u64;
    let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
    if hours > 0 { format!("{hours}:{minutes:02}:{seconds:02}") } else { format!("{minutes}:{seconds:02}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_spans_with_a_unit_only() {
        assert_eq!(parse("30s"), Ok(Duration::from_secs(30)), "seconds");
        assert_eq!(parse("1m 30s"), Ok(Duration::from_secs(90)), "sum");
        assert_eq!(parse("500ms"), Ok(Duration::from_millis(500)), "milliseconds");
        for wrong in ["30", "", "-1s", "s", "0s", "1e9y", "NaN"] {
            assert!(parse(wrong).is_err(), "`{wrong}` is no span");
        }
    }

    #[test]
    fn a_rate_is_a_number_in_range() {
        assert_eq!(parse_rate("2.5"), Ok(2.5), "a number");
        for wrong in ["NaN", "inf", "0", "-1", "fast"] {
            assert!(parse_rate(wrong).is_err(), "`{wrong}` is no rate");
        }
    }

    #[test]
    fn spans_have_a_fitting_unit() {
        let texts = [0.000_85, 0.0123, 4.2, 200.0, 7500.0].map(span);
        assert_eq!([clock(75.9), clock(7389.0)], ["1:15", "2:03:09"], "stop watch");
        assert_eq!(texts, ["850 µs", "12.3 ms", "4.2 s", "3 min 20 s", "2 h 5 min"], "unit by unit");
    }
}
