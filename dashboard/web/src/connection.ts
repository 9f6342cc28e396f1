// One WebSocket that comes back by itself, for ever. Never keeps a message for later: what cannot be sent now is an error now,
// since a command that arrives late is worse than none.
import { Frames, readFrame, readMessage, type ImageFrame, type Reply, type ServerMessage } from "./protocol";

const PAUSE_MS = 500;
const LONG_PAUSE_MS = 3000;
/** So many tries at the short pause: half a minute. */
const PATIENT_AFTER = 60;
const REPLY_PATIENCE_MS = 15_000;
/** Pings follow a question: TCP misses a lost packet that nothing follows only after a fifth of a second, one that others follow at once. */
const FOLLOWED_AFTER_MS = [8, 24];
/** A server that says nothing for so long is gone, whatever TCP believes: `status` and `pong` come every second. */
const SILENCE_MS = 2500;
/** Tries under way at a time: over a network that swallows packets each waits longer and longer, and only a new one comes through at once. */
const TRIES = 6;

export function pauseBefore(attempt: number): number {
  return attempt < PATIENT_AFTER ? PAUSE_MS : LONG_PAUSE_MS;
}

export interface Listener {
  opened(): void;
  closed(reason: string): void;
  message(message: ServerMessage): void;
  image(frame: ImageFrame): void;
  bad(error: string): void;
}

const wholeFrame = (buffer: ArrayBuffer): ImageFrame => readFrame(buffer);

/** A socket that is no longer needed. One that still connects is ended when it has: to cut it off before fills the console with errors. */
function dismiss(socket: WebSocket | null): void {
  if (socket?.readyState === WebSocket.CONNECTING) socket.addEventListener("open", () => socket.close());
  else socket?.close();
}

type Waiting = { resolve: (value: unknown) => void; reject: (error: Error) => void; timer: number };

export class Connection {
  private socket: WebSocket | null = null;
  /** Whoever of them is greeted first becomes the connection. */
  private tries: WebSocket[] = [];
  private view: View | null = null;
  private waiting = new Map<number, Waiting>();
  private pings = new Map<number, number>();
  private nextId = 1;
  private attempt = 0;
  private retry: number | undefined;
  private farewell = "";
  private heardAt = 0;
  /** Since when there is none, on the page's clock; null while there is one. */
  downSince: number | null = performance.now();
  /** The newest `time_ms` that came from the server, in any message: proof of what the page could have seen. */
  seen_ms = 0;
  onPong: (sent_ms: number, received_ms: number, car_ms: number) => void = () => {};

  constructor(private readonly url: string, private readonly listener: Listener) {}

  get connected(): boolean {
    return this.downSince === null;
  }

  /** Begins a try, and the next one after a pause, until one of them is greeted. */
  open(): void {
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    this.tries.push(socket);
    if (this.tries.length > TRIES) this.tries.shift()?.close();
    socket.addEventListener("message", (event) => {
      if (this.tries.includes(socket)) this.adopt(socket);
      if (socket === this.socket) this.receive(event.data, wholeFrame);
    });
    socket.addEventListener("close", () => {
      this.tries = this.tries.filter((other) => other !== socket);
      if (socket === this.socket) this.lost();
    });
    window.clearTimeout(this.retry);
    this.retry = window.setTimeout(() => this.open(), pauseBefore(this.attempt++));
  }

  private adopt(socket: WebSocket): void {
    const late = this.tries.filter((other) => other !== socket);
    this.tries = [];
    window.clearTimeout(this.retry);
    this.socket = socket;
    for (const other of late) dismiss(other);
  }

  /** Anew at once: the cookie is read when the WebSocket opens. */
  reopen(): void {
    const old = [this.socket, ...this.tries];
    this.socket = null;
    this.tries = [];
    this.view?.close();
    for (const each of old) dismiss(each);
    if (this.connected) this.giveUpWaiting("the connection is opened anew");
    this.open();
  }

  private receive(data: unknown, frameOf: (piece: ArrayBuffer) => ImageFrame | null): void {
    this.heardAt = performance.now();
    try {
      if (data instanceof ArrayBuffer) {
        const frame = frameOf(data);
        if (frame === null) return;
        this.seen_ms = Math.max(this.seen_ms, frame.time_ms);
        this.listener.image(frame);
      } else if (typeof data === "string") {
        const { message, time_ms } = readMessage(data);
        if (message.type === "hello") this.greeted(time_ms ?? 0, message.hello.view);
        else if (time_ms !== null) this.seen_ms = Math.max(this.seen_ms, time_ms);
        this.dispatch(message);
      }
    } catch (error) {
      this.listener.bad(error instanceof Error ? error.message : String(error));
    }
  }

  /** Another run has another clock: what was seen of the last one proves nothing. */
  private greeted(time_ms: number, view: string | null): void {
    this.seen_ms = time_ms;
    this.attempt = 0;
    this.farewell = "";
    this.downSince = null;
    this.pings.clear();
    this.view?.close();
    this.view = view === null ? null : new View(`${this.url}/view`, view, (data, frames) => this.receive(data, (piece) => frames.add(piece)));
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
    this.view?.close();
    this.view = null;
    this.giveUpWaiting("the connection broke before an answer came");
    if (this.downSince === null) this.downSince = performance.now();
    this.listener.closed(this.farewell);
    window.clearTimeout(this.retry);
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
      for (const after of FOLLOWED_AFTER_MS) window.setTimeout(() => this.ping(), after);
    });
  }

  private ping(): void {
    const id = this.nextId++;
    if (this.send({ type: "ping", id })) this.pings.set(id, performance.now());
  }

  /** Once a second: measures the round trip, and ends a connection that only seems to be there. */
  tick(): void {
    const now = performance.now();
    if (this.connected && now - this.heardAt > SILENCE_MS) {
      const dead = this.socket;
      this.lost();
      dismiss(dead);
      return;
    }
    this.ping();
  }
}

/** The second connection: data and images, so that neither a command nor its answer waits behind a picture. It comes back by itself; without it the first one carries all. */
class View {
  private socket: WebSocket | null = null;
  private retry: number | undefined;

  constructor(private readonly url: string, private readonly of: string, private readonly receive: (data: unknown, frames: Frames) => void) {
    this.open();
  }

  private open(): void {
    const socket = new WebSocket(this.url);
    const frames = new Frames();
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.addEventListener("open", () => socket === this.socket && socket.send(JSON.stringify({ type: "view", of: this.of })));
    socket.addEventListener("message", (event) => socket === this.socket && this.receive(event.data, frames));
    socket.addEventListener("close", () => {
      if (socket === this.socket) this.retry = window.setTimeout(() => this.open(), PAUSE_MS);
    });
  }

  close(): void {
    window.clearTimeout(this.retry);
    const socket = this.socket;
    this.socket = null;
    dismiss(socket);
  }
}
