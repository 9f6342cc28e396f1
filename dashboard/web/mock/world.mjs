// A car on an oval, with what its nodes would say. Enough to develop and test the page; the physics of carril live elsewhere.
import { SOURCE, leftAt, shadeOf } from "./road.mjs";

const [STRAIGHT_M, RADIUS_M] = [2.4, 1.1];
const LAP_M = 2 * STRAIGHT_M + 2 * Math.PI * RADIUS_M;
const STEERING_IN_BEND = Math.atan(0.26 / RADIUS_M);

function poseAt(s) {
  const at = s % LAP_M;
  const arc = Math.PI * RADIUS_M;
  if (at < STRAIGHT_M) return { x_m: at - STRAIGHT_M / 2, y_m: -RADIUS_M, yaw_rad: 0, bend: 0 };
  if (at < STRAIGHT_M + arc) return bendAt((at - STRAIGHT_M) / RADIUS_M, STRAIGHT_M / 2, -Math.PI / 2);
  if (at < 2 * STRAIGHT_M + arc) return { x_m: STRAIGHT_M / 2 - (at - STRAIGHT_M - arc), y_m: RADIUS_M, yaw_rad: Math.PI, bend: 0 };
  return bendAt((at - 2 * STRAIGHT_M - arc) / RADIUS_M, -STRAIGHT_M / 2, Math.PI / 2);
}

function bendAt(turned, centre, from) {
  const angle = from + turned;
  return { x_m: centre + RADIUS_M * Math.cos(angle), y_m: RADIUS_M * Math.sin(angle), yaw_rad: angle + Math.PI / 2, bend: 1 };
}

export class World {
  constructor() {
    this.state = "lane-follow";
    this.reason = "auto_start";
    this.since_ms = 0;
    this.transitions = 1;
    this.speed = 0;
    this.s = 0;
    this.bend = 0;
    this.faults = 0;
    this.manual = null;
    this.seconds = 0;
  }

  enter(state, reason, now_ms) {
    if (state === this.state) return;
    Object.assign(this, { state, reason, since_ms: now_ms, transitions: this.transitions + 1 });
  }

  control(word, now_ms) {
    if (word === "estop") this.enter("e-stop", "e-stop by a person", now_ms);
    else if (word === "reset") {
      this.faults = 0;
      this.enter("idle", "reset by a person", now_ms);
    } else if (this.state !== "e-stop") this.enter(word === "start" ? "lane-follow" : "idle", `${word} by a person`, now_ms);
  }

  step(dt, now_ms) {
    this.seconds += dt;
    if (this.manual && now_ms - this.manual.at_ms > 300) this.manual = null;
    const blocked = this.seconds % 40 > 34;
    if (this.state === "lane-follow" && blocked) this.enter("obstacle-stop", "front occupied (nearest 0.46 m)", now_ms);
    if (this.state === "obstacle-stop" && !blocked) this.enter("lane-follow", "front clear for 1.0 s (nearest 1.32 m)", now_ms);
    this.blocked = blocked;
    this.target = this.state === "e-stop" ? 0 : this.manual ? this.manual.speed_m_s : this.state === "lane-follow" ? 0.5 : 0;
    this.speed += Math.max(-3 * dt, Math.min(1.5 * dt, this.target - this.speed));
    this.s = (this.s + this.speed * dt + 1000 * LAP_M) % (1000 * LAP_M);
    this.pose = poseAt(this.s);
    this.bend += (poseAt(this.s + 0.35).bend - this.bend) * Math.min(1, dt * 3);
    this.steering = this.manual ? this.manual.steering_rad : this.bend * STEERING_IN_BEND + 0.02 * Math.sin(this.seconds * 2.1);
    this.shade = shadeOf(this.bend * 0.9 + 0.12 * Math.sin(this.seconds * 0.9));
  }

  lane(config) {
    const centroid = (row) => {
      const ahead_px = SOURCE.height - 1 - Math.floor(row * SOURCE.height);
      return { left_px: leftAt(ahead_px, this.shade), ahead_px, pixels: 22 };
    };
    const [far, near] = [centroid(config.row_far), centroid(config.row_near)];
    const angle_rad = Math.atan((far.left_px - near.left_px) / (far.ahead_px - near.ahead_px));
    const distance_px = (far.left_px - Math.tan(angle_rad) * far.ahead_px) * Math.cos(angle_rad);
    const seen = config.threshold === "otsu" || config.threshold < 230;
    return { lane: seen ? { angle_rad, distance_px, distance_m: null, far, near } : null, quality: seen ? 0.93 : 0, threshold: seen ? Number(config.threshold) || 141 : null };
  }

  scan() {
    const ranges_m = [];
    for (let index = 0; index < 360; index++) {
      const bearing = -Math.PI + (index * Math.PI) / 180;
      const wall = Math.min(2.2 / Math.abs(Math.sin(bearing - 0.2)) || 99, 3.4 / Math.abs(Math.cos(bearing - 0.2)) || 99);
      const noise = 0.012 * Math.sin(index * 12.9 + this.seconds * 40);
      const box = this.blocked && Math.abs(bearing) < 0.16 ? 0.46 : 99;
      const cone = Math.abs(bearing - 1.15) < 0.05 ? 0.9 : 99;
      ranges_m.push(index % 41 === 0 ? null : Math.min(wall, box, cone) + noise);
    }
    return { angle_min_rad: -Math.PI, angle_increment_rad: Math.PI / 180, scan_time_s: 0.1, range_min_m: 0.05, range_max_m: 16, ranges_m };
  }

  sectors(config) {
    const { ranges_m } = this.scan();
    return {
      sectors: config.sectors.map((sector) => {
        const [from_rad, raw] = [sector.from_deg, sector.to_deg].map((deg) => (deg * Math.PI) / 180);
        const to_rad = raw < from_rad ? raw + 2 * Math.PI : raw;
        let [nearest_m, nearest_bearing_rad, returns_within] = [null, null, 0];
        for (let bearing = from_rad; bearing <= to_rad; bearing += Math.PI / 180) {
          const range = ranges_m[Math.round(((bearing + Math.PI) * 180) / Math.PI) % 360];
          if (range === null) continue;
          if (range < sector.limit_m) returns_within++;
          if (nearest_m === null || range < nearest_m) [nearest_m, nearest_bearing_rad] = [range, bearing];
        }
        return { name: sector.name, from_rad, to_rad, nearest_m, nearest_bearing_rad, returns_within, occupied: returns_within >= sector.min_returns, coverage: 0.98 };
      }),
    };
  }

  vehicle() {
    const { x_m, y_m, yaw_rad } = this.pose;
    return { pose_in_map: { x_m, y_m, yaw_rad }, speed_m_s: this.speed, yaw_rate_rad_s: 0, steering_rad: this.steering };
  }

  progress() {
    return {
      laps: Math.floor(this.s / LAP_M), last_lap_s: this.s > LAP_M ? 23.4 : null, distance_m: this.s, cross_track_m: 0.014 * Math.sin(this.seconds * 0.7),
      cross_track_rms_m: 0.011, cross_track_max_m: 0.041, departures: 0, outside: false, collisions: 0,
    };
  }

  telemetry() {
    return {
      ticks: Math.floor(this.s * 100), tick_period_us: 2400, speed_m_s: this.speed + 0.008 * Math.sin(this.seconds * 17), steering_rad: this.steering * 0.97,
      battery_v: 7.62 - 0.0004 * this.seconds + 0.01 * Math.sin(this.seconds * 3), faults: this.faults, driving: this.state !== "e-stop",
      last_command_seq: 1, round_trip_us: 2100, frames_lost: 0, frames_damaged: 0,
    };
  }

  decision() {
    return {
      state: this.state, since: Math.round(this.since_ms * 1e6), reason: this.reason, target_speed_m_s: this.target, steering_rad: this.steering, transitions: this.transitions,
    };
  }
}
