//! The device, for simulation and tests: answers requests, turns, and measures what it is told to see. Pure.

use std::f32::consts::{PI, TAU};

use carril_messages::LaserScan;
use serde::{Deserialize, Serialize};

use super::codec::{Answer, CAPSULE_POINTS, Point, encode_capsule, encode_node};

/// Turns a second.
const TURNS_PER_S: f64 = 10.0;
/// Measurements in a turn, standard and express.
const PER_TURN: [u32; 2] = [400, 800];
/// As an A1 with firmware 1.29 says it: model, minor, major, hardware.
const INFO: [u8; 4] = [0x18, 29, 1, 7];
/// No request is longer, B.
const MAX_REQUEST: usize = 64;

/// What the device does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
enum Work {
    Idle,
    Standard,
    Express,
}

/// The device.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RplidarModel {
    /// 0 good, 1 warning, 2 error, and its code.
    health: (u8, u16),
    work: Work,
    request: Vec<u8>,
    /// Measurements since the start of the scan.
    measured: u64,
    /// Time that has not become a measurement yet, s.
    left_s: f64,
}

impl Default for RplidarModel {
    fn default() -> Self {
        Self { health: (0, 0), work: Work::Idle, request: Vec::new(), measured: 0, left_s: 0.0 }
    }
}

impl RplidarModel {
    /// One that is not well until it is reset.
    #[must_use]
    pub fn unwell(status: u8, code: u16) -> Self {
        Self { health: (status, code), ..Self::default() }
    }

    /// Takes in bytes of the host; `out` gets the answers.
    pub fn hear(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.request.extend_from_slice(bytes);
        while let Some(used) = self.next(out) {
            self.request.drain(..used);
        }
        let excess = self.request.len().saturating_sub(MAX_REQUEST);
        self.request.drain(..excess);
    }

    /// How many bytes are done with; `None`: more must come first.
    fn next(&mut self, out: &mut Vec<u8>) -> Option<usize> {
        let [first, command, ..] = self.request[..] else {
            return (self.request.first().is_some_and(|byte| *byte != 0xA5)).then_some(1);
        };
        if first != 0xA5 {
            return Some(1);
        }
        // Commands from 0x80 on have a payload and a checksum.
        let len = if command >= 0x80 { 4 + usize::from(*self.request.get(2)?) } else { 2 };
        let request = self.request.get(..len)?;
        let sound = command < 0x80 || request.iter().fold(0, |sum, byte| sum ^ byte) == 0;
        if !sound {
            return Some(1);
        }
        self.answer(command, out);
        Some(len)
    }

    fn answer(&mut self, command: u8, out: &mut Vec<u8>) {
        match command {
            0x25 => self.work = Work::Idle,
            0x40 => *self = Self { request: std::mem::take(&mut self.request), ..Self::default() },
            0x50 => {
                out.extend(Answer::Info.descriptor());
                out.extend(INFO);
                out.extend(0..16_u8);
            }
            0x52 => {
                out.extend(Answer::Health.descriptor());
                out.push(self.health.0);
                out.extend(self.health.1.to_le_bytes());
            }
            0x20 if self.health.0 < 2 => self.begin(Work::Standard, Answer::Nodes, out),
            0x82 if self.health.0 < 2 => self.begin(Work::Express, Answer::Capsules, out),
            _ => {}
        }
    }

    fn begin(&mut self, work: Work, answer: Answer, out: &mut Vec<u8>) {
        (self.work, self.measured, self.left_s) = (work, 0, 0.0);
        out.extend(answer.descriptor());
    }

    /// Measures for so long what a scan shows; `None`: nothing is around it.
    pub fn turn(&mut self, seconds: f64, scan: Option<&LaserScan>, out: &mut Vec<u8>) {
        let (per_turn, at_once) = match self.work {
            Work::Idle => return,
            Work::Standard => (PER_TURN[0], 1),
            Work::Express => (PER_TURN[1], CAPSULE_POINTS as u64),
        };
        self.left_s += seconds.clamp(0.0, 1.0);
        let takes_s = at_once as f64 / (f64::from(per_turn) * TURNS_PER_S);
        while self.left_s >= takes_s {
            self.left_s -= takes_s;
            self.send(per_turn, scan, out);
            self.measured += at_once;
        }
    }

    fn send(&self, per_turn: u32, scan: Option<&LaserScan>, out: &mut Vec<u8>) {
        let angle_deg = |index: u64| (index % u64::from(per_turn)) as f32 * 360.0 / per_turn as f32;
        if self.work == Work::Standard {
            let clockwise_deg = angle_deg(self.measured);
            let begins = self.measured.is_multiple_of(u64::from(per_turn));
            out.extend(encode_node(&Point { clockwise_deg, range_m: seen(scan, clockwise_deg), begins }));
        } else {
            let ranges = std::array::from_fn(|index| seen(scan, angle_deg(self.measured + index as u64)));
            out.extend(encode_capsule(angle_deg(self.measured), self.measured == 0, &ranges));
        }
    }
}

/// What comes back from a direction of a scan.
fn seen(scan: Option<&LaserScan>, clockwise_deg: f32) -> Option<f32> {
    let scan = scan.filter(|scan| !scan.ranges_m.is_empty() && scan.angle_increment_rad.abs() > 1e-6)?;
    let bearing_rad = (PI - clockwise_deg.to_radians()).rem_euclid(TAU) - PI;
    let from_first = (bearing_rad - scan.angle_min_rad).rem_euclid(TAU);
    let index = (from_first / scan.angle_increment_rad).round();
    let range_m = *scan.ranges_m.get(index as usize % scan.ranges_m.len())?;
    (range_m.is_finite() && range_m > 0.0).then_some(range_m)
}
