// From an operator's JSON Schema and its configuration to the fields of a form. Pure. The operator's own check has the last word:
// what this file does not understand becomes a line of JSON text, never a guess.
import { fields, isFields, list, number, text, type Fields } from "./read";

export type FieldKind = "number" | "integer" | "boolean" | "choice" | "json";

export interface Field {
  /** As `carril set` has it: `camera.noise_grey`. */
  path: string;
  kind: FieldKind;
  /** In force; undefined: neither configured nor a default. */
  value: unknown;
  fallback: unknown;
  minimum: number | null;
  exclusiveMinimum: number | null;
  maximum: number | null;
  /** Words besides numbers (`otsu`) or instead of them (`bright`). */
  words: string[];
  nullable: boolean;
  unit: string;
  help: string;
}

const DEEPEST = 8;

/** Follows references; what stands beside a reference goes before what it refers to. */
function resolve(schema: Fields, root: Fields): Fields {
  let at = schema;
  for (let depth = 0; depth < DEEPEST && typeof at.$ref === "string"; depth++) {
    const { $ref, ...beside } = at;
    const target = String($ref).replace(/^#\//, "").split("/").reduce<unknown>((from, part) => fields(from)[part], root);
    at = { ...fields(target), ...beside };
  }
  return at;
}

const typesOf = (schema: Fields): string[] => (Array.isArray(schema.type) ? schema.type.filter((each) => typeof each === "string") : text(schema.type) ? [String(schema.type)] : []);

interface Shape { numeric: Fields | null; integer: boolean; boolean: boolean; words: string[]; nullable: boolean; other: boolean; object: Fields | null }

function merge(into: Shape, from: Shape): void {
  into.numeric ??= from.numeric;
  into.object ??= from.object;
  into.integer ||= from.integer;
  into.boolean ||= from.boolean;
  into.nullable ||= from.nullable;
  into.other ||= from.other;
  into.words.push(...from.words.filter((word) => !into.words.includes(word)));
}

function shapeOf(schema: Fields, root: Fields, depth = 0): Shape {
  const shape: Shape = { numeric: null, integer: false, boolean: false, words: [], nullable: false, other: false, object: null };
  const at = resolve(schema, root);
  const choices = [...list(at.oneOf), ...list(at.anyOf)].filter(isFields);
  if (choices.length > 0 && depth < DEEPEST) {
    for (const choice of choices) merge(shape, shapeOf(choice, root, depth + 1));
    return shape;
  }
  if (typeof at.const === "string") shape.words.push(at.const);
  else if (Array.isArray(at.enum)) shape.words.push(...at.enum.filter((each): each is string => typeof each === "string"));
  else {
    for (const type of typesOf(at)) {
      if (type === "null") shape.nullable = true;
      else if (type === "boolean") shape.boolean = true;
      else if (type === "number" || type === "integer") [shape.numeric, shape.integer] = [at, type === "integer"];
      else if (type === "object" && isFields(at.properties)) shape.object = at;
      else shape.other = true;
    }
    if (typesOf(at).length === 0) shape.other = true;
  }
  return shape;
}

function kindOf(shape: Shape): FieldKind {
  if (shape.other || shape.object) return "json";
  if (shape.numeric) return shape.integer ? "integer" : "number";
  if (shape.boolean) return "boolean";
  return shape.words.length > 0 ? "choice" : "json";
}

export function fieldsOf(schema: Fields, config: Fields): Field[] {
  const found: Field[] = [];
  walk(schema, config, "", 0);
  return found;

  function walk(at: Fields, values: Fields, prefix: string, depth: number): void {
    for (const [name, raw] of Object.entries(fields(at.properties))) {
      if (!isFields(raw)) continue;
      const property = resolve(raw, schema);
      const shape = shapeOf(property, schema);
      const path = prefix + name;
      const value = name in values ? values[name] : property.default;
      if (shape.object && shape.words.length === 0 && isFields(value) && depth < DEEPEST) {
        walk(shape.object, value, `${path}.`, depth + 1);
        continue;
      }
      const range = shape.numeric ?? {};
      found.push({
        path, kind: kindOf(shape), value, fallback: property.default,
        minimum: number(range.minimum), exclusiveMinimum: number(range.exclusiveMinimum), maximum: number(range.maximum),
        words: shape.words, nullable: shape.nullable, unit: text(property.unit) ?? text(range.unit) ?? "", help: text(property.description) ?? "",
      });
    }
  }
}

/** The configuration in force, also where the server tells only what was configured. */
export function withDefaults(schema: Fields, config: Fields): Fields {
  const properties = Object.entries(fields(schema.properties)).filter(([, property]) => isFields(property) && "default" in property);
  return { ...Object.fromEntries(properties.map(([name, property]) => [name, fields(property).default])), ...config };
}

/** Ends and step of a slider; null: without two ends there is none. */
export interface SliderRange { min: number; max: number; step: number }

const niceStep = (span: number): number => {
  const raw = span / 200;
  const power = 10 ** Math.floor(Math.log10(raw));
  const factor = [1, 2, 5, 10].find((each) => each * power >= raw * 0.999) ?? 10;
  return factor * power;
};

/**
 * A limit such as 50 m/s² for a value of 1.5 would leave a slider with nothing to hold: then it spans the neighbourhood of value and
 * default, and the field of numbers beside it takes the rest.
 */
export function sliderOf(field: Field): SliderRange | null {
  const low = field.minimum ?? field.exclusiveMinimum;
  if ((field.kind !== "number" && field.kind !== "integer") || low === null || field.maximum === null || field.maximum <= low) return null;
  const typical = Math.max(Math.abs(number(field.value) ?? 0), Math.abs(number(field.fallback) ?? 0));
  const reach = typical * 4;
  const narrow = typical > 0 && field.maximum > reach * 1.5;
  let [min, max] = [low, narrow ? reach : field.maximum];
  if (min < -reach && narrow) min = -reach;
  let step = niceStep(max - min);
  if (field.kind === "integer") [min, max, step] = [Math.floor(min), Math.ceil(max), Math.max(1, Math.round(step))];
  if (field.kind === "number") [min, max] = [Math.ceil(min / step - 1e-9) * step, Math.ceil(max / step - 1e-9) * step]; // round values, so that 1 can be had
  max = Math.min(max, field.maximum);
  if (field.exclusiveMinimum !== null && min <= field.exclusiveMinimum) min = field.exclusiveMinimum + step;
  return { min: tidy(min), max: tidy(max), step: tidy(step) };
}

/** Without the dust of binary fractions. */
export const tidy = (value: number): number => Number(value.toPrecision(10));

/** `0 to 255`, `> 0 to 1`, `0 to 255 or otsu` */
export function allowed(field: Field): string {
  const from = field.exclusiveMinimum !== null ? `> ${field.exclusiveMinimum}` : field.minimum !== null ? `${field.minimum}` : null;
  const range = from !== null && field.maximum !== null ? `${from} to ${field.maximum}`
    : from !== null ? (field.exclusiveMinimum !== null ? from : `>= ${from}`) : field.maximum !== null ? `<= ${field.maximum}` : null;
  return [range, ...field.words].filter((each) => each !== null).join(" or ");
}

/** What a person typed: JSON where it is JSON, else a word. */
export function typed(input: string): unknown {
  try {
    return JSON.parse(input);
  } catch {
    return input.trim();
  }
}

export const shown = (value: unknown): string =>
  value === undefined || value === null ? "" : typeof value === "string" ? value : typeof value === "number" ? String(tidy(value)) : JSON.stringify(value);

/** As in configurations: 190 and 190.0 are one value. */
export const same = (a: unknown, b: unknown): boolean => JSON.stringify(a ?? null) === JSON.stringify(b ?? null);
