// What passes between page and server (dashboard/protocol.md): types, and readers that take nothing for granted.
import { count, fields, isFields, list, number, text, type Fields } from "./read";

export interface Access { level: "control" | "read"; name: string | null; why: string }
export interface DriveTerms { node: string; port: string; max_speed_m_s: number; max_steering_rad: number; lease_ms: number }
export interface Hello {
  version: number; robot: string; graph: string; access: Access; can_log_in: boolean; estop_open: boolean; drive: DriveTerms | null;
  view: string | null; // names this connection to a second one, for the view
}
export interface GraphInput { port: string; message_type: string; from: string | null; external: boolean }
export interface GraphOutput { port: string; message_type: string; on_demand: boolean }
export interface GraphNode {
  name: string; operator: string; process: string; version: number;
  inputs: GraphInput[]; outputs: GraphOutput[]; config: Fields; schema: Fields;
  fitting: string[]; // other operators that fit in its place
}
export interface Percentiles { p50: number; p99: number; max: number }
export interface InputStatus { port: string; received: number; dropped: number; lost: number; stale: number; refused: number; last_refusal: string | null }
export interface OutputStatus { port: string; sent: number; bytes: number }
export interface NodeStatus {
  node: string; operator: string; process: string; pid: number | null; state: string; rate_hz: number;
  step_us: Percentiles | null; latency_us: Percentiles | null; age_ms: Percentiles | null;
  overruns: number; missed_periods: number; errors: number; last_error: string | null; restarts: number; budget_violations: number;
  measured_ms: number; // counters and figures are of this time
  inputs: InputStatus[]; outputs: OutputStatus[];
}
export interface Status {
  time_ms: number; uptime_s: number; fault: { node: string; reason: string } | null; nodes: NodeStatus[];
  link: { sent_bytes: number; dropped_images: number; dropped_data: number; viewers: number; driver: string | null };
}
export interface RawSample { key: string; message_type: string; seq: number; time_ms: number; origin_ms: number | null; origins: ReadonlyMap<string, number>; value: unknown }
export interface LogLine { time_ms: number; level: "error" | "warning" | "info" | "debug"; process: string; text: string }
export interface Receipt { node: string; what: string; outcome: string; from: string; to: string; reason: string | null; gap_ms: number | null; lost: number; duplicated: number }
export interface DriveAck { seq: number; applied: boolean; error: string | null }
export interface ImageFrame {
  key: string; seq: number; time_ms: number; origin_ms: number | null; width: number; height: number;
  source_width: number; source_height: number; source_encoding: string; jpeg: Uint8Array<ArrayBuffer>;
}
export interface Want { key: string; max_hz: number; width?: number; quality?: number }

export type Reply = { id: number } & ({ ok: true; value: unknown } | { ok: false; error: string });
export type ServerMessage =
  | { type: "hello"; hello: Hello }
  | { type: "graph"; nodes: GraphNode[] }
  | { type: "status"; status: Status }
  | { type: "sample"; sample: RawSample }
  | { type: "log"; line: LogLine }
  | { type: "receipt"; receipt: Receipt }
  | { type: "access"; access: Access }
  | { type: "drive_terms"; drive: DriveTerms | null }
  | { type: "reply"; reply: Reply }
  | { type: "pong"; id: number; time_ms: number }
  | { type: "drive_ack"; ack: DriveAck }
  | { type: "refused"; error: string }
  | { type: "bye"; reason: string }
  | { type: "unknown" };

/** Of the protocol that this page speaks. */
export const VERSION = 1;

export class BadMessage extends Error {}

function demand<T>(value: T | null, what: string): T {
  if (value === null) throw new BadMessage(`no ${what}`);
  return value;
}

export function readAccess(value: unknown): Access {
  const from = fields(value);
  return { level: from.level === "control" ? "control" : "read", name: text(from.name), why: text(from.why) ?? "" };
}

function readDrive(value: unknown): DriveTerms | null {
  if (!isFields(value)) return null;
  const speed = number(value.max_speed_m_s);
  const steering = number(value.max_steering_rad);
  if (speed === null || steering === null) return null;
  return { node: text(value.node) ?? "", port: text(value.port) ?? "", max_speed_m_s: speed, max_steering_rad: steering, lease_ms: number(value.lease_ms) ?? 300 };
}

function readHello(from: Fields): Hello {
  return {
    version: count(from.version), robot: text(from.robot) ?? "car", graph: text(from.graph) ?? "", access: readAccess(from.access),
    can_log_in: from.can_log_in === true, estop_open: from.estop_open === true, drive: readDrive(from.drive),
    view: text(from.view),
  };
}

function readGraphNode(value: unknown): GraphNode {
  const from = fields(value);
  return {
    name: demand(text(from.name), "name of a node"), operator: text(from.operator) ?? "", process: text(from.process) ?? "",
    version: count(from.version), config: fields(from.config), schema: fields(from.schema), fitting: list(from.fitting).flatMap((each) => text(each) ?? []),
    inputs: list(from.inputs).map(fields).map((input) => ({
      port: text(input.port) ?? "", message_type: text(input.message_type) ?? "", from: text(input.from), external: input.external === true,
    })),
    outputs: list(from.outputs).map(fields).map((output) => ({
      port: text(output.port) ?? "", message_type: text(output.message_type) ?? "", on_demand: output.on_demand === true,
    })),
  };
}

function readPercentiles(value: unknown): Percentiles | null {
  return isFields(value) ? { p50: count(value.p50), p99: count(value.p99), max: count(value.max) } : null;
}

function readNodeStatus(value: unknown, time_ms: number): NodeStatus {
  const from = fields(value);
  return {
    node: demand(text(from.node), "name of a node"), operator: text(from.operator) ?? "", process: text(from.process) ?? "",
    pid: number(from.pid), state: text(from.state) ?? "unknown", rate_hz: count(from.rate_hz),
    step_us: readPercentiles(from.step_us), latency_us: readPercentiles(from.latency_us), age_ms: readPercentiles(from.age_ms),
    overruns: count(from.overruns), missed_periods: count(from.missed_periods), errors: count(from.errors), last_error: text(from.last_error),
    restarts: count(from.restarts), budget_violations: count(from.budget_violations), measured_ms: number(from.measured_ms) ?? time_ms,
    inputs: list(from.inputs).map(fields).map((input) => ({
      port: text(input.port) ?? "", received: count(input.received), dropped: count(input.dropped), lost: count(input.lost),
      stale: count(input.stale), refused: count(input.refused), last_refusal: text(input.last_refusal),
    })),
    outputs: list(from.outputs).map(fields).map((output) => ({ port: text(output.port) ?? "", sent: count(output.sent), bytes: count(output.bytes) })),
  };
}

function readStatus(from: Fields): Status {
  const fault = isFields(from.fault) ? { node: text(from.fault.node) ?? "", reason: text(from.fault.reason) ?? "" } : null;
  const link = fields(from.link);
  const dropped = fields(link.dropped);
  const time_ms = demand(number(from.time_ms), "time_ms");
  return {
    time_ms, uptime_s: count(from.uptime_s), fault, nodes: list(from.nodes).map((node) => readNodeStatus(node, time_ms)),
    link: { sent_bytes: count(link.sent_bytes), dropped_images: count(dropped.image), dropped_data: count(dropped.data), viewers: count(link.viewers), driver: text(link.driver) },
  };
}

const LEVELS = ["error", "warning", "info", "debug"] as const;

function readLog(from: Fields): LogLine {
  return {
    time_ms: count(from.time_ms), level: LEVELS.find((level) => level === from.level) ?? "info",
    process: text(from.process) ?? "", text: demand(text(from.text), "text"),
  };
}

export function readReceipt(value: unknown): Receipt {
  const from = fields(value);
  return {
    node: text(from.node) ?? "", what: text(from.what) ?? "", outcome: text(from.outcome) ?? "unknown", from: text(from.from) ?? "", to: text(from.to) ?? "",
    reason: text(from.reason), gap_ms: number(from.gap_ms), lost: count(from.lost), duplicated: count(from.duplicated),
  };
}

function readReply(from: Fields): Reply {
  const id = demand(number(from.id), "id");
  return from.ok === true ? { id, ok: true, value: from.value } : { id, ok: false, error: text(from.error) ?? "refused without a reason" };
}

function readSample(from: Fields): RawSample {
  return {
    key: demand(text(from.key), "key"), message_type: text(from.message_type) ?? "", seq: count(from.seq),
    time_ms: demand(number(from.time_ms), "time_ms"), origin_ms: number(from.origin_ms), value: from.value,
    origins: new Map(Object.entries(fields(from.origins)).flatMap(([key, value]) => (typeof value === "number" ? [[key, value]] : []))),
  };
}

/** Throws on what cannot be read. Types that this page does not know are no error: the server may be newer. */
export function readMessage(raw: string): { message: ServerMessage; time_ms: number | null } {
  const from: unknown = JSON.parse(raw);
  if (!isFields(from)) throw new BadMessage("not an object");
  return { message: readTyped(from), time_ms: number(from.time_ms) };
}

function readTyped(from: Fields): ServerMessage {
  switch (from.type) {
    case "hello": return { type: "hello", hello: readHello(from) };
    case "graph": return { type: "graph", nodes: list(from.nodes).map(readGraphNode) };
    case "status": return { type: "status", status: readStatus(from) };
    case "sample": return { type: "sample", sample: readSample(from) };
    case "log": return { type: "log", line: readLog(from) };
    case "receipt": return { type: "receipt", receipt: readReceipt(from.receipt) };
    case "drive_terms": return { type: "drive_terms", drive: readDrive(from.drive) };
    case "access": return { type: "access", access: readAccess(from.access) };
    case "reply": return { type: "reply", reply: readReply(from) };
    case "pong": return { type: "pong", id: demand(number(from.id), "id"), time_ms: demand(number(from.time_ms), "time_ms") };
    case "drive_ack": return { type: "drive_ack", ack: { seq: count(from.seq), applied: from.applied === true, error: text(from.error) } };
    case "refused": return { type: "refused", error: text(from.error) ?? "" };
    case "bye": return { type: "bye", reason: text(from.reason) ?? "" };
    default: return { type: "unknown" };
  }
}

/** A binary frame: length of the header (4 bytes, little endian), header, JPEG. */
function headerOf(buffer: ArrayBuffer): { from: Fields; end: number } {
  if (buffer.byteLength < 4) throw new BadMessage(`image frame of ${buffer.byteLength} B, expected at least 4 B`);
  const length = new DataView(buffer).getUint32(0, true);
  if (length > buffer.byteLength - 4) throw new BadMessage(`image header of ${length} B in a frame of ${buffer.byteLength} B`);
  const header: unknown = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { from: fields(header), end: 4 + length };
}

export function readFrame(buffer: ArrayBuffer): ImageFrame {
  const { from, end } = headerOf(buffer);
  const width = demand(number(from.width), "width");
  const height = demand(number(from.height), "height");
  return {
    key: demand(text(from.key), "key"), seq: count(from.seq), time_ms: demand(number(from.time_ms), "time_ms"), origin_ms: number(from.origin_ms),
    width, height, source_width: number(from.source_width) ?? width, source_height: number(from.source_height) ?? height,
    source_encoding: text(from.source_encoding) ?? "", jpeg: new Uint8Array(buffer, end),
  };
}

/** A frame is no larger: 4096 pixels square as JPEG are less. */
const MAX_FRAME_BYTES = 32 << 20;

/** Puts frames together that come in pieces: the first begins with the header, which says how long the JPEG is. */
export class Frames {
  private pieces: Uint8Array<ArrayBuffer>[] = [];
  private have = 0;
  private whole = 0;

  /** The frame, if this was its last piece. Throws what cannot be a frame, and begins anew. */
  add(buffer: ArrayBuffer): ImageFrame | null {
    try {
      if (this.have === 0) this.whole = lengthOf(buffer);
      this.pieces.push(new Uint8Array(buffer));
      this.have += buffer.byteLength;
      if (this.have < this.whole) return null;
      if (this.have > this.whole) throw new BadMessage(`image frame of ${this.have} B, announced were ${this.whole} B`);
      const frame = new Uint8Array(this.whole);
      let at = 0;
      for (const piece of this.pieces) {
        frame.set(piece, at);
        at += piece.byteLength;
      }
      this.forget();
      return readFrame(frame.buffer);
    } catch (error) {
      this.forget();
      throw error;
    }
  }

  private forget(): void {
    this.pieces = [];
    this.have = 0;
  }
}

function lengthOf(buffer: ArrayBuffer): number {
  const header = headerOf(buffer);
  const bytes = demand(number(header.from.bytes), "bytes");
  const whole = header.end + bytes;
  if (!(bytes >= 0 && whole <= MAX_FRAME_BYTES)) throw new BadMessage(`image of ${bytes} B, allowed are ${MAX_FRAME_BYTES} B`);
  return whole;
}
