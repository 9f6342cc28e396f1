// The last minute of a few figures, at a fixed rate, in one table: rows fall out at the old end, gaps are null. Pure.

export const SPAN_MS = 60_000;
export const STEP_MS = 100;

export class History<K extends string> {
  private times: number[] = [];
  private readonly columns: Record<K, (number | null)[]>;

  constructor(private readonly names: readonly K[]) {
    this.columns = Object.fromEntries(names.map((name) => [name, []])) as unknown as Record<K, (number | null)[]>;
  }

  push(time_ms: number, row: Partial<Record<K, number | null>>): void {
    const last = this.times.at(-1);
    if (last !== undefined && time_ms <= last) this.clear(); // another clock
    this.times.push(time_ms);
    for (const name of this.names) this.columns[name].push(row[name] ?? null);
    const kept = this.times.findIndex((time) => time >= time_ms - SPAN_MS);
    if (kept <= 0) return;
    this.times.splice(0, kept);
    for (const name of this.names) this.columns[name].splice(0, kept);
  }

  clear(): void {
    this.times = [];
    for (const name of this.names) this.columns[name].length = 0;
  }

  /** Seconds before the newest row (0 or less), then the columns. */
  table(...names: K[]): [number[], ...(number | null)[][]] {
    const newest = this.times.at(-1) ?? 0;
    return [this.times.map((time) => (time - newest) / 1000), ...names.map((name) => [...this.columns[name]])];
  }
}
