// Where no object answers, groups of lit Gaussians do: voxels that touch, as robots group them.

import { centreOf } from "./drawing/pick";
import type { CellGaussians, Scores } from "./messages";
import { type Answer, type Description, MAX_ANSWERS, type Vector } from "./network";

/** The robot's own. */
const MIN_COUNT = 10;
const METRIC_VOXEL_M = 0.25;
/** Along a cell, where units are not metres. */
const VOXELS_PER_CELL = 64;

interface Voxel {
  points: Vector[];
  sum: number;
  isTaken: boolean;
}

const middleOf = (values: number[]) => values.sort((a, b) => a - b)[Math.floor(values.length / 2)] ?? 0;

/** Edge of the voxels, the robot's own. */
export function voxelOf({ metric, cells }: Description): number {
  if (metric) return METRIC_VOXEL_M;
  return middleOf(cells.map(({ box_m: { min, max } }) => middleOf(min.map((low, i) => max[i] - low)))) / VOXELS_PER_CELL || 1;
}

/** The score that the best thousandth of the Gaussians that are drawn reach, and as many as make a group; null without scores. */
export function topScore(cells: Iterable<[number, CellGaussians]>, scores: Scores): number | null {
  const counts = new Uint32Array(256);
  for (const [cell, { n, step }] of cells) {
    const levels = scores.byCell.get(cell);
    for (let i = 0; levels && i < n; i++) counts[levels[i * step]]++;
  }
  const most = Math.max(counts.slice(1).reduce((sum, count) => sum + count, 0) / 1000, 5 * MIN_COUNT);
  for (let level = 255, n = 0; level > 0; level--) {
    n += counts[level];
    if (n >= most) return scores.min + (level / 255) * (scores.max - scores.min);
  }
  return null;
}

/** Groups of Gaussians that score at least the threshold, best first. */
export function clustersOf(cells: Iterable<[number, CellGaussians]>, scores: Scores, threshold: number, edge: number): Answer[] {
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
  return found.sort((a, b) => b.score * Math.sqrt(b.n_gaussians ?? 0) - a.score * Math.sqrt(a.n_gaussians ?? 0)).slice(0, MAX_ANSWERS + 1);
}

function answerOf(points: Vector[], score: number): Answer {
  const along = (f: (values: number[]) => number) => [0, 1, 2].map((axis) => f(points.map((point) => point[axis]))) as Vector;
  return {
    score, n_gaussians: points.length,
    position_in_world: along((values) => values.reduce((a, b) => a + b) / values.length),
    box_min_in_world: along((values) => values.reduce((a, b) => Math.min(a, b))), box_max_in_world: along((values) => values.reduce((a, b) => Math.max(a, b))),
  };
}
