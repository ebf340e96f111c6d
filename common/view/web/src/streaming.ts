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
    const cells = this.description.cells.map((cell, index) => ({ cell, index })).filter(({ cell }) => cell.state === "on_board");
    const distance = ({ min, max }: { min: number[]; max: number[] }) =>
      Math.hypot(...at.map((v, i) => Math.max(min[i] - v, 0, v - max[i])));
    cells.sort((a, b) => distance(a.cell.box_m) - distance(b.cell.box_m) || a.index - b.index);
    let nGaussians = 0;
    let isLoaded = true;
    for (const { cell, index } of cells) {
      nGaussians += cell.n_gaussians;
      if (nGaussians > MAX_GAUSSIANS && index !== cells[0].index) {
        this.drawing.cells.remove(index);
      } else if (!this.drawing.cells.has(index)) {
        isLoaded = false;
        if (this.underWay.size < AT_A_TIME) void this.load(cell.cell, index);
      }
    }
    this.isLoaded = isLoaded;
  }

  /** Whether all cells that the budget allows are drawn. */
  get isComplete(): boolean {
    return this.isLoaded;
  }

  private async load(cell: number, index: number): Promise<void> {
    if (this.underWay.has(index)) return;
    this.underWay.add(index);
    try {
      const gaussians = await fetchCell(cell, this.description.generation);
      if (this.isStopped) return;
      this.drawing.cells.add(index, gaussians);
      this.drawing.redraw();
      this.underWay.delete(index);
      this.update();
      this.onCell();
    } catch (error) {
      // The next look at the service tries again.
      this.underWay.delete(index);
      if (!this.isStopped) this.onError(error);
    }
  }
}
