// Fetches cells, nearest first, until the budget of Gaussians is spent.

import type { Drawing } from "./drawing/drawing";
import { type Description, fetchCell } from "./network";

const AT_A_TIME = 3;
/** Bounds the GPU's memory: 20 bytes a Gaussian here, and as much again in the renderer. */
const MAX_GAUSSIANS = 4_000_000;

export class Streaming {
  private readonly underWay = new Set<number>();
  private isStopped = false;
  private isLoaded = false;

  constructor(private readonly description: Description, private readonly drawing: Drawing,
    private readonly onCell: () => void, private readonly onError: (error: unknown) => void) {}

  stop(): void {
    this.isStopped = true;
  }

  /** Chooses cells for where the camera is. */
  update(): void {
    if (this.isStopped) return;
    const at = this.drawing.pose().position;
    const cells = this.description.cells.filter(({ state }) => state !== "missing");
    const distance = ({ min, max }: { min: number[]; max: number[] }) =>
      Math.hypot(...at.map((v, i) => Math.max(min[i] - v, 0, v - max[i])));
    cells.sort((a, b) => distance(a.box_m) - distance(b.box_m) || a.cell - b.cell);
    let nGaussians = 0;
    let isLoaded = true;
    for (const { cell, n_gaussians } of cells) {
      nGaussians += n_gaussians;
      if (nGaussians > MAX_GAUSSIANS && cell !== cells[0].cell) {
        this.drawing.cells.remove(cell);
      } else if (!this.drawing.cells.has(cell)) {
        isLoaded = false;
        if (this.underWay.size < AT_A_TIME) void this.load(cell);
      }
    }
    this.isLoaded = isLoaded;
  }

  /** Whether all cells that the budget allows are drawn. */
  get isComplete(): boolean {
    return this.isLoaded;
  }

  private async load(cell: number): Promise<void> {
    if (this.underWay.has(cell)) return;
    this.underWay.add(cell);
    try {
      const gaussians = await fetchCell(cell, this.description.generation);
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
