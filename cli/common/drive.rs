//! What the car is doing, gathered from the samples and health of a running graph: the content of the status line. Pure.

use carril_messages::{
    DecisionState, DriveState, Header, Health, Message, NodeState, Payload, Percentiles, TrackProgress, VehicleState,
    WheelTelemetry,
};
use carril_runtime::control_plane::Status;
use serde::Serialize;

use super::time;

/// Types that the view is made of. Ports of these types are worth a subscription.
pub const WATCHED: [&str; 4] =
    ["carril/TrackProgress", "carril/DecisionState", "carril/WheelTelemetry", "carril/VehicleState"];

/// The last that was heard of the car.
#[derive(Clone, Debug, Default)]
pub struct Drive {
    progress: Option<TrackProgress>,
    decision: Option<DecisionState>,
    wheel_speed_m_s: Option<f32>,
    vehicle_speed_m_s: Option<f32>,
    fault: Option<&'static str>,
}

impl Drive {
    /// Takes in a sample of any type; those that say nothing about the drive change nothing.
    pub fn update(&mut self, header: &Header, payload: &Payload) {
        if let Some(progress) = read::<TrackProgress>(header, payload) {
            self.progress = Some(progress);
        } else if let Some(decision) = read::<DecisionState>(header, payload) {
            self.decision = Some(decision);
        } else if let Some(telemetry) = read::<WheelTelemetry>(header, payload) {
            self.wheel_speed_m_s = Some(telemetry.speed_m_s);
            self.fault = telemetry.faults.iter().next().map(carril_messages::Fault::text);
        } else if let Some(vehicle) = read::<VehicleState>(header, payload) {
            self.vehicle_speed_m_s = Some(vehicle.speed_m_s);
        }
    }

    /// Speed, m/s: from the encoder, else from the simulator.
    pub fn speed_m_s(&self) -> Option<f32> {
        self.wheel_speed_m_s.or(self.vehicle_speed_m_s)
    }

    /// The referee's numbers.
    pub fn progress(&self) -> Option<&TrackProgress> {
        self.progress.as_ref()
    }

    /// Everything at one moment. `age_ms` is that of the last second, from exposure to wheel.
    pub fn moment(&self, status: &Status, age_ms: Option<Percentiles>) -> Moment {
        let down = |node: &&Health| !matches!(node.state, NodeState::Running);
        Moment {
            time_s: status.uptime_s,
            state: self.decision.as_ref().map(|decision| decision.state),
            speed_m_s: self.speed_m_s(),
            lap: self.progress.map(|progress| progress.laps),
            cross_track_m: self.progress.map(|progress| progress.cross_track_m),
            age_ms,
            rates_hz: status.nodes.iter().map(|node| (node.node.clone(), node.rate_hz)).collect(),
            down: status.nodes.iter().filter(down).map(|node| (node.node.clone(), node.state)).collect(),
            overruns: status.nodes.iter().map(|node| node.overruns).sum(),
            fault: match (&status.fault, self.fault) {
                (Some(report), _) => Some(format!("{}: {}", report.node, report.reason)),
                (None, Some(text)) => Some(text.to_owned()),
                (None, None) => None,
            },
        }
    }
}

fn read<T: Message>(header: &Header, payload: &Payload) -> Option<T> {
    header.expect::<T>().ok()?;
    T::decode(&header.meta, payload).ok()
}

/// The content of one status line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Moment {
    /// Since the start of the run, s.
    pub time_s: f64,
    /// What the decision node does; `None`: nothing heard yet.
    pub state: Option<DriveState>,
    /// m/s
    pub speed_m_s: Option<f32>,
    /// Whole laps.
    pub lap: Option<u32>,
    /// m, + when the car is left of the middle.
    pub cross_track_m: Option<f32>,
    /// From exposure to wheel, ms.
    pub age_ms: Option<Percentiles>,
    /// Steps per second, node by node.
    pub rates_hz: Vec<(String, f64)>,
    /// Nodes that do not run, and where they are instead.
    pub down: Vec<(String, NodeState)>,
    /// Steps that took too long, all nodes.
    pub overruns: u64,
    /// What stopped the car.
    pub fault: Option<String>,
}

impl Moment {
    /// The status line.
    pub fn line(&self) -> String {
        let mut parts = vec![format!("{:>5}", time::clock(self.time_s))];
        parts.push(self.state.map_or_else(|| "waiting".to_owned(), |state| state.name().to_owned()));
        parts.extend(self.speed_m_s.map(|speed| format!("{speed:.2} m/s")));
        parts.extend(self.lap.map(|lap| format!("lap {lap}")));
        parts.extend(self.age_ms.map(|age| format!("age {:.1}/{:.1} ms", age.p50, age.p99)));
        if self.overruns > 0 {
            parts.push(super::output::counted(self.overruns, "overrun"));
        }
        let starting = self.down.iter().filter(|(_, state)| *state == NodeState::Starting).count();
        if starting > 0 {
            parts.push(format!("{starting} of {} nodes starting", self.rates_hz.len()));
        }
        let down = self.down.iter().filter(|(_, state)| *state != NodeState::Starting);
        parts.extend(down.map(|(node, state)| format!("{node} {}", state_name(*state).to_uppercase())));
        parts.extend(self.fault.iter().map(|fault| format!("STOPPED by {fault}")));
        let rates: Vec<String> = self.rates_hz.iter().map(|(node, rate)| format!("{node} {rate:.0}")).collect();
        parts.push(format!("Hz: {}", rates.join(" ")));
        parts.join("  ")
    }
}

/// As on the wire: `gave-up`.
pub fn state_name(state: NodeState) -> &'static str {
    match state {
        NodeState::Starting => "starting",
        NodeState::Running => "running",
        NodeState::Faulted => "faulted",
        NodeState::Restarting => "restarting",
        NodeState::GaveUp => "gave up",
        NodeState::Stopped => "stopped",
        NodeState::Away => "away",
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Meta, Origins, Stamp};
    use carril_runtime::control_plane::FaultReport;

    use super::*;

    fn update<T: Message>(drive: &mut Drive, message: &T) {
        let encoded = message.encode().expect("it encodes");
        let (stamp, origins, meta) = (Stamp::ZERO, Origins::none(), Meta::new());
        drive.update(&Header { epoch: 0, seq: 0, stamp, origins, message_type: T::TYPE, meta }, &encoded.payload);
    }

    fn status() -> Status {
        let node = |name: &str, rate_hz, state| Health { node: name.into(), rate_hz, state, ..Health::default() };
        Status {
            uptime_s: 75.0,
            nodes: vec![node("lane", 29.9, NodeState::Running), node("bridge", 30.2, NodeState::Running)],
            fault: None,
            machines: Vec::new(),
        }
    }

    #[test]
    fn a_driving_car_has_one_line() {
        let mut drive = Drive::default();
        update(&mut drive, &TrackProgress { laps: 2, ..TrackProgress::default() });
        update(
            &mut drive,
            &VehicleState {
                pose_in_map: carril_messages::Pose::default(),
                speed_m_s: 0.5,
                yaw_rate_rad_s: 0.0,
                steering_rad: 0.0,
            },
        );
        let expected = " 1:15  waiting  0.50 m/s  lap 2  age 12.3/18.9 ms  Hz: lane 30 bridge 30";
        assert_eq!(
            drive.moment(&status(), Some(Percentiles { p50: 12.34, p99: 18.9, max: 20.0 })).line(),
            expected,
            "all that is known"
        );
    }

    #[test]
    fn trouble_is_named() {
        let mut status = status();
        status.nodes[0].state = NodeState::GaveUp;
        status.nodes[1].state = NodeState::Starting;
        status.fault = Some(FaultReport { node: "bridge".into(), reason: "`command` is 132 ms old".into() });
        let line = Drive::default().moment(&status, None).line();
        assert!(
            line.contains("1 of 2 nodes starting  lane GAVE UP")
                && line.contains("STOPPED by bridge: `command` is 132 ms old"),
            "{line}"
        );
    }
}
