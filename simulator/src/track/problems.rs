//! What is wrong with a track, place by place.

use std::fmt;

/// One thing wrong with a track.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Line and column in the file, from 1. `None`: the file as a whole.
    pub place: Option<(u32, u32)>,
    /// Which value, what we got, what is allowed.
    pub message: String,
    /// What to do, if there is more to say.
    pub hint: Option<String>,
}

/// Everything wrong with a track.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrackError {
    /// The track as configured.
    pub track: String,
    /// At least one.
    pub problems: Vec<Problem>,
}

impl TrackError {
    /// A problem of the track as a whole.
    pub fn whole(track: &str, message: String, hint: Option<&str>) -> Self {
        let problem = Problem { place: None, message, hint: hint.map(str::to_owned) };
        Self { track: track.to_owned(), problems: vec![problem] }
    }

    /// One problem at one place.
    pub fn at(track: &str, place: (u32, u32), message: String, hint: Option<&str>) -> Self {
        let problem = Problem { place: Some(place), message, hint: hint.map(str::to_owned) };
        Self { track: track.to_owned(), problems: vec![problem] }
    }

    /// One line for each problem, without the hints: `tracks/mine.yaml:7:13: ...`.
    pub fn lines(&self) -> impl Iterator<Item = (String, Option<&str>)> {
        self.problems.iter().map(|problem| {
            let place = problem.place.map_or_else(String::new, |(line, column)| format!(":{line}:{column}"));
            (format!("{}{place}: {}", self.track, problem.message), problem.hint.as_deref())
        })
    }
}

impl fmt::Display for TrackError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (line, hint)) in self.lines().enumerate() {
            let separator = if index > 0 { "\n" } else { "" };
            write!(f, "{separator}{line}")?;
            if let Some(hint) = hint {
                write!(f, "; {hint}")?;
            }
        }
        Ok(())
    }
}

impl std::error::Error for TrackError {}
