//! What joins two runs of one graph, that on the car and that on another machine: samples put in the place of nodes elsewhere, and what a
//! machine tells the car. The gateway calls the one half on the car, the link of the machine both.

use std::time::Duration;

use carril_messages::{Header, Health, Key, Message, Meta, Origins};

use super::{Client, ClientError, Way};
use crate::control_plane::{FaultReport, fault_key, health_key, machine_key};
use crate::machines::{Join, Joined};
use crate::transport::zenoh::{FarPublisher, StandIn};
use crate::transport::{Guard, TransportError};

/// A car that is there says within this time whether a machine may join: it may have to look at both graphs.
const JOIN_PATIENCE: Duration = Duration::from_secs(1);

impl Client {
    /// Publishes in the place of a node that runs elsewhere.
    pub fn stand_in(&self, node: &str, port: &str) -> Result<StandIn, ClientError> {
        Ok(self.transport.stand_in(&Key::new(&self.run.robot, node, port))?)
    }

    /// Passes on how a node does that runs elsewhere.
    pub fn tell_health(&self, health: &Health) -> Result<(), ClientError> {
        let (stamp, origins, meta) = (self.clock.now(), Origins::none(), Meta::new());
        let header = Header { epoch: 0, seq: 0, stamp, origins, message_type: Health::TYPE, meta };
        let header = header.encode().map_err(TransportError::from)?;
        let payload = Message::encode(health).map_err(TransportError::from)?.payload.to_vec();
        Ok(self.transport.put(&health_key(&self.run.robot, &health.node), Some(header), payload)?)
    }

    /// Stops the car in the name of a node that runs elsewhere.
    pub fn tell_fault(&self, fault: &FaultReport) -> Result<(), ClientError> {
        let bytes = serde_json::to_vec(fault).unwrap_or_default();
        Ok(self.transport.put(&fault_key(&self.run.robot), None, bytes)?)
    }

    /// Hears every fault of a node on this machine.
    pub fn watch_faults(&self, hear: impl Fn(FaultReport) + Send + Sync + 'static) -> Result<Guard, ClientError> {
        Ok(self.transport.watch(&fault_key(&self.run.robot), move |_, _, payload| {
            if let Ok(fault) = serde_json::from_slice(&payload) {
                hear(fault);
            }
        })?)
    }

    /// Joins a car far away, or says that the machine is still there. `Err`: the car is not to be reached, or refuses, and why.
    pub fn join(&self, machine: &str, join: &Join) -> Result<Joined, ClientError> {
        let key = self.machine_path(machine, "join")?;
        self.ask(&key, serde_json::to_vec(join).unwrap_or_default(), JOIN_PATIENCE)
    }

    /// Publishes something of a machine to a car far away: `port/<node>/<port>`, `status`, `fault`. `urgent`: before all else on the link.
    pub fn machine_outlet(&self, machine: &str, path: &str, urgent: bool) -> Result<FarPublisher, ClientError> {
        Ok(self.transport.publish_far(&self.machine_path(machine, path)?, urgent)?)
    }

    fn machine_path(&self, machine: &str, path: &str) -> Result<String, ClientError> {
        let (what, robot) = ("running nodes on another machine", self.run.robot.clone());
        match &self.way {
            Way::Far(way) => {
                let name = way.name().ok_or(ClientError::NoKey { what, robot: robot.clone() })?;
                Ok(machine_key(&robot, name, machine, path))
            }
            Way::Near => Err(ClientError::NoKey { what, robot }),
        }
    }
}
