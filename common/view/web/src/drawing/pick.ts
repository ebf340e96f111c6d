// Centres of Gaussians out of their packed words, and the one under a ray.

import * as THREE from "three";
import type { Vector } from "../network";
import type { CellGaussians } from "../messages";

const HALVES = Float32Array.from({ length: 65536 }, (_, half) => THREE.DataUtils.fromHalfFloat(half));
/** Standard deviation of an axis by its byte, metres (`readCell` has the bytes). */
const SIGMAS = Float32Array.from({ length: 256 }, (_, byte) => (byte === 0 ? 0 : Math.exp(((byte - 1) * 21) / 254 - 12)));
/** Less opaque ones are not what is seen. */
const LEAST_OPACITY = 90;
/** A Gaussian counts as hit within so many pixels of the ray at most, and one at least. */
const MOST_PX = 6;

/** Writes a Gaussian's centre in world metres. */
export function centreOf({ packed, originM }: CellGaussians, i: number, out: Vector | Float64Array): void {
  const xy = packed[4 * i + 1];
  out[0] = originM[0] + HALVES[xy & 0xffff];
  out[1] = originM[1] + HALVES[xy >>> 16];
  out[2] = originM[2] + HALVES[packed[4 * i + 2] & 0xffff];
}

/** Standard deviation along the axis that is neither the shortest nor the longest: the radius of a disk. */
function sigmaOf(packed: Uint32Array, i: number): number {
  const word = packed[4 * i + 3];
  const [a, b, c] = [word & 255, (word >> 8) & 255, (word >> 16) & 255];
  return SIGMAS[a + b + c - Math.min(a, b, c) - Math.max(a, b, c)];
}

/** Share of the light that reaches a place from a point of a ray, by every `stride`-th Gaussian; they count as balls. */
export function lightAlong(cells: Iterable<[number, CellGaussians]>, from: Vector, along: Vector, untilM: number, stride: number): number {
  const centre = new Float64Array(3);
  let light = 1;
  for (const [, gaussians] of cells) {
    for (let i = 0; i < gaussians.n; i += stride) {
      centreOf(gaussians, i, centre);
      const [x, y, z] = [centre[0] - from[0], centre[1] - from[1], centre[2] - from[2]];
      const t = x * along[0] + y * along[1] + z * along[2];
      if (t <= 0 || t > untilM) continue;
      const variance = sigmaOf(gaussians.packed, i) ** 2;
      const squared = x * x + y * y + z * z - t * t;
      if (squared < 9 * variance) light *= 1 - ((gaussians.packed[4 * i] >>> 24) / 255) * Math.exp((-0.5 * squared) / variance);
    }
  }
  return light ** stride;
}

export interface Hit {
  point: Vector;
  cell: number;
  /** Among the cell's Gaussians that are drawn. */
  index: number;
  distanceM: number;
}

/** The nearest Gaussian that a ray meets; `pxRad`: angle of a pixel. */
export function pick(cells: Iterable<[number, CellGaussians]>, from: Vector, along: Vector, pxRad: number): Hit | null {
  const centre = new Float64Array(3);
  let best: Hit | null = null;
  let nearest = Infinity;
  for (const [cell, gaussians] of cells) {
    const { packed, n } = gaussians;
    for (let i = 0; i < n; i++) {
      if (packed[4 * i] >>> 24 < LEAST_OPACITY) continue;
      centreOf(gaussians, i, centre);
      const [x, y, z] = [centre[0] - from[0], centre[1] - from[1], centre[2] - from[2]];
      const t = x * along[0] + y * along[1] + z * along[2];
      if (t <= 0 || t >= nearest) continue;
      const reach = Math.min(Math.max(sigmaOf(packed, i), t * pxRad), t * pxRad * MOST_PX);
      if (x * x + y * y + z * z - t * t > reach * reach) continue;
      nearest = t;
      best = { point: [centre[0], centre[1], centre[2]], cell, index: i, distanceM: t };
    }
  }
  return best;
}
