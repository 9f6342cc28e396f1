//! Names that come from another program's description. Kinds and ports are known by `&'static str` everywhere; those of built-in
//! operators are literals, and these are kept as long as this program runs, each text once.

use std::collections::HashSet;
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Deserializer};

/// A name. An alias, because serde takes a field of the bare type for one that borrows from its input.
pub(crate) type Name = &'static str;

/// The text, for ever. At most as much is kept as programs have described ([`MAX_OUTPUT_BYTES`](crate::describe) each).
pub(crate) fn intern(text: &str) -> Name {
    static KNOWN: Mutex<Option<HashSet<Name>>> = Mutex::new(None);
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let known = known.get_or_insert_default();
    if let Some(name) = known.get(text) {
        return name;
    }
    let name: Name = Box::leak(text.to_owned().into_boxed_str());
    known.insert(name);
    name
}

/// For `#[serde(deserialize_with)]`.
pub(crate) fn name<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Name, D::Error> {
    Ok(intern(&String::deserialize(deserializer)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_kept_once() {
        let first = intern("some-port");
        assert!(std::ptr::eq(first, intern(&String::from("some-port"))), "the same memory");
        assert_ne!(first, intern("another-port"), "another text");
    }
}
