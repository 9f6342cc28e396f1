// What the page knows of the car: the newest of everything, with its age. Never more than the newest: histories belong to panels.
import { CarClock } from "./clock";
import { Connection } from "./connection";
import { VERSION, type Access, type DriveAck, type DriveTerms, type GraphNode, type Hello, type ImageFrame, type LogLine, type RawSample, type Receipt, type ServerMessage, type Status } from "./protocol";
import { readCommand, readDecision, readLane, readProgress, readScan, readSectors, readTelemetry, readVehicle } from "./values";

export interface Sample { key: string; message_type: string; time_ms: number; origin_ms: number | null; origins: ReadonlyMap<string, number>; received_ms: number; value: unknown }

/** What panels may listen to. */
export interface Events {
  connection: void;
  hello: Hello;
  access: Access;
  /** How the car can be driven by hand, or not: other limits than before. */
  drive: DriveTerms | null;
  graph: GraphNode[];
  status: Status;
  sample: Sample;
  image: ImageFrame;
  log: LogLine;
  receipt: Receipt;
  driveAck: DriveAck;
  /** Something for the log that the page itself has to say. */
  note: { level: LogLine["level"]; text: string };
}

const READERS: Record<string, (value: unknown) => unknown> = {
  "carril/Command": readCommand,
  "carril/DecisionState": readDecision,
  "carril/LaneEstimate": readLane,
  "carril/LaserScan": readScan,
  "carril/Sectors": readSectors,
  "carril/TrackProgress": readProgress,
  "carril/VehicleState": readVehicle,
  "carril/WheelTelemetry": readTelemetry,
};

export class Car {
  readonly clock = new CarClock();
  readonly connection: Connection;
  hello: Hello | null = null;
  nodes: GraphNode[] = [];
  status: Status | null = null;
  statusBefore: Status | null = null;
  statusReceived_ms = 0;
  goodbye = "";
  badMessages = 0;
  private samples = new Map<string, Sample>();
  private listeners = new Map<keyof Events, ((event: never) => void)[]>();

  constructor(url: string) {
    this.connection = new Connection(url, {
      opened: () => this.opened(),
      closed: (reason) => this.closed(reason),
      message: (message) => this.heard(message),
      image: (frame) => this.emit("image", frame),
      bad: (error) => this.bad(error),
    });
    this.connection.onPong = (sent, received, car) => {
      this.clock.learn(sent, received, car);
      this.emit("connection", undefined);
    };
  }

  on<K extends keyof Events>(name: K, listener: (event: Events[K]) => void): void {
    this.listeners.set(name, [...(this.listeners.get(name) ?? []), listener as (event: never) => void]);
  }

  emit<K extends keyof Events>(name: K, event: Events[K]): void {
    for (const listener of this.listeners.get(name) ?? []) {
      try {
        (listener as (event: Events[K]) => void)(event);
      } catch (error) {
        // One panel's defect must not silence the others.
        console.error(`listener of ${name}`, error);
      }
    }
  }

  get inControl(): boolean {
    return this.connection.connected && this.hello?.access.level === "control";
  }

  /** The newest sample of a key, as its reader understands it. */
  value<T>(key: string | null): T | null {
    return key === null ? null : ((this.samples.get(key)?.value as T | undefined) ?? null);
  }

  sample(key: string | null): Sample | null {
    return key === null ? null : (this.samples.get(key) ?? null);
  }

  /** The car's time now; null while it is not known. */
  now(): number | null {
    return this.clock.carTimeMs(performance.now());
  }

  /** Age of something stamped `time_ms` that came at `received_ms`. Without the car's clock, at least the time since it came. */
  age(time_ms: number, received_ms: number): number {
    const page_ms = performance.now();
    const car_ms = this.clock.carTimeMs(page_ms);
    return Math.max(0, car_ms === null ? page_ms - received_ms : car_ms - time_ms);
  }

  ageOf(key: string | null): number | null {
    const sample = this.sample(key);
    return sample && this.age(sample.time_ms, sample.received_ms);
  }

  /** Nothing old may look new: after a pause the page begins with empty hands. */
  forgetSamples(): void {
    this.samples.clear();
  }

  private opened(): void {
    this.forgetSamples();
    this.clock.forget();
    this.status = this.statusBefore = null;
    this.goodbye = "";
    this.connection.tick();
    this.emit("connection", undefined);
  }

  private closed(reason: string): void {
    if (reason) this.goodbye = reason;
    this.emit("connection", undefined);
  }

  private bad(error: string): void {
    this.badMessages += 1;
    this.emit("note", { level: "warning", text: `message ${this.badMessages} that this page cannot read: ${error}` });
  }

  private heard(message: ServerMessage): void {
    switch (message.type) {
      case "hello":
        this.hello = message.hello;
        if (message.hello.version !== VERSION) this.emit("note", { level: "error", text: `the server speaks version ${message.hello.version} of the protocol, this page ${VERSION}: reload the page` });
        this.emit("hello", message.hello);
        this.emit("access", message.hello.access);
        break;
      case "access":
        if (this.hello) this.hello.access = message.access;
        this.emit("access", message.access);
        break;
      case "drive_terms":
        if (this.hello) this.hello.drive = message.drive;
        this.emit("drive", message.drive);
        break;
      case "graph":
        this.nodes = message.nodes;
        this.emit("graph", message.nodes);
        break;
      case "status":
        this.statusBefore = this.status;
        this.status = message.status;
        this.statusReceived_ms = performance.now();
        this.emit("status", message.status);
        break;
      case "sample": this.sampled(message.sample); break;
      case "log": this.emit("log", message.line); break;
      case "receipt": this.emit("receipt", message.receipt); break;
      case "drive_ack": this.emit("driveAck", message.ack); break;
      case "refused": this.emit("note", { level: "error", text: `the server refused a message: ${message.error}` }); break;
      case "bye": this.goodbye = message.reason; this.emit("note", { level: "warning", text: `the server says goodbye: ${message.reason}` }); break;
    }
  }

  private sampled(raw: RawSample): void {
    const reader = READERS[raw.message_type];
    const value = reader ? reader(raw.value) : raw.value;
    if (reader && value === null) {
      this.bad(`${raw.key} is no ${raw.message_type}`);
      return;
    }
    const sample: Sample = { key: raw.key, message_type: raw.message_type, time_ms: raw.time_ms, origin_ms: raw.origin_ms, origins: raw.origins, received_ms: performance.now(), value };
    this.samples.set(raw.key, sample);
    this.emit("sample", sample);
  }
}
