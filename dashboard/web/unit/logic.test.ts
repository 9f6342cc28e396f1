// The pure logic of the page. Each test says what must hold for the person who looks at the page or drives the car.
import assert from "node:assert/strict";
import { test } from "node:test";
import { CarClock } from "../src/clock";
import { pauseBefore } from "../src/connection";
import { Beat, PERIOD_MS, Ramp, commandOf, wishOfGamepad, wishOfKeys } from "../src/drive";
import { bandwidthOf, flowOf } from "../src/flow";
import { bytesPerSecond, degrees, duration, fixed, microseconds } from "../src/format";
import { History } from "../src/history";
import { edgeName, layOut } from "../src/layout";
import { Newest, Throttle } from "../src/newest";
import { DeadReckoning } from "../src/odometry";
import { bandsOf, inImage, lineOf } from "../src/overlay";
import { Frames, readFrame, readMessage } from "../src/protocol";
import { laneSourceOf, wheelCommandKey } from "../src/roles";
import { allowed, fieldsOf, sliderOf, typed, withDefaults } from "../src/schema";
import { unite } from "../src/subscriptions";
import { Transitions } from "../src/transitions";
import { faultTexts, readLane, readScan } from "../src/values";
import { makeGraph } from "../mock/graph.mjs";

const near = (got: number, expected: number, within: number, what = "") => assert.ok(Math.abs(got - expected) <= within, `${what}: got ${got}, expected ${expected} ± ${within}`);

test("the clock trusts the exchange with the shortest round trip", () => {
  const clock = new CarClock();
  assert.equal(clock.carTimeMs(0), null, "unknown before the first pong");
  clock.learn(0, 200, 5190); // 90 ms late on the way out
  clock.learn(1000, 1010, 6005); // nearly even
  clock.learn(2000, 2300, 7290);
  near(clock.carTimeMs(3000) ?? NaN, 8000, 1, "offset of the short exchange");
  assert.equal(clock.roundTripMs(), 300, "round trip of the newest");
});

test("the clock forgets what is older than its window", () => {
  const clock = new CarClock();
  clock.learn(0, 1, 1000);
  clock.learn(100_000, 100_050, 105_025);
  near(clock.carTimeMs(100_025) ?? NaN, 105_025, 0.001, "only the newer one is left");
});

test("reconnecting is tried twice a second for half a minute, and then less often for ever", () => {
  for (let attempt = 0; attempt < 60; attempt++) assert.equal(pauseBefore(attempt), 500, `attempt ${attempt}`);
  for (const attempt of [60, 1e6]) assert.equal(pauseBefore(attempt), 3000, `attempt ${attempt}`);
});

test("a frame in pieces is put together, and one that is not what it announced is refused without harm to the next", () => {
  const header = new TextEncoder().encode(JSON.stringify({ key: "world/camera", seq: 3, time_ms: 12.5, origin_ms: null, width: 4, height: 2, bytes: 5 }));
  const whole = new Uint8Array(4 + header.length + 5);
  new DataView(whole.buffer).setUint32(0, header.length, true);
  whole.set(header, 4);
  whole.set([1, 2, 3, 4, 5], 4 + header.length);
  const frames = new Frames();
  const cut = 4 + header.length + 2;
  for (const ends of [[cut], [cut, cut + 1], [4 + header.length, cut], []]) {
    let from = 0;
    for (const end of ends) {
      assert.equal(frames.add(whole.slice(from, end).buffer), null, "more is to come");
      from = end;
    }
    assert.deepEqual([...(frames.add(whole.slice(from).buffer)?.jpeg ?? [])], [1, 2, 3, 4, 5], `cut at ${ends}`);
  }
  assert.equal(frames.add(whole.slice(0, cut).buffer), null);
  assert.throws(() => frames.add(new Uint8Array(9).buffer), /announced/);
  assert.throws(() => frames.add(new Uint8Array(3).buffer), /at least 4 B/);
  assert.equal(frames.add(whole.buffer.slice(0))?.seq, 3, "the next one is whole again");
});

test("an image frame is read back, and every truncation of it is refused or has fewer bytes of JPEG", () => {
  const header = new TextEncoder().encode(JSON.stringify({ key: "world/camera", seq: 3, time_ms: 12.5, origin_ms: null, width: 4, height: 2, source_width: 8, source_height: 4 }));
  const whole = new Uint8Array(4 + header.length + 3);
  new DataView(whole.buffer).setUint32(0, header.length, true);
  whole.set(header, 4);
  whole.set([1, 2, 3], 4 + header.length);
  const frame = readFrame(whole.buffer);
  assert.deepEqual([frame.key, frame.seq, frame.source_width, [...frame.jpeg]], ["world/camera", 3, 8, [1, 2, 3]]);
  for (let length = 0; length < 4 + header.length; length++) assert.throws(() => readFrame(whole.buffer.slice(0, length)), `${length} B`);
});

test("bad messages throw, unknown types do not", () => {
  for (const bad of ["", "[]", "3", "{", '{"type":"sample"}', '{"type":"pong","id":1}', '{"type":"log"}', '{"type":"reply"}']) assert.throws(() => readMessage(bad), bad);
  assert.equal(readMessage('{"type":"new thing","time_ms":4}').message.type, "unknown");
  assert.equal(readMessage('{"type":"new thing","time_ms":4}').time_ms, 4, "its time was seen all the same");
});

test("values of the wrong shape are no values", () => {
  assert.equal(readLane({ lane: { angle_rad: 1 } }), null);
  assert.deepEqual(readLane({ lane: null, quality: 0, threshold: null }), { lane: null, quality: 0, threshold: null });
  assert.equal(readScan({ angle_min_rad: 0 }), null);
  assert.deepEqual(readScan({ angle_min_rad: 0, angle_increment_rad: 1, range_min_m: 0, range_max_m: 9, ranges_m: [1, null, "x"] })?.ranges_m, [1, null, null]);
});

test("every fault bit has words, also one that this page does not know", () => {
  assert.match(faultTexts(1 << 3)[0] ?? "", /battery/);
  assert.equal(faultTexts(0).length, 0);
  assert.match(faultTexts(1 << 12)[0] ?? "", /12/);
});

test("lane pixels land on the image: origin in the middle of the bottom row, left and up", () => {
  const size = { width: 640, height: 480 };
  assert.deepEqual(inImage(0, 0, size), { x: 0.5, y: 479.5 / 480 });
  near(inImage(319.5, 0, size).x, 0.5 / 640, 1e-9, "leftmost column");
  near(inImage(0, 479, size).y, 0.5 / 480, 1e-9, "top row");
});

test("the line goes through both centroids", () => {
  const size = { width: 100, height: 100 };
  const lane = { angle_rad: 0, distance_px: 0, distance_m: null, near: { left_px: 10, ahead_px: 20, pixels: 1 }, far: { left_px: 20, ahead_px: 40, pixels: 1 } };
  const [from, to] = lineOf(lane, size);
  const at = (point: { x: number; y: number }) => { const share = (point.y - from.y) / (to.y - from.y); return from.x + share * (to.x - from.x); };
  for (const each of [lane.near, lane.far]) { const point = inImage(each.left_px, each.ahead_px, size); near(at(point), point.x, 1e-9); }
});

test("bands stand where the configuration says, and are absent without it", () => {
  assert.deepEqual(bandsOf({ row_far: 0.5, row_near: 0.75, band_px: 10 }, { width: 1, height: 100 }), [{ top: 0.45, bottom: 0.55 }, { top: 0.7, bottom: 0.8 }]);
  assert.deepEqual(bandsOf({}, { width: 1, height: 100 }), []);
});

test("dead reckoning drives a circle of the radius that the steering gives", () => {
  const reckoning = new DeadReckoning();
  const steering_rad = Math.atan(0.26 / 1.0);
  let far = 0;
  for (let ms = 0; ms <= 2 * Math.PI * 1000; ms += 10) far = Math.max(far, reckoning.step(ms, 1, steering_rad).y_m);
  near(far, 2, 0.02, "diameter");
  near(Math.hypot(reckoning.pose.x_m, reckoning.pose.y_m), 0, 0.03, "back at the start");
});

test("dead reckoning does not move over a gap", () => {
  const reckoning = new DeadReckoning();
  reckoning.step(0, 1, 0);
  reckoning.step(5000, 1, 0);
  assert.equal(reckoning.pose.x_m, 0);
});

test("parameters come with range, unit and default; references and choices are followed", () => {
  const lane = makeGraph().find((node) => node.name === "lane");
  const fields = new Map(fieldsOf(lane.schema, lane.config).map((field) => [field.path, field]));
  const threshold = fields.get("threshold");
  assert.deepEqual([threshold?.kind, threshold?.minimum, threshold?.maximum, threshold?.words, threshold?.unit, threshold?.value], ["number", 0, 255, ["otsu"], "grey value", 190]);
  assert.equal(fields.get("marking")?.kind, "json", "words or an object: text");
  assert.equal(fields.get("metres_per_px")?.nullable, true);
  assert.equal(fields.get("row_near")?.exclusiveMinimum, 0);
  assert.equal(allowed(threshold as never), "0 to 255 or otsu");
});

test("what is not configured has its default", () => {
  const lane = makeGraph().find((node) => node.name === "lane");
  const config = withDefaults(lane.schema, { row_far: 0.6 });
  assert.deepEqual([config.row_far, config.row_near, config.band_px], [0.6, 0.85, 1]);
});

test("nested parameters have paths with dots", () => {
  const world = makeGraph().find((node) => node.name === "world");
  const fields = fieldsOf(world.schema, world.config);
  const noise = fields.find((field) => field.path === "camera.noise_grey");
  assert.deepEqual([noise?.kind, noise?.maximum], ["number", 50]);
  assert.equal(fields.find((field) => field.path === "camera.lighting")?.kind, "choice");
  assert.equal(fields.find((field) => field.path === "lidar.posts")?.kind, "json");
});

test("every parameter of every operator gets a slider inside its range, or none", () => {
  for (const node of makeGraph()) {
    for (const field of fieldsOf(node.schema, node.config)) {
      const slider = sliderOf(field);
      if (!slider) continue;
      const where = `${node.name}.${field.path} ${JSON.stringify(slider)}`;
      assert.ok(slider.step > 0 && slider.max > slider.min, where);
      assert.ok(slider.max <= (field.maximum ?? Infinity), where);
      assert.ok(slider.min >= (field.minimum ?? -Infinity) && slider.min > (field.exclusiveMinimum ?? -Infinity), where);
      if (typeof field.value === "number") assert.ok(field.value >= slider.min - slider.step && field.value <= slider.max + slider.step, `${where} has ${field.value}`);
    }
  }
});

test("what a person types is JSON, else a word", () => {
  assert.deepEqual([typed("3"), typed("true"), typed("otsu"), typed('{"hsv": {}}')], [3, true, "otsu", { hsv: {} }]);
});

const METRICS = { width: 100, height: 50, gapX: 50, gapY: 10 };

test("the graph runs from left to right; the loop of the simulator is cut where it comes back to the sensors", () => {
  const nodes = makeGraph().map((node) => ({ name: node.name, from: node.inputs.flatMap((input) => (input.from ? [input.from.split("/")[0]] : [])), sensor: node.name === "world" }));
  const { places, back } = layOut(nodes, METRICS);
  assert.deepEqual([...back], [edgeName("mcu", "world")]);
  const order = ["world", "lane", "decision", "actuator", "bridge"].map((name) => places.get(name)?.layer);
  assert.deepEqual(order, [0, 1, 2, 3, 4]);
});

test("no two nodes of a graph lie on each other", () => {
  const nodes = [...Array(30).keys()].map((at) => ({ name: `n${at}`, from: at === 0 ? [] : [`n${Math.floor((at * 7) % at)}`, `n${Math.floor(at / 3)}`], sensor: false }));
  const all = [...layOut(nodes, METRICS).places.values()];
  for (const [at, a] of all.entries()) {
    for (const b of all.slice(at + 1)) assert.ok(Math.abs(a.x - b.x) >= METRICS.width || Math.abs(a.y - b.y) >= METRICS.height - 1e-6, `${JSON.stringify(a)} ${JSON.stringify(b)}`);
  }
});

test("an edge to itself and a graph of nothing break nothing", () => {
  assert.equal(layOut([{ name: "a", from: ["a"], sensor: false }], METRICS).places.size, 1);
  assert.equal(layOut([], METRICS).places.size, 0);
});

test("held keys point where their arrows do, and opposite ones cancel", () => {
  assert.equal(wishOfKeys(new Set()), null, "nothing held, nothing sent");
  assert.deepEqual(wishOfKeys(new Set(["KeyW", "ArrowLeft"])), { steering: 1, speed: 1 });
  assert.deepEqual(wishOfKeys(new Set(["KeyA", "KeyD"])), { steering: 0, speed: 0 });
});

test("a gamepad drives only while a shoulder button is held", () => {
  const buttons = [...Array(17)].map(() => ({ pressed: false, value: 0 }));
  buttons[7] = { pressed: true, value: 1 };
  assert.equal(wishOfGamepad({ axes: [1, 0], buttons }), null);
  buttons[5] = { pressed: true, value: 1 };
  assert.deepEqual(wishOfGamepad({ axes: [1, 0], buttons }), { steering: -1, speed: 1 }, "stick to the right is negative");
  assert.deepEqual(wishOfGamepad({ axes: [NaN, 0], buttons }), { steering: 0, speed: 1 });
});

test("no wish goes beyond the limits", () => {
  assert.deepEqual(commandOf({ steering: 5, speed: -7 }, { max_speed_m_s: 0.5, max_steering_rad: 0.3 }), { steering_rad: 0.3, speed_m_s: -0.5 });
  assert.deepEqual(commandOf({ steering: NaN, speed: NaN }, { max_speed_m_s: 0.5, max_steering_rad: 0.3 }), { steering_rad: 0, speed_m_s: 0 });
});

test("keys ramp up and a release begins at nothing again", () => {
  const ramp = new Ramp();
  assert.ok(ramp.step({ steering: 1, speed: 1 }, 0.02).speed < 0.1);
  for (let at = 0; at < 100; at++) ramp.step({ steering: 1, speed: 1 }, 0.02);
  assert.deepEqual(ramp.step({ steering: 1, speed: 1 }, 0.02), { steering: 1, speed: 1 });
  ramp.reset();
  assert.ok(ramp.step({ steering: 1, speed: 1 }, 0.02).speed < 0.1);
});

test("the beat keeps 50 a second over late timers, and does not catch up on a long pause", () => {
  let [now, beats] = [0, 0];
  let planned: { at: number; action: () => void } | null = null;
  const beat = new Beat({ now: () => now, later: (ms, action) => { planned = { at: now + ms, action }; return () => { planned = null; }; } }, () => { beats += 1; });
  const run = (until: number, late: number) => { while (planned && planned.at <= until) { const { at, action } = planned; now = at + late; action(); } now = Math.max(now, until); };
  beat.start();
  run(1000, 6);
  near(beats, 1000 / PERIOD_MS, 2, "timers of 6 ms delay lose no beat");
  const before = beats;
  run(1030, 500); // the browser slept
  run(1600, 0);
  assert.ok(beats - before < 12, `got ${beats - before} beats: those that were missed stay missed`);
  beat.stop();
  const stopped = beats;
  run(5000, 0);
  assert.equal(beats, stopped);
});

test("rates come from two statuses, by the clock of the node; a restart gives none", () => {
  const status = (measured_ms: number, sent: number, bytes: number) => ({ time_ms: 1e6, nodes: [{ node: "a", measured_ms, outputs: [{ port: "x", sent, bytes }] }] }) as never;
  assert.deepEqual(flowOf(status(0, 0, 0), status(2000, 60, 4000), "a/x"), { rate_hz: 30, bytes_per_s: 2000 });
  assert.equal(flowOf(status(0, 100, 0), status(1000, 5, 0), "a/x"), null, "it was started anew");
  assert.equal(flowOf(status(0, 1, 1), status(0, 1, 1), "a/x"), null, "nothing newer was measured");
  assert.equal(flowOf(null, status(0, 1, 1), "a/x"), null);
  assert.equal(flowOf(status(0, 0, 0), status(1000, 1, 1), "a/y"), null, "no such output");
});

test("what stays in the process has a rate and no bandwidth", () => {
  assert.deepEqual([{ rate_hz: 30, bytes_per_s: 1200 }, { rate_hz: 30, bytes_per_s: 0 }, { rate_hz: 0, bytes_per_s: 0 }].map(bandwidthOf), ["1.2 kB/s", "in process", ""]);
});

test("numbers for people: no data is a dash, zero has no sign", () => {
  assert.deepEqual([fixed(null, 1), fixed(NaN, 1), fixed(-0.001, 1), fixed(-1.25, 1)], ["–", "–", "0.0", "−1.3"]);
  assert.deepEqual([degrees(Math.PI), duration(34.4), duration(1234), duration(61_000)], ["180.0", "34 ms", "1.2 s", "1 min 1 s"]);
  assert.deepEqual([microseconds(320), microseconds(1200), bytesPerSecond(27_648_000), bytesPerSecond(999), bytesPerSecond(1200)], ["320 µs", "1.2 ms", "28 MB/s", "999 B/s", "1.2 kB/s"]);
});

test("the history holds one minute and begins anew with another clock", () => {
  const history = new History(["a"] as const);
  for (let ms = 1000; ms <= 100_000; ms += 1000) history.push(ms, { a: ms });
  const [times, values] = history.table("a");
  assert.deepEqual([times[0], times.at(-1), values?.length], [-60, 0, 61]);
  history.push(5, { a: 1 });
  assert.equal(history.table("a")[0].length, 1);
});

test("transitions: newest first, those not seen are counted, a restart begins anew", () => {
  const history = new Transitions();
  const at = (state: string, transitions: number) => ({ state, transitions, since_ms: 0, reason: "", target_speed_m_s: 0, steering_rad: 0 });
  assert.equal(history.take(at("idle", 1)), true);
  assert.equal(history.take(at("idle", 1)), false);
  history.take(at("lane-follow", 4));
  assert.deepEqual(history.newestFirst().map((each) => [each.state, each.missed]), [["lane-follow", 2], ["idle", 0]]);
  history.take(at("idle", 0));
  assert.equal(history.newestFirst().length, 1);
  for (let count = 1; count < 60; count++) history.take(at("idle", count));
  assert.equal(history.newestFirst().length, 20);
});

test("of items that come while one is handled only the newest is handled", async () => {
  const handled: number[] = [];
  const dropped: number[] = [];
  let release = () => {};
  const queue = new Newest<number>((item) => { handled.push(item); return new Promise((done) => { release = done; }); }, (item) => dropped.push(item));
  for (const item of [1, 2, 3, 4]) queue.push(item);
  release();
  await new Promise((done) => setImmediate(done));
  assert.deepEqual([handled, dropped], [[1, 4], [2, 3]]);
});

test("a throttle does the first at once and then the newest of each pause", async () => {
  const done: number[] = [];
  let wake = () => {};
  const throttle = new Throttle<number>(200, async (item) => { done.push(item); }, () => new Promise((resolve) => { wake = resolve; }));
  throttle.push(1);
  throttle.push(2);
  throttle.push(3);
  assert.deepEqual(done, [1]);
  wake();
  await new Promise((resolve) => setImmediate(resolve));
  assert.deepEqual(done, [1, 3]);
});

test("several wishes for a key become one, at the highest rate and size", () => {
  assert.deepEqual(unite([{ key: "b", max_hz: 5 }, { key: "a", max_hz: 10, width: 320 }, { key: "a", max_hz: 30, width: 480, quality: 70 }]), [{ key: "a", max_hz: 30, width: 480, quality: 70 }, { key: "b", max_hz: 5 }]);
});

test("roles: the command at the wheel and the detector of an image", () => {
  const graph = makeGraph();
  assert.equal(wheelCommandKey(graph), "actuator/command");
  assert.equal(wheelCommandKey(graph.filter((node) => node.name !== "bridge")), "actuator/command", "else the last");
  const source = laneSourceOf(graph, "world/camera");
  assert.deepEqual([source?.laneKey, source?.debugKey], ["lane/lane", "lane/debug"]);
  assert.equal(laneSourceOf(graph, "lane/debug")?.laneKey, "lane/lane", "its own picture has the same pixels");
  assert.equal(laneSourceOf(graph, null), null);
});
