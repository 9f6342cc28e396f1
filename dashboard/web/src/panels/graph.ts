// The nodes of the graph from left to right, with what flows between them. A node opens its details.
import type { Car } from "../car";
import { h, setText, svg } from "../dom";
import { DASH, fixed, hertz } from "../format";
import { bandwidthOf, flowOf, lookOf, nodeOf } from "../flow";
import { edgeName, layOut, type Layout } from "../layout";
import { Panel } from "../panel";
import type { GraphNode, Percentiles } from "../protocol";

const METRICS = { width: 140, height: 64, gapX: 84, gapY: 20 };
const MARGIN = 10;
/** Loops are drawn below everything, each a little lower than the last. */
const LOOP_DROP = 20;
/** Smaller, nobody could read it: then it scrolls instead. */
const FIGURE_HOLDS_MS = 2500;
const SMALLEST_SCALE = 0.72;
const LARGEST_SCALE = 1.25;
const LONGEST_NAME = 14;
const SENSOR_TYPES = new Set(["carril/Image", "carril/LaserScan"]);

/** Milliseconds with two digits that count. */
const brief = (us: number): string => fixed(us / 1000, us < 995 ? 2 : us < 9950 ? 1 : 0);
/** Median and 99th percentile of the latency; of the step, where nothing triggers it. */
const pair = (value: Percentiles | null): string => (value ? ` · ${brief(value.p50)}/${brief(value.p99)} ms` : "");

const nodeBefore = (key: string): string => key.slice(0, key.lastIndexOf("/"));

interface NodeParts { group: SVGGElement; mark: SVGTextElement; pace: SVGTextElement; age: SVGTextElement }
interface EdgeParts { key: string; rate: SVGTextElement; bytes: SVGTextElement }

export function graphPanel(car: Car, open: (node: string) => void): { panel: Panel; select(node: string | null): void } {
  const panel = new Panel(car, {
    id: "graph", title: "Graph", limit_ms: 3000, age: () => car.status && car.age(car.status.time_ms, car.statusReceived_ms), absent: () => (car.connection.connected && car.nodes.length === 0 ? "the graph has no nodes" : null),
  });
  const note = h("span", { class: "panel-note" });
  const expand = h("button", { type: "button", class: "toggle graph-expand", "aria-pressed": "false", "aria-label": "Large graph", title: "Large, over camera and lidar", onclick: () => expand.setAttribute("aria-pressed", String(panel.root.classList.toggle("is-large"))) }, "⤢");
  panel.tools.append(note, expand);
  const scroller = h("div", { class: "graph-scroll" });
  panel.body.append(scroller);
  let parts = new Map<string, NodeParts>();
  let edges: EdgeParts[] = [];
  let drawing: SVGSVGElement | null = null;
  let size = { width: 1, height: 1 };
  let shape = "";
  let selected: string | null = null;

  function build(nodes: GraphNode[]): void {
    const nextShape = JSON.stringify(nodes.map((node) => [node.name, node.operator, node.inputs.map((input) => [input.from, input.port])]));
    if (nextShape === shape) return;
    shape = nextShape;
    const layout = layOut(nodes.map((node) => ({
      name: node.name, from: node.inputs.flatMap((input) => (input.from ? [nodeBefore(input.from)] : [])), sensor: node.outputs.some((output) => SENSOR_TYPES.has(output.message_type)),
    })), METRICS);
    parts = new Map();
    edges = [];
    const [lines, labels, boxes] = [svg("g"), svg("g"), svg("g")];
    const labelled = new Set<string>();
    let loops = 0;
    for (const node of nodes) {
      for (const input of node.inputs) {
        if (!input.from || !layout.places.has(nodeBefore(input.from))) continue;
        const loop = layout.back.has(edgeName(nodeBefore(input.from), node.name)) ? ++loops : 0;
        const { path, x, y } = route(layout, nodeBefore(input.from), node.name, portShift(node, input.port), outShift(nodes, input.from), loop);
        lines.append(svg("path", { d: path, class: loop ? "edge edge-loop" : "edge", "marker-end": "url(#arrow)" }, svg("title", {}, `${input.from} → ${node.name}/${input.port}`)));
        if (labelled.has(input.from)) continue; // one output is one flow, whoever reads it
        labelled.add(input.from);
        const [rate, bytes] = [svg("text", { class: "edge-label", x, y: y - 4 }), svg("text", { class: "edge-label", x, y: y + 11 })];
        edges.push({ key: input.from, rate, bytes });
        labels.append(rate, bytes);
      }
      boxes.append(box(node, layout));
    }
    size = { width: layout.width + 2 * MARGIN, height: layout.height + 2 * MARGIN + (loops > 0 ? LOOP_DROP + 8 * loops : 0) };
    const arrow = svg("marker", { id: "arrow", viewBox: "0 0 8 8", refX: 7, refY: 4, markerWidth: 7, markerHeight: 7, orient: "auto-start-reverse" }, svg("path", { d: "M0 0 8 4 0 8z", class: "arrow" }));
    drawing = svg("svg", { class: "graph", viewBox: `0 0 ${size.width} ${size.height}`, role: "group", "aria-label": "Nodes of the graph" }, svg("defs", {}, arrow), lines, boxes, labels);
    scroller.replaceChildren(drawing);
    fit();
    refresh();
  }

  /** Several edges of one node do not lie on each other. */
  const spread = (index: number, count: number): number => (count <= 1 ? 0 : (index - (count - 1) / 2) * Math.min(16, (METRICS.height - 24) / (count - 1)));
  function portShift(node: GraphNode, port: string): number {
    const wired = node.inputs.filter((input) => input.from);
    return spread(wired.findIndex((input) => input.port === port), wired.length);
  }
  function outShift(nodes: GraphNode[], key: string): number {
    const read = (nodes.find((node) => node.name === nodeBefore(key))?.outputs ?? []).map((output) => `${nodeBefore(key)}/${output.port}`).filter((each) => nodes.some((node) => node.inputs.some((input) => input.from === each)));
    return spread(read.indexOf(key), read.length);
  }

  function route(layout: Layout, from: string, to: string, inShift: number, out: number, loop: number): { path: string; x: number; y: number } {
    const [start, end] = [layout.places.get(from), layout.places.get(to)];
    if (!start || !end) return { path: "", x: 0, y: 0 };
    if (loop > 0) {
      const drop = layout.height + MARGIN + LOOP_DROP - 6 + 8 * (loop - 1);
      const [x1, x2] = [start.x + MARGIN + METRICS.width * 0.5, end.x + MARGIN + METRICS.width * 0.5];
      const [y1, y2] = [start.y + MARGIN + METRICS.height, end.y + MARGIN + METRICS.height];
      const bend = x1 > x2 ? 8 : -8;
      return { path: `M${x1} ${y1} V${drop - 8} Q${x1} ${drop} ${x1 - bend} ${drop} H${x2 + bend} Q${x2} ${drop} ${x2} ${drop - 8} V${y2 + 1}`, x: (x1 + x2) / 2, y: drop - 19 };
    }
    const [x1, y1] = [start.x + MARGIN + METRICS.width, start.y + MARGIN + METRICS.height / 2 + out];
    const [x2, y2] = [end.x + MARGIN - 1, end.y + MARGIN + METRICS.height / 2 + inShift];
    const ways = (layout.ways.get(edgeName(from, to)) ?? []).map((way) => ({ x: way.x + MARGIN, y: way.y + MARGIN + out }));
    let [path, x, y] = [`M${x1} ${y1}`, x1, y1];
    const bendTo = (nextX: number, nextY: number) => {
      const middle = (x + nextX) / 2;
      path += ` C${middle} ${y} ${middle} ${nextY} ${nextX} ${nextY}`;
      [x, y] = [nextX, nextY];
    };
    for (const way of ways) {
      bendTo(way.x, way.y);
      x += METRICS.width;
      path += ` H${x}`;
    }
    bendTo(x2, y2);
    const [nextX, nextY] = [ways[0]?.x ?? x2, ways[0]?.y ?? y2];
    return { path, x: (x1 + nextX) / 2, y: (y1 + nextY) / 2 };
  }

  function box(node: GraphNode, layout: Layout): SVGGElement {
    const place = layout.places.get(node.name) ?? { x: 0, y: 0 };
    const line = (y: number, className: string, x = 12) => svg("text", { x, y, class: className });
    const name = line(18, "node-name", 27);
    name.textContent = node.name.length > LONGEST_NAME ? `${node.name.slice(0, LONGEST_NAME - 1)}…` : node.name;
    const found: NodeParts = { mark: line(18, "node-mark"), pace: line(38, "node-small"), age: line(54, "node-small"), group: svg("g") };
    found.group = svg("g", {
      class: "node", transform: `translate(${place.x + MARGIN} ${place.y + MARGIN})`, tabindex: 0, role: "button", "data-node": node.name, onclick: () => open(node.name),
      onkeydown: (event: KeyboardEvent) => event.key === "Enter" && open(node.name),
    }, svg("rect", { class: "node-box", width: METRICS.width, height: METRICS.height, rx: 6 }), svg("rect", { class: "node-strip", width: 4, height: METRICS.height - 12, y: 6, x: 0, rx: 2 }), found.mark, name, found.pace, found.age, svg("title", {}, `${node.name}: ${node.operator}\nrate; latency from sample to end of step (step where none triggers), p50 and p99; age of the exposure; samples dropped, lost, stale or refused`));
    parts.set(node.name, found);
    return found.group;
  }

  function refresh(): void {
    let running = 0;
    for (const [name, found] of parts) {
      const status = nodeOf(car.status, name);
      const look = lookOf(status?.state ?? null);
      if (look.tone === "good") running += 1;
      found.group.setAttribute("class", `node tone-${look.tone}${name === selected ? " is-open" : ""}`);
      found.group.setAttribute("aria-label", `${name}, ${look.words}`);
      setText(found.mark, look.mark);
      setText(found.pace, status ? `${hertz(status.rate_hz)}${pair(status.latency_us ?? status.step_us)}` : "");
      const drops = status?.inputs.reduce((sum, input) => sum + input.dropped + input.lost + input.stale + input.refused, 0) ?? 0;
      setText(found.age, !status ? look.words : look.tone === "good" ? [status.age_ms ? `age ${fixed(status.age_ms.p50, 0)} ms` : null, `drops ${drops}`].filter(Boolean).join(" · ") : look.words);
    }
    for (const edge of edges) {
      const flow = flowOf(car.statusBefore, car.status, edge.key);
      // Nothing newer was measured between two statuses: the last figure holds for a while.
      const measured_ms = nodeOf(car.status, nodeBefore(edge.key))?.measured_ms ?? 0;
      if (!flow && car.status && car.status.time_ms - measured_ms < FIGURE_HOLDS_MS && edge.rate.textContent) continue;
      setText(edge.rate, flow ? hertz(flow.rate_hz) : DASH);
      setText(edge.bytes, flow ? bandwidthOf(flow) : "");
    }
    const link = car.status?.link;
    setText(note, car.status ? `${running} of ${parts.size} run · up ${Math.floor(car.status.uptime_s / 60)} min ${Math.floor(car.status.uptime_s % 60)} s${link ? ` · ${link.viewers} ${link.viewers === 1 ? "viewer" : "viewers"}` : ""}${link?.driver ? ` · ${link.driver} drives` : ""}` : "");
  }

  function fit(): void {
    if (!drawing || scroller.clientWidth === 0) return;
    const tall = scroller.clientHeight > 60 ? scroller.clientHeight : Infinity;
    const scale = Math.max(SMALLEST_SCALE, Math.min(LARGEST_SCALE, scroller.clientWidth / size.width, tall / size.height));
    drawing.setAttribute("width", String(Math.floor(size.width * scale)));
    drawing.setAttribute("height", String(Math.floor(size.height * scale)));
  }

  car.on("graph", build);
  car.on("status", refresh);
  new ResizeObserver(fit).observe(scroller);
  const select = (node: string | null) => {
    selected = node;
    refresh();
  };
  return { panel, select };
}
