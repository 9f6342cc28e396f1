// Finds in a graph which output plays which part. By type of message, so that graphs of any names work.
import type { GraphNode } from "./protocol";

export interface LaneSource { node: GraphNode; laneKey: string; debugKey: string | null }

const outputsOf = (nodes: GraphNode[], type: string): string[] =>
  nodes.flatMap((node) => node.outputs.filter((output) => output.message_type === type).map((output) => `${node.name}/${output.port}`));

export const imageKeys = (nodes: GraphNode[]): string[] => outputsOf(nodes, "carril/Image");
export const firstKey = (nodes: GraphNode[], type: string): string | null => outputsOf(nodes, type)[0] ?? null;

/** The command nearest the wheel: what the link to the microcontroller reads; else the last of the graph. */
export function wheelCommandKey(nodes: GraphNode[]): string | null {
  const link = nodes.find((node) => node.operator === "mcu-link");
  const read = link?.inputs.find((input) => input.message_type === "carril/Command" && input.from);
  return read?.from ?? outputsOf(nodes, "carril/Command").at(-1) ?? null;
}

/** From the exposure of the camera to the publication of what derives from it, ms. Slower sensors that had a say in it do not count. */
export function eyeAge(nodes: GraphNode[], sample: { time_ms: number; origin_ms: number | null; origins: ReadonlyMap<string, number> } | null): number | null {
  if (!sample) return null;
  const exposures = imageKeys(nodes).flatMap((key) => sample.origins.get(key) ?? []);
  const exposed_ms = exposures.length > 0 ? Math.min(...exposures) : sample.origin_ms;
  return exposed_ms === null ? null : sample.time_ms - exposed_ms;
}

/** The detector whose estimates lie in the pixels of that image. */
export function laneSourceOf(nodes: GraphNode[], imageKey: string | null): LaneSource | null {
  for (const node of nodes) {
    const reads = imageKey !== null && (node.inputs.some((input) => input.from === imageKey) || imageKey.startsWith(`${node.name}/`));
    const lane = node.outputs.find((output) => output.message_type === "carril/LaneEstimate");
    if (!reads || !lane || !node.inputs.some((input) => input.message_type === "carril/Image")) continue;
    const debug = node.outputs.find((output) => output.message_type === "carril/Image");
    return { node, laneKey: `${node.name}/${lane.port}`, debugKey: debug ? `${node.name}/${debug.port}` : null };
  }
  return null;
}
