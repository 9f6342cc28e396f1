//! Listening to ports of a running graph: how long, how many, and the statistics at the end. The same for `echo`, `hz`,
//! `bw` and `delay`.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError, SyncSender, TrySendError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use carril_messages::{CompressedImage, Header, Image, Message, Payload, Stamp};
use clap::Args;
use serde::Serialize;

use super::interrupt;
use super::live::Run;
use super::output;
use super::ports::{self, Port};
use super::statistics::{Sensors, Statistics, Summary};
use super::time;
use super::way::Target;

/// Samples that wait for being shown. A terminal that is slower loses samples, and is told so.
const QUEUE: usize = 256;
/// After so long without a sample people are told what is waited for.
const PATIENCE: Duration = Duration::from_secs(2);

/// Arguments of all commands that listen.
#[derive(Args)]
pub struct WatchArgs {
    /// End after this time, for example 30s or 2m; exit code 1 if nothing came
    #[arg(long = "for", value_name = "DURATION", value_parser = time::parse)]
    pub duration: Option<Duration>,
    /// End after N samples of each port
    #[arg(short = 'n', long = "count", value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// One JSON object a line; the last one holds the statistics
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub target: Target,
}

/// A sample that has come.
pub struct Arrival {
    /// Index of its port.
    pub port: usize,
    /// Its header.
    pub header: Header,
    /// Its bytes.
    pub payload: Payload,
    /// When it came, on the car's clock.
    pub arrived: Stamp,
}

/// What a command shows.
pub trait Viewer {
    /// Whether it wants every sample, or only the numbers.
    const SAMPLES: bool;

    /// A sample has come.
    fn sample(&mut self, _port: &Port, _arrival: &Arrival) -> Result<()> {
        Ok(())
    }

    /// A second is over.
    fn second(&mut self, _windows: &[Summary]) -> Result<()> {
        Ok(())
    }

    /// The last line before the statistics must end.
    fn end(&mut self) -> Result<()> {
        Ok(())
    }
}

enum Event {
    Arrival(Box<Arrival>),
    LookAgain,
}

/// Takes note of every sample on the transport's thread.
pub struct Recorder {
    port: usize,
    message_type: String,
    limit: u64,
    seen: Mutex<Seen>,
    events: SyncSender<Event>,
    samples: bool,
}

struct Seen {
    total: Statistics,
    window: Statistics,
    not_shown: u64,
    last_refusal: Option<String>,
}

impl Recorder {
    fn new(index: usize, port: &Port, sensors: &Arc<Sensors>, limit: Option<u64>, events: SyncSender<Event>) -> Self {
        let statistics = || Statistics::new(&port.name(), sensors);
        let seen = Seen { total: statistics(), window: statistics(), not_shown: 0, last_refusal: None };
        let (message_type, limit) = (port.message_type.clone(), limit.unwrap_or(u64::MAX));
        Self { port: index, message_type, limit, seen: Mutex::new(seen), events, samples: true }
    }

    fn numbers_only(self) -> Self {
        Self { samples: false, ..self }
    }

    fn lock(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A sample has come. One of another type than the port's is counted as refused.
    pub fn record(&self, header: Header, payload: Payload, arrived: Stamp) {
        let mut seen = self.lock();
        if seen.total.count() >= self.limit {
            return;
        }
        // Images come compressed from a car on another machine.
        let compressed = self.message_type == Image::TYPE.name && header.message_type == CompressedImage::TYPE;
        if header.message_type.name != self.message_type && !compressed {
            seen.total.record_refused();
            seen.window.record_refused();
            seen.last_refusal = Some(format!("it is a `{}`, expected `{}`", header.message_type, self.message_type));
            return;
        }
        seen.total.record(&header, payload.len(), arrived);
        seen.window.record(&header, payload.len(), arrived);
        if self.samples {
            let event = Event::Arrival(Box::new(Arrival { port: self.port, header, payload, arrived }));
            seen.not_shown += u64::from(matches!(self.events.try_send(event), Err(TrySendError::Full(_))));
        }
        if seen.total.count() >= self.limit {
            let _ = self.events.try_send(Event::LookAgain);
        }
    }

    fn full(&self) -> bool {
        self.lock().total.count() >= self.limit
    }
}

/// Listens to `ports` until enough has come, the time is over, or Ctrl-C; then prints the statistics.
pub fn watch<V: Viewer>(run: &Run, ports: &[Port], args: &WatchArgs, viewer: &mut V) -> Result<()> {
    let (events, inbox) = mpsc::sync_channel(QUEUE);
    let sensors = Arc::new(ports::sensors(run.file()));
    let recorder = |(index, port): (usize, &Port)| {
        let recorder = Recorder::new(index, port, &sensors, args.count, events.clone());
        Arc::new(if V::SAMPLES { recorder } else { recorder.numbers_only() })
    };
    let recorders: Vec<Arc<Recorder>> = ports.iter().enumerate().map(recorder).collect();
    let interrupted = interrupted(events)?;
    let mut guards = Vec::new();
    for (port, recorder) in ports.iter().zip(&recorders) {
        guards.push(run.subscribe(port, Arc::clone(recorder))?);
    }
    let watching = Watching { run, ports, recorders: &recorders, args, interrupted: &interrupted };
    let ended = watching.until_the_end(&inbox, viewer)?;
    drop(guards);
    viewer.end()?;
    watching.conclude(ended)
}

/// Becomes true at Ctrl-C; the queue only wakes the loop, as it may be full.
fn interrupted(events: SyncSender<Event>) -> Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = Arc::clone(&flag);
    interrupt::on_interrupt(move || {
        set.store(true, Ordering::Relaxed);
        let _ = events.try_send(Event::LookAgain);
    })?;
    Ok(flag)
}

struct Watching<'a> {
    run: &'a Run,
    ports: &'a [Port],
    recorders: &'a [Arc<Recorder>],
    args: &'a WatchArgs,
    interrupted: &'a AtomicBool,
}

/// The last line of `--json`.
#[derive(Serialize)]
struct Statement<'a> {
    statistics: &'a [Summary],
}

#[derive(PartialEq)]
enum Ended {
    Enough,
    TimeOver,
    Interrupted,
    RunOver,
}

impl Watching<'_> {
    fn until_the_end<V: Viewer>(&self, inbox: &mpsc::Receiver<Event>, viewer: &mut V) -> Result<Ended> {
        let begun = Instant::now();
        let end = self.args.duration.map(|duration| begun + duration);
        let mut next_second = begun + Duration::from_secs(1);
        let mut patience = Some(begun + PATIENCE);
        loop {
            let deadline = end.map_or(next_second, |end| end.min(next_second));
            match inbox.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(Event::Arrival(arrival)) => viewer.sample(&self.ports[arrival.port], &arrival)?,
                Ok(Event::LookAgain) | Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
            }
            if self.interrupted.load(Ordering::Relaxed) {
                return Ok(Ended::Interrupted);
            }
            let now = Instant::now();
            if self.recorders.iter().all(|recorder| recorder.full()) {
                return self.show_the_rest(inbox, viewer);
            }
            if end.is_some_and(|end| now >= end) {
                return Ok(Ended::TimeOver);
            }
            if now >= next_second {
                next_second += Duration::from_secs(1);
                self.one_second(viewer)?;
                if !self.run.is_alive() {
                    return Ok(Ended::RunOver);
                }
            }
            if patience.is_some_and(|patience| now >= patience) {
                patience = None;
                self.say_what_is_waited_for();
            }
        }
    }

    fn show_the_rest<V: Viewer>(&self, inbox: &mpsc::Receiver<Event>, viewer: &mut V) -> Result<Ended> {
        while let Ok(event) = inbox.try_recv() {
            if let Event::Arrival(arrival) = event {
                viewer.sample(&self.ports[arrival.port], &arrival)?;
            }
        }
        Ok(Ended::Enough)
    }

    fn one_second<V: Viewer>(&self, viewer: &mut V) -> Result<()> {
        let windows: Vec<Summary> =
            self.recorders.iter().map(|recorder| recorder.lock().window.next_window()).collect();
        viewer.second(&windows)
    }

    /// Goes to standard error, so that a pipe gets samples only.
    fn say_what_is_waited_for(&self) {
        for (port, recorder) in self.ports.iter().zip(self.recorders) {
            if recorder.lock().total.count() == 0 {
                eprintln!("waiting: nothing has come on `{}` yet; {}", port.name(), self.run.explain_silence(port));
            }
        }
    }

    fn conclude(&self, ended: Ended) -> Result<()> {
        let summaries: Vec<Summary> = self.recorders.iter().map(|recorder| recorder.lock().total.summary()).collect();
        if self.args.json {
            output::json_line(&Statement { statistics: &summaries })?;
        } else {
            summaries.iter().try_for_each(output::text)?;
        }
        for (port, recorder) in self.ports.iter().zip(self.recorders) {
            let seen = recorder.lock();
            if seen.not_shown > 0 {
                let samples = output::counted(seen.not_shown, "sample");
                eprintln!("note: {samples} of `{}` not shown; the terminal was too slow", port.name());
            }
            if let Some(reason) = &seen.last_refusal {
                eprintln!("warning: `{}` carried something that is no sample of its type: {reason}", port.name());
            }
        }
        if ended == Ended::RunOver {
            bail!("the graph of robot `{}` has ended", self.run.file().robot);
        }
        let silent = summaries.iter().find(|summary| summary.count == 0);
        if let (Ended::TimeOver, Some(silent)) = (ended, silent) {
            bail!("nothing came on `{}`", silent.port);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Command, Key, Message, MessageType, Meta, Origins};

    use super::*;

    fn header(message_type: MessageType, seq: u64) -> Header {
        let (stamp, origins, meta) = (Stamp::ZERO, Origins::none(), Meta::new());
        Header { epoch: 0, seq, stamp, origins, message_type, meta }
    }

    fn recorder(limit: Option<u64>, queue: usize) -> (Recorder, mpsc::Receiver<Event>) {
        let (events, inbox) = mpsc::sync_channel(queue);
        let key = Key::new("car1", "decision", "command");
        let port = Port { key, message_type: "carril/Command".into(), on_demand: false, external_input: false };
        (Recorder::new(0, &port, &Arc::default(), limit, events), inbox)
    }

    #[test]
    fn counts_no_more_than_was_asked_for() {
        let (recorder, inbox) = recorder(Some(2), 8);
        (0..5).for_each(|seq| recorder.record(header(Command::TYPE, seq), Payload::default(), Stamp::ZERO));
        assert!(recorder.full(), "two are enough");
        assert_eq!(recorder.lock().total.summary().count, 2, "the rest is not counted");
        let arrivals = inbox.try_iter().filter(|event| matches!(event, Event::Arrival(_))).count();
        assert_eq!(arrivals, 2, "nor shown");
    }

    #[test]
    fn a_slow_terminal_loses_samples_but_no_numbers() {
        let (recorder, _inbox) = recorder(None, 1);
        (0..5).for_each(|seq| recorder.record(header(Command::TYPE, seq), Payload::default(), Stamp::ZERO));
        let seen = recorder.lock();
        assert_eq!((seen.total.summary().count, seen.not_shown), (5, 4), "all counted, one shown");
    }

    #[test]
    fn a_foreign_type_is_refused_and_named() {
        let (recorder, inbox) = recorder(None, 8);
        recorder.record(header(MessageType::new("acme/Radar", 1), 0), Payload::default(), Stamp::ZERO);
        let seen = recorder.lock();
        assert_eq!((seen.total.summary().count, seen.total.summary().refused), (0, 1), "refused, not counted");
        assert_eq!(seen.last_refusal.as_deref(), Some("it is a `acme/Radar v1`, expected `carril/Command`"), "reason");
        assert!(inbox.try_recv().is_err(), "nothing to show");
    }
}
