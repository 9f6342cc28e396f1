//! How far away a car is: the time to open a TCP connection, which is one round trip. Says nothing on the connection.

use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

/// Whoever does not answer within this time is not asked again.
const PATIENCE: Duration = Duration::from_secs(2);
/// A knock that took longer may have been lost and sent again (after 1 s): it is repeated.
const SLOW: Duration = Duration::from_millis(300);

/// The round trip to `tls/car.local:7448` or `tcp/10.0.0.1:7447`. `None`: nobody opened.
pub fn round_trip(endpoint: &str) -> Option<Duration> {
    let (_, address) = endpoint.split_once('/')?;
    let address = address.split(['?', '#']).next()?;
    let addresses: Vec<_> = address.to_socket_addrs().ok()?.collect();
    let knock = || {
        addresses.iter().find_map(|address| {
            let knocked = Instant::now();
            TcpStream::connect_timeout(address, PATIENCE).ok().map(|_| knocked.elapsed())
        })
    };
    let first = knock()?;
    Some(if first > SLOW { knock().map_or(first, |second| first.min(second)) } else { first })
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn whoever_listens_is_near_and_others_are_unknown() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("it has one");
        for endpoint in [format!("tls/{address}"), format!("tcp/{address}#so_sndbuf=1")] {
            assert!(round_trip(&endpoint).is_some(), "{endpoint}");
        }
        drop(listener);
        for endpoint in [format!("tcp/{address}"), "tcp/".into(), "nonsense".into(), "tcp/no port".into()] {
            assert_eq!(round_trip(&endpoint), None, "{endpoint}");
        }
    }
}
