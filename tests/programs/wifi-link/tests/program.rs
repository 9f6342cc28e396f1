//! The program `wifi-link` as a user has it.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

fn program() -> Command {
    Command::new(env!("CARGO_BIN_EXE_wifi-link"))
}

/// Ends with the test, also when that fails; so that it cleans up after itself, it is only asked to.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // Before `wait`, the pid is its own or that of a zombie.
        if matches!(self.0.try_wait(), Ok(None)) {
            let _ = kill(Pid::from_raw(self.0.id() as i32), Signal::SIGTERM);
        }
        let _ = self.0.wait();
    }
}

#[test]
fn wrong_options_are_refused_with_what_to_write_instead() {
    let cases = [
        (&["--loss", "2"][..], "such as 2%"),
        (&["--rate", "20"], "such as 20mbit"),
        (&["--queue", "64"], "such as 200ms"),
        (&["--outage", "10s"], "such as 10s@30s"),
        (&["--delay", "1ms", "--jitter", "2ms"], "Allowed: 0 to the delay"),
    ];
    for (arguments, expected) in cases {
        let output = program().args(arguments).output().expect("it was built");
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(expected), "{arguments:?}: no `{expected}` in: {said}");
    }
}

#[test]
fn runs_until_it_is_interrupted_and_leaves_nothing() {
    let child = program()
        .args([
            "--rate",
            "2mbit",
            "--delay",
            "5ms",
            "--jitter",
            "3ms",
            "--loss",
            "2%",
            "--outage",
            "10s@30s",
            "--verbose",
            "--",
        ])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn();
    let mut child = Running(child.expect("it was built"));
    let mut lines =
        BufReader::new(child.0.stdout.take().expect("it is piped")).lines().map(|line| line.expect("it is text"));
    let Some(first) = lines.next() else {
        let mut said = String::new();
        child.0.stderr.take().expect("it is piped").read_to_string(&mut said).expect("it is text");
        assert!(said.contains("not possible here"), "it ended: {said}");
        return eprintln!("skipped: {said}");
    };
    let pid = Pid::from_raw(child.0.id() as i32);
    let (car, laptop) = (format!("carril-{pid}-car"), format!("carril-{pid}-laptop"));
    assert!(first.contains(&car), "no `{car}` in: {first}");
    let second = lines.next().expect("a line of the laptop");
    assert!(second.contains(&laptop), "no `{laptop}` in: {second}");
    let third = lines.next().expect("a line of the link");
    assert_eq!(third, "link    2 Mbit/s shared, 5 ± 3 ms, 2 % loss, queue 200 ms", "the conditions");
    lines.find(|line| line.contains("car > laptop")).expect("counters once a second");
    for (signal, expected) in [(Signal::SIGUSR1, "cut"), (Signal::SIGUSR2, "restored")] {
        kill(pid, signal).expect("it runs");
        lines.find(|line| line.starts_with(expected)).unwrap_or_else(|| panic!("it does not say `{expected}`"));
    }
    kill(pid, Signal::SIGINT).expect("it runs");
    assert_eq!(lines.find(|line| line.starts_with("error")), None, "to the end of its output");
    assert_eq!(child.0.wait().expect("it ends").code(), Some(0), "an interrupt is how it ends");
    let left = Command::new("ip").args(["netns", "list"]).output().expect("a link was made with it").stdout;
    let left = String::from_utf8_lossy(&left);
    assert!(!left.contains(&car) && !left.contains(&laptop), "it left {left}");
}
