//! Who has logged in, kept in memory: a restart of the server logs everybody out. And a limit for those who guess. The time comes from
//! outside.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::http::HeaderMap;
use axum::http::header::COOKIE;

/// A session ends after this time.
pub const HOLDS_FOR: Duration = Duration::from_secs(12 * 3600);
/// So many at a time; the oldest goes.
const MOST_SESSIONS: usize = 256;
/// So many wrong tries from one address ...
const TRIES: u32 = 5;
/// ... in this time.
const TRIES_IN: Duration = Duration::from_secs(60);
/// So many addresses are remembered.
const MOST_ADDRESSES: usize = 1000;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Those that are logged in: session to key.
#[derive(Default)]
pub struct Sessions(Mutex<HashMap<String, (String, Instant)>>);

impl Sessions {
    /// A new session, `secret`, of the key with that id.
    pub fn begin(&self, secret: String, key_id: String, now: Instant) {
        let mut sessions = lock(&self.0);
        sessions.retain(|_, (_, begun)| now < *begun + HOLDS_FOR);
        if sessions.len() >= MOST_SESSIONS
            && let Some(oldest) = sessions.iter().min_by_key(|(_, (_, begun))| *begun).map(|(secret, _)| secret.clone())
        {
            sessions.remove(&oldest);
        }
        sessions.insert(secret, (key_id, now));
    }

    /// The id of the key of a session that holds.
    pub fn key_id(&self, secret: &str, now: Instant) -> Option<String> {
        let sessions = lock(&self.0);
        sessions.get(secret).filter(|(_, begun)| now < *begun + HOLDS_FOR).map(|(id, _)| id.clone())
    }

    /// Ends one.
    pub fn end(&self, secret: &str) {
        lock(&self.0).remove(secret);
    }
}

/// Wrong tries to log in, by address.
#[derive(Default)]
pub struct Tries(Mutex<HashMap<IpAddr, (u32, Instant)>>);

impl Tries {
    /// Whether somebody at this address may try.
    pub fn may_try(&self, from: IpAddr, now: Instant) -> bool {
        let tries = lock(&self.0);
        tries.get(&household(from)).is_none_or(|(count, begun)| *count < TRIES || now >= *begun + TRIES_IN)
    }

    /// It was wrong. Whether it was the last try for now.
    pub fn was_wrong(&self, from: IpAddr, now: Instant) -> bool {
        let mut tries = lock(&self.0);
        if tries.len() >= MOST_ADDRESSES {
            tries.retain(|_, (_, begun)| now < *begun + TRIES_IN);
        }
        let (count, begun) = tries.entry(household(from)).or_insert((0, now));
        if now >= *begun + TRIES_IN {
            (*count, *begun) = (0, now);
        }
        *count += 1;
        *count == TRIES
    }
}

/// Whoever has one address of an IPv6 network has all of them.
fn household(address: IpAddr) -> IpAddr {
    match address {
        IpAddr::V6(v6) => IpAddr::V6((u128::from(v6) >> 64 << 64).into()),
        IpAddr::V4(_) => address,
    }
}

/// Name of the cookie. Cookies do not know ports: two cars on one machine must not log each other out.
pub fn cookie_name(robot: &str) -> String {
    format!("carril-{robot}")
}

/// The session that a request brings.
pub fn of_request(headers: &HeaderMap, robot: &str) -> Option<String> {
    let name = cookie_name(robot);
    let lines = headers.get_all(COOKIE).iter().filter_map(|line| line.to_str().ok());
    let pairs = lines.flat_map(|line| line.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.into_iter().find(|(key, _)| *key == name).map(|(_, value)| value.to_owned())
}

/// The cookie of a session. `None` ends it.
pub fn cookie(robot: &str, secret: Option<&str>, encrypted: bool) -> String {
    let name = cookie_name(robot);
    let secure = if encrypted { "; Secure" } else { "" };
    let (value, age_s) = secret.map_or(("", 0), |secret| (secret, HOLDS_FOR.as_secs()));
    format!("{name}={value}; Path=/; Max-Age={age_s}; HttpOnly; SameSite=Strict{secure}")
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_session_holds_until_it_is_ended_or_too_old() {
        let (sessions, now) = (Sessions::default(), Instant::now());
        sessions.begin("secret".into(), "laptop-1-aa".into(), now);
        assert_eq!(sessions.key_id("secret", now).as_deref(), Some("laptop-1-aa"), "it holds");
        assert_eq!(sessions.key_id("guess", now), None, "another does not");
        assert_eq!(sessions.key_id("secret", now + HOLDS_FOR), None, "too old");
        sessions.end("secret");
        assert_eq!(sessions.key_id("secret", now), None, "ended");
        for at in 0..=MOST_SESSIONS {
            sessions.begin(format!("{at}"), "key".into(), now + Duration::from_secs(at as u64));
        }
        assert_eq!((sessions.key_id("0", now), lock(&sessions.0).len()), (None, MOST_SESSIONS), "the oldest has gone");
    }

    #[test]
    fn guessing_has_a_limit_for_each_address() {
        let (tries, now) = (Tries::default(), Instant::now());
        let (one, other): (IpAddr, IpAddr) = ([10, 0, 0, 1].into(), [10, 0, 0, 2].into());
        let last: Vec<bool> = (0..TRIES).map(|_| tries.was_wrong(one, now)).collect();
        assert_eq!(last, [false, false, false, false, true], "the last one is told");
        assert!(!tries.may_try(one, now) && tries.may_try(other, now), "for that address alone");
        assert!(tries.may_try(one, now + TRIES_IN), "for a while");
        let (six, neighbour): (IpAddr, IpAddr) = ("fd00::1".parse().expect("one"), "fd00::2".parse().expect("one"));
        let last = (0..TRIES).filter(|_| tries.was_wrong(six, now)).count();
        assert_eq!(last, 1, "told once");
        assert!(!tries.may_try(neighbour, now), "one network is one");
    }

    #[test]
    fn cookies_are_found_and_kept_from_scripts() {
        let set = cookie("car1", Some("abc"), true);
        assert!(["HttpOnly", "SameSite=Strict", "Secure", "Path=/"].iter().all(|flag| set.contains(flag)), "{set}");
        assert!(!cookie("car1", Some("abc"), false).contains("Secure"), "a plain connection could not give it back");
        assert!(cookie("car1", None, true).contains("Max-Age=0"), "ended");
        let mut headers = HeaderMap::new();
        headers.append(COOKIE, HeaderValue::from_static("a=b; carril-car2=other"));
        assert_eq!(of_request(&headers, "car1"), None, "another car's");
        headers.append(COOKIE, HeaderValue::from_static("x; carril-car1=abc"));
        assert_eq!(of_request(&headers, "car1").as_deref(), Some("abc"), "ours");
    }

    proptest! {
        #[test]
        fn garbage_is_no_panic(bytes in proptest::collection::vec(any::<u8>(), 0..60)) {
            let mut headers = HeaderMap::new();
            if let Ok(value) = HeaderValue::from_bytes(&bytes) {
                headers.append(COOKIE, value);
            }
            of_request(&headers, "car1");
        }
    }
}
