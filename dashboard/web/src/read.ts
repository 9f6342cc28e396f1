// Reads values of unknown shape. What a server sends is checked before it is used: a bad message is counted, it never breaks the page.

export type Json = null | boolean | number | string | Json[] | { [key: string]: Json };
export type Fields = Record<string, unknown>;

export const isFields = (value: unknown): value is Fields =>
  typeof value === "object" && value !== null && !Array.isArray(value);

export const fields = (value: unknown): Fields => (isFields(value) ? value : {});
export const list = (value: unknown): unknown[] => (Array.isArray(value) ? value : []);
export const number = (value: unknown): number | null =>
  typeof value === "number" && Number.isFinite(value) ? value : null;
export const count = (value: unknown): number => number(value) ?? 0;
export const text = (value: unknown): string | null => (typeof value === "string" ? value : null);

/** The numbers of those names, or null when one is missing. */
export function numbers<K extends string>(value: unknown, ...names: K[]): Record<K, number> | null {
  const from = fields(value);
  const read = {} as Record<K, number>;
  for (const name of names) {
    const found = number(from[name]);
    if (found === null) return null;
    read[name] = found;
  }
  return read;
}
