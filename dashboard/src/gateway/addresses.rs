//! The names and addresses under which this machine can be reached.

use std::net::{IpAddr, SocketAddr};

use nix::ifaddrs::getifaddrs;

/// Names of this machine: its own, and that under which mDNS knows it.
pub fn names() -> Vec<String> {
    let own = nix::unistd::gethostname().ok().and_then(|name| name.into_string().ok());
    // Only what can stand in a certificate.
    let fits = |name: &String| {
        !name.is_empty() && name.len() < 64 && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'.')
    };
    let mut names: Vec<String> = own.into_iter().filter(fits).collect();
    if let Some(name) = names.first().filter(|name| !name.contains('.')) {
        names.push(format!("{name}.local"));
    }
    names.push("localhost".into());
    names.dedup();
    names
}

/// Addresses of this machine, those for other machines first.
pub fn addresses() -> Vec<IpAddr> {
    let mut found: Vec<IpAddr> = Vec::new();
    for interface in getifaddrs().into_iter().flatten() {
        let Some(address) = interface.address else { continue };
        let ip = if let Some(v4) = address.as_sockaddr_in() {
            IpAddr::V4(v4.ip())
        } else if let Some(v6) = address.as_sockaddr_in6() {
            // Those that hold on one link only need the name of the interface, which a certificate cannot have.
            if v6.ip().is_unicast_link_local() {
                continue;
            }
            IpAddr::V6(v6.ip())
        } else {
            continue;
        };
        if !found.contains(&ip) {
            found.push(ip);
        }
    }
    found.sort_by_key(|ip| (ip.is_loopback(), ip.is_ipv6(), *ip));
    found
}

/// Where a server that listens at `listen` can be reached: that address, or all of this machine's if it listens at all.
pub fn reachable(listen: SocketAddr) -> Vec<SocketAddr> {
    if !listen.ip().is_unspecified() {
        return vec![listen];
    }
    let fits = |ip: &IpAddr| listen.is_ipv6() || ip.is_ipv4();
    addresses().into_iter().filter(fits).map(|ip| SocketAddr::new(ip, listen.port())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_has_names_and_addresses() {
        assert!(names().contains(&"localhost".to_owned()), "{:?}", names());
        let addresses = addresses();
        assert!(addresses.iter().any(IpAddr::is_loopback), "{addresses:?}");
        assert!(addresses.last().is_some_and(IpAddr::is_loopback), "those for others come first: {addresses:?}");
        let one: SocketAddr = "127.0.0.1:80".parse().expect("an address");
        assert_eq!(reachable(one), [one], "one address is that one");
        let all: SocketAddr = "0.0.0.0:80".parse().expect("an address");
        assert!(reachable(all).contains(&one), "all are all of this machine's");
    }
}
