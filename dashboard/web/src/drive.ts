// Driving by hand: what is held becomes a command 50 times a second, and nothing held becomes `drive_end` at once. Knows no keys and
// no screen; time comes from outside, so that tests need none.

export interface Wish { steering: number; speed: number } // shares of what is allowed, -1 to 1; + is left and forward
export interface Limits { max_speed_m_s: number; max_steering_rad: number }
export interface DriveCommand { steering_rad: number; speed_m_s: number }

export const PERIOD_MS = 20;
const STEERING_PER_S = 4;
const SPEED_PER_S = 2.5;

const clamp = (value: number): number => (Number.isFinite(value) ? Math.min(1, Math.max(-1, value)) : 0);

function towards(from: number, to: number, step: number): number {
  return Math.abs(to - from) <= step ? to : from + Math.sign(to - from) * step;
}

/** Which ways the held keys point. Opposite keys cancel. */
export function wishOfKeys(held: ReadonlySet<string>): Wish | null {
  const any = (...codes: string[]) => (codes.some((code) => held.has(code)) ? 1 : 0);
  const [left, right] = [any("ArrowLeft", "KeyA"), any("ArrowRight", "KeyD")];
  const [ahead, backward] = [any("ArrowUp", "KeyW"), any("ArrowDown", "KeyS")];
  return left + right + ahead + backward === 0 ? null : { steering: left - right, speed: ahead - backward };
}

export const DRIVE_KEYS: ReadonlySet<string> = new Set(["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "KeyA", "KeyD", "KeyW", "KeyS"]);

interface PadState { axes: readonly number[]; buttons: readonly { pressed: boolean; value: number }[] }

/** Standard mapping: left stick steers, right trigger drives, left trigger backs. Without a held shoulder button: nothing. */
export function wishOfGamepad(pad: PadState): Wish | null {
  const deadMan = pad.buttons[4]?.pressed || pad.buttons[5]?.pressed;
  if (!deadMan) return null;
  const stick = pad.axes[0] ?? 0;
  return {
    steering: clamp(Math.abs(stick) < 0.08 ? 0 : -stick),
    speed: clamp((pad.buttons[7]?.value ?? 0) - (pad.buttons[6]?.value ?? 0)),
  };
}

/** Keys know only all or nothing; a wheel that jumps from stop to stop helps nobody. Sticks and pads go through unchanged. */
export class Ramp {
  private at: Wish = { steering: 0, speed: 0 };

  step(wish: Wish, elapsed_s: number): Wish {
    this.at = {
      steering: towards(this.at.steering, wish.steering, STEERING_PER_S * elapsed_s),
      speed: towards(this.at.speed, wish.speed, SPEED_PER_S * elapsed_s),
    };
    return this.at;
  }

  reset(): void {
    this.at = { steering: 0, speed: 0 };
  }
}

export function commandOf(wish: Wish, limits: Limits): DriveCommand {
  return { steering_rad: clamp(wish.steering) * limits.max_steering_rad, speed_m_s: clamp(wish.speed) * limits.max_speed_m_s };
}

export interface Wheel { now(): number; later(ms: number, action: () => void): () => void }

/** Calls `beat` every 20 ms while it runs. Timers come late; a late beat is made up for by the next one, a missed one never. */
export class Beat {
  private cancel: (() => void) | null = null;
  private due = 0;

  constructor(private readonly wheel: Wheel, private readonly beat: (elapsed_s: number) => void) {}

  get running(): boolean {
    return this.cancel !== null;
  }

  start(): void {
    if (this.running) return;
    this.due = this.wheel.now();
    this.plan();
    this.beat(PERIOD_MS / 1000);
  }

  stop(): void {
    this.cancel?.();
    this.cancel = null;
  }

  private plan(): void {
    const now = this.wheel.now();
    this.due = Math.max(this.due + PERIOD_MS, now);
    this.cancel = this.wheel.later(this.due - now, () => {
      this.plan();
      this.beat(PERIOD_MS / 1000);
    });
  }
}
