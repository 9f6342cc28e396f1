// Draws what a camera on the car might see: a dark floor with a bright marking whose course is known, so that the lane estimates of
// the mock match its images exactly.
import jpeg from "jpeg-js";

export const SOURCE = { width: 640, height: 480 };
const HORIZON = 0.36;
const SHADES = 24;

/** Columns to the left of the middle at so many rows above the bottom, for a bend of -1 (right) to 1 (left). */
export const leftAt = (ahead_px, bend) => bend * (18 + 0.16 * ahead_px + 0.0011 * ahead_px * ahead_px);

export function greyAt(x, y, bend) {
  const horizon = SOURCE.height * HORIZON;
  if (y < horizon) return 96 + ((x * 7) % 5) + (horizon - y) * 0.18;
  const depth = (y - horizon) / (SOURCE.height - horizon);
  const middle = (SOURCE.width - 1) / 2 - leftAt(SOURCE.height - 1 - y, bend);
  const half = 2 + 13 * depth;
  const edge = Math.abs(x - middle) - half;
  const floor = 52 + 14 * depth + ((x * 13 + y * 29) % 7);
  return edge < 0 ? 230 : edge < 1.5 ? 150 : floor;
}

const tints = { floor: [0.94, 1, 1.05], marking: [1, 1, 0.97] };
export function rgbAt(x, y, bend) {
  const grey = greyAt(x, y, bend);
  return (grey > 190 ? tints.marking : tints.floor).map((tint) => Math.min(255, Math.round(grey * tint)));
}

function draw(width, height, paint) {
  const data = Buffer.alloc(width * height * 4, 255);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const [r, g, b] = paint(Math.floor(((x + 0.5) * SOURCE.width) / width), Math.floor(((y + 0.5) * SOURCE.height) / height));
      const at = (y * width + x) * 4;
      [data[at], data[at + 1], data[at + 2]] = [r, g, b];
    }
  }
  return Buffer.from(jpeg.encode({ data, width, height }, 72).data);
}

const cache = new Map();
/** One of a few shades of bend, since drawing takes longer than a frame may. */
export const shadeOf = (bend) => Math.round(bend * SHADES) / SHADES;

export function picture(kind, bend, threshold) {
  const name = `${kind} ${bend} ${kind === "debug" ? threshold : ""}`;
  if (!cache.has(name)) {
    if (cache.size > 400) cache.clear();
    const paint = kind === "camera"
      ? (x, y) => rgbAt(x, y, bend)
      : (x, y) => (greyAt(x, y, bend) > threshold && y > SOURCE.height * 0.6 ? [255, 255, 255] : [0, 0, 0]);
    cache.set(name, draw(480, 360, paint));
  }
  return cache.get(name);
}

export function hsvOf([r, g, b]) {
  const [max, min] = [Math.max(r, g, b), Math.min(r, g, b)];
  const span = max - min;
  let hue = 0;
  if (span > 0) hue = max === r ? (60 * (g - b)) / span : max === g ? 120 + (60 * (b - r)) / span : 240 + (60 * (r - g)) / span;
  return [Math.round((hue + 360) % 360 / 2), max === 0 ? 0 : Math.round((255 * span) / max), max];
}
