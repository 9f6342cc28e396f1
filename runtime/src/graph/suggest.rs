//! "Did you mean": the nearest of the names that exist.

/// The candidate that `got` was probably meant to be.
pub(crate) fn nearest<'a>(got: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let far = (got.chars().count() / 3).clamp(1, 4);
    let distance =
        |candidate: &str| strsim::damerau_levenshtein(&shorten(got).to_lowercase(), &shorten(candidate).to_lowercase());
    let scored = candidates.into_iter().map(|candidate| (distance(candidate), candidate));
    scored.filter(|(distance, _)| *distance <= far).min().map(|(_, candidate)| candidate)
}

/// A hint from the names that exist: the nearest, else all of them.
pub(crate) fn hint<'a>(got: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<String> {
    let candidates: Vec<&str> = candidates.into_iter().collect();
    if let Some(nearest) = nearest(got, candidates.iter().copied()) {
        return Some(format!("did you mean `{nearest}`?"));
    }
    list(candidates).map(|names| format!("there are {names}"))
}

/// `` `a`, `b`, `c` ``, cut after twelve.
pub(crate) fn list<'a>(names: impl IntoIterator<Item = &'a str>) -> Option<String> {
    let names: Vec<String> = names.into_iter().map(|name| format!("`{name}`")).collect();
    match names.len() {
        0 => None,
        1..=12 => Some(names.join(", ")),
        more => Some(format!("{} and {} more", names[..12].join(", "), more - 12)),
    }
}

/// A name as messages show it: a forged one of a megabyte must not fill the screen.
pub(crate) fn shorten(name: &str) -> &str {
    name.char_indices().nth(64).map_or(name, |(at, _)| &name[..at])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_a_slip_of_the_finger_but_no_stranger() {
        let names = ["lane/lane", "world/camera", "world/scan"];
        assert_eq!(nearest("lane/lnae", names), Some("lane/lane"), "swapped letters");
        assert_eq!(nearest("decision/command", names), None, "nothing is near");
        assert_eq!(
            hint("x", names).as_deref(),
            Some("there are `lane/lane`, `world/camera`, `world/scan`"),
            "then all"
        );
    }
}
