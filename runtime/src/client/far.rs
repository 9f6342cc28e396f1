//! By way of the gateway of a car: over the network, with or without a key that was granted.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Control, Payload, Stamp};

use super::{ANSWER_PATIENCE, ASK_AGAIN, Client, ClientError, Way};
use crate::clock::FarClock;
use crate::control_plane::{
    Access, AccessLevel, ControlReply, RunFile, access_key, clock_key, granted_key, open_estop_key, run_key,
};
use crate::process::CONTROL_PATIENCE;
use crate::transport::TransportError;
use crate::transport::zenoh::{FarOptions, ZenohTransport};

/// A link that was there so short a time ago comes back, most likely: whoever looks on waits.
const OUTAGE_PATIENCE: Duration = Duration::from_secs(30);
/// The car's clock is compared so often with ours.
const COMPARE_EVERY: Duration = Duration::from_secs(5);
/// Each time with so many questions: the quickest answer tells best.
const QUESTIONS: u32 = 5;
/// A question far away is answered within this time, or lost.
const FAR_PATIENCE: Duration = Duration::from_secs(2);

/// So many small questions follow one that somebody asked, ...
const FOLLOWERS: u32 = 2;
/// ... each so long after the one before.
const FOLLOWS_AFTER: Duration = Duration::from_millis(8);

/// What is known of the way.
pub(super) struct FarWay {
    /// Name of the key, as the gateway knows it.
    name: Option<String>,
    linked: Mutex<Instant>,
    ended: Arc<AtomicBool>,
    pub(super) asked: Followers,
}

impl Drop for FarWay {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
    }
}

impl Client {
    /// Connects to the gateway of a car: `robot`, or whichever is there. `name`: that of the key.
    pub fn open_far(
        options: &FarOptions,
        name: Option<&str>,
        robot: Option<&str>,
        patience: Duration,
    ) -> Result<Self, ClientError> {
        let begun = Instant::now();
        let transport = ZenohTransport::open_far(options)?;
        let unreachable =
            || ClientError::Unreachable { endpoint: options.endpoint.clone(), waited_s: begun.elapsed().as_secs_f64() };
        transport.wait_for_links(1, patience);
        if transport.links() == 0 {
            return Err(unreachable());
        }
        let run = ask_for_run(&transport, robot, patience.max(ANSWER_PATIENCE)).ok_or_else(unreachable)?;
        let clock = Arc::new(FarClock::set_to(Stamp::ZERO));
        if !compare(&transport, &run.robot, &clock) {
            return Err(unreachable());
        }
        let ended = Arc::new(AtomicBool::new(false));
        keep_comparing(transport.clone(), run.robot.clone(), Arc::clone(&clock), Arc::clone(&ended));
        let asked = Followers::start(transport.clone(), clock_key(&run.robot));
        let way = FarWay { name: name.map(str::to_owned), linked: Mutex::new(Instant::now()), ended, asked };
        Self::on(run, Way::Far(way), transport, clock, None)
    }
}

fn ask_for_run(transport: &ZenohTransport, robot: Option<&str>, patience: Duration) -> Option<RunFile> {
    let key = run_key(robot.unwrap_or("*"));
    let deadline = Instant::now() + patience;
    loop {
        let answers = transport.ask(&key, Vec::new(), FAR_PATIENCE).unwrap_or_default();
        let run = answers.into_iter().flatten().find_map(|answer| serde_json::from_slice(&answer).ok());
        if run.is_some() || Instant::now() >= deadline {
            return run;
        }
        // A question that comes before the link is known on both sides is answered by nobody.
        std::thread::sleep(ASK_AGAIN);
    }
}

/// Sets the clock by the quickest of some answers. `false`: there was none.
fn compare(transport: &ZenohTransport, robot: &str, clock: &FarClock) -> bool {
    let key = clock_key(robot);
    let mut best: Option<(Duration, Stamp, Instant)> = None;
    for _ in 0..QUESTIONS {
        let asked = Instant::now();
        let Ok(answers) = transport.ask(&key, Vec::new(), FAR_PATIENCE) else { continue };
        let (took, now) = (asked.elapsed(), Instant::now());
        let stamp = answers.into_iter().flatten().find_map(|answer| serde_json::from_slice::<i64>(&answer).ok());
        // Half of the way there, half back: no better guess can be made from one clock.
        let Some(stamp) = stamp.map(|stamp| Stamp::from_nanos(stamp) + took / 2) else { continue };
        if best.as_ref().is_none_or(|(least, _, _)| took < *least) {
            best = Some((took, stamp, now));
        }
    }
    if let Some((_, stamp, when)) = best {
        clock.set(stamp, when);
    }
    best.is_some()
}

fn keep_comparing(transport: ZenohTransport, robot: String, clock: Arc<FarClock>, ended: Arc<AtomicBool>) {
    std::thread::spawn(move || {
        let mut compared = Instant::now();
        while !ended.load(Ordering::Relaxed) {
            // Short, so that the session is not held after its client.
            std::thread::sleep(Duration::from_millis(100));
            if compared.elapsed() >= COMPARE_EVERY && transport.links() > 0 {
                compare(&transport, &robot, &clock);
                compared = Instant::now();
            }
        }
    });
}

/// Asks something small after each question: TCP misses a lost packet that nothing follows only after a fifth of a second, one that others
/// follow at once. The answers do the same for the answer.
#[derive(Clone)]
pub(super) struct Followers(Sender<()>);

impl Followers {
    fn start(transport: ZenohTransport, key: String) -> Self {
        let (asked, questions) = channel();
        std::thread::spawn(move || {
            // It ends with the last who asks.
            while questions.recv().is_ok() {
                let mut left = FOLLOWERS;
                while left > 0 {
                    std::thread::sleep(FOLLOWS_AFTER);
                    // Nobody needs the answer.
                    let _ = transport.ask(&key, Vec::new(), FOLLOWS_AFTER);
                    left = if questions.try_recv().is_ok() { FOLLOWERS } else { left - 1 };
                }
            }
        });
        Self(asked)
    }

    /// Something is asked now.
    pub(super) fn is_asked(&self) {
        // The thread ends last.
        let _ = self.0.send(());
    }
}

impl FarWay {
    /// Name of the key, as the gateway knows it.
    pub(super) fn name(&self) -> Option<&str> {
        self.name.as_deref()
    }

    pub(super) fn is_alive(&self, transport: &ZenohTransport) -> bool {
        let mut linked = self.linked.lock().unwrap_or_else(PoisonError::into_inner);
        if transport.links() > 0 {
            *linked = Instant::now();
        }
        linked.elapsed() < OUTAGE_PATIENCE
    }

    pub(super) fn access(&self, client: &Client) -> Access {
        let read = |why: String| Access { level: AccessLevel::Read, name: self.name.clone(), why };
        let Some(name) = &self.name else { return read("connected without a key".into()) };
        match client.ask(&access_key(&client.run.robot, name), Vec::new(), FAR_PATIENCE) {
            Ok(access) => access,
            Err(error) => read(format!("the car does not say what the key may do: {error}")),
        }
    }

    /// The key of a request, once the car has said that it will hear it: a request that Zenoh refuses gets no answer at all.
    pub(super) fn request_key(&self, client: &Client, what: &'static str, path: &str) -> Result<String, ClientError> {
        let robot = client.run.robot.clone();
        let Some(name) = &self.name else { return Err(ClientError::NoKey { what, robot }) };
        let access = self.access(client);
        if access.level != AccessLevel::Control {
            return Err(ClientError::Refused { what, robot, why: access.why });
        }
        Ok(granted_key(&robot, name, path))
    }

    pub(super) fn control(
        &self,
        client: &Client,
        control: Control,
    ) -> Result<Vec<Result<ControlReply, String>>, ClientError> {
        let key = match (control, &self.name) {
            // Nobody is asked first: this must not wait.
            (Control::EStop, _) => open_estop_key(&client.run.robot),
            _ => self.request_key(client, "a word to the car", "control")?,
        };
        let word = serde_json::to_vec(&control).unwrap_or_default();
        client.ask(&key, word, CONTROL_PATIENCE + FAR_PATIENCE)
    }
}

/// A sample in one piece: length of the header (4 bytes, little endian), header, payload.
pub fn pack_sample(header: &[u8], payload: &[u8]) -> Vec<u8> {
    let mut packed = (header.len() as u32).to_le_bytes().to_vec();
    packed.extend_from_slice(header);
    packed.extend_from_slice(payload);
    packed
}

/// Header and payload of a packed sample. `None`: it is none.
pub fn unpack_sample(packed: &[u8]) -> Option<(&[u8], &[u8])> {
    let (len, rest) = packed.split_first_chunk::<4>()?;
    rest.split_at_checked(u32::from_le_bytes(*len) as usize)
}

/// Asks the gateway to put a sample on an input that is open to people.
pub(super) fn put(transport: &ZenohTransport, key: &str, header: &[u8], payload: &Payload) -> Result<(), ClientError> {
    let answers = transport.ask(key, pack_sample(header, payload), FAR_PATIENCE)?;
    match answers.into_iter().next() {
        Some(Ok(_)) => Ok(()),
        Some(Err(reason)) => Err(ClientError::Answer { key: key.to_owned(), reason }),
        None => Err(TransportError::NoAnswer { key: key.to_owned(), timeout_ms: FAR_PATIENCE.as_millis() }.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_packed_and_damaged_ones_refused() {
        let packed = pack_sample(b"head", b"body");
        assert_eq!(unpack_sample(&packed), Some((&b"head"[..], &b"body"[..])), "round trip");
        assert_eq!(unpack_sample(&packed[..6]), None, "the header is cut");
        assert_eq!(unpack_sample(b"\xff\xff\xff\xffx"), None, "an absurd length");
        assert_eq!(unpack_sample(b""), None, "nothing");
    }
}
