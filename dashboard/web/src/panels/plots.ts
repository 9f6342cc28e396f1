// The last minute of what was asked of the car and what it did. Stands still under the pointer, so that it can be read.
import uPlot from "uplot";
import type { Car } from "../car";
import { h, setText } from "../dom";
import { fixed } from "../format";
import { History, STEP_MS } from "../history";
import { Panel } from "../panel";
import { eyeAge, firstKey, wheelCommandKey } from "../roles";
import { color, onTheme } from "../theme";
import type { Command, Telemetry, Vehicle } from "../values";

const LIMIT_MS = 1000;
const NAMES = ["steering_asked", "steering", "speed_asked", "speed", "age", "battery"] as const;
type Name = (typeof NAMES)[number];
interface Series { name: Name; label: string; tone: "series-a" | "series-b"; dash?: number[] }
interface Chart { title: string; unit: string; digits: number; least: number; series: Series[] }

const asked = (name: Name): Series => ({ name, label: "asked", tone: "series-b", dash: [4, 3] });
const is = (name: Name, label: string): Series => ({ name, label, tone: "series-a" });
const CHARTS: Chart[] = [
  { title: "Steering", unit: "°", digits: 1, least: 4, series: [asked("steering_asked"), is("steering", "told the servo")] },
  { title: "Speed", unit: "m/s", digits: 2, least: 0.2, series: [asked("speed_asked"), is("speed", "measured")] },
  { title: "Eye → wheel", unit: "ms", digits: 0, least: 10, series: [is("age", "age")] },
  { title: "Battery", unit: "V", digits: 2, least: 0.2, series: [is("battery", "measured")] },
];

/** So many that no two ticks read the same. */
const decimals = (step: number): number => [0, 1, 2].find((digits) => Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) < 1e-6) ?? 3;

/** Both ends of an axis: at least `least` apart, so that noise is not blown up to mountains. */
function ends(_: uPlot, low: number | null, high: number | null, least: number): uPlot.Range.MinMax {
  if (low === null || high === null) return [0, least];
  const room = Math.max((high - low) * 0.1, (least - (high - low)) / 2, 0);
  return [low - room, high + room];
}

export function plotsPanel(car: Car): Panel {
  const keys = () => ({ command: wheelCommandKey(car.nodes), telemetry: firstKey(car.nodes, "carril/WheelTelemetry"), vehicle: firstKey(car.nodes, "carril/VehicleState") });
  const history = new History<Name>(NAMES);
  let hovered = false;
  let plots: { chart: Chart; plot: uPlot; box: HTMLElement; values: HTMLElement[] }[] = [];

  const panel = new Panel(car, {
    id: "plots", title: "Last minute", limit_ms: LIMIT_MS, age: () => car.ageOf(keys().telemetry) ?? car.ageOf(keys().command),
    absent: () => (car.nodes.length > 0 && !keys().command && !keys().telemetry ? "this graph commands nothing" : null),
  });
  const hold = h("span", { class: "panel-note" });
  panel.tools.append(hold);
  const charts = h("div", { class: "charts", onpointerenter: () => setHovered(true), onpointerleave: () => setHovered(false) });
  panel.body.append(charts);

  function setHovered(next: boolean): void {
    hovered = next;
    setText(hold, next ? "held" : "");
    if (!next) show();
  }

  function build(): void {
    for (const { plot } of plots) plot.destroy();
    charts.replaceChildren();
    plots = CHARTS.map((chart, at) => {
      const values = chart.series.map(() => h("span", { class: "chart-value" }, "–"));
      const head = h("div", { class: "chart-head" }, h("span", { class: "chart-title" }, chart.title, h("span", { class: "unit" }, chart.unit)),
        ...chart.series.map((series, index) => h("span", { class: `chart-key key-${series.tone}${chart.series.length > 1 ? "" : " is-alone"}` }, chart.series.length > 1 ? `${series.label} ` : "", values[index])));
      const box = h("div", { class: "chart-box" });
      charts.append(h("div", { class: "chart" }, head, box));
      return { chart, plot: new uPlot(options(chart, at === CHARTS.length - 1, values), [[]], box), box, values };
    });
    resize();
    show();
  }

  function options(chart: Chart, last: boolean, values: HTMLElement[]): uPlot.Options {
    const axis = { stroke: color("muted"), font: "10px system-ui, sans-serif", grid: { stroke: color("grid"), width: 1 }, ticks: { show: false } };
    return {
      width: 300, height: 60, legend: { show: false }, padding: [6, 14, last ? 0 : 4, 0],
      cursor: { sync: { key: "last-minute" }, drag: { x: false, y: false }, points: { size: 5 }, y: false },
      scales: { x: { time: false, range: [-60, 0] }, y: { range: (plot, low, high) => ends(plot, low, high, chart.least) } },
      axes: [
        { ...axis, show: true, size: last ? 18 : 0, gap: 2, splits: () => [-60, -45, -30, -15, 0], values: (_, splits) => (last ? splits.map((at) => (at === 0 ? "now" : at === -60 ? "" : `−${-at} s`)) : splits.map(() => "")) },
        { ...axis, size: 38, gap: 3, space: 18, values: (_, splits, _axis, _space, step) => splits.map((each) => fixed(each, decimals(step))) },
      ],
      series: [{}, ...chart.series.map((series): uPlot.Series => ({ stroke: color(series.tone), width: 1.5, spanGaps: false, points: { show: false }, ...(series.dash ? { dash: series.dash } : {}) }))],
      hooks: { setCursor: [(plot) => showValues(plot, chart, values)] },
    };
  }

  function showValues(plot: uPlot, chart: Chart, values: HTMLElement[]): void {
    const at = plot.cursor.idx ?? (plot.data[0].length > 0 ? plot.data[0].length - 1 : null);
    chart.series.forEach((_, index) => {
      const element = values[index];
      if (element) setText(element, fixed(at === null ? null : plot.data[index + 1]?.[at], chart.digits));
    });
  }

  function show(): void {
    if (hovered || !panel.visible) return;
    for (const { chart, plot, values } of plots) {
      plot.setData(history.table(...chart.series.map((series) => series.name)) as uPlot.AlignedData);
      showValues(plot, chart, values);
    }
  }

  function resize(): void {
    for (const { plot, box } of plots) {
      const [width, height] = [box.clientWidth, box.clientHeight];
      if (width > 0 && height > 0 && (plot.width !== width || plot.height !== height)) plot.setSize({ width, height });
    }
  }

  function sample(): void {
    const now = car.now();
    if (now === null || !car.connection.connected || document.hidden) return;
    const found = keys();
    const fresh = <T,>(key: string | null): T | null => ((car.ageOf(key) ?? Infinity) <= LIMIT_MS ? car.value<T>(key) : null);
    const [command, is] = [fresh<Command>(found.command), fresh<Telemetry>(found.telemetry) ?? fresh<Vehicle>(found.vehicle)];
    const stamp = command ? car.sample(found.command) : null;
    const deg = (rad: number | undefined) => (rad === undefined ? null : (rad * 180) / Math.PI);
    history.push(now, {
      steering_asked: deg(command?.steering_rad), steering: deg(is?.steering_rad), speed_asked: command?.speed_m_s ?? null, speed: is?.speed_m_s ?? null,
      age: eyeAge(car.nodes, stamp), battery: is && "battery_v" in is ? is.battery_v : null,
    });
    show();
  }

  car.on("hello", () => history.clear());
  onTheme(build);
  new ResizeObserver(resize).observe(charts);
  build();
  window.setInterval(sample, STEP_MS);
  return panel;
}
