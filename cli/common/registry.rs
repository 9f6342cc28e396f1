//! The operators that this program brings along.

use carril_runtime::Registry;

/// Every kind that a graph file can name.
pub fn built_in() -> Registry {
    carril_operators::registry().and(carril_bridge::registry()).and(carril_simulator::registry())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn knows_the_operators_of_every_crate() {
        let registry = built_in();
        for kind in ["lane-detector", "mcu-link", "sim-world"] {
            assert!(registry.get(kind).is_some(), "`{kind}` is missing");
        }
    }
}
