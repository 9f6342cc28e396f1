//! One conversation, whichever protocol it is held in: our own or one of stock firmware. Chooses, and nothing else.

use carril_messages::{Command, Control, Stamp};
use serde::{Deserialize, Serialize};

use crate::host::{ChipClock, CommandError, Effects, Host, HostState, Latches, LinkCounts};
use crate::stock::{StockHost, StockState};

/// The conversation as a successor takes it over, also one that speaks another protocol.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LinkState {
    /// Of our own protocol. Its stops count for each.
    pub host: HostState,
    /// What is known of the chip's time. `None`: it does not tell it.
    pub chip_clock: Option<ChipClock>,
    /// `None`: the predecessor spoke our own.
    pub stock: Option<StockState>,
}

impl From<HostState> for LinkState {
    fn from(host: HostState) -> Self {
        Self { host, chip_clock: None, stock: None }
    }
}

/// The host's side, in one of the protocols. Each is large, and there is one of them.
pub(crate) enum Conversation {
    Carril(Box<Host>),
    Stock(Box<StockHost>),
}

impl Conversation {
    pub fn opened(&mut self, now: Stamp, effects: &mut Effects) {
        match self {
            Self::Carril(host) => host.opened(now, effects),
            Self::Stock(host) => host.opened(now, effects),
        }
    }

    pub fn closed(&mut self, now: Stamp, reason: String) {
        match self {
            Self::Carril(host) => host.closed(now, reason),
            Self::Stock(host) => host.closed(now, reason),
        }
    }

    pub fn receive(&mut self, arrived: Stamp, bytes: &[u8], effects: &mut Effects) {
        match self {
            Self::Carril(host) => host.receive(arrived, bytes, effects),
            Self::Stock(host) => host.receive(arrived, bytes, effects),
        }
    }

    pub fn command(
        &mut self,
        command: Command,
        made: Stamp,
        now: Stamp,
        effects: &mut Effects,
    ) -> Result<(), CommandError> {
        match self {
            Self::Carril(host) => host.command(&command, made, now, effects),
            Self::Stock(host) => host.command(&command, made, now, effects),
        }
    }

    pub fn control(&mut self, control: Control, now: Stamp, effects: &mut Effects) {
        match self {
            Self::Carril(host) => host.control(control, now, effects),
            Self::Stock(host) => host.control(control, now, effects),
        }
    }

    pub fn tick(&mut self, now: Stamp, effects: &mut Effects) {
        match self {
            Self::Carril(host) => host.tick(now, effects),
            Self::Stock(host) => host.tick(now, effects),
        }
    }

    /// The way out. `handed_over`: a successor goes on. Our own firmware then keeps the session, and its lease watches over the
    /// gap; stock firmware would drive on through it, whatever happens, and is stopped.
    pub fn leave(&mut self, handed_over: bool, now: Stamp, effects: &mut Effects) {
        match self {
            Self::Carril(_) if handed_over => {}
            Self::Carril(host) => host.release(effects),
            Self::Stock(host) => host.release(now, effects),
        }
    }

    pub fn problem(&self, now: Stamp) -> Option<String> {
        match self {
            Self::Carril(host) => host.problem(now),
            Self::Stock(host) => host.problem(now),
        }
    }

    pub fn state(&self) -> LinkState {
        match self {
            Self::Carril(host) => LinkState { host: host.state(), chip_clock: host.chip_clock().cloned(), stock: None },
            Self::Stock(host) => LinkState { host: host.latches().into(), chip_clock: None, stock: Some(host.state()) },
        }
    }

    pub fn restore(&mut self, state: LinkState, effects: &mut Effects) {
        let LinkState { host: mut predecessor, chip_clock, stock } = state;
        match self {
            Self::Carril(host) => {
                // A lease that ran out before the protocol was changed is a stop that needs a reset.
                let expired = stock.is_some_and(|stock| stock.lease_expired);
                predecessor.latches =
                    Latches { link_lost: predecessor.latches.link_lost || expired, ..predecessor.latches };
                host.set_chip_clock(chip_clock);
                host.restore(predecessor, effects);
            }
            Self::Stock(host) => host.restore(predecessor.latches, stock.unwrap_or_default()),
        }
    }

    pub fn counts(&self) -> LinkCounts {
        match self {
            Self::Carril(host) => host.counts(),
            Self::Stock(host) => host.counts(),
        }
    }

    pub fn damaged(&self) -> u64 {
        match self {
            Self::Carril(host) => host.damaged(),
            Self::Stock(host) => host.damaged(),
        }
    }
}
