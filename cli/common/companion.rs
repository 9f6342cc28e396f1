//! A process beside a run that talks to other machines: the gateway of a car, or the link of another machine to it. One of its own, so that
//! nothing that comes from outside can reach the supervisor. It is started when the graph is up, again when it dies, and ended with the run.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde::de::DeserializeOwned;

/// It is started again after this pause ...
const AGAIN_AFTER: Duration = Duration::from_secs(1);
/// ... unless it has died so often in a row, each time within a minute: a port that is taken stays taken.
const TRIES: u32 = 5;
const LONG_LIFE: Duration = Duration::from_secs(60);
/// It has this long to end.
const END_PATIENCE: Duration = Duration::from_secs(2);
const LOOK: Duration = Duration::from_millis(20);

/// What a companion has to say.
pub enum News<T> {
    /// Something for programs: a line of JSON on its standard output.
    Said(Box<T>),
    /// It wrote a line.
    Line(String),
    /// It died, and whether it starts again.
    Died { how: String, again: bool },
}

/// Keeps a companion running until it is dropped.
pub struct Companion<T> {
    stop: Arc<AtomicBool>,
    pid: Arc<Mutex<Option<u32>>>,
    news: Receiver<News<T>>,
    thread: Option<JoinHandle<()>>,
}

impl<T: DeserializeOwned + Send + 'static> Companion<T> {
    /// Starts `carril` with these arguments.
    pub fn start(arguments: Vec<String>) -> Result<Self> {
        let program = std::env::current_exe().context("where is this program?")?;
        let (stop, pid) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(None)));
        let (sender, news) = channel();
        let (told, shown) = (Arc::clone(&stop), Arc::clone(&pid));
        let thread = std::thread::spawn(move || {
            let start = || {
                let mut command = Command::new(&program);
                command.args(&arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
                // Ctrl-C in the terminal is for the run, which ends this one when the car stands.
                std::os::unix::process::CommandExt::process_group(&mut command, 0);
                command.spawn()
            };
            keep(start, &told, &shown, &sender);
        });
        Ok(Self { stop, pid, news, thread: Some(thread) })
    }

    /// The next news, if there are any.
    pub fn news(&self) -> Option<News<T>> {
        self.news.try_recv().ok()
    }
}

impl<T> Drop for Companion<T> {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        send(*self.pid.lock().unwrap_or_else(PoisonError::into_inner), Signal::SIGTERM);
        if let Some(thread) = self.thread.take() {
            // If it panicked, it has said so.
            let _ = thread.join();
        }
    }
}

fn send(pid: Option<u32>, signal: Signal) {
    if let Some(pid) = pid.and_then(|pid| i32::try_from(pid).ok()) {
        // It may just have ended.
        let _ = kill(Pid::from_raw(pid), signal);
    }
}

fn keep<T: DeserializeOwned + Send + 'static>(
    start: impl Fn() -> std::io::Result<Child>,
    stop: &AtomicBool,
    pid: &Mutex<Option<u32>>,
    news: &Sender<News<T>>,
) {
    let mut deaths = 0;
    while !stop.load(Ordering::Relaxed) {
        let begun = Instant::now();
        let how = match start() {
            Ok(child) => {
                *pid.lock().unwrap_or_else(PoisonError::into_inner) = Some(child.id());
                let how = attend(child, stop, news);
                *pid.lock().unwrap_or_else(PoisonError::into_inner) = None;
                how
            }
            Err(error) => error.to_string(),
        };
        if stop.load(Ordering::Relaxed) {
            return;
        }
        deaths = if begun.elapsed() > LONG_LIFE { 1 } else { deaths + 1 };
        let again = deaths < TRIES;
        // The run may have ended meanwhile.
        let _ = news.send(News::Died { how, again });
        if !again {
            return;
        }
        let pause = Instant::now() + AGAIN_AFTER;
        while Instant::now() < pause && !stop.load(Ordering::Relaxed) {
            std::thread::sleep(LOOK);
        }
    }
}

/// Listens to a child until it has ended. How it ended.
fn attend<T: DeserializeOwned + Send + 'static>(mut child: Child, stop: &AtomicBool, news: &Sender<News<T>>) -> String {
    let readers = [
        child.stdout.take().map(|output| read_lines(output, news.clone(), true)),
        child.stderr.take().map(|output| read_lines(output, news.clone(), false)),
    ];
    let mut killed_at: Option<Instant> = None;
    let how = loop {
        match child.try_wait() {
            Ok(Some(status)) => break status.to_string(),
            Ok(None) => {}
            Err(error) => break error.to_string(),
        }
        if stop.load(Ordering::Relaxed) {
            let deadline = *killed_at.get_or_insert_with(|| Instant::now() + END_PATIENCE);
            send(Some(child.id()), if Instant::now() < deadline { Signal::SIGTERM } else { Signal::SIGKILL });
        }
        std::thread::sleep(LOOK);
    };
    for reader in readers.into_iter().flatten() {
        // If it panicked, it has said so.
        let _ = reader.join();
    }
    how
}

fn read_lines<T: DeserializeOwned + Send + 'static>(
    output: impl Read + Send + 'static,
    news: Sender<News<T>>,
    for_programs: bool,
) -> JoinHandle<()> {
    std::thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            let said = if for_programs { serde_json::from_str(&line).ok() } else { None };
            let one = said.map_or(News::Line(line), News::Said);
            // The run may have ended meanwhile.
            let _ = news.send(one);
        }
    })
}
