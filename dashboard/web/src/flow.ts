// Rates between two statuses. Counters run since the start of a process: after a restart they begin anew, and there is no rate.
import { bytesPerSecond } from "./format";
import type { NodeStatus, Status } from "./protocol";

export interface Flow { rate_hz: number; bytes_per_s: number }

export const nodeOf = (status: Status | null, name: string): NodeStatus | null => status?.nodes.find((node) => node.node === name) ?? null;

/** Of an output, `node/port`. */
export function flowOf(before: Status | null, now: Status | null, key: string): Flow | null {
  const slash = key.lastIndexOf("/");
  const [name, port] = [key.slice(0, slash), key.slice(slash + 1)];
  const [old, fresh] = [nodeOf(before, name), nodeOf(now, name)];
  const counters = (node: NodeStatus | null) => node?.outputs.find((output) => output.port === port);
  const [counted, counts] = [counters(old), counters(fresh)];
  if (!old || !fresh || !counted || !counts || counts.sent < counted.sent || counts.bytes < counted.bytes) return null;
  // Nodes measure in a rhythm of their own: by their clock, else every other second would show twice the rate.
  const seconds = (fresh.measured_ms - old.measured_ms) / 1000;
  return seconds > 0 ? { rate_hz: (counts.sent - counted.sent) / seconds, bytes_per_s: (counts.bytes - counted.bytes) / seconds } : null;
}

/** What does not leave the process is passed on as it is: no bytes are made of it. */
export const bandwidthOf = ({ rate_hz, bytes_per_s }: Flow): string => (bytes_per_s > 0 ? bytesPerSecond(bytes_per_s) : rate_hz > 0 ? "in process" : "");

/** It does not come back by itself. */
export const isDown = (state: string | null): boolean => state === "gave-up" || state === "stopped";

export interface StateLook { mark: string; tone: "good" | "warn" | "bad" | "idle"; words: string }

/** States differ in shape and word too, not in colour alone. */
export function lookOf(state: string | null): StateLook {
  switch (state) {
    case "running": return { mark: "●", tone: "good", words: "running" };
    case "starting": return { mark: "◔", tone: "warn", words: "starting" };
    case "restarting": return { mark: "↻", tone: "warn", words: "restarting" };
    case "faulted": return { mark: "▲", tone: "bad", words: "faulted" };
    case "gave-up": return { mark: "✕", tone: "bad", words: "gave up" };
    case "stopped": return { mark: "■", tone: "idle", words: "stopped" };
    case "away": return { mark: "◌", tone: "bad", words: "its machine is away" };
    default: return { mark: "?", tone: "idle", words: state ?? "unknown" };
  }
}

export function lookOfDrive(state: string | null): StateLook {
  switch (state) {
    case "lane-follow": return { mark: "▶", tone: "good", words: "lane-follow" };
    case "idle": return { mark: "◦", tone: "idle", words: "idle" };
    case "manual": return { mark: "◈", tone: "good", words: "manual" };
    case "obstacle-stop": return { mark: "◆", tone: "warn", words: "obstacle-stop" };
    case "light-stop": return { mark: "●", tone: "warn", words: "light-stop" };
    case "overtake-out": return { mark: "↰", tone: "good", words: "overtake-out" };
    case "overtake-pass": return { mark: "⇈", tone: "good", words: "overtake-pass" };
    case "overtake-in": return { mark: "↱", tone: "good", words: "overtake-in" };
    case "overtake-wait": return { mark: "◇", tone: "warn", words: "overtake-wait" };
    case "overtake-stop": return { mark: "◆", tone: "warn", words: "overtake-stop" };
    case "park-search": return { mark: "▶", tone: "good", words: "park-search" };
    case "park-drive": return { mark: "◀", tone: "good", words: "park-drive" };
    case "parked": return { mark: "■", tone: "good", words: "parked" };
    case "park-stop": return { mark: "▲", tone: "warn", words: "park-stop" };
    case "lane-lost": return { mark: "▲", tone: "warn", words: "lane-lost" };
    case "e-stop": return { mark: "✕", tone: "bad", words: "e-stop" };
    default: return { mark: "?", tone: "idle", words: state ?? "–" };
  }
}
