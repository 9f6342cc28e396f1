// What lies around the car: points of the scan and the sectors drawn from it. Body frame: x is up, y is left.
import type { Car } from "../car";
import { fitCanvas, h, setText } from "../dom";
import { fixed } from "../format";
import { recall, remember } from "../memory";
import { Panel } from "../panel";
import { fields, list, number, text, type Fields } from "../read";
import { firstKey } from "../roles";
import { withDefaults } from "../schema";
import type { Subscriptions } from "../subscriptions";
import { color, onTheme } from "../theme";
import type { Scan, Sector } from "../values";

const LIMIT_MS = 1000;
const REACHES_M = [1, 2, 4, 8, 16];
const RINGS_M = [0.25, 0.5, 1, 2, 5, 10];
/** Labels nearer than this would lie on each other. */
const RING_GAP_PX = 48;

export function lidarPanel(car: Car, subscriptions: Subscriptions): Panel {
  const keys = () => ({ scan: firstKey(car.nodes, "carril/LaserScan"), sectors: firstKey(car.nodes, "carril/Sectors") });
  const main = () => keys().scan ?? keys().sectors;
  let reach = REACHES_M.find((each) => String(each) === recall("lidar.reach")) ?? 2;
  let planned = false;

  const panel = new Panel(car, {
    id: "lidar", title: "Lidar", limit_ms: LIMIT_MS, changed: () => subscriptions.update(), age: () => car.ageOf(main()),
    absent: () => (car.nodes.length > 0 && !main() ? "this graph has no lidar" : null),
  });
  const canvas = h("canvas", { class: "fill-canvas", role: "img", "aria-label": "Lidar, seen from above, car looks up" });
  const foot = h("span", { class: "panel-note" });
  const zoom = (by: number) => {
    reach = REACHES_M[Math.min(REACHES_M.length - 1, Math.max(0, REACHES_M.indexOf(reach) + by))] ?? 2;
    remember("lidar.reach", String(reach));
    plan();
  };
  panel.tools.append(foot, h("div", { class: "group" },
    h("button", { type: "button", "aria-label": "Nearer", title: "Nearer", onclick: () => zoom(-1) }, "+"), h("button", { type: "button", "aria-label": "Farther", title: "Farther", onclick: () => zoom(1) }, "−")));
  panel.body.append(canvas);

  subscriptions.add(() => (panel.visible ? Object.values(keys()).filter((key): key is string => key !== null).map((key) => ({ key, max_hz: 15 })) : []));

  function plan(): void {
    if (planned) return;
    planned = true;
    requestAnimationFrame(() => {
      planned = false;
      draw();
    });
  }

  function sectorConfig(): Fields {
    const node = car.nodes.find((each) => each.outputs.some((output) => output.message_type === "carril/Sectors"));
    return node ? withDefaults(node.schema, node.config) : {};
  }
  function limits(): Map<string, number> {
    const found = list(sectorConfig().sectors).map(fields);
    return new Map(found.map((each) => [text(each.name) ?? "", number(each.limit_m) ?? 1]));
  }

  function draw(): void {
    const fitted = fitCanvas(canvas);
    if (!fitted || !panel.visible) return;
    const { context, width, height } = fitted;
    context.clearRect(0, 0, width, height);
    const [cx, cy] = [width / 2, height / 2];
    const scale = (Math.min(width, height) / 2 - 6) / reach;
    const at = (range: number, bearing: number) => [cx - Math.sin(bearing) * range * scale, cy - Math.cos(bearing) * range * scale] as const;
    rings(context, width, height, cx, cy, scale);
    const sectors = car.value<Sector[]>(keys().sectors) ?? [];
    const limitOf = limits();
    for (const sector of sectors) wedge(context, sector, limitOf.get(sector.name) ?? 1, cx, cy, scale);
    points(context, at);
    carShape(context, cx, cy, scale);
    nearest(context, sectors, at);
    const occupied = sectors.filter((sector) => sector.occupied).map((sector) => sector.name);
    setText(foot, sectors.length === 0 ? "" : occupied.length > 0 ? `▲ ${occupied.join(", ")}` : "✓ free");
    foot.className = `panel-note ${occupied.length > 0 ? "tone-bad" : "tone-good"}`;
  }

  function rings(context: CanvasRenderingContext2D, width: number, height: number, cx: number, cy: number, scale: number): void {
    const far = Math.hypot(width, height) / 2 / scale;
    const step = RINGS_M.find((each) => each * scale >= RING_GAP_PX) ?? 20;
    context.font = "10px system-ui, sans-serif";
    context.textAlign = "left";
    context.textBaseline = "bottom";
    for (let range = step; range < far; range += step) {
      context.beginPath();
      context.arc(cx, cy, range * scale, 0, 2 * Math.PI);
      context.strokeStyle = color("grid");
      context.lineWidth = 1;
      context.stroke();
      const x = cx + range * scale;
      if (x > width - 28) continue;
      context.fillStyle = color("faint");
      context.fillText(`${range} m`, x + 3, cy - 2);
    }
    context.beginPath();
    context.moveTo(cx, 0);
    context.lineTo(cx, height);
    context.moveTo(0, cy);
    context.lineTo(width, cy);
    context.stroke();
  }

  function wedge(context: CanvasRenderingContext2D, sector: Sector, limit_m: number, cx: number, cy: number, scale: number): void {
    context.beginPath();
    context.moveTo(cx, cy);
    // A canvas turns clockwise from the right, the body counter-clockwise from ahead, which is up.
    context.arc(cx, cy, limit_m * scale, -Math.PI / 2 - sector.to_rad, -Math.PI / 2 - sector.from_rad);
    context.closePath();
    const blind = sector.coverage <= 0;
    context.globalAlpha = sector.occupied ? 0.28 : 0.1;
    context.fillStyle = color(sector.occupied ? "bad" : blind ? "muted" : "accent");
    context.fill();
    context.globalAlpha = sector.occupied ? 1 : 0.5;
    context.strokeStyle = context.fillStyle;
    context.lineWidth = sector.occupied ? 2 : 1;
    context.setLineDash(blind ? [3, 3] : []);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  type At = (range: number, bearing: number) => readonly [number, number];

  function points(context: CanvasRenderingContext2D, at: At): void {
    const scan = car.value<Scan>(keys().scan);
    if (!scan) return;
    const mounting_rad = ((number(sectorConfig().mounting_deg) ?? 0) * Math.PI) / 180;
    context.fillStyle = color("ink");
    scan.ranges_m.forEach((range, index) => {
      if (range === null || range < scan.range_min_m || range > scan.range_max_m) return;
      const [x, y] = at(range, scan.angle_min_rad + index * scan.angle_increment_rad + mounting_rad);
      context.fillRect(x - 1.25, y - 1.25, 2.5, 2.5);
    });
  }

  function carShape(context: CanvasRenderingContext2D, cx: number, cy: number, scale: number): void {
    const size = Math.max(7, 0.13 * scale);
    context.beginPath();
    context.moveTo(cx, cy - size);
    context.lineTo(cx + size * 0.65, cy + size * 0.8);
    context.lineTo(cx, cy + size * 0.4);
    context.lineTo(cx - size * 0.65, cy + size * 0.8);
    context.closePath();
    context.fillStyle = color("accent");
    context.fill();
  }

  function nearest(context: CanvasRenderingContext2D, sectors: Sector[], at: At): void {
    const found = sectors.filter((sector) => sector.nearest_m !== null && sector.nearest_bearing_rad !== null).sort((a, b) => (a.nearest_m ?? 0) - (b.nearest_m ?? 0))[0];
    if (!found) return;
    const [x, y] = at(found.nearest_m ?? 0, found.nearest_bearing_rad ?? 0);
    const tone = color(found.occupied ? "bad" : "ink");
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    context.strokeStyle = tone;
    context.lineWidth = 2;
    context.stroke();
    const words = `${fixed(found.nearest_m, 2)} m`;
    context.font = "600 11px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = y > 24 ? "bottom" : "top";
    context.lineWidth = 3;
    context.strokeStyle = color("panel");
    const below = y > 24 ? y - 9 : y + 9;
    context.strokeText(words, x, below);
    context.fillStyle = tone;
    context.fillText(words, x, below);
  }

  car.on("sample", (sample) => {
    if (sample.message_type === "carril/LaserScan" || sample.message_type === "carril/Sectors") plan();
  });
  onTheme(plan);
  new ResizeObserver(plan).observe(canvas);
  return panel;
}
