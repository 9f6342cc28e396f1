//! The live executor: the nodes of one OS process, on the real clock.
//!
//! Nodes without `priority` and `cpus` share one thread, the others have one each. A sample from a node of the same process is
//! an `Arc` pushed into a mailbox. A sample from elsewhere arrives on the transport's thread; when the shared thread is idle
//! and the node's steps have been short, the step runs there at once, otherwise the thread is woken.

mod group;
mod role;
mod router;
mod seats;
mod slot;
mod trial;
mod wiring;

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use carril_messages::{Control, Health};
use thiserror::Error;

use crate::clock::Clock;
use crate::control_plane::{ControlReply, FaultReport};
use crate::executor::build::BuildError;
use crate::graph::{Graph, GraphNode};
use crate::transport::{Transport, TransportError};
use group::{Group, Request, lock};
pub use role::{FreezeTerms, MutedOutput, ProbationTerms};
use router::Router;
pub use seats::Prepared;
pub(crate) use seats::{RETIRE_PATIENCE, STEP_PATIENCE};
pub use trial::TrialNews;
use wiring::{Common, Seat, Wired};

/// What the nodes of a process get from it.
#[derive(Clone)]
pub struct Environment {
    /// Carries samples beyond the process.
    pub transport: Arc<dyn Transport>,
    /// The car's clock.
    pub clock: Arc<dyn Clock>,
    /// Folder of the run.
    pub run_dir: Option<PathBuf>,
    /// Seed of the run.
    pub seed: u64,
}

/// Why the nodes of a process could not start.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StartError {
    /// A node could not be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// A port could not be opened.
    #[error("node `{node}`: {reason}")]
    Transport {
        /// The node.
        node: String,
        /// What the transport says.
        reason: TransportError,
    },
    /// The operating system refused a thread.
    #[error("no thread for node `{node}`: {reason}")]
    Thread {
        /// The node.
        node: String,
        /// What the system says.
        reason: std::io::Error,
    },
}

/// Something that the process must act on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NodeEvent {
    /// A node stops the car.
    Fault(FaultReport),
    /// A step panicked. `alone`: it was the only node of the process, which should end now; else it is built anew in place.
    Panicked {
        /// The node.
        node: String,
        /// What it said.
        message: String,
        /// The only node.
        alone: bool,
    },
    /// An instance on trial has passed, or failed.
    Trial(TrialNews),
}

/// The nodes of one process at work.
pub struct Executor {
    process: String,
    robot: String,
    environment: Environment,
    router: Router,
    events: Events,
    alone: Arc<AtomicBool>,
    seats: Mutex<Vec<Seat>>,
    threads: Mutex<Vec<(Arc<Group>, JoinHandle<()>)>>,
}

impl Executor {
    /// Builds the nodes of `process` and starts them. What they report comes out of the receiver.
    pub fn start(
        graph: &Graph,
        process: &str,
        environment: &Environment,
    ) -> Result<(Self, Receiver<NodeEvent>), StartError> {
        let (events, receiver) = channel();
        let nodes: Vec<&GraphNode> = graph.nodes.iter().filter(|node| node.process == process).collect();
        let executor = Self {
            process: process.to_owned(),
            robot: graph.robot.clone(),
            environment: environment.clone(),
            router: Router::default(),
            events,
            alone: Arc::new(AtomicBool::new(nodes.len() == 1)),
            seats: Mutex::default(),
            threads: Mutex::default(),
        };
        let common = executor.common();
        let Wired { groups, mut seats } = wiring::build(graph, &nodes, &common)?;
        for group in groups {
            executor.spawn(group)?;
        }
        // Last: until here nothing comes in, and nothing can be missed by a node that is not there yet.
        let local: Vec<&str> = nodes.iter().map(|node| node.name.as_str()).collect();
        for seat in &mut seats {
            seat.listen(&graph.robot, &local, &common)?;
        }
        *lock(&executor.seats) = seats;
        Ok((executor, receiver))
    }

    fn common(&self) -> Common<'_> {
        Common { environment: &self.environment, events: &self.events, router: &self.router, alone: &self.alone }
    }

    fn spawn(&self, group: Arc<Group>) -> Result<(), StartError> {
        let thread = group::spawn(&group).map_err(|reason| StartError::Thread { node: group.name(), reason })?;
        lock(&self.threads).push((group, thread));
        Ok(())
    }

    /// Tells every node, and waits until they have heard it. `Err` names those that have not: their steps still run.
    pub fn control(&self, control: Control, patience: Duration) -> Result<ControlReply, String> {
        let (heard, receiver) = channel();
        let all = self.ask(|| Request::Control(control, heard.clone()));
        drop(heard);
        let heard = collect(&receiver, all.len(), patience);
        let missing: Vec<String> =
            all.into_iter().filter(|node| !heard.iter().any(|heard| heard.node == *node)).collect();
        let nodes: Vec<String> = heard.into_iter().filter(|heard| heard.is_the_node).map(|heard| heard.node).collect();
        let list = |names: &[String]| names.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        if missing.is_empty() {
            return Ok(ControlReply { process: self.process.clone(), nodes });
        }
        Err(format!(
            "process `{}`: {} did not hear `{control}` within {} ms: a step is still running, or the node is down (see \
             `carril top`); heard by: {}",
            self.process,
            list(&missing),
            patience.as_millis(),
            if nodes.is_empty() { "none".to_owned() } else { list(&nodes) },
        ))
    }

    /// How each node did since the last call. A node whose step has not ended within `patience` is left out.
    pub fn health(&self, patience: Duration) -> Vec<Health> {
        let (reply, receiver) = channel();
        let expected = self.ask(|| Request::Health(reply.clone())).len();
        drop(reply);
        let pid = Some(std::process::id());
        let own = |health| Health { process: self.process.clone(), pid, ..health };
        collect(&receiver, expected, patience).into_iter().flatten().map(own).collect()
    }

    /// Asks all groups; the nodes of all that will answer.
    fn ask(&self, request: impl Fn() -> Request) -> Vec<String> {
        let threads = lock(&self.threads);
        threads.iter().for_each(|(group, _)| group.ask(request()));
        threads.iter().flat_map(|(group, _)| group.nodes().iter().cloned()).collect()
    }

    /// Lets running steps end, and takes everything down.
    pub fn stop(&self) {
        lock(&self.seats).clear();
        let threads = std::mem::take(&mut *lock(&self.threads));
        for (group, _) in &threads {
            group.stop();
        }
        for (_, thread) in threads {
            if thread.join().is_err() {
                tracing::error!("an executor thread of process `{}` panicked", self.process);
            }
        }
    }
}

fn collect<T>(receiver: &Receiver<T>, expected: usize, patience: Duration) -> Vec<T> {
    let deadline = Instant::now() + patience;
    let mut got = Vec::with_capacity(expected);
    while got.len() < expected {
        match receiver.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(one) => got.push(one),
            Err(_) => break,
        }
    }
    got
}

type Events = Sender<NodeEvent>;
