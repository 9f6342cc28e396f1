//! The model of the microcontroller: what the firmware does with bytes, pins and time, and nothing else. It opens no port and
//! asks no clock. Its rules are those of `bridge/protocol.md`; the firmware's core is measured against it.

use carril_messages::{Fault, FaultSet, McuPins, McuSensors};
use serde::{Deserialize, Serialize};

use crate::calibration::{Calibration, Param, SPECS};
use crate::codec::{
    CalibrationState, CalibrationStatus, CalibrationStore, Capabilities, Command, Decoder, Direction, Drive, FULL_DUTY,
    FirmwareVersion, Frame, FrameKind, HelloAck, LastCommand, Packet, Parameter, ParameterWrite, Session, Telemetry,
    TimeSyncAck, encode,
};
use crate::speed_control::{Encoder, Gains, MotorOrder, SpeedControl};
use crate::units::{m_s_of_mm_s, mm_s_of_m_s, rad_of_tenth_mrad, servo_us_of_rad, tenth_mrad_of_rad};
use crate::watch::{BatteryWatch, EncoderWatch, NoiseWatch};

/// The model's own version, as in its `HelloAck`.
pub const FIRMWARE: FirmwareVersion = FirmwareVersion { major: 0, minor: 1, patch: 0 };
/// Stands for "nothing valid is stored" in a `CalibrationState`.
const NOTHING_STORED: u16 = 0xFFFF;
/// Between two telemetry frames, µs.
pub const TELEMETRY_PERIOD_US: u64 = 10_000;

const CAPABILITIES: Capabilities = Capabilities::SPEED_CONTROL
    .and(Capabilities::BATTERY)
    .and(Capabilities::ESTOP_INPUT)
    .and(Capabilities::RAW_DUTY)
    .and(Capabilities::CALIBRATION)
    .and(Capabilities::TIME_SYNC);
/// Faults that stop the motor. The others are told and the car goes on.
pub const STOPPING_FAULTS: FaultSet = FaultSet::NONE
    .with(Fault::LeaseExpired)
    .with(Fault::EstopPressed)
    .with(Fault::EstopByHost)
    .with(Fault::BatteryLow)
    .with(Fault::EncoderSilent)
    .with(Fault::WatchdogReset);

/// A command in force.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Leased {
    drive: Push,
    until_us: u64,
}

/// How the motor shall turn, in SI units.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
enum Push {
    /// With this speed, m/s.
    Speed(f32),
    /// With this duty, -1 to 1.
    Duty(f32),
}

/// A duty on its way to 0 after the end of a lease.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct RunOut {
    duty: f32,
    from_us: u64,
}

/// The microcontroller. Times are µs since its start.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct McuModel {
    decoder: Decoder,
    next_seq: u16,
    session: Option<Session>,
    last_command: Option<(u16, u64)>,
    leased: Option<Leased>,
    steering_rad: Option<f32>,
    faults: FaultSet,
    sensors: Option<McuSensors>,
    battery: BatteryWatch,
    encoder_watch: EncoderWatch,
    noise: NoiseWatch,
    encoder: Encoder,
    control: SpeedControl,
    /// The set speed on its way to the one of the command.
    set_speed_m_s: f32,
    last_drive_us: Option<u64>,
    motor: MotorOrder,
    run_out: Option<RunOut>,
    calibration: Calibration,
    stored: Option<Calibration>,
    next_telemetry_us: u64,
}

impl McuModel {
    /// A chip that has just started. Below `battery_low_v` it does not drive.
    pub fn new(battery_low_v: f32) -> Self {
        let mut calibration = Calibration::default();
        // Out of the parameter's range is out of the caller's, too.
        let _ = calibration.set(Param::BatteryLowMv, (battery_low_v * 1_000.0).round() as i32);
        Self {
            decoder: Decoder::new(Direction::FromHost),
            next_seq: 0,
            session: None,
            last_command: None,
            leased: None,
            steering_rad: None,
            faults: FaultSet::NONE,
            sensors: None,
            battery: BatteryWatch::new(battery_low_v),
            encoder_watch: EncoderWatch::default(),
            noise: NoiseWatch::default(),
            encoder: Encoder::default(),
            control: SpeedControl::default(),
            set_speed_m_s: 0.0,
            last_drive_us: None,
            motor: MotorOrder::BRAKE,
            run_out: None,
            calibration,
            stored: None,
            next_telemetry_us: 0,
        }
    }

    /// Takes bytes that arrived at `at_us` and appends its answers to `reply`.
    pub fn receive(&mut self, at_us: u64, bytes: &[u8], reply: &mut Vec<u8>) {
        // First the time, then the bytes: a command that comes after the lease has run out revives nothing.
        self.watch_lease(at_us);
        for byte in bytes {
            match self.decoder.push(*byte) {
                Some(Ok(packet)) => self.obey(packet, at_us, reply),
                Some(Err(error)) if error.is_foreign(FrameKind::EStop) => self.stop(Fault::EstopByHost),
                Some(Err(error)) if error.is_foreign(FrameKind::Hello) => self.answer(Session(0), reply),
                Some(Err(_)) => self.noise.count(),
                None => {}
            }
        }
    }

    /// Lets time pass until `now_us`, appends telemetry to `reply` when it is due, and gives the pins. `sensors` is the newest
    /// reading; `None` before the first.
    pub fn step(&mut self, now_us: u64, sensors: Option<&McuSensors>, reply: &mut Vec<u8>) -> McuPins {
        self.watch_lease(now_us);
        if let Some(sensors) = sensors {
            self.encoder.read(sensors, now_us);
            self.sensors = Some(*sensors);
            self.watch_sensors(sensors, now_us);
        }
        self.watch_noise(now_us);
        self.drive(now_us);
        if now_us >= self.next_telemetry_us {
            let telemetry = self.telemetry(now_us);
            self.send(Frame::Telemetry(telemetry), reply);
            self.next_telemetry_us = (now_us / TELEMETRY_PERIOD_US + 1) * TELEMETRY_PERIOD_US;
        }
        McuPins {
            servo_us: self.steering_rad.map(|angle_rad| servo_us_of_rad(angle_rad, &self.calibration)),
            motor_duty: self.motor.duty,
            brake: self.motor.brake,
        }
    }

    /// Another limit of the battery, from the next reading on.
    pub fn set_battery_low(&mut self, battery_low_v: f32) {
        let _ = self.calibration.set(Param::BatteryLowMv, (battery_low_v * 1_000.0).round() as i32);
        self.battery.set_low(battery_low_v);
    }

    /// Whether all that moves something is a number within its limits: a model that came as bytes may hold anything.
    pub fn is_sane(&self) -> bool {
        let within = match self.leased.map(|leased| leased.drive) {
            Some(Push::Speed(speed_m_s)) => speed_m_s.abs() <= self.full_duty_m_s(),
            Some(Push::Duty(duty)) => duty.abs() <= 1.0,
            None => true,
        };
        let run_out = self.run_out.map_or(0.0, |run_out| run_out.duty);
        within
            && self.steering_rad.unwrap_or(0.0).abs() <= self.steering_limit_rad()
            && self.set_speed_m_s.is_finite()
            && self.motor.duty.abs() <= 1.0
            && run_out.abs() <= 1.0
            && self.control.is_sane()
            && Param::ALL.into_iter().all(|param| param.allows(self.calibration.get(param)))
    }

    /// Faults in force.
    pub fn faults(&self) -> FaultSet {
        self.faults
    }

    /// A session is open, the lease runs, and no fault stops the motor.
    pub fn driving(&self) -> bool {
        self.session.is_some() && self.leased.is_some() && !self.stopped()
    }

    fn stopped(&self) -> bool {
        self.faults.0 & STOPPING_FAULTS.0 != 0
    }

    fn obey(&mut self, packet: Packet, at_us: u64, reply: &mut Vec<u8>) {
        match packet.frame {
            Frame::Hello(session) => {
                if self.session != Some(session) {
                    self.halt();
                    self.session = Some(session);
                }
                self.answer(session, reply);
            }
            Frame::Command(command) if self.session == Some(command.session) => {
                self.last_command = Some((packet.seq, at_us));
                self.take_command(command, at_us);
            }
            Frame::EStop => self.stop(Fault::EstopByHost),
            Frame::FaultClear(session) if self.session == Some(session) => self.clear_faults(),
            Frame::Release(session) if self.session == Some(session) => self.halt(),
            Frame::TimeSync(token) => {
                let now_us = at_us as u32;
                self.send(Frame::TimeSyncAck(TimeSyncAck { token, received_us: now_us, sent_us: now_us }), reply);
            }
            Frame::ParameterRead(index) => self.tell_parameter(index, CalibrationStatus::Done, reply),
            Frame::ParameterWrite(write) => {
                let status = self.write_parameter(write);
                self.tell_parameter(write.index, status, reply);
            }
            Frame::CalibrationStore(CalibrationStore { session, crc }) => {
                let status = self.store(session, crc);
                self.tell_calibration(status, reply);
            }
            Frame::CalibrationDefaults(session) => {
                let status = self.may_calibrate(session);
                if status == CalibrationStatus::Done {
                    self.calibration = Calibration::default();
                    self.calibration_changed();
                }
                self.tell_calibration(status, reply);
            }
            Frame::CalibrationQuery => self.tell_calibration(CalibrationStatus::Done, reply),
            // Another session's, or the chip's own kinds, which the decoder refuses.
            _ => {}
        }
    }

    fn take_command(&mut self, command: Command, at_us: u64) {
        if self.stopped() {
            return;
        }
        let (limit_rad, limit_m_s) = (self.steering_limit_rad(), self.full_duty_m_s());
        self.steering_rad = Some(rad_of_tenth_mrad(command.steering_tenth_mrad).clamp(-limit_rad, limit_rad));
        let drive = match command.drive {
            Drive::Speed(speed_mm_s) => Push::Speed(m_s_of_mm_s(speed_mm_s).clamp(-limit_m_s, limit_m_s)),
            Drive::Duty(duty) => Push::Duty(f32::from(duty) / f32::from(FULL_DUTY)),
        };
        self.run_out = None;
        self.leased = Some(Leased { drive, until_us: at_us + u64::from(command.lease_ms) * 1_000 });
    }

    fn steering_limit_rad(&self) -> f32 {
        self.calibration.get(Param::SteeringLimitTenthMrad) as f32 / 10_000.0
    }

    fn full_duty_m_s(&self) -> f32 {
        self.calibration.get(Param::FullDutySpeedMmS) as f32 / 1_000.0
    }

    fn may_calibrate(&self, session: Session) -> CalibrationStatus {
        if self.session != Some(session) {
            CalibrationStatus::NotTheSession
        } else if self.leased.is_some() {
            CalibrationStatus::Driving
        } else {
            CalibrationStatus::Done
        }
    }

    fn write_parameter(&mut self, write: ParameterWrite) -> CalibrationStatus {
        let may = self.may_calibrate(write.session);
        if may != CalibrationStatus::Done {
            return may;
        }
        let Some(param) = Param::ALL.get(usize::from(write.index)) else { return CalibrationStatus::NoSuchParameter };
        match self.calibration.set(*param, write.value) {
            Ok(()) => {
                self.calibration_changed();
                CalibrationStatus::Done
            }
            Err(status) => status,
        }
    }

    fn calibration_changed(&mut self) {
        self.battery.set_low(self.calibration.get(Param::BatteryLowMv) as f32 / 1_000.0);
    }

    fn store(&mut self, session: Session, crc: u16) -> CalibrationStatus {
        let may = self.may_calibrate(session);
        if may != CalibrationStatus::Done {
            return may;
        }
        if crc != self.calibration.crc() {
            return CalibrationStatus::CrcDiffers;
        }
        self.stored = Some(self.calibration);
        self.faults = self.faults.without(Fault::CalibrationInvalid);
        CalibrationStatus::Done
    }

    fn tell_parameter(&mut self, index: u8, status: CalibrationStatus, reply: &mut Vec<u8>) {
        let known = Param::ALL.get(usize::from(index)).map(|param| self.calibration.get(*param));
        let status = if known.is_none() { CalibrationStatus::NoSuchParameter } else { status };
        self.send(Frame::Parameter(Parameter { index, status, value: known.unwrap_or(0) }), reply);
    }

    fn tell_calibration(&mut self, status: CalibrationStatus, reply: &mut Vec<u8>) {
        let state = CalibrationState {
            status,
            count: SPECS.len() as u8,
            crc_in_force: self.calibration.crc(),
            crc_stored: self.stored.map_or(NOTHING_STORED, |stored| stored.crc()),
        };
        self.send(Frame::Calibration(state), reply);
    }

    fn answer(&mut self, session: Session, reply: &mut Vec<u8>) {
        let calibration_crc = self.calibration.crc();
        let ack = HelloAck { session, firmware: FIRMWARE, capabilities: CAPABILITIES, calibration_crc };
        self.send(Frame::HelloAck(ack), reply);
    }

    fn send(&mut self, frame: Frame, reply: &mut Vec<u8>) {
        encode(&Packet { seq: self.next_seq, frame }, reply);
        self.next_seq = self.next_seq.wrapping_add(1);
    }

    /// Brakes and ends the session. The steering stays where it is: centring it in a bend would leave the lane.
    fn halt(&mut self) {
        self.session = None;
        self.last_command = None;
        self.leased = None;
        self.run_out = None;
        self.set_speed_m_s = 0.0;
        self.encoder_watch = EncoderWatch::default();
        self.control.reset();
        self.motor = MotorOrder::BRAKE;
    }

    /// Latches a fault that stops.
    fn stop(&mut self, fault: Fault) {
        self.faults = self.faults.with(fault);
        self.halt();
    }

    fn watch_lease(&mut self, now_us: u64) {
        let Some(leased) = self.leased.filter(|leased| now_us >= leased.until_us) else { return };
        let duty = self.motor.duty;
        self.stop(Fault::LeaseExpired);
        if duty != 0.0 && self.calibration.get(Param::LeaseRampMs) > 0 {
            self.run_out = Some(RunOut { duty, from_us: leased.until_us });
        }
    }

    /// What is left of the motor's duty after the end of a lease.
    fn running_out(&mut self, now_us: u64) -> MotorOrder {
        let ramp_us = self.calibration.get(Param::LeaseRampMs) as f32 * 1_000.0;
        let left = self.run_out.map(|run_out| {
            let gone_us = now_us.saturating_sub(run_out.from_us) as f32;
            run_out.duty * (1.0 - gone_us / ramp_us.max(1.0))
        });
        match (left, self.run_out) {
            (Some(left), Some(run_out)) if left * run_out.duty > 0.0 => MotorOrder { duty: left, brake: false },
            _ => {
                self.run_out = None;
                MotorOrder::BRAKE
            }
        }
    }

    /// The set speed, nearer to the commanded one by what the ramp allows.
    fn ramp(&mut self, wanted_m_s: f32, elapsed_us: u64) -> f32 {
        let limit_m_s2 = self.calibration.get(Param::AccelerationMmS2) as f32 / 1_000.0;
        let most_m_s = limit_m_s2 * elapsed_us as f32 * 1e-6;
        let missing_m_s = wanted_m_s - self.set_speed_m_s;
        self.set_speed_m_s =
            if limit_m_s2 > 0.0 { self.set_speed_m_s + missing_m_s.clamp(-most_m_s, most_m_s) } else { wanted_m_s };
        self.set_speed_m_s
    }

    fn watch_sensors(&mut self, sensors: &McuSensors, now_us: u64) {
        if sensors.estop_pressed && !self.faults.contains(Fault::EstopPressed) {
            self.stop(Fault::EstopPressed);
        }
        if self.battery.is_low(sensors.battery_v, now_us) && !self.faults.contains(Fault::BatteryLow) {
            self.stop(Fault::BatteryLow);
        }
    }

    /// The one fault that comes and goes by itself.
    fn watch_noise(&mut self, now_us: u64) {
        let noisy = self.noise.is_noisy(now_us);
        self.faults = if noisy { self.faults.with(Fault::LinkNoisy) } else { self.faults.without(Fault::LinkNoisy) };
    }

    /// Clears what is latched; what still has its cause stays.
    fn clear_faults(&mut self) {
        let pressed = self.sensors.is_some_and(|sensors| sensors.estop_pressed);
        let battery_low = self.sensors.is_some_and(|sensors| !self.battery.is_good(sensors.battery_v));
        let persists = |fault| match fault {
            Fault::EstopPressed => pressed,
            Fault::BatteryLow => battery_low,
            Fault::LinkNoisy | Fault::CalibrationInvalid => true,
            _ => false,
        };
        self.faults = self.faults.iter().filter(|fault| persists(*fault)).fold(FaultSet::NONE, FaultSet::with);
    }

    fn wheel_m_s(&self, now_us: u64) -> f32 {
        let tick_m = f64::from(self.calibration.get(Param::EncoderTickNm)) * 1e-9;
        self.encoder.speed_m_s(tick_m, now_us)
    }

    fn drive(&mut self, now_us: u64) {
        let elapsed_us = now_us.saturating_sub(self.last_drive_us.replace(now_us).unwrap_or(now_us));
        let gains = Gains::of(&self.calibration);
        self.motor = match self.leased.map(|leased| leased.drive) {
            Some(Push::Speed(speed_m_s)) if !self.stopped() => {
                let set_m_s = self.ramp(speed_m_s, elapsed_us);
                self.control.step(&gains, set_m_s, self.wheel_m_s(now_us), now_us)
            }
            Some(Push::Duty(duty)) if !self.stopped() => {
                self.control.pushes(duty);
                MotorOrder { duty: gains.over_friction(duty), brake: duty == 0.0 }
            }
            _ => self.running_out(now_us),
        };
        let silent_us = self.encoder.since_tick_us(now_us);
        let driven = if self.run_out.is_some() { 0.0 } else { self.motor.duty };
        if self.encoder_watch.is_silent(driven, silent_us, now_us) {
            self.stop(Fault::EncoderSilent);
        }
    }

    fn telemetry(&self, now_us: u64) -> Telemetry {
        let speed_m_s = self.control.direction() * self.wheel_m_s(now_us);
        let last_command = self.last_command.map(|(seq, at_us)| LastCommand {
            seq,
            age_us: u16::try_from(now_us.saturating_sub(at_us)).unwrap_or(u16::MAX),
        });
        Telemetry {
            session: self.session,
            ticks: self.encoder.ticks(),
            tick_period_us: self.encoder.period_us(now_us),
            speed_mm_s: mm_s_of_m_s(speed_m_s),
            steering_tenth_mrad: tenth_mrad_of_rad(self.steering_rad.unwrap_or(0.0)),
            battery_mv: self.sensors.map(|sensors| (sensors.battery_v * 1_000.0).round() as u16),
            faults: self.faults,
            driving: self.driving(),
            last_command,
            chip_time_us: now_us as u32,
            damaged_frames: self.decoder.damage().total() as u16,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::encode_with_version;

    const SESSION: Session = Session(0x1234);

    /// A chip on the bench: its time, its pins, and a host that says what the test wants.
    struct Bench {
        model: McuModel,
        now_us: u64,
        seq: u16,
        sensors: McuSensors,
        pins: McuPins,
        encoder_works: bool,
        heard: Vec<Frame>,
    }

    impl Bench {
        fn new() -> Self {
            let sensors =
                McuSensors { encoder_ticks: 0, encoder_period_us: None, battery_v: 8.0, estop_pressed: false };
            let pins = McuPins { servo_us: None, motor_duty: 0.0, brake: false };
            Self { model: McuModel::new(6.4), now_us: 0, seq: 0, sensors, pins, encoder_works: true, heard: Vec::new() }
        }

        fn driving() -> Self {
            let mut bench = Self::new();
            bench.say(Frame::Hello(SESSION));
            bench.say(command(SESSION, 500, 200));
            bench.run_ms(5);
            assert!(bench.pins.motor_duty > 0.0 && bench.model.driving(), "it drives: {:?}", bench.pins);
            bench
        }

        fn bytes(&mut self, bytes: &[u8]) {
            let mut reply = Vec::new();
            self.model.receive(self.now_us, bytes, &mut reply);
            self.hear(&reply);
        }

        fn say(&mut self, frame: Frame) {
            let mut bytes = Vec::new();
            encode(&Packet { seq: self.seq, frame }, &mut bytes);
            self.seq += 1;
            self.bytes(&bytes);
        }

        fn hear(&mut self, reply: &[u8]) {
            let mut decoder = Decoder::new(Direction::FromChip);
            self.heard.extend(reply.iter().filter_map(|byte| decoder.push(*byte)).map(|r| r.expect("intact").frame));
        }

        /// Steps every 5 ms with a wheel that turns while the motor does.
        fn run_ms(&mut self, ms: u64) {
            for _ in 0..ms / 5 {
                self.now_us += 5_000;
                let mut reply = Vec::new();
                self.pins = self.model.step(self.now_us, Some(&self.sensors), &mut reply);
                self.hear(&reply);
                if self.pins.motor_duty != 0.0 && self.encoder_works {
                    self.sensors.encoder_ticks += 2;
                    self.sensors.encoder_period_us = Some(2_500);
                }
            }
        }

        fn telemetry(&self) -> Telemetry {
            let last = self.heard.iter().rev().find_map(|frame| match frame {
                Frame::Telemetry(telemetry) => Some(*telemetry),
                _ => None,
            });
            last.expect("telemetry has come")
        }

        fn braking(&self) -> bool {
            self.pins.brake && self.pins.motor_duty == 0.0 && !self.model.driving()
        }
    }

    fn command(session: Session, speed_mm_s: i16, lease_ms: u16) -> Frame {
        Frame::Command(Command { session, steering_tenth_mrad: 1_000, drive: Drive::Speed(speed_mm_s), lease_ms })
    }

    #[test]
    fn nothing_moves_before_the_handshake() {
        let mut bench = Bench::new();
        bench.say(command(SESSION, 500, 200));
        bench.run_ms(50);
        assert!(bench.braking() && bench.pins.servo_us.is_none(), "no wheel and no servo: {:?}", bench.pins);
        assert_eq!(bench.telemetry().session, None, "telemetry comes, and says that no session is open");
        bench.say(Frame::Hello(SESSION));
        bench.say(command(Session(9), 500, 200));
        bench.run_ms(50);
        assert!(bench.braking(), "nor for a command of another session");
        assert_eq!(bench.model.faults(), FaultSet::NONE, "which is no fault");
    }

    #[test]
    fn brakes_within_ten_ms_of_the_end_of_the_lease_and_latches() {
        for lease_ms in [1_u16, 20, 200, 2_000] {
            let mut bench = Bench::driving();
            bench.say(command(SESSION, 500, lease_ms));
            let from_us = bench.now_us;
            while !bench.braking() {
                bench.run_ms(5);
            }
            let over_us = bench.now_us - from_us - u64::from(lease_ms) * 1_000;
            assert!(over_us <= 10_000, "lease {lease_ms} ms: braked {over_us} us late");
            bench.run_ms(10);
            assert_eq!(bench.model.faults(), FaultSet::NONE.with(Fault::LeaseExpired), "latched and named");
            assert!(bench.pins.servo_us.is_some(), "the servo holds its angle");
        }
    }

    #[test]
    fn after_the_lease_only_handshake_and_fault_clear_drive_again() {
        let mut bench = Bench::driving();
        bench.run_ms(500);
        bench.say(command(SESSION, 500, 200));
        bench.run_ms(10);
        assert!(bench.braking(), "a command alone is not enough");
        bench.say(Frame::FaultClear(SESSION));
        bench.say(command(SESSION, 500, 200));
        bench.run_ms(10);
        assert!(bench.braking(), "nor a clear in the old session");
        bench.say(Frame::Hello(Session(2)));
        bench.say(command(Session(2), 500, 200));
        bench.run_ms(10);
        assert!(bench.braking(), "nor a handshake without a clear");
        assert_eq!(bench.telemetry().last_command.map(|last| last.seq), Some(bench.seq - 1), "but it was heard");
        bench.say(Frame::FaultClear(Session(2)));
        bench.run_ms(10);
        assert!(bench.braking(), "and the command before the clear does not come back");
        bench.say(command(Session(2), 500, 200));
        bench.run_ms(10);
        assert!(bench.model.driving() && bench.pins.motor_duty > 0.0, "all three together drive");
    }

    #[test]
    fn a_command_that_comes_too_late_revives_nothing() {
        let mut bench = Bench::driving();
        bench.now_us += 300_000;
        bench.say(command(SESSION, 500, 200));
        bench.run_ms(5);
        assert!(bench.braking(), "the lease had run out before the bytes came");
    }

    #[test]
    fn estop_by_host_and_by_button_stop_at_once_and_latch() {
        let mut bench = Bench::driving();
        bench.say(Frame::EStop);
        bench.run_ms(5);
        assert!(bench.braking() && bench.model.faults().contains(Fault::EstopByHost), "by the host");

        let mut bench = Bench::driving();
        bench.sensors.estop_pressed = true;
        bench.run_ms(5);
        assert!(bench.braking() && bench.model.faults().contains(Fault::EstopPressed), "by the button");
        bench.say(Frame::Hello(Session(2)));
        bench.say(Frame::FaultClear(Session(2)));
        bench.run_ms(5);
        assert!(bench.model.faults().contains(Fault::EstopPressed), "a pressed button cannot be cleared");
        bench.sensors.estop_pressed = false;
        bench.run_ms(5);
        assert!(bench.model.faults().contains(Fault::EstopPressed), "releasing it is not enough");
        bench.say(Frame::FaultClear(Session(2)));
        assert_eq!(bench.model.faults(), FaultSet::NONE, "both together are");
    }

    #[test]
    fn another_version_is_answered_but_not_obeyed_except_for_its_estop() {
        let mut bench = Bench::driving();
        let mut bytes = Vec::new();
        encode_with_version(2, &Packet { seq: 0, frame: Frame::Hello(Session(7)) }, &mut bytes);
        bench.bytes(&bytes);
        bench.run_ms(5);
        let answered = matches!(bench.heard[..], [.., Frame::HelloAck(ack), _] if ack.session == Session(0));
        assert!(answered, "the answer tells the host our version: {:?}", bench.heard);
        assert!(bench.model.driving(), "the session that is open goes on");
        bytes.clear();
        encode_with_version(2, &Packet { seq: 0, frame: Frame::EStop }, &mut bytes);
        bench.bytes(&bytes);
        bench.run_ms(5);
        assert!(bench.braking(), "an e-stop is an e-stop in every version");
    }

    #[test]
    fn a_release_brakes_without_a_fault_and_the_same_hello_changes_nothing() {
        let mut bench = Bench::driving();
        bench.say(Frame::Hello(SESSION));
        bench.run_ms(5);
        assert!(bench.model.driving(), "a repeated hello (its answer was lost) does not stop the car");
        bench.say(Frame::Release(SESSION));
        bench.run_ms(500);
        assert!(bench.braking() && bench.model.faults().is_empty(), "stopped in order: {:?}", bench.model.faults());
    }

    #[test]
    fn stops_for_a_low_battery_and_a_silent_encoder() {
        let mut bench = Bench::driving();
        bench.sensors.battery_v = 5.0;
        (0..25).for_each(|_| {
            bench.say(command(SESSION, 500, 200));
            bench.run_ms(50);
        });
        assert!(bench.braking() && bench.model.faults().contains(Fault::BatteryLow), "{:?}", bench.model.faults());

        let mut bench = Bench::driving();
        bench.encoder_works = false;
        (0..25).for_each(|_| {
            bench.say(command(SESSION, 500, 200));
            bench.run_ms(50);
        });
        assert!(bench.braking() && bench.model.faults().contains(Fault::EncoderSilent), "{:?}", bench.model.faults());
    }

    #[test]
    fn noise_is_told_and_does_not_stop() {
        let mut bench = Bench::driving();
        for _ in 0..30 {
            bench.bytes(&[1, 2, 3, 0].repeat(5));
            bench.say(command(SESSION, 500, 200));
            bench.run_ms(10);
        }
        assert_eq!(bench.model.faults(), FaultSet::NONE.with(Fault::LinkNoisy), "150 damaged frames in 0.3 s");
        assert!(bench.model.driving(), "good frames still get through");
        assert_eq!(bench.telemetry().damaged_frames, 150, "the chip counts them");
    }

    /// The chip's last answer to a question for its calibration.
    fn status(bench: &Bench) -> CalibrationStatus {
        let last = bench.heard.iter().rev().find_map(|frame| match frame {
            Frame::Parameter(parameter) => Some(parameter.status),
            Frame::Calibration(state) => Some(state.status),
            _ => None,
        });
        last.expect("it was asked")
    }

    fn write(session: Session, param: Param, value: i32) -> Frame {
        Frame::ParameterWrite(ParameterWrite { session, index: param as u8, value })
    }

    #[test]
    fn a_calibration_changes_only_in_the_session_while_nothing_drives() {
        let mut bench = Bench::driving();
        bench.say(write(SESSION, Param::ServoCenterUs, 1_000));
        assert_eq!(status(&bench), CalibrationStatus::Driving, "it drives");
        bench.say(Frame::Release(SESSION));
        bench.say(write(SESSION, Param::ServoCenterUs, 1_000));
        assert_eq!(status(&bench), CalibrationStatus::NotTheSession, "the session is over");
        bench.say(Frame::Hello(Session(2)));
        bench.say(write(Session(2), Param::ServoCenterUs, 3_000));
        assert_eq!(status(&bench), CalibrationStatus::OutOfRange, "no servo takes that");
        bench.say(Frame::ParameterWrite(ParameterWrite { session: Session(2), index: 24, value: 0 }));
        assert_eq!(status(&bench), CalibrationStatus::NoSuchParameter, "there are 24");
        assert_eq!(bench.model.calibration, Calibration::default(), "nothing has changed");
        bench.say(write(Session(2), Param::ServoCenterUs, 1_000));
        let center = Parameter { index: 2, status: CalibrationStatus::Done, value: 1_000 };
        assert_eq!(bench.heard.last(), Some(&Frame::Parameter(center)), "in force");
        let store = |crc| Frame::CalibrationStore(CalibrationStore { session: Session(2), crc });
        bench.say(store(Calibration::default().crc()));
        assert_eq!(status(&bench), CalibrationStatus::CrcDiffers, "the host means other values");
        assert_eq!(bench.model.stored, None, "nothing was stored");
        let crc = bench.model.calibration.crc();
        bench.say(store(crc));
        let stored =
            CalibrationState { status: CalibrationStatus::Done, count: 24, crc_in_force: crc, crc_stored: crc };
        assert_eq!(bench.heard.last(), Some(&Frame::Calibration(stored)), "stored");
        bench.say(Frame::CalibrationDefaults(Session(2)));
        assert_eq!(bench.model.calibration, Calibration::default(), "back to what it was built with");
        assert_eq!(bench.model.stored.map(|stored| stored.crc()), Some(crc), "until the next restart");
    }

    #[test]
    fn a_duty_is_passed_on_and_a_lease_may_run_out_over_a_ramp() {
        let mut bench = Bench::new();
        bench.say(Frame::Hello(SESSION));
        bench.say(write(SESSION, Param::LeaseRampMs, 100));
        let command = Command { session: SESSION, steering_tenth_mrad: 0, drive: Drive::Duty(-510), lease_ms: 50 };
        bench.say(Frame::Command(command));
        bench.run_ms(5);
        assert_eq!((bench.pins.motor_duty, bench.pins.brake), (-0.5, false), "half of it, backwards");
        bench.run_ms(95);
        assert_eq!(bench.model.faults(), FaultSet::NONE.with(Fault::LeaseExpired), "told at once");
        assert!((bench.pins.motor_duty + 0.25).abs() < 0.03, "half way down: {:?}", bench.pins);
        bench.run_ms(60);
        assert!(bench.braking(), "then it brakes: {:?}", bench.pins);

        let mut bench = Bench::new();
        bench.say(Frame::Hello(SESSION));
        bench.say(write(SESSION, Param::LeaseRampMs, 1_000));
        bench.say(Frame::Command(command));
        bench.run_ms(100);
        assert!(bench.pins.motor_duty < 0.0, "on its way down");
        bench.say(Frame::EStop);
        bench.run_ms(5);
        assert!(bench.braking(), "an e-stop waits for no ramp");
    }

    #[test]
    fn a_set_speed_may_be_reached_over_a_ramp() {
        let mut bench = Bench::new();
        bench.say(Frame::Hello(SESSION));
        bench.say(write(SESSION, Param::AccelerationMmS2, 1_000));
        bench.say(command(SESSION, 1_000, 2_000));
        bench.run_ms(5);
        bench.run_ms(300);
        assert!((bench.model.set_speed_m_s - 0.3).abs() < 0.01, "1 m/s2 for 0.3 s: {}", bench.model.set_speed_m_s);
    }

    #[test]
    fn the_chip_tells_its_time() {
        let mut bench = Bench::new();
        bench.run_ms(40);
        bench.say(Frame::TimeSync(77));
        let ack = TimeSyncAck { token: 77, received_us: 40_000, sent_us: 40_000 };
        assert_eq!(bench.heard.last(), Some(&Frame::TimeSyncAck(ack)), "without a session");
    }

    #[test]
    fn telemetry_comes_a_hundred_times_a_second() {
        let mut bench = Bench::new();
        bench.run_ms(5);
        bench.heard.clear();
        bench.run_ms(1_000);
        assert_eq!(bench.heard.len(), 100, "frames in a second of 5 ms steps");
    }
}
