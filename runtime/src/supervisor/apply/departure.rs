//! A node that goes: it rests first, and can come back as it was, until it is let go for good.

use std::cell::RefCell;
use std::time::Duration;

use super::super::candidate::{DEVICE_PATIENCE, failure};
use super::super::changes::{Changes, Failure};
use super::super::live::NodeLife;
use super::super::monitor::Message;
use super::super::plan::PlanNode;
use crate::seats::{SeatName, SeatQuestion};

/// A step of it has this long to end.
const REST_PATIENCE: Duration = Duration::from_secs(2);

/// A node that is no longer in the graph.
pub(super) struct Departed {
    seat: SeatName,
    process: String,
    /// `None`: it is back.
    known: RefCell<Option<(PlanNode, NodeLife)>>,
}

impl Departed {
    /// Takes a node out of the graph. One that is down, or hangs, goes as well.
    pub(super) fn of(changes: &Changes, node: &str) -> Result<Self, Failure> {
        let (seat, let_go) = {
            let live = changes.live.lock();
            let planned = live.plan.node(node);
            let kind = planned.and_then(|planned| live.kind(&planned.body));
            let exclusive = planned.zip(kind).is_some_and(|(planned, kind)| kind.exclusive(&planned.config));
            (SeatName { node: node.to_owned(), number: live.seat(node) }, exclusive)
        };
        let known = changes.live.lock().plan.node(node).map(|planned| planned.process.clone());
        let process = known.ok_or_else(|| failure("request", format!("there is no node `{node}`")))?;
        let freeze =
            SeatQuestion::Freeze { seat: seat.clone(), at_least: Vec::new(), fresh: false, let_go, rests: true };
        if let Err(reason) = changes.ask_for(&process, &freeze, REST_PATIENCE) {
            tracing::warn!("node `{node}` is removed without having been asked: {reason}");
        }
        let known = RefCell::new(changes.live.lock().remove(node));
        let _ = changes.monitor.send(Message::Replanned);
        Ok(Self { seat, process, known })
    }

    pub(super) fn node(&self) -> &str {
        &self.seat.node
    }

    /// It goes for good, and its process with it if that is empty.
    pub(super) fn let_go(&self, changes: &Changes) {
        if let Err(error) = changes.ask(&self.process, &SeatQuestion::Retire(self.seat.clone())) {
            tracing::debug!("{error}");
        }
        changes.end_if_empty(&self.process);
    }

    /// It is in the graph again, as it was.
    pub(super) fn come_back(&self, changes: &Changes) -> Result<(), Failure> {
        let Some(known) = self.known.borrow_mut().take() else { return Ok(()) };
        changes.live.lock().put_back(known);
        let _ = changes.monitor.send(Message::Replanned);
        let thaw = SeatQuestion::Thaw { seat: self.seat.clone(), repeat_last: false };
        let thawed = changes.ask_for(&self.process, &thaw, DEVICE_PATIENCE);
        thawed.map(|_| ()).map_err(|reason| failure("undo", reason))
    }
}
