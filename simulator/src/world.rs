//! The operator `sim-world`: vehicle, track and sensors behind the ports that a real car's drivers would serve.

use std::time::Duration;

use carril_messages::{
    Command, Encoding, Image, LaneEstimate, LaserScan, McuPins, McuSensors, Pose, Stamp, TrackProgress, VehicleState,
};
use carril_runtime::{Context, Operator, Setup, SetupError, StateError, StepError, inputs, outputs};
use serde::{Deserialize, Serialize};

use crate::camera::{Camera, Scene};
use crate::config::{SimWorldConfig, StartConfig};
use crate::lane_sensor;
use crate::lidar::Lidar;
use crate::noise;
use crate::obstacles::{Obstacles, Placed};
use crate::referee::Referee;
use crate::schedule::Schedule;
use crate::track::{Block, Track};
use crate::traffic_light::Shown;
use crate::vehicle::{Drive, Vehicle};

/// Steps of the operator.
const PERIOD: Duration = Duration::from_millis(5);
/// Steps of the vehicle are at most this long, s.
const SUBSTEP_S: f64 = 1e-3;
/// After a longer pause than this (a computer that was busy), the world has stood still meanwhile.
const LONGEST_PAUSE: Duration = Duration::from_millis(250);
/// Truth about the vehicle.
const VEHICLE_HZ: f64 = 50.0;
/// The referee's word.
const PROGRESS_HZ: f64 = 10.0;

inputs! {
    /// What drives the simulated car.
    pub struct WorldInputs {
        /// Pins of a microcontroller: servo pulse, motor duty, brake. They win over `command`.
        pins: McuPins [hold optional],
        /// Steering and speed without a microcontroller, for small graphs.
        command: Command [hold optional],
    }
}

outputs! {
    /// What the simulated car's sensors say, and the truth.
    pub struct WorldOutputs {
        /// Camera frames, bgr8.
        camera: Image [on_demand],
        /// Lidar scans.
        scan: LaserScan,
        /// Input pins of the microcontroller: encoder, battery, e-stop button; with every step.
        sensors: McuSensors,
        /// The truth about the car, 50 Hz.
        vehicle: VehicleState,
        /// The referee's word, 10 Hz.
        progress: TrackProgress,
        /// What a flawless lane detector would say, at the camera's rate.
        lane: LaneEstimate [on_demand],
    }
}

/// The simulated world.
pub struct SimWorld {
    config: SimWorldConfig,
    track: Track,
    obstacles: Obstacles,
    placed: Placed,
    camera: Camera,
    lidar: Lidar,
    state: WorldState,
}

/// Everything that changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorldState {
    started: Option<Stamp>,
    now: Stamp,
    vehicle: Vehicle,
    drive: Drive,
    /// Way of each of the configured obstacles, m.
    driven_m: Vec<f64>,
    referee: Referee,
    frames: Schedule,
    scans: Schedule,
    vehicles: Schedule,
    progress: Schedule,
}

/// Pose at the start: the track's, moved along and beside the lane (without a lane: along and beside its own direction).
pub fn start_pose(track: &Track, start: &StartConfig) -> Pose {
    let own = track.start;
    let turned_rad = start.yaw_deg.to_radians();
    let Some(lane) = track.lane.as_ref().filter(|_| start.along_m != 0.0 || start.left_m != 0.0) else {
        let (sin, cos) = own.yaw_rad.sin_cos();
        let x_m = own.x_m + cos * start.along_m - sin * start.left_m;
        let y_m = own.y_m + sin * start.along_m + cos * start.left_m;
        return Pose { x_m, y_m, yaw_rad: own.yaw_rad + turned_rad };
    };
    let here = lane.centre.locate(nalgebra::Point2::new(own.x_m, own.y_m), None);
    let on_lane = lane.pose_at(here.along_m, here.left_m);
    let pose = lane.pose_at(here.along_m + start.along_m, here.left_m + start.left_m);
    Pose { yaw_rad: pose.yaw_rad + own.yaw_rad - on_lane.yaw_rad + turned_rad, ..pose }
}

impl Operator for SimWorld {
    const KIND: &'static str = "sim-world";
    const SUMMARY: &'static str = "Vehicle, track, camera and lidar that take the hardware's place";
    const STAYS_ON_CAR: bool = true;

    type Config = SimWorldConfig;
    type Inputs = WorldInputs;
    type Outputs = WorldOutputs;
    type State = WorldState;

    fn new(config: SimWorldConfig, setup: &Setup) -> Result<Self, SetupError> {
        let track = Track::load(&config.track, &setup.base_dir).map_err(SetupError::new)?;
        let seed = noise::mix(&[config.seed, setup.seed]);
        let camera = Camera::new(&config.camera, &track, seed).map_err(SetupError::new)?;
        let lidar = Lidar::new(&config.lidar, &track, noise::mix(&[seed, 2]));
        let state = WorldState {
            started: None,
            now: Stamp::ZERO,
            vehicle: Vehicle::at(start_pose(&track, &config.start), &config.vehicle),
            drive: Drive::IDLE,
            driven_m: Vec::new(),
            referee: Referee::default(),
            frames: Schedule::new(config.camera.rate_hz),
            scans: Schedule::new(config.lidar.rate_hz),
            vehicles: Schedule::new(VEHICLE_HZ),
            progress: Schedule::new(PROGRESS_HZ),
        };
        let placed = Placed::new(&config.obstacles, &track);
        Ok(Self { obstacles: Obstacles::of(&track), placed, config, track, camera, lidar, state })
    }

    fn step(
        &mut self,
        inputs: &mut WorldInputs,
        outputs: &mut WorldOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let elapsed = self.advance_to(context.now());
        let heard = self.hear(inputs);
        self.show_camera(outputs, context, elapsed)?;
        self.show_rest(outputs, elapsed);
        heard
    }

    fn period(_config: &SimWorldConfig) -> Option<Duration> {
        Some(PERIOD)
    }

    fn snapshot(&self) -> WorldState {
        self.state.clone()
    }

    fn restore(&mut self, state: WorldState) -> Result<(), StateError> {
        let elapsed = state.started.map_or(Duration::ZERO, |started| state.now.since(started).to_duration());
        let frames = state.frames.at_rate(self.config.camera.rate_hz, elapsed);
        let scans = state.scans.at_rate(self.config.lidar.rate_hz, elapsed);
        self.state = WorldState { frames, scans, ..state };
        Ok(())
    }
}

impl SimWorld {
    /// Brings the world to `now`, driven by what was heard before; returns the time since the start.
    fn advance_to(&mut self, now: Stamp) -> Duration {
        let started = *self.state.started.get_or_insert(now);
        let passed = if started == now { Duration::ZERO } else { now.since(self.state.now).to_duration() };
        self.state.now = now;
        let elapsed = now.since(started).to_duration();
        let before = self.state.vehicle.clone();
        let passed_s = passed.min(LONGEST_PAUSE).as_secs_f64();
        let substeps = (passed_s / SUBSTEP_S - 1e-6).ceil();
        for _ in 0..substeps as u32 {
            self.state.vehicle.advance(&self.state.drive, &self.config.vehicle, passed_s / substeps);
        }
        let WorldState { driven_m, vehicle, .. } = &mut self.state;
        self.placed.drive_on(&self.track, driven_m, vehicle.pose, passed_s);
        let blocks = self.blocks();
        self.obstacles.place(&blocks);
        self.judge(before.pose, elapsed);
        elapsed
    }

    /// The configured obstacles as they stand now.
    fn blocks(&self) -> Vec<Block> {
        self.placed.blocks(&self.track, &self.state.driven_m)
    }

    /// The referee looks; the car does not go through things.
    fn judge(&mut self, before: Pose, elapsed: Duration) {
        let WorldState { vehicle, referee, .. } = &mut self.state;
        referee.watch_body(vehicle.pose, &self.obstacles);
        if self.obstacles.touches(vehicle.pose) && !self.obstacles.touches(before) {
            vehicle.pose = before;
            vehicle.speed_m_s = 0.0;
        }
        referee.observe(vehicle.pose, self.track.lane.as_ref(), elapsed.as_secs_f64());
        if let Some(lane) = &self.track.lane {
            referee.watch_lights(vehicle.speed_m_s, lane, &self.track.lights, elapsed.as_secs_f64());
        }
    }

    /// What the traffic lights show.
    fn shown(&self, elapsed: Duration) -> Vec<Shown> {
        self.track.lights.iter().map(|light| light.shown(elapsed.as_secs_f64())).collect()
    }

    /// Takes in what drives the car from now on. What is not a number is refused, and the car goes on as before.
    fn hear(&mut self, inputs: &mut WorldInputs) -> Result<(), StepError> {
        let news = inputs.pins.has_news() || inputs.command.has_news();
        let pins = inputs.pins.latest();
        let command = inputs.command.latest();
        let drive = match (&pins, &command) {
            (Some(pins), _) => Drive::from_pins(pins),
            (None, Some(command)) => Drive::from_command(command),
            (None, None) => return Ok(()),
        };
        match drive {
            Some(drive) => self.state.drive = drive,
            None if news => {
                return Err(StepError::new("`pins` or `command` holds a number that is not finite; refused"));
            }
            None => {}
        }
        Ok(())
    }

    fn show_camera(
        &mut self,
        out: &mut WorldOutputs,
        context: &Context<'_>,
        elapsed: Duration,
    ) -> Result<(), StepError> {
        let Some(frame) = self.state.frames.due(elapsed) else { return Ok(()) };
        let (pose, now) = (self.state.vehicle.pose, self.state.now);
        if let (true, Some(lane), Some(index)) = (out.lane.wanted(), &self.track.lane, self.state.referee.lane_index())
        {
            out.lane.send_captured(lane_sensor::estimate(&self.config.camera.model(), pose, lane, index), now);
        }
        if out.camera.wanted() {
            let mut buffer = context.buffer(self.camera.frame_len());
            let shown: Vec<_> = self.shown(elapsed).iter().map(|shown| shown.colour).collect();
            let scene = Scene { shown: &shown, blocks: &self.blocks() };
            self.camera.render(pose, scene, frame, &mut buffer);
            let (width, height) = (self.config.camera.width as u32, self.config.camera.height as u32);
            let image = Image::packed(width, height, Encoding::Bgr8, buffer.freeze()).map_err(StepError::new)?;
            out.camera.send_captured(image, now);
        }
        Ok(())
    }

    fn show_rest(&mut self, out: &mut WorldOutputs, elapsed: Duration) {
        let blocks = self.blocks();
        let WorldState { now, vehicle, referee, scans, vehicles, progress, .. } = &mut self.state;
        if let Some(number) = scans.due(elapsed) {
            out.scan.send_captured(self.lidar.scan(vehicle.pose, &blocks, number), *now);
        }
        let elapsed_s = elapsed.as_secs_f64();
        let estop_pressed = self.config.estop_pressed_s.iter().any(|[from, to]| (*from..*to).contains(&elapsed_s));
        let sensors = McuSensors {
            encoder_ticks: vehicle.encoder_ticks(),
            encoder_period_us: vehicle.encoder_period_us(),
            battery_v: vehicle.battery_v as f32,
            estop_pressed,
        };
        out.sensors.send_captured(sensors, *now);
        if vehicles.due(elapsed).is_some() {
            let state = VehicleState {
                pose_in_map: vehicle.pose,
                speed_m_s: vehicle.speed_m_s as f32,
                yaw_rate_rad_s: vehicle.yaw_rate_rad_s as f32,
                steering_rad: vehicle.steering_rad as f32,
            };
            out.vehicle.send_captured(state, *now);
        }
        if progress.due(elapsed).is_some() {
            out.progress.send_captured(referee.progress(), *now);
        }
    }
}
