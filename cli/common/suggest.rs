//! "Did you mean": the known name that a mistyped one resembles.

/// Less alike than this, a suggestion confuses more than it helps. 0.7 finds swapped, missing and wrong letters.
const ALIKE: f64 = 0.7;

/// The name most like `got`, if any is alike enough.
pub fn closest<'a>(got: &str, names: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let scored = names.into_iter().map(|name| (likeness(got, name), name));
    let best = scored.max_by(|left, right| left.0.total_cmp(&right.0));
    best.filter(|(score, _)| *score >= ALIKE).map(|(_, name)| name)
}

fn likeness(got: &str, name: &str) -> f64 {
    strsim::normalized_damerau_levenshtein(got, name).max(strsim::jaro_winkler(got, name) - 0.15)
}

/// A second line for an error message: the name that was probably meant, else `otherwise`.
pub fn hint<'a>(got: &str, names: impl IntoIterator<Item = &'a str>, otherwise: &str) -> String {
    match closest(got, names) {
        Some(name) => format!("\nhint: did you mean `{name}`?"),
        None if otherwise.is_empty() => String::new(),
        None => format!("\nhint: {otherwise}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PORTS: [&str; 3] = ["world/camera", "world/scan", "lane/lane"];

    #[test]
    fn finds_a_mistyped_port() {
        assert_eq!(closest("world/camrea", PORTS), Some("world/camera"), "two letters swapped");
        assert_eq!(closest("lane/lan", PORTS), Some("lane/lane"), "one letter missing");
    }

    #[test]
    fn is_silent_when_nothing_is_alike() {
        assert_eq!(closest("gps/fix", PORTS), None, "a wild guess would confuse");
        assert_eq!(closest("lane", []), None, "no names at all");
    }
}
