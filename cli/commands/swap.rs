//! `carril swap`, `shadow`, `rollback` and `restart`: another version of a node, or the same anew, while the car drives.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result};
use carril_runtime::control_plane::{Change, Outcome, Receipt, SwapRequest, SwapTerms};
use clap::Args;

use crate::common::graph_file::Shown;
use crate::common::live::Run;
use crate::common::way::Target;
use crate::common::{assignments, output, receipt, time};

/// What a candidate is, and how it is tried.
#[derive(Args)]
struct Candidate {
    /// The node
    #[arg(value_name = "NODE")]
    node: String,
    /// Another operator of carril with the same ports
    #[arg(long, value_name = "KIND", conflicts_with = "exec")]
    operator: Option<String>,
    /// A binary of your own with the same ports
    #[arg(long, value_name = "PATH")]
    exec: Option<PathBuf>,
    /// Other values in its configuration; may be given several times
    #[arg(long = "set", value_name = "PATH=VALUE[,...]")]
    values: Vec<String>,
    /// Begin without the state of the version before
    #[arg(long)]
    fresh: bool,
    /// Memory that a candidate in a process of its own may use
    #[arg(long, value_name = "MB", default_value_t = SwapTerms::default().memory_limit_mb)]
    memory_limit_mb: u64,
    /// A step that takes longer is a stall
    #[arg(long, value_name = "MS", default_value_t = SwapTerms::default().stall_ms)]
    stall_ms: u64,
    #[command(flatten)]
    answer: Answer,
}

/// How to answer.
#[derive(Args)]
struct Answer {
    /// The receipt as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    target: Target,
}

/// The conditions of a probation.
#[derive(Args)]
struct Probation {
    /// Outputs after which the version before is let go
    #[arg(long = "probation", value_name = "OUTPUTS", default_value_t = SwapTerms::default().probation_outputs)]
    outputs: u64,
}

/// Arguments of `carril swap`.
#[derive(Args)]
#[command(
    after_help = "The candidate runs in shadow first, then takes over between two messages, with the state, what waits and the
sequence numbers. Until its probation is over the version before is kept warm and takes over again should the candidate
panic, fail, stall, miss its deadline or die. Exit code 1 when it was refused or rolled back.

Examples:
  carril swap lane --set threshold=180,row_far=0.7
  carril swap lane --operator some-other-detector
  carril swap lane --exec ./target/release/my-lane --shadow 2s"
)]
pub struct SwapArgs {
    #[command(flatten)]
    candidate: Candidate,
    /// How long the candidate runs in shadow before it takes over
    #[arg(long, value_name = "TIME", default_value = "300ms", value_parser = time::parse_span)]
    shadow: Duration,
    #[command(flatten)]
    probation: Probation,
}

/// Arguments of `carril shadow`.
#[derive(Args)]
#[command(after_help = "The candidate gets the live inputs of the node; its outputs go nowhere and are compared.

Examples:
  carril shadow lane --set threshold=170 --seconds 10
  carril shadow lane --exec ./target/release/my-lane")]
pub struct ShadowArgs {
    #[command(flatten)]
    candidate: Candidate,
    /// For how long
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = time::parse_span)]
    seconds: Duration,
}

/// Arguments of `carril rollback`.
#[derive(Args)]
#[command(after_help = "Examples:
  carril rollback lane")]
pub struct RollbackArgs {
    /// The node
    #[arg(value_name = "NODE")]
    node: String,
    /// How long the version before runs in shadow before it takes over again
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = time::parse_span)]
    shadow: Duration,
    #[command(flatten)]
    probation: Probation,
    #[command(flatten)]
    answer: Answer,
}

/// Arguments of `carril restart`.
#[derive(Args)]
#[command(
    after_help = "A node that runs is replaced by a new instance of itself, between two messages and with its state, as in a swap. One that
gave up or was left down is started again, without its state; `carril swap` starts it as another version.

Examples:
  carril restart lane
  carril restart lane --fresh"
)]
pub struct RestartArgs {
    /// The node
    #[arg(value_name = "NODE")]
    node: String,
    /// Begin without the state of the instance before
    #[arg(long)]
    fresh: bool,
    #[command(flatten)]
    probation: Probation,
    #[command(flatten)]
    answer: Answer,
}

/// Runs `carril swap`.
pub fn swap(args: &SwapArgs) -> Result<()> {
    let terms = SwapTerms { probation_outputs: args.probation.outputs, ..terms(&args.candidate, args.shadow) };
    send(&Change::Swap(request(&args.candidate, terms)?), &args.candidate.answer)
}

/// Runs `carril shadow`.
pub fn shadow(args: &ShadowArgs) -> Result<()> {
    let terms = SwapTerms { compare_only: true, ..terms(&args.candidate, args.seconds) };
    send(&Change::Swap(request(&args.candidate, terms)?), &args.candidate.answer)
}

/// Runs `carril rollback`.
pub fn rollback(args: &RollbackArgs) -> Result<()> {
    let terms = SwapTerms {
        shadow_ms: args.shadow.as_millis() as u64,
        probation_outputs: args.probation.outputs,
        ..SwapTerms::default()
    };
    send(&Change::Rollback { node: args.node.clone(), terms }, &args.answer)
}

/// Runs `carril restart`.
pub fn restart(args: &RestartArgs) -> Result<()> {
    let terms = SwapTerms { probation_outputs: args.probation.outputs, ..SwapTerms::restart(args.fresh) };
    send(&Change::Restart { node: args.node.clone(), terms }, &args.answer)
}

fn terms(candidate: &Candidate, shadow: Duration) -> SwapTerms {
    SwapTerms {
        shadow_ms: shadow.as_millis() as u64,
        stall_ms: candidate.stall_ms,
        memory_limit_mb: candidate.memory_limit_mb,
        fresh: candidate.fresh,
        ..SwapTerms::default()
    }
}

fn request(candidate: &Candidate, terms: SwapTerms) -> Result<SwapRequest> {
    Ok(SwapRequest {
        node: candidate.node.clone(),
        operator: candidate.operator.clone(),
        exec: candidate.exec.as_deref().map(program).transpose()?,
        values: assignments::parse(&candidate.values)?,
        terms,
    })
}

/// The supervisor may have another working directory.
fn program(path: &Path) -> Result<PathBuf> {
    path.canonicalize().with_context(|| format!("`{}`: build it first, then give its path", path.display()))
}

fn send(change: &Change, answer: &Answer) -> Result<()> {
    let run = Run::connect(&answer.target)?;
    show(&run.change(change)?, answer.json)
}

/// Writes a receipt.
pub fn write(receipt: &Receipt, as_json: bool) -> Result<()> {
    if as_json { output::json_line(receipt) } else { output::line(receipt::text(receipt)) }
}

/// Writes a receipt; exit code 1 when the change did not go through.
pub fn show(receipt: &Receipt, as_json: bool) -> Result<()> {
    write(receipt, as_json)?;
    match receipt.outcome {
        Outcome::Done | Outcome::Compared | Outcome::Planned => Ok(()),
        Outcome::Refused | Outcome::RolledBack => Err(Shown.into()),
    }
}
