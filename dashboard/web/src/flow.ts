// Rates between two statuses. Counters run since the start of a process: after a restart they begin anew, and there is no rate.
import type { NodeStatus, Status } from "./protocol";

export interface Flow { rate_hz: number; bytes_per_s: number | null }
export interface Reader { node: string; port: string }

export const nodeOf = (status: Status | null, name: string): NodeStatus | null => status?.nodes.find((node) => node.node === name) ?? null;

/** Of an output; where outputs are not counted one by one, as its reader counts what it receives. */
export function flowOf(before: Status | null, now: Status | null, key: string, reader?: Reader): Flow | null {
  const slash = key.lastIndexOf("/");
  const [name, port] = [key.slice(0, slash), key.slice(slash + 1)];
  const counters = (status: Status | null) => nodeOf(status, name)?.outputs.find((output) => output.port === port);
  const [old, fresh] = [counters(before), counters(now)];
  if (!before || !now) return null;
  if (!old || !fresh) return reader ? received(before, now, reader) : null;
  if (fresh.sent < old.sent || fresh.bytes < old.bytes) return null;
  const seconds = (now.time_ms - before.time_ms) / 1000;
  return seconds > 0 ? { rate_hz: (fresh.sent - old.sent) / seconds, bytes_per_s: (fresh.bytes - old.bytes) / seconds } : null;
}

function received(before: Status, now: Status, reader: Reader): Flow | null {
  const [old, fresh] = [nodeOf(before, reader.node), nodeOf(now, reader.node)];
  const count = (node: NodeStatus | null) => node?.inputs.find((input) => input.port === reader.port)?.received ?? null;
  const [counted, counts] = [count(old), count(fresh)];
  if (!old || !fresh || counted === null || counts === null || counts < counted) return null;
  // Nodes measure in a rhythm of their own: by their clock, else every other second would show twice the rate.
  const seconds = (fresh.measured_ms - old.measured_ms) / 1000;
  return seconds > 0 ? { rate_hz: (counts - counted) / seconds, bytes_per_s: null } : null;
}

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
    default: return { mark: "?", tone: "idle", words: state ?? "unknown" };
  }
}

export function lookOfDrive(state: string | null): StateLook {
  switch (state) {
    case "lane-follow": return { mark: "▶", tone: "good", words: "lane-follow" };
    case "idle": return { mark: "◦", tone: "idle", words: "idle" };
    case "manual": return { mark: "◈", tone: "good", words: "manual" };
    case "obstacle-stop": return { mark: "◆", tone: "warn", words: "obstacle-stop" };
    case "lane-lost": return { mark: "▲", tone: "warn", words: "lane-lost" };
    case "e-stop": return { mark: "✕", tone: "bad", words: "e-stop" };
    default: return { mark: "?", tone: "idle", words: state ?? "–" };
  }
}
