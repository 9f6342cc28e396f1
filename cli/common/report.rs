//! The summary at the end of a run, as text: facts with a name, then tables and remarks. The same for `run` and `sim`.

use std::fmt::{self, Display, Write};

use carril_messages::{Percentiles, TrackProgress};

use super::output;

/// A text that grows line by line.
#[derive(Default)]
pub struct Report(String);

impl Report {
    /// A line.
    pub fn line(&mut self, text: impl Display) {
        writeln!(self.0, "{text}").expect("a text can always grow");
    }

    /// A named fact: `laps         2, 29.9 m`.
    pub fn fact(&mut self, name: &str, value: impl Display) {
        self.line(format_args!("{name:<12} {value}"));
    }

    /// A table behind an empty line.
    pub fn table(&mut self, columns: &[&str], rows: &[Vec<String>]) {
        self.line("");
        self.0 += &output::table(columns, rows);
    }

    /// Text that brings its own line ends.
    pub fn text(&mut self, text: &str) {
        self.0 += text;
    }

    /// How the car did on its track.
    pub fn progress(&mut self, progress: &TrackProgress) {
        let lap = progress.last_lap_s.map(|seconds| format!(" (last in {seconds:.2} s)")).unwrap_or_default();
        self.fact("laps", format_args!("{}{lap}, {:.1} m", progress.laps, progress.distance_m));
        let (rms, max) = (progress.cross_track_rms_m, progress.cross_track_max_m);
        self.fact("cross-track", format_args!("rms {rms:.4} m, max {max:.4} m"));
        self.fact("departures", format_args!("{}, collisions {}", progress.departures, progress.collisions));
        if progress.red_runs > 0 || progress.stopped_before_line_m.is_some() {
            let stood = progress.stopped_before_line_m;
            let stood = stood.map(|ahead_m| format!(", last stood {ahead_m:.2} m before the stop line"));
            self.fact("lights", format_args!("passed at red {}{}", progress.red_runs, stood.unwrap_or_default()));
        }
    }

    /// How old exposures were at the wheel, ms.
    pub fn age(&mut self, path: Option<&str>, age: Option<Percentiles>) {
        if let (Some(path), Some(age)) = (path, age) {
            self.fact("age", format_args!("{path}: p50 {:.1}, p99 {:.1}, max {:.1} ms", age.p50, age.p99, age.max));
        }
    }
}

impl Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn facts_line_up() {
        let mut report = Report::default();
        report.progress(&TrackProgress {
            laps: 2,
            last_lap_s: Some(20.4),
            distance_m: 29.94,
            ..TrackProgress::default()
        });
        report.age(Some("world/camera to bridge"), None);
        let expected = "laps         2 (last in 20.40 s), 29.9 m\ncross-track  rms 0.0000 m, max 0.0000 m\n\
                        departures   0, collisions 0\n";
        assert_eq!(report.to_string(), expected, "no age, no line");
    }
}
