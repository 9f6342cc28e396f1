//! How much a test does. `./dev test` must not keep people waiting; `./dev test --thorough`, as in CI, takes the whole count.
//! Test programs of every crate take this file in by its path.

/// `usual`; `thorough` when the environment has `CARRIL_THOROUGH=1`.
pub fn count<T>(usual: T, thorough: T) -> T {
    if std::env::var_os("CARRIL_THOROUGH").is_some_and(|value| value == "1") { thorough } else { usual }
}
