// Where the car is, from above, with the trail of the last minute; how it does on its track.
import type { Car, Sample } from "../car";
import { fitCanvas, h, setText } from "../dom";
import { fixed } from "../format";
import { DeadReckoning, type Pose } from "../odometry";
import { Panel } from "../panel";
import { firstKey } from "../roles";
import type { Subscriptions } from "../subscriptions";
import { color, onTheme } from "../theme";
import type { Progress, Telemetry, Vehicle } from "../values";

const LIMIT_MS = 1000;
const TRAIL_MS = 60_000;
const TRAIL_STEP_MS = 100;
/** The view never shows less than this, m: a car that stands would fill it with noise. */
const SMALLEST_VIEW_M = 1.5;

interface Crumb extends Pose { time_ms: number }

/** 1, 2 or 5 times a power of ten, at most `length`. */
function roundLength(length: number): number {
  const power = 10 ** Math.floor(Math.log10(length));
  return ([5, 2, 1].find((factor) => factor * power <= length) ?? 1) * power;
}

export function vehiclePanel(car: Car, subscriptions: Subscriptions): Panel {
  const keys = () => ({
    vehicle: firstKey(car.nodes, "carril/VehicleState"), telemetry: firstKey(car.nodes, "carril/WheelTelemetry"), progress: firstKey(car.nodes, "carril/TrackProgress"),
  });
  const main = () => keys().vehicle ?? keys().telemetry;
  let trail: Crumb[] = [];
  let pose: Pose | null = null;
  let reckoning = new DeadReckoning();
  let planned = false;

  const panel = new Panel(car, {
    id: "vehicle", title: "Vehicle", limit_ms: LIMIT_MS, changed: () => subscriptions.update(), age: () => car.ageOf(main()),
    absent: () => (car.nodes.length > 0 && !main() ? "nothing here tells where the car is" : null),
  });
  const origin = h("span", { class: "panel-note" });
  const canvas = h("canvas", { class: "fill-canvas", role: "img", "aria-label": "Path of the car, seen from above" });
  const figures = h("div", { class: "vehicle-foot" });
  panel.tools.append(origin);
  panel.body.append(canvas, figures);

  subscriptions.add(() => {
    if (panel.collapsed) return [];
    const found = keys();
    return [found.vehicle ?? found.telemetry, found.progress].filter((key): key is string => key !== null).map((key) => ({ key, max_hz: 20 }));
  });

  function took(next: Pose, time_ms: number): void {
    pose = next;
    const last = trail.at(-1);
    if (last && time_ms < last.time_ms) trail = [];
    if (!last || time_ms - last.time_ms >= TRAIL_STEP_MS) trail.push({ ...next, time_ms });
    const oldest = time_ms - TRAIL_MS;
    while ((trail[0]?.time_ms ?? Infinity) < oldest) trail.shift();
    plan();
  }

  function sampled(sample: Sample): void {
    const found = keys();
    if (sample.key === found.vehicle) took(sample.value as Vehicle, sample.time_ms);
    else if (sample.key === found.telemetry && !found.vehicle) {
      const { speed_m_s, steering_rad } = sample.value as Telemetry;
      took(reckoning.step(sample.time_ms, speed_m_s, steering_rad), sample.time_ms);
    } else if (sample.key === found.progress) showProgress(sample.value as Progress);
  }

  function showProgress(progress: Progress): void {
    const parts: [string, string][] = [
      ["laps", progress.last_lap_s === null ? String(progress.laps) : `${progress.laps} (${fixed(progress.last_lap_s, 1)} s)`], ["cross-track", `${fixed(progress.cross_track_m * 100, 1)} cm`],
      ["rms", `${fixed(progress.cross_track_rms_m * 100, 1)} cm`], ["driven", `${fixed(progress.distance_m, 1)} m`],
    ];
    if (progress.outside) parts.push(["▲", "outside the lane"]);
    if (progress.collisions > 0) parts.push(["▲ collisions", String(progress.collisions)]);
    figures.replaceChildren(...parts.map(([label, value]) => h("span", {}, h("span", { class: "muted" }, `${label} `), value)));
  }

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
    if (!fitted || !panel.visible || !pose) return;
    const { context, width, height } = fitted;
    context.clearRect(0, 0, width, height);
    const xs = [...trail.map((crumb) => crumb.x_m), pose.x_m];
    const ys = [...trail.map((crumb) => crumb.y_m), pose.y_m];
    const [minX, maxX, minY, maxY] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const margin = 18;
    const scale = Math.min((width - 2 * margin) / Math.max(maxX - minX, SMALLEST_VIEW_M), (height - 2 * margin) / Math.max(maxY - minY, SMALLEST_VIEW_M / 2));
    const [midX, midY] = [(minX + maxX) / 2, (minY + maxY) / 2];
    const at = (x: number, y: number) => [width / 2 + (x - midX) * scale, height / 2 - (y - midY) * scale] as const;
    context.lineWidth = 2;
    context.lineCap = "round";
    context.strokeStyle = color("accent");
    for (let index = 1; index < trail.length; index++) {
      const [from, to] = [trail[index - 1], trail[index]];
      if (!from || !to || to.time_ms - from.time_ms > 1000) continue; // a gap stays a gap
      context.globalAlpha = 0.15 + 0.85 * (index / trail.length);
      context.beginPath();
      context.moveTo(...at(from.x_m, from.y_m));
      context.lineTo(...at(to.x_m, to.y_m));
      context.stroke();
    }
    context.globalAlpha = 1;
    arrow(context, at(pose.x_m, pose.y_m), pose.yaw_rad);
    scaleBar(context, height, scale);
  }

  function arrow(context: CanvasRenderingContext2D, [x, y]: readonly [number, number], yaw_rad: number): void {
    context.save();
    context.translate(x, y);
    context.rotate(-yaw_rad);
    context.beginPath();
    for (const [dx, dy] of [[11, 0], [-7, 6], [-4, 0], [-7, -6]] as const) context.lineTo(dx, dy);
    context.closePath();
    context.fillStyle = color("ink");
    context.fill();
    context.strokeStyle = color("panel");
    context.lineWidth = 1.5;
    context.stroke();
    context.restore();
  }

  function scaleBar(context: CanvasRenderingContext2D, height: number, scale: number): void {
    const length = roundLength(70 / scale);
    context.strokeStyle = context.fillStyle = color("muted");
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(10, height - 12);
    context.lineTo(10, height - 8);
    context.lineTo(10 + length * scale, height - 8);
    context.lineTo(10 + length * scale, height - 12);
    context.stroke();
    context.font = "10px system-ui, sans-serif";
    context.textBaseline = "bottom";
    context.textAlign = "left";
    context.fillText(`${Number(length.toPrecision(1))} m`, 14, height - 10);
  }

  car.on("sample", sampled);
  car.on("graph", () => {
    const found = keys();
    setText(origin, found.vehicle ? "map" : found.telemetry ? "dead reckoning" : "");
    origin.title = found.vehicle ? "Pose in the map" : "From wheel speed and steering: drifts";
    if (!found.progress) figures.replaceChildren();
  });
  car.on("hello", () => {
    trail = [];
    pose = null;
    reckoning = new DeadReckoning();
  });
  onTheme(plan);
  new ResizeObserver(plan).observe(canvas);
  return panel;
}
