//! `carril scenarios shrink`: from a drive that fails to the smallest scenario in which it still fails, as a file.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail};
use carril_runtime::Registry;
use carril_runtime::executor::lockstep::Lockstep;
use carril_runtime::graph::Graph;
use carril_runtime::parameters::value_at;
use carril_runtime::scenario::{Amount, Drawn, Scenario, Success};
use clap::Args;
use indicatif::ProgressBar;
use serde_json::Value;

use super::drive::{Onlooker, Outcome, drive, reasons_now};
use super::regression;
use crate::common::lockstep::SLICE;
use crate::common::report::Report;
use crate::common::{interrupt, output, progress};

/// How the progress looks. How many drives it takes is not known before.
const BAR: &str = "{spinner} {pos} drives  {elapsed_precise}  {msg}";
/// A drive goes on for this long after it has failed, s.
const AFTER_FAILURE_S: f64 = 0.5;
/// So often a number is moved halfway to its default.
const HALVINGS: usize = 4;

/// Arguments of `carril scenarios shrink`.
#[derive(Args)]
#[command(
    after_help = "Reasons are of the same kind when they differ in numbers only. The file has a fixed seed and nothing that varies; \
`carril scenarios run` of it fails until the fault is mended.

Examples:
  carril scenarios shrink lanes --seed 417
  carril scenarios shrink scenarios/lanes.yaml --seed 417 --out scenarios/departs.yaml"
)]
pub struct ShrinkArgs {
    /// The scenario file, or its name in scenarios/
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Seed of a drive that fails, as a series names it
    #[arg(long)]
    seed: u64,
    /// Where the small scenario is written to [default: FILE-SEED.yaml beside the scenario]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// A scenario that is made smaller.
struct Shrinker<'a> {
    registry: &'a Registry,
    stop: &'a AtomicBool,
    bar: ProgressBar,
    /// The smallest so far that fails.
    best: Scenario,
    /// What was drawn and is still set.
    drawn: Vec<String>,
    /// Of the reason that must stay.
    kind: String,
    /// When that reason came to stay, in the last drive that failed. `None`: it was there from the beginning.
    since_s: Option<f64>,
    reason: String,
    drives: u64,
    /// What was done, for people.
    notes: Vec<String>,
}

/// Runs it.
pub fn run(args: &ShrinkArgs, registry: &Registry) -> Result<ExitCode> {
    let scenario = super::read(&args.file, registry)?;
    let out = args.out.clone().unwrap_or_else(|| beside(&scenario.path, args.seed));
    if out.exists() {
        bail!("`{}` exists already; remove it, or name another file with --out", out.display());
    }
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    interrupt::on_interrupt(move || stopped.store(true, Ordering::Relaxed))?;
    let mut shrinker = Shrinker::new(&scenario, args.seed, registry, &stop)?;
    shrinker.shrink()?;
    let comments = shrinker.comments(&scenario, args.seed);
    let text = regression::text(&shrinker.best, &out, &comments)?;
    shrinker.prove(&text, &out)?;
    shrinker.bar.finish_and_clear();
    std::fs::write(&out, text).with_context(|| format!("cannot write `{}`", out.display()))?;
    output::text(shrinker.report(&scenario, args.seed, &out))?;
    Ok(ExitCode::SUCCESS)
}

fn beside(path: &Path, seed: u64) -> PathBuf {
    let name = path.file_stem().map_or_else(|| "scenario".into(), |name| name.to_string_lossy());
    path.with_file_name(format!("{name}-{seed}.yaml"))
}

/// What a reason says, without its numbers: `# departures, allowed are #`.
fn kind_of(reason: &str) -> String {
    let mut kind = String::new();
    let mut rest = reason.chars().peekable();
    while let Some(letter) = rest.next() {
        let is_sign =
            letter == '-' && rest.peek().is_some_and(char::is_ascii_digit) && !kind.ends_with(char::is_alphanumeric);
        if !letter.is_ascii_digit() && !is_sign {
            kind.push(letter);
            continue;
        }
        while rest.next_if(|next| next.is_ascii_digit() || *next == '.').is_some() {}
        kind.push('#');
    }
    kind
}

/// The drive with this seed as a scenario of its own, in which nothing varies.
fn concrete(scenario: &Scenario, seed: u64, drawn: &Drawn) -> Scenario {
    let mut set = scenario.set.clone();
    set.extend(drawn.values.iter().map(|(key, value)| (key.clone(), value.clone())));
    let fixed = |(node, ms): (&String, &Value)| (node.clone(), Amount::Fixed(ms.as_f64().unwrap_or_default()));
    Scenario {
        seed: Some(scenario.noise_seed(seed)),
        set,
        vary: Vec::new(),
        latency: drawn.latency_ms.iter().map(fixed).collect(),
        ..scenario.clone()
    }
}

/// Sees when a kind of reason comes to stay.
struct Watch<'a> {
    success: &'a Success,
    kind: &'a str,
    since_s: Option<f64>,
    now_s: f64,
}

impl Onlooker for Watch<'_> {
    fn look(&mut self, lockstep: &Lockstep, graph: &Graph) -> Result<()> {
        self.now_s = lockstep.now().as_secs_f64();
        let there = reasons_now(self.success, lockstep, graph).iter().any(|reason| kind_of(reason) == self.kind);
        self.since_s = there.then(|| self.since_s.unwrap_or(self.now_s));
        Ok(())
    }
}

impl<'a> Shrinker<'a> {
    /// Drives once as it was drawn, and once as a scenario of its own: both must fail in the same way.
    fn new(scenario: &Scenario, seed: u64, registry: &'a Registry, stop: &'a AtomicBool) -> Result<Self> {
        let Some(first) = drive(scenario, None, seed, registry, stop, &mut ()) else { bail!(STOPPED) };
        let Some(reason) = first.reasons.first().cloned() else {
            let path = scenario.path.display();
            bail!(
                "the drive with seed {seed} of `{path}` succeeds: there is nothing to shrink; `carril scenarios run` names the seeds that fail"
            );
        };
        let drawn = first.drawn.values.keys().cloned();
        let mut shrinker = Self {
            registry,
            stop,
            bar: progress::bar(0, BAR)?,
            best: concrete(scenario, seed, &first.drawn),
            drawn: drawn.collect(),
            kind: kind_of(&reason),
            since_s: None,
            reason,
            drives: 1,
            notes: Vec::new(),
        };
        let (again, since_s) = shrinker.drive(&shrinker.best.clone())?;
        if again.reasons != first.reasons || again.hash != first.hash {
            bail!(
                "the drive with seed {seed} does not come out the same a second time: some node is not deterministic"
            );
        }
        shrinker.since_s = since_s;
        Ok(shrinker)
    }

    fn drive(&mut self, candidate: &Scenario) -> Result<(Outcome, Option<f64>)> {
        let mut watch = Watch { success: &candidate.success, kind: &self.kind, since_s: None, now_s: 0.0 };
        let seed = candidate.seed.unwrap_or_default();
        let Some(outcome) = drive(candidate, None, seed, self.registry, self.stop, &mut watch) else { bail!(STOPPED) };
        self.drives += 1;
        self.bar.inc(1);
        // What ends a drive at once is never looked at.
        let slice_s = SLICE.as_secs_f64();
        let since_s = watch.since_s.unwrap_or(watch.now_s + slice_s);
        Ok((outcome, (since_s > 1.5 * slice_s).then_some(since_s)))
    }

    /// Keeps the candidate if it still fails for the same kind of reason.
    fn keep(&mut self, candidate: Scenario) -> Result<bool> {
        let (outcome, since_s) = self.drive(&candidate)?;
        let Some(reason) = outcome.reasons.into_iter().find(|reason| kind_of(reason) == self.kind) else {
            return Ok(false);
        };
        (self.best, self.since_s, self.reason) = (candidate, since_s, reason);
        Ok(true)
    }

    fn shrink(&mut self) -> Result<()> {
        self.bar.set_message("leaving out");
        while self.leave_out()? {}
        self.shorten()?;
        self.bar.set_message("simplifying numbers");
        self.simplify()?;
        self.shorten()?;
        self.bar.set_message("conditions");
        self.need_less()
    }

    /// Without one of the values that were drawn, or without a latency: the graph's own is taken. Gives whether something went.
    fn leave_out(&mut self) -> Result<bool> {
        let mut went = false;
        for key in self.drawn.clone() {
            let mut candidate = self.best.clone();
            candidate.set.retain(|(set, _)| *set != key);
            let value = self.value(&key);
            if self.keep(candidate)? {
                self.drawn.retain(|drawn| *drawn != key);
                self.notes.push(format!("left out: {key} ({value})"));
                went = true;
            }
        }
        for (node, ms) in self.best.latency.clone() {
            let mut candidate = self.best.clone();
            candidate.latency.retain(|(other, _)| *other != node);
            if self.keep(candidate)? {
                self.notes.push(format!("left out: latency of {node} ({} ms)", ms.draw(0, "")));
                went = true;
            }
        }
        Ok(went)
    }

    fn value(&self, key: &str) -> Value {
        let set = self.best.set.iter().rfind(|(set, _)| set == key);
        set.map(|(_, value)| value.clone()).unwrap_or_default()
    }

    /// Until just after the failure; not if the reason is there from the beginning, like a way that is too short.
    fn shorten(&mut self) -> Result<()> {
        let Some(since_s) = self.since_s else { return Ok(()) };
        let seconds = ((since_s + AFTER_FAILURE_S) * 10.0).round() / 10.0;
        if seconds >= self.best.seconds {
            return Ok(());
        }
        let before_s = self.best.seconds;
        let success = Success { laps_min: None, ..self.best.success.clone() };
        // A drive so short ends by its time.
        let shorter = Scenario { seconds, laps: None, success, ..self.best.clone() };
        if self.keep(shorter)? {
            self.notes.push(format!("shortened: {before_s} s to {seconds} s"));
        }
        Ok(())
    }

    /// Numbers with fewer digits, nearer to what the graph has.
    fn simplify(&mut self) -> Result<()> {
        let defaults = self.defaults();
        for key in self.drawn.clone() {
            let (Value::Number(before), whole) = (self.value(&key), self.value(&key).is_i64()) else { continue };
            let default = defaults.as_ref().and_then(|graph| {
                let (node, path) = key.split_once('.')?;
                value_at(&graph.nodes.iter().find(|other| other.name == node)?.config, path)?.as_f64()
            });
            let set = |scenario: &mut Scenario, number: f64| {
                let value = if whole { Value::from(number as i64) } else { Value::from(number) };
                scenario.set.iter_mut().filter(|(set, _)| *set == key).for_each(|(_, old)| *old = value.clone());
            };
            self.simplify_one(before.as_f64().unwrap_or_default(), default, whole, &key, &set)?;
        }
        for (node, ms) in self.best.latency.clone() {
            let own = |graph: &Graph| Some(graph.nodes.iter().find(|other| other.name == node)?.modelled_latency);
            let default = defaults.as_ref().and_then(own).map(|latency| latency.as_secs_f64() * 1e3);
            let set = |scenario: &mut Scenario, number: f64| {
                let latency = scenario.latency.iter_mut().filter(|(other, _)| *other == node);
                latency.for_each(|(_, old)| *old = Amount::Fixed(number));
            };
            self.simplify_one(ms.draw(0, ""), default, false, &format!("latency of {node}"), &set)?;
        }
        Ok(())
    }

    fn simplify_one(
        &mut self,
        before: f64,
        default: Option<f64>,
        whole: bool,
        name: &str,
        set: &dyn Fn(&mut Scenario, f64),
    ) -> Result<()> {
        let mut now = before;
        for _ in 0..HALVINGS {
            let Some(default) = default else { break };
            let halfway = with_digits(default + (now - default) / 2.0, 2);
            let halfway = if whole { halfway.round() } else { halfway };
            if !self.try_number(&mut now, halfway, set)? {
                break;
            }
        }
        for digits in 1..=4 {
            let shorter = with_digits(now, digits);
            if shorter == now || (whole && shorter.fract() != 0.0) || self.try_number(&mut now, shorter, set)? {
                break;
            }
        }
        if now != before {
            self.notes.push(format!("simplified: {name} from {before} to {now}"));
        }
        Ok(())
    }

    fn try_number(&mut self, now: &mut f64, number: f64, set: &dyn Fn(&mut Scenario, f64)) -> Result<bool> {
        if number == *now {
            return Ok(false);
        }
        let mut candidate = self.best.clone();
        set(&mut candidate, number);
        let kept = self.keep(candidate)?;
        if kept {
            *now = number;
        }
        Ok(kept)
    }

    /// The graph without what was drawn.
    fn defaults(&self) -> Option<Graph> {
        let mut plain = self.best.clone();
        plain.set.retain(|(key, _)| !self.drawn.contains(key));
        plain.graph_of(&Drawn::default(), self.registry).ok()
    }

    /// Without the conditions of success that have nothing to do with the failure.
    fn need_less(&mut self) -> Result<()> {
        let Value::Object(conditions) = serde_json::to_value(&self.best.success)? else { return Ok(()) };
        let mut left = conditions.clone();
        for key in conditions.keys() {
            let mut fewer = left.clone();
            fewer.remove(key);
            let success: Success = serde_json::from_value(Value::Object(fewer.clone()))?;
            if success == self.best.success {
                continue;
            }
            if self.keep(Scenario { success, ..self.best.clone() })? {
                self.notes.push(format!("not asked: {key}"));
                left = fewer;
            }
        }
        Ok(())
    }

    /// The file is read and driven: it must fail as what it was made of.
    fn prove(&mut self, text: &str, out: &Path) -> Result<()> {
        let scenario = Scenario::parse(text.to_owned(), out, self.registry)
            .map_err(|problems| anyhow::anyhow!("{}", problems.render(false)))
            .context("the small scenario cannot be read again")?;
        if !self.keep(scenario)? {
            bail!("the small scenario does not fail once it is written; please report this");
        }
        Ok(())
    }

    fn comments(&self, scenario: &Scenario, seed: u64) -> Vec<String> {
        let mut comments = vec![
            format!(
                "A drive of {} (seed {seed}) that fails, made as small as it goes by `carril scenarios shrink`",
                scenario.path.display()
            ),
            // One more, when the file is read again.
            format!("in {} drives. It fails with: {}", self.drives + 1, self.reason),
        ];
        comments.extend(self.notes.iter().cloned());
        comments
    }

    fn report(&self, scenario: &Scenario, seed: u64, out: &Path) -> Report {
        let mut report = Report::default();
        report.fact("scenario", format_args!("{}, seed of the drive {seed}", scenario.path.display()));
        report.fact("drives", self.drives);
        report.fact("fails with", &self.reason);
        report.fact("kind", &self.kind);
        for note in &self.notes {
            let (what, detail) = note.split_once(": ").unwrap_or(("", note));
            report.fact(what, detail);
        }
        let set = self.best.set.iter().filter(|(key, _)| self.drawn.contains(key));
        for (key, value) in set {
            report.fact("needed", format_args!("{key}: {value}"));
        }
        for (node, ms) in &self.best.latency {
            report.fact("needed", format_args!("latency of {node}: {} ms", ms.draw(0, "")));
        }
        report.fact("written", out.display());
        report
    }
}

const STOPPED: &str = "stopped before the end; nothing was written";

/// Rounded to so many significant digits.
fn with_digits(number: f64, digits: usize) -> f64 {
    format!("{number:.*e}", digits.saturating_sub(1)).parse().unwrap_or(number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_are_of_a_kind_when_only_numbers_differ() {
        assert_eq!(kind_of("2 departures, allowed are 0"), "# departures, allowed are #", "counts");
        assert_eq!(kind_of("at 1.25 s: -3.5 m"), kind_of("at 13 s: 2 m"), "signs and points");
        assert_ne!(kind_of("1 departures, allowed are 0"), kind_of("1 contacts, allowed are 0"), "words differ");
        assert_eq!(kind_of("lane-lost"), "lane-lost", "a hyphen is no sign");
    }

    #[test]
    fn numbers_lose_digits() {
        assert_eq!([1, 2, 3].map(|digits| with_digits(0.071_234_5, digits)), [0.07, 0.071, 0.0712], "below 1");
        assert_eq!(with_digits(-123.0, 1), -100.0, "above 1");
    }
}
