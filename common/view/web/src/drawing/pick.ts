// Centres of Gaussians out of their packed words, and the one under a ray.

import { utils } from "@sparkjsdev/spark";
import * as THREE from "three";
import type { Vector } from "../network";
import type { CellGaussians } from "../messages";

const HALVES = Float32Array.from({ length: 65536 }, (_, half) => THREE.DataUtils.fromHalfFloat(half));
/** Standard deviation of an axis by its byte, metres (`readCell` has the bytes). */
const SIGMAS = Float32Array.from({ length: 256 }, (_, byte) => (byte === 0 ? 0 : Math.exp(((byte - 1) * 21) / 254 - 12)));
/** A Gaussian is met within so many standard deviations of its middle. */
const MOST_SIGMAS = 2;
/** Where a ray meets one, it takes this share of the light at least. */
const LEAST_ALPHA = 0.02;
/** What is seen lies where this share of the light is left, or what takes the most if more of it comes through. */
const HALF = 0.5;
/** All Gaussians along a ray take this share of the light at least, or there is nothing. */
const LEAST_TAKEN = 0.2;
/** The renderer's blur, which makes the smallest ones a pixel wide, pixels. */
const BLUR_PX = 0.55;

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

/** Where a ray meets an ellipsoid most, and which share of the light that takes; null where it passes by. */
class Ellipsoids {
  private readonly turn = new THREE.Quaternion();
  private readonly from = new THREE.Vector3();
  private readonly along = new THREE.Vector3();

  /** `offset`: from the ray's start to the Gaussian's middle. */
  meet(packed: Uint32Array, i: number, offset: Vector, along: Vector, blur: number): [number, number] | null {
    const [, , shape, scales] = packed.subarray(4 * i, 4 * i + 4);
    utils.decodeQuatOctXy88R8((shape >>> 16) | ((scales >>> 24) << 16), this.turn).invert();
    const sigma = [scales & 255, (scales >> 8) & 255, (scales >> 16) & 255].map((byte) => Math.hypot(SIGMAS[byte], blur));
    // In its own axes and standard deviations it is a ball of radius 1.
    const from = this.from.set(-offset[0], -offset[1], -offset[2]).applyQuaternion(this.turn);
    const ray = this.along.set(...along).applyQuaternion(this.turn);
    from.set(from.x / sigma[0], from.y / sigma[1], from.z / sigma[2]);
    ray.set(ray.x / sigma[0], ray.y / sigma[1], ray.z / sigma[2]);
    const distance = -from.dot(ray) / ray.lengthSq();
    const squared = from.addScaledVector(ray, distance).lengthSq();
    const alpha = ((packed[4 * i] >>> 24) / 255) * Math.exp(-0.5 * squared);
    return distance <= 0 || squared > MOST_SIGMAS ** 2 || alpha < LEAST_ALPHA ? null : [distance, alpha];
  }
}

/** The surface that a ray meets: where the nearest Gaussians have taken half of the light; `pxRad`: angle of a pixel. */
export function pick(cells: Iterable<[number, CellGaussians]>, from: Vector, along: Vector, pxRad: number): Hit | null {
  const centre = new Float64Array(3);
  const ellipsoids = new Ellipsoids();
  const met: { hit: Hit; alpha: number }[] = [];
  for (const [cell, gaussians] of cells) {
    const { packed, n } = gaussians;
    for (let i = 0; i < n; i++) {
      centreOf(gaussians, i, centre);
      const [x, y, z] = [centre[0] - from[0], centre[1] - from[1], centre[2] - from[2]];
      const t = x * along[0] + y * along[1] + z * along[2];
      const scales = packed[4 * i + 3];
      const blur = BLUR_PX * pxRad * Math.max(t, 0);
      const reach = MOST_SIGMAS * (SIGMAS[Math.max(scales & 255, (scales >> 8) & 255, (scales >> 16) & 255)] + blur);
      if (t <= -reach || x * x + y * y + z * z - t * t > reach * reach) continue;
      const found = ellipsoids.meet(packed, i, [x, y, z], along, blur);
      if (!found) continue;
      const [distanceM, alpha] = found;
      met.push({ hit: { point: from.map((v, k) => v + along[k] * distanceM) as Vector, cell, index: i, distanceM }, alpha });
    }
  }
  met.sort((a, b) => a.hit.distanceM - b.hit.distanceM);
  let light = 1;
  let most = 0;
  let best: Hit | null = null;
  for (const { hit, alpha } of met) {
    if (light * alpha > most) [most, best] = [light * alpha, hit];
    light *= 1 - alpha;
    if (light < HALF) return hit;
  }
  return 1 - light < LEAST_TAKEN ? null : best;
}
