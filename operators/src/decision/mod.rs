//! Operator `decision`: what the car shall do, from the lane, the sectors around it, and the words of a person. Never moves
//! before `start`, never leaves the e-stop without `reset`, and never sends what is not a finite number.

mod config;
mod facts;
mod light;
#[cfg(test)]
mod light_tests;
mod overtake;
mod own_lane;
mod park;
pub mod pursuit;
mod table;
#[cfg(test)]
mod tests;

use std::time::Duration;

use carril_messages::{
    Command, Control, DecisionState, DriveState, Goal, Lane, LaneEstimate, LaserScan, Sectors, Stamp, TrafficLight,
    WheelTelemetry,
};
use carril_runtime::{Context, Operator, Setup, SetupError, StateError, StepError};
use serde::{Deserialize, Serialize};

pub use config::DecisionConfig;
pub use facts::{Front, LaneMemory, LaneProblem};
pub use light::{LightConfig, LightMemory};
pub use overtake::{OvertakeConfig, OvertakeMemory};
pub use park::{ParkConfig, ParkMemory};
pub use table::{RULES, Rule};

use crate::odometry::Wheels;
use pursuit::Going;

/// How often the state is sent when it does not change.
const STATE_PERIOD: Duration = Duration::from_millis(200);

/// All that the decision node remembers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DecisionMemory {
    state: DriveState,
    since: Option<Stamp>,
    reason: String,
    transitions: u64,
    go: bool,
    estop: bool,
    lane: LaneMemory,
    front: Front,
    /// When the newest sectors were scanned; `None` before the first.
    scanned: Option<Stamp>,
    clear_since: Option<Stamp>,
    light: LightMemory,
    overtake: OvertakeMemory,
    park: ParkMemory,
    coast_until: Option<Stamp>,
    steering_rad: f32,
    /// The newest command of a person who drives by hand, and when it was given; `None` after any other word.
    hand: Option<(Command, Stamp)>,
    /// Speed on the way into a gap, m/s.
    park_speed_m_s: f64,
    /// From the last goal, m/s; `None`: the configuration's `cruise_speed_m_s`.
    goal_speed_m_s: Option<f64>,
    state_sent: Option<Stamp>,
}

carril_runtime::inputs! {
    /// What the decision node reads.
    pub struct DecisionInputs {
        /// Where the lane lies.
        lane: LaneEstimate,
        /// What lies around the car.
        sectors: Sectors [hold optional],
        /// What the traffic light shows, and where its stop line is.
        light: TrafficLight [hold optional],
        /// The scan that `sectors` come from: to overtake and to park.
        scan: LaserScan [hold optional],
        /// What the wheels do: to overtake and to park.
        wheels: WheelTelemetry [hold optional],
        /// What a person asks for: `carril pub decision/goal '{"cruise": {"speed_m_s": 0.4}}'`.
        goal: Goal [hold external],
        /// A person drives by hand, again and again for as long as they hold the key: without the next one the car stops.
        manual: Command [external],
    }
}

carril_runtime::outputs! {
    /// What the decision node gives.
    pub struct DecisionOutputs {
        /// What the car shall do; on each step.
        command: Command,
        /// What the node is doing and why; on each transition, and every 200 ms.
        state: DecisionState,
    }
}

/// Decides what the car shall do.
pub struct Decision {
    config: DecisionConfig,
    memory: DecisionMemory,
}

impl Decision {
    /// From a configuration that has passed its check.
    pub fn from_config(config: DecisionConfig) -> Self {
        let memory = DecisionMemory {
            state: DriveState::Idle,
            since: None,
            reason: if config.auto_start { "began, with `auto_start`" } else { "began; `start` to drive" }.into(),
            transitions: 0,
            go: config.auto_start,
            estop: false,
            lane: LaneMemory::default(),
            front: unheard(&config),
            scanned: None,
            clear_since: None,
            light: LightMemory::default(),
            overtake: OvertakeMemory::default(),
            park: ParkMemory::new(&config.park),
            coast_until: None,
            steering_rad: 0.0,
            hand: None,
            park_speed_m_s: 0.0,
            goal_speed_m_s: None,
            state_sent: None,
        };
        Self { config, memory }
    }

    /// Where the FSM is.
    pub fn state(&self) -> DriveState {
        self.memory.state
    }

    /// Reads the newest estimate. A held one is read again while it counts, so that commands carry its age; one that has grown too
    /// old is not, so that a stop for want of a lane does not carry the age of the lane it no longer has.
    fn read_lane(&mut self, inputs: &mut DecisionInputs, now: Stamp) -> Option<Lane> {
        let news = inputs.lane.has_news();
        let moves = self.moves(now) && self.memory.state != DriveState::ParkDrive;
        let counts = moves || self.memory.lane.age(now).is_some_and(|age| age <= self.lane_timeout());
        if !news && !counts {
            return None;
        }
        let sample = inputs.lane.latest()?;
        if !news {
            return None;
        }
        let captured = now - sample.age(now).to_duration();
        self.memory.lane.observe(&sample, captured, &self.config).copied()
    }

    fn read_sectors(&mut self, inputs: &mut DecisionInputs, now: Stamp) {
        let timeout = Duration::from_secs_f64(self.config.sectors_timeout_ms * 1e-3);
        let young = |scanned: Option<Stamp>| scanned.is_some_and(|stamp| now.since(stamp).to_duration() <= timeout);
        let news = inputs.sectors.has_news();
        if (news || young(self.memory.scanned))
            && let Some(sample) = inputs.sectors.latest()
            && news
        {
            self.memory.scanned = Some(now - sample.age(now).to_duration());
            self.memory.front = facts::front_of(&sample, &self.config);
        }
        if let Some(scanned) = self.memory.scanned
            && !young(Some(scanned))
        {
            let limit_ms = self.config.sectors_timeout_ms;
            self.memory.front = Front::Unknown(format!("no scan for more than {limit_ms:.0} ms"));
        }
        match self.memory.front {
            Front::Clear(_) | Front::NoLidar => self.memory.clear_since = self.memory.clear_since.or(Some(now)),
            Front::Near(_) | Front::Blocked(..) | Front::Unknown(_) => self.memory.clear_since = None,
        }
    }

    /// Carries the way to the stop line on, and reads the newest word about the light.
    fn read_light(&mut self, inputs: &mut DecisionInputs, now: Stamp) {
        let speed_m_s = self.speed_m_s(now);
        self.memory.light.drive_on(speed_m_s, now);
        let news = inputs.light.has_news();
        let counts = self.memory.state == DriveState::LightStop && self.memory.light.counts(now, &self.config.light);
        if (news || counts)
            && let Some(sample) = inputs.light.latest()
            && news
        {
            let captured = now - sample.age(now).to_duration();
            self.memory.light.observe(&sample, captured, speed_m_s, now, &self.config.light);
        }
    }

    /// Carries the car on by its wheels, and reads the newest scan, while something needs them: overtaking, parking. `lane`: seen in this
    /// step.
    fn read_surroundings(&mut self, inputs: &mut DecisionInputs, lane: Option<&Lane>, now: Stamp) {
        let Self { config, memory, .. } = self;
        let (overtakes, parks) = (config.overtake.enabled, memory.park.listens());
        if !overtakes && !parks {
            return;
        }
        let wheels = Wheels::newest(&mut inputs.wheels, now);
        let scan = if inputs.scan.has_news() { inputs.scan.latest() } else { None };
        if parks {
            memory.park.drive_on(wheels, now, config);
            if let Some(scan) = &scan {
                let captured = now - scan.age(now).to_duration();
                memory.park.observe(&config.body.points(scan), captured, config);
            }
        }
        if overtakes {
            memory.overtake.drive_on(wheels, now, config);
            if let Some(ground) = lane.and_then(|lane| lane.ground.as_ref()) {
                let age_s = memory.lane.age(now).unwrap_or_default().as_secs_f64();
                memory.overtake.observe_lane(ground, wheels, age_s, config);
            }
            if let Some(scan) = &scan {
                let (steering_rad, age_s) = (f64::from(memory.steering_rad), scan.age(now).as_secs_f64());
                memory.overtake.observe_scan(scan, (wheels, steering_rad), (age_s, now), config);
            }
            let hindered = memory.overtake.hindered(now, config).is_some();
            memory.overtake.keep_time(now, hindered || memory.light.stops(now, &config.light).is_some());
        }
    }

    fn read_goal(&mut self, inputs: &mut DecisionInputs) -> Result<(), StepError> {
        let mut refused = Ok(());
        while let Some(goal) = inputs.goal.take() {
            match *goal {
                Goal::Cruise { speed_m_s } if speed_m_s.is_finite() && speed_m_s > 0.0 => {
                    match self.memory.park.withdraw() {
                        Ok(()) => self.memory.goal_speed_m_s = Some(f64::from(speed_m_s)),
                        Err(reason) => refused = Err(StepError::new(format!("goal refused: {reason}"))),
                    }
                }
                Goal::Park(parking) => {
                    if let Err(reason) = self.memory.park.ask(parking) {
                        refused = Err(StepError::new(format!("goal refused: {reason}")));
                    }
                }
                Goal::Cruise { speed_m_s } => {
                    let most = self.config.max_speed_m_s;
                    let reason =
                        format!("goal refused: got `speed_m_s` {speed_m_s}, allowed is more than 0, up to {most}");
                    refused = Err(StepError::new(reason));
                }
                _ => refused = Err(StepError::new("goal refused: this decision node knows only `cruise` and `park`")),
            }
        }
        refused
    }

    /// Takes the driver's command. Speed 0 and straight ahead is one, too: it holds the car.
    fn read_hand(&mut self, inputs: &mut DecisionInputs, now: Stamp) -> Result<(), StepError> {
        if !inputs.manual.has_news() {
            return Ok(());
        }
        let Some(sample) = inputs.manual.latest() else { return Ok(()) };
        let (command, stamp) = (**sample.value(), sample.header().stamp);
        if !command.is_finite() {
            let (steering, speed) = (command.steering_rad, command.speed_m_s);
            return Err(StepError::new(format!(
                "manual command refused: got steering {steering} rad, speed {speed} m/s, both must be finite"
            )));
        }
        // A stamp from the future must not keep a command fresh for longer.
        self.memory.hand = Some((command, stamp.min(now)));
        Ok(())
    }

    /// Takes the transition that is due.
    fn decide(&mut self, now: Stamp) -> bool {
        let memory = &self.memory;
        let facts = table::Facts {
            now,
            config: &self.config,
            go: memory.go,
            estop: memory.estop,
            hand: memory.hand.map(|(_, given)| now.since(given).to_duration()),
            lane: &memory.lane,
            front: &memory.front,
            clear_since: memory.clear_since,
            light: &memory.light,
            overtake: &memory.overtake,
            cruise_speed_m_s: self.cruise_speed_m_s(),
            park: &memory.park,
        };
        let Some((to, reason)) = table::due(memory.state, &facts) else { return false };
        let from = memory.state;
        let coasts = matches!(from, DriveState::LaneFollow | DriveState::ParkSearch) && to == DriveState::LaneLost;
        self.memory.coast_until = coasts.then(|| now + Duration::from_secs_f64(self.config.coast_s));
        if from == DriveState::Manual || to == DriveState::Manual {
            // Who has driven by hand says when the car shall drive again by itself.
            self.memory.go = false;
        }
        self.memory.overtake.enter(from, to, &self.config);
        self.memory.state = to;
        self.memory.since = Some(now);
        self.memory.reason = reason;
        self.memory.transitions += 1;
        true
    }

    fn lane_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.config.lane_timeout_ms * 1e-3)
    }

    /// Speed on the lane, m/s.
    fn cruise_speed_m_s(&self) -> f64 {
        self.memory.goal_speed_m_s.unwrap_or(self.config.cruise_speed_m_s).min(self.config.max_speed_m_s)
    }

    /// Speed that the state asks for, m/s.
    fn speed_m_s(&self, now: Stamp) -> f64 {
        match self.memory.state {
            DriveState::LaneFollow => self.cruise_speed_m_s(),
            DriveState::ParkSearch => self.cruise_speed_m_s().min(self.config.park.search_speed_m_s),
            DriveState::ParkDrive => self.memory.park_speed_m_s,
            DriveState::Manual => {
                let most = self.config.manual_max_speed_m_s;
                self.memory.hand.map_or(0.0, |(command, _)| f64::from(command.speed_m_s).clamp(-most, most))
            }
            DriveState::LightStop => self.memory.light.speed_m_s(self.cruise_speed_m_s(), now, &self.config.light),
            DriveState::OvertakeWait => self.memory.overtake.waiting_speed_m_s(self.cruise_speed_m_s(), &self.config),
            DriveState::OvertakeOut | DriveState::OvertakePass | DriveState::OvertakeIn => {
                self.config.overtake.speed_m_s.min(self.cruise_speed_m_s())
            }
            DriveState::LaneLost if self.memory.coast_until.is_some_and(|until| now < until) => {
                self.config.coast_speed_m_s.min(self.cruise_speed_m_s())
            }
            _ => 0.0,
        }
    }

    fn moves(&self, now: Stamp) -> bool {
        self.speed_m_s(now) != 0.0
    }

    /// Steering follows the lane while driving, and while braking for an obstacle; otherwise the wheels are held.
    fn steer(&mut self, lane: Option<Lane>, now: Stamp) {
        if self.memory.state == DriveState::Manual
            && let Some((command, _)) = self.memory.hand
        {
            let limit = self.config.max_steering_deg.to_radians() as f32;
            self.memory.steering_rad = command.steering_rad.clamp(-limit, limit);
        }
        if matches!(self.memory.state, DriveState::OvertakeOut | DriveState::OvertakePass | DriveState::OvertakeIn) {
            let steering_rad = f64::from(self.memory.steering_rad);
            let going = Going { speed_m_s: self.speed_m_s(now), steering_rad, age_s: 0.0 };
            if let Some(steering_rad) = self.memory.overtake.steering_rad(going, &self.config) {
                self.memory.steering_rad = steering_rad as f32;
            }
        }
        let speed_m_s = self.speed_m_s(now);
        if self.memory.state == DriveState::OvertakeWait
            && speed_m_s < 0.0
            && let Some(steering_rad) = self.memory.overtake.backing_steering_rad(&self.config)
        {
            self.memory.steering_rad = steering_rad as f32;
            return;
        }
        let follows = matches!(
            self.memory.state,
            DriveState::LaneFollow
                | DriveState::ObstacleStop
                | DriveState::LightStop
                | DriveState::OvertakeWait
                | DriveState::ParkSearch
        );
        if let Some(lane) = lane.filter(|_| follows) {
            let steering = match &lane.ground {
                Some(ground) => {
                    let going = Going {
                        speed_m_s: self.speed_m_s(now),
                        steering_rad: f64::from(self.memory.steering_rad),
                        age_s: self.memory.lane.age(now).unwrap_or_default().as_secs_f64(),
                    };
                    pursuit::steering_rad(ground, going, &self.config)
                }
                None => self.steering_in_image_rad(&lane),
            };
            self.memory.steering_rad = steering as f32;
        }
    }

    /// Steering by the lane as it lies in the image.
    fn steering_in_image_rad(&self, lane: &Lane) -> f64 {
        let limit = self.config.max_steering_deg.to_radians();
        let distance = f64::from(lane.distance_px) - self.config.target_distance_px;
        let steering = self.config.k_angle * f64::from(lane.angle_rad) + self.config.k_distance_rad_per_px * distance;
        steering.clamp(-limit, limit)
    }

    /// Looks for a gap, or drives into it.
    fn park(&mut self, now: Stamp) {
        let steers = self.memory.park.go_on(self.memory.state, now, &self.config);
        self.memory.park_speed_m_s = steers.map_or(0.0, |(speed_m_s, _)| speed_m_s);
        if let Some((_, steering_rad)) = steers {
            self.memory.steering_rad = steering_rad as f32;
        }
        if let Some(news) = self.memory.park.news() {
            self.memory.reason = news;
            self.memory.state_sent = None;
        }
    }

    fn send_state(&mut self, outputs: &mut DecisionOutputs, changed: bool, now: Stamp) {
        let due = self.memory.state_sent.is_none_or(|sent| now.since(sent).to_duration() >= STATE_PERIOD);
        if !changed && !due {
            return;
        }
        self.memory.state_sent = Some(now);
        outputs.state.send(DecisionState {
            state: self.memory.state,
            since: *self.memory.since.get_or_insert(now),
            reason: self.memory.reason.clone(),
            target_speed_m_s: self.speed_m_s(now) as f32,
            steering_rad: self.memory.steering_rad,
            transitions: self.memory.transitions,
        });
    }
}

/// What is known of the way ahead before the first scan.
fn unheard(config: &DecisionConfig) -> Front {
    if config.require_sectors { Front::Unknown("no scan has come yet".into()) } else { Front::NoLidar }
}

impl Operator for Decision {
    const KIND: &'static str = "decision";
    const STATE_VERSION: u32 = 4;
    const SUMMARY: &'static str =
        "what the car shall do: follow the lane, stop at obstacles and red lights, overtake, park, obey a person";
    const STAYS_ON_CAR: bool = true;

    type Config = DecisionConfig;
    type Inputs = DecisionInputs;
    type Outputs = DecisionOutputs;
    type State = DecisionMemory;

    fn new(config: DecisionConfig, _setup: &Setup) -> Result<Self, SetupError> {
        Ok(Self::from_config(config))
    }

    fn step(
        &mut self,
        inputs: &mut DecisionInputs,
        outputs: &mut DecisionOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        let now = context.now();
        let goal = self.read_goal(inputs);
        let hand = self.read_hand(inputs, now);
        let lane = self.read_lane(inputs, now);
        self.read_sectors(inputs, now);
        self.read_light(inputs, now);
        self.read_surroundings(inputs, lane.as_ref(), now);
        self.park(now);
        let changed = self.decide(now);
        self.steer(lane, now);
        let speed_m_s = self.speed_m_s(now) as f32;
        outputs.command.send(Command { steering_rad: self.memory.steering_rad, speed_m_s });
        self.send_state(outputs, changed, now);
        goal.and(hand)
    }

    fn period(_config: &DecisionConfig) -> Option<Duration> {
        Some(Duration::from_millis(50))
    }

    fn control(&mut self, control: Control, _now: Stamp) {
        let memory = &mut self.memory;
        // A command that was given before the word counts no more.
        memory.hand = None;
        match control {
            Control::EStop => (memory.estop, memory.go) = (true, false),
            Control::Reset => (memory.estop, memory.go) = (false, false),
            Control::Stop => memory.go = false,
            Control::Start => memory.go = !memory.estop,
        }
    }

    fn snapshot(&self) -> DecisionMemory {
        self.memory.clone()
    }

    fn restore(&mut self, mut memory: DecisionMemory) -> Result<(), StateError> {
        if !memory.steering_rad.is_finite() || !memory.goal_speed_m_s.is_none_or(|speed| speed > 0.0) {
            let (steering, goal) = (memory.steering_rad, memory.goal_speed_m_s);
            return Err(StateError::new(format!(
                "the predecessor steers {steering} rad towards a goal of {goal:?} m/s"
            )));
        }
        if !(memory.park.is_finite() && memory.park_speed_m_s.is_finite()) {
            return Err(StateError::new("the predecessor parks by something that is no number"));
        }
        if !memory.light.is_finite() {
            return Err(StateError::new("the predecessor's way to the stop line is no number"));
        }
        if !memory.overtake.is_finite() {
            return Err(StateError::new("the predecessor's place on the road is no number"));
        }
        memory.hand = memory.hand.filter(|(command, _)| command.is_finite());
        // The successor may have other limits.
        let limit = self.config.max_steering_deg.to_radians() as f32;
        memory.steering_rad = memory.steering_rad.clamp(-limit, limit);
        if memory.scanned.is_none() {
            memory.front = unheard(&self.config);
        }
        self.memory = memory;
        Ok(())
    }
}
