//! Key expressions: `carril/<robot>/<node>/<port>` for data, `carril/<robot>/@/...` for the control plane.

use std::fmt;

use thiserror::Error;

/// First chunk of every key.
pub const ROOT: &str = "carril";
/// Second chunk behind the robot for all that is not data. No node can have this name.
pub const CONTROL_PLANE: &str = "@";
/// No name is longer, B.
pub const MAX_NAME_BYTES: usize = 48;

/// Why a name cannot be a chunk of a key expression.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("`{name}` is no valid name: {reason}; allowed are 1 to 48 of a-z, 0-9, `-` and `_`, beginning with a letter")]
pub struct NameError {
    /// The name.
    pub name: String,
    /// What is wrong with it.
    pub reason: &'static str,
}

/// Checks the name of a robot, node, port or process.
pub fn check_name(name: &str) -> Result<(), NameError> {
    let fail = |reason| Err(NameError { name: name.chars().take(MAX_NAME_BYTES).collect(), reason });
    if name.is_empty() {
        return fail("it is empty");
    }
    if name.len() > MAX_NAME_BYTES {
        return fail("it is too long");
    }
    if !name.starts_with(|c: char| c.is_ascii_lowercase()) {
        return fail("it does not begin with a lower-case letter");
    }
    if name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '_') {
        Ok(())
    } else {
        fail("it has other characters")
    }
}

/// The key of one port.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Key {
    /// The robot.
    pub robot: String,
    /// The node.
    pub node: String,
    /// The port.
    pub port: String,
}

impl Key {
    /// The key of a port; names are checked where they enter, in the graph reader.
    pub fn new(robot: &str, node: &str, port: &str) -> Self {
        Self { robot: robot.into(), node: node.into(), port: port.into() }
    }

    /// Reads `carril/<robot>/<node>/<port>`; other keys, the control plane's among them, give `None`.
    pub fn parse(key: &str) -> Option<Self> {
        let mut chunks = key.split('/');
        let (root, robot, node, port) = (chunks.next()?, chunks.next()?, chunks.next()?, chunks.next()?);
        let valid =
            root == ROOT && chunks.next().is_none() && [robot, node, port].iter().all(|c| check_name(c).is_ok());
        valid.then(|| Self::new(robot, node, port))
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{ROOT}/{}/{}/{}", self.robot, self.node, self.port)
    }
}

/// A key of the control plane: `carril/<robot>/@/<path>`.
pub fn control_key(robot: &str, path: &str) -> String {
    format!("{ROOT}/{robot}/{CONTROL_PLANE}/{path}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trips_and_refuses_the_control_plane() {
        let key = Key::new("car1", "lane", "lane");
        assert_eq!(key.to_string(), "carril/car1/lane/lane", "display");
        assert_eq!(Key::parse(&key.to_string()), Some(key), "parse undoes display");
        assert_eq!(Key::parse(&control_key("car1", "health")), None, "no data key");
        assert_eq!(Key::parse("carril/car1/lane"), None, "too short");
        assert_eq!(Key::parse("carril/car1/lane/lane/x"), None, "too long");
    }

    #[test]
    fn refuses_names_that_zenoh_would_read_otherwise() {
        for name in ["", "*", "a/b", "a b", "A", "1a", "@", "a$", "ä", &"x".repeat(49)] {
            assert!(check_name(name).is_err(), "`{name}` must be refused");
        }
        assert!(check_name("lane-detector_2").is_ok(), "an ordinary name");
    }
}
