//! Operator `rplidar`: scans from a lidar of SLAMTEC's A series on a serial port. The protocol is in `codec`, the conversation in `talk`, the
//! port in [`link`](crate::link); this joins them. `model` is the device, for simulation and tests.

pub mod codec;
mod config;
pub mod model;
mod rotation;
mod sim;
mod talk;
#[cfg(test)]
mod tests;

use std::time::Duration;

use carril_messages::{LaserScan, Stamp};
use carril_runtime::{Context, NoInputs, Operator, Setup, SetupError, StepError};

pub use config::{Mode, RplidarConfig};
pub use sim::{SimRplidar, SimRplidarConfig, SimRplidarInputs};

use self::codec::HealthStatus;
use self::rotation::Rotation;
use self::talk::{Note, Outcome, Talk};
use crate::link::{self, Dtr, Line, LineEvent};

/// How often the conversation looks at its timers. Measurements are taken when they come.
const PERIOD: Duration = Duration::from_millis(20);

carril_runtime::outputs! {
    /// What the lidar sees.
    pub struct RplidarOutputs {
        /// A scan per rotation, in the frame of the device: its front is 0, counter-clockwise; a direction that was not measured is NaN.
        scan: LaserScan,
    }
}

/// The driver.
pub struct Rplidar {
    port: String,
    line: Box<dyn Line>,
    talk: Talk,
    rotation: Rotation,
    events: Vec<LineEvent>,
}

impl Operator for Rplidar {
    const KIND: &'static str = "rplidar";
    const SUMMARY: &'static str = "Scans from an RPLIDAR A1, A2 or A3 on a serial port";
    const STAYS_ON_CAR: bool = true;
    type Config = RplidarConfig;
    type Inputs = NoInputs;
    type Outputs = RplidarOutputs;

    fn new(config: RplidarConfig, setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self {
            line: link::open(&config.port, config.baud, Dtr::Clear, setup)?,
            talk: Talk::new(config.mode, config.motor_pwm, config.silence()),
            rotation: Rotation::new(config.points as usize, config.reach_m()),
            events: Vec::new(),
            port: config.port,
        })
    }

    fn step(
        &mut self,
        _inputs: &mut NoInputs,
        outputs: &mut RplidarOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let now = context.now();
        let mut trouble = Vec::new();
        self.line.poll(now, &mut self.events);
        for event in std::mem::take(&mut self.events) {
            let mut out = Outcome::default();
            let arrived = match event {
                LineEvent::Opened => {
                    self.talk.opened(now, &mut out);
                    now
                }
                LineEvent::Closed(reason) => {
                    self.talk.closed();
                    self.rotation.reset();
                    trouble.push(format!("{reason}; it is opened again when it is back"));
                    now
                }
                LineEvent::Bytes(arrived, bytes) => {
                    self.talk.heard(&bytes, arrived, &mut out);
                    arrived
                }
            };
            self.follow(&out, arrived, outputs, &mut trouble);
        }
        let mut out = Outcome::default();
        self.talk.tick(now, &mut out);
        self.follow(&out, now, outputs, &mut trouble);
        if trouble.is_empty() {
            Ok(())
        } else {
            Err(StepError::new(format!("`{}`: {}", self.port, trouble.join("; "))))
        }
    }

    fn period(_config: &RplidarConfig) -> Option<Duration> {
        Some(PERIOD)
    }

    carril_runtime::stateless!();

    /// Two drivers would ask the same device.
    fn exclusive(_config: &RplidarConfig) -> bool {
        true
    }
}

impl Rplidar {
    fn follow(&mut self, out: &Outcome, arrived: Stamp, outputs: &mut RplidarOutputs, trouble: &mut Vec<String>) {
        if out.anew {
            self.rotation.reset();
        }
        for point in &out.points {
            if let Some(scan) = self.rotation.add(point, arrived) {
                outputs.scan.send_captured(scan, arrived);
            }
        }
        if !out.send.is_empty() {
            self.line.send_urgent(&out.send);
        }
        trouble.extend(out.notes.iter().filter_map(|note| self.told(note)));
    }

    /// What people should know: good news goes to the log, the rest is trouble.
    fn told(&self, note: &Note) -> Option<String> {
        let port = &self.port;
        match note {
            Note::Found(info) => {
                let [major, minor] = info.firmware;
                tracing::info!(
                    "`{port}`: RPLIDAR model {:#04x}, firmware {major}.{minor:02}, hardware {}, serial {}",
                    info.model,
                    info.hardware,
                    info.serial
                );
                None
            }
            Note::Scanning => {
                tracing::info!("`{port}`: the lidar scans");
                None
            }
            Note::Unwell(health) if health.status == HealthStatus::Error => Some(format!(
                "the lidar has stopped itself (error {:#06x}) and is reset; if it does so again, see that it turns freely",
                health.code
            )),
            Note::Unwell(health) => Some(format!("the lidar warns of itself (code {:#06x}); it scans on", health.code)),
            Note::NoAnswer => Some(
                "nothing answers as an RPLIDAR does; is `baud` that of the device (A1, A2M8: 115200; A2M12, A3: 256000), and is its \
                 motor supplied? It is asked on"
                    .to_owned(),
            ),
            Note::Silent(silent) => {
                Some(format!("no measurement for {} ms; the conversation begins again", silent.as_millis()))
            }
        }
    }
}

impl Drop for Rplidar {
    fn drop(&mut self) {
        self.line.send_urgent(&talk::farewell());
        tracing::debug!(lost = self.talk.lost(), "`{}`: closed; bytes that belonged to nothing", self.port);
    }
}
