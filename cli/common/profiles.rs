//! Cars that were reached before, by robot: where, and with which key. So that `--connect` and `--key` are typed once.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use anyhow::Result;
use carril_dashboard::access::{KeyFile, config_dir, write_private};
use serde::{Deserialize, Serialize};

/// A car that was reached before.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Profile {
    /// Where readers connect: `tcp/car.local:7447`.
    pub endpoint: String,
    /// A copy of its key.
    pub key: Option<PathBuf>,
}

/// All of them.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Profiles {
    #[serde(flatten)]
    by_robot: BTreeMap<String, Profile>,
}

fn file() -> PathBuf {
    config_dir().join("profiles.json")
}

impl Profiles {
    /// Those that are kept. A damaged file counts as none, with a warning: it costs one `--connect`.
    pub fn read() -> Self {
        let Ok(text) = fs::read(file()) else { return Self::default() };
        serde_json::from_slice(&text).unwrap_or_else(|error| {
            eprintln!(
                "warning: `{}` is not readable ({error}); cars have to be named with --connect again",
                file().display()
            );
            Self::default()
        })
    }

    /// That of a robot.
    pub fn of(&self, robot: &str) -> Option<&Profile> {
        self.by_robot.get(robot)
    }

    /// All, by robot.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Profile)> {
        self.by_robot.iter().map(|(robot, profile)| (robot.as_str(), profile))
    }
}

/// Keeps where a car was reached; with a key, a copy of that. That of a machine is no key for people: see [`remember_machine`].
pub fn remember(robot: &str, endpoint: &str, key: Option<&KeyFile>) -> Result<()> {
    let key = key.filter(|key| key.machine.is_none());
    let mut profiles = Profiles::read();
    let before = profiles.of(robot).cloned();
    let key = match key {
        Some(key) => Some(keep_key(robot, key)?),
        None => before.as_ref().and_then(|profile| profile.key.clone()),
    };
    let profile = Profile { endpoint: endpoint.to_owned(), key };
    if before.as_ref() == Some(&profile) {
        return Ok(());
    }
    profiles.by_robot.insert(robot.to_owned(), profile);
    Ok(write_private(&file(), &serde_json::to_vec_pretty(&profiles)?)?)
}

/// Where the key of a machine is kept.
pub fn machine_key(robot: &str, machine: &str) -> PathBuf {
    config_dir().join("keys").join(format!("{robot}.machine-{machine}.json"))
}

/// Keeps a copy of the key of a machine.
pub fn remember_machine(key: &KeyFile, machine: &str) -> Result<()> {
    Ok(write_private(&machine_key(&key.robot, machine), &serde_json::to_vec_pretty(key)?)?)
}

fn keep_key(robot: &str, key: &KeyFile) -> Result<PathBuf> {
    let path = config_dir().join("keys").join(format!("{robot}.json"));
    write_private(&path, &serde_json::to_vec_pretty(key)?)?;
    Ok(path)
}
