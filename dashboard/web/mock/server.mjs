// A server that speaks dashboard/protocol.md about a car that is not there: for work on the page and for its tests.
//
//   node mock/server.mjs [--port N] [--read] [--stall] [--no-drive] [--no-vehicle] [--plain]
//
// --read: no control, the e-stop stays open; --stall: data stop after 5 s while the connection lives; --no-drive: the graph has no
// manual drive; --no-vehicle: nothing tells the pose; --plain: no log-in. It listens on 127.0.0.1 only. The token of the log-in form is `secret`.
import { createServer } from "node:http";
import { readFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { WebSocketServer } from "ws";
import { assign, makeGraph, refusal } from "./graph.mjs";
import { SOURCE, greyAt, hsvOf, picture, rgbAt } from "./road.mjs";
import { World } from "./world.mjs";

const CSP = "default-src 'self'; img-src 'self' blob:; connect-src 'self'";
const TYPES = { "/": "text/html", "/app.js": "text/javascript", "/app.css": "text/css", "/icon.svg": "image/svg+xml" };
const RATES = { "carril/Image": 15, "carril/LaneEstimate": 15, "carril/LaserScan": 10, "carril/Sectors": 10 };
const round3 = (value) => Math.round(value * 1000) / 1000;

class Mock {
  constructor(options) {
    this.options = { access: "control", stall: false, drive: true, vehicle: true, canLogIn: true, ...options };
    this.world = new World();
    this.graph = this.options.vehicle ? makeGraph() : makeGraph().map((node) => ({ ...node, outputs: node.outputs.filter((output) => !["vehicle", "progress"].includes(output.port)) }));
    this.sent = new Map();
    this.restarts = new Map();
    /** Everything that pages sent, for tests. */
    this.received = [];
    this.clients = new Set();
    /** A node that gave up. */
    this.gone = this.options.gone ?? null;
    this.started_ms = performance.now();
    this.epoch_ms = 1_795_656_000_000;
    this.logs = [["info", "supervisor", "7 nodes in 7 processes"], ["info", "bridge", "firmware carril 0.1.0 answers on sim:mcu"], ["debug", "lane", "first image: 640x480 bgr8"]]
      .map(([level, process, text], index) => ({ type: "log", time_ms: this.epoch_ms - 900 + index * 200, level, process, text }));
  }

  now() { return round3(this.epoch_ms + performance.now() - this.started_ms); }
  node(name) { return this.graph.find((node) => node.name === name); }
  access() {
    return this.options.access === "control"
      ? { level: "control", name: "laptop-1", why: "granted key" }
      : { level: "read", name: null, why: "no key: log in with the token of `carril grant`" };
  }

  async listen() {
    this.http = createServer((request, response) => void this.serve(request, response));
    this.sockets = new WebSocketServer({
      server: this.http, path: "/ws",
      verifyClient: (_, accept) => setTimeout(() => accept(true), this.options.slowUpgrade_ms ?? 0),
    });
    this.sockets.on("connection", (socket) => this.greet(socket));
    await new Promise((done, failed) => this.http.once("error", failed).listen(this.options.port ?? 0, "127.0.0.1", done));
    this.port = this.http.address().port;
    this.url = `http://127.0.0.1:${this.port}/`;
    this.ticks = 0;
    this.stepped_ms = this.told_ms = performance.now();
    this.timer = setInterval(() => this.tick(), 20);
    return this;
  }

  async close(reason = "the graph has ended") {
    clearInterval(this.timer);
    for (const client of this.clients) {
      this.tell(client, { type: "bye", reason });
      client.socket.terminate();
    }
    this.http.closeAllConnections();
    await new Promise((done) => this.sockets.close(() => this.http.close(done)));
  }

  async serve(request, response) {
    const answer = (status, type, body) => response.writeHead(status, { "content-type": type, "content-security-policy": CSP, "cache-control": "no-store" }).end(body);
    const json = (status, body) => answer(status, "application/json", JSON.stringify(body));
    if (request.method === "POST") {
      let body = "";
      for await (const chunk of request) body += chunk;
      if (request.url === "/api/logout") this.options.access = "read";
      else if (JSON.parse(body || "{}").token === "secret") this.options.access = "control";
      else return json(401, { error: "wrong token; make one with `carril grant`" });
      return json(200, { access: this.access() });
    }
    if (request.url === "/api/session") return json(200, { robot: "car1", access: this.access() });
    const type = TYPES[request.url];
    if (!type) return answer(404, "text/plain", "not here");
    const file = request.url === "/" ? "index.html" : request.url.slice(1);
    return answer(200, type, await readFile(new URL(`../dist/${file}`, import.meta.url)));
  }

  greet(socket) {
    const client = { socket, wants: [], flying: new Map(), due: new Map() };
    this.clients.add(client);
    socket.on("close", () => this.clients.delete(client));
    socket.on("message", (data) => this.hear(client, JSON.parse(data.toString())));
    this.tell(client, {
      type: "hello", version: 1, robot: "car1", graph: "dataflow.yaml", time_ms: this.now(), access: this.access(), can_log_in: this.options.canLogIn, estop_open: true,
      drive: this.options.drive ? { node: "decision", port: "manual", max_speed_m_s: 1, max_steering_rad: 0.349, lease_ms: 300 } : null,
    });
    this.tell(client, { type: "graph", nodes: this.graph });
    for (const line of this.logs) this.tell(client, line);
    this.tell(client, this.status());
  }

  tell(client, message) { if (client.socket.readyState === 1) client.socket.send(JSON.stringify(message)); }
  tellAll(message) { for (const client of this.clients) this.tell(client, message); }
  log(level, process, text) {
    const line = { type: "log", time_ms: this.now(), level, process, text };
    this.logs = [...this.logs, line].slice(-100);
    this.tellAll(line);
  }

  hear(client, message) {
    this.received.push(message);
    const reply = (value) => this.tell(client, { type: "reply", id: message.id, ok: true, value });
    const fail = (error) => this.tell(client, { type: "reply", id: message.id, ok: false, error });
    const controls = this.options.access === "control";
    switch (message.type) {
      case "subscribe": client.wants = message.keys; break;
      case "ack": client.flying.set(message.key, Math.max(0, (client.flying.get(message.key) ?? 0) - 1)); break;
      case "ping": this.tell(client, { type: "pong", id: message.id, time_ms: this.now() }); break;
      case "pixel": reply(this.pixel(message)); break;
      case "control":
        if (!controls && message.word !== "estop") return fail("needs control; log in with the token of `carril grant`");
        this.world.control(message.word, this.now());
        this.log(message.word === "estop" ? "warning" : "info", "gateway", `${message.word} by ${this.access().name ?? "a viewer"}`);
        reply({ nodes: ["decision", "actuator", "bridge"], errors: [] });
        break;
      case "set": case "swap": case "rollback": case "restart":
        if (!controls) return fail("needs control; log in with the token of `carril grant`");
        reply(this.change(message));
        break;
      case "pub": return controls ? reply(null) : fail("needs control");
      case "drive":
        if (controls && this.world.state !== "e-stop") this.world.manual = { steering_rad: message.steering_rad, speed_m_s: message.speed_m_s, at_ms: this.now() };
        this.tell(client, { type: "drive_ack", seq: message.seq, time_ms: this.now(), applied: controls && this.world.state !== "e-stop", error: controls ? (this.world.state === "e-stop" ? "e-stop is latched; reset first" : null) : "needs control" });
        break;
      case "drive_end": this.world.manual = null; break;
      default: this.tell(client, { type: "refused", error: `unknown type \`${message.type}\`` });
    }
  }

  pixel({ x, y }) {
    const [column, row] = [Math.min(SOURCE.width - 1, Math.floor(x * SOURCE.width)), Math.min(SOURCE.height - 1, Math.floor(y * SOURCE.height))];
    const rgb = rgbAt(column, row, this.world.shade);
    return { x: column, y: row, grey: Math.round(greyAt(column, row, this.world.shade)), rgb, hsv: hsvOf(rgb), seq: this.sent.get("world/camera")?.sent ?? 0 };
  }

  change(message) {
    const node = this.node(message.node);
    const receipt = { node: message.node, what: message.type, outcome: "done", from: `v${node.version}`, to: `v${node.version + 1}`, reason: null, gap_ms: message.type === "set" ? 0 : 35, lost: 0, duplicated: 0 };
    for (const [path, value] of Object.entries(message.values ?? {})) {
      const reason = refusal(node, path, value);
      if (reason) Object.assign(receipt, { outcome: "refused", reason, to: receipt.from });
    }
    if (message.operator && !node.fitting.includes(message.operator)) {
      Object.assign(receipt, { outcome: "refused", to: receipt.from, reason: `\`${message.operator}\` does not fit as node \`${node.name}\`` });
    }
    if (receipt.outcome === "done") {
      for (const [path, value] of Object.entries(message.values ?? {})) assign(node.config, path, value);
      node.version += 1;
      if (node.name === this.gone) this.gone = null;
      if (message.type === "restart") this.restarts.set(node.name, (this.restarts.get(node.name) ?? 0) + 1);
      this.tellAll({ type: "graph", nodes: this.graph });
    }
    this.tellAll({ type: "receipt", receipt });
    return receipt;
  }

  valueOf(key) {
    const world = this.world;
    const command = { steering_rad: world.steering, speed_m_s: world.target };
    switch (key) {
      case "lane/lane": return world.lane(this.node("lane").config);
      case "world/scan": return world.scan();
      case "sectors/sectors": return world.sectors(this.node("sectors").config);
      case "world/vehicle": return world.vehicle();
      case "world/progress": return world.progress();
      case "decision/state": return world.decision();
      case "decision/command": case "actuator/command": return command;
      case "bridge/telemetry": return world.telemetry();
      default: return null;
    }
  }

  tick() {
    const now = performance.now();
    const elapsed_s = Math.min(0.2, (now - this.stepped_ms) / 1000); // timers come late on a busy machine; the car must not slow down for it
    this.stepped_ms = now;
    this.ticks += 1;
    this.world.step(elapsed_s, this.now());
    if (this.world.since_ms === 0) this.world.since_ms = this.now();
    for (const node of this.graph) for (const output of node.outputs) this.count(`${node.name}/${output.port}`, output.message_type, elapsed_s);
    if (now - this.told_ms >= 1000) {
      this.told_ms = now;
      this.tellAll(this.status());
    }
    if (this.ticks % 400 === 0) this.log("debug", "lane", "threshold 190 divides floor 61 and marking 230");
    const stalled = this.options.stall === true && performance.now() - this.started_ms > (this.options.stallAfter_ms ?? 5000);
    if (!stalled) for (const client of this.clients) for (const want of client.wants) this.feed(client, want);
  }

  count(key, type, elapsed_s) {
    const counter = this.sent.get(key) ?? { sent: 0, bytes: 0 };
    const [rate_hz, size] = { "carril/Image": [30, 921_600], "carril/LaserScan": [10, 1460], "carril/LaneEstimate": [30, 44], "carril/Sectors": [10, 210] }[type] ?? [50, 40];
    counter.sent += rate_hz * elapsed_s;
    counter.bytes += rate_hz * elapsed_s * size;
    this.sent.set(key, counter);
  }

  feed(client, want) {
    const node = this.node(want.key.split("/")[0]);
    const type = node?.outputs.find((output) => `${node.name}/${output.port}` === want.key)?.message_type;
    if (!type) return;
    const period = 1000 / Math.min(want.max_hz, RATES[type] ?? 50);
    const due = client.due.get(want.key) ?? 0;
    const now = performance.now();
    if (now < due) return;
    client.due.set(want.key, Math.max(due + period, now - period));
    const time_ms = this.now();
    if (type === "carril/Image") this.feedImage(client, want.key, time_ms);
    else {
      const value = this.valueOf(want.key);
      if (value !== null) this.tell(client, { type: "sample", key: want.key, message_type: type, seq: this.ticks, time_ms, origin_ms: round3(time_ms - 31 - 6 * Math.sin(this.ticks / 9)), value });
    }
  }

  feedImage(client, key, time_ms) {
    const flying = client.flying.get(key) ?? 0;
    if (flying >= 2) return;
    client.flying.set(key, flying + 1);
    const threshold = Number(this.node("lane").config.threshold) || 141;
    const image = picture(key === "lane/debug" ? "debug" : "camera", this.world.shade, threshold);
    const header = Buffer.from(JSON.stringify({ key, seq: this.ticks, time_ms, origin_ms: time_ms - 12, width: 480, height: 360, source_width: SOURCE.width, source_height: SOURCE.height, source_encoding: "bgr8" }));
    const length = Buffer.alloc(4);
    length.writeUInt32LE(header.length);
    if (client.socket.readyState === 1) client.socket.send(Buffer.concat([length, header, image]));
  }

  status() {
    const wobble = (base, share = 0.12) => base * (1 + share * Math.sin(this.ticks / 37 + base));
    const triple = (base) => ({ p50: wobble(base), p99: wobble(base * 2.3), max: wobble(base * 3.1) });
    const rates = { world: 120, lane: 30, sectors: 10, decision: 50, actuator: 50, bridge: 50, mcu: 100 };
    const broken = this.options.broken;
    return {
      type: "status", time_ms: this.now(), uptime_s: (performance.now() - this.started_ms) / 1000, fault: broken ? { node: broken, reason: "step failed 3 times: no image for 2.0 s" } : null,
      nodes: this.graph.map((node, index) => ({
        node: node.name, operator: node.operator, process: node.process, pid: 4210 + index, state: node.name === broken ? "faulted" : node.name === this.gone ? "gave-up" : "running",
        rate_hz: wobble(rates[node.name] ?? 10, 0.004), step_us: triple(120 + 90 * index), latency_us: node.name === "world" ? null : triple(260 + 140 * index),
        age_ms: ["lane", "decision", "actuator", "bridge"].includes(node.name) ? triple(14 + 4 * index) : null, overruns: 0, missed_periods: 0,
        errors: node.name === broken ? 3 : 0, last_error: node.name === broken ? "no image for 2.0 s" : null, restarts: this.restarts.get(node.name) ?? 0, budget_violations: 0,
        inputs: node.inputs.map((input) => ({ port: input.port, received: this.ticks, dropped: node.name === "decision" ? 2 : 0, lost: 0, stale: 0, refused: 0, last_refusal: null })),
        outputs: node.outputs.map((output) => {
          const counter = this.sent.get(`${node.name}/${output.port}`) ?? { sent: 0, bytes: 0 };
          return { port: output.port, sent: Math.floor(counter.sent), bytes: Math.floor(counter.bytes) };
        }),
      })),
      link: { sent_bytes: 1_200_000, dropped: { image: 0, data: 0 }, viewers: this.clients.size },
    };
  }
}

export const startMock = (options = {}) => new Mock(options).listen();

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  const has = (flag) => process.argv.includes(`--${flag}`);
  const port = has("port") ? Number(process.argv[process.argv.indexOf("--port") + 1]) : 0;
  const mock = await startMock({ port, access: has("read") ? "read" : "control", stall: has("stall"), drive: !has("no-drive"), vehicle: !has("no-vehicle"), canLogIn: !has("plain") });
  console.log(mock.url);
}
