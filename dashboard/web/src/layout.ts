// Places the nodes of a graph from left to right, by layers (after Sugiyama): edges that close a loop are set aside, the longest path
// gives the layer, the mean of the neighbours gives the order. For tens of nodes, not thousands.

export interface LayoutNode { name: string; from: string[]; sensor: boolean }
export interface Place { layer: number; x: number; y: number }
/** Where an edge that skips layers passes through them: left end of the free lane in each, its middle line. */
export type Way = { x: number; y: number }[];
export interface Layout { places: Map<string, Place>; ways: Map<string, Way>; back: Set<string>; width: number; height: number; layers: number }
export interface Metrics { width: number; height: number; gapX: number; gapY: number }

export const edgeName = (from: string, to: string): string => `${from}\n${to}`;

/** Loops are cut where they lead back to what came first: to the sensors, since data flows from them. */
function backEdges(nodes: LayoutNode[], followers: Map<string, string[]>): Set<string> {
  const [back, state] = [new Set<string>(), new Map<string, "open" | "done">()];
  const visit = (name: string): void => {
    state.set(name, "open");
    for (const next of followers.get(name) ?? []) {
      const seen = state.get(next);
      if (seen === "open") back.add(edgeName(name, next));
      else if (seen === undefined) visit(next);
    }
    state.set(name, "done");
  };
  const roots = [...nodes.filter((node) => node.from.length === 0), ...nodes.filter((node) => node.sensor), ...nodes];
  for (const node of roots) if (!state.has(node.name)) visit(node.name);
  return back;
}

function layersOf(nodes: LayoutNode[], back: Set<string>): Map<string, number> {
  const [known, byName] = [new Map<string, number>(), new Map(nodes.map((node) => [node.name, node]))];
  const layerOf = (name: string): number => {
    const found = known.get(name);
    if (found !== undefined) return found;
    const before = (byName.get(name)?.from ?? []).filter((from) => byName.has(from) && !back.has(edgeName(from, name)));
    const layer = before.reduce((deepest, from) => Math.max(deepest, layerOf(from) + 1), 0);
    known.set(name, layer);
    return layer;
  };
  for (const node of nodes) layerOf(node.name);
  return known;
}

/** An edge that skips layers gets a seat in each of them, so that no node sits on it. */
interface Seat { name: string; real: boolean; layer: number; before: Seat[]; after: Seat[]; y: number }

function seatsOf(nodes: LayoutNode[], layer: Map<string, number>, back: Set<string>): { rows: Seat[][]; passes: Map<string, Seat[]> } {
  const rows: Seat[][] = [];
  const passes = new Map<string, Seat[]>();
  const seatIn = (at: number, name: string, real: boolean): Seat => {
    const seat: Seat = { name, real, layer: at, before: [], after: [], y: 0 };
    (rows[at] ??= []).push(seat);
    return seat;
  };
  for (let at = 0; at <= Math.max(0, ...layer.values()); at++) rows[at] ??= [];
  const seats = new Map(nodes.map((node) => [node.name, seatIn(layer.get(node.name) ?? 0, node.name, true)]));
  for (const node of nodes) {
    for (const from of new Set(node.from)) {
      const [start, end] = [seats.get(from), seats.get(node.name)];
      if (!start || !end || from === node.name || back.has(edgeName(from, node.name))) continue;
      let last = start;
      const passed: Seat[] = [];
      for (let at = (layer.get(from) ?? 0) + 1; at < (layer.get(node.name) ?? 0); at++) {
        const seat = seatIn(at, "", false);
        last.after.push(seat);
        seat.before.push(last);
        last = seat;
        passed.push(seat);
      }
      passes.set(edgeName(from, node.name), passed);
      last.after.push(end);
      end.before.push(last);
    }
  }
  return { rows, passes };
}

const mean = (seats: Seat[]): number | null => (seats.length === 0 ? null : seats.reduce((sum, seat) => sum + seat.y, 0) / seats.length);

function settle(rows: Seat[][], metrics: Metrics): void {
  const space = (seat: Seat) => (seat.real ? metrics.height + metrics.gapY : metrics.gapY * 2);
  const stack = (row: Seat[], wished: (seat: Seat) => number): void => {
    const wishes = new Map(row.map((seat) => [seat, wished(seat)]));
    row.sort((a, b) => (wishes.get(a) ?? 0) - (wishes.get(b) ?? 0));
    let at = -Infinity;
    for (const seat of row) {
      seat.y = Math.max(wishes.get(seat) ?? 0, at + space(seat) / 2);
      at = seat.y + space(seat) / 2;
    }
    const drift = row.reduce((sum, seat) => sum + seat.y - (wishes.get(seat) ?? 0), 0) / Math.max(1, row.length);
    for (const seat of row) seat.y -= drift;
  };
  for (const row of rows) row.forEach((seat, index) => { seat.y = (index - (row.length - 1) / 2) * (metrics.height + metrics.gapY); });
  for (let sweep = 0; sweep < 6; sweep++) {
    for (const row of rows) stack(row, (seat) => mean(seat.before) ?? seat.y);
    for (const row of [...rows].reverse()) stack(row, (seat) => mean([...seat.after, ...seat.before]) ?? seat.y);
  }
}

export function layOut(nodes: LayoutNode[], metrics: Metrics): Layout {
  const followers = new Map<string, string[]>();
  for (const node of nodes) for (const from of node.from) followers.set(from, [...(followers.get(from) ?? []), node.name]);
  const back = backEdges(nodes, followers);
  const layer = layersOf(nodes, back);
  const { rows, passes } = seatsOf(nodes, layer, back);
  settle(rows, metrics);
  const all = rows.flat();
  const top = Math.min(...all.map((seat) => seat.y), 0);
  const bottom = Math.max(...all.map((seat) => seat.y), 0);
  const places = new Map<string, Place>();
  rows.forEach((row, at) => {
    for (const seat of row) if (seat.real) places.set(seat.name, { layer: at, x: at * (metrics.width + metrics.gapX), y: seat.y - top });
  });
  const ways = new Map([...passes].map(([name, seats]) => [name, seats.map((seat) => ({ x: seat.layer * (metrics.width + metrics.gapX), y: seat.y - top + metrics.height / 2 }))]));
  return { places, ways, back, layers: rows.length, width: rows.length * (metrics.width + metrics.gapX) - metrics.gapX, height: bottom - top + metrics.height };
}
