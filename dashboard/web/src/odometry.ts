// Where the car went, from what its wheels say (kinematic bicycle, rear axle). Drifts: shown as dead reckoning, never as a position.

export interface Pose { x_m: number; y_m: number; yaw_rad: number }

/** Distance of the axles of the 1:10 car, m. */
const WHEELBASE_M = 0.26;
/** A longer silence is a gap, not a movement: integrating over it would invent a path. */
const LONGEST_STEP_MS = 500;

export class DeadReckoning {
  private last_ms: number | null = null;
  pose: Pose = { x_m: 0, y_m: 0, yaw_rad: 0 };

  step(time_ms: number, speed_m_s: number, steering_rad: number): Pose {
    const elapsed_ms = this.last_ms === null ? 0 : time_ms - this.last_ms;
    this.last_ms = time_ms;
    if (!(elapsed_ms > 0 && elapsed_ms <= LONGEST_STEP_MS)) return this.pose;
    const distance = (speed_m_s * elapsed_ms) / 1000;
    const turn = (distance * Math.tan(steering_rad)) / WHEELBASE_M;
    const heading = this.pose.yaw_rad + turn / 2;
    this.pose = {
      x_m: this.pose.x_m + distance * Math.cos(heading),
      y_m: this.pose.y_m + distance * Math.sin(heading),
      yaw_rad: this.pose.yaw_rad + turn,
    };
    return this.pose;
  }
}
