//! What an instance of a node is to the graph: the node itself, or one that is to become it, or one that was.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::Mutex;

use carril_messages::{Control, Header};

use crate::handover::StepRecord;
use crate::ports::AnyMessage;

/// Hears what an instance in shadow would have published: port, header, message.
pub type MutedOutput = Arc<dyn Fn(&'static str, &Arc<Header>, &Arc<dyn AnyMessage>) + Send + Sync>;

/// Tells a predecessor of a step.
pub type TellStep = Box<dyn Fn(StepRecord) + Send>;

/// The conditions of a probation.
pub struct ProbationTerms {
    /// It ends after so many outputs.
    pub outputs: u64,
    /// So many steps may miss their deadline.
    pub overruns: u64,
    /// Steps may fail: the node waits for a device that its predecessor has just let go, or the predecessor's failed, too.
    pub may_err: bool,
    /// Tells the predecessor, which follows.
    pub tell: TellStep,
}

/// How an instance stops.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FreezeTerms {
    /// Its state is not handed over.
    pub fresh: bool,
    /// It lets go of its device.
    pub let_go: bool,
    /// It does not follow a successor: it rests.
    pub rests: bool,
}

/// The role of an instance.
pub(super) enum Role {
    /// It is the node: its outputs are published.
    Active,
    /// It is the node, for now: its predecessor follows, and takes over again should it fail.
    Probation(Probation),
    /// It gets the inputs; its outputs are compared, not published.
    Shadow(Shadow),
    /// It takes nothing and keeps everything, until its predecessor has handed over. Words are heard afterwards.
    Held(Vec<Control>),
    /// It makes the steps that its successor has made, without publishing. The last one it makes only when the next is known:
    /// should the successor die, its outputs may not have come out.
    Following(VecDeque<StepRecord>),
    /// It does nothing and keeps only what its queues hold; it may be the node again. Its sequence numbers go on with those of its
    /// successor, if it has one.
    Resting,
    /// Its time is over.
    Retired,
}

pub(super) struct Shadow {
    /// Hears what it would have published.
    pub hear: MutedOutput,
    /// Its steps may fail: those of the active instance do, too.
    pub may_err: bool,
}

pub(super) struct Probation {
    pub terms: ProbationTerms,
    pub next_number: u64,
}

impl Role {
    pub(super) fn name(&self) -> &'static str {
        match self {
            Self::Active => "active",
            Self::Probation(_) => "probation",
            Self::Shadow(_) => "shadow",
            Self::Held(_) => "held",
            Self::Following(_) => "following",
            Self::Resting => "resting",
            Self::Retired => "retired",
        }
    }

    /// Whether it steps on its own.
    pub(super) fn steps(&self) -> bool {
        matches!(self, Self::Active | Self::Probation(_) | Self::Shadow(_))
    }

    /// Whether it is the node that the rest of the graph sees.
    pub(super) fn is_the_node(&self) -> bool {
        matches!(self, Self::Active | Self::Probation(_))
    }
}

/// Lets outputs out, or not. It is shut from outside when a step hangs and another instance takes over: what the step sends
/// when it ends at last must not come out.
#[derive(Clone)]
pub(super) struct Gate(Arc<Mutex<bool>>);

impl Gate {
    pub(super) fn new() -> Self {
        Self(Arc::new(Mutex::new(true)))
    }

    /// Runs `publish` unless the gate is shut. `false`: it is.
    pub(super) fn pass(&self, publish: impl FnOnce()) -> bool {
        let open = super::group::lock(&self.0);
        if *open {
            publish();
        }
        *open
    }

    /// From now on nothing comes out. Waits for what is coming out.
    pub(super) fn shut(&self) {
        *super::group::lock(&self.0) = false;
    }
}
