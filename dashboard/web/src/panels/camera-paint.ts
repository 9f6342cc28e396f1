// Draws the detector's view over the camera image, at any size: on the screen and in snapshots alike. Colours are fixed, since they
// lie on pictures and not on the page; each shape has an outline, so that it is seen on bright and on dark floors.
import { bandsOf, inImage, lineOf, type Point, type Size } from "../overlay";
import type { Fields } from "../read";
import type { Lane } from "../values";

export interface Area { x: number; y: number; width: number; height: number }
export interface Layers { rows: Fields | null; line: Lane | null; points: Lane | null }

/** As large as fits, undistorted, in the middle. */
export function contain(size: Size, width: number, height: number): Area {
  const scale = Math.min(width / size.width, height / size.height);
  const [wide, tall] = [size.width * scale, size.height * scale];
  return { x: (width - wide) / 2, y: (height - tall) / 2, width: wide, height: tall };
}

export function paintLane(context: CanvasRenderingContext2D, area: Area, scale: number, source: Size, layers: Layers): void {
  const at = (share: Point) => [area.x + share.x * area.width, area.y + share.y * area.height] as const;
  context.save();
  context.beginPath();
  context.rect(area.x, area.y, area.width, area.height);
  context.clip();
  if (layers.rows) paintBands(context, area, scale, source, layers.rows);
  if (layers.line) {
    const [from, to] = lineOf(layers.line, source);
    stroke(context, [["rgba(0, 0, 0, 0.6)", 5 * scale], ["#f0c000", 2.5 * scale]], () => {
      context.moveTo(...at(from));
      context.lineTo(...at(to));
    });
  }
  if (layers.points) {
    for (const point of [layers.points.far, layers.points.near]) {
      const [x, y] = at(inImage(point.left_px, point.ahead_px, source));
      context.beginPath();
      context.arc(x, y, 6 * scale, 0, 2 * Math.PI);
      context.fillStyle = "#d55e00";
      context.fill();
      context.strokeStyle = "#fff";
      context.lineWidth = 2 * scale;
      context.stroke();
    }
  }
  context.restore();
}

function paintBands(context: CanvasRenderingContext2D, area: Area, scale: number, source: Size, config: Fields): void {
  context.fillStyle = "rgba(86, 180, 233, 0.75)";
  for (const band of bandsOf(config, source)) {
    const tall = Math.max(1.5 * scale, (band.bottom - band.top) * area.height);
    context.fillRect(area.x, area.y + band.top * area.height, area.width, tall);
  }
}

/** Four ticks around the place, which stays free to be seen. */
export function paintCrosshair(context: CanvasRenderingContext2D, x: number, y: number): void {
  stroke(context, [["rgba(0, 0, 0, 0.7)", 3], ["#fff", 1]], () => {
    for (const side of [-1, 1]) {
      context.moveTo(x + side * 4, y);
      context.lineTo(x + side * 12, y);
      context.moveTo(x, y + side * 4);
      context.lineTo(x, y + side * 12);
    }
  });
}

function stroke(context: CanvasRenderingContext2D, strokes: [string, number][], path: () => void): void {
  for (const [style, width] of strokes) {
    context.beginPath();
    path();
    context.strokeStyle = style;
    context.lineWidth = width;
    context.stroke();
  }
}
