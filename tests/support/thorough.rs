//! How much a test does. `./dev test` must not keep people waiting; `./dev test --thorough`, as in CI, takes the whole count.
//! Test programs of every crate take this file in by its path.
#![allow(dead_code, reason = "each test program uses a part of it")]

/// `usual`; `thorough` when the environment has `CARRIL_THOROUGH=1`.
pub fn count<T>(usual: T, thorough: T) -> T {
    if is_thorough() { thorough } else { usual }
}

/// Whether the environment has `CARRIL_THOROUGH=1`.
pub fn is_thorough() -> bool {
    std::env::var_os("CARRIL_THOROUGH").is_some_and(|value| value == "1")
}
