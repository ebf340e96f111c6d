// Centres of Gaussians out of their packed words, and the one under a ray.

import * as THREE from "three";
import type { Vector } from "../network";
import type { CellGaussians } from "../messages";

const HALVES = Float32Array.from({ length: 65536 }, (_, half) => THREE.DataUtils.fromHalfFloat(half));
/** Mean standard deviation by the sum of the three axes' bytes, metres (`readCell` has the bytes). */
const SIGMAS = Float32Array.from({ length: 766 }, (_, sum) => Math.exp(((sum / 3 - 1) * 21) / 254 - 12));
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
      const word = packed[4 * i + 3];
      const sigma = SIGMAS[(word & 255) + ((word >> 8) & 255) + ((word >> 16) & 255)];
      const reach = Math.min(Math.max(sigma, t * pxRad), t * pxRad * MOST_PX);
      if (x * x + y * y + z * z - t * t > reach * reach) continue;
      nearest = t;
      best = { point: [centre[0], centre[1], centre[2]], cell, index: i, distanceM: t };
    }
  }
  return best;
}
