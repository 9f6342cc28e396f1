// Numbers for people. No data is a dash, never 0.

export const DASH = "–";

export function fixed(value: number | null | undefined, digits: number): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−"); // a value that wavers around 0 must not flicker its sign
}

export const degrees = (rad: number | null | undefined, digits = 1): string =>
  fixed(rad === null || rad === undefined ? null : (rad * 180) / Math.PI, digits);

/** `34 ms`, `1.2 s`, `3 min` */
export function duration(ms: number | null | undefined): string {
  if (ms === null || ms === undefined || !Number.isFinite(ms)) return DASH;
  const size = Math.max(0, ms);
  if (size < 999.5) return `${Math.round(size)} ms`;
  if (size < 60_000) return `${(size / 1000).toFixed(1)} s`;
  if (size < 3_600_000) return `${Math.floor(size / 60_000)} min ${Math.floor((size % 60_000) / 1000)} s`;
  return `${Math.floor(size / 3_600_000)} h ${Math.floor((size % 3_600_000) / 60_000)} min`;
}

/** Microseconds: `320 µs`, `1.2 ms` */
export function microseconds(us: number | null | undefined): string {
  if (us === null || us === undefined || !Number.isFinite(us)) return DASH;
  if (us < 999.5) return `${Math.round(us)} µs`;
  return us < 99_950 ? `${(us / 1000).toFixed(1)} ms` : `${Math.round(us / 1000)} ms`;
}

export function hertz(value: number | null | undefined): string {
  return value === null || value === undefined ? DASH : `${fixed(value, value < 9.95 ? 1 : 0)} Hz`;
}

/** `27.6 MB/s` */
export function bytesPerSecond(value: number | null | undefined): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  const units = ["B/s", "kB/s", "MB/s", "GB/s"];
  let [size, unit] = [value, 0];
  while (size >= 999.5 && unit < units.length - 1) [size, unit] = [size / 1000, unit + 1];
  return `${size < 9.95 && unit > 0 ? size.toFixed(1) : Math.round(size)} ${units[unit]}`;
}

/** Without the milliseconds, where there is little room. */
export const shortTime = (time_ms: number): string => timeOfDay(time_ms).replace(/(:\d\d)\.\d+$/, "$1");

/** Time of day of a stamp on the car's clock; clocks of a lockstep run start at 0 and are shown so. */
export function timeOfDay(time_ms: number): string {
  if (time_ms < 1e11) return `${(time_ms / 1000).toFixed(2)} s`;
  const at = new Date(time_ms);
  const two = (value: number) => String(value).padStart(2, "0");
  return `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}.${String(at.getMilliseconds()).padStart(3, "0")}`;
}
