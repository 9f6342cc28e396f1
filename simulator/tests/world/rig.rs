//! A small rig around the operator: steps it on a grid of 5 ms and closes the loop with the lane follower's control law.

use std::sync::Arc;
use std::time::Duration;

use carril_messages::car::STEERING_LIMIT_RAD;
use carril_messages::{
    Command, Header, Image, LaneEstimate, LaserScan, McuPins, McuSensors, Message, Meta, Origins, Stamp, TrackProgress,
    VehicleState,
};
use carril_runtime::{Context, HeapPool, Operator, Setup, Trigger};
use carril_simulator::{SimWorld, SimWorldConfig, WorldInputs, WorldOutputs};

/// Which output closes the loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Eye {
    Camera { threshold: Threshold },
    IdealLane,
}

/// What divides marking from floor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Threshold {
    Fixed(u8),
    OtsuOfRow,
}

pub struct Rig {
    pub world: SimWorld,
    pub inputs: WorldInputs,
    pub outputs: WorldOutputs,
    pub now: Stamp,
}

/// What one step gave.
#[derive(Default)]
pub struct Seen {
    pub camera: Option<Arc<Image>>,
    pub lane: Option<Arc<LaneEstimate>>,
    pub scan: Option<Arc<LaserScan>>,
    pub sensors: Option<Arc<McuSensors>>,
    pub vehicle: Option<Arc<VehicleState>>,
    pub progress: Option<Arc<TrackProgress>>,
}

impl Rig {
    pub fn new(config: SimWorldConfig, seed: u64, camera: bool) -> Self {
        let setup = Setup { seed, ..Setup::for_tests("world") };
        let world = SimWorld::new(config, &setup).expect("the configuration is good");
        let mut outputs = WorldOutputs::default();
        outputs.camera.set_wanted(camera);
        outputs.lane.set_wanted(!camera);
        Self { world, inputs: WorldInputs::default(), outputs, now: Stamp::ZERO }
    }

    fn header<T: Message>(&self) -> Header {
        let (origins, meta) = (Origins::none(), Meta::new());
        Header { epoch: 1, seq: 0, stamp: self.now, origins, message_type: T::TYPE, meta }
    }

    pub fn command(&mut self, steering_rad: f64, speed_m_s: f64) {
        let header = self.header::<Command>();
        let command = Command { steering_rad: steering_rad as f32, speed_m_s: speed_m_s as f32 };
        self.inputs.command.put(command, header);
    }

    pub fn pins(&mut self, pins: McuPins) {
        let header = self.header::<McuPins>();
        self.inputs.pins.put(pins, header);
    }

    pub fn step(&mut self) -> Seen {
        let context = Context::new(self.now, Trigger::Period, &HeapPool);
        self.world.step(&mut self.inputs, &mut self.outputs, &context).expect("the step succeeds");
        self.now = self.now + Duration::from_millis(5);
        Seen {
            camera: self.outputs.camera.sent().pop(),
            lane: self.outputs.lane.sent().pop(),
            scan: self.outputs.scan.sent().pop(),
            sensors: self.outputs.sensors.sent().pop(),
            vehicle: self.outputs.vehicle.sent().pop(),
            progress: self.outputs.progress.sent().pop(),
        }
    }
}

/// The lane follower: the line through the centroids of the marking pixels in the rows at 75 % and 85 %.
pub fn steering_rad(image: &Image, threshold: Threshold) -> Option<f64> {
    let far = centroid(image, 0.75, threshold)?;
    let near = centroid(image, 0.85, threshold)?;
    let angle = ((far.0 - near.0) / (far.1 - near.1)).atan();
    let distance = (far.0 - angle.tan() * far.1) * angle.cos();
    Some(law(angle, distance))
}

/// The control law.
pub fn law(angle: f64, distance_px: f64) -> f64 {
    (0.9 * angle + 0.005 * distance_px).clamp(-STEERING_LIMIT_RAD, STEERING_LIMIT_RAD)
}

/// Left and ahead, px.
fn centroid(image: &Image, share: f64, threshold: Threshold) -> Option<(f64, f64)> {
    let row = (share * f64::from(image.height())) as u32;
    let green: Vec<u8> = image.row(row).iter().skip(1).step_by(3).copied().collect();
    let limit = match threshold {
        Threshold::Fixed(limit) => limit,
        Threshold::OtsuOfRow => otsu(&green),
    };
    let bright: Vec<usize> = (0..green.len()).filter(|column| green[*column] >= limit).collect();
    let mean = bright.iter().sum::<usize>() as f64 / bright.len() as f64;
    let left = (f64::from(image.width()) - 1.0) / 2.0 - mean;
    (!bright.is_empty()).then_some((left, f64::from(image.height() - 1 - row)))
}

/// The grey value that divides a row best (Otsu 1979): the smallest that counts as bright.
fn otsu(row: &[u8]) -> u8 {
    let mut counts = [0_u32; 256];
    for grey in row {
        counts[usize::from(*grey)] += 1;
    }
    let weigh = |range: std::ops::Range<usize>| {
        let (count, sum) = range.fold((0, 0), |(n, sum), grey| (n + counts[grey], sum + counts[grey] * grey as u32));
        (f64::from(count), f64::from(sum))
    };
    let spread = |limit: usize| {
        let ((dark, dark_sum), (bright, bright_sum)) = (weigh(0..limit), weigh(limit..256));
        if dark * bright == 0.0 { 0.0 } else { dark * bright * (bright_sum / bright - dark_sum / dark).powi(2) }
    };
    (1..256).max_by(|a, b| spread(*a).total_cmp(&spread(*b))).unwrap_or(128) as u8
}

/// Drives until `laps` are done or `limit_s` has passed; the referee's last word.
pub fn follow(rig: &mut Rig, eye: Eye, speed_m_s: f64, laps: u32, limit_s: f64) -> TrackProgress {
    let mut last = TrackProgress::default();
    while last.laps < laps && rig.now.as_secs_f64() < limit_s {
        let seen = rig.step();
        let steering = match (eye, &seen.camera, &seen.lane) {
            (Eye::Camera { threshold }, Some(image), _) => steering_rad(image, threshold),
            (Eye::IdealLane, _, Some(estimate)) => {
                estimate.lane.map(|lane| law(f64::from(lane.angle_rad), f64::from(lane.distance_px)))
            }
            _ => None,
        };
        if let Some(steering) = steering {
            rig.command(steering, speed_m_s);
        }
        if let Some(progress) = seen.progress {
            last = *progress;
        }
    }
    last
}
