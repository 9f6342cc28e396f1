// What the camera sees, what the lane detector makes of it, and what a pixel is worth: the place where thresholds are found.
import type { Car, Sample } from "../car";
import { fitCanvas, h, setAttribute, setText } from "../dom";
import { fixed } from "../format";
import { recall, remember } from "../memory";
import { Newest, Throttle } from "../newest";
import { announce } from "../notices";
import { Panel } from "../panel";
import type { ImageFrame } from "../protocol";
import { fields, list, number } from "../read";
import { imageKeys, laneSourceOf, type LaneSource } from "../roles";
import { withDefaults } from "../schema";
import type { Subscriptions } from "../subscriptions";
import type { LaneEstimate } from "../values";
import { contain, paintCrosshair, paintLane, type Area } from "./camera-paint";

const LIMIT_MS = 1000;
const PIXEL_PAUSE_MS = 100;
/** Half a second of them: an image comes later than its estimate, by the time that its JPEG takes. */
const ESTIMATES_KEPT = 15;
const LAYERS = ["rows", "points", "line", "mask"] as const;
type Layer = (typeof LAYERS)[number];
const LAYER_TITLES: Record<Layer, string> = {
  rows: "Bands of rows that the detector reads", points: "Centroids of the marking", line: "The line through both centroids", mask: "What the detector sees; made only while it is shown",
};

interface Shown { bitmap: ImageBitmap; frame: ImageFrame; received_ms: number }
export function cameraPanel(car: Car, subscriptions: Subscriptions): Panel {
  let key: string | null = null;
  let shown: Shown | null = null;
  let mask: Shown | null = null;
  let pointer: { x: number; y: number } | null = null;
  let area: Area = { x: 0, y: 0, width: 0, height: 0 };
  let planned = false;
  let estimates: Sample[] = [];
  const layers = new Set<Layer>(LAYERS.filter((layer) => recall(`layer.${layer}`) === "yes" || (layer !== "mask" && recall(`layer.${layer}`) === null)));

  const panel = new Panel(car, {
    id: "camera", title: "Camera", limit_ms: LIMIT_MS, changed: () => subscriptions.update(),
    age: () => shown && car.age(shown.frame.time_ms, shown.received_ms),
    absent: () => (car.nodes.length > 0 && imageKeys(car.nodes).length === 0 ? "this graph has no images" : null),
  });

  const pick = h("select", { class: "camera-pick", "aria-label": "Image", onchange: () => choose(pick.value) });
  const layerButtons = LAYERS.map((layer) => h("button", { type: "button", class: "toggle", title: LAYER_TITLES[layer], "data-layer": layer, onclick: () => toggle(layer) }, layer));
  const snap = h("button", { type: "button", class: "toggle", title: "Snapshot: save what is shown as PNG", "aria-label": "Snapshot", onclick: () => void snapshot() }, "⤓");
  panel.tools.append(pick, h("div", { class: "group", role: "group", "aria-label": "Overlays" }, ...layerButtons), snap);
  const canvas = h("canvas", { class: "camera-canvas", role: "img", "aria-label": "Camera image; point at it to read a pixel" });
  const swatch = h("canvas", { class: "swatch", width: 16, height: 16, "aria-hidden": true });
  const readout = h("span", { class: "pixel-text", id: "pixel" });
  const lane = h("span", { class: "lane-text", id: "lane-text" });
  panel.body.append(h("div", { class: "camera-stage" }, canvas), h("div", { class: "camera-foot" }, swatch, readout, lane));

  const source = (): LaneSource | null => laneSourceOf(car.nodes, key);
  /** The estimate of the very image that is shown, known by its exposure; else the newest. At speed, one frame is centimetres. */
  function estimate(laneKey: string, frame: ImageFrame): LaneEstimate | null {
    if ((car.ageOf(laneKey) ?? Infinity) > LIMIT_MS) return null;
    const own = frame.origin_ms === null ? undefined : estimates.find((each) => each.key === laneKey && each.origin_ms === frame.origin_ms);
    return (own?.value as LaneEstimate | undefined) ?? car.value<LaneEstimate>(laneKey);
  }

  subscriptions.add(() => {
    if (!panel.visible || !key) return [];
    const pixels = canvas.clientWidth * Math.min(window.devicePixelRatio || 1, 2);
    const width = [320, 480, 640, 960].find((each) => each >= pixels * 0.75) ?? 960; // a little coarser than the screen: half the bytes, hardly seen
    const found = source();
    const wants = [{ key, max_hz: 30, width, quality: 70 }];
    if (layers.has("mask") && found?.debugKey && found.debugKey !== key) wants.push({ key: found.debugKey, max_hz: 15, width, quality: 70 });
    return found ? [...wants, { key: found.laneKey, max_hz: 30 }] : wants;
  });

  function choose(next: string | null): void {
    if (next === key) return;
    key = next;
    shown?.bitmap.close();
    shown = null;
    if (next) remember("camera", next);
    subscriptions.update();
    plan();
  }

  function toggle(layer: Layer): void {
    if (!layers.delete(layer)) layers.add(layer);
    remember(`layer.${layer}`, layers.has(layer) ? "yes" : "no");
    showLayers();
    subscriptions.update();
    plan();
  }

  function showLayers(): void {
    for (const button of layerButtons) setAttribute(button, "aria-pressed", String(layers.has(button.dataset.layer as Layer)));
    if (!layers.has("mask")) {
      mask?.bitmap.close();
      mask = null;
    }
  }

  const acknowledge = (frame: ImageFrame) => car.connection.send({ type: "ack", key: frame.key, seq: frame.seq });

  /** Decodes the newest only. What was overtaken is acknowledged too, else the server would wait for it. */
  function decoder(take: (next: Shown) => void): Newest<ImageFrame> {
    return new Newest<ImageFrame>(async (frame, overtaken) => {
      const received_ms = performance.now();
      let bitmap: ImageBitmap;
      try {
        bitmap = await createImageBitmap(new Blob([frame.jpeg], { type: "image/jpeg" }));
      } catch {
        car.emit("note", { level: "warning", text: `${frame.key}: image ${frame.seq} cannot be decoded` });
        acknowledge(frame);
        return;
      }
      if (overtaken() || !panel.visible) bitmap.close();
      else take({ bitmap, frame, received_ms });
      acknowledge(frame);
    }, acknowledge);
  }
  const images = decoder((next) => {
    if (next.frame.key !== key) return next.bitmap.close();
    shown?.bitmap.close();
    shown = next;
    draw();
    if (pointer) ask.push(pointer);
  });
  const masks = decoder((next) => {
    mask?.bitmap.close();
    mask = layers.has("mask") ? next : null;
    if (!mask) next.bitmap.close();
    plan();
  });

  /** Soon, once: lane and mask may arrive in the same moment. */
  function plan(): void {
    if (planned) return;
    planned = true;
    requestAnimationFrame(() => {
      planned = false;
      draw();
    });
  }

  function draw(): void {
    const fitted = fitCanvas(canvas);
    if (!fitted || !panel.visible) return;
    const { context, width, height } = fitted;
    context.clearRect(0, 0, width, height);
    if (!shown) return;
    area = contain(shown.frame, width, height);
    paint(context, area, 1);
    if (pointer) paintCrosshair(context, area.x + pointer.x * area.width, area.y + pointer.y * area.height);
  }

  function paint(context: CanvasRenderingContext2D, into: Area, scale: number): void {
    if (!shown) return;
    const { frame, bitmap } = shown;
    context.imageSmoothingEnabled = true;
    context.drawImage(bitmap, into.x, into.y, into.width, into.height);
    if (layers.has("mask") && mask && car.age(mask.frame.time_ms, mask.received_ms) <= LIMIT_MS) {
      context.globalAlpha = 0.55;
      context.drawImage(mask.bitmap, into.x, into.y, into.width, into.height);
      context.globalAlpha = 1;
    }
    const found = source();
    if (!found) return;
    const seen = estimate(found.laneKey, frame)?.lane ?? null;
    paintLane(context, into, scale, { width: frame.source_width, height: frame.source_height }, {
      rows: layers.has("rows") ? withDefaults(found.node.schema, found.node.config) : null, line: layers.has("line") ? seen : null, points: layers.has("points") ? seen : null,
    });
  }

  const ask = new Throttle<{ x: number; y: number }>(PIXEL_PAUSE_MS, async (at) => {
    if (!key || !pointer) return;
    try {
      const answer = fields(await car.connection.request({ type: "pixel", key, ...at }));
      if (pointer) showPixel(answer);
    } catch (error) {
      setText(readout, (error as Error).message);
    }
  });

  function showPixel(answer: Record<string, unknown>): void {
    const [rgb, hsv] = [list(answer.rgb).map(number), list(answer.hsv).map(number)];
    setText(readout, `x ${number(answer.x)} y ${number(answer.y)}  grey ${number(answer.grey)}  rgb ${rgb.join(" ")}  hsv ${hsv.join(" ")}`);
    lane.hidden = true; // there is room for one of them
    const context = swatch.getContext("2d");
    if (!context) return;
    context.fillStyle = `rgb(${rgb.map((each) => each ?? 0).join(",")})`;
    context.fillRect(0, 0, 16, 16);
    swatch.classList.add("has-value");
  }

  function point(event: PointerEvent): void {
    const box = canvas.getBoundingClientRect();
    const [x, y] = [(event.clientX - box.left - area.x) / area.width, (event.clientY - box.top - area.y) / area.height];
    pointer = shown && x >= 0 && x < 1 && y >= 0 && y < 1 ? { x, y } : null;
    if (pointer) ask.push(pointer);
    else unpoint();
    plan();
  }

  function unpoint(): void {
    pointer = null;
    ask.clear();
    setText(readout, matchMedia("(pointer: coarse)").matches ? "tap to read a pixel" : "point at the image to read a pixel");
    lane.hidden = false;
    swatch.classList.remove("has-value");
    plan();
  }
  canvas.addEventListener("pointermove", point);
  canvas.addEventListener("pointerdown", point);
  // A finger that left the screen meant that place; a mouse that left the image did not.
  canvas.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && unpoint());
  unpoint();

  async function snapshot(): Promise<void> {
    if (!shown) return announce("bad", "Snapshot: there is no image yet");
    const { frame } = shown;
    const picture = document.createElement("canvas");
    [picture.width, picture.height] = [frame.width, frame.height];
    const context = picture.getContext("2d");
    if (!context) return;
    paint(context, { x: 0, y: 0, width: frame.width, height: frame.height }, Math.max(1, frame.width / 640));
    const blob = await new Promise<Blob | null>((done) => picture.toBlob(done, "image/png"));
    if (!blob) return announce("bad", "Snapshot: the browser made no PNG");
    const time = frame.time_ms > 1e11 ? new Date(frame.time_ms).toISOString().replace(/[:.]/g, "-") : `${(frame.time_ms / 1000).toFixed(3)}s`;
    const link = h("a", { href: URL.createObjectURL(blob), download: `${car.hello?.robot ?? "car"}_${frame.key.replace(/\W/g, "-")}_${time}.png` });
    link.click();
    window.setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }

  car.on("graph", (nodes) => {
    const keys = imageKeys(nodes);
    pick.replaceChildren(...keys.map((each) => h("option", { value: each }, each)));
    const remembered = recall("camera");
    const next = keys.find((each) => each === key) ?? keys.find((each) => each === remembered) ?? keys[0] ?? null;
    choose(next);
    if (next) pick.value = next;
    plan();
  });
  car.on("image", (frame) => {
    if (frame.key === key) images.push(frame);
    else if (frame.key === source()?.debugKey && layers.has("mask")) masks.push(frame);
    else acknowledge(frame);
  });
  car.on("hello", () => {
    images.clear();
    masks.clear();
    estimates = [];
  });
  car.on("sample", (sample) => {
    if (sample.message_type !== "carril/LaneEstimate" || sample.key !== source()?.laneKey) return;
    estimates = [...estimates, sample].slice(-ESTIMATES_KEPT);
    const { lane: seen, quality } = sample.value as LaneEstimate;
    setText(lane, seen ? `lane ${fixed((seen.angle_rad * 180) / Math.PI, 1)}° ${fixed(seen.distance_px, 0)} px · q ${fixed(quality, 2)}` : "no lane");
    plan();
  });
  new ResizeObserver(() => {
    subscriptions.update();
    plan();
  }).observe(canvas);
  showLayers();
  return panel;
}
