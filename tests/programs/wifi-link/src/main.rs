//! `wifi-link`: an emulated Wi-Fi link between two network namespaces, to try carril by hand over a bad link.
//!
//! This file reads the command line, prints, and waits for signals; the library does the rest.

use std::io::{self, Write};
use std::os::fd::AsFd;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};
use nix::errno::Errno;
use nix::libc;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::signal::{SigSet, Signal};
use nix::sys::signalfd::{SfdFlags, SignalFd};
use nix::sys::time::TimeSpec;
use wifi_link::{Conditions, Counters, Direction, LinkError, Medium, Queue, WifiLink};

const EXAMPLES: &str = "\
Examples:
  sudo wifi-link
      20 Mbit/s shared, 5 ± 3 ms, 2 % loss
  sudo wifi-link --rate 20mbit --delay 5ms --jitter 3ms --loss 2% --outage 10s@30s --verbose
      the same in numbers, with an outage of 10 s after 30 s, and counters
  sudo wifi-link --preset slow --queue 1s
      2 Mbit/s behind a queue that delays a full load by a second

In a second and a third shell, as root, with the names that wifi-link prints:
  ip netns exec carril-4711-car bash
  ip netns exec carril-4711-laptop bash

While it runs: Ctrl-C ends it and removes the namespaces; `kill -USR1 PID` cuts the link, `kill -USR2 PID` restores it.
Exit code: 0 ended by a signal, 1 the link is not possible or broke, 2 usage.";

/// Joins two network namespaces, a car's and a laptop's, by an emulated Wi-Fi link until Ctrl-C
///
/// IP packets, multicast too, pass with the given rate, delay, jitter, loss and outages, in order. Needs root, `ip` (package
/// iproute2) and /dev/net/tun.
#[derive(Parser)]
#[command(name = "wifi-link", version, max_term_width = 110, after_help = EXAMPLES)]
struct Arguments {
    /// Conditions to begin with; the options below change single ones
    #[arg(long, value_name = "NAME", default_value = "good")]
    preset: Preset,
    /// What goes through: bit, kbit, mbit or gbit per second, such as 2.5mbit, or `unlimited`
    #[arg(long, value_name = "RATE", value_parser = rate)]
    rate: Option<Rate>,
    /// Give each direction the whole rate, as a cable does, instead of letting both share it, as Wi-Fi does
    #[arg(long)]
    per_direction: bool,
    /// Time from the end of a packet's transmission to its arrival, such as 5ms
    #[arg(long, value_name = "TIME", value_parser = humantime::parse_duration)]
    delay: Option<Duration>,
    /// How far the delay varies to both sides, at most by the delay; packets keep their order
    #[arg(long, value_name = "TIME", value_parser = humantime::parse_duration)]
    jitter: Option<Duration>,
    /// Share of the packets that are lost, such as 2%
    #[arg(long, value_name = "SHARE", value_parser = share)]
    loss: Option<f64>,
    /// What may wait in each direction before packets are dropped: a time at the rate, such as 200ms, or bytes, such as 64kB
    #[arg(long, value_name = "LIMIT", value_parser = queue)]
    queue: Option<Queue>,
    /// An outage, its length and when it begins after the start, such as 10s@30s; may be given several times
    #[arg(long = "outage", value_name = "LENGTH@BEGIN", value_parser = outage)]
    outages: Vec<Outage>,
    /// The same seed loses and delays the n-th packet alike in each run
    #[arg(long, value_name = "NUMBER")]
    seed: Option<u64>,
    /// Print counters of both directions once a second
    #[arg(long, short)]
    verbose: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Preset {
    /// 20 Mbit/s shared, 5 ± 3 ms, 2 % loss, a queue of 200 ms
    Good,
    /// As good, with 2 Mbit/s
    Slow,
    /// No limit, no delay, no loss
    Perfect,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Rate(Option<u64>);

#[derive(Clone, Copy, Debug, PartialEq)]
struct Outage {
    length: Duration,
    begin: Duration,
}

impl Arguments {
    fn conditions(&self) -> Conditions {
        let preset = match self.preset {
            Preset::Good => Conditions::good(),
            Preset::Slow => Conditions::slow(),
            Preset::Perfect => Conditions::perfect(),
        };
        let delay = self.delay.unwrap_or(preset.delay);
        Conditions {
            rate_bit_s: self.rate.map_or(preset.rate_bit_s, |rate| rate.0),
            medium: if self.per_direction { Medium::PerDirection } else { preset.medium },
            delay,
            // Only what was asked for is an error: `--delay 1ms` alone takes the preset's jitter as far as it goes.
            jitter: self.jitter.unwrap_or(preset.jitter.min(delay)),
            loss: self.loss.unwrap_or(preset.loss),
            queue: self.queue.unwrap_or(preset.queue),
            seed: self.seed.unwrap_or(preset.seed),
        }
    }
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(Ending::Link(error)) => {
            eprintln!("error: {error}");
            let is_usage = matches!(error, LinkError::BadConditions(_));
            if is_usage {
                eprintln!("hint: `wifi-link --help` lists the options");
            }
            ExitCode::from(if is_usage { 2 } else { 1 })
        }
        Err(Ending::Broken(reason)) => {
            eprintln!("error: the link broke: {reason}");
            eprintln!("hint: start it again; the namespaces it made are removed");
            ExitCode::FAILURE
        }
    }
}

enum Ending {
    Link(LinkError),
    Broken(String),
}

impl From<LinkError> for Ending {
    fn from(error: LinkError) -> Self {
        Self::Link(error)
    }
}

impl From<Errno> for Ending {
    fn from(error: Errno) -> Self {
        Self::Broken(error.desc().to_owned())
    }
}

fn run(arguments: &Arguments) -> Result<(), Ending> {
    // Before there is anything to clean up, and before the first thread, which inherits it.
    let signals =
        SigSet::from_iter([Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP, Signal::SIGUSR1, Signal::SIGUSR2]);
    signals.thread_block()?;
    let signals = SignalFd::with_flags(&signals, SfdFlags::SFD_NONBLOCK | SfdFlags::SFD_CLOEXEC)?;

    let link = WifiLink::new(arguments.conditions())?;
    for outage in &arguments.outages {
        link.plan_outage(outage.begin, outage.length);
    }
    introduce(&link);
    report(&link, &signals, arguments.verbose)
}

/// Waits for signals, and prints counters, until one says to end.
fn report(link: &WifiLink, signals: &SignalFd, verbose: bool) -> Result<(), Ending> {
    const SECOND: Duration = Duration::from_secs(1);
    let started = Instant::now();
    let mut last = Direction::BOTH.map(|direction| link.counters(direction));
    for second in 1.. {
        while let Some(wait) = (second * SECOND).checked_sub(started.elapsed()).filter(|wait| !wait.is_zero()) {
            let mut fds = [PollFd::new(signals.as_fd(), PollFlags::POLLIN)];
            match ppoll(&mut fds, Some(TimeSpec::from_duration(wait)), None) {
                Ok(_) | Err(Errno::EINTR) => {}
                Err(error) => return Err(error.into()),
            }
            while let Some(signal) = signals.read_signal()? {
                match signal.ssi_signo as i32 {
                    libc::SIGUSR1 => {
                        link.cut();
                        say("cut; `kill -USR2` restores it");
                    }
                    libc::SIGUSR2 => {
                        link.restore();
                        say("restored");
                    }
                    _ => return Ok(()),
                }
            }
        }
        if let Some(reason) = link.failure() {
            return Err(Ending::Broken(reason));
        }
        if verbose {
            let now = Direction::BOTH.map(|direction| link.counters(direction));
            let state = if link.is_cut() { "cut " } else { "" };
            say(&format!("{second:>4} s  {state}car > laptop: {}", line(&now[0], &last[0])));
            say(&format!("        {state}laptop > car: {}", line(&now[1], &last[1])));
            last = now;
        }
    }
    Ok(())
}

fn introduce(link: &WifiLink) {
    for (name, host) in [("car", link.car()), ("laptop", link.laptop())] {
        say(&format!("{name:<7} {:<15} ip netns exec {} bash", host.address(), host.namespace()));
    }
    say(&format!("link    {}", described(&link.conditions())));
    say(&format!("Ctrl-C ends it; `kill -USR1 {0}` cuts the link, `kill -USR2 {0}` restores it", std::process::id()));
}

/// A reader that went away is no reason to take the link from those who use it.
fn say(line: &str) {
    let mut stdout = io::stdout();
    let _ = writeln!(stdout, "{line}").and_then(|()| stdout.flush());
}

fn described(conditions: &Conditions) -> String {
    let rate = conditions.rate_bit_s.map_or("no limit of the rate".to_owned(), |rate| {
        let medium = if conditions.medium == Medium::Shared { "shared" } else { "in each direction" };
        format!("{} Mbit/s {medium}", rate as f64 / 1e6)
    });
    let queue = match conditions.queue {
        Queue::Bytes(bytes) => format!("{bytes} bytes"),
        Queue::Time(time) => format!("{} ms", ms(time)),
    };
    let (delay, jitter) = (ms(conditions.delay), ms(conditions.jitter));
    format!("{rate}, {delay} ± {jitter} ms, {} % loss, queue {queue}", conditions.loss * 100.0)
}

fn ms(time: Duration) -> f64 {
    (time.as_secs_f64() * 1e6).round() / 1e3
}

/// Totals, and the rate since `last`, a second ago.
fn line(now: &Counters, last: &Counters) -> String {
    let mbit = (now.delivered_bytes - last.delivered_bytes) as f64 * 8.0 / 1e6;
    let refused = match now.refused_packets {
        0 => String::new(),
        packets => format!(", {packets} refused by the device, which is down"),
    };
    format!(
        "{mbit:.2} Mbit/s, {} of {} packets, {} bytes, {} lost, {} queue drops, {} in outages, queue {:.1} ms, {} late by up to {:.1} ms{refused}",
        now.delivered_packets,
        now.sent_packets,
        now.delivered_bytes,
        now.lost_packets,
        now.queue_drops,
        now.outage_drops,
        ms(now.queue_delay),
        now.late_packets,
        ms(now.worst_lateness),
    )
}

/// A number of at least 0 and its unit.
fn quantity(text: &str) -> Option<(f64, &str)> {
    let unit = text.find(|letter: char| letter != '.' && !letter.is_ascii_digit()).unwrap_or(text.len());
    let number = text[..unit].parse().ok().filter(|number: &f64| number.is_finite())?;
    Some((number, text[unit..].trim()))
}

fn rate(text: &str) -> Result<Rate, String> {
    let wanted = || "write a number above 0 and its unit, such as 20mbit or 500kbit, or `unlimited`".to_owned();
    if text == "unlimited" {
        return Ok(Rate(None));
    }
    let (number, unit) = quantity(text).ok_or_else(wanted)?;
    let factor = match unit.to_ascii_lowercase().trim_end_matches("/s") {
        "bit" => 1.0,
        "kbit" => 1e3,
        "mbit" => 1e6,
        "gbit" => 1e9,
        _ => return Err(wanted()),
    };
    let bit_s = (number * factor).round();
    if bit_s >= 1.0 { Ok(Rate(Some(bit_s as u64))) } else { Err(wanted()) }
}

fn share(text: &str) -> Result<f64, String> {
    let wanted = || "write a share from 0% to 100% with its percent sign, such as 2%".to_owned();
    match quantity(text) {
        Some((percent, "%")) if percent <= 100.0 => Ok(percent / 100.0),
        _ => Err(wanted()),
    }
}

fn queue(text: &str) -> Result<Queue, String> {
    if let Ok(time) = humantime::parse_duration(text) {
        return Ok(Queue::Time(time));
    }
    let wanted = || "write a time, such as 200ms, or bytes, such as 64kB or 1MB".to_owned();
    let (number, unit) = quantity(text).ok_or_else(wanted)?;
    let factor = match unit {
        "B" => 1.0,
        "kB" => 1e3,
        "MB" => 1e6,
        _ => return Err(wanted()),
    };
    Ok(Queue::Bytes((number * factor).round() as u64))
}

fn outage(text: &str) -> Result<Outage, String> {
    let wanted = "write its length, `@`, and when it begins, such as 10s@30s";
    let (length, begin) = text.split_once('@').ok_or(wanted)?;
    let time = |text: &str| humantime::parse_duration(text).map_err(|error| format!("`{text}`: {error}; {wanted}"));
    Ok(Outage { length: time(length)?, begin: time(begin)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        <Arguments as clap::CommandFactory>::command().debug_assert();
    }

    #[test]
    fn reads_rates() {
        for (text, bit_s) in
            [("20mbit", 20_000_000), ("2.5Mbit/s", 2_500_000), ("500 kbit", 500_000), ("1gbit", 1_000_000_000)]
        {
            assert_eq!(rate(text), Ok(Rate(Some(bit_s))), "{text}");
        }
        assert_eq!(rate("unlimited"), Ok(Rate(None)), "unlimited");
        for text in ["", "20", "0mbit", "-1mbit", "20mb", "mbit", "nanmbit", "infmbit", "1e9bit"] {
            assert!(rate(text).is_err(), "`{text}` was taken");
        }
    }

    #[test]
    fn reads_shares_with_their_percent_sign_only() {
        assert_eq!(share("2%"), Ok(0.02), "2%");
        assert_eq!(share("100 %"), Ok(1.0), "100 %");
        for text in ["2", "0.02", "101%", "-1%", "NaN%", "%", ""] {
            assert!(share(text).is_err(), "`{text}` was taken");
        }
    }

    #[test]
    fn reads_queues() {
        assert_eq!(queue("200ms"), Ok(Queue::Time(Duration::from_millis(200))), "200ms");
        assert_eq!(queue("64kB"), Ok(Queue::Bytes(64_000)), "64kB");
        for text in ["64", "64kb", "-1B", ""] {
            assert!(queue(text).is_err(), "`{text}` was taken");
        }
    }

    #[test]
    fn reads_outages() {
        let expected = Outage { length: Duration::from_secs(10), begin: Duration::from_secs(30) };
        assert_eq!(outage("10s@30s"), Ok(expected), "10s@30s");
        for text in ["10s", "10@30s", "@", "10s@"] {
            assert!(outage(text).is_err(), "`{text}` was taken");
        }
    }
}
