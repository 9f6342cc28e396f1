// From the car's pixels to those of the image. The lane image frame has its origin in the middle of the bottom row; `left_px` counts
// columns to the left, `ahead_px` rows upwards (docs/frames-and-units.md). Answers are shares of width and height, from the top left,
// so that they fit the image at any size.
import type { Lane } from "./values";
import { number, type Fields } from "./read";

export interface Size { width: number; height: number }
export interface Point { x: number; y: number }
export interface Band { top: number; bottom: number }

/** Pixels are counted in whole numbers, and their middle is half a pixel on. */
export function inImage(left_px: number, ahead_px: number, source: Size): Point {
  return {
    x: ((source.width - 1) / 2 - left_px + 0.5) / source.width,
    y: (source.height - 1 - ahead_px + 0.5) / source.height,
  };
}

/** The line through both centroids from the bottom of the image to a little above the far one. */
export function lineOf(lane: Lane, source: Size): [Point, Point] {
  const rise = lane.far.ahead_px - lane.near.ahead_px;
  const slope = rise === 0 ? 0 : (lane.far.left_px - lane.near.left_px) / rise;
  const leftAt = (ahead_px: number) => lane.near.left_px + slope * (ahead_px - lane.near.ahead_px);
  const top = lane.far.ahead_px + Math.abs(rise) * 0.6;
  return [inImage(leftAt(0), 0, source), inImage(leftAt(top), top, source)];
}

/** The bands of rows that the detector reads, far one first. */
export function bandsOf(config: Fields, source: Size): Band[] {
  const half = (number(config.band_px) ?? 1) / 2 / source.height;
  return [number(config.row_far), number(config.row_near)]
    .filter((row): row is number => row !== null)
    .map((row) => ({ top: row - half, bottom: row + half }));
}
