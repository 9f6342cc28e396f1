//! Who may control a car from afar: the car's certificate authority and the keys that it has granted, in a folder of the car.
//!
//! A key is a file for the other machine: a certificate with which tools connect, and a token with which a person logs in at the
//! dashboard. The car keeps no secret of it, only what it needs to recognise it. Whoever may write that folder may grant.

pub mod certificates;

use std::fmt::Write as _;
use std::fs;
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use carril_messages::key::check_name;
use carril_runtime::transport::zenoh::Identity;
use ring::digest::{SHA256, digest};
use ring::rand::{SecureRandom, SystemRandom};
use serde::{Deserialize, Serialize};

use certificates::{CertificateError, Pair};

/// Names the folder, for tests and for machines with several users.
pub const CONFIG_DIR_VARIABLE: &str = "CARRIL_CONFIG_DIR";

/// What can go wrong with grants.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AccessError {
    /// A file cannot be read or written.
    #[error("`{}`: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: io::Error,
    },
    /// A file is damaged.
    #[error("`{}` is damaged ({reason}); restore it, or remove the folder to begin anew: then all keys of the car are void", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The name is none.
    #[error(transparent)]
    Name(#[from] carril_messages::key::NameError),
    /// The name has a key.
    #[error("`{name}` has a key already; `carril revoke {name}` first, or choose another name")]
    Taken {
        /// The name.
        name: String,
    },
    /// The name has no key.
    #[error("`{name}` has no key; granted are: {granted}")]
    Unknown {
        /// The name.
        name: String,
        /// Those that have one.
        granted: String,
    },
    /// Making a certificate failed.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
    /// There is no randomness.
    #[error("the system gives no random numbers")]
    Random,
}

/// A key that was granted, as the car remembers it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Grant {
    /// Whose it is: `laptop-1`.
    pub name: String,
    /// The name in its certificate: `laptop-1-3f9a2c`. No two keys have the same, so that a revoked one stays void.
    pub id: String,
    /// When, s since 1970.
    pub granted_s: u64,
    /// When it was revoked, s since 1970.
    pub revoked_s: Option<u64>,
    /// It is no person's: with it the machine of that name runs its nodes of the graph, and does nothing else but look on.
    #[serde(default)]
    pub machine: Option<String>,
    /// SHA-256 of its token.
    token_sha256: String,
}

impl Grant {
    /// Whether it still counts.
    pub fn is_valid(&self) -> bool {
        self.revoked_s.is_none()
    }
}

/// The key itself: a file for another machine. Whoever has it controls the car, or runs nodes of its graph.
#[derive(Clone, Serialize, Deserialize)]
pub struct KeyFile {
    /// The car.
    pub robot: String,
    /// Whose it is.
    pub name: String,
    /// The name in the certificate.
    pub id: String,
    /// For the dashboard. Nothing: the key is a machine's, which has no business there.
    pub token: String,
    /// The machine in the graph that the key is for. `None`: it is a person's.
    #[serde(default)]
    pub machine: Option<String>,
    /// Certificate of the car's authority, PEM.
    pub authority: String,
    /// Certificate, PEM.
    pub certificate: String,
    /// Private key, PEM.
    pub private_key: String,
}

impl KeyFile {
    /// Reads a key file.
    pub fn read(path: &Path) -> Result<Self, AccessError> {
        let text = fs::read(path).map_err(|reason| AccessError::File { path: path.to_owned(), reason })?;
        let damaged = |error: serde_json::Error| AccessError::Damaged {
            path: path.to_owned(),
            reason: format!("no key of `carril grant`: {error}"),
        };
        serde_json::from_slice(&text).map_err(damaged)
    }

    /// Writes it so that only its owner can read it. Refuses to overwrite a file.
    pub fn write(&self, path: &Path) -> Result<(), AccessError> {
        let failed = |reason| AccessError::File { path: path.to_owned(), reason };
        let mut file = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(path).map_err(failed)?;
        let text = serde_json::to_vec_pretty(self).unwrap_or_default();
        file.write_all(&text).map_err(failed)
    }

    /// For the link to the car.
    pub fn identity(&self) -> Identity {
        Identity {
            authority: self.authority.clone(),
            certificate: self.certificate.clone(),
            key: self.private_key.clone(),
        }
    }
}

/// Grants of a car, on the car.
pub struct Access {
    robot: String,
    dir: PathBuf,
    authority: Pair,
    grants: Vec<Grant>,
}

/// Folder in which carril keeps what outlives a run: `$CARRIL_CONFIG_DIR`, else `$XDG_CONFIG_HOME/carril`, else `~/.config/carril`.
pub fn config_dir() -> PathBuf {
    if let Some(dir) = std::env::var_os(CONFIG_DIR_VARIABLE) {
        return PathBuf::from(dir);
    }
    let config = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from);
    let home = || PathBuf::from(std::env::var_os("HOME").unwrap_or_else(|| "/root".into())).join(".config");
    config.unwrap_or_else(home).join("carril")
}

const GRANTS: &str = "grants.json";
const AUTHORITY: &str = "authority.json";

impl Access {
    /// Reads what is there; makes folder and authority where there are none.
    pub fn open(config_dir: &Path, robot: &str) -> Result<Self, AccessError> {
        let dir = config_dir.join("access").join(robot);
        let failed = |reason| AccessError::File { path: dir.clone(), reason };
        fs::DirBuilder::new().recursive(true).mode(0o700).create(&dir).map_err(failed)?;
        let authority = if let Some(made_before) = read_json::<Pair>(&dir.join(AUTHORITY))? {
            made_before
        } else {
            let made = certificates::make_authority(robot)?;
            write_json(&dir.join(AUTHORITY), &made)?;
            made
        };
        let grants = read_json(&dir.join(GRANTS))?.unwrap_or_default();
        Ok(Self { robot: robot.to_owned(), dir, authority, grants })
    }

    /// The car.
    pub fn robot(&self) -> &str {
        &self.robot
    }

    /// The file that changes whenever a key is granted or revoked.
    pub fn grants_file(&self) -> PathBuf {
        self.dir.join(GRANTS)
    }

    /// Every key, revoked ones too, the oldest first.
    pub fn grants(&self) -> &[Grant] {
        &self.grants
    }

    /// The key with that name in its certificate.
    pub fn by_id(&self, id: &str) -> Option<&Grant> {
        self.grants.iter().find(|grant| grant.id == id)
    }

    /// The valid key of a person whose token this is.
    pub fn by_token(&self, name: &str, token: &str) -> Option<&Grant> {
        let hash = hash(token);
        let mut people = self.grants.iter().filter(|grant| grant.is_valid() && grant.machine.is_none());
        people.find(|grant| grant.name == name && grant.token_sha256 == hash)
    }

    /// Grants a key to control the car.
    pub fn grant(&mut self, name: &str) -> Result<KeyFile, AccessError> {
        self.grant_for(name, None)
    }

    /// Grants a key to run the nodes that the graph places on a machine.
    pub fn grant_machine(&mut self, machine: &str) -> Result<KeyFile, AccessError> {
        self.grant_for(machine, Some(machine))
    }

    fn grant_for(&mut self, name: &str, machine: Option<&str>) -> Result<KeyFile, AccessError> {
        check_name(name)?;
        if self.grants.iter().any(|grant| grant.name == name && grant.is_valid()) {
            return Err(AccessError::Taken { name: name.to_owned() });
        }
        let id = format!("{name}-{}", random_hex::<3>()?);
        let token = random_hex::<16>()?;
        let pair = certificates::sign_client(&self.authority, &self.robot, &id)?;
        self.grants.push(Grant {
            name: name.to_owned(),
            id: id.clone(),
            granted_s: now_s(),
            revoked_s: None,
            machine: machine.map(str::to_owned),
            token_sha256: hash(&token),
        });
        self.save()?;
        Ok(KeyFile {
            robot: self.robot.clone(),
            name: name.to_owned(),
            id,
            token: if machine.is_some() { String::new() } else { token },
            machine: machine.map(str::to_owned),
            authority: self.authority.certificate.clone(),
            certificate: pair.certificate,
            private_key: pair.key,
        })
    }

    /// Makes a key void.
    pub fn revoke(&mut self, name: &str) -> Result<(), AccessError> {
        let found = self.grants.iter_mut().find(|grant| grant.name == name && grant.is_valid());
        let Some(grant) = found else {
            let valid = self.grants.iter().filter(|grant| grant.is_valid());
            let granted = valid.map(|grant| grant.name.as_str()).collect::<Vec<_>>().join(", ");
            let granted = if granted.is_empty() { "none".to_owned() } else { granted };
            return Err(AccessError::Unknown { name: name.to_owned(), granted });
        };
        grant.revoked_s = Some(now_s());
        self.save()
    }

    /// A certificate for the car with all its names and addresses.
    pub fn server_identity(
        &self,
        names: &[String],
        addresses: &[std::net::IpAddr],
    ) -> Result<(Identity, String), AccessError> {
        let pair = certificates::sign_server(&self.authority, &self.robot, names, addresses)?;
        let identity =
            Identity { authority: self.authority.certificate.clone(), certificate: pair.certificate, key: pair.key };
        Ok((identity, pair.fingerprint))
    }

    fn save(&self) -> Result<(), AccessError> {
        write_json(&self.grants_file(), &self.grants)
    }
}

fn now_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

fn hash(token: &str) -> String {
    hex(digest(&SHA256, token.as_bytes()).as_ref())
}

/// Two digits a byte.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        // Writing to a text cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// A random text of `2 * N` digits.
pub(crate) fn random_hex<const N: usize>() -> Result<String, AccessError> {
    let mut bytes = [0; N];
    SystemRandom::new().fill(&mut bytes).map_err(|_| AccessError::Random)?;
    Ok(hex(&bytes))
}

fn read_json<T: for<'de> Deserialize<'de>>(path: &Path) -> Result<Option<T>, AccessError> {
    match fs::read(path) {
        Ok(text) => serde_json::from_slice(&text)
            .map(Some)
            .map_err(|error| AccessError::Damaged { path: path.to_owned(), reason: error.to_string() }),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(reason) => Err(AccessError::File { path: path.to_owned(), reason }),
    }
}

fn write_json(path: &Path, value: &impl Serialize) -> Result<(), AccessError> {
    write_private(path, &serde_json::to_vec_pretty(value).unwrap_or_default())
}

/// Writes a file, and its folder where there is none, for its owner alone. In one go: whoever reads it sees the old or the new one.
pub fn write_private(path: &Path, bytes: &[u8]) -> Result<(), AccessError> {
    let failed = |reason| AccessError::File { path: path.to_owned(), reason };
    let dir = path.parent().unwrap_or(Path::new("."));
    fs::DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(failed)?;
    let new = path.with_extension(format!("new-{}", std::process::id()));
    let mut file =
        fs::OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(&new).map_err(failed)?;
    file.write_all(bytes).map_err(failed)?;
    file.sync_all().map_err(failed)?;
    fs::rename(&new, path).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_counts_until_it_is_revoked_and_its_name_is_free_again() {
        let dir = tempfile::tempdir().expect("a folder");
        let mut access = Access::open(dir.path(), "car1").expect("an empty folder");
        let key = access.grant("laptop-1").expect("granted");
        assert!(matches!(access.grant("laptop-1"), Err(AccessError::Taken { .. })), "one key a name");
        assert_eq!(access.by_token("laptop-1", &key.token).map(|grant| &grant.id), Some(&key.id), "its token");
        assert!(access.by_token("laptop-1", "guess").is_none(), "another token");
        access.revoke("laptop-1").expect("revoked");
        assert!(access.by_token("laptop-1", &key.token).is_none(), "void");
        let second = access.grant("laptop-1").expect("granted again");
        assert_ne!(second.id, key.id, "the old certificate stays void");
        let again = Access::open(dir.path(), "car1").expect("the same folder");
        assert_eq!(again.grants(), access.grants(), "it outlives the process");
        assert!(!again.by_id(&key.id).expect("it is remembered").is_valid(), "the first is void for good");
        let error = access.revoke("laptop-2").expect_err("never granted").to_string();
        assert!(error.contains("granted are: laptop-1"), "{error}");
    }

    #[test]
    fn files_are_for_their_owner_alone_and_damage_is_named() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().expect("a folder");
        let mut access = Access::open(dir.path(), "car1").expect("an empty folder");
        let key = access.grant("laptop-1").expect("granted");
        let path = dir.path().join("key.json");
        key.write(&path).expect("written");
        assert!(matches!(key.write(&path), Err(AccessError::File { .. })), "nothing is overwritten");
        for file in [path.clone(), access.grants_file(), access.grants_file().with_file_name(AUTHORITY)] {
            let mode = fs::metadata(&file).expect("it is there").permissions().mode();
            assert_eq!(mode & 0o077, 0, "`{}`: others see nothing", file.display());
        }
        assert_eq!(KeyFile::read(&path).expect("it can be read").id, key.id, "round trip");
        fs::write(&path, "{").expect("writable");
        assert!(KeyFile::read(&path).err().expect("damaged").to_string().contains("carril grant"), "says what it is");
        fs::write(access.grants_file(), "[{]").expect("writable");
        let error = Access::open(dir.path(), "car1").err().expect("damaged").to_string();
        assert!(error.contains("grants.json") && error.contains("damaged"), "{error}");
    }

    #[test]
    fn odd_names_are_refused() {
        let dir = tempfile::tempdir().expect("a folder");
        let mut access = Access::open(dir.path(), "car1").expect("an empty folder");
        for name in ["", "*", "a/b", "**", "a b", &"x".repeat(60)] {
            assert!(matches!(access.grant(name), Err(AccessError::Name(_))), "`{name}`");
        }
    }
}
