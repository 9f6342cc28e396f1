//! `carril start`, `stop`, `estop` and `reset`: a word to every node of the car, and who confirmed it.

use anyhow::{Result, bail};
use carril_messages::Control;
use carril_runtime::control_plane::ControlReply;
use clap::Args;
use serde_json::json;

use crate::common::live::Run;
use crate::common::output;

/// Arguments of the four commands.
#[derive(Args)]
pub struct ControlArgs {
    /// Who confirmed and who did not, as JSON
    #[arg(long)]
    json: bool,
    /// Which robot, where several graphs run
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
}

/// Runs one of them.
pub fn run(args: &ControlArgs, word: Control) -> Result<()> {
    let run = Run::connect(args.robot.as_deref())?;
    let replies = run.control(word)?;
    let expected: Vec<&str> = run.file().processes.iter().map(|process| process.name.as_str()).collect();
    let missing = missing(&expected, &replies);
    if args.json {
        output::json_line(&json!({ "word": word, "confirmed": replies, "missing": missing }))?;
    } else {
        output::line(confirmed(word, &replies))?;
    }
    if missing.is_empty() {
        return Ok(());
    }
    let names = missing.join(", ");
    match word {
        Control::EStop => bail!("`estop` was not confirmed by {names}\nhint: cut the power; then see `carril top`"),
        _ => bail!("`{word}` was not confirmed by {names}\nhint: see `carril top` for what is down"),
    }
}

fn missing<'a>(expected: &[&'a str], replies: &[ControlReply]) -> Vec<&'a str> {
    let silent = |name: &&&str| !replies.iter().any(|reply| reply.process == **name);
    expected.iter().filter(silent).copied().collect()
}

fn confirmed(word: Control, replies: &[ControlReply]) -> String {
    let names: Vec<&str> = replies.iter().map(|reply| reply.process.as_str()).collect();
    let nodes: usize = replies.iter().map(|reply| reply.nodes.len()).sum();
    let nodes = output::counted(nodes as u64, "node");
    let processes = output::counted(replies.len() as u64, "process");
    format!("{word}: confirmed by {nodes} in {processes}: {}", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_silent_process_is_named() {
        let reply = ControlReply { process: "bridge".into(), nodes: vec!["bridge".into()] };
        assert_eq!(missing(&["bridge", "vision"], std::slice::from_ref(&reply)), ["vision"], "it did not answer");
        assert_eq!(confirmed(Control::EStop, &[reply]), "estop: confirmed by 1 node in 1 process: bridge", "text");
    }
}
