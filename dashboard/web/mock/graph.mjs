// The graph of dataflow.yaml as the server would tell it. Schemas: `carril operators --json`, stored in operators.json.
import { readFileSync } from "node:fs";

const kinds = JSON.parse(readFileSync(new URL("operators.json", import.meta.url), "utf8"));

const nodes = [
  ["world", "sim-world", { pins: "mcu/pins" }, { track: "tracks/oval.yaml", seed: 1 }],
  ["lane", "lane-detector", { image: "world/camera" }, { threshold: 190, row_far: 0.75, row_near: 0.85 }],
  ["sectors", "lidar-sectors", { scan: "world/scan" }, {}],
  ["decision", "decision", { lane: "lane/lane", sectors: "sectors/sectors" }, { auto_start: true }],
  ["actuator", "actuator", { command: "decision/command" }, {}],
  ["bridge", "mcu-link", { command: "actuator/command" }, { port: "sim:mcu", lease_ms: 200 }],
  ["mcu", "sim-mcu", { sensors: "world/sensors" }, { line: "mcu" }],
];

const typeOf = (type) => type.split(" ")[0];

function defaultsOf(schema) {
  return Object.fromEntries(Object.entries(schema.properties ?? {}).filter(([, each]) => "default" in each).map(([name, each]) => [name, each.default]));
}

/** The other operators that have what is wired. */
function fitting(operator, edges) {
  const ports = (kind) => JSON.stringify([kind.inputs.filter((input) => edges[input.name]).map((input) => [input.name, input.type]), kind.outputs.map((output) => [output.name, output.type])]);
  const own = kinds.find((each) => each.name === operator);
  return kinds.filter((each) => each.name !== operator && ports(each) === ports(own)).map((each) => each.name);
}

export function makeGraph() {
  return nodes.map(([name, operator, edges, config]) => {
    const kind = kinds.find((each) => each.name === operator);
    const inputs = kind.inputs
      .filter((input) => edges[input.name] || input.external)
      .map((input) => ({ port: input.name, message_type: typeOf(input.type), from: edges[input.name] ?? null, external: input.external }));
    return {
      name, operator, exec: null, process: name, version: 1, fitting: fitting(operator, edges),
      inputs,
      outputs: kind.outputs.filter((output) => !(name === "world" && output.name === "lane"))
        .map((output) => ({ port: output.name, message_type: typeOf(output.type), on_demand: output.on_demand })),
      config: { ...structuredClone(defaultsOf(kind.config)), ...config }, schema: kind.config,
    };
  });
}

const resolve = (schema, root) => (schema?.$ref ? { ...root.$defs[schema.$ref.split("/").at(-1)], ...schema, $ref: undefined } : schema);

/** Why a value is refused, in the manner of carril; null: it is allowed. */
export function refusal(node, path, value) {
  let at = node.schema;
  for (const part of path.split(".")) at = resolve(at?.properties?.[part], node.schema);
  if (!at) return `node \`${node.name}\`: there is no \`${path}\``;
  const range = at.oneOf?.find((each) => each.type === "number") ?? at;
  if (typeof value !== "number") return null;
  if (range.minimum !== undefined && value < range.minimum) return `node \`${node.name}\`: \`${path}\`: got ${value}, allowed is ${range.minimum} to ${range.maximum}`;
  if (range.maximum !== undefined && value > range.maximum) return `node \`${node.name}\`: \`${path}\`: got ${value}, allowed is at most ${range.maximum}`;
  if (path === "row_far" && value >= node.config.row_near) return `node \`${node.name}\`: \`row_far\`: got ${value}, must be above \`row_near\` (${node.config.row_near})`;
  return null;
}

export function assign(config, path, value) {
  const parts = path.split(".");
  const last = parts.pop();
  parts.reduce((at, part) => (at[part] ??= {}), config)[last] = value;
}
