//! What runs beside a graph to reach other machines, in words: the gateway of a car, or the link of another machine to it.

use std::io::IsTerminal;

use anyhow::Result;
use carril_dashboard::gateway::GATEWAY;
use carril_dashboard::machine::link;
use carril_runtime::graph::remote::{Remote, RemoteRates};
use serde_json::{Value, json};

use super::companion::{Companion, News};
use crate::commands::gateway::Reachable;

/// The name of the link in logs; no process of a graph can have it.
const LINK: &str = "_link";

/// The process beside a run.
pub enum Outside {
    /// Of the car.
    Gateway(Companion<Reachable>),
    /// Of another machine.
    Link(Companion<link::News>),
}

/// Something that it said.
pub struct Told {
    /// For programs.
    pub json: Value,
    /// For people.
    pub text: String,
    /// Also where nothing but what matters is said.
    pub always: bool,
}

impl Outside {
    /// Starts the gateway for the run of `robot`.
    pub fn gateway(robot: &str, remote: &Remote) -> Result<Self> {
        let remote = serde_json::to_string(remote)?;
        let arguments = ["gateway", "--robot", robot, "--remote", &remote, "--json"];
        Ok(Self::Gateway(Companion::start(arguments.map(str::to_owned).to_vec())?))
    }

    /// Starts the link for the run of `robot` on `machine`.
    pub fn link(robot: &str, machine: &str, connect: Option<&str>, rates: RemoteRates) -> Result<Self> {
        let rates = serde_json::to_string(&rates)?;
        let mut arguments = vec!["machine", machine, "--robot", robot, "--rates", &rates];
        arguments.extend(connect.iter().flat_map(|at| ["--connect", at]));
        Ok(Self::Link(Companion::start(arguments.into_iter().map(str::to_owned).collect())?))
    }

    /// The next thing that it said, if there is any.
    pub fn told(&self) -> Option<Told> {
        match self {
            Self::Gateway(gateway) => gateway.news().map(|news| match news {
                News::Said(at) => reachable(&at),
                News::Line(text) => line(GATEWAY, "gateway", &text),
                News::Died { how, again } => {
                    let lost = "the car cannot be reached from other machines";
                    died("gateway", &how, again, lost)
                }
            }),
            Self::Link(link) => link.news().map(|news| match news {
                News::Said(news) => joined(&news),
                News::Line(text) => line(LINK, "link", &text),
                News::Died { how, again } => died("link", &how, again, "the car does without this machine"),
            }),
        }
    }
}

fn reachable(at: &Reachable) -> Told {
    let code = at.dashboard.first().filter(|_| std::io::stderr().is_terminal()).and_then(|url| qr_code(url));
    let text = format!("{}{}", at.text(), code.map(|code| format!("\n{code}")).unwrap_or_default());
    Told { json: json!({ "kind": "reachable", "at": at }), text, always: false }
}

fn joined(news: &link::News) -> Told {
    let (text, always) = match news {
        link::News::Joined => ("joined the car".to_owned(), false),
        link::News::Apart { why } => (format!("not joined: {why}; trying again"), true),
    };
    Told { json: json!({ "kind": "link", "news": news }), text, always }
}

fn line(process: &str, shown: &str, text: &str) -> Told {
    let json = json!({ "kind": "line", "process": process, "text": text });
    Told { json, text: format!("[{shown}] {text}"), always: true }
}

fn died(what: &str, how: &str, again: bool, lost: &str) -> Told {
    let then = if again { "it starts again".to_owned() } else { format!("and stays down: {lost}") };
    let text =
        if again { format!("the {what} died ({how}); {then}") } else { format!("the {what} died ({how}) {then}") };
    Told { json: json!({ "kind": format!("{what}-died"), "how": how, "again": again }), text, always: true }
}

/// For the camera of a phone.
fn qr_code(text: &str) -> Option<String> {
    let code = qrcode::QrCode::new(text).ok()?;
    Some(code.render::<qrcode::render::unicode::Dense1x2>().quiet_zone(true).build())
}
