//! How a command reaches the running graph that is meant: on this machine; where `--connect` says; where it was reached before; or
//! whoever answers in the network.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, bail};
use carril_dashboard::access::KeyFile;
use carril_runtime::client::{Client, ClientError};
use carril_runtime::graph::remote::GATEWAY_PORT;
use carril_runtime::transport::zenoh::{FarOptions, Found, scout};
use clap::Args;

use super::profiles::{self, Profile, Profiles};

/// Where to connect, as `--connect` says it.
pub const CONNECT_VARIABLE: &str = "CARRIL_CONNECT";
/// Network interface on which cars are looked for, `auto` or `off`.
pub const SCOUTING_VARIABLE: &str = "CARRIL_SCOUTING";
/// A link comes up within this time, if at all.
const PATIENCE: Duration = Duration::from_secs(3);
/// Cars answer within this time.
const SCOUTING: Duration = Duration::from_secs(1);

/// Which running graph.
#[derive(Args, Clone, Debug, Default)]
pub struct Target {
    /// Which robot, where several graphs run
    #[arg(long, value_name = "NAME")]
    pub robot: Option<String>,
    /// A car on another machine, `car.local` or `tcp/192.168.1.5:7447`; remembered for the next time
    #[arg(long, value_name = "HOST[:PORT]")]
    pub connect: Option<String>,
    /// The key that `carril grant` wrote on the car; remembered for the next time
    #[arg(long, value_name = "FILE")]
    pub key: Option<PathBuf>,
}

impl Target {
    /// That of a robot, wherever it runs.
    pub fn of(robot: Option<&str>) -> Self {
        Self { robot: robot.map(str::to_owned), ..Self::default() }
    }

    /// The same, of that robot.
    pub fn for_robot(mut self, robot: &str) -> Self {
        self.robot = Some(robot.to_owned());
        self
    }

    /// Where `--connect` or the environment sends it.
    pub fn endpoint(&self) -> Result<Option<String>> {
        let named =
            self.connect.clone().or_else(|| std::env::var(CONNECT_VARIABLE).ok().filter(|text| !text.is_empty()));
        named.as_deref().map(endpoint).transpose()
    }
}

/// An endpoint as people write it: `car.local`, `car.local:7447`, `tcp/car.local:7447`, `[fe80::1]:7447`.
pub fn endpoint(text: &str) -> Result<String> {
    let address = text.strip_prefix("tcp/").or_else(|| text.strip_prefix("tls/")).unwrap_or(text);
    let (host, port) = match address.rsplit_once(':') {
        Some((host, port)) if !host.contains(':') || host.ends_with(']') => match port.parse::<u16>() {
            Ok(port) => (host, port),
            Err(_) => bail!("--connect: got port `{port}` in `{text}`, allowed is 1 to 65535"),
        },
        _ => (address, GATEWAY_PORT),
    };
    let valid = |c: char| c.is_ascii_alphanumeric() || "-._:[]%".contains(c);
    if host.is_empty() || !host.chars().all(valid) {
        bail!(
            "--connect: got `{text}`, allowed is a name or address with or without a port: `car.local`, `tcp/192.168.1.5:7447`"
        );
    }
    let bracketed = host.contains(':') && !host.starts_with('[');
    let host = if bracketed { format!("[{host}]") } else { host.to_owned() };
    // With a key, tools connect to the next port: that is worked out later, from this.
    let port = if text.starts_with("tls/") { port.saturating_sub(1) } else { port };
    Ok(format!("tcp/{host}:{port}"))
}

/// Where holders of a key connect to a car whose readers connect to `endpoint`.
pub fn with_key(endpoint: &str) -> String {
    let address = endpoint.trim_start_matches("tcp/");
    match address.rsplit_once(':').map(|(host, port)| (host, port.parse::<u16>())) {
        Some((host, Ok(port))) => format!("tls/{host}:{}", port.saturating_add(1)),
        _ => endpoint.to_owned(),
    }
}

/// Connects to the running graph that is meant.
pub fn connect(target: &Target) -> Result<Client> {
    if let Some(endpoint) = target.endpoint()? {
        let key = match &target.key {
            Some(path) => Some(KeyFile::read(path)?),
            None => key_for(target, &endpoint),
        };
        return far(target, &endpoint, key.as_ref());
    }
    let near = match Client::connect(target.robot.as_deref()) {
        Ok(client) => return Ok(client),
        Err(error @ (ClientError::NoRun { .. } | ClientError::OtherRuns { .. } | ClientError::Stale { .. })) => error,
        Err(error) => return Err(error.into()),
    };
    if let Some((profile, key)) = remembered(target)? {
        return far(target, &profile.endpoint, key.as_ref());
    }
    match look_around()? {
        found if found.is_empty() => Err(near.into()),
        found => {
            let key = target.key.as_deref().map(KeyFile::read).transpose()?;
            scouted(target, &found, key.as_ref(), near)
        }
    }
}

/// The way of a machine that runs nodes of a car's graph to that car.
pub struct MachineWay {
    robot: String,
    key: KeyFile,
    /// Where readers connect. `None`: it is looked for.
    endpoint: Option<String>,
}

impl MachineWay {
    /// With the key that is named, else with that which was named before; to where `target` or the environment says, else to where the
    /// car was reached before.
    pub fn find(robot: &str, machine: &str, target: &Target) -> Result<Self> {
        let path = target.key.clone().unwrap_or_else(|| profiles::machine_key(robot, machine));
        if target.key.is_none() && !path.exists() {
            bail!(
                "machine `{machine}` needs a key for robot `{robot}`: on the car `carril grant --machine {machine}`, then here \
                 `--key FILE` with the file that it wrote"
            );
        }
        let key = KeyFile::read(&path)?;
        if key.robot != robot || key.machine.as_deref() != Some(machine) {
            let whose = match &key.machine {
                Some(other) => format!("of machine `{other}` for robot `{}`", key.robot),
                None => format!("of `{}` to control robot `{}`", key.name, key.robot),
            };
            bail!(
                "`{}` is the key {whose}, needed is that of machine `{machine}` for robot `{robot}`: on the car `carril grant \
                 --machine {machine}`",
                path.display()
            );
        }
        if target.key.is_some() {
            profiles::remember_machine(&key, machine)?;
        }
        let known = || Profiles::read().of(robot).map(|profile| profile.endpoint.clone());
        let endpoint = target.endpoint()?.or_else(known);
        Ok(Self { robot: robot.to_owned(), key, endpoint })
    }

    /// Connects to the car.
    pub fn connect(&self) -> Result<Client> {
        if let Some(endpoint) = &self.endpoint {
            return self.to(endpoint);
        }
        let mut last = None;
        for car in &look_around()? {
            for endpoint in reader_endpoints(car) {
                match self.to(endpoint) {
                    Ok(client) => return Ok(client),
                    Err(error) => last = Some(error),
                }
            }
        }
        Err(last.unwrap_or_else(|| anyhow::anyhow!("no car answers in this network; name it with --connect HOST")))
    }

    fn to(&self, endpoint: &str) -> Result<Client> {
        let identity = Some(self.key.identity());
        let options = FarOptions { endpoint: with_key(endpoint), identity };
        let client = Client::open_far(&options, Some(&self.key.id), Some(&self.robot), PATIENCE)?;
        profiles::remember(&self.robot, endpoint, None)?;
        Ok(client)
    }
}

/// The key that is kept for a car that was reached there before.
pub fn key_for(target: &Target, endpoint: &str) -> Option<KeyFile> {
    let profiles = Profiles::read();
    let known = match &target.robot {
        Some(robot) => profiles.of(robot),
        None => profiles.iter().map(|(_, profile)| profile).find(|profile| profile.endpoint == endpoint),
    };
    read_key(known?)
}

fn read_key(profile: &Profile) -> Option<KeyFile> {
    let path = profile.key.as_ref()?;
    KeyFile::read(path).inspect_err(|error| eprintln!("warning: connecting without the key: {error}")).ok()
}

/// The car that was reached before, and its key.
fn remembered(target: &Target) -> Result<Option<(Profile, Option<KeyFile>)>> {
    let key = target.key.as_deref().map(KeyFile::read).transpose()?;
    let profiles = Profiles::read();
    let robot = target.robot.clone().or_else(|| key.as_ref().map(|key| key.robot.clone()));
    let profile = if let Some(robot) = robot {
        profiles.of(&robot).cloned()
    } else {
        let all: Vec<_> = profiles.iter().collect();
        if all.len() > 1 {
            let robots = all.iter().map(|(robot, _)| *robot).collect::<Vec<_>>().join(", ");
            bail!("no graph runs on this machine, and several cars are known: {robots}; choose one with --robot");
        }
        all.first().map(|(_, profile)| (*profile).clone())
    };
    Ok(profile.map(|profile| {
        let key = key.or_else(|| read_key(&profile));
        (profile, key)
    }))
}

fn far(target: &Target, endpoint: &str, key: Option<&KeyFile>) -> Result<Client> {
    let robot = target.robot.as_deref();
    let identity = key.map(KeyFile::identity);
    let at = if key.is_some() { with_key(endpoint) } else { endpoint.to_owned() };
    let id = key.map(|key| key.id.as_str());
    let client = Client::open_far(&FarOptions { endpoint: at, identity }, id, robot, PATIENCE)?;
    profiles::remember(&client.file().robot, endpoint, key)?;
    Ok(client)
}

/// Who answers when cars are looked for.
pub fn look_around() -> Result<Vec<Found>> {
    let interface = std::env::var(SCOUTING_VARIABLE).unwrap_or_else(|_| "auto".into());
    if interface == "off" {
        return Ok(Vec::new());
    }
    Ok(scout(&interface, SCOUTING)?)
}

/// Its endpoints for readers, those on other machines first.
pub fn reader_endpoints(found: &Found) -> Vec<&str> {
    let mut endpoints: Vec<&str> =
        found.endpoints.iter().map(String::as_str).filter(|endpoint| endpoint.starts_with("tcp/")).collect();
    endpoints.sort_by_key(|endpoint| {
        endpoint.contains("/127.") || endpoint.contains("/[::1]") || endpoint.contains("/[fe80")
    });
    endpoints
}

fn scouted(target: &Target, found: &[Found], key: Option<&KeyFile>, otherwise: ClientError) -> Result<Client> {
    let mut clients = Vec::new();
    for car in found {
        let reached = reader_endpoints(car).into_iter().find_map(|endpoint| far(target, endpoint, key).ok());
        clients.extend(reached);
    }
    match clients.len() {
        0 => Err(otherwise.into()),
        1 => Ok(clients.remove(0)),
        _ => {
            let robots = clients.iter().map(|client| client.file().robot.as_str()).collect::<Vec<_>>().join(", ");
            bail!("several cars answer: {robots}; choose one with --robot")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_read_as_people_write_them() {
        let read = |text: &str| endpoint(text).map_err(|error| error.to_string());
        for (text, expected) in [
            ("car.local", "tcp/car.local:7447"),
            ("car.local:80", "tcp/car.local:80"),
            ("tcp/10.0.0.1:7447", "tcp/10.0.0.1:7447"),
            ("tls/10.0.0.1:7448", "tcp/10.0.0.1:7447"),
            ("::1", "tcp/[::1]:7447"),
            ("[::1]:7000", "tcp/[::1]:7000"),
        ] {
            assert_eq!(read(text), Ok(expected.to_owned()), "`{text}`");
        }
        for text in ["", "car:99999", "a b", "tcp/", "car:x"] {
            assert!(read(text).is_err_and(|error| error.contains("allowed")), "`{text}` is refused");
        }
        assert_eq!(with_key("tcp/car.local:7447"), "tls/car.local:7448", "the next port");
    }
}
