// Where no object answers, groups of lit Gaussians do: voxels that touch, as robots group them.

import { centreOf } from "./drawing/pick";
import type { CellGaussians, Scores } from "./messages";
import type { Answer, Vector } from "./network";

/** The robot's own. */
const MIN_COUNT = 10;
const VOXEL_M = 0.25;
const MAX_CLUSTERS = 20;
/** Voxels are at most so many along the scene's diagonal, or groups of a survey fall apart. */
const MAX_ALONG = 400;

interface Voxel {
  points: Vector[];
  sum: number;
  isTaken: boolean;
}

/** Groups of Gaussians that score at least the threshold, best first. */
export function clustersOf(cells: Iterable<[number, CellGaussians]>, scores: Scores, threshold: number, diagonalM: number): Answer[] {
  const edge = Math.max(VOXEL_M, diagonalM / MAX_ALONG);
  const voxels = new Map<string, Voxel>();
  const keyOf = (at: number[]) => at.join(",");
  for (const [cell, gaussians] of cells) {
    const levels = scores.byCell.get(cell);
    for (let i = 0; levels && i < gaussians.n; i++) {
      const score = scores.min + (levels[i * gaussians.step] / 255) * (scores.max - scores.min);
      if (levels[i * gaussians.step] === 0 || score < threshold) continue;
      const point: Vector = [0, 0, 0];
      centreOf(gaussians, i, point);
      const key = keyOf(point.map((v) => Math.floor(v / edge)));
      const voxel = voxels.get(key) ?? { points: [], sum: 0, isTaken: false };
      voxel.points.push(point);
      voxel.sum += score;
      voxels.set(key, voxel);
    }
  }
  const found: Answer[] = [];
  for (const [start, voxel] of voxels) {
    if (voxel.isTaken) continue;
    voxel.isTaken = true;
    const points: Vector[] = [];
    let sum = 0;
    const open: [string, Voxel][] = [[start, voxel]];
    for (let next = open.pop(); next; next = open.pop()) {
      for (const point of next[1].points) points.push(point);
      sum += next[1].sum;
      const at = next[0].split(",").map(Number);
      for (let i = 0; i < 27; i++) {
        const key = keyOf([at[0] + (i % 3) - 1, at[1] + (Math.floor(i / 3) % 3) - 1, at[2] + Math.floor(i / 9) - 1]);
        const beside = voxels.get(key);
        if (!beside || beside.isTaken) continue;
        beside.isTaken = true;
        open.push([key, beside]);
      }
    }
    if (points.length >= MIN_COUNT) found.push(answerOf(points, sum / points.length));
  }
  return found.sort((a, b) => b.score * Math.sqrt(b.n_gaussians ?? 0) - a.score * Math.sqrt(a.n_gaussians ?? 0)).slice(0, MAX_CLUSTERS);
}

function answerOf(points: Vector[], score: number): Answer {
  const along = (f: (values: number[]) => number) => [0, 1, 2].map((axis) => f(points.map((point) => point[axis]))) as Vector;
  return {
    score, n_gaussians: points.length,
    position_in_world: along((values) => values.reduce((a, b) => a + b) / values.length),
    box_min_in_world: along((values) => values.reduce((a, b) => Math.min(a, b))), box_max_in_world: along((values) => values.reduce((a, b) => Math.max(a, b))),
  };
}
