// The last transitions of the state machine, from samples of its state: what was not sampled is counted, not invented.
import type { Decision } from "./values";

const MOST = 20;
export interface Transition { state: string; since_ms: number; reason: string; missed: number }

export class Transitions {
  private entries: Transition[] = [];
  private count: number | null = null;

  /** Whether it was a new one. */
  take(decision: Decision): boolean {
    if (this.count !== null && decision.transitions < this.count) this.clear(); // the node began anew
    if (this.count === decision.transitions && this.entries.at(-1)?.state === decision.state) return false;
    const missed = this.count === null ? 0 : Math.max(0, decision.transitions - this.count - 1);
    this.entries = [...this.entries, { state: decision.state, since_ms: decision.since_ms, reason: decision.reason, missed }].slice(-MOST);
    this.count = decision.transitions;
    return true;
  }

  newestFirst(): Transition[] {
    return [...this.entries].reverse();
  }

  clear(): void {
    this.entries = [];
    this.count = null;
  }
}
