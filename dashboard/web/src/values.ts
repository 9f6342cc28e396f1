// The messages of carril that the page draws, read from JSON. A reader answers null for what it cannot use.
import { count, fields, isFields, list, number, numbers, text } from "./read";

export interface Centroid { left_px: number; ahead_px: number; pixels: number }
export interface Lane { angle_rad: number; distance_px: number; distance_m: number | null; far: Centroid; near: Centroid }
export interface LaneEstimate { lane: Lane | null; quality: number; threshold: number | null }
export interface Command { steering_rad: number; speed_m_s: number }
export interface Scan { angle_min_rad: number; angle_increment_rad: number; range_min_m: number; range_max_m: number; ranges_m: (number | null)[] }
export interface Sector { name: string; from_rad: number; to_rad: number; nearest_m: number | null; nearest_bearing_rad: number | null; returns_within: number; occupied: boolean; coverage: number }
export interface Vehicle { x_m: number; y_m: number; yaw_rad: number; speed_m_s: number; steering_rad: number }
export interface Progress { laps: number; last_lap_s: number | null; distance_m: number; cross_track_m: number; cross_track_rms_m: number; departures: number; outside: boolean; collisions: number }
export interface Telemetry { speed_m_s: number; steering_rad: number; battery_v: number | null; faults: number; driving: boolean }
export interface Decision { state: string; since_ms: number; reason: string; target_speed_m_s: number; steering_rad: number; transitions: number }

const readCentroid = (value: unknown): Centroid | null => numbers(value, "left_px", "ahead_px", "pixels");

export function readLane(value: unknown): LaneEstimate | null {
  if (!isFields(value)) return null;
  const estimate = { quality: count(value.quality), threshold: number(value.threshold) };
  if (value.lane === null || value.lane === undefined) return { lane: null, ...estimate };
  const from = fields(value.lane);
  const [line, far, near] = [numbers(from, "angle_rad", "distance_px"), readCentroid(from.far), readCentroid(from.near)];
  if (!line || !far || !near) return null;
  return { lane: { ...line, distance_m: number(from.distance_m), far, near }, ...estimate };
}

export const readCommand = (value: unknown): Command | null => numbers(value, "steering_rad", "speed_m_s");

export function readScan(value: unknown): Scan | null {
  const from = fields(value);
  const shape = numbers(from, "angle_min_rad", "angle_increment_rad", "range_max_m");
  if (!shape || !Array.isArray(from.ranges_m)) return null;
  return { ...shape, range_min_m: count(from.range_min_m), ranges_m: from.ranges_m.map(number) };
}

export function readSectors(value: unknown): Sector[] | null {
  const from = fields(value);
  if (!Array.isArray(from.sectors)) return null;
  const sectors: Sector[] = [];
  for (const each of list(from.sectors).map(fields)) {
    const edges = numbers(each, "from_rad", "to_rad");
    if (!edges) return null;
    sectors.push({
      ...edges, name: text(each.name) ?? "", nearest_m: number(each.nearest_m), nearest_bearing_rad: number(each.nearest_bearing_rad),
      returns_within: count(each.returns_within), occupied: each.occupied === true, coverage: count(each.coverage),
    });
  }
  return sectors;
}

export function readVehicle(value: unknown): Vehicle | null {
  const pose = numbers(fields(value).pose_in_map, "x_m", "y_m", "yaw_rad");
  const motion = numbers(value, "speed_m_s", "steering_rad");
  return pose && motion ? { ...pose, ...motion } : null;
}

export function readProgress(value: unknown): Progress | null {
  const main = numbers(value, "laps", "distance_m", "cross_track_m", "cross_track_rms_m");
  if (!main) return null;
  const from = fields(value);
  return { ...main, last_lap_s: number(from.last_lap_s), departures: count(from.departures), outside: from.outside === true, collisions: count(from.collisions) };
}

export function readTelemetry(value: unknown): Telemetry | null {
  const main = numbers(value, "speed_m_s", "steering_rad");
  if (!main) return null;
  const from = fields(value);
  return { ...main, battery_v: number(from.battery_v), faults: count(from.faults), driving: from.driving === true };
}

export function readDecision(value: unknown): Decision | null {
  const from = fields(value);
  const state = text(from.state);
  const since_ns = number(from.since);
  if (state === null || since_ns === null) return null;
  return {
    state, since_ms: since_ns / 1e6, reason: text(from.reason) ?? "", target_speed_m_s: count(from.target_speed_m_s),
    steering_rad: count(from.steering_rad), transitions: count(from.transitions),
  };
}

/** Bit by bit, as `Fault::text` in messages/src/types/wheel.rs says them. */
const FAULTS = [
  "the lease of the last command ran out; see why the host fell silent, then reset",
  "the e-stop button is pressed; release it, then reset",
  "e-stop by the host; reset, then start",
  "the battery is too low to drive; charge it",
  "the motor is driven, but the encoder counts nothing; check motor, gear and encoder cable",
  "the chip was reset by its watchdog; reset, and report it if it happens again",
  "the stored calibration is damaged; calibrate again",
  "many damaged frames on the serial line; check the cable and its ground",
];

export function faultTexts(bits: number): string[] {
  const texts: string[] = [];
  for (let bit = 0; bit < 16; bit++) if (bits & (1 << bit)) texts.push(FAULTS[bit] ?? `fault ${bit}, unknown to this page`);
  return texts;
}
