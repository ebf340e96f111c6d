// Fetches cells: first every few Gaussians of all of them, nearest cells first, so that there is a picture of
// the whole at once; then near cells in full and far ones as the budget of Gaussians allows.

import type { Drawing } from "./drawing/drawing";
import { type Cell, type Description, fetchCell } from "./network";

const AT_A_TIME = 4;
/** Gaussians of the first picture, 16 bytes each. A scene of twice as many is fetched in full at once. */
const FIRST_PICTURE = 200_000;
/** Gaussians that are drawn at most: the renderer's own default for computers. */
const MAX_GAUSSIANS = 2_500_000;
/** Lower bound of that budget, for slow browsers. */
const MIN_GAUSSIANS = 400_000;
/** Share of the budget for near cells in full. */
const NEAR_SHARE = 0.6;

/** The smallest power of two as a step with which `n` Gaussians are at most `most`. */
function stepFor(n: number, most: number): number {
  return 2 ** Math.ceil(Math.log2(Math.max(n / Math.max(most, 1), 1)));
}

/**
 * Chooses a step for each cell, in the order of their distance: 1 while they fit into the share of near cells,
 * one for all others.
 */
export function chooseSteps(counts: number[], budget: number): number[] {
  const total = counts.reduce((sum, n) => sum + n, 0);
  if (total <= budget) return counts.map(() => 1);
  let nNear = 0;
  let near = 0;
  while (nNear < counts.length && near + counts[nNear] <= NEAR_SHARE * budget) near += counts[nNear++];
  const step = stepFor(total - near, budget - near);
  return counts.map((_, at) => (at < nNear ? 1 : step));
}

export class Streaming {
  private readonly underWay = new Set<number>();
  private readonly cells: Cell[];
  private readonly firstStep: number;
  private budget = MAX_GAUSSIANS;
  private isStopped = false;
  private isLoaded = false;
  private onWhole = () => {};
  /** Once all cells are drawn, if with few Gaussians. */
  readonly whole = new Promise<void>((resolve) => (this.onWhole = resolve));

  constructor(private readonly description: Description, private readonly drawing: Drawing,
    private readonly onCell: () => void, private readonly onError: (error: unknown) => void) {
    this.cells = description.cells.filter(({ state }) => state !== "missing");
    const total = this.cells.reduce((sum, { n_gaussians }) => sum + n_gaussians, 0);
    this.firstStep = total > 2 * FIRST_PICTURE ? stepFor(total, FIRST_PICTURE) : 1;
  }

  stop(): void {
    this.isStopped = true;
  }

  /** Draws fewer Gaussians from now on: at most this share of those that are drawn. */
  lower(share: number): void {
    const budget = Math.max(Math.min(this.budget, this.drawing.cells.nDrawn) * share, MIN_GAUSSIANS);
    if (budget >= this.budget) return;
    this.budget = budget;
    this.update();
  }

  /** Chooses cells for where the camera is. */
  update(): void {
    if (this.isStopped) return;
    const at = this.drawing.pose().position;
    const distance = ({ min, max }: { min: number[]; max: number[] }) =>
      Math.hypot(...at.map((v, i) => Math.max(min[i] - v, 0, v - max[i])));
    this.cells.sort((a, b) => distance(a.box_m) - distance(b.box_m) || a.cell - b.cell);
    const first = this.cells.filter(({ cell }) => this.drawing.cells.stepOf(cell) === null);
    if (first.length === 0) this.onWhole();
    const steps = chooseSteps(this.cells.map(({ n_gaussians }) => n_gaussians), this.budget);
    const rest = this.cells.map(({ cell }, i): [number, number] => [cell, steps[i]]).filter(([cell, step]) => this.drawing.cells.stepOf(cell) !== step);
    this.isLoaded = rest.length === 0;
    const wanted = first.length > 0 ? first.map(({ cell }): [number, number] => [cell, this.firstStep]) : rest;
    for (const [cell, step] of wanted) {
      if (this.underWay.size >= AT_A_TIME) break;
      void this.load(cell, step);
    }
  }

  /** Whether all cells are drawn, with as many Gaussians as the budget allows. */
  get isComplete(): boolean {
    return this.isLoaded;
  }

  private async load(cell: number, step: number): Promise<void> {
    if (this.underWay.has(cell)) return;
    this.underWay.add(cell);
    try {
      const gaussians = await fetchCell(cell, this.description.generation, step);
      if (this.isStopped) return;
      this.drawing.cells.add(cell, gaussians);
      this.drawing.redraw();
      this.underWay.delete(cell);
      this.update();
      this.onCell();
    } catch (error) {
      // The next look at the service tries again.
      this.underWay.delete(cell);
      if (!this.isStopped) this.onError(error);
    }
  }
}
