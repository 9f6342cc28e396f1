//! Who may talk to the server from a browser: the page that it served itself, under a name of its own. Else any page that is open in
//! somebody's browser could drive the car, and a foreign name that leads here (DNS rebinding) would count as ours. Pure.

use std::net::IpAddr;

/// Whether `host`, as a request names it, is this machine: an address, `localhost`, or one of its names.
pub fn is_ours(host: &str, names: &[String]) -> bool {
    let Some((name, _)) = split(host) else { return false };
    let address = name.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(name);
    if address.parse::<IpAddr>().is_ok() {
        return true;
    }
    let name = name.trim_end_matches('.');
    name.eq_ignore_ascii_case("localhost") || names.iter().any(|known| known.eq_ignore_ascii_case(name))
}

/// Whether a page of `origin` was served under `host`. `encrypted`: the request came over TLS.
pub fn is_same(origin: &str, host: &str, encrypted: bool) -> bool {
    let (scheme, default) = if encrypted { ("https://", 443) } else { ("http://", 80) };
    let Some(named) = origin.strip_prefix(scheme) else { return false };
    let (Some((named, named_port)), Some((host, port))) = (split(named), split(host)) else { return false };
    named.eq_ignore_ascii_case(host) && named_port.unwrap_or(default) == port.unwrap_or(default)
}

/// Name and port of `host:port`. `None`: it is neither.
fn split(host: &str) -> Option<(&str, Option<u16>)> {
    let fits = |name: &str| {
        let inner = name.strip_prefix('[').and_then(|rest| rest.strip_suffix(']'));
        let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"-._".contains(&byte);
        match inner {
            Some(address) => address.parse::<std::net::Ipv6Addr>().is_ok(),
            None => !name.is_empty() && name.bytes().all(allowed),
        }
    };
    let (name, port) = match host.rsplit_once(':') {
        Some((name, port)) if !port.ends_with(']') => (name, Some(port.parse().ok()?)),
        _ => (host, None),
    };
    fits(name).then_some((name, port))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn only_names_of_this_machine_are_served() {
        let names = ["car1".to_owned(), "car1.local".to_owned()];
        for host in [
            "192.168.1.5:8080",
            "127.0.0.1",
            "[::1]:8080",
            "[fe80::1]",
            "localhost:8080",
            "Car1.local",
            "car1:80",
            "car1.local.",
        ] {
            assert!(is_ours(host, &names), "{host}");
        }
        for host in [
            "evil.example",
            "car1.evil.example",
            "",
            ":80",
            "car1:port",
            "car1@evil.example",
            "[evil]",
            "car1.local:80:80",
            "127.0.0.1.evil.example",
        ] {
            assert!(!is_ours(host, &names), "{host}");
        }
    }

    #[test]
    fn only_the_page_that_was_served_here_may_talk() {
        assert!(is_same("http://car1.local:8080", "car1.local:8080", false), "the same");
        assert!(is_same("https://car1.local", "CAR1.local:443", true), "the default port");
        assert!(is_same("http://[::1]:8080", "[::1]:8080", false), "an address");
        for (origin, host, encrypted) in [
            ("http://evil.example", "car1.local:8080", false),
            ("http://car1.local:8081", "car1.local:8080", false),
            ("http://car1.local:8080", "car1.local:8080", true),
            ("https://car1.local:8080", "car1.local:8080", false),
            ("null", "car1.local:8080", false),
            ("", "", false),
            ("http://car1.local:8080@evil.example", "evil.example", false),
        ] {
            assert!(!is_same(origin, host, encrypted), "{origin} on {host}");
        }
    }

    proptest! {
        #[test]
        fn garbage_is_no_panic(origin in ".{0,40}", host in ".{0,40}") {
            is_same(&origin, &host, true);
            is_ours(&host, &[]);
        }
    }
}
