//! What the graph file says of access from other machines: where the gateway, the dashboard and Foxglove listen, who may read, and how
//! much of it leaves the car.

use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

use super::raw::{RawAddress, RawRemote, RawWho};

/// Value of an address or of `scouting` that turns it off.
pub const OFF: &str = "off";
/// Port of the gateway for readers, as Zenoh's routers have it; holders of a key use the next one.
pub const GATEWAY_PORT: u16 = 7447;
/// Port of the dashboard.
pub const DASHBOARD_PORT: u16 = 8080;
/// Port of the Foxglove server, as Foxglove has it.
pub const FOXGLOVE_PORT: u16 = 8765;

/// Access from other machines.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Remote {
    /// Where the gateway listens for readers. Holders of a key use the next port, over TLS.
    pub listen: SocketAddr,
    /// Where the dashboard is served. `None`: nowhere.
    pub dashboard: Option<SocketAddr>,
    /// Where Foxglove connects. `None`: nowhere.
    pub foxglove: Option<SocketAddr>,
    /// Anybody may read; otherwise only holders of a key.
    pub read_for_all: bool,
    /// Anybody who may read may say `estop`; otherwise only holders of a key.
    pub estop_for_all: bool,
    /// Network interface on which the car answers those who look for it; `auto`: all. `None`: it does not.
    pub scouting: Option<String>,
    /// How much leaves the car.
    pub rates: RemoteRates,
}

/// How much leaves the car at most.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RemoteRates {
    /// Images of a port, Hz.
    pub image_hz: f64,
    /// Their width, px.
    pub image_width: u32,
    /// Their JPEG quality, 1 to 100.
    pub image_quality: u8,
    /// Other samples of a port, Hz.
    pub data_hz: f64,
}

impl Default for RemoteRates {
    fn default() -> Self {
        Self { image_hz: 10.0, image_width: 480, image_quality: 60, data_hz: 30.0 }
    }
}

impl Default for Remote {
    fn default() -> Self {
        let anywhere = |port| SocketAddr::from(([0, 0, 0, 0], port));
        Self {
            listen: anywhere(GATEWAY_PORT),
            dashboard: Some(anywhere(DASHBOARD_PORT)),
            foxglove: None,
            read_for_all: true,
            estop_for_all: true,
            scouting: Some("auto".into()),
            rates: RemoteRates::default(),
        }
    }
}

/// An address as written: `0.0.0.0:7447`, `[::]:7447`, `7447` (all addresses), or `off`.
pub fn address(text: &str) -> Result<Option<SocketAddr>, String> {
    if text == OFF {
        return Ok(None);
    }
    let port_only = text.parse().ok().map(|port: u16| SocketAddr::from(([0, 0, 0, 0], port)));
    let wrong = || format!("got `{text}`, allowed is an address with a port (`0.0.0.0:7447`), a port, or `{OFF}`");
    port_only.or_else(|| text.parse().ok()).map(Some).ok_or_else(wrong)
}

fn read_raw(written: &RawAddress) -> Result<Option<SocketAddr>, String> {
    match written {
        RawAddress::Port(port) => address(&port.to_string()),
        RawAddress::Text(text) => address(text),
    }
}

/// Reads a section, or says of each key what is wrong with it.
pub(super) fn read(raw: &RawRemote) -> Result<Remote, Vec<(Vec<&'static str>, String)>> {
    let mut remote = Remote::default();
    let mut wrong = Vec::new();
    let mut read_address =
        |key, written: &Option<RawAddress>, into: &mut Option<SocketAddr>| match written.as_ref().map(read_raw) {
            None => {}
            Some(Ok(address)) => *into = address,
            Some(Err(message)) => wrong.push((vec![key], message)),
        };
    let mut listen = Some(remote.listen);
    read_address("listen", &raw.listen, &mut listen);
    read_address("dashboard", &raw.dashboard, &mut remote.dashboard);
    read_address("foxglove", &raw.foxglove, &mut remote.foxglove);
    match listen {
        Some(listen) if listen.port() < u16::MAX => remote.listen = listen,
        Some(listen) => {
            wrong.push((vec!["listen"], format!("got port {}, the next one must exist, too", listen.port())));
        }
        None => {
            wrong.push((vec!["listen"], "got `off`; without a gateway leave the whole section `remote` out".into()));
        }
    }
    remote.read_for_all = raw.read != Some(RawWho::Granted);
    remote.estop_for_all = raw.estop != Some(RawWho::Granted);
    if let Some(interface) = &raw.scouting {
        remote.scouting = (interface != OFF).then(|| interface.clone());
        if interface.is_empty() {
            wrong.push((vec!["scouting"], "got an empty name, allowed is `auto`, `off` or a network interface".into()));
        }
    }
    let images = raw.images.as_ref();
    let rates = &mut remote.rates;
    let mut number = |path: &[&'static str], value: Option<f64>, min: f64, max: f64, unit: &str| {
        let value = value?;
        if value >= min && value <= max {
            return Some(value);
        }
        wrong.push((path.to_vec(), format!("got {value}{unit}, allowed is {min} to {max}{unit}")));
        None
    };
    let width = images.and_then(|images| images.max_width).map(|px| px as f64);
    let quality = images.and_then(|images| images.quality).map(|quality| quality as f64);
    let image_hz = number(&["images", "max_hz"], images.and_then(|images| images.max_hz), 0.1, 100.0, " Hz");
    let image_width = number(&["images", "max_width"], width, 16.0, 4096.0, " px");
    let image_quality = number(&["images", "quality"], quality, 1.0, 100.0, "");
    let data_hz = number(&["max_hz"], raw.max_hz, 0.1, 1000.0, " Hz");
    rates.image_hz = image_hz.unwrap_or(rates.image_hz);
    rates.image_width = image_width.map_or(rates.image_width, |width| width as u32);
    rates.image_quality = image_quality.map_or(rates.image_quality, |quality| quality as u8);
    rates.data_hz = data_hz.unwrap_or(rates.data_hz);
    if wrong.is_empty() { Ok(remote) } else { Err(wrong) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_or_refused() {
        let read = |text| address(text).map(|address| address.map(|address| address.to_string()));
        assert_eq!(read("off"), Ok(None), "off");
        assert_eq!(read("7447"), Ok(Some("0.0.0.0:7447".into())), "a port");
        assert_eq!(read("[::1]:80"), Ok(Some("[::1]:80".into())), "IPv6");
        for text in ["", "70000", "car", "car:80", "1.2.3.4", "0.0.0.0:x"] {
            assert!(read(text).is_err_and(|error| error.contains("allowed is")), "`{text}` is refused");
        }
    }

    #[test]
    fn every_wrong_key_is_named() {
        let raw = RawRemote {
            listen: Some(RawAddress::Text("off".into())),
            dashboard: Some(RawAddress::Port(70_000)),
            max_hz: Some(f64::NAN),
            images: Some(super::super::raw::RawRemoteImages {
                max_hz: Some(0.0),
                max_width: Some(1),
                quality: Some(101),
            }),
            ..RawRemote::default()
        };
        let wrong: Vec<String> =
            read(&raw).expect_err("all wrong").into_iter().map(|(path, _)| path.join(".")).collect();
        let all = ["dashboard", "listen", "images.max_hz", "images.max_width", "images.quality", "max_hz"];
        assert_eq!(wrong, all, "each once");
        assert_eq!(read(&RawRemote::default()), Ok(Remote::default()), "an empty section is the defaults");
    }
}
