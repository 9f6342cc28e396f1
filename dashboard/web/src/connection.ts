// One WebSocket that comes back by itself, for ever. Never keeps a message for later: what cannot be sent now is an error now,
// since a command that arrives late is worse than none.
import { readFrame, readMessage, type ImageFrame, type Reply, type ServerMessage } from "./protocol";

const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 3000;
const REPLY_PATIENCE_MS = 15_000;
/** A server that says nothing for so long is gone, whatever TCP believes: `status` and `pong` come every second. */
const SILENCE_MS = 5000;
/** A network that swallows packets would keep the browser trying for minutes. */
const OPENING_MS = 5000;

export function pauseBefore(attempt: number): number {
  return Math.min(LONGEST_PAUSE_MS, FIRST_PAUSE_MS * 1.5 ** attempt);
}

export interface Listener {
  opened(): void;
  closed(reason: string): void;
  message(message: ServerMessage): void;
  image(frame: ImageFrame): void;
  bad(error: string): void;
}

type Waiting = { resolve: (value: unknown) => void; reject: (error: Error) => void; timer: number };

export class Connection {
  private socket: WebSocket | null = null;
  private waiting = new Map<number, Waiting>();
  private pings = new Map<number, number>();
  private nextId = 1;
  private attempt = 0;
  private retry: number | undefined;
  private farewell = "";
  private heardAt = 0;
  private openedAt = 0;
  /** Since when there is none, on the page's clock; null while there is one. */
  downSince: number | null = performance.now();
  /** The newest `time_ms` that came from the server, in any message: proof of what the page could have seen. */
  seen_ms = 0;
  onPong: (sent_ms: number, received_ms: number, car_ms: number) => void = () => {};

  constructor(private readonly url: string, private readonly listener: Listener) {}

  get connected(): boolean {
    return this.downSince === null;
  }

  open(): void {
    const socket = new WebSocket(this.url);
    this.openedAt = performance.now();
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.addEventListener("message", (event) => socket === this.socket && this.receive(event.data));
    socket.addEventListener("close", () => socket === this.socket && this.lost());
  }

  /** Anew at once: the cookie is read when the WebSocket opens. */
  reopen(): void {
    const old = this.socket;
    this.socket = null;
    old?.close();
    window.clearTimeout(this.retry);
    if (this.connected) this.giveUpWaiting("the connection is opened anew");
    this.open();
  }

  private receive(data: unknown): void {
    this.heardAt = performance.now();
    try {
      if (data instanceof ArrayBuffer) {
        const frame = readFrame(data);
        this.seen_ms = Math.max(this.seen_ms, frame.time_ms);
        this.listener.image(frame);
      } else if (typeof data === "string") {
        const { message, time_ms } = readMessage(data);
        if (message.type === "hello") this.greeted(time_ms ?? 0);
        else if (time_ms !== null) this.seen_ms = Math.max(this.seen_ms, time_ms);
        this.dispatch(message);
      }
    } catch (error) {
      this.listener.bad(error instanceof Error ? error.message : String(error));
    }
  }

  /** Another run has another clock: what was seen of the last one proves nothing. */
  private greeted(time_ms: number): void {
    this.seen_ms = time_ms;
    this.attempt = 0;
    this.farewell = "";
    this.downSince = null;
    this.pings.clear();
    this.listener.opened();
  }

  private dispatch(message: ServerMessage): void {
    if (message.type === "reply") this.settle(message.reply);
    else if (message.type === "pong") this.ponged(message.id, message.time_ms);
    else {
      if (message.type === "bye") this.farewell = message.reason;
      this.listener.message(message);
    }
  }

  private settle(reply: Reply): void {
    const waiting = this.waiting.get(reply.id);
    if (!waiting) return;
    this.waiting.delete(reply.id);
    window.clearTimeout(waiting.timer);
    if (reply.ok) waiting.resolve(reply.value);
    else waiting.reject(new Error(reply.error));
  }

  private ponged(id: number, time_ms: number): void {
    const sent = this.pings.get(id);
    this.pings.delete(id);
    if (sent !== undefined) this.onPong(sent, performance.now(), time_ms);
  }

  private giveUpWaiting(reason: string): void {
    for (const { reject, timer } of this.waiting.values()) {
      window.clearTimeout(timer);
      reject(new Error(reason));
    }
    this.waiting.clear();
    this.pings.clear();
  }

  private lost(): void {
    this.socket = null;
    this.giveUpWaiting("the connection broke before an answer came");
    if (this.downSince === null) this.downSince = performance.now();
    this.listener.closed(this.farewell);
    this.retry = window.setTimeout(() => this.open(), pauseBefore(this.attempt++));
  }

  /** Sends now or not at all; answers whether it was sent. */
  send(message: object): boolean {
    if (!this.connected || this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  request(message: object): Promise<unknown> {
    const id = this.nextId++;
    return new Promise((resolve, reject) => {
      if (!this.send({ ...message, id })) {
        reject(new Error("not connected: nothing was sent"));
        return;
      }
      const timer = window.setTimeout(() => {
        this.waiting.delete(id);
        reject(new Error(`no answer within ${REPLY_PATIENCE_MS / 1000} s`));
      }, REPLY_PATIENCE_MS);
      this.waiting.set(id, { resolve, reject, timer });
    });
  }

  /** Once a second: measures the round trip, and ends a connection that only seems to be there. */
  tick(): void {
    const now = performance.now();
    const silent = this.connected && now - this.heardAt > SILENCE_MS && now - this.openedAt > SILENCE_MS;
    const stuck = !this.connected && this.socket !== null && now - this.openedAt > OPENING_MS;
    if (silent || stuck) {
      const dead = this.socket;
      this.lost();
      dead?.close();
      return;
    }
    const id = this.nextId++;
    if (this.send({ type: "ping", id })) this.pings.set(id, now);
  }
}
