//! Sets parameters of the running graph for those who may, one wish after the other, and says what came of it.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};

use carril_runtime::control_plane::{Change, Outcome};
use foxglove::websocket::{AnyClient, GetParametersResponder, Parameter, ParameterHandler, SetParametersResponder};

use super::hub::{Hub, lock, refuse, warn};
use super::parameters::{self, Wish};

/// So many wishes may wait; further ones are refused. A change takes a fraction of a second as a rule.
const MOST_WAITING: usize = 16;

/// What Foxglove calls when somebody asks for parameters or sets them. Returns at once.
pub struct Handler {
    hub: Arc<Hub>,
    wishes: SyncSender<Asked>,
}

struct Asked {
    client: AnyClient,
    parameters: Vec<Parameter>,
    responder: SetParametersResponder,
}

impl Handler {
    /// With the thread that carries wishes out. It ends with the handler.
    pub fn start(hub: Arc<Hub>) -> Self {
        let (wishes, coming) = sync_channel(MOST_WAITING);
        let own = Arc::clone(&hub);
        std::thread::spawn(move || carry_out_all(&own, &coming));
        Self { hub, wishes }
    }
}

impl ParameterHandler for Handler {
    fn get(&self, _client: AnyClient, names: Vec<String>, _id: Option<String>, responder: GetParametersResponder) {
        self.hub.question(names, responder);
    }

    fn set(
        &self,
        client: AnyClient,
        parameters: Vec<Parameter>,
        _id: Option<String>,
        responder: SetParametersResponder,
    ) {
        let asked = Asked { client, parameters, responder };
        if !self.hub.options.may_control {
            return asked.refuse_all(&self.hub, "this server only shows; start it with the right to control");
        }
        match self.wishes.try_send(asked) {
            Ok(()) => {}
            Err(TrySendError::Full(asked)) => asked.refuse_all(&self.hub, "too many changes at a time; try again"),
            Err(TrySendError::Disconnected(asked)) => asked.refuse_all(&self.hub, "the server ends"),
        }
    }
}

fn carry_out_all(hub: &Hub, coming: &Receiver<Asked>) {
    while let Ok(asked) = coming.recv() {
        let (wishes, refused) = parameters::wishes(&asked.parameters, &lock(&hub.parameters));
        for (name, reason) in refused {
            refuse(&asked.client, hub, &name, &reason);
        }
        for wish in wishes {
            carry_out(hub, &asked.client, wish);
        }
        // What is in force now, whatever came of the wishes.
        match hub.client.graph() {
            Ok(graph) => hub.learn(parameters::of_graph(&graph.nodes)),
            Err(error) => hub.complain("graph", &error.to_string()),
        }
        asked.answer(hub);
    }
}

fn carry_out(hub: &Hub, client: &AnyClient, wish: Wish) {
    let Wish { node, values } = wish;
    let names: Vec<String> = values.keys().map(|path| format!("{node}.{path}")).collect();
    match hub.client.change(&Change::Set { node, values }) {
        Ok(receipt) if receipt.outcome == Outcome::Done => {}
        // The run's own log tells of every receipt.
        Ok(receipt) => warn(client, &names.join(", "), receipt.reason.as_deref().unwrap_or("it was taken back")),
        Err(error) => refuse(client, hub, &names.join(", "), &error.to_string()),
    }
}

impl Asked {
    fn refuse_all(self, hub: &Hub, reason: &str) {
        let names: Vec<&str> = self.parameters.iter().map(|one| one.name.as_str()).collect();
        refuse(&self.client, hub, &names.join(", "), reason);
        self.answer(hub);
    }

    /// With the values in force: to who asked, and to all who follow these parameters, so that nobody shows a wish as a fact.
    fn answer(self, hub: &Hub) {
        let names: Vec<String> = self.parameters.into_iter().map(|one| one.name).collect();
        // No name would mean all of them.
        let in_force = if names.is_empty() { Vec::new() } else { hub.in_force(&names) };
        hub.with_server(|server| server.publish_parameter_values(in_force.clone()));
        self.responder.respond(in_force);
    }
}
