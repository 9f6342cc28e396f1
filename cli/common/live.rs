//! A running graph, as the commands see it: what it is made of, its ports, its status, and words to it.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use carril_messages::{Control, Header, MessageType, Payload};
use carril_runtime::client::{Client, ExternalPublisher};
use carril_runtime::control_plane::{
    ApplyReceipt, ApplyRequest, Change, ControlReply, LiveGraph, Receipt, RunFile, Status,
};
use carril_runtime::transport::Guard;

use super::ports::Port;
use super::watch::Recorder;
use super::way::{self, Target};
use super::{drive, output, time};

/// The supervisor says how everything is once a second.
const STATUS_PERIOD: Duration = Duration::from_millis(1500);

/// A running graph.
pub struct Run {
    client: Client,
    file: RunFile,
}

impl Run {
    /// The graph that is meant: on this machine, or on another one.
    pub fn connect(target: &Target) -> Result<Self> {
        let client = way::connect(target)?;
        // Without a supervisor, what it wrote last must do.
        let file = client.run().unwrap_or_else(|_| client.file().clone());
        Ok(Self { client, file })
    }

    /// The way into it.
    pub fn client(&self) -> &Client {
        &self.client
    }

    /// What it is made of.
    pub fn file(&self) -> &RunFile {
        &self.file
    }

    /// Whether it still runs.
    pub fn is_alive(&self) -> bool {
        self.client.supervisor_is_alive()
    }

    /// Hears a port until the guard is dropped.
    pub fn subscribe(&self, port: &Port, recorder: Arc<Recorder>) -> Result<Guard> {
        let hear = move |header, payload, arrived| recorder.record(header, payload, arrived);
        Ok(self.client.subscribe(&port.key.node, &port.key.port, hear)?)
    }

    /// Hears every sample of a port until the guard is dropped, on a thread of the transport.
    pub fn hear(&self, port: &Port, hear: impl Fn(Header, Payload) + Send + Sync + 'static) -> Result<Guard> {
        Ok(self.client.subscribe(&port.key.node, &port.key.port, move |header, payload, _| hear(header, payload))?)
    }

    /// Asks for a change of the graph, and waits for its receipt.
    pub fn change(&self, change: &Change) -> Result<Receipt> {
        Ok(self.client.change(change)?)
    }

    /// Asks for the running graph to become another one, or what would be done, and waits for the receipt.
    pub fn apply(&self, request: &ApplyRequest) -> Result<ApplyReceipt> {
        Ok(self.client.apply(request)?)
    }

    /// The next status, if one comes in time.
    pub fn next_status(&self, timeout: Duration) -> Option<Status> {
        self.client.next_status(timeout)
    }

    /// The last status that came, if any yet.
    pub fn last_status(&self) -> Option<Status> {
        self.client.status()
    }

    /// A status, at once or within the second and a half in which the next one comes.
    pub fn status(&self) -> Status {
        self.client.status().or_else(|| self.client.next_status(STATUS_PERIOD)).unwrap_or_default()
    }

    /// Why nothing may have come on a port: what its node does.
    pub fn explain_silence(&self, port: &Port) -> String {
        if port.external_input {
            return "`carril pub` writes it, and nobody has yet".to_owned();
        }
        silence(&self.status(), &port.key.node)
    }

    /// Says a word to every node. An answer, or an error, from each process that heard it.
    pub fn control(&self, word: Control) -> Result<Vec<Result<ControlReply, String>>> {
        Ok(self.client.control(word)?)
    }

    /// The graph as it runs now, with every configuration.
    pub fn graph(&self) -> Result<LiveGraph> {
        Ok(self.client.graph()?)
    }

    /// Opens an input that is open to people.
    pub fn publisher(&self, node: &str, port: &str, message_type: MessageType) -> ExternalPublisher {
        self.client.publisher(node, port, message_type)
    }
}

fn silence(status: &Status, node: &str) -> String {
    let Some(health) = status.nodes.iter().find(|health| health.node == node) else {
        return format!("node `{node}` has not reported yet");
    };
    let state = drive::state_name(health.state);
    let steps = output::counted(health.steps, "step");
    let up = time::clock(status.uptime_s);
    let error = health.last_error.as_ref().map(|error| format!("; its last error: {error}")).unwrap_or_default();
    format!("node `{node}` is {state}, {steps} so far, graph up {up}{error}")
}

#[cfg(test)]
mod tests {
    use carril_messages::{Health, NodeState};

    use super::*;

    #[test]
    fn silence_is_explained_by_the_state_of_the_node() {
        let (node, state, last_error) = ("lane".to_owned(), NodeState::GaveUp, Some("no camera".to_owned()));
        let nodes = vec![Health { node, state, last_error, ..Health::default() }];
        let status = Status { uptime_s: 75.0, nodes, fault: None, machines: Vec::new() };
        let expected = "node `lane` is gave up, 0 steps so far, graph up 1:15; its last error: no camera";
        assert_eq!(silence(&status, "lane"), expected, "state and error");
        assert_eq!(silence(&status, "gps"), "node `gps` has not reported yet", "nothing known");
    }
}
